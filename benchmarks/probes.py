"""What checks read off a result at any place: the basis at a point, the gap between lips, an image's values."""

import numpy as np
import shapely
from scipy.sparse import csr_array

from xfemnav.geometry.plane.snapping import SEVER
from xfemnav.imaging.carrying.warp import sample_into
from xfemnav.mechanics.conditions.lips import LEFT, lip_quadrature
from xfemnav.mechanics.space.space import Space


def basis_at(space: Space, points, side: int | None = None) -> csr_array:
    """B (k, n_rows) at any points (k, 2) mm of the organ; on a cut, `side` +1 is the left lip and -1 the right.

    Raises ValueError for a point outside the mesh or in a resection.
    """
    points = np.asarray(points, float)
    return space.basis_in(points, parts_at(space, points, side))


def parts_at(space: Space, points, side: int | None = None) -> np.ndarray:
    """Part (k,) that holds each point (k, 2) mm and is not resected; see `basis_at`."""
    points, parts = np.asarray(points, float), space.parts
    reach = SEVER * float(space.mesh.sizes.min())
    left = np.flatnonzero(~parts.removed[parts.part])
    tree = shapely.STRtree(shapely.polygons(parts.corners[left]))
    at, triangle = tree.query(shapely.points(points), predicate="dwithin", distance=reach)
    triangle = left[triangle]
    # Off the cut every candidate gives the same value; on it, the candidate's side of the lip decides.
    centre = parts.corners[triangle].mean(axis=1)
    preference = np.einsum("ki,ki->k", centre - points[at], _lip_normals(parts, points)[at]) * (side or 0)
    depth = _depth(parts.corners[triangle], points[at])
    order = np.lexsort((-depth, -np.sign(preference) * (np.abs(depth) < reach), at))
    who, first = np.unique(at[order], return_index=True)
    found = np.full(len(points), -1)
    found[who] = parts.part[triangle[order[first]]]
    if (found < 0).any():
        x, y = points[found < 0][0]
        raise ValueError(f"point ({x:.3f}, {y:.3f}) mm lies outside the mesh, or was resected")
    return found


def _lip_normals(parts, points):
    """Normal (k, 2) to the left of the lip nearest to each point; zero where there are no lips."""
    facets = parts.lips.facets
    if not len(facets):
        return np.zeros((len(points), 2))
    d = facets[:, 1] - facets[:, 0]
    normals = np.stack([-d[:, 1], d[:, 0]], axis=1) / np.linalg.norm(d, axis=1)[:, None]
    return normals[shapely.STRtree(shapely.linestrings(facets)).nearest(shapely.points(points))]


def _depth(corners, points):
    """How far inside its triangle each point lies (k,): the smallest barycentric coordinate times the height, mm."""
    a, b = corners, corners[:, [1, 2, 0]]
    d = b - a
    off = d[..., 0] * (points[:, None, 1] - a[..., 1]) - d[..., 1] * (points[:, None, 0] - a[..., 0])
    return (off / np.linalg.norm(d, axis=2)).min(axis=1)


def lip_gaps(space: Space, U, cut: int) -> tuple[np.ndarray, np.ndarray]:
    """Arc (q,) mm and normal gap (q,) mm between the lips at Gauss points of a cut; U (n_rows, 2) mm."""
    length = space.parts.lips.arc[space.parts.lips.cut == cut].max()
    q = lip_quadrature(space, cut, LEFT, (0.0, length))
    jump = (space.basis_in(q.points, q.parts) - space.basis_in(q.points, q.across)) @ U
    return q.arc, np.einsum("qi,qi->q", jump, q.normals)


def sample(values, origin, spacing, points, interp: str = "linear") -> np.ndarray:
    """Values (...) of an image (n1, n2) at `points` (..., 2) mm; NaN points give NaN.

    `interp` is linear, cubic or nearest, whose values have the image's own type, 0 for NaN points.
    """
    points = np.ascontiguousarray(points, float)
    own = interp == "nearest"
    out = np.full(points.shape[:-1], 0 if own else np.nan, np.asarray(values).dtype if own else float)
    sample_into(out, values, origin, spacing, points, interp)
    return out
