"""What cuts do to a mesh: parts of cells, the contacts between them, and the lips.

The mesh never contains the cut. Each crossed cell is split by binary space partition: a convex part is split by the
supporting line of a segment, and only the segment's own interval on that line is a cut. Two parts are *joined* where
their facets overlap in an interval that is not cut, so vertices that hang on a neighbour's facet do not matter.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from xfemnav.geometry.cut import Cut
from xfemnav.geometry.mesh import Mesh, frozen_array, orient

# Fractions of the local element size h.
SNAP = 1e-3  # the cut is moved onto a node or edge as near as this
ON_LINE = 1e-9  # a vertex as near as this to a line is on it
REACH = 1e-6  # a segment that covers less of a chord than this does not cut it
SEVER = 1e-5  # a contact shorter than this joins nothing

UNCUT = -1


@dataclass(frozen=True, eq=False)
class Subcells:
    """Parts of the mesh's cells and how they touch.

    Part c < n_cells belongs to cell c; cells in several parts have their further parts after those. Arrays:

    corners (s, 3, 2) mm: triangles, positively oriented; `part` (s,): the part that each belongs to.
    part_cell (p,): the cell of each part.
    joins (j, 4): parts p, q, and two local flags packed as cell nodes i, k that the contact lets through: for a contact
        across a mesh edge its two nodes, for a contact inside a cell (-1, -1), meaning all three.
    lip_cut (l,), lip_ends (l, 2, 2) mm, lip_arc (l, 2) mm from the mouth, lip_parts (l, 2): pieces of the cut inside
        one cell (or along an edge), in travel order; the parts on the left (+1) and on the right (-1).
    lip_on_edge (l, 2): whether each end lies on a mesh edge or node.
    rim_part (b,), rim_ends (b, 2, 2) mm: facets of the organ's outline, tissue on the left.
    tip_cut (t,), tip_end (t,) 0 or -1, tips (t, 2) mm, tip_travel (t, 2) unit direction in which the cut would go on.
    tip_touch (k, 2): pairs (tip, part) of the parts that a tip touches.
    paths: the snapped cuts, a tuple of (k, 2) mm.
    """

    corners: np.ndarray
    part: np.ndarray
    part_cell: np.ndarray
    joins: np.ndarray
    lip_cut: np.ndarray
    lip_ends: np.ndarray
    lip_arc: np.ndarray
    lip_parts: np.ndarray
    lip_on_edge: np.ndarray
    rim_part: np.ndarray
    rim_ends: np.ndarray
    tip_cut: np.ndarray
    tip_end: np.ndarray
    tips: np.ndarray
    tip_travel: np.ndarray
    tip_touch: np.ndarray
    paths: tuple

    def __post_init__(self):
        n = None
        for name, kind, shape in (
            ("corners", float, (n, 3, 2)), ("part", np.int64, (n,)), ("part_cell", np.int64, (n,)),
            ("joins", np.int64, (n, 4)), ("lip_cut", np.int64, (n,)), ("lip_ends", float, (n, 2, 2)),
            ("lip_arc", float, (n, 2)), ("lip_parts", np.int64, (n, 2)), ("lip_on_edge", bool, (n, 2)),
            ("rim_part", np.int64, (n,)), ("rim_ends", float, (n, 2, 2)), ("tip_cut", np.int64, (n,)),
            ("tip_end", np.int64, (n,)), ("tips", float, (n, 2)), ("tip_travel", float, (n, 2)),
            ("tip_touch", np.int64, (n, 2)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), kind, shape, name))
        object.__setattr__(self, "paths", tuple(frozen_array(path, float, (n, 2), "path") for path in self.paths))

    @cached_property
    def areas(self) -> np.ndarray:
        """Triangle areas (s,) mm^2."""
        a, b, c = self.corners.swapaxes(0, 1)
        return orient(a, b, c) / 2

    @property
    def n_parts(self) -> int:
        """Number of parts."""
        return len(self.part_cell)


def embed(mesh: Mesh, cuts: tuple[Cut, ...]) -> Subcells:
    """Split the cells of `mesh` by the cuts; nothing is dropped for being small.

    The network is first snapped to the mesh at 1e-3 of the local element size. Raises nothing for any simple polylines.
    """
    node_h = _node_sizes(mesh)
    paths = _snap(mesh, node_h, [cut.path for cut in cuts])
    loops = [np.allclose(path[0], path[-1]) for path in paths]
    segments = _Segments(paths)
    ends = [] if not paths else _tips(mesh, node_h, paths, loops)
    polygons = _split_cells(mesh, segments, [path[end] for _, path, end in ends])
    return _assemble(mesh, paths, segments, ends, polygons)


# --- snapping -------------------------------------------------------------------------------------------------------


def _node_sizes(mesh):
    total = np.bincount(mesh.cells.ravel(), np.repeat(mesh.sizes, 3), len(mesh.points))
    return total / np.maximum(np.bincount(mesh.cells.ravel(), minlength=len(mesh.points)), 1)


def _snap(mesh, node_h, paths):
    """Move cut vertices onto near nodes and edges, and make near nodes vertices of the cut."""
    edges = mesh.edges
    edge_h = node_h[edges].min(axis=1)
    snapped = []
    for path in paths:
        path = np.array([_snap_vertex(x, mesh.points, node_h, edges, edge_h) for x in path])
        path = path[np.concatenate([[True], (np.diff(path, axis=0) != 0).any(axis=1)])]
        snapped.append(_through_near_nodes(path, mesh.points, node_h) if len(path) > 1 else path)
    # Ends of a branch are put on the cut that they touch.
    for k, path in enumerate(snapped):
        for end in (0, -1):
            for other in snapped[:k] + snapped[k + 1:]:
                nearest = _nearest_on_path(other, path[end])
                h = node_h[np.argmin(np.sum((mesh.points - path[end]) ** 2, axis=1))]
                if np.linalg.norm(nearest - path[end]) < SNAP * h:
                    path[end] = nearest
    return snapped


def _snap_vertex(x, points, node_h, edges, edge_h):
    to_node = np.linalg.norm(points - x, axis=1)
    near = np.argmin(to_node / node_h)
    if to_node[near] <= SNAP * node_h[near]:
        return points[near].copy()
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    t = np.clip(np.einsum("ei,ei->e", x - a, b - a) / np.einsum("ei,ei->e", b - a, b - a), 0, 1)
    foot = a + t[:, None] * (b - a)
    gap = np.linalg.norm(foot - x, axis=1)
    near = np.argmin(gap / edge_h)
    return foot[near] if gap[near] <= SNAP * edge_h[near] else x


def _through_near_nodes(path, points, node_h):
    """Bend each segment through the nodes that it nearly touches, until it touches no other."""
    for _ in range(10):
        bent = [path[0]]
        for a, b in zip(path[:-1], path[1:]):
            length = np.linalg.norm(b - a)
            t = (points - a) @ (b - a) / length
            off = np.abs(orient(a, b, points)) / length
            near = np.flatnonzero((off <= SNAP * node_h) & (t > 0) & (t < length))
            near = near[(points[near] != a).any(axis=1) & (points[near] != b).any(axis=1)]
            bent.extend(points[near[np.argsort(t[near])]])
            bent.append(b)
        if len(bent) == len(path):
            break
        path = np.array(bent)
    return path


def _nearest_on_path(path, x):
    a, b = path[:-1], path[1:]
    t = np.clip(np.einsum("ki,ki->k", x - a, b - a) / np.einsum("ki,ki->k", b - a, b - a), 0, 1)
    foot = a + t[:, None] * (b - a)
    return foot[np.argmin(np.sum((foot - x) ** 2, axis=1))]


def _tips(mesh, node_h, paths, loops):
    """Cut ends that are tips, as (cut, path, end): not on the outline, not on another cut, not a loop's end."""
    a, b = mesh.points[mesh.boundary_edges].swapaxes(0, 1)
    tips = []
    for k, path in enumerate(paths):
        for end in (0, -1):
            x = path[end]
            t = np.clip(np.einsum("ei,ei->e", x - a, b - a) / np.einsum("ei,ei->e", b - a, b - a), 0, 1)
            h = node_h[np.argmin(np.sum((mesh.points - x) ** 2, axis=1))]
            to_rim = np.linalg.norm(a + t[:, None] * (b - a) - x, axis=1).min()
            to_cut = min((np.linalg.norm(_nearest_on_path(other, x) - x) for j, other in enumerate(paths) if j != k),
                         default=np.inf)
            if not loops[k] and min(to_rim, to_cut) > SEVER * h:
                tips.append((k, path, end))
    return tips


