"""The motion of the tissue as a map of points: affine on each triangle, two-valued on the cuts."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from xfemnav.geometry.locate import LIP, Buckets, bucket, locate, locate_beside
from xfemnav.geometry.mesh import frozen_array


@dataclass(frozen=True, eq=False)
class Motion:
    """Triangles at `rest` and `moved`, both (t, 3, 2) mm, and the `cuts` between them, paths (n, 2) mm at rest.

    The triangles tile the tissue at rest and do not cross the cuts. In all methods points are (n, 2) mm in the plane,
    and where there is no tissue (outside, in the opened cut, where it was resected) the result is NaN.
    """

    rest: np.ndarray
    moved: np.ndarray
    cuts: tuple[np.ndarray, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "rest", frozen_array(self.rest, float, (None, 3, 2), "rest"))
        object.__setattr__(self, "moved", frozen_array(self.moved, float, self.rest.shape, "moved"))
        object.__setattr__(self, "cuts", tuple(frozen_array(path, float, (None, 2), "cut") for path in self.cuts))

    def to_current(self, points, side=0) -> np.ndarray:
        """Where the tissue that rested at `points` is now.

        Points on a cut are on the lip of `side`, +1 left or -1 right of the direction of travel: one number for all, or
        (n,). With 0 or None they are on either lip. Away from the cuts `side` changes nothing.
        """
        points = np.array(points, float, ndmin=2)
        side = np.broadcast_to(0 if side is None else side, len(points))
        current = _carry(points, locate(points, self.rest, self._rest_buckets), self.rest, self.moved)
        if self.cuts and side.any():
            foot, corner, distance = _nearest_on(self.cuts, points)
            lip = (side != 0) & (distance <= LIP)
            beside = locate_beside(foot[lip], corner[lip], side[lip] > 0, self.rest, self._rest_buckets)
            current[lip] = points[lip] + _carry(foot[lip], beside, self.rest, self.moved) - foot[lip]
        return current

    def lip_now(self, cut: int, side: int, step_mm: float = 1.0) -> np.ndarray:
        """Where a cut's lip on the side +1 (left) or -1 is now: points (k, 2) mm along it, without resected ones."""
        along = shapely.get_coordinates(shapely.segmentize(shapely.LineString(self.cuts[cut]), step_mm))
        moved = self.to_current(along, side)
        return moved[np.isfinite(moved[:, 0])]

    def to_preoperative(self, points) -> np.ndarray:
        """Where the tissue that is now at `points` rested; where tissue overlaps, one of the places."""
        points = np.array(points, float, ndmin=2)
        return _carry(points, locate(points, self.moved, self._moved_buckets), self.moved, self.rest)

    def displacement(self, points, side=0) -> np.ndarray:
        """Displacement (n, 2) mm of the tissue that rested at `points`; `side` as in `to_current`."""
        return self.to_current(points, side) - np.array(points, float, ndmin=2)

    def holds(self, points) -> np.ndarray:
        """Whether tissue rested at `points`, (n,) bool."""
        return locate(np.array(points, float, ndmin=2), self.rest, self._rest_buckets) >= 0

    def beside(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Distance (n,) mm of points at rest from the nearest cut, and the side (n,) of it that they are on.

        The side is +1 left and -1 right of the direction of travel. Without cuts the distance is infinite.
        """
        points = np.array(points, float, ndmin=2)
        _, corner, distance = _nearest_on(self.cuts, points)
        apex, ahead, back = corner.swapaxes(0, 1)
        left = _turn(ahead, points - apex) < _turn(ahead, back)
        return distance, np.where(left, 1, -1)

    @cached_property
    def _rest_buckets(self) -> Buckets:
        return bucket(self.rest)

    @cached_property
    def _moved_buckets(self) -> Buckets:
        return bucket(self.moved)


def _carry(points, triangle, here, there) -> np.ndarray:
    """Points (n, 2) carried by their `triangle` (n,) from `here` to `there`, both (t, 3, 2); -1 gives NaN."""
    a, e, f = _sides(here[triangle])
    b, g, h = _sides(there[triangle])
    p = points - a
    twice = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
    s = (p[:, 0] * f[:, 1] - p[:, 1] * f[:, 0]) / twice
    t = (e[:, 0] * p[:, 1] - e[:, 1] * p[:, 0]) / twice
    carried = b + s[:, None] * g + t[:, None] * h
    carried[triangle < 0] = np.nan
    return carried


def _turn(a, b) -> np.ndarray:
    """Angle (n,) rad from directions `a` to `b`, both (n, 2), counter-clockwise, 0 to 2 pi."""
    cross, dot = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)
    return np.arctan2(cross, dot) % (2 * np.pi)


def _sides(corners):
    """First corner and the two sides from it, each (n, 2)."""
    return corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def _nearest_on(paths, points):
    """Nearest places (n, 2) on the `paths`, their distances (n,) mm, and the corner (n, 3, 2) of the path there.

    A corner is an apex with the unit directions ahead and back along the path. It is the vertex where two segments meet
    if the place is within LIP of one, else the place itself.
    """
    foot, corner, distance = np.zeros(points.shape), np.zeros((len(points), 3, 2)), np.full(len(points), np.inf)
    for path in paths:
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
