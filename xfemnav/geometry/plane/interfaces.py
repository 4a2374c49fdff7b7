"""What the facets of parts are: contacts across which parts are joined, lips of the cuts, and the organ's rim.

Two parts are joined where their uncut facets overlap, on a mesh edge or on a line inside a cell, so vertices that hang
on a neighbour's facet do not matter. All of it is scalar work, compiled.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from xfemnav.geometry.plane.bisection import REACH, UNCUT
from xfemnav.geometry.plane.partition import HERE, touches
from xfemnav.geometry.plane.snapping import SEVER, SNAP


class Polygons(NamedTuple):
    """Parts of the cells that cuts touch: convex polygons, lists of edges (x, y, tag, by) as in `partition`.

    Polygon k lies in cell[k] and is part[k]; those of cell c are numbers begin[c] to begin[c + 1], none when the cell
    is whole.
    """

    polygons: list
    cell: list
    part: list
    begin: np.ndarray


@njit
def joins(corners, neighbours, sizes, parts):
    """Pairs of parts that are joined, and the ends (x, y, x', y') mm of their contacts, the first part on their left.

    Those between whole cells come first, then those on the edges of other cells, then those inside cells.
    """
    pairs, ends = [], []
    for others in (False, True):
        for c in range(len(corners)):
            for e in range(3):
                d = neighbours[c, e]
                if d <= c or (_split(parts, c) or _split(parts, d)) != others:
                    continue
                a, b = (e + 1) % 3, (e + 2) % 3
                x, y, x1, y1 = corners[c, a, 0], corners[c, a, 1], corners[c, b, 0], corners[c, b, 1]
                if not others:
                    pairs.append((c, d))
                    ends.append((x, y, x1, y1))
                    continue
                f = 0
                while neighbours[d, f] != c:
                    f += 1
                length = np.hypot(x1 - x, y1 - y)
                line = x, y, (x1 - x) / length, (y1 - y) / length
                one, other = _on_edge(parts, c, e, line, length), _on_edge(parts, d, f, line, length)
                for p, q, low, high in _overlaps(one, other, SEVER * sizes[c]):
                    pairs.append((p, q))
                    ends.append(_at(line, low) + _at(line, high))
    for c in range(len(corners)):
        for tag in _tags(parts, c):
            left, right, line = _on_line(parts, c, tag)
            for p, q, low, high in _overlaps(left, right, SEVER * sizes[c]):
                pairs.append((p, q))
                ends.append(_at(line, low) + _at(line, high))
    return pairs, ends


@njit
def _split(parts, c):
    return parts.begin[c] < parts.begin[c + 1]


@njit
def _at(line, t):
    x, y, dx, dy = line
    return x + t * dx, y + t * dy


@njit
def _along(line, x, y):
    return (x - line[0]) * line[2] + (y - line[1]) * line[3]


@njit
def _on_edge(parts, c, e, line, length):
    """Uncut facets (from, to, part) of a cell on its edge e, mm along the edge's line."""
    found = []
    if not _split(parts, c):
        found.append((0.0, length, c))
    for k in range(parts.begin[c], parts.begin[c + 1]):
        polygon = parts.polygons[k]
        for n in range(len(polygon)):
            x, y, tag, by = polygon[n]
            if tag == -1 - e and by == UNCUT:
                x1, y1, _, _ = polygon[(n + 1) % len(polygon)]
                t0, t1 = _along(line, x, y), _along(line, x1, y1)
                found.append((min(t0, t1), max(t0, t1), parts.part[k]))
    return found


@njit
def _tags(parts, c):
    """The lines inside a cell on which uncut facets lie, in the order of their first ones."""
    found = []
    for k in range(parts.begin[c], parts.begin[c + 1]):
        for _, _, tag, by in parts.polygons[k]:
            if tag >= 0 and by == UNCUT and tag not in found:
                found.append(tag)
    return found


@njit
def _on_line(parts, c, tag):
    """Uncut facets (from, to, part) of a cell on a line inside it, of the parts on its left and right, and the line
    (x, y, dx, dy): that of the first of them."""
    left, right = [], []
    line, first = (0.0, 0.0, 0.0, 0.0), True
    for k in range(parts.begin[c], parts.begin[c + 1]):
        polygon = parts.polygons[k]
        for n in range(len(polygon)):
            x, y, own, by = polygon[n]
            if own != tag or by != UNCUT:
                continue
            x1, y1, _, _ = polygon[(n + 1) % len(polygon)]
            if first:
                length = np.hypot(x1 - x, y1 - y)
                line, first = (x, y, (x1 - x) / length, (y1 - y) / length), False
            t0, t1 = _along(line, x, y), _along(line, x1, y1)
            if t1 < t0:
                right.append((t1, t0, parts.part[k]))
            else:
                left.append((t0, t1, parts.part[k]))
    return left, right, line


@njit
def _overlaps(one, two, least):
    """Pairs of parts whose facets overlap by more than `least` mm, in order, and from where to where."""
    found = [(p, q, max(a0, b0), min(a1, b1)) for a0, a1, p in one for b0, b1, q in two]
    found = [own for own in found if own[3] - own[2] > least]
    for k in range(1, len(found)):
        own, at = found[k], k
        while at > 0 and own[:2] < found[at - 1][:2]:
            found[at] = found[at - 1]
            at -= 1
        found[at] = own
    # The first overlap of a pair counts.
    return [found[k] for k in range(len(found)) if k == 0 or found[k][:2] != found[k - 1][:2]]