class _Segments:
    """All segments of the network as plain floats: the partition of a cell is scalar work."""

    def __init__(self, paths):
        self.rows = []  # (ax, ay, dx, dy, length), unit direction
        self.cut, self.start = [], []
        for k, path in enumerate(paths):
            arc = 0.0
            for a, b in zip(path[:-1], path[1:]):
                length = float(np.hypot(*(b - a)))
                self.rows.append((*a.tolist(), *((b - a) / length).tolist(), length))
                self.cut.append(k)
                self.start.append(arc)
                arc += length


# --- splitting ------------------------------------------------------------------------------------------------------
# A polygon is a list of edges (x, y, tag, by): it runs from (x, y) to the next edge's start. `tag` is the line that the
# edge lies on: -1, -2, -3 the cell's edges opposite local node 0, 1, 2, and s >= 0 the line of segment s.
# `by` is the segment that cuts along the edge, or UNCUT.


def _split_cells(mesh, segments, tips):
    """Convex polygons of every cell that a segment or tip touches: {cell: [polygon, ...]}."""
    crossing = {}
    for s, row in enumerate(segments.rows):
        for c in _touched(mesh, np.array(row[:2]), np.array(row[2:4]), row[4]):
            crossing.setdefault(int(c), []).append(s)
    polygons = {}
    for c, crossed in sorted(crossing.items()):
        h = float(mesh.sizes[c])
        (x0, y0), (x1, y1), (x2, y2) = mesh.corners[c].tolist()
        cell = [[(x0, y0, -3, UNCUT), (x1, y1, -1, UNCUT), (x2, y2, -2, UNCUT)]]
        for s in crossed:
            cell = [half for polygon in cell for half in _split(polygon, s, segments.rows[s], h)]
        cell = [_with_vertices(polygon, tips, h) for polygon in cell]
        if len(cell) > 1 or len(cell[0]) > 3 or any(edge[3] != UNCUT for edge in cell[0]):
            polygons[c] = cell
    return polygons


