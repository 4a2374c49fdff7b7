"""Convex polygons as fans of triangles, compiled."""

import numpy as np
from numba import njit

from xfemnav.geometry.plane.partition import HERE

FLAT = 1e-13  # of the local element size: a triangle lower than this has no area but rounding


@njit
def fan(polygon, tips, h):
    """Triangles (x, y, x', y', x'', y'') of a convex polygon, a list of corners (x, y, ...), in a cell of size h mm.

    The fan starts at the vertex that makes the best ones; a tip (t, 2) mm first. A polygon may have vertices inside its
    sides; every vertex is a corner of some triangle if any fan allows it.
    """
    n = len(polygon)
    best = _best_apex(polygon, tips, h) if n > 3 else 0
    triangles = []
    for k in range(best + 1, best + n - 1):
        if n == 3 or _score(polygon, best, k, h) >= 0:
            a, b, c = polygon[best], polygon[k % n], polygon[(k + 1) % n]
            triangles.append((a[0], a[1], b[0], b[1], c[0], c[1]))
    return triangles


@njit
def _best_apex(polygon, tips, h):
    """The corner that makes the best fan: its worst triangle is better than that of others."""
    n, best, highest = len(polygon), 0, -1.0
    for apex in range(n):
        worst, complete, solid_before = np.inf, True, True
        for k in range(apex + 1, apex + n - 1):
            score = _score(polygon, apex, k, h)
            if score >= 0:
                worst = min(worst, score)
            # A flat triangle leaves a vertex out, unless its neighbour in the fan has it.
            elif not solid_before or k == apex + 1 or k == apex + n - 2:
                complete = False
            solid_before = score >= 0
        if worst == np.inf:
            continue
        worst += 2.0 * complete
        for t in range(len(tips)):
            if np.sqrt((polygon[apex][0] - tips[t, 0]) ** 2 + (polygon[apex][1] - tips[t, 1]) ** 2) < HERE * h:
                worst += 1.0
                break
        if worst > highest:
            best, highest = apex, worst
    return best


@njit
def _score(polygon, apex, k, h):
    """Area over squared longest side of the triangle of an apex and corners k and k + 1; -1 when it is flat."""
    ax, ay, _, _ = polygon[apex]
    bx, by, _, _ = polygon[k % len(polygon)]
    cx, cy, _, _ = polygon[(k + 1) % len(polygon)]
    area = ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / 2
    longest = max(
        np.sqrt((ax - bx) ** 2 + (ay - by) ** 2),
        np.sqrt((bx - cx) ** 2 + (by - cy) ** 2),
        np.sqrt((cx - ax) ** 2 + (cy - ay) ** 2),
    )
    return area / longest**2 if area > FLAT * h * longest else -1.0
