"""Conforming mesh of a cut domain: the cut is made of mesh edges, and its nodes are doubled.

A node of the cut is split into as many nodes as its fan of triangles has parts, two triangles being in one part when
they share an edge that is not cut. So tips stay whole, mouths open, and crossings of several cuts need no rule.
"""

import math
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

#: Grading towards a vertex of a polyline can leave slivers, even of no area: such a mesh is refused, and gmsh's next
#: algorithm tried (frontal, Delaunay, local adaptation).
WORST_QUALITY = 0.1
ALGORITHMS = (6, 5, 1)


@dataclass(frozen=True)
class Grading:
    """Edge length mm: `fine` at the focus points, growing by `slope` mm per mm, at most `coarse`.

    A focus point is (x, y), or (x, y, size) where the edges may be longer than `fine`.
    """

    coarse: float
    fine: float
    slope: float
    focus: tuple = ()


@dataclass(frozen=True, eq=False)
class SplitMesh:
    """Triangles, in space tetrahedra, with doubled nodes along the cuts: points (n, d) mm, cells (m, d + 1)."""

    points: np.ndarray
    cells: np.ndarray


def conforming_mesh(outline, cuts, grading: Grading, marks=(), holes=()) -> SplitMesh:
    """Mesh of the inside of `outline` (n, 2) mm, a closed loop, opened along the `cuts`, a sequence of (k, 2) mm.

    `marks` (k, 2) mm are points of the outline or of the cuts that must be nodes: where data begin or end. `holes` are
    closed loops like the outline, inside it, with no tissue in them.
    Raises ValueError when a triangle is worse than WORST_QUALITY.
    """
    loops = [np.asarray(loop, float) for loop in (outline, *holes)]
    vertices, rings, inner = _network(loops, [np.asarray(c, float) for c in cuts], marks)
    for algorithm in ALGORITHMS:
        points, cells, cut_edges = _triangulate(vertices, rings, inner, grading, algorithm)
        quality = _quality(points[cells])
        if quality.min() >= WORST_QUALITY:
            return split(points, cells, cut_edges)
    where = points[cells[np.argmin(quality)]].mean(axis=0)
    raise ValueError(f"triangle of quality {quality.min():.1e} at {where.round(4)} mm; change the grading")


def _network(loops, cuts, marks):
    """Vertices (v, 2), edges of each loop in order (r, 2), edges inside (e, 2), with every meeting point a vertex."""
    ends = [c[k] for c in cuts for k in (0, -1)]
    special = np.array([*ends, *marks]).reshape(-1, 2)
    rings = [_with_points(np.vstack([loop, loop[:1]]), special) for loop in loops]
    lines = [_with_points(c, special) for c in cuts]
    noded = shapely.get_parts(shapely.node(shapely.MultiLineString([*lines]))) if lines else []
    vertices, number = [], {}

    def index(point):
        key = tuple(np.round(point, 8))
        if key not in number:
            number[key] = len(vertices)
            vertices.append(np.asarray(point, float))
        return number[key]

    chains = [[index(p) for p in ring] for ring in rings]
    ring_edges = [np.stack([chain[:-1], chain[1:]], axis=1) for chain in chains]
    inner = set()
    for line in noded:
        chain = [index(p) for p in shapely.get_coordinates(line)]
        inner |= {tuple(sorted(edge)) for edge in zip(chain, chain[1:])}
    return np.array(vertices), ring_edges, np.array(sorted(inner)).reshape(-1, 2)


def _with_points(line, points):
    """The polyline (k, 2) with those of `points` that lie on it as vertices."""
    for p in points:
        if np.linalg.norm(line - p, axis=1).min() <= 1e-8:
            continue
        a, d = line[:-1], np.diff(line, axis=0)
        t = np.clip(np.einsum("ki,ki->k", p - a, d) / np.einsum("ki,ki->k", d, d), 0, 1)
        off = np.linalg.norm(a + t[:, None] * d - p, axis=1)
        k = int(np.argmin(off))
        if off[k] <= 1e-7:
            line = np.insert(line, k + 1, p, axis=0)
    return line


def _triangulate(vertices, rings, inner, grading, algorithm):
    """gmsh's triangles: points (n, 2), cells (m, 3), and the mesh edges on the cuts (e, 2)."""
    import gmsh

    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        for source in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
            gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)
        gmsh.option.setNumber("Mesh.Algorithm", algorithm)
        geo = gmsh.model.geo
        tags = [geo.addPoint(x, y, 0) for x, y in vertices]
        loops = [geo.addCurveLoop([geo.addLine(tags[a], tags[b]) for a, b in ring]) for ring in rings]
        cut = [geo.addLine(tags[a], tags[b]) for a, b in inner]
        surface = geo.addPlaneSurface(loops)
        geo.synchronize()
        gmsh.model.mesh.embed(1, cut, 2, surface)
        gmsh.model.mesh.setSizeCallback(_size_callback(grading))
        gmsh.model.mesh.generate(2)
        node_tags, xyz, _ = gmsh.model.mesh.getNodes()
        number = np.full(int(node_tags.max()) + 1, -1)
        number[node_tags.astype(int)] = np.arange(len(node_tags))
        cells = number[gmsh.model.mesh.getElementsByType(2)[1].astype(int)].reshape(-1, 3)
        chains = [gmsh.model.mesh.getElementsByType(1, tag)[1].astype(int) for tag in cut]
        edges = number[np.concatenate([*chains, np.empty(0, int)])].reshape(-1, 2)
        points = xyz.reshape(-1, 3)[:, :2].copy()
    finally:
        gmsh.finalize()
    used = np.unique(cells)
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    return points[used], number[cells], number[edges]


def _size_callback(grading):
    focus = [(float(x), float(y), *own) for x, y, *own in grading.focus]
    fine = [(x, y) for x, y, *own in focus if not own]
    other = [spot for spot in focus if len(spot) == 3]

    def size(dim, tag, x, y, z, lc):
        r = min((math.hypot(x - a, y - b) for a, b in fine), default=math.inf)
        grown = [own + grading.slope * math.hypot(x - a, y - b) for a, b, own in other]
        return min(grading.coarse, grading.fine + grading.slope * r, *grown)

    return size


def split(points, cells, cut_facets) -> SplitMesh:
    """Double the nodes of the cut facets (e, d): one node for each connected part of a node's fan of simplices."""
    k = cells.shape[1]
    corner = k * np.arange(len(cells))[:, None, None] + [[b for b in range(k) if b != a] for a in range(k)]
    corner = corner.reshape(-1, k - 1)
    corner = np.take_along_axis(corner, np.argsort(cells.ravel()[corner], axis=1), axis=1)
    place = len(points) ** np.arange(k - 1)
    key = cells.ravel()[corner] @ place
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    one, two = order[same], order[same + 1]
    closed = ~np.isin(key[one], np.sort(cut_facets, axis=1) @ place)
    pairs = np.stack([corner[one[closed]], corner[two[closed]]]).reshape(2, -1)
    size = cells.size
    n, label = connected_components(coo_array((np.ones(pairs.shape[1], bool), pairs), (size, size)), directed=False)
    where = np.empty(n, dtype=int)
    where[label] = cells.ravel()
    return SplitMesh(points[where], label.reshape(-1, k))


def _quality(x):
    """2 r_in / r_out of triangles (m, 3, 2)."""
    a, b, c = (np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in ((1, 2), (2, 0), (0, 1)))
    return (b + c - a) * (c + a - b) * (a + b - c) / (a * b * c)
