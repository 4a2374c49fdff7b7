"""Nearest places on triangles in space, and on which side of a sheet of triangles a place is.

Kernels take a point as a tuple of three numbers, which costs no array.
"""

import numpy as np
from numba import njit

TIE = 1e-9  # mm, between triangles that are equally near


@njit(cache=True)
def triple(x):
    """The row (3,) as a tuple."""
    return x[0], x[1], x[2]


@njit(cache=True)
def minus(a, b):
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def dot(a, b):
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a, b):
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _along(a, e, s):
    return a[0] + s * e[0], a[1] + s * e[1], a[2] + s * e[2]


@njit(cache=True)
def nearest_on(p, a, b, c):
    """The place of the triangle a, b, c that is nearest to p."""
    e, f, w = minus(b, a), minus(c, a), minus(p, a)
    ee, ef, ff, we, wf = dot(e, e), dot(e, f), dot(f, f), dot(w, e), dot(w, f)
    det = ee * ff - ef * ef
    if det > 0:
        s, t = (we * ff - wf * ef) / det, (wf * ee - we * ef) / det
        if s >= 0 and t >= 0 and s + t <= 1:
            return _along(_along(a, e, s), f, t)
    best, least = a, np.inf
    for start, end in ((a, b), (b, c), (c, a)):
        edge = minus(end, start)
        length = dot(edge, edge)
        s = dot(minus(p, start), edge) / length if length > 0 else 0.0
        at = _along(start, edge, min(max(s, 0.0), 1.0))
        off = minus(p, at)
        if dot(off, off) < least:
            best, least = at, dot(off, off)
    return best


@njit(cache=True)
def _normal(triangle):
    a, b, c = triple(triangle[0]), triple(triangle[1]), triple(triangle[2])
    n = cross(minus(b, a), minus(c, a))
    length = dot(n, n) ** 0.5
    return (n[0] / length, n[1] / length, n[2] / length) if length > 0 else (0.0, 0.0, 0.0)


@njit(cache=True)
def nearest_of(p, triangles, chosen):
    """The number of the `chosen` triangle that is nearest to p, -1 for none; its place there, the distance mm, and the
    height mm over the triangle, positive where its normal points.

    At an edge or corner several are equally near: the one whose plane p is farthest from knows the side.
    """
    found, place, distance, height = -1, p, np.inf, 0.0
    for c in chosen:
        a = triple(triangles[c, 0])
        at = nearest_on(p, a, triple(triangles[c, 1]), triple(triangles[c, 2]))
        off = minus(p, at)
        gap = dot(off, off) ** 0.5
        if gap <= distance + TIE:
            over = dot(off, _normal(triangles[c]))
            if gap < distance - TIE or abs(over) > abs(height):
                found, place, height = c, at, over
            distance = min(gap, distance)
    return found, place, distance, height


@njit(cache=True)
def nearest_on_sheet(points, triangles):
    """For points (n, 3) mm: the nearest of `triangles` (f, 3, 3) mm (n,), the place (n, 3) on it, the distance (n,) mm,
    and whether the point is on the side (n,) to which the normals point."""
    n, f = len(points), len(triangles)
    nearest, place, distance = np.full(n, -1), np.zeros((n, 3)), np.full(n, np.inf)
    left = np.zeros(n, np.bool_)
    middle, reach = np.zeros((f, 3)), np.zeros(f)
    for c in range(f):
        middle[c] = (triangles[c, 0] + triangles[c, 1] + triangles[c, 2]) / 3
        for k in range(3):
            off = minus(triple(triangles[c, k]), triple(middle[c]))
            reach[c] = max(reach[c], dot(off, off) ** 0.5)
    near, away = np.empty(f, np.int64), np.empty(f)
    for k in range(n):
        p, count, least = triple(points[k]), 0, np.inf
        for c in range(f):
            off = minus(p, triple(middle[c]))
            away[c] = dot(off, off) ** 0.5
            least = min(least, away[c])  # to a place of the triangle: the nearest one is not farther
        for c in range(f):
            if away[c] - reach[c] <= least + TIE:
                near[count] = c
                count += 1
        if count:
            nearest[k], place[k], distance[k], height = nearest_of(p, triangles, near[:count])
            left[k] = height > 0
    return nearest, place, distance, left


@njit(cache=True)
def crossings(start, end, triangles, same):
    """Where ways from `start` to `end`, both (n, 3), meet `triangles` (f, 3, 3): the way (k,) and the part (k,) of it.

    An end, an edge or a corner that a way meets up to `same`, as a part of way or triangle, is met.
    """
    ways, parts = [], []
    low, high = np.minimum(start, end), np.maximum(start, end)
    for t in triangles:
        a, e, f = triple(t[0]), minus(triple(t[1]), triple(t[0])), minus(triple(t[2]), triple(t[0]))
        normal = cross(e, f)
        area = dot(normal, normal)
        least, most = np.minimum(np.minimum(t[0], t[1]), t[2]), np.maximum(np.maximum(t[0], t[1]), t[2])
        for n in range(len(start)):
            if (high[n, 0] < least[0] - same or low[n, 0] > most[0] + same or high[n, 1] < least[1] - same
                    or low[n, 1] > most[1] + same or high[n, 2] < least[2] - same or low[n, 2] > most[2] + same):
                continue
            p = triple(start[n])
            step = minus(triple(end[n]), p)
            across, height = dot(step, normal), dot(minus(a, p), normal)
            if across == 0 or area == 0:
                continue    # along the triangle
            s = height / across
            if not -same <= s <= 1 + same:
                continue
            w = minus(_along(p, step, s), a)
            u, v = dot(cross(w, f), normal) / area, dot(cross(e, w), normal) / area
            if u >= -same and v >= -same and u + v <= 1 + same:
                ways.append(n)
                parts.append(s)
    return np.array(ways, np.int64), np.array(parts, np.float64)
