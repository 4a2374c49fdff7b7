"""A triangle split by the lines of segments, one after the other: the scalar work of the partition, compiled.

A polygon is an array of edges (x, y, tag, by), which run to the next edge's start; see `partition`.
"""

import numpy as np
from numba import njit

# Fractions of the local element size h.
ON_LINE = 1e-11  # a vertex as near as this to a line is on it
REACH = 1e-8  # a segment that covers less of a chord than this does not cut it

UNCUT = -1


@njit(cache=True)
def split_cell(corners, rows, by, lines, tips, h):
    """The convex polygons of a triangle (3, 2) mm: all their edges (e, 4), and the number of edges of each.

    Segments are `rows` (k, 5) of start, unit direction and length; the segment's number is `by` (k,), and that of the
    line it is on `lines` (k,). tips (t, 2) mm inside an edge become vertices.
    """
    whole = np.empty((3, 4))
    for k in range(3):
        whole[k, 0], whole[k, 1], whole[k, 2], whole[k, 3] = corners[k, 0], corners[k, 1], -1 - (k + 2) % 3, UNCUT
    polygons = [whole]
    for s in range(len(rows)):
        halves = polygons[:0]
        for polygon in polygons:
            left, right = _split(polygon, by[s], lines[s], rows[s], h)
            halves.append(left)
            if len(right):
                halves.append(right)
        polygons = halves
    total, count = 0, np.empty(len(polygons), np.int64)
    for p in range(len(polygons)):
        polygons[p] = _with_vertices(polygons[p], tips, h)
        count[p] = len(polygons[p])
        total += count[p]
    edges, at = np.empty((total, 4)), 0
    for polygon in polygons:
        edges[at : at + len(polygon)] = polygon
        at += len(polygon)
    return edges, count


@njit(cache=True)
def _split(polygon, by, line, row, h):
    """The two halves of a convex polygon on either side of a segment, or the polygon itself and an empty one."""
    ax, ay, dx, dy, length = row
    n = len(polygon)
    along, raw, off = np.empty(n), np.empty(n), np.empty(n)
    tolerance = ON_LINE * h
    for k in range(n):
        x, y = polygon[k, 0], polygon[k, 1]
        along[k] = (x - ax) * dx + (y - ay) * dy
        raw[k] = (y - ay) * dx - (x - ax) * dy
        off[k] = 0.0 if abs(raw[k]) < tolerance else raw[k]
    if not off.min() < 0 < off.max():
        return _flag_edges_on_line(polygon, along, off, by, length, h), polygon[:0]
    for k in range(n):  # only vertices of the chord may lie on the line
        after = (k + 1) % n
        if off[k] == 0 and off[after] == 0:
            worse = k if abs(raw[k]) > abs(raw[after]) else after
            off[worse] = raw[worse] if raw[worse] != 0 else tolerance
    left, right, n_left, n_right = np.empty((n + 2, 4)), np.empty((n + 2, 4)), 0, 0
    t0, t1 = np.inf, -np.inf
    for k in range(n):
        o, o_next = off[k], off[(k + 1) % n]
        if o == 0:
            t0, t1 = min(t0, along[k]), max(t1, along[k])
            left[n_left], right[n_right] = polygon[k], polygon[k]
            if not o_next > 0:
                left[n_left, 2], left[n_left, 3] = line, UNCUT
            if not o_next < 0:
                right[n_right, 2], right[n_right, 3] = line, UNCUT
            n_left, n_right = n_left + 1, n_right + 1
            continue
        if o > 0:
            left[n_left], n_left = polygon[k], n_left + 1
        else:
            right[n_right], n_right = polygon[k], n_right + 1
        if o * o_next < 0:
            x, y = polygon[k, 0], polygon[k, 1]
            x1, y1 = polygon[(k + 1) % n, 0], polygon[(k + 1) % n, 1]
            w = o / (o - o_next)
            t = along[k] + w * (along[(k + 1) % n] - along[k])
            t0, t1 = min(t0, t), max(t1, t)
            for one in (left[n_left], right[n_right]):
                one[0], one[1] = x + w * (x1 - x), y + w * (y1 - y)
            here, beyond = (left[n_left], right[n_right]) if o > 0 else (right[n_right], left[n_left])
            here[2], here[3], beyond[2], beyond[3] = line, UNCUT, polygon[k, 2], polygon[k, 3]
            n_left, n_right = n_left + 1, n_right + 1
    if min(t1, length) - max(t0, 0.0) <= REACH * h:
        return polygon, polygon[:0]
    return _flag_chord(left[:n_left], by, line, row, h), _flag_chord(right[:n_right], by, line, row, h)


