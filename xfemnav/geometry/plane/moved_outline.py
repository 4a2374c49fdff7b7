"""The organ's outline now, from moved triangles: facets of its boundary end to end, bridged where tissue has parted."""

import numpy as np
import shapely

from xfemnav.geometry.motion import Motion

ON_LOOP = 1e-5  # mm from the outline up to which a side of a triangle lies on it: files round corners to 1e-6 mm
SIDES = [[0, 1], [1, 2], [2, 0]]


def moved_outline(loop, motion: Motion) -> np.ndarray:
    """The outline now, a closed loop (k, 2) mm, of the organ whose resting one is `loop` (n, 2) mm, counter-clockwise.

    The triangles of its `motion` tile what is left of it, each turning left at rest. Straight lines bridge mouths.
    Where tissue was taken out at the surface the resting outline goes on, moved as its two ends are, linearly between.
    """
    ring = shapely.LinearRing(loop)
    facets, now, arc = _facets(ring, motion.rest, motion.moved)
    if not len(facets):
        return np.array(loop, float)
    half = np.linalg.norm(facets[:, 1] - facets[:, 0], axis=1) / 2
    start, stop = arc - half, arc + half
    gap = np.append(start[1:], start[0] + ring.length) - stop
    u = now - facets
    node = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(loop, axis=0), axis=1))])
    found = []
    for k in range(len(facets)):
        found.append(now[k])
        if gap[k] > ON_LOOP:
            t = np.mod(node - stop[k], ring.length) / gap[k]
            inside = np.flatnonzero((t > 0) & (t < 1))
            inside = inside[np.argsort(t[inside])]
            t = t[inside, None]
            found.append(loop[inside] + (1 - t) * u[k, 1] + t * u[(k + 1) % len(facets), 0])
    return np.concatenate(found)


def _facets(ring, rest, moved):
    """Sides of the triangles on the `ring`, in order: at rest and moved (f, 2, 2), and the arc (f,) of middles."""
    sides, now = (x[:, SIDES].reshape(-1, 2, 2) for x in (rest, moved))
    shapely.prepare(ring)
    on = np.arange(len(sides))
    for end in (0, 1):
        on = on[shapely.dwithin(ring, shapely.points(sides[on, end]), ON_LOOP)]
    middles = shapely.points(sides[on].mean(axis=1))
    near = shapely.dwithin(ring, middles, ON_LOOP)
    arc = shapely.line_locate_point(ring, middles[near])
    order = np.argsort(arc)
    return sides[on[near][order]], now[on[near][order]], arc[order]
