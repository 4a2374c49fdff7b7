"""The motion of the tissue as a map of points: affine on each simplex, two-valued on the cuts."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from xfemnav.geometry.locate import LIP, Buckets, bucket, locate
from xfemnav.geometry.mesh import determinants, frozen_array
from xfemnav.geometry.sides import Paths, Sheets


@dataclass(frozen=True, eq=False)
class Motion:
    """Simplices at `rest` and `moved`, both (t, d + 1, d) mm, and the `cuts` between them at rest.

    The simplices tile the tissue at rest and do not cross the cuts. A cut is a path (n, 2) mm in the plane, in space a
    sheet of triangles (f, 3, 3) mm whose normals point to its left. In all methods points are (n, d) mm, and where
    there is no tissue (outside, in the opened cut, where it was resected) the result is NaN.
    """

    rest: np.ndarray
    moved: np.ndarray
    cuts: tuple[np.ndarray, ...] = ()

    def __post_init__(self):
        d = np.shape(self.rest)[-1]
        object.__setattr__(self, "rest", frozen_array(self.rest, float, (None, d + 1, d), "rest"))
        object.__setattr__(self, "moved", frozen_array(self.moved, float, self.rest.shape, "moved"))
        cut = (None, 2) if d == 2 else (None, 3, 3)
        object.__setattr__(self, "cuts", tuple(frozen_array(each, float, cut, "cut") for each in self.cuts))

    def to_current(self, points, side=0) -> np.ndarray:
        """Where the tissue that rested at `points` is now.

        Points on a cut are on the lip of `side`, +1 left (of the direction of travel, or where a sheet's normals point)
        or -1 right: one number for all, or (n,). With 0 or None they are on either lip. Away from the cuts `side`
        changes nothing.
        """
        points = np.array(points, float, ndmin=2)
        side = np.broadcast_to(0 if side is None else side, len(points))
        current = _carry(points, locate(points, self.rest, self._rest_buckets), self.rest, self.moved)
        if self.cuts and side.any():
            foot, where, distance = self._cuts.nearest(points)
            lip = (side != 0) & (distance <= LIP)
            beside = self._cuts.locate(foot[lip], where[lip], side[lip] > 0, self.rest, self._rest_buckets)
            current[lip] = points[lip] + _carry(foot[lip], beside, self.rest, self.moved) - foot[lip]
        return current

    def lip_now(self, cut: int, side: int, step_mm: float = 1.0) -> np.ndarray:
        """In the plane: where a cut's lip on the side +1 (left) or -1 is now: (k, 2) mm along what is left of it."""
        along = shapely.get_coordinates(shapely.segmentize(shapely.LineString(self.cuts[cut]), step_mm))
        moved = self.to_current(along, side)
        return moved[np.isfinite(moved[:, 0])]

    def to_preoperative(self, points) -> np.ndarray:
        """Where the tissue that is now at `points` rested; where tissue overlaps, one of the places."""
        points = np.array(points, float, ndmin=2)
        return _carry(points, locate(points, self.moved, self._moved_buckets), self.moved, self.rest)

    def displacement(self, points, side=0) -> np.ndarray:
        """Displacement (n, d) mm of the tissue that rested at `points`; `side` as in `to_current`."""
        return self.to_current(points, side) - np.array(points, float, ndmin=2)

    def holds(self, points) -> np.ndarray:
        """Whether tissue rested at `points`, (n,) bool."""
        return locate(np.array(points, float, ndmin=2), self.rest, self._rest_buckets) >= 0

    def beside(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Distance (n,) mm of points at rest from the nearest cut, and the side (n,) of it that they are on.

        The side is +1 left and -1 right, as in `to_current`. Without cuts the distance is infinite.
        """
        distance, left = self._cuts.beside(np.array(points, float, ndmin=2))
        return distance, np.where(left, 1, -1)

    def near(self, points) -> np.ndarray:
        """Whether points (n, d) at rest are on a cut, up to LIP, (n,) bool."""
        return self._cuts.near(points)

    def crossings(self, start, end) -> tuple[np.ndarray, np.ndarray]:
        """Where straight ways from `start` to `end`, both (n, d) at rest, meet the cuts: the way's number (k,) and the
        part (k,) of it."""
        return self._cuts.crossings(start, end)

    @cached_property
    def _cuts(self) -> Paths | Sheets:
        return (Paths if self.rest.shape[2] == 2 else Sheets)(self.cuts)

    @cached_property
    def _rest_buckets(self) -> Buckets:
        return bucket(self.rest)

    @cached_property
    def _moved_buckets(self) -> Buckets:
        return bucket(self.moved)


def _carry(points, simplex, here, there) -> np.ndarray:
    """Points (n, d) carried by their `simplex` (n,) from `here` to `there`, both (t, d + 1, d); -1 gives NaN."""
    here, there = here[simplex], there[simplex]
    sides, carried = here[:, 1:] - here[:, :1], there[:, 0]
    whole = determinants(sides)
    for k in range(sides.shape[1]):    # Cramer's rule: barycentric coordinate of corner k + 1
        with_point = sides.copy()
        with_point[:, k] = points - here[:, 0]
        carried = carried + (determinants(with_point) / whole)[:, None] * (there[:, k + 1] - there[:, 0])
    carried[simplex < 0] = np.nan
    return carried
