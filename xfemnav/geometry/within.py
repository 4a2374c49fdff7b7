"""What a closed outline encloses: a loop in the plane, a surface of triangles in space."""

import numpy as np
import shapely
from numba import njit


def within(points, outline) -> np.ndarray:
    """Whether `points` (n, d) mm lie in the closed `outline`, (n,) bool: a loop (k, 2) mm, or triangles (k, 3, 3) mm.

    In triangles is what they go around an odd number of times.
    """
    points, outline = np.array(points, float, ndmin=2), np.asarray(outline, float)
    if outline.ndim == 2:
        return shapely.contains_xy(shapely.Polygon(outline).buffer(0), points)
    return _odd(points, np.ascontiguousarray(outline))


@njit(cache=True)
def _odd(points, triangles):
    """Whether a way up the third axis from each of the points (n, 3) meets an odd number of triangles (k, 3, 3).

    Triangles that share an edge agree on which side of it a way passes: an end is on one side or on the other.
    """
    odd = np.zeros(len(points), np.bool_)
    for t in triangles:
        low0, high0 = min(t[0, 0], t[1, 0], t[2, 0]), max(t[0, 0], t[1, 0], t[2, 0])
        low1, high1 = min(t[0, 1], t[1, 1], t[2, 1]), max(t[0, 1], t[1, 1], t[2, 1])
        for n in range(len(points)):
            x, y, z = points[n]
            if not (low0 <= x <= high0 and low1 <= y <= high1):
                continue
            count, ends = 0, np.empty((2, 2))
            for e in range(3):
                a, b = (t[e - 1], t[e]) if t[e - 1, 0] < t[e, 0] else (t[e], t[e - 1])
                if a[0] < x <= b[0]:
                    s = (x - a[0]) / (b[0] - a[0])
                    ends[count, 0], ends[count, 1] = a[1] + s * (b[1] - a[1]), a[2] + s * (b[2] - a[2])
                    count += 1
            if count == 2:
                p, q = (ends[0], ends[1]) if ends[0, 0] < ends[1, 0] else (ends[1], ends[0])
                if p[0] < y <= q[0] and p[1] + (y - p[0]) / (q[0] - p[0]) * (q[1] - p[1]) > z:
                    odd[n] = not odd[n]
    return odd