def _touched(mesh, a, d, length):
    """Cells whose closed triangle comes within 1e-3 h of the segment."""
    x = mesh.points - a
    along, off = x @ d, x @ np.array([-d[1], d[0]])
    slack = SNAP * mesh.sizes
    along, off = along[mesh.cells], off[mesh.cells]
    return np.flatnonzero((along.max(1) >= -slack) & (along.min(1) <= length + slack)
                          & (off.max(1) >= -slack) & (off.min(1) <= slack))


def _split(polygon, s, row, h):
    """The two halves of a convex polygon on either side of segment s, or the polygon itself."""
    ax, ay, dx, dy, length = row
    along = [(x - ax) * dx + (y - ay) * dy for x, y, _, _ in polygon]
    raw = [(y - ay) * dx - (x - ax) * dy for x, y, _, _ in polygon]
    tolerance = ON_LINE * h
    off = [0.0 if abs(o) < tolerance else o for o in raw]
    if not min(off) < 0 < max(off):
        return [_flag_edges_on_line(polygon, along, off, s, length, h)]
    n = len(polygon)
    for k in range(n):  # only vertices of the chord may lie on the line
        if off[k] == 0 and off[(k + 1) % n] == 0:
            worse = k if abs(raw[k]) > abs(raw[(k + 1) % n]) else (k + 1) % n
            off[worse] = raw[worse] or tolerance
    left, right, ends = [], [], []
    for k, (x, y, tag, by) in enumerate(polygon):
        o, o_next = off[k], off[(k + 1) % n]
        if o == 0:
            ends.append(along[k])
            left.append((x, y, tag, by) if o_next > 0 else (x, y, s, UNCUT))
            right.append((x, y, tag, by) if o_next < 0 else (x, y, s, UNCUT))
            continue
        (left if o > 0 else right).append((x, y, tag, by))
        if o * o_next < 0:
            x1, y1 = polygon[(k + 1) % n][:2]
            w = o / (o - o_next)
            xc, yc = x + w * (x1 - x), y + w * (y1 - y)
            ends.append(along[k] + w * (along[(k + 1) % n] - along[k]))
            (left if o > 0 else right).append((xc, yc, s, UNCUT))
            (right if o > 0 else left).append((xc, yc, tag, by))
    t0, t1 = min(ends), max(ends)
    if min(t1, length) - max(t0, 0.0) <= REACH * h:
        return [polygon]
    return [_flag_chord(half, s, row, h) for half in (left, right)]


