"""Surfaces (.stl, .vtk, .vtp, .gii, .obj, .ply) through the motion of the tissue in a slice or a volume.

A surface is many landmarks joined by faces, and its points move as landmarks do: with the tissue at their place, of a
slice in or beside its plane, keeping their distance from it. What is outside of the organ stays. Points keep their
number and order, so that what other files say of them (curvature, parcels) still fits; a face that a cut or a resection
separates is left out, never stretched across the gap, and so is one at the outline where the tissue has left it.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree

from xfemnav.geometry.locate import LIP, held
from xfemnav.geometry.mesh import frozen_array, volumes
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.landmarks import (
    ON_A_CUT,
    OUTSIDE,
    RESECTED,
    TISSUE,
    moved_points,
    warn_of_frame,
)
from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.frames.slices import warn_of_slice
from xfemnav.imaging.points.surface_files import Surface
from xfemnav.interruption import checkpoint
from xfemnav.limits import PARTED

BLOCK = 1 << 14  # points that are looked up at once: their distances to all segments of the cuts are kept together
STEP = 1.0  # mm between places of a face in space that are looked at
SAME = 1e-6  # rounding, as a part of what is rounded
LEFT_OUT = ("on a cut", "resected", "at the outline")  # why faces are left out


@dataclass(frozen=True, eq=False)
class MovedSurface:
    """A surface after the motion: `points` (n, 3) world RAS mm, and a `flag` for each as of `MovedPoints`.

    Points "on a cut" are on the lip that most of their faces are on; those of "resected" tissue stay where they were,
    and no face has them. `kept` (m,) bool: the faces that are left; `left_out`: how many are not, by reason. `off` of
    the points are off the slice, up to `farthest` mm from its plane.
    """

    surface: Surface
    points: np.ndarray
    flag: tuple[str, ...]
    kept: np.ndarray
    left_out: dict[str, int]
    off: int
    farthest: float

    def __post_init__(self):
        object.__setattr__(self, "points", frozen_array(self.points, float, self.surface.points.shape, "points"))
        object.__setattr__(self, "kept", frozen_array(self.kept, bool, (len(self.surface.count),), "kept"))

    @property
    def table(self) -> dict[str, int | str]:
        """The surface's frame, and how many points and faces became what."""
        flags = {flag.replace(" ", "_"): self.flag.count(flag) for flag in (TISSUE, ON_A_CUT, RESECTED, OUTSIDE)}
        left_out = {f"left_out_{reason.replace(' ', '_')}": n for reason, n in self.left_out.items()}
        return {"frame": self.surface.frame, "n": len(self.flag), **flags, "off_the_slice": self.off, "farthest_mm":
                round(self.farthest, 3), "faces": len(self.kept), **left_out}

    @property
    def words(self) -> str:
        """The table in a few words."""
        flags = ", ".join(f"{self.flag.count(flag)} {flag}" for flag in (TISSUE, ON_A_CUT, RESECTED, OUTSIDE)
                          if flag in self.flag)
        left_out = ", ".join(f"{n} {reason}" for reason, n in self.left_out.items() if n)
        return (f"{len(self.flag)} points: {flags}; {self.off} off the slice by up to {self.farthest:.1f} mm; "
                f"{len(self.kept)} faces, {f'left out {left_out}' if left_out else 'all kept'} ({self.surface.frame})")

    def warn_of_frame(self, name: str, frame: Grid, outline) -> None:
        """W131 where the surface in the file `name` seems to count in another frame, W132 where it lies all on one side
        of the slice, so that none of it is known to move as its tissue does."""
        mend = "Check the frame that the file states." if self.surface.stated else "Say its frame: ⟦space=lps|ras⟧."
        warn_of_frame(self.surface.points, name, frame, outline, mend)
        distance = frame.from_world(self.surface.points)[1]
        if min(distance.max(), -distance.min()) < -frame.thickness / 2:
            warn_of_slice(self.surface.points, name, frame)

    @property
    def content(self) -> bytes:
        """The surface as a file of the format, frame and form that it came in."""
        return self.surface.written(self.points, self.kept)