@njit
def lips(corners, sizes, parts, segments):
    """Pieces of the cuts in travel order: (segment, part on the left, on the right, 1 where the start is on a mesh edge
    and 1 where the stop is), and where they start and stop (mm from the segment's start)."""
    found, spans = [], []
    sides, stop = _sides(parts, segments), 0
    while stop < len(sides):
        s, start = sides[stop][0], stop
        while stop < len(sides) and sides[stop][0] == s and sides[stop][1] == 0:
            stop += 1
        first = j = stop
        while stop < len(sides) and sides[stop][0] == s:
            stop += 1
        line = segments.rows[s, 0], segments.rows[s, 1], segments.rows[s, 2], segments.rows[s, 3]
        for a in range(start, first):
            _, _, a0, a1, p, c, tag = sides[a]
            while j > first and sides[j - 1][3] > a0:
                j -= 1
            while j < stop and sides[j][2] < a1:
                _, _, b0, b1, q, d, _ = sides[j]
                low, high = max(a0, b0), min(a1, b1)
                if high - low > REACH * sizes[c]:
                    on = [_on_mesh(corners, sizes, tag, c, d, *_at(line, t)) for t in (low, high)]
                    found.append((s, p, q, on[0], on[1]))
                    spans.append((low, high))
                j += 1
    return found, spans


@njit
def _sides(parts, segments):
    """Facets of the cuts in order: (segment, 0 on its left or 1 on its right, from and to, mm from its start, part,
    cell, tag)."""
    found = []
    for k in range(len(parts.polygons)):
        polygon = parts.polygons[k]
        for n in range(len(polygon)):
            x, y, tag, s = polygon[n]
            if s == UNCUT:
                continue
            x1, y1, _, _ = polygon[(n + 1) % len(polygon)]
            line = segments.rows[s, 0], segments.rows[s, 1], segments.rows[s, 2], segments.rows[s, 3]
            t0, t1 = _along(line, x, y), _along(line, x1, y1)
            # Parts have their facets counter-clockwise: those on the left run with the travel.
            found.append((s, int(t0 > t1), min(t0, t1), max(t0, t1), parts.part[k], parts.cell[k], tag))
    gap = len(found) // 2  # Shell's sort
    while gap > 0:
        for k in range(gap, len(found)):
            own, at = found[k], k
            while at >= gap and own < found[at - gap]:
                found[at] = found[at - gap]
                at -= gap
            found[at] = own
        gap //= 2
    return found


@njit
def _on_mesh(corners, sizes, tag, c, d, x, y):
    """1 where a point of a lip, a facet with this tag between cells c and d, is on an edge of the mesh, else 0."""
    return int(tag < 0 or _on_an_edge(corners[c], x, y, sizes[c]) or _on_an_edge(corners[d], x, y, sizes[d]))


@njit
def _on_an_edge(corners, x, y, h):
    depth = np.inf
    for k in range(3):
        after = (k + 1) % 3
        ex, ey = corners[after, 0] - corners[k, 0], corners[after, 1] - corners[k, 1]
        depth = min(depth, ex * (y - corners[k, 1]) - ey * (x - corners[k, 0]))
    return depth < SEVER * h**2


@njit
def rim(corners, neighbours, parts):
    """Parts behind the facets of the organ's outline, and their ends (x, y, x', y') mm, tissue on the left."""
    owner, ends = [], []
    for c in range(len(neighbours)):
        for e in range(3):
            if neighbours[c, e] >= 0:
                continue
            if not _split(parts, c):
                a, b = (e + 1) % 3, (e + 2) % 3
                owner.append((c,))
                ends.append((corners[c, a, 0], corners[c, a, 1], corners[c, b, 0], corners[c, b, 1]))
            for k in range(parts.begin[c], parts.begin[c + 1]):
                polygon = parts.polygons[k]
                for n in range(len(polygon)):
                    if polygon[n][2] == -1 - e:
                        after = polygon[(n + 1) % len(polygon)]
                        owner.append((parts.part[k],))
                        ends.append((polygon[n][0], polygon[n][1], after[0], after[1]))
    return owner, ends


@njit
def touched(corners, sizes, parts, tips):
    """Pairs of a tip (t, 2) mm and a part with a corner on it."""
    found = []
    for t in range(len(tips)):
        x, y = tips[t, 0], tips[t, 1]
        for c in range(len(corners)):
            if not touches(corners[c], x, y, 1.0, 0.0, 0.0, SNAP * sizes[c]):
                continue
            reach = HERE * sizes[c]
            if not _split(parts, c):
                for k in range(3):
                    if np.hypot(corners[c, k, 0] - x, corners[c, k, 1] - y) < reach:
                        found.append((t, c))
                        break
            for k in range(parts.begin[c], parts.begin[c + 1]):
                for u, v, _, _ in parts.polygons[k]:
                    if np.hypot(u - x, v - y) < reach:
                        found.append((t, parts.part[k]))
                        break
    return found