def _flag_chord(half, s, row, h):
    along = [(x - row[0]) * row[2] + (y - row[1]) * row[3] for x, y, _, _ in half]
    on_line = [k for k, edge in enumerate(half) if edge[2] == s and edge[3] == UNCUT]
    off = [1.0] * len(half)
    for k in on_line:
        off[k] = off[(k + 1) % len(half)] = 0.0
    return _flag_edges_on_line(half, along, off, s, row[4], h)


def _flag_edges_on_line(polygon, along, off, s, length, h):
    """Mark the part of each edge on the segment's line that the segment covers; its ends become vertices."""
    flagged = []
    for k, (x, y, tag, by) in enumerate(polygon):
        t0, t1 = along[k], along[(k + 1) % len(polygon)]
        low, high = max(min(t0, t1), 0.0), min(max(t0, t1), length)
        if off[k] != 0 or off[(k + 1) % len(polygon)] != 0 or by != UNCUT or high - low <= REACH * h:
            flagged.append((x, y, tag, by))
            continue
        x1, y1 = polygon[(k + 1) % len(polygon)][:2]
        start, stop = (low, high) if t1 > t0 else (high, low)
        marks = [(t0, s if abs(start - t0) <= REACH * h else UNCUT)]
        if marks[0][1] == UNCUT:
            marks.append((start, s))
        if abs(stop - t1) > REACH * h:
            marks.append((stop, UNCUT))
        for t, mark in marks:
            w = (t - t0) / (t1 - t0)
            flagged.append((x + w * (x1 - x), y + w * (y1 - y), tag, mark))
    return flagged


def _with_vertices(polygon, tips, h):
    """The polygon with each tip that lies inside one of its edges as a vertex."""
    for tip in tips:
        for k, (x, y, tag, by) in enumerate(polygon):
            x1, y1 = polygon[(k + 1) % len(polygon)][:2]
            length = np.hypot(x1 - x, y1 - y)
            t = ((tip[0] - x) * (x1 - x) + (tip[1] - y) * (y1 - y)) / length
            off = ((tip[1] - y) * (x1 - x) - (tip[0] - x) * (y1 - y)) / length
            if abs(off) < ON_LINE * h and REACH * h < t < length - REACH * h:
                polygon = [*polygon[:k + 1], (float(tip[0]), float(tip[1]), tag, by), *polygon[k + 1:]]
                break
    return polygon


# --- putting it together --------------------------------------------------------------------------------------------