def move_surface(surface: Surface, frame: Grid, motion: Motion, organ) -> MovedSurface:
    """The `surface` after the `motion` of the tissue in the slice or volume `frame`.

    `organ` (t, d + 1, d) mm: simplices of the whole organ at rest, also of what was resected.
    """
    organ = np.asarray(organ)
    found = []
    for at in range(0, len(surface.points), BLOCK):
        checkpoint()
        found.append(moved_points(surface.points[at:at + BLOCK], frame, motion, organ))
    flag = np.concatenate([part.flag for part in found])
    points = np.concatenate([part.moved for part in found])
    lips = np.concatenate([part.lips for part in found])
    faces = (_FlatFaces if len(frame.spacing) < len(frame.axes) else _SolidFaces)(surface, frame)
    two_valued = np.isnan(points[:, 0]) & (flag == ON_A_CUT)
    side = faces.sides(two_valued, motion)
    points[two_valued] = _on_lips(lips[two_valued], side[two_valued])
    stays = np.isin(flag, (OUTSIDE, RESECTED))
    points[stays] = surface.points[stays]
    torn, gone = faces.torn(flag != OUTSIDE, side, motion), faces.gone(flag, motion, organ)
    parted = faces.parted(flag, motion, organ)
    why = np.select([torn, gone, parted], [1, 2, 3], 0)
    left_out = {reason: int((why == k).sum()) for k, reason in enumerate(LEFT_OUT, 1)}
    distance = abs(frame.from_world(surface.points)[1])
    off = int((distance > frame.thickness / 2 * (1 + SAME)).sum())
    return MovedSurface(surface, points, tuple(map(str, flag)), why == 0, left_out, off, float(distance.max()))


def _on_lips(lips, side) -> np.ndarray:
    """Of `lips` (n, 2, 3), left and right, that of each `side` (n,), or the other one where that was resected."""
    chosen = np.where((side > 0)[:, None], lips[:, 0], lips[:, 1])
    return np.where(np.isnan(chosen), np.where((side > 0)[:, None], lips[:, 1], lips[:, 0]), chosen)


class _Faces:
    """The faces of a surface on a grid's axes: corner k is point `corners[k]` of face `owner[k]`, at `at` (k, d) mm;
    `middle` (m, d) is the mean of each face's corners."""

    def __init__(self, surface: Surface, frame: Grid):
        self.n, self.corners = len(surface.count), surface.corners
        self.owner = np.repeat(np.arange(self.n), surface.count)
        self.points = frame.from_world(surface.points)[0] if len(surface.points) else np.zeros((0, len(frame.spacing)))
        self.at = self.points[self.corners]
        self.middle = np.zeros((self.n, *self.points.shape[1:]))
        np.add.at(self.middle, self.owner, self.at)
        self.middle /= np.maximum(surface.count, 1)[:, None]

    def any(self, corner) -> np.ndarray:
        """Whether a face has a `corner` (k,) that is true, (m,) bool."""
        found = np.zeros(self.n, bool)
        found[self.owner[corner]] = True
        return found

    def sides(self, points, motion) -> np.ndarray:
        """For those of the `points` (n,) bool the side of the cut, +1 or -1, that most of their faces are on; else 0.

        What each corner's face is on is kept as `on` (k,).
        """
        self.on = np.zeros(len(self.corners), int)
        k = np.flatnonzero(points[self.corners])
        if len(k):
            way = self.middle[self.owner[k]] - self.at[k]
            length = np.linalg.norm(way, axis=1)[:, None]
            beside = self.at[k] + way * np.minimum(0.5, LIP / 2 / np.where(length > 0, length, 1))
            self.on[k] = motion.beside(beside)[1]
        votes = np.zeros(len(points), int)
        np.add.at(votes, self.corners, self.on)
        return np.where(points, np.where(votes < 0, -1, 1), 0)

    def torn(self, moves, side, motion) -> np.ndarray:
        """Faces (m,) bool that a cut goes through, or that lie beyond the lip that a corner of theirs is on.

        Only those with a point that `moves` (n,). A face that ends on a cut does not go through it.
        """
        wrong = self.any((self.on != 0) & (self.on != side[self.corners]))
        return wrong | self.crossed(motion, self.any(moves[self.corners])) if motion.cuts else wrong

    def gone(self, flag, motion, organ) -> np.ndarray:
        """Faces (m,) bool that have tissue in them that was resected."""
        lost = self.any((flag == RESECTED)[self.corners])
        left, whole = (abs(volumes(simplices)).sum() for simplices in (motion.rest, organ))
        return lost if whole - left <= SAME * whole else lost | self.hollow(motion, organ, ~lost)

    def parted(self, flag, motion, organ) -> np.ndarray:
        """Faces (m,) bool with corners in tissue and outside, where the outline has moved by more than PARTED."""
        outside = (flag == OUTSIDE)[self.corners]
        mixed = self.any(outside) & self.any(~outside)
        k = np.flatnonzero(outside & mixed[self.owner])
        apart = np.zeros(len(self.corners), bool)
        if len(k):
            places = organ.reshape(-1, self.at.shape[1])
            nearest = places[cKDTree(places).query(self.at[k])[1]]
            apart[k] = np.linalg.norm(motion.displacement(nearest), axis=1) > PARTED.value  # NaN: resected, told there
        return self.any(apart)

    def drawn_in(self, k) -> np.ndarray:
        """The corners `k`, two widths of a lip towards the middle of their face: at its rim it has nothing."""
        inward = self.middle[self.owner[k]] - self.at[k]
        length = np.linalg.norm(inward, axis=1)[:, None]
        return self.at[k] + inward * np.minimum(0.5, 2 * LIP / np.where(length > 0, length, 1))