@njit(cache=True)
def _flag_chord(half, by, line, row, h):
    n = len(half)
    along, off = np.empty(n), np.ones(n)
    for k in range(n):
        along[k] = (half[k, 0] - row[0]) * row[2] + (half[k, 1] - row[1]) * row[3]
        if half[k, 2] == line and half[k, 3] == UNCUT:
            off[k] = off[(k + 1) % n] = 0.0
    return _flag_edges_on_line(half, along, off, by, row[4], h)


@njit(cache=True)
def _flag_edges_on_line(polygon, along, off, by, length, h):
    """Mark the part of each edge on the segment's line that the segment covers; its ends become vertices."""
    n, m = len(polygon), 0
    flagged = np.empty((3 * n, 4))
    for k in range(n):
        after = (k + 1) % n
        t0, t1 = along[k], along[after]
        low, high = max(min(t0, t1), 0.0), min(max(t0, t1), length)
        flagged[m] = polygon[k]
        m += 1
        if off[k] != 0 or off[after] != 0 or polygon[k, 3] != UNCUT or high - low <= REACH * h:
            continue
        x, y, x1, y1 = polygon[k, 0], polygon[k, 1], polygon[after, 0], polygon[after, 1]
        start, stop = (low, high) if t1 > t0 else (high, low)
        # From its start, from the segment's, and from where the segment stops.
        flagged[m - 1, 3] = by if abs(start - t0) <= REACH * h else UNCUT
        if flagged[m - 1, 3] == UNCUT:
            w = (start - t0) / (t1 - t0)
            flagged[m] = polygon[k]
            flagged[m, 0], flagged[m, 1], flagged[m, 3] = x + w * (x1 - x), y + w * (y1 - y), by
            m += 1
        if abs(stop - t1) > REACH * h:
            w = (stop - t0) / (t1 - t0)
            flagged[m] = polygon[k]
            flagged[m, 0], flagged[m, 1], flagged[m, 3] = x + w * (x1 - x), y + w * (y1 - y), UNCUT
            m += 1
    return flagged[:m].copy()


@njit(cache=True)
def _with_vertices(polygon, tips, h):
    """The polygon with each tip that lies inside one of its edges as a vertex."""
    for t in range(len(tips)):
        for k in range(len(polygon)):
            x, y = polygon[k, 0], polygon[k, 1]
            after = (k + 1) % len(polygon)
            x1, y1 = polygon[after, 0], polygon[after, 1]
            length = np.hypot(x1 - x, y1 - y)
            along = ((tips[t, 0] - x) * (x1 - x) + (tips[t, 1] - y) * (y1 - y)) / length
            off = ((tips[t, 1] - y) * (x1 - x) - (tips[t, 0] - x) * (y1 - y)) / length
            if abs(off) < ON_LINE * h and REACH * h < along < length - REACH * h:
                longer = np.empty((len(polygon) + 1, 4))
                longer[: k + 1], longer[k + 2 :] = polygon[: k + 1], polygon[k + 1 :]
                longer[k + 1] = polygon[k]
                longer[k + 1, 0], longer[k + 1, 1] = tips[t, 0], tips[t, 1]
                polygon = longer
                break
    return polygon
