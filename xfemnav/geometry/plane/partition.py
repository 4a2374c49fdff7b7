"""Binary space partition of the cells that a network of segments crosses.

A convex part is split by the supporting line of a segment; only the segment's own interval on that line is a cut.
A polygon is a list of edges (x, y, tag, by): it runs from (x, y) to the next edge's start. `tag` is the line that the
edge lies on: -1, -2, -3 the cell's edges opposite local node 0, 1, 2, and s >= 0 the line of segment s.
`by` is the segment that cuts along the edge, or UNCUT.

Segments that run on one line but for rounding would leave slivers that no predicate tells apart: inside a cell they
are put on one line, whose tag they share.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from xfemnav.geometry.plane.bisection import UNCUT, split_cell
from xfemnav.geometry.plane.snapping import SNAP

# Fractions of the local element size h.
ONE_LINE = 4e-6  # two segments that stay as near as this to one line, inside a cell, are on it
AT_TIP = 1e-9  # a corner as near as this to a tip is moved onto it
HERE = 1e-5  # a corner as near as this to a node or tip is that node or tip


class Segments(NamedTuple):
    """All segments of a network, path by path.

    rows (s, 5): start mm, unit direction, length mm; cut (s,): the path of each; start (s,): where it starts, mm along
    the path.
    """

    rows: np.ndarray
    cut: np.ndarray
    start: np.ndarray


def segments_of(paths) -> Segments:
    """The segments of paths (k, 2) mm."""
    rows, cut, start = [np.empty((0, 5))], [np.empty(0, int)], [np.empty(0)]
    for k, path in enumerate(paths):
        d = path[1:] - path[:-1]
        length = np.hypot(d[:, 0], d[:, 1])
        rows.append(np.column_stack([path[:-1], d / length[:, None], length]))
        cut.append(np.full(len(d), k))
        start.append(np.concatenate([[0.0], np.cumsum(length)])[:-1])
    return Segments(np.concatenate(rows), np.concatenate(cut), np.concatenate(start))


@njit
def split_cells(corners, sizes, rows, tips):
    """Convex polygons of every cell (m, 3, 2) mm that a segment (s, 5) touches and does not leave whole, cell by cell,
    and the cell of each; tips (t, 2) mm inside an edge are corners."""
    polygons, cells = [], []
    for c in range(len(corners)):
        h, crossed = sizes[c], []
        for s in range(len(rows)):
            if touches(corners[c], rows[s, 0], rows[s, 1], rows[s, 2], rows[s, 3], rows[s, 4], SNAP * h):
                crossed.append(s)
        if len(crossed) == 0:
            continue
        on, lines = _lines(crossed, rows, corners[c], tips, h)
        found = split_cell(corners[c], on, crossed, lines, tips, h)
        for t in range(len(tips)):
            found = _one_corner_at(found, tips[t, 0], tips[t, 1], AT_TIP * h)
        if len(found) > 1 or len(found[0]) > 3 or _is_cut(found[0]):
            for polygon in found:
                polygons.append(polygon)
                cells.append(c)
    return polygons, cells


@njit
def touches(corners, ax, ay, dx, dy, length, slack):
    """Whether a closed triangle (3, 2) mm comes within `slack` mm of a segment."""
    along0, along1, off0, off1 = np.inf, -np.inf, np.inf, -np.inf
    for k in range(3):
        x, y = corners[k, 0] - ax, corners[k, 1] - ay
        along, off = x * dx + y * dy, y * dx - x * dy
        along0, along1, off0, off1 = min(along0, along), max(along1, along), min(off0, off), max(off1, off)
    return along1 >= -slack and along0 <= length + slack and off1 >= -slack and off0 <= slack


@njit
def _is_cut(polygon):
    cut = False
    for _, _, _, by in polygon:
        cut |= by != UNCUT
    return cut


@njit
def _lines(crossed, rows, corners, tips, h):
    """Row and line of each segment in a cell: its own, or what the cell holds of it on the line of a longer one."""
    found = [(rows[s, 0], rows[s, 1], rows[s, 2], rows[s, 3], rows[s, 4]) for s in crossed]
    lines = crossed.copy()
    if len(crossed) == 1:
        return found, lines
    held = [_held(row, corners, tips, h) for row in found]
    leaders = []
    for k in _longest_first(held):
        _, length, x, y, x1, y1 = held[k]
        _, _, dx, dy, _ = found[k]
        own = True
        for j in leaders:
            bx, by, ex, ey, _ = found[j]
            off = max(abs((y - by) * ex - (x - bx) * ey), abs((y1 - by) * ex - (x1 - bx) * ey))
            if off < ONE_LINE * h:
                sign = 1.0 if dx * ex + dy * ey > 0 else -1.0
                t = (x - bx) * ex + (y - by) * ey
                found[k], lines[k] = (bx + t * ex, by + t * ey, sign * ex, sign * ey, length), crossed[j]
                own = False
                break
        if own:
            leaders.append(k)
    return found, lines


@njit
def _held(row, corners, tips, h):
    """What a cell holds of a segment: whether a tip ends it, its length, and its ends."""
    ax, ay, dx, dy, length = row
    low, high = np.inf, -np.inf
    for k in range(3):
        t = (corners[k, 0] - ax) * dx + (corners[k, 1] - ay) * dy
        low, high = min(low, t), max(high, t)
    low, high = max(low, 0.0), max(min(high, length), 0.0)
    x, y, x1, y1 = ax + low * dx, ay + low * dy, ax + high * dx, ay + high * dy
    ended = False
    for k in range(len(tips)):
        ended |= np.hypot(tips[k, 0] - x, tips[k, 1] - y) < HERE * h
        ended |= np.hypot(tips[k, 0] - x1, tips[k, 1] - y1) < HERE * h
    return ended, high - low, x, y, x1, y1


@njit
def _longest_first(held):
    """Numbers of the segments in a cell: those that a tip ends first, for it stays where it is, then the longest."""
    order = list(range(len(held)))
    for k in range(1, len(held)):
        at = k
        while at > 0 and (held[order[at - 1]][0], held[order[at - 1]][1]) < (held[k][0], held[k][1]):
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
    return order


@njit
def _one_corner_at(cell, x, y, reach):
    """The polygons with all corners within `reach` mm of a tip (x, y) on it: lines that meet there at a small angle
    miss it by more than rounding."""
    near = False
    for polygon in cell:
        for u, v, _, _ in polygon:
            near |= 0 < abs(u - x) + abs(v - y) < reach
    if not near:
        return cell
    found = []
    for polygon in cell:
        moved = [(x, y, tag, by) if abs(u - x) + abs(v - y) < reach else (u, v, tag, by) for u, v, tag, by in polygon]
        kept = []
        for k in range(len(moved)):
            after = moved[(k + 1) % len(moved)]
            if moved[k][0] != after[0] or moved[k][1] != after[1]:
                kept.append(moved[k])
        if len(kept) > 2:
            found.append(kept)
    return found
