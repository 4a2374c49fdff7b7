"""Snap a network of cuts to a mesh and to itself, so that no part is thinner than rounding can tell.

One line after the other: its vertices move onto near nodes, vertices and edges of the mesh and of the lines before it,
and its segments bend through the nodes and vertices that they nearly touch. So lines that nearly coincide do coincide.
"""

from dataclasses import dataclass

import numpy as np
import shapely

from xfemnav.geometry.mesh import frozen_array, orient
from xfemnav.geometry.plane.resection import even_odd, inner_paths, rings_of

# Fractions of the local element size h.
SNAP = 1e-3  # the cut is moved onto a node or edge as near as this
SEVER = 1e-5  # a contact shorter than this joins nothing


@dataclass(frozen=True, eq=False)
class Net:
    """What lines are snapped to: `points` (n, 2) mm and the local element size (n,) mm there, `segments` (e, 2, 2) mm
    and theirs (e,) mm. The first points are the mesh's nodes, and the first segments its edges."""

    points: np.ndarray
    sizes: np.ndarray
    segments: np.ndarray
    segment_sizes: np.ndarray

    def __post_init__(self):
        for name, shape in (("points", (None, 2)), ("sizes", (None,)), ("segments", (None, 2, 2))):
            object.__setattr__(self, name, frozen_array(getattr(self, name), float, shape, name))
        sizes = frozen_array(self.segment_sizes, float, (len(self.segments),), "segment_sizes")
        object.__setattr__(self, "segment_sizes", sizes)

    def size_at(self, x) -> float:
        """Element size mm at the point nearest to x (2,) mm."""
        dx, dy = (self.points - x).T
        return float(self.sizes[np.argmin(dx**2 + dy**2)])

    def about(self, path) -> "Net":
        """What lies near a path (k, 2): all within two of the largest elements of its bounding box."""
        reach = 2 * self.sizes.max()
        low, high = path.min(axis=0) - reach, path.max(axis=0) + reach
        points, segments = True, True
        for i in (0, 1):
            x, a, b = self.points[:, i], self.segments[:, 0, i], self.segments[:, 1, i]
            points &= (x >= low[i]) & (x <= high[i])
            segments &= (np.maximum(a, b) >= low[i]) & (np.minimum(a, b) <= high[i])
        if not points.any():
            return self
        return Net(self.points[points], self.sizes[points], self.segments[segments], self.segment_sizes[segments])

    def with_lines(self, paths) -> "Net":
        """The net with polylines that lie on it already, so that others can be snapped to them."""
        paths = [path for path in paths if len(path) > 1]
        if not paths:
            return self
        sizes = [np.array([self.size_at(x) for x in path]) for path in paths]
        points = np.concatenate([self.points, *paths])
        _, first = np.unique(points.view(complex), return_index=True)
        first = np.sort(first)
        return Net(
            points[first],
            np.concatenate([self.sizes, *sizes])[first],
            np.concatenate([self.segments, *map(_stretches, paths)]),
            np.concatenate([self.segment_sizes, *(np.minimum(h[:-1], h[1:]) for h in sizes)]),
        )


def mesh_net(mesh) -> Net:
    """Nodes and edges of a mesh, with the mean size of the elements about each node."""
    total = np.bincount(mesh.cells.ravel(), np.repeat(mesh.sizes, 3), len(mesh.points))
    h = total / np.maximum(np.bincount(mesh.cells.ravel(), minlength=len(mesh.points)), 1)
    return Net(mesh.points, h, mesh.points[mesh.edges], np.minimum(*h[mesh.edges.T]))


def snap_region(net: Net, region, outline) -> tuple[shapely.Geometry, tuple[np.ndarray, ...]]:
    """A region snapped to the mesh, and the lines (k, 2) mm of its boundary that run off the `outline`.

    What is narrower than the snapping closes, so the region is snapped again until it stays as it is.
    """
    for _ in range(10):
        rings = _one_by_one(net, [np.vstack([ring, ring[:1]]) for ring in rings_of(region)])
        before, region = region, even_odd([ring[:-1] for ring in rings])
        if shapely.equals_exact(shapely.normalize(region), shapely.normalize(before)):
            break
    return region, inner_paths(rings_of(region), outline, SEVER * net.sizes.min())


def snap(mesh, net: Net, paths, walls=()) -> list[np.ndarray]:
    """Cuts (k, 2) mm snapped to the mesh, to the walls of resections, which are snapped already, and to each other."""
    rim = mesh.points[mesh.boundary_facets]
    snapped = _one_by_one(net.with_lines(walls), paths)
    for k, path in enumerate(snapped):
        others = [line for line in (*snapped[:k], *snapped[k + 1 :], *walls) if len(line) > 1]
        for end in (0, -1) if len(path) > 1 else ():
            h = net.size_at(path[end])
            if not _is_on(rim, path[end], h) and not any(_is_on(_stretches(other), path[end], h) for other in others):
                _onto_near_lines([path, *others], path, end, h, _directions(net, path[end], h))
    return snapped


def _one_by_one(net, paths):
    snapped = []
    for path in paths:
        net = net.with_lines(snapped[-1:])
        snapped.append(_snapped(net.about(path), path))
    return snapped


def _snapped(net, path):
    own = np.empty((0, 2))
    for x in _simplified(path, net):
        own = np.vstack([own, _snap_vertex(x, net, own)])
    path = own[np.concatenate([[True], (np.diff(own, axis=0) != 0).any(axis=1)])]
    return _through_near_nodes(path, net.with_lines([path])) if len(path) > 1 else path


