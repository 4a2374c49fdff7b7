"""Chart: a cut where it lies in the organ, as all above the parts of a mesh sees it: a `Cut`, a path in the plane, or a
`Sheet` in space."""

from typing import Protocol

import numpy as np


class Chart(Protocol):
    """A cut by its name, with a mouth on the organ's surface or without, and how long it is."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def mouth(self) -> bool:
        """Whether it begins at the organ's surface."""

    @property
    def mouth_line(self) -> np.ndarray:
        """Places (k, d) mm of its mouth: in the plane one, or none without a mouth."""

    @property
    def craniotomy(self) -> bool:
        """Whether the skull is open about its mouth."""

    @property
    def length(self) -> float:
        """Its length, mm."""
