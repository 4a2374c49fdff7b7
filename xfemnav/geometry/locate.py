"""Which triangle is a point in: triangles sorted into square buckets, with a choice of side on a cut."""

from typing import NamedTuple

import numpy as np
from numba import njit

# Points this near to a triangle (mm) touch it: rounding at shared edges must not open the tissue.
TOUCH = 1e-8
# Points this near to a cut (mm) are on its lips when a side is asked for: more than cuts are snapped to the mesh.
LIP = 1e-2


class Buckets(NamedTuple):
    """Square buckets of `width` mm from `corner` (2,) mm, `shape` (2,) of them, and the triangles near each one.

    Bucket (i, j) lists `triangle[start[k] : start[k + 1]]`, k = i * shape[1] + j.
    """

    corner: np.ndarray
    width: float
    shape: np.ndarray
    start: np.ndarray
    triangle: np.ndarray


def bucket(triangles) -> Buckets:
    """Sort triangles (t, 3, 2) mm into about as many buckets; a triangle is in all that its box, LIP wider, meets."""
    low, high = triangles.min(axis=1) - LIP, triangles.max(axis=1) + LIP
    corner, size = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    width = float(np.sqrt(size.prod() / len(triangles)))
    first, last = ((x - corner) // width for x in (low, high))
    first, last = first.astype(np.int64), last.astype(np.int64)
    shape = last.max(axis=0) + 1
    return Buckets(corner, width, shape, *_fill(first, last, shape))


def held(points, triangles) -> np.ndarray:
    """Whether points (n, 2) mm lie in triangles (t, 3, 2) mm, (n,) bool."""
    return locate(np.array(points, float, ndmin=2), triangles, bucket(triangles)) >= 0


@njit(cache=True)
def _fill(first, last, shape):
    start = np.zeros(shape[0] * shape[1] + 1, np.int64)
    for c in range(len(first)):
        for i in range(first[c, 0], last[c, 0] + 1):
            for j in range(first[c, 1], last[c, 1] + 1):
                start[i * shape[1] + j + 1] += 1
    start = np.cumsum(start)
    free, triangle = start[:-1].copy(), np.empty(start[-1], np.int64)
    for c in range(len(first)):
        for i in range(first[c, 0], last[c, 0] + 1):
            for j in range(first[c, 1], last[c, 1] + 1):
                k = i * shape[1] + j
                triangle[free[k]] = c
                free[k] += 1
    return start, triangle


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
def _bucket_of(x, y, buckets):
    i, j = np.floor((x - buckets.corner[0]) / buckets.width), np.floor((y - buckets.corner[1]) / buckets.width)
    if 0 <= i < buckets.shape[0] and 0 <= j < buckets.shape[1]:
        return int(i) * buckets.shape[1] + int(j)
    return -1


@njit(cache=True)
def locate(points, triangles, buckets):
    """Index (n,) of the triangle that each point is in, -1 for none."""
    found = np.full(len(points), -1)
    for n in range(len(points)):
        x, y = points[n]
        k = _bucket_of(x, y, buckets)
        best = -TOUCH
        for c in buckets.triangle[buckets.start[k]:buckets.start[k + 1]] if k >= 0 else buckets.triangle[:0]:
            fit = _fit(x, y, triangles[c])
            if fit > best:
                best, found[n] = fit, c
    return found


@njit(cache=True)
def _turn(a, b):
    """Angle from direction `a` to `b`, both (2,), counter-clockwise, 0 to 2 pi."""
    return np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]) % (2 * np.pi)


@njit(cache=True)
def locate_beside(points, corner, left, triangles, buckets):
    """Like `locate` for points on a cut: only triangles on its left, or right, up to LIP away.

    `corner` (n, 3, 2) is the cut's apex near the point and its directions ahead and back: the left is the sector from
    ahead counter-clockwise to back, which at a kink is no half plane.
    """
    found = np.full(len(points), -1)
    for n in range(len(points)):
        x, y = points[n]
        k = _bucket_of(x, y, buckets)
        best = -LIP
        apex, ahead, back = corner[n]
        sector = _turn(ahead, back)
        for c in buckets.triangle[buckets.start[k]:buckets.start[k + 1]] if k >= 0 else buckets.triangle[:0]:
            middle = (triangles[c, 0] + triangles[c, 1] + triangles[c, 2]) / 3
            if (_turn(ahead, middle - apex) < sector) == left[n]:
                fit = _fit(x, y, triangles[c])
                if fit > best:
                    best, found[n] = fit, c
    return found
