"""Left and right of cuts: paths in the plane, sheets of triangles in space."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from xfemnav.geometry.locate import LIP, bucket, locate_beside, locate_beside_sheet
from xfemnav.geometry.nearest import nearest_on_sheet


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths (k, 2) mm in the plane: left and right are as one travels."""

    cuts: tuple[np.ndarray, ...]

    def nearest(self, points):
        """Nearest places (n, 2) on the paths, the corner (n, 3, 2) of the path there, and their distances (n,) mm.

        A corner is an apex with the unit directions ahead and back along the path. It is the vertex where two segments
        meet if the place is within LIP of one, else the place itself.
        """
        foot, corner, distance = np.zeros(points.shape), np.zeros((len(points), 3, 2)), np.full(len(points), np.inf)
        for path in self.cuts:
            step = np.diff(path, axis=0)
            length = np.linalg.norm(step, axis=1)
            unit = step / length[:, None]
            along = np.clip(np.einsum("nsi,si->ns", points[:, None] - path[:-1], unit), 0, length)
            feet = path[:-1] + along[..., None] * unit
            gap = np.linalg.norm(points[:, None] - feet, axis=-1)
            s = gap.argmin(axis=1)
            n = np.flatnonzero(gap[np.arange(len(s)), s] < distance)
            s = s[n]
            distance[n], foot[n] = gap[n, s], feet[n, s]
            corner[n] = np.stack([feet[n, s], unit[s], -unit[s]], axis=1)
            last = len(unit) - 1
            start, end = (along[n, s] <= LIP) & (s > 0), (length[s] - along[n, s] <= LIP) & (s < last)
            for near, before in ((start, s[start] - 1), (end, s[end])):
                corner[n[near]] = np.stack([path[before + 1], unit[before + 1], -unit[before]], axis=1)
        return foot, corner, distance

    def beside(self, points):
        """Distance (n,) mm of points (n, 2) mm from the nearest path, and whether they are left of it (n,)."""
        _, corner, distance = self.nearest(points)
        apex, ahead, back = corner.swapaxes(0, 1)
        return distance, _turn(ahead, points - apex) < _turn(ahead, back)

    def locate(self, foot, corner, left, triangles, buckets) -> np.ndarray:
        """The triangle (n,) beside each place of `nearest`, on its left or right; -1 for none."""
        return locate_beside(foot, corner, left, triangles, buckets)


@dataclass(frozen=True, eq=False)
class Sheets:
    """Sheets of triangles (f, 3, 3) mm in space: the left is where their normals point."""

    cuts: tuple[np.ndarray, ...]

    def nearest(self, points):
        """Nearest places (n, 3) on the sheets, the sheet (n,) that each is on, -1 for none, and their distances (n,)
        mm."""
        foot, sheet, distance, _ = self._nearest(points)
        return foot, sheet, distance

    def beside(self, points):
        """Distance (n,) mm of points (n, 3) mm from the nearest sheet, and whether they are left of it (n,)."""
        return self._nearest(points)[2:]

    def locate(self, foot, sheet, left, tetrahedra, buckets) -> np.ndarray:
        """The tetrahedron (n,) beside each place of `nearest`, on its left or right; -1 for none."""
        found = np.full(len(foot), -1)
        for k, triangles in enumerate(self.cuts):
            n = sheet == k
            found[n] = locate_beside_sheet(foot[n], left[n], tetrahedra, buckets, triangles, self._buckets[k])
        return found

    @cached_property
    def _buckets(self) -> list:
        return [bucket(triangles) for triangles in self.cuts]

    def _nearest(self, points):
        foot, sheet = np.zeros(points.shape), np.full(len(points), -1)
        distance, left = np.full(len(points), np.inf), np.zeros(len(points), bool)
        for k, triangles in enumerate(self.cuts):
            place, gap, above = nearest_on_sheet(points, triangles)
            n = gap < distance
            foot[n], sheet[n], distance[n], left[n] = place[n], k, gap[n], above[n]
        return foot, sheet, distance, left


def _turn(a, b) -> np.ndarray:
    """Angle (n,) rad from directions `a` to `b`, both (n, 2), counter-clockwise, 0 to 2 pi."""
    cross, dot = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)
    return np.arctan2(cross, dot) % (2 * np.pi)
