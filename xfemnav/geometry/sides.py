"""Left and right of cuts: paths in the plane, sheets of triangles in space."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from xfemnav.geometry.locate import LIP, bucket, locate_beside, locate_beside_sheet, touches
from xfemnav.geometry.nearest import crossings, nearest_on_sheet

SAME = 1e-9  # rounding, as a part of what is rounded


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

    def near(self, points) -> np.ndarray:
        """Whether points (n, 2) mm are on a path, up to LIP, (n,) bool."""
        lines = shapely.MultiLineString([shapely.LineString(path) for path in self.cuts])
        with np.errstate(invalid="ignore"):    # a place that is nowhere is on none
            return shapely.dwithin(lines, shapely.points(points), LIP)

    def crossings(self, start, end):
        """Where ways from `start` to `end`, both (n, 2) mm, meet the paths: the way (k,) and the part (k,) of it."""
        step, ways, parts = end - start, [np.zeros(0, int)], [np.zeros(0)]
        for c, d in (ends for path in self.cuts for ends in zip(path, path[1:])):
            edge = d - c
            across = step[:, 0] * edge[1] - step[:, 1] * edge[0]
            with np.errstate(divide="ignore", invalid="ignore"):    # parallel ways meet nothing
                t = ((c - start)[:, 0] * edge[1] - (c - start)[:, 1] * edge[0]) / across
                w = ((c - start)[:, 0] * step[:, 1] - (c - start)[:, 1] * step[:, 0]) / across
            meet = np.flatnonzero((t >= -SAME) & (t <= 1 + SAME) & (w >= -SAME) & (w <= 1 + SAME))
            ways.append(meet)
            parts.append(t[meet])
        return np.concatenate(ways), np.concatenate(parts)

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

    def near(self, points) -> np.ndarray:
        """Whether points (n, 3) mm are on a sheet, up to LIP, (n,) bool."""
        found = np.zeros(len(points), bool)
        for triangles, buckets in zip(self.cuts, self._buckets):
            found |= touches(np.ascontiguousarray(points, float), triangles, buckets)
        return found

    def crossings(self, start, end):
        """Where ways from `start` to `end`, both (n, 3) mm, meet the sheets: the way (k,) and the part (k,) of it."""
        ways, parts = [np.zeros(0, int)], [np.zeros(0)]
        for triangles in self.cuts:
            low, high = triangles.min(axis=(0, 1)) - LIP, triangles.max(axis=(0, 1)) + LIP
            n = np.flatnonzero(((np.maximum(start, end) >= low) & (np.minimum(start, end) <= high)).all(axis=1))
            way, part = crossings(start[n], end[n], triangles, SAME)
            ways.append(n[way])
            parts.append(part)
        return np.concatenate(ways), np.concatenate(parts)

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
            _, place, gap, above = nearest_on_sheet(points, triangles)
            n = gap < distance
            foot[n], sheet[n], distance[n], left[n] = place[n], k, gap[n], above[n]
        return foot, sheet, distance, left


def beside_cuts(cuts, points) -> tuple[np.ndarray, np.ndarray]:
    """Distance (n,) mm of `points` (n, d) mm from the nearest of `cuts`, and whether they are left of it (n,)."""
    return (Sheets if np.ndim(cuts[0]) == 3 else Paths)(tuple(cuts)).beside(points)


def _turn(a, b) -> np.ndarray:
    """Angle (n,) rad from directions `a` to `b`, both (n, 2), counter-clockwise, 0 to 2 pi."""
    cross, dot = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)
    return np.arctan2(cross, dot) % (2 * np.pi)
