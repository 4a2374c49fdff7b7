"""A signed distance in space: values on a grid that may lie obliquely in the world, and what is read between them."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit

from xfemnav.geometry.mesh import frozen_array

DIGITS = 10  # of axes in mm: over a thousand values as many times 1e-10 mm


class Samples(NamedTuple):
    """A field as kernels read it: index of a place x is (x - origin) @ inverse, `values` are float32 mm."""

    values: np.ndarray
    origin: np.ndarray
    inverse: np.ndarray


@dataclass(frozen=True, eq=False)
class Field:
    """Signed distance from an organ's surface, mm, positive inside.

    `values` (n1, n2, n3) float32, two at least along each axis; values[i, j, k] lies at origin + (i, j, k) @ axes,
    world RAS mm: `origin` (3,), and row a of `axes` (3, 3) is the step from one value to the next along array axis a.
    """

    values: np.ndarray
    origin: np.ndarray
    axes: np.ndarray

    def __post_init__(self):
        for name, dtype, shape in (("values", np.float32, (None,) * 3), ("origin", float, (3,)),
                                   ("axes", float, (3, 3))):
            object.__setattr__(self, name, frozen_array(getattr(self, name), dtype, shape, name))
        if min(self.values.shape) < 2:
            raise ValueError(f"values have shape {self.values.shape}, wanted two along each axis")

    @cached_property
    def samples(self) -> Samples:
        """What kernels read."""
        return Samples(self.values, self.origin, np.linalg.inv(self.axes))

    @property
    def spacing(self) -> np.ndarray:
        """Length (3,) mm of the step along each array axis."""
        return np.linalg.norm(self.axes, axis=1)

    def __call__(self, points) -> np.ndarray:
        """Values (n,) mm at world points (n, 3) mm, linear along each axis; beyond the grid those of its border."""
        return _levels(self.samples, np.array(points, float, ndmin=2))

    def gradient(self, points) -> np.ndarray:
        """Gradients (n, 3) at world points (n, 3) mm: differences over a step of the grid, so that none jumps."""
        return _slopes(self.samples, np.array(points, float, ndmin=2))

    def upright(self) -> tuple["Field", np.ndarray]:
        """The field with its origin at 0 and its axes turned to the nearest that are those of the world, and the turn.

        Place x (3,) in it is origin + x @ turn in the world. What is done there is the same to the last bit wherever
        the field lies: what rounding the turn leaves is rounded away.
        """
        u, _, vt = np.linalg.svd(self.axes)
        return Field(self.values, np.zeros(3), np.round(self.axes @ (u @ vt).T, DIGITS)), u @ vt


@njit(cache=True)
def _at(values, i, j, k):
    """Value at the index (i, j, k), which need not be whole."""
    n1, n2, n3 = values.shape
    i, j, k = min(max(i, 0.0), n1 - 1.0), min(max(j, 0.0), n2 - 1.0), min(max(k, 0.0), n3 - 1.0)
    a, b, c = min(int(i), n1 - 2), min(int(j), n2 - 2), min(int(k), n3 - 2)
    x, y, z = i - a, j - b, k - c
    near = ((values[a, b, c] * (1 - x) + values[a + 1, b, c] * x) * (1 - y)
            + (values[a, b + 1, c] * (1 - x) + values[a + 1, b + 1, c] * x) * y)
    far = ((values[a, b, c + 1] * (1 - x) + values[a + 1, b, c + 1] * x) * (1 - y)
           + (values[a, b + 1, c + 1] * (1 - x) + values[a + 1, b + 1, c + 1] * x) * y)
    return near * (1 - z) + far * z


@njit(cache=True)
def _index(field, x):
    """Index of the place x (3,) mm."""
    a, b, c = x[0] - field.origin[0], x[1] - field.origin[1], x[2] - field.origin[2]
    t = field.inverse
    return (a * t[0, 0] + b * t[1, 0] + c * t[2, 0], a * t[0, 1] + b * t[1, 1] + c * t[2, 1],
            a * t[0, 2] + b * t[1, 2] + c * t[2, 2])


@njit(cache=True)
def level(field, x):
    """Value at a place x (3,) mm of a field's `Samples`."""
    i, j, k = _index(field, x)
    return _at(field.values, i, j, k)


@njit(cache=True)
def slope(field, x, found):
    """Put the gradient at a place x (3,) mm into `found` (3,)."""
    i, j, k = _index(field, x)
    v, t = field.values, field.inverse
    di = _at(v, i + 0.5, j, k) - _at(v, i - 0.5, j, k)
    dj = _at(v, i, j + 0.5, k) - _at(v, i, j - 0.5, k)
    dk = _at(v, i, j, k + 0.5) - _at(v, i, j, k - 0.5)
    for a in range(3):
        found[a] = t[a, 0] * di + t[a, 1] * dj + t[a, 2] * dk


@njit(cache=True)
def _levels(field, points):
    found = np.empty(len(points))
    for n in range(len(points)):
        found[n] = level(field, points[n])
    return found


@njit(cache=True)
def _slopes(field, points):
    found = np.empty(points.shape)
    for n in range(len(points)):
        slope(field, points[n], found[n])
    return found
