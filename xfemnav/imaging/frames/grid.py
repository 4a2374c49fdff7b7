"""Grid: where the values of an image lie in the world, and in its file: pixels of a `Slice`, voxels of a `Volume`."""

from typing import Protocol

import numpy as np


class Grid(Protocol):
    """`values` on a grid of d axes: their `spacing` (d,) mm; `axes` (3, 3) of its points, unit vectors in world RAS as
    rows; `thickness` mm, to half of which points off the grid still belong to it; and `affine` (4, 4) of its file."""

    values: np.ndarray
    spacing: np.ndarray
    axes: np.ndarray
    thickness: float
    affine: np.ndarray

    @property
    def lattice(self) -> tuple:
        """Origin (d,), and spacing (d,) or steps (3, 3), mm; and shape (d,): where a pull-back puts its pixels."""

    def to_world(self, points) -> np.ndarray:
        """World RAS mm (n, 3) of points (n, d) on the grid's axes."""

    def from_world(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, d) of world points (n, 3) RAS mm, and how far (n,) mm these are off the grid."""

    def pixel_centres(self) -> np.ndarray:
        """Places (..., d) mm of all values."""

    def to_storage(self, values) -> np.ndarray:
        """Values in the order of the image's file."""

    def header(self):
        """A NIfTI header with the frames of the image's file."""
