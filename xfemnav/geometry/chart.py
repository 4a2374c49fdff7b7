"""Chart: a cut where it lies in the organ, as all above the parts of a mesh sees it; in the plane `Cut`, a path."""

from typing import Protocol


class Chart(Protocol):
    """A cut by its name, with a mouth on the organ's surface or without, and how long it is."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def mouth(self) -> bool:
        """Whether it begins at the organ's surface."""

    @property
    def craniotomy(self) -> bool:
        """Whether the skull is open about its mouth."""

    @property
    def length(self) -> float:
        """Its length, mm."""
