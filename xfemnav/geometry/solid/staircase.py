"""Simplices divided by a linear function, in any dimension.

Where a function is positive on a corners of a simplex, zero on z and negative on b, its positive part is the join of
the z corners with a product of a simplex of a corners and one of b + 1: positive corner i itself, or where its edges to
the b negative ones cross zero. A product of simplices falls into simplices along its staircases, the monotone paths
through its grid of corners (Freudenthal 1942), and so does the section where the function is zero, with b for b + 1.
"""

from itertools import combinations

import numpy as np
from numba import njit

CORNERS = 4  # of a tetrahedron


def _staircases():
    """For a x c corners: how many paths lead from (0, 0) to (a - 1, c - 1), and their steps, [a, c, path, corner]."""
    count = np.zeros((CORNERS + 1, CORNERS + 1), np.int64)
    steps = np.zeros((CORNERS + 1, CORNERS + 1, 6, CORNERS + 1, 2), np.int64)
    for a in range(1, CORNERS + 1):
        for c in range(1, CORNERS + 2 - a):
            for path, up in enumerate(combinations(range(a + c - 2), a - 1)):
                moves = np.array([(1, 0) if k in up else (0, 1) for k in range(a + c - 2)]).reshape(-1, 2)
                steps[a, c, path, 1 : a + c - 1] = moves.cumsum(axis=0)
                count[a, c] += 1
    return count, steps


COUNT, STEPS = _staircases()


@njit(cache=True)
def room(array, n):
    """An array with space for more rows than `n`, and the rows that it had."""
    if n < len(array):
        return array
    larger = np.empty((2 * len(array) + 8,) + array.shape[1:], array.dtype)  # noqa: RUF005 - numba knows no star here
    larger[: len(array)] = array
    return larger


@njit(cache=True)
def _sorted(values, zero, order):
    """Corners into `order`: those above zero, on it and below; and how many are above and below."""
    above = below = 0
    for i in range(len(values)):
        if values[i] > zero:
            order[0, above] = i
            above += 1
        elif values[i] < -zero:
            order[1, below] = i
            below += 1
        else:
            order[2, i - above - below] = i
    return above, below


@njit(cache=True)
def divide(simplex, values, zero, above, n_above, below, n_below):
    """Put the parts of a `simplex` (v, w) where its function, with `values` (v,) at the corners, is positive after the
    first n of `above`, and the negative ones after those of `below`; the whole of one that is zero everywhere is above.

    Returns the two lists, which may have grown, and how many they hold. Corners within `zero` of 0 are on it.
    """
    order = np.empty((3, len(simplex)), np.int64)
    a, b = _sorted(values, zero, order)
    if b == 0:
        above = room(above, n_above)
        above[n_above] = simplex
        return above, n_above + 1, below, n_below
    if a == 0:
        below = room(below, n_below)
        below[n_below] = simplex
        return above, n_above, below, n_below + 1
    above, n_above = _products(simplex, values, order, 0, a, b, 0, above, n_above)
    below, n_below = _products(simplex, values, order, 1, b, a, 0, below, n_below)
    return above, n_above, below, n_below


@njit(cache=True)
def section(simplex, values, zero, found, n):
    """Put the simplices (v - 1, w) of the section of a `simplex` (v, w) on which its function is 0 after the first n of
    `found`; none where it has one sign. Returns the list and how many it holds."""
    order = np.empty((3, len(simplex)), np.int64)
    a, b = _sorted(values, zero, order)
    if a == 0 or b == 0:
        return found, n
    return _products(simplex, values, order, 0, a, b, 1, found, n)


@njit(cache=True)
def _products(simplex, values, order, side, a, b, skip, found, n):
    """The simplices of one side, or with `skip` 1 of the section."""
    on = len(simplex) - a - b
    for path in range(COUNT[a, b + 1 - skip]):
        found = room(found, n)
        for k in range(on):
            found[n, k] = simplex[order[2, k]]
        for k in range(a + b - skip):
            i, j = STEPS[a, b + 1 - skip, path, k]
            p = order[side, i]
            if j + skip == 0:
                found[n, on + k] = simplex[p]
            else:
                q = order[1 - side, j + skip - 1]
                # The same corner from both sides, to the last bit: from the positive end to the negative one.
                high, low = (p, q) if side == 0 else (q, p)
                t = values[high] / (values[high] - values[low])
                found[n, on + k] = simplex[high] + t * (simplex[low] - simplex[high])
        n += 1
    return found, n
