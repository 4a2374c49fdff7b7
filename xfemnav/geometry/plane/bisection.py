"""A triangle split by the lines of segments, one after the other: the scalar work of the partition, compiled.

A polygon is a list of edges (x, y, tag, by), which run to the next edge's start; see `partition`.
"""

import numpy as np
from numba import njit

# Fractions of the local element size h.
ON_LINE = 1e-11  # a vertex as near as this to a line is on it
REACH = 1e-8  # a segment that covers less of a chord than this does not cut it

UNCUT = -1


@njit
def split_cell(corners, rows, by, lines, tips, h):
    """The convex polygons of a triangle (3, 2) mm.

    Segments are `rows` (start, unit direction, length); the segment's number is `by` (k,), and that of the line it is
    on `lines` (k,). tips (t, 2) mm inside an edge become vertices.
    """
    polygons = [[(corners[k, 0], corners[k, 1], -1 - (k + 2) % 3, UNCUT) for k in range(3)]]
    for s in range(len(rows)):
        halves = []
        for polygon in polygons:
            for half in _split(polygon, by[s], lines[s], rows[s], h):
                halves.append(half)
        polygons = halves
    for polygon in polygons:
        _add_vertices(polygon, tips, h)
    return polygons


@njit
def _split(polygon, by, line, row, h):
    """The two halves of a convex polygon on either side of a segment, or the polygon itself."""
    ax, ay, dx, dy, length = row
    n, tolerance = len(polygon), ON_LINE * h
    along = [(x - ax) * dx + (y - ay) * dy for x, y, _, _ in polygon]
    raw = [(y - ay) * dx - (x - ax) * dy for x, y, _, _ in polygon]
    off = [0.0 if abs(o) < tolerance else o for o in raw]
    above = below = False
    for o in off:
        above, below = above or o > 0, below or o < 0
    if not (above and below):
        return [_flag_edges_on_line(polygon, along, off, by, length, h)]
    for k in range(n):  # only vertices of the chord may lie on the line
        after = (k + 1) % n
        if off[k] == 0 and off[after] == 0:
            worse = k if abs(raw[k]) > abs(raw[after]) else after
            off[worse] = raw[worse] if raw[worse] != 0 else tolerance
    left, right = [], []
    t0, t1 = np.inf, -np.inf
    for k in range(n):
        o, o_next = off[k], off[(k + 1) % n]
        x, y, tag, own = polygon[k]
        if o == 0:
            t0, t1 = min(t0, along[k]), max(t1, along[k])
            left.append((x, y, tag, own) if o_next > 0 else (x, y, line, UNCUT))
            right.append((x, y, tag, own) if o_next < 0 else (x, y, line, UNCUT))
            continue
        here, beyond = (left, right) if o > 0 else (right, left)
        here.append(polygon[k])
        if o * o_next < 0:
            x1, y1, _, _ = polygon[(k + 1) % n]
            w = o / (o - o_next)
            t = along[k] + w * (along[(k + 1) % n] - along[k])
            t0, t1 = min(t0, t), max(t1, t)
            here.append((x + w * (x1 - x), y + w * (y1 - y), line, UNCUT))
            beyond.append((x + w * (x1 - x), y + w * (y1 - y), tag, own))
    if min(t1, length) - max(t0, 0.0) <= REACH * h:
        return [polygon]
    return [_flag_chord(left, by, line, row, h), _flag_chord(right, by, line, row, h)]


@njit
def _flag_chord(half, by, line, row, h):
    ax, ay, dx, dy, length = row
    along, off = [(x - ax) * dx + (y - ay) * dy for x, y, _, _ in half], [1.0 for _ in half]
    for k in range(len(half)):
        if half[k][2] == line and half[k][3] == UNCUT:
            off[k] = off[(k + 1) % len(half)] = 0.0
    return _flag_edges_on_line(half, along, off, by, length, h)


@njit
def _flag_edges_on_line(polygon, along, off, by, length, h):
    """Mark the part of each edge on the segment's line that the segment covers; its ends become vertices."""
    flagged = []
    for k in range(len(polygon)):
        after = (k + 1) % len(polygon)
        t0, t1 = along[k], along[after]
        low, high = max(min(t0, t1), 0.0), min(max(t0, t1), length)
        x, y, tag, own = polygon[k]
        if off[k] != 0 or off[after] != 0 or own != UNCUT or high - low <= REACH * h:
            flagged.append(polygon[k])
            continue
        x1, y1, _, _ = polygon[after]
        start, stop = (low, high) if t1 > t0 else (high, low)
        # From its start, from the segment's, and from where the segment stops.
        covered = abs(start - t0) <= REACH * h
        flagged.append((x, y, tag, by if covered else UNCUT))
        if not covered:
            w = (start - t0) / (t1 - t0)
            flagged.append((x + w * (x1 - x), y + w * (y1 - y), tag, by))
        if abs(stop - t1) > REACH * h:
            w = (stop - t0) / (t1 - t0)
            flagged.append((x + w * (x1 - x), y + w * (y1 - y), tag, UNCUT))
    return flagged


@njit
def _add_vertices(polygon, tips, h):
    """Make each tip that lies inside one of the polygon's edges a vertex."""
    for t in range(len(tips)):
        for k in range(len(polygon)):
            x, y, tag, by = polygon[k]
            x1, y1, _, _ = polygon[(k + 1) % len(polygon)]
            length = np.hypot(x1 - x, y1 - y)
            along = ((tips[t, 0] - x) * (x1 - x) + (tips[t, 1] - y) * (y1 - y)) / length
            off = ((tips[t, 1] - y) * (x1 - x) - (tips[t, 0] - x) * (y1 - y)) / length
            if abs(off) < ON_LINE * h and REACH * h < along < length - REACH * h:
                polygon.insert(k + 1, (tips[t, 0], tips[t, 1], tag, by))
                break
