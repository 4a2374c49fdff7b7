"""The organ's surface now, closed: mouths bridged, and the resting surface where it was taken out with its tissue."""

from itertools import combinations

import numpy as np

WELD = 1e-6  # mm up to which corners of facets are one: parts of neighbouring cells compute theirs each for itself


def moved_surface(outline, rest, moved) -> np.ndarray:
    """Triangles (k, 3, 3) mm that enclose the organ as it is now, an odd number of times along any way out of it.

    `outline` (b, 3, 3) mm is the organ's closed surface at rest; `rest` and `moved`, both (f, 3, 3) mm, are the facets
    that are left of it, without gaps at rest. A corner that lies on several places now, on the lips of a mouth, is put
    in the middle between them, so that facets on both sides reach across the mouth and meet: straight from lip to lip,
    as `moved_outline` bridges the plane's mouths, but for the tilt of those facets. Where the surface was taken out
    with its tissue the outline at rest goes on, joined to the moved rim about it.
    """
    corner, at = _welded(rest)
    now = _middles(corner, np.asarray(moved, float).reshape(-1, 3))
    faces = corner.reshape(-1, 3)
    edges = np.sort(np.concatenate([faces[:, pair] for pair in combinations(range(3), 2)]), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    border = edges[uses % 2 == 1]
    if not len(border):
        return now[faces]
    # What was taken out is the outline without what is left of it; along its border it is joined to where that is now.
    a, b = border.T
    joints = np.concatenate([np.stack([at[a], at[b], now[b]], axis=1), np.stack([at[a], now[b], now[a]], axis=1)])
    return np.concatenate([now[faces], at[faces], joints, np.asarray(outline, float)])


def _welded(facets):
    """Number (3 f,) of the corner that each corner of facets (f, 3, 3) is, and the places (c, 3) of those."""
    points = np.asarray(facets, float).reshape(-1, 3)
    _, first, corner = np.unique(np.rint(points / WELD).astype(np.int64), axis=0, return_index=True,
                                 return_inverse=True)
    return corner.ravel(), points[first]


def _middles(corner, places) -> np.ndarray:
    """The middle (c, 3) of the different places (n, 3) of each `corner` (n,)."""
    whole = np.column_stack([corner, np.rint(places / WELD).astype(np.int64)])
    _, first = np.unique(whole, axis=0, return_index=True)
    corner, places = corner[first], places[first]
    return np.stack([np.bincount(corner, x) for x in places.T], axis=1) / np.bincount(corner)[:, None]