def _assemble(mesh, paths, segments, ends, polygons):
    n_cells = len(mesh.cells)
    part_cell = list(range(n_cells))
    part_of = {}
    for c, cell in polygons.items():
        part_of[c] = [c, *range(len(part_cell), len(part_cell) + len(cell) - 1)]
        part_cell.extend([c] * (len(cell) - 1))
    whole = np.ones(n_cells, dtype=bool)
    whole[list(polygons)] = False
    corners, part = [mesh.corners[whole]], [np.flatnonzero(whole)]
    tip_points = [path[end] for _, path, end in ends]
    touch = []
    for c, cell in polygons.items():
        for p, polygon in zip(part_of[c], cell):
            triangles = _triangulate(np.array([edge[:2] for edge in polygon]), tip_points, mesh.sizes[c])
            corners.append(triangles)
            part.append(np.full(len(triangles), p))
    for t, tip in enumerate(tip_points):
        for c in _touched(mesh, tip, np.array([1.0, 0.0]), 0.0):
            for p, polygon in zip(part_of.get(c, [c]), polygons.get(c, [mesh.corners[c]])):
                xy = np.array([edge[:2] for edge in polygon])
                if (np.hypot(*(xy - tip).T) < REACH * mesh.sizes[c]).any():
                    touch.append((t, p))
    lips = _lips(mesh, segments, polygons, part_of)
    rim_part, rim_ends = _rim(mesh, polygons, part_of)
    travel = [(path[0] - path[1]) if end == 0 else (path[-1] - path[-2]) for _, path, end in ends]
    return Subcells(
        corners=np.concatenate(corners), part=np.concatenate(part), part_cell=part_cell,
        joins=_joins(mesh, polygons, part_of),
        lip_cut=[row[0] for row in lips], lip_arc=np.array([row[1] for row in lips]).reshape(-1, 2),
        lip_ends=np.array([row[2] for row in lips]).reshape(-1, 2, 2),
        lip_parts=np.array([row[3] for row in lips], dtype=int).reshape(-1, 2),
        lip_on_edge=np.array([row[4] for row in lips], dtype=bool).reshape(-1, 2),
        rim_part=rim_part, rim_ends=rim_ends,
        tip_cut=[k for k, _, _ in ends], tip_end=[end for _, _, end in ends],
        tips=np.array(tip_points).reshape(-1, 2),
        tip_travel=np.array([d / np.linalg.norm(d) for d in travel]).reshape(-1, 2),
        tip_touch=np.array(touch, dtype=int).reshape(-1, 2), paths=tuple(paths),
    )


def _triangulate(xy, tips, h):
    """Fan of triangles (k, 3, 2) from the vertex that makes the best ones; a tip is preferred."""
    n = len(xy)
    best, best_score = None, -1.0
    for apex in range(n):
        fan = np.array([[xy[apex], xy[(apex + k) % n], xy[(apex + k + 1) % n]] for k in range(1, n - 1)])
        area = orient(fan[:, 0], fan[:, 1], fan[:, 2]) / 2
        longest = np.linalg.norm(fan - fan[:, [1, 2, 0]], axis=2).max(axis=1)
        solid = area > ON_LINE * h * longest
        used = {tuple(x) for x in fan[solid].reshape(-1, 2)}
        score = (area[solid] / longest[solid] ** 2).min() if solid.any() else 0.0
        score += sum(np.hypot(*(xy[apex] - tip)) < REACH * h for tip in tips)
        if len(used) == n or best is None:
            score += len(used) == n
            if score > best_score:
                best, best_score = fan[solid], score
    return best


def _joins(mesh, polygons, part_of):
    """Contacts (j, 4): part, part, and the two nodes that it lets through, or (-1, -1) inside a cell."""
    cell, local = np.nonzero(mesh.neighbours > np.arange(len(mesh.cells))[:, None])
    other = mesh.neighbours[cell, local]
    i, k = mesh.cells[cell, (local + 1) % 3], mesh.cells[cell, (local + 2) % 3]
    touched = np.zeros(len(mesh.cells), dtype=bool)
    touched[list(polygons)] = True
    plain = ~(touched[cell] | touched[other])
    joins = [np.stack([cell[plain], other[plain], i[plain], k[plain]], axis=1)]
    for c, d, a, b in np.stack([cell, other, i, k], axis=1)[~plain].tolist():
        sides = [_facets_on_edge(mesh, polygons, part_of, e, a, b) for e in (c, d)]
        joins.extend([(p, q, a, b)] for p, q in _overlaps(*sides, SEVER * mesh.sizes[c]))
    for c, cell_polygons in polygons.items():
        lines = {}
        for p, polygon in zip(part_of[c], cell_polygons):
            for n, (x, y, tag, by) in enumerate(polygon):
                if tag >= 0 and by == UNCUT:
                    x1, y1 = polygon[(n + 1) % len(polygon)][:2]
                    lines.setdefault(tag, []).append((p, x, y, x1, y1))
        for facets in lines.values():
            _, x, y, x1, y1 = facets[0]
            length = np.hypot(x1 - x, y1 - y)
            dx, dy = (x1 - x) / length, (y1 - y) / length
            sides = ([], [])
            for p, xa, ya, xb, yb in facets:
                ta, tb = (xa - x) * dx + (ya - y) * dy, (xb - x) * dx + (yb - y) * dy
                sides[int(tb < ta)].append((min(ta, tb), max(ta, tb), p))
            joins.extend([(p, q, -1, -1)] for p, q in _overlaps(*sides, SEVER * mesh.sizes[c]))
    return np.concatenate([np.asarray(rows, dtype=int).reshape(-1, 4) for rows in joins])


