"""A cut in space: a triangulated sheet, with a mouth on the organ's surface or inside; and its level set in a mesh."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from xfemnav.geometry.mesh import Mesh, frozen_array
from xfemnav.geometry.nearest import nearest_on_sheet
from xfemnav.geometry.solid.levels import Level

#: Nodes nearer to a sheet than so many of their longest edges are given its level; those beyond their longest edge
#: belong to no cell that it crosses.
BAND = 3.5
#: A foot this near (mm) to the sheet's border lies on it.
ON_BORDER = 1e-7


@dataclass(frozen=True, eq=False)
class Sheet:
    """A `Chart` in space: vertices (v, 3) mm, triangles (f, 3) whose normals point to the left, and chart coordinates
    `at` (v, 2): along, 0 to 1 from its first point, and depth, 0 where it leaves the organ and 1 at the front.

    It goes on beyond the organ at its mouth, `mouth_line` (k, 3) mm, which an internal sheet lacks. `name` is what
    messages call it; `craniotomy` whether the skull is open about the mouth.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    at: np.ndarray
    mouth_line: np.ndarray
    name: str = "cut"
    craniotomy: bool = True

    def __post_init__(self):
        for field, kind, shape in (("vertices", float, (None, 3)), ("triangles", np.int64, (None, 3)),
                                   ("at", float, (len(self.vertices), 2)), ("mouth_line", float, (None, 3))):
            object.__setattr__(self, field, frozen_array(getattr(self, field), kind, shape, field))

    @property
    def mouth(self) -> bool:
        """Whether it begins at the organ's surface."""
        return len(self.mouth_line) > 0

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners (f, 3, 3) mm of the triangles."""
        return self.vertices[self.triangles]

    @property
    def area_mm2(self) -> float:
        """Its area below the organ's surface, mm^2."""
        return float(self._areas.sum())

    @cached_property
    def _areas(self):
        """Areas (f,) mm^2 of the triangles, 0 of those outside of the organ."""
        edges = self.corners[:, 1:] - self.corners[:, :1]
        below = self.at[self.triangles, 1].mean(axis=1) >= 0
        return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2 * below

    @cached_property
    def lengths(self) -> tuple[float, float]:
        """How long it is, mm, along its middle depth and down its middle: the mean length of a unit of either."""
        edges = self.corners[:, 1:] - self.corners[:, :1]
        chart = self.at[self.triangles]
        slopes = np.linalg.pinv(chart[:, 1:] - chart[:, :1]) @ edges
        return tuple((np.linalg.norm(slopes, axis=2).T @ self._areas / self.area_mm2).tolist())

    @property
    def length(self) -> float:
        """How deep it is, mm."""
        return self.lengths[1]

    @cached_property
    def _normals(self):
        """Normals (v, 3) at the vertices: the mean of the triangles', by their angles (Thurmer & Wuthrich 1998)."""
        normals = np.zeros_like(self.vertices)
        x = self.corners
        flat = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        flat /= np.linalg.norm(flat, axis=1)[:, None]
        for i in range(3):
            u, v = x[:, (i + 1) % 3] - x[:, i], x[:, (i + 2) % 3] - x[:, i]
            angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))
            np.add.at(normals, self.triangles[:, i], angle[:, None] * flat)
        return normals / np.linalg.norm(normals, axis=1)[:, None]

    @cached_property
    def border(self) -> np.ndarray:
        """Ends (e, 2, 3) mm of the edges of its border: its front, its sides, and the end outside of the organ."""
        edges = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, count = np.unique(edges, axis=0, return_counts=True)
        return self.vertices[edges[count == 1]]

    @property
    def left(self) -> np.ndarray:
        """The unit direction (3,) in which its left lies, in the mean."""
        x = self.corners
        mean = (np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) * (self._areas > 0)[:, None]).sum(axis=0)
        return mean / np.linalg.norm(mean)

    def level(self, mesh: Mesh) -> Level:
        """The sheet as functions at the nodes of a mesh: phi its signed distance, positive on the left, one bound that
        is the signed distance from its border along it, and the chart coordinates, which go on beyond the border:
        along, depth, and how far from the border, mm.

        Far from the sheet the bound is positive, and the others say nothing.
        """
        longest = np.zeros(len(mesh.points))
        length = np.linalg.norm(np.diff(mesh.points[mesh.edges], axis=1)[:, 0], axis=1)
        for end in mesh.edges.T:
            np.maximum.at(longest, end, length)
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        outside = np.maximum(low - mesh.points, mesh.points - high).max(axis=1)
        near = np.flatnonzero(outside < BAND * longest)
        feet = _Feet.on(self, mesh.points[near])
        held = feet.distance < BAND * longest[near]
        near, feet = near[held], _Feet(*(x[held] for x in feet))
        phi, bound, at = np.full(len(longest), np.inf), np.full(len(longest), np.inf), np.zeros((len(longest), 3))
        phi[near], bound[near] = self._signed(mesh.points[near], feet)
        bound[near[feet.distance > longest[near]]] = np.inf
        beyond = _shares(self.corners[feet.triangle], mesh.points[near])
        at[near, :2] = np.einsum("na,nak->nk", beyond, self.at[self.triangles[feet.triangle]])
        size = 2 * float(longest.max())
        at[:, 2] = np.clip(-bound, -size, size)
        return Level(np.minimum(phi, size), np.minimum(bound, size)[None], at=at)

    def _signed(self, points, feet):
        """phi and the bound (n,) mm at points (n, 3) mm with these feet."""
        foot, shares = feet.place, _shares(self.corners[feet.triangle], feet.place)
        normal = np.einsum("na,nai->ni", shares, self._normals[self.triangles[feet.triangle]])
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        off = points - foot
        height = (off * normal).sum(axis=1)
        inward = _distance(foot, self.border)
        beyond = inward < ON_BORDER
        aside = np.linalg.norm(off - height[:, None] * normal, axis=1)
        phi = np.where(beyond, height, np.where(feet.left, 1, -1) * feet.distance)
        return phi, np.where(beyond, aside, -inward)


class _Feet(NamedTuple):
    """The nearest triangle (n,) of a sheet to points, the place (n, 3) mm on it, the distance (n,) mm, and whether they
    are on its left (n,)."""

    triangle: np.ndarray
    place: np.ndarray
    distance: np.ndarray
    left: np.ndarray

    @classmethod
    def on(cls, sheet: Sheet, points) -> "_Feet":
        return cls(*nearest_on_sheet(np.ascontiguousarray(points), np.ascontiguousarray(sheet.corners)))


def _shares(corners, points):
    """Barycentric coordinates (n, 3) of the projections of points (n, 3) on triangles (n, 3, 3)."""
    u, v, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    uu, uv, vv, wu, wv = ((x * y).sum(axis=1) for x, y in ((u, u), (u, v), (v, v), (w, u), (w, v)))
    det = uu * vv - uv**2
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    return np.stack([1 - s - t, s, t], axis=1)


def _distance(points, segments):
    """Distance (n,) mm of points (n, 3) mm from the nearest of segments (e, 2, 3) mm."""
    start, edge = segments[:, 0], segments[:, 1] - segments[:, 0]
    square, found = (edge**2).sum(axis=1), np.full(len(points), np.inf)
    for k in range(len(segments)):
        off = points - start[k]
        along = np.clip(off @ edge[k] / square[k], 0, 1)
        np.minimum(found, ((off - along[:, None] * edge[k]) ** 2).sum(axis=1), out=found)
    return np.sqrt(found)
