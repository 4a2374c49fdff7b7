"""A scene that is known in closed form: what every format, frame and direction has to say of it.

A square of tissue is cut through its middle, and each half moves by an affine map. The image is a linear function of
the world, so that interpolation is exact, and no two of its axes or directions look alike. World is RAS mm throughout;
nothing here asks the rest of the program what that means.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

HALF = 16.0  # mm, half the square's side
F = np.array([[1.02, 0.05], [-0.03, 1.01]])  # deformation of both halves
SHIFT = np.array([-2.5, 0.7])  # mm, of the left half; the right one goes the other way
CUT = np.array([[0.0, -HALF], [0.0, HALF]])  # left of it is x < 0
SLOPE = np.array([3.0, 5.0, 7.0])  # of the image, per mm of R, A, S
SHAPE, SPACING = (30, 36, 3), np.array([2.0, 1.5, 3.0])
MIDDLE = np.array([14.637, 17.719, 1.0])  # voxel of the square's middle: no pixel's centre is on a border
FROM_CUT = 5.0  # mm, farther than a pixel from any lip: a field on a grid is exact there


class Mismatch(Exception):
    """Something is not as it is known to be."""


def agree(what: str, got, wanted, tolerance: float) -> None:
    """Raise Mismatch when two arrays differ by more than the `tolerance`."""
    got, wanted = np.asarray(got, float), np.asarray(wanted, float)
    if got.shape != wanted.shape:
        raise Mismatch(f"{what} has shape {got.shape}, not {wanted.shape}")
    off = abs(got - wanted)
    if not (off <= tolerance).all():
        raise Mismatch(f"{what} is off by up to {np.nanmax(off):.3g}, allowed is {tolerance:.1g}")


@dataclass(frozen=True, eq=False)
class Scene:
    """The square in an axial slice whose axes e1, e2, normal are the columns of `turn` (3, 3), about `centre` (3,) RAS
    mm. Plane points (n, 2) mm count from the centre."""

    turn: np.ndarray
    centre: np.ndarray

    @cached_property
    def rest(self) -> np.ndarray:
        """Triangles (4, 3, 2) mm of the tissue at rest, two a half."""
        left = np.array([[[-HALF, -HALF], [0, -HALF], [0, HALF]], [[-HALF, -HALF], [0, HALF], [-HALF, HALF]]])
        return np.concatenate([left, left + np.array([HALF, 0])])

    @cached_property
    def moved(self) -> np.ndarray:
        """The same triangles now."""
        return self.rest @ F.T + np.array([1, 1, -1, -1])[:, None, None] * SHIFT

    def now(self, plane) -> np.ndarray:
        """Where the tissue at plane points (n, 2) is now; off the cut and in the square."""
        plane = np.asarray(plane, float)
        return plane @ F.T + np.where(plane[..., :1] < 0, 1, -1) * SHIFT

    def resting(self, plane) -> np.ndarray:
        """Where the tissue now at plane points (n, 2) rested, NaN where there is none."""
        found = np.full(np.shape(plane), np.nan)
        for side in (1, -1):
            at = (plane - side * SHIFT) @ np.linalg.inv(F).T
            inside = (abs(at) < HALF).all(axis=-1) & (side * at[..., 0] < 0)
            found[inside] = at[inside]
        return found

    def inner(self) -> np.ndarray:
        """Plane points (n, 2) well within the halves at rest."""
        x, y = np.meshgrid(np.linspace(FROM_CUT, HALF - FROM_CUT, 4), np.linspace(FROM_CUT - HALF, HALF - FROM_CUT, 5))
        right = np.column_stack([x.ravel(), y.ravel()])
        return np.concatenate([right, right * [-1, 1]])

    def world(self, plane) -> np.ndarray:
        """World (n, 3) RAS mm of plane points (n, 2)."""
        return self.centre + np.asarray(plane) @ self.turn[:, :2].T

    def plane(self, world) -> np.ndarray:
        """Plane points (n, 2) of world ones (n, 3)."""
        return (np.asarray(world) - self.centre) @ self.turn[:, :2]

    @property
    def position_mm(self) -> float:
        """The slice's place along its normal."""
        return float(self.centre @ self.turn[:, 2])

    def image(self, world) -> np.ndarray:
        """Intensity at world points (n, 3)."""
        return 1000 + np.asarray(world) @ SLOPE

    def updated(self, world) -> np.ndarray:
        """Intensity at world points (n, 3) of the slice after the motion; 0 where the tissue has left."""
        plane = self.plane(world)
        rest = self.resting(plane)
        tissue, square = np.isfinite(rest[..., 0]), (abs(plane) < HALF).all(axis=-1)
        return np.select([tissue, square], [self.image(self.world(np.nan_to_num(rest))), 0.0], self.image(world))

    def volume(self, order=(0, 1, 2), flips=(False, False, False)) -> tuple[np.ndarray, np.ndarray]:
        """The image on a grid in some storage order: values, and the affine (4, 4) from voxels to world RAS mm."""
        affine = np.eye(4)
        affine[:3, :3] = self.turn * SPACING
        affine[:3, 3] = self.centre - affine[:3, :3] @ MIDDLE
        voxels = np.moveaxis(np.indices(SHAPE), 0, -1)
        values = self.image(voxels @ affine[:3, :3].T + affine[:3, 3]).transpose(order)
        affine = affine[:, [*order, 3]]
        for axis in np.flatnonzero(flips):
            affine[:, 3] += affine[:, axis] * (values.shape[axis] - 1)
            affine[:, axis] *= -1
        return np.flip(values, np.flatnonzero(flips)), affine


def _rotation(axis, angle: float) -> np.ndarray:
    """Rotation (3, 3) by `angle` rad about the unit vector along `axis` (Rodrigues)."""
    x, y, z = np.array(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


STRAIGHT = Scene(np.eye(3), np.array([12.0, -23.0, 31.0]))
OBLIQUE = Scene(_rotation((1, 2, 0.5), 0.3), np.array([12.0, -23.0, 31.0]))
#: Name: scene, order of the array axes, which of them count backwards.
ORDERS = {
    "RAS": (STRAIGHT, (0, 1, 2), (False, False, False)),
    "LAS": (STRAIGHT, (0, 1, 2), (True, False, False)),
    "LPS": (STRAIGHT, (0, 1, 2), (True, True, False)),
    "PIR": (STRAIGHT, (1, 2, 0), (True, True, False)),
    "oblique": (OBLIQUE, (0, 1, 2), (False, False, False)),
    "oblique LIA": (OBLIQUE, (0, 2, 1), (True, True, False)),
}
