"""Grid: where the values of an image lie in the world, and in its file; a `Slice` is one of pixels in a plane."""

from typing import Protocol

import numpy as np


class Grid(Protocol):
    """Values on a grid of d axes: their `spacing` (d,) mm, and its `axes` (3, 3), unit vectors in world RAS as rows."""

    spacing: np.ndarray
    axes: np.ndarray

    def to_world(self, points) -> np.ndarray:
        """World RAS mm (n, 3) of points (n, d) on the grid's axes."""

    def from_world(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, d) of world points (n, 3) RAS mm, and how far (n,) mm these are off the grid."""

    def pixel_centres(self) -> np.ndarray:
        """Places (..., d) mm of all values."""

    def to_storage(self, values) -> np.ndarray:
        """Values in the order of the image's file."""
