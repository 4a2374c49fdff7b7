"""Wanted element size as a function of place: far away, in the corridor of the cuts, about single points."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array


@njit(cache=True)
def distance_to_path(points, path):
    """Distance (n,) mm of `points` (n, 2) from the polyline `path` (k, 2)."""
    nearest = np.full(len(points), np.inf)
    for s in range(max(1, len(path) - 1)):
        ax, ay = path[s]
        dx, dy = path[min(s + 1, len(path) - 1), 0] - ax, path[min(s + 1, len(path) - 1), 1] - ay
        length2 = dx * dx + dy * dy
        for n in range(len(points)):
            x, y = points[n, 0] - ax, points[n, 1] - ay
            r = min(1.0, max(0.0, (x * dx + y * dy) / length2)) if length2 > 0 else 0.0
            nearest[n] = min(nearest[n], (x - r * dx) ** 2 + (y - r * dy) ** 2)
    return np.sqrt(nearest)


@njit(cache=True)
def is_inside(points, loop):
    """Whether each of `points` (n, 2) lies inside the closed `loop` (k, 2): even-odd count of crossings."""
    inside = np.zeros(len(points), np.bool_)
    for s in range(len(loop)):
        ax, ay = loop[s - 1]
        bx, by = loop[s]
        for n in range(len(points)):
            x, y = points[n]
            if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
                inside[n] = not inside[n]
    return inside


@njit(cache=True)
def sample_inside(loop, n):
    """Centres (k, 2) mm of those n x n boxes over the closed `loop` that lie inside it; the area of a box, mm^2."""
    x0, y0, dx, dy = loop[:, 0].min(), loop[:, 1].min(), np.ptp(loop[:, 0]) / n, np.ptp(loop[:, 1]) / n
    odd = np.zeros((n, n + 1), np.bool_)  # where along each row the loop crosses it
    for s in range(len(loop)):
        ax, ay = loop[s - 1]
        bx, by = loop[s]
        first, last = np.ceil((min(ay, by) - y0) / dy - 0.5), np.ceil((max(ay, by) - y0) / dy - 0.5)
        for row in range(max(0, int(first)), min(n, int(last))):
            x = ax + (y0 + (row + 0.5) * dy - ay) * (bx - ax) / (by - ay)
            column = min(n, max(0, int(np.ceil((x - x0) / dx - 0.5))))
            odd[row, column] = not odd[row, column]
    points, k = np.empty((n * n, 2)), 0
    for row in range(n):
        inside = False
        for column in range(n):
            inside = inside != odd[row, column]
            if inside:
                points[k] = x0 + (column + 0.5) * dx, y0 + (row + 0.5) * dy
                k += 1
    return points[:k], dx * dy


@njit(cache=True)
def cones(points, centres, sizes, slopes):
    """Smallest of sizes + slopes * distance (n,) mm over the `centres` (k, 2)."""
    lowest = np.full(len(points), np.inf)
    for n in range(len(points)):
        for k in range(len(centres)):
            r = np.hypot(points[n, 0] - centres[k, 0], points[n, 1] - centres[k, 1])
            lowest[n] = min(lowest[n], sizes[k] + slopes[k] * r)
    return lowest


@dataclass(frozen=True, eq=False)
class SizeField:
    """Wanted edge length, mm: `element_mm` far away, `corridor_element_mm` where the surgeon works.

    corridor: paths (k, 2) mm; the size is uniform within `corridor_mm` of each. A path whose last point repeats its
    first is a closed region, uniform inside.
    focus: (point, size) or (point, size, growth): `size` mm there, growing with distance.
    growth: rise of the size, mm per mm, outside the corridor and about the focus points; good meshes need at most .3.
    Raises XfemnavError E207 when a size or the growth is not positive.
    """

    element_mm: float
    corridor_element_mm: float | None = None
    corridor_mm: float = 0.0
    corridor: tuple = ()
    focus: tuple = ()
    growth: float = 0.2

    def __post_init__(self):
        corridor = tuple(frozen_array(path, float, (None, 2), "corridor") for path in self.corridor)
        object.__setattr__(self, "corridor", corridor)
        fine = self.element_mm if self.corridor_element_mm is None else self.corridor_element_mm
        smallest = min(self.element_mm, fine, self.growth, *(spot[1] for spot in self.focus))
        if not (smallest > 0 and np.isfinite(self.element_mm)):
            raise XfemnavError("E207", f"a size of {smallest:g} mm is not positive; give sizes and growth above 0")

    def __call__(self, points) -> np.ndarray:
        """Wanted edge length (n,) mm at `points` (n, 2) mm."""
        points = np.ascontiguousarray(points, dtype=float)
        size = np.full(len(points), float(self.element_mm))
        if self.corridor_element_mm is not None:
            for path in self.corridor:
                beyond = np.maximum(self._distance(points, path), 0) * self.growth
                size = np.minimum(size, self.corridor_element_mm + beyond)
        if self.focus:
            centres = np.array([spot[0] for spot in self.focus], dtype=float)
            sizes = np.array([spot[1] for spot in self.focus], dtype=float)
            slopes = np.array([spot[2] if len(spot) > 2 else self.growth for spot in self.focus], dtype=float)
            size = np.minimum(size, cones(points, centres, sizes, slopes))
        return size

    def _distance(self, points, path) -> np.ndarray:
        """Distance (n,) mm beyond the corridor of one path, not positive within it."""
        if len(path) > 3 and np.array_equal(path[0], path[-1]):
            return np.where(is_inside(points, path[:-1]), 0.0, distance_to_path(points, path))
        return distance_to_path(points, path) - self.corridor_mm