class _FlatFaces(_Faces):
    """Faces in the plane of a slice."""

    def crossed(self, motion, faces) -> np.ndarray:
        """Those of the `faces` (m,) bool that a cut goes through."""
        return self._meet(shapely.multilinestrings(list(motion.cuts)), faces)

    def hollow(self, motion, organ, faces) -> np.ndarray:
        """Those of the `faces` (m,) bool that have a part in the organ where no tissue is left."""
        rest, whole = shapely.polygons(motion.rest), shapely.polygons(organ)
        return self._meet(shapely.union_all(whole).difference(shapely.union_all(rest)).buffer(-LIP), faces)

    def _meet(self, shape, faces) -> np.ndarray:
        """Those of the `faces` (m,) bool that a `shape` has something in common with; at their rim alone is nothing."""
        found = np.zeros(self.n, bool)
        if shape.is_empty:
            return found
        low, high = np.split(np.array(shape.bounds), 2)
        near = np.ones(self.n, bool)
        for axis in (0, 1):
            least, most = np.full(self.n, np.inf), np.full(self.n, -np.inf)
            np.minimum.at(least, self.owner, self.at[:, axis])
            np.maximum.at(most, self.owner, self.at[:, axis])
            near &= (most >= low[axis]) & (least <= high[axis])
        chosen = np.flatnonzero(near & faces)
        k = np.flatnonzero(np.isin(self.owner, chosen))
        hulls = shapely.convex_hull(shapely.multipoints(
            shapely.points(self.drawn_in(k)), indices=np.searchsorted(chosen, self.owner[k])))
        shapely.prepare(shape)
        found[chosen] = shapely.intersects(shape, hulls)
        return found


class _SolidFaces(_Faces):
    """Faces in space."""

    def crossed(self, motion, faces) -> np.ndarray:
        """Those of the `faces` (m,) bool an edge of which a cut goes through."""
        start, end = self._edges(faces)
        ways, _ = motion.crossings(self.drawn_in(start), self.drawn_in(end))
        found = np.zeros(self.n, bool)
        found[self.owner[start[ways]]] = True
        return found

    def hollow(self, motion, organ, faces) -> np.ndarray:
        """Those of the `faces` (m,) bool with a place in the organ where no tissue is left; looked at every STEP."""
        start, end = self._edges(faces)
        a, b, c = self.drawn_in(start), self.drawn_in(end), self.middle[self.owner[start]]
        longest = np.max([np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0, initial=0)
        parts, found = np.ceil(longest / STEP).astype(int), np.zeros(self.n, bool)
        for n in np.unique(parts):
            k = np.flatnonzero(parts == n)
            for i, j in np.argwhere(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n):
                at = (i * a[k] + j * b[k] + (n - i - j) * c[k]) / max(n, 1)
                gone = held(at, organ) & ~motion.holds(at)
                found[self.owner[start[k[gone]]]] = True
        return found

    def _edges(self, faces) -> tuple[np.ndarray, np.ndarray]:
        """The corners at which the edges of `faces` (m,) bool start and end."""
        last = np.append(self.owner[1:] != self.owner[:-1], True)[:len(self.owner)]
        first = np.flatnonzero(np.append(True, last[:-1])[:len(self.owner)])
        following = np.arange(1, len(self.owner) + 1)
        following[last] = first
        start = np.flatnonzero(faces[self.owner])
        return start, following[start]
