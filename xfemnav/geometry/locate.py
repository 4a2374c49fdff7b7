"""Which simplex is a point in: simplices sorted into square buckets, with a choice of side on a cut."""

from typing import NamedTuple

import numpy as np
from numba import njit

from xfemnav.geometry.nearest import cross, dot, minus, nearest_of, nearest_on, triple

# Points this near to a simplex (mm) touch it: rounding at shared edges must not open the tissue.
TOUCH = 1e-8
# Points this near to a cut (mm) are on its lips when a side is asked for: more than cuts are snapped to the mesh.
LIP = 1e-2


class Buckets(NamedTuple):
    """Square buckets of `width` mm from `corner` (d,) mm, `shape` (d,) of them, and the simplices near each one.

    Bucket k lists `simplex[start[k] : start[k + 1]]`; the last axis of `shape` counts fastest.
    """

    corner: np.ndarray
    width: float
    shape: np.ndarray
    start: np.ndarray
    simplex: np.ndarray


def bucket(simplices) -> Buckets:
    """Sort simplices (t, k, d) mm into about as many buckets; one is in all that its box, LIP wider, meets."""
    low, high = simplices.min(axis=1) - LIP, simplices.max(axis=1) + LIP
    corner, size = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    width = float((size.prod() / len(simplices)) ** (1 / len(size)))
    first, last = ((x - corner) // width for x in (low, high))
    first, last = first.astype(np.int64), last.astype(np.int64)
    shape = last.max(axis=0) + 1
    flat = np.zeros((len(first), 3 - len(size)), np.int64)  # the plane is one layer of space
    layers = np.concatenate([np.ones(3 - len(size), np.int64), shape])
    return Buckets(corner, width, shape, *_fill(np.hstack([flat, first]), np.hstack([flat, last]), layers))


def held(points, simplices) -> np.ndarray:
    """Whether points (n, d) mm lie in simplices (t, d + 1, d) mm, (n,) bool."""
    return locate(np.array(points, float, ndmin=2), simplices, bucket(simplices)) >= 0


@njit(cache=True)
def _fill(first, last, shape):
    """`start` and `simplex` of Buckets, from the first and last buckets (t, 3) of each one's box."""
    start = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    for c in range(len(first)):
        for i in range(first[c, 0], last[c, 0] + 1):
            for j in range(first[c, 1], last[c, 1] + 1):
                row = (i * shape[1] + j) * shape[2] + 1
                for k in range(row + first[c, 2], row + last[c, 2] + 1):
                    start[k] += 1
    start = np.cumsum(start)
    free, simplex = start[:-1].copy(), np.empty(start[-1], np.int64)
    for c in range(len(first)):
        for i in range(first[c, 0], last[c, 0] + 1):
            for j in range(first[c, 1], last[c, 1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for k in range(row + first[c, 2], row + last[c, 2] + 1):
                    simplex[free[k]] = c
                    free[k] += 1
    return start, simplex


@njit(cache=True)
def _fit(x, y, corners):
    """How well the point (x, y) fits a triangle (3, 2): its height where they touch, else minus their distance, mm.

    Of the triangles that touch a point the tallest carries it with the least rounding; on one turned inside out a point
    fits worse than on any that is not.
    """
    twice = (corners[1, 0] - corners[0, 0]) * (corners[2, 1] - corners[0, 1]) \
        - (corners[1, 1] - corners[0, 1]) * (corners[2, 0] - corners[0, 0])
    distance, longest, inside = np.inf, 0.0, True
    for k in range(3):
        ax, ay = corners[k]
        bx, by = corners[(k + 1) % 3]
        length = np.hypot(bx - ax, by - ay)
        longest = max(longest, length)
        if length == 0 or twice == 0:
            return -np.inf
        along = ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length
        beside = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / length
        inside &= beside * twice >= 0
        past = max(-along, along - length, 0.0)
        distance = min(distance, np.hypot(past, beside))
    if inside or distance <= TOUCH:
        return twice / longest if twice > 0 else 0.0
    return -distance


@njit(cache=True)
def _fit_solid(point, corners):
    """`_fit` of a point (3,) to a tetrahedron (4, 3)."""
    p, a, b, c, d = triple(point), triple(corners[0]), triple(corners[1]), triple(corners[2]), triple(corners[3])
    for i in range(3):
        low, high = min(min(a[i], b[i]), min(c[i], d[i])), max(max(a[i], b[i]), max(c[i], d[i]))
        if p[i] < low - LIP or p[i] > high + LIP:
            return -np.inf    # too far for anything
    lowest, largest = np.inf, 0.0
    six = dot(cross(minus(b, a), minus(c, a)), minus(d, a))
    if six == 0:
        return -np.inf
    for top, u, v, w in ((a, b, c, d), (b, a, c, d), (c, a, b, d), (d, a, b, c)):
        normal = cross(minus(v, u), minus(w, u))
        area = dot(normal, normal) ** 0.5
        largest = max(largest, area)
        above = dot(normal, minus(p, u)) / area
        lowest = min(lowest, above if dot(normal, minus(top, u)) > 0 else -above)
    distance = 0.0
    if lowest < 0:
        if lowest < -LIP:
            return lowest    # farther than from the plane of a face
        distance = np.inf
        for u, v, w in ((b, c, d), (a, c, d), (a, b, d), (a, b, c)):
            off = minus(p, nearest_on(p, u, v, w))
            distance = min(distance, dot(off, off) ** 0.5)
    if distance <= TOUCH:
        return six / largest if six > 0 else 0.0
    return -distance


@njit(cache=True)
def _fits(point, simplex):
    """`_fit` in the plane or in space."""
    return _fit(point[0], point[1], simplex) if len(point) == 2 else _fit_solid(point, simplex)


@njit(cache=True)
def _listed(point, buckets):
    """The simplices near a point (d,)."""
    k = 0
    for a in range(len(point)):
        i = np.floor((point[a] - buckets.corner[a]) / buckets.width)
        if not 0 <= i < buckets.shape[a]:
            return buckets.simplex[:0]
        k = k * buckets.shape[a] + int(i)
    return buckets.simplex[buckets.start[k]:buckets.start[k + 1]]


@njit(cache=True)
def locate(points, simplices, buckets):
    """Index (n,) of the simplex that each point is in, -1 for none."""
    found = np.full(len(points), -1)
    for n in range(len(points)):
        best = -TOUCH
        for c in _listed(points[n], buckets):
            fit = _fits(points[n], simplices[c])
            if fit > best:
                best, found[n] = fit, c
    return found


@njit(cache=True)
def _turn(a, b):
    """Angle from direction `a` to `b`, both (2,), counter-clockwise, 0 to 2 pi."""
    return np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]) % (2 * np.pi)


@njit(cache=True)
def locate_beside(points, corner, left, triangles, buckets):
    """Like `locate` for points on a path: only triangles on its left, or right, up to LIP away.

    `corner` (n, 3, 2) is the path's apex near the point and its directions ahead and back: the left is the sector from
    ahead counter-clockwise to back, which at a kink is no half plane.
    """
    found = np.full(len(points), -1)
    for n in range(len(points)):
        best = -LIP
        apex, ahead, back = corner[n]
        sector = _turn(ahead, back)
        for c in _listed(points[n], buckets):
            middle = (triangles[c, 0] + triangles[c, 1] + triangles[c, 2]) / 3
            if (_turn(ahead, middle - apex) < sector) == left[n]:
                fit = _fit(points[n, 0], points[n, 1], triangles[c])
                if fit > best:
                    best, found[n] = fit, c
    return found


@njit(cache=True)
def locate_beside_sheet(points, left, tetrahedra, buckets, sheet, sheet_buckets):
    """Like `locate` for points on a `sheet` (f, 3, 3): only tetrahedra on its left, or right, up to LIP away.

    The left is where the triangles' normals point; near a point only those triangles tell that are near it.
    """
    found = np.full(len(points), -1)
    for n in range(len(points)):
        best, near = -LIP, _listed(points[n], sheet_buckets)
        for c in _listed(points[n], buckets):
            x = tetrahedra[c]
            middle = triple((x[0] + x[1] + x[2] + x[3]) / 4)
            if (nearest_of(middle, sheet, near)[3] > 0) == left[n]:
                fit = _fit_solid(points[n], x)
                if fit > best:
                    best, found[n] = fit, c
    return found


@njit(cache=True)
def touches(points, sheet, buckets):
    """Whether points (n, 3) are on triangles `sheet` (f, 3, 3), up to LIP, (n,) bool."""
    found = np.zeros(len(points), np.bool_)
    for n in range(len(points)):
        found[n] = nearest_of(triple(points[n]), sheet, _listed(points[n], buckets))[2] <= LIP
    return found