def _facets_on_edge(mesh, polygons, part_of, c, a, b):
    """Uncut intervals (t0, t1, part) along the mesh edge a-b of cell c, mm from a."""
    if c not in polygons:
        return [(0.0, float(np.hypot(*(mesh.points[b] - mesh.points[a]))), c)]
    start, d = mesh.points[a], mesh.points[b] - mesh.points[a]
    d = d / np.hypot(*d)
    opposite = -1 - int(np.flatnonzero((mesh.cells[c] != a) & (mesh.cells[c] != b))[0])
    found = []
    for p, polygon in zip(part_of[c], polygons[c]):
        for n, (x, y, tag, by) in enumerate(polygon):
            if tag == opposite and by == UNCUT:
                x1, y1 = polygon[(n + 1) % len(polygon)][:2]
                t = sorted(((x - start[0]) * d[0] + (y - start[1]) * d[1], (x1 - start[0]) * d[0] + (y1 - start[1]) * d[1]))
                found.append((t[0], t[1], p))
    return found


def _overlaps(one, two, least):
    """Pairs of parts whose intervals overlap by more than `least`."""
    return sorted({(p, q) for a0, a1, p in one for b0, b1, q in two if min(a1, b1) - max(a0, b0) > least})


def _lips(mesh, segments, polygons, part_of):
    """Pieces of the cuts between the parts on their two sides, in travel order."""
    sides = {}
    for c, cell in polygons.items():
        for p, polygon in zip(part_of[c], cell):
            for n, (x, y, tag, by) in enumerate(polygon):
                if by == UNCUT:
                    continue
                ax, ay, dx, dy, _ = segments.rows[by]
                x1, y1 = polygon[(n + 1) % len(polygon)][:2]
                ta, tb = (x - ax) * dx + (y - ay) * dy, (x1 - ax) * dx + (y1 - ay) * dy
                # Parts have their facets counter-clockwise: those on the left run with the travel.
                sides.setdefault(by, ([], []))[int(ta > tb)].append((min(ta, tb), max(ta, tb), p, c, tag))
    lips = []
    for s, (left, right) in sorted(sides.items()):
        ax, ay, dx, dy, _ = segments.rows[s]
        left.sort()
        right.sort()
        j = 0
        for a0, a1, p, c, tag in left:
            while j and right[j - 1][1] > a0:
                j -= 1
            while j < len(right) and right[j][0] < a1:
                b0, b1, q, other, _ = right[j]
                low, high = max(a0, b0), min(a1, b1)
                if high - low > REACH * mesh.sizes[c]:
                    ends = [(ax + t * dx, ay + t * dy) for t in (low, high)]
                    on_edge = [tag < 0 or _on_an_edge(mesh, (c, other), x) for x in ends]
                    arcs = (segments.start[s] + low, segments.start[s] + high)
                    lips.append((segments.cut[s], arcs, ends, (p, q), on_edge))
                j += 1
    return lips


def _on_an_edge(mesh, cells, x):
    for c in cells:
        corners = mesh.corners[c]
        depth = [orient(corners[k - 1], corners[k], np.asarray(x)) for k in range(3)]
        if min(depth) < SEVER * mesh.sizes[c] ** 2:
            return True
    return False


def _rim(mesh, polygons, part_of):
    """Facets of the organ's outline and the parts behind them, tissue on the left."""
    cell, local = np.nonzero(mesh.neighbours < 0)
    parts, ends = [], []
    for c, k in zip(cell.tolist(), local.tolist()):
        if c not in polygons:
            parts.append(c)
            ends.append(mesh.corners[c][[(k + 1) % 3, (k + 2) % 3]])
            continue
        for p, polygon in zip(part_of[c], polygons[c]):
            for n, (x, y, tag, _) in enumerate(polygon):
                if tag == -1 - k:
                    parts.append(p)
                    ends.append(np.array([(x, y), polygon[(n + 1) % len(polygon)][:2]]))
    return np.array(parts, dtype=int), np.array(ends).reshape(-1, 2, 2)