def _directions(net, x, h):
    """Unit directions (k, 2) of the mesh's edges through a point (2,) mm."""
    near = net.segments[_boxed(net.segments, x, SNAP * h)]
    a, d = near[:, 0], near[:, 1] - near[:, 0]
    length = np.linalg.norm(d, axis=1)
    along = ((x - a) * d).sum(axis=1) / length
    off = np.abs(d[:, 0] * (x - a)[:, 1] - d[:, 1] * (x - a)[:, 0]) / length
    return (d / length[:, None])[(off < 1e-9 * h) & (along > -1e-9 * h) & (along < length + 1e-9 * h)]


def _onto_near_lines(paths, path, end, h, edges):
    """Move a cut's end onto the line of another segment that passes it by a hair: cells are split along whole lines.

    An end on one of the mesh's `edges` (k, 2) stays on it, and an end on a node stays.
    """
    own = path[:2] if end == 0 else path[-2:]
    for other in paths:
        for a, b in zip(other[:-1], other[1:]):
            if other is path and (np.array_equal(a, own[0]) or np.array_equal(b, own[1])):
                continue
            length = np.linalg.norm(b - a)
            along, off = (path[end] - a) @ (b - a) / length, orient(a, b, path[end]) / length
            if not 0 < abs(off) <= SNAP / 10 * h or not -2 * h < along < length + 2 * h:
                continue
            if not len(edges):
                path[end] = a + along * (b - a) / length
            elif len(edges) == 1:
                slope = orient(np.zeros(2), (b - a) / length, edges[0])
                if abs(off) <= SNAP * h * abs(slope):
                    path[end] = path[end] - off / slope * edges[0]


def _simplified(path, net):
    """The path without vertices that lie on it anyway, to a tenth of the snapping: dense points make no kinks."""
    h = min(net.size_at(x) for x in path)
    return shapely.get_coordinates(shapely.simplify(shapely.LineString(path), SNAP / 10 * h))


def _snap_vertex(x, net, own):
    """The vertex x (2,), moved onto a near node, or else a vertex of its `own` path before it, or else an edge."""
    to_node = np.linalg.norm(net.points - x, axis=1)
    near = np.argmin(to_node / net.sizes)
    # Farther than a line is bent to a node, so that no node is left on the line just before a tip.
    if to_node[near] <= 2 * SNAP * net.sizes[near]:
        return net.points[near].copy()
    to_own = np.linalg.norm(own - x, axis=1)
    if to_own.min(initial=np.inf) <= 2 * SNAP * net.sizes[near]:
        return own[np.argmin(to_own)]
    boxed = _boxed(net.segments, x, 2 * SNAP * net.segment_sizes.max(initial=0.0))
    foot, sizes = _feet(net.segments[boxed], x), net.segment_sizes[boxed]
    gap = np.linalg.norm(foot - x, axis=1)
    if not (gap <= SNAP * sizes).any():
        return x
    return foot[np.argmin(gap / sizes)]


def _through_near_nodes(path, net):
    """Bend each segment through the nodes that it nearly touches, until it touches no other."""
    points = net.points
    for _ in range(10):
        bent = [path[0]]
        for a, b in zip(path[:-1], path[1:]):
            length = np.linalg.norm(b - a)
            t = (points - a) @ (b - a) / length
            off = np.abs(orient(a, b, points)) / length
            near = np.flatnonzero((off <= SNAP * net.sizes) & (t > 0) & (t < length))
            near = near[(points[near] != a).any(axis=1) & (points[near] != b).any(axis=1)]
            bent.extend(points[near[np.argsort(t[near])]])
            bent.append(b)
        if len(bent) == len(path):
            break
        path = np.array(bent)
    return path


def _stretches(path):
    """The segments (k - 1, 2, 2) of a path (k, 2)."""
    return np.stack([path[:-1], path[1:]], axis=1)


def _boxed(segments, x, reach):
    """Which of the segments (e, 2, 2) have a point (2,) in their bounding box, or as near as `reach` mm to it."""
    found = True
    for i in (0, 1):
        a, b = segments[:, 0, i], segments[:, 1, i]
        found &= (np.minimum(a, b) <= x[i] + reach) & (np.maximum(a, b) >= x[i] - reach)
    return np.flatnonzero(found)


def _feet(segments, x):
    """The points (e, 2) of segments (e, 2, 2) that are nearest to x (2,)."""
    a, b = segments.swapaxes(0, 1)
    t = np.clip(np.einsum("ei,ei->e", x - a, b - a) / np.einsum("ei,ei->e", b - a, b - a), 0, 1)
    return a + t[:, None] * (b - a)


def _is_on(segments, x, h):
    """Whether one of the segments (e, 2, 2) passes x (2,) so near that what lies between joins nothing."""
    near = segments[_boxed(segments, x, 2 * SEVER * h)]
    return bool((np.linalg.norm(_feet(near, x) - x, axis=1) <= SEVER * h).any())


def find_tips(mesh, net: Net, paths, walls=()) -> list[tuple[int, np.ndarray, int]]:
    """Cut ends that are tips, as (cut, path, end): not on the outline, not on another cut or wall, not a loop's end."""
    rim, tips = mesh.points[mesh.boundary_facets], []
    for k, path in enumerate(paths):
        if len(path) < 2 or np.array_equal(path[0], path[-1]):
            continue
        others = [*paths[:k], *paths[k + 1 :], *walls]
        for end in (0, -1):
            x, h = path[end], net.size_at(path[end])
            if not _is_on(rim, x, h) and not any(_is_on(_stretches(other), x, h) for other in others):
                tips.append((k, path, end))
    return tips
