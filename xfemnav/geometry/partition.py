"""Binary space partition of the cells that a network of segments crosses.

A convex part is split by the supporting line of a segment; only the segment's own interval on that line is a cut.
A polygon is a list of edges (x, y, tag, by): it runs from (x, y) to the next edge's start. `tag` is the line that the
edge lies on: -1, -2, -3 the cell's edges opposite local node 0, 1, 2, and s >= 0 the line of segment s.
`by` is the segment that cuts along the edge, or UNCUT.

Segments that run on one line but for rounding would leave slivers that no predicate tells apart: inside a cell they
are put on one line, whose tag they share.
"""

import numpy as np

from xfemnav.geometry.mesh import orient
from xfemnav.geometry.snapping import SNAP

# Fractions of the local element size h.
ON_LINE = 1e-11  # a vertex as near as this to a line is on it
REACH = 1e-8  # a segment that covers less of a chord than this does not cut it
ONE_LINE = 4e-6  # two segments that stay as near as this to one line, inside a cell, are on it
FLAT = 1e-13  # a triangle lower than this has no area but rounding
HERE = 1e-5  # a corner as near as this to a node or tip is that node or tip

UNCUT = -1


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
    polygons = {}
    for c, crossed in sorted(crossing.items()):
        h = float(mesh.sizes[c])
        (x0, y0), (x1, y1), (x2, y2) = mesh.corners[c].tolist()
        cell = [[(x0, y0, -3, UNCUT), (x1, y1, -1, UNCUT), (x2, y2, -2, UNCUT)]]
        for s, (row, line) in zip(crossed, _lines(crossed, segments, mesh.corners[c], tips, h)):
            cell = [half for polygon in cell for half in _split(polygon, s, line, row, h)]
        cell = [_with_vertices(polygon, tips, h) for polygon in cell]
        if len(cell) > 1 or len(cell[0]) > 3 or any(edge[3] != UNCUT for edge in cell[0]):
            polygons[c] = cell
    return polygons


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


def _split(polygon, s, line, row, h):
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
            left.append((x, y, tag, by) if o_next > 0 else (x, y, line, UNCUT))
            right.append((x, y, tag, by) if o_next < 0 else (x, y, line, UNCUT))
            continue
        (left if o > 0 else right).append((x, y, tag, by))
        if o * o_next < 0:
            x1, y1 = polygon[(k + 1) % n][:2]
            w = o / (o - o_next)
            xc, yc = x + w * (x1 - x), y + w * (y1 - y)
            ends.append(along[k] + w * (along[(k + 1) % n] - along[k]))
            (left if o > 0 else right).append((xc, yc, line, UNCUT))
            (right if o > 0 else left).append((xc, yc, tag, by))
    t0, t1 = min(ends), max(ends)
    if min(t1, length) - max(t0, 0.0) <= REACH * h:
        return [polygon]
    return [_flag_chord(half, s, line, row, h) for half in (left, right)]


def _flag_chord(half, s, line, row, h):
    along = [(x - row[0]) * row[2] + (y - row[1]) * row[3] for x, y, _, _ in half]
    on_line = [k for k, edge in enumerate(half) if edge[2] == line and edge[3] == UNCUT]
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
                polygon = [*polygon[: k + 1], (float(tip[0]), float(tip[1]), tag, by), *polygon[k + 1 :]]
                break
    return polygon


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
