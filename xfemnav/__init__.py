"""xfemnav: update preoperative images after cuts and retractions with the extended finite element method."""

__version__ = "0.1.0"
