"""Grid: where the values of an image lie in the world, and in its file: pixels of a `Slice`, voxels of a `Volume`."""

from typing import Protocol

import numpy as np

SKEW = 1e-3  # cosine between two axes up to which an affine is rounded, not sheared: .05 mm in 100 mm
SAME_PIXEL = 0.05  # pixels apart up to which two grids are one: files round their affines


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

    def to_pixels(self, points) -> np.ndarray:
        """Pixel coordinates (n, d) of points (n, d)."""

    def padded(self, before, after) -> "Grid":
        """The grid with so many pixels (d,) more along each axis, on either side."""

    @property
    def placed(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (3, d) and shift (3,) that take points to the world."""

    @property
    def corners(self) -> np.ndarray:
        """Places (2^d, d) mm of the values at the grid's corners."""

    def pixel_centres(self) -> np.ndarray:
        """Places (..., d) mm of all values."""

    def to_storage(self, values) -> np.ndarray:
        """Values in the order of the image's file."""

    def header(self):
        """A NIfTI header with the frames of the image's file."""


def by(numbers) -> str:
    """Numbers of a message, as "256 x 256"."""
    return " x ".join(f"{x:.4g}" for x in numbers)


def at(point) -> str:
    """A place in a message, mm."""
    return ", ".join(f"{x:.2f}" for x in point)
