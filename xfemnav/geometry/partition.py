"""Binary space partition of the cells that a network of segments crosses.

A convex part is split by the supporting line of a segment; only the segment's own interval on that line is a cut.
A polygon is a list of edges (x, y, tag, by): it runs from (x, y) to the next edge's start. `tag` is the line that the
edge lies on: -1, -2, -3 the cell's edges opposite local node 0, 1, 2, and s >= 0 the line of segment s.
`by` is the segment that cuts along the edge, or UNCUT.

Segments that run on one line but for rounding would leave slivers that no predicate tells apart: inside a cell they
are put on one line, whose tag they share.
"""

import numpy as np

from xfemnav.geometry.bisection import UNCUT, split_cell
from xfemnav.geometry.mesh import orient
from xfemnav.geometry.snapping import SNAP

# Fractions of the local element size h.
ONE_LINE = 4e-6  # two segments that stay as near as this to one line, inside a cell, are on it
FLAT = 1e-13  # a triangle lower than this has no area but rounding
AT_TIP = 1e-9  # a corner as near as this to a tip is moved onto it
HERE = 1e-5  # a corner as near as this to a node or tip is that node or tip


class Segments:
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


def split_cells(mesh, segments, tips):
    """Convex polygons of every cell that a segment or tip touches: {cell: [polygon, ...]}."""
    crossing = {}
    for s, row in enumerate(segments.rows):
        for c in touched_cells(mesh, np.array(row[:2]), np.array(row[2:4]), row[4]):
            crossing.setdefault(int(c), []).append(s)
    polygons, ends = {}, np.array(tips).reshape(-1, 2)
    for c, crossed in sorted(crossing.items()):
        h = float(mesh.sizes[c])
        rows, lines = zip(*_lines(crossed, segments, mesh.corners[c], tips, h))
        edges, count = split_cell(mesh.corners[c], np.array(rows), np.array(crossed), np.array(lines), ends, h)
        edges = [(x, y, int(tag), int(by)) for x, y, tag, by in edges.tolist()]
        stop = np.cumsum(count).tolist()
        cell = [edges[a:b] for a, b in zip([0, *stop], stop)]
        for x, y in tips:
            cell = _one_corner_at(cell, float(x), float(y), AT_TIP * h)
        if len(cell) > 1 or len(cell[0]) > 3 or any(edge[3] != UNCUT for edge in cell[0]):
            polygons[c] = cell
    return polygons


def _one_corner_at(cell, x, y, reach):
    """The polygons with all corners within `reach` mm of a tip (x, y) on it: lines that meet there at a small angle
    miss it by more than rounding."""
    if not any(0 < abs(u - x) + abs(v - y) < reach for polygon in cell for u, v, _, _ in polygon):
        return cell
    cell = [[(x, y, *e[2:]) if abs(e[0] - x) + abs(e[1] - y) < reach else e for e in polygon] for polygon in cell]
    cell = [[e for e, after in zip(polygon, [*polygon[1:], polygon[0]]) if e[:2] != after[:2]] for polygon in cell]
    return [polygon for polygon in cell if len(polygon) > 2]


def touched_cells(mesh, a, d, length):
    """Cells whose closed triangle comes within 1e-3 h of the segment."""
    x = mesh.points - a
    along, off = x @ d, x @ np.array([-d[1], d[0]])
    slack = SNAP * mesh.sizes
    along, off = along[mesh.cells], off[mesh.cells]
    return np.flatnonzero(
        (along.max(1) >= -slack) & (along.min(1) <= length + slack) & (off.max(1) >= -slack) & (off.min(1) <= slack)
    )


def _lines(crossed, segments, corners, tips, h):
    """Row and line of each segment in a cell: its own, or what the cell holds of it on the line of a longer one."""
    if len(crossed) == 1:
        return [(segments.rows[crossed[0]], crossed[0])]
    inside = {}
    for s in crossed:
        ax, ay, dx, dy, length = segments.rows[s]
        along = [(x - ax) * dx + (y - ay) * dy for x, y in corners.tolist()]
        low, high = max(min(along), 0.0), max(min(max(along), length), 0.0)
        ends = [(ax + t * dx, ay + t * dy) for t in (low, high)]
        # A tip stays where it is.
        inside[s] = any(np.hypot(x - a, y - b) < HERE * h for x, y in tips for a, b in ends), high - low, ends
    found, leaders = {}, []
    for s in sorted(crossed, key=lambda s: inside[s][:2], reverse=True):
        _, _, dx, dy, _ = segments.rows[s]
        found[s] = segments.rows[s], s
        for leader in leaders:
            bx, by, ex, ey, _ = segments.rows[leader]
            if all(abs((y - by) * ex - (x - bx) * ey) < ONE_LINE * h for x, y in inside[s][2]):
                sign = 1.0 if dx * ex + dy * ey > 0 else -1.0
                t = (inside[s][2][0][0] - bx) * ex + (inside[s][2][0][1] - by) * ey
                found[s] = (bx + t * ex, by + t * ey, sign * ex, sign * ey, inside[s][1]), leader
                break
        else:
            leaders.append(s)
    return [found[s] for s in crossed]


def triangulate(polygons, tips, h) -> list[np.ndarray]:
    """Fan of triangles (k, 3, 2) of each convex polygon (n, 2) mm, in cells of sizes `h` (p,) mm; those alike at once.

    A fan starts at the vertex that makes the best ones; a tip first. A polygon may have vertices inside its sides;
    every vertex is a corner of some triangle if any fan allows it.
    """
    found = [polygon[None] for polygon in polygons]
    alike = {}
    for p, polygon in enumerate(polygons):
        alike.setdefault(len(polygon), []).append(p)
    for n, chosen in alike.items():
        if n > 3:
            fans, solid = _best_fans(np.array([polygons[p] for p in chosen]), tips, h[chosen])
            for p, fan, own in zip(chosen, fans, solid):
                found[p] = fan[own]
    return found


def _best_fans(xy, tips, h):
    """The best fan (p, n - 2, 3, 2) of each polygon (p, n, 2), and which of its triangles (p, n - 2) are not flat."""
    n = xy.shape[1]
    first = (np.arange(n)[:, None] + np.arange(1, n - 1)) % n
    apex = np.broadcast_to(xy[:, :, None], (len(xy), n, n - 2, 2))
    fans = np.stack([apex, xy[:, first], xy[:, (first + 1) % n]], axis=3)
    area = orient(fans[..., 0, :], fans[..., 1, :], fans[..., 2, :]) / 2
    longest = np.linalg.norm(fans - fans[..., [1, 2, 0], :], axis=4).max(axis=3)
    solid = area > FLAT * h[:, None, None] * longest
    score = np.where(solid, area / longest**2, np.inf).min(axis=2)
    # A flat triangle leaves a vertex out, unless its neighbour in the fan has it.
    none = np.zeros((len(xy), n, 1), dtype=bool)
    seen = np.concatenate([solid, none], axis=2) | np.concatenate([none, solid], axis=2)
    score += 2.0 * seen.all(axis=2)
    if len(tips):
        gap = np.linalg.norm(xy[:, :, None] - np.asarray(tips), axis=3).min(axis=2)
        score += gap < HERE * h[:, None]
    best = np.argmax(np.where(solid.any(axis=2), score, -1.0), axis=1)
    return fans[np.arange(len(xy)), best], solid[np.arange(len(xy)), best]
