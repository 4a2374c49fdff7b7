"""Triangulation that grows point by point: locate, cut the cavity, fill it (Bowyer 1981, Watson 1981).

Cells are counter-clockwise; `across[t, i]` is the cell behind the edge opposite local corner i, -1 outside the hull.
Cells with different `inside` marks are never joined in one cavity, so that the interface between them, the outline,
stays. Everything here is compiled by numba; positions are mm.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

CAVITY = 4096  # most edges that one cavity may have


class Triangulation(NamedTuple):
    """Growing triangulation; the first `count[0]` nodes and `count[1]` cells are in use.

    points (n, 2) mm; sizes (n,) mm, wanted edge length at the nodes; cells, across (m, 3); inside (m,) int8; home
    (n,) one cell at each node; stamp (m,) and slot (n,) scratch marks of the insertion; count (4,): nodes, cells,
    insertions tried, cell found last.
    """

    points: np.ndarray
    sizes: np.ndarray
    cells: np.ndarray
    across: np.ndarray
    inside: np.ndarray
    home: np.ndarray
    stamp: np.ndarray
    slot: np.ndarray
    count: np.ndarray


def square(low: np.ndarray, high: np.ndarray, capacity: int) -> Triangulation:
    """Two cells over a square far around the box `low`, `high` (2,) mm, with room for `capacity` nodes."""
    centre, reach = (low + high) / 2, 8 * float(np.max(high - low))
    n, m = capacity + 4, 2 * (capacity + 4)
    points, cells, across = np.empty((n, 2)), np.empty((m, 3), np.int64), np.empty((m, 3), np.int64)
    # Turned by an odd angle: no edge of the square is parallel to a rectangular outline.
    turn = 0.37 + np.pi / 2 * np.arange(4)
    points[:4] = centre + reach * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    cells[:2], across[:2] = [[0, 1, 2], [0, 2, 3]], [[-1, 1, -1], [-1, -1, 0]]
    # Zeros and empties cost nothing until they are written, so that room for many nodes is free.
    return Triangulation(
        points, np.zeros(n), cells, across, np.zeros(m, np.int8), home=np.zeros(n, np.int64),
        stamp=np.zeros(m, np.int64), slot=np.zeros(n, np.int64), count=np.array([4, 2, 0, 0]),
    )


@njit(cache=True, inline="always")
def _turn(p, a, b, x, y):
    """Twice the area of the triangle a, b, (x, y), mm^2, positive when it turns left."""
    return (p[b, 0] - p[a, 0]) * (y - p[a, 1]) - (p[b, 1] - p[a, 1]) * (x - p[a, 0])


@njit(cache=True, inline="always")
def _encircles(p, a, b, c, x, y):
    """Whether (x, y) lies inside the circle through a, b, c (counter-clockwise)."""
    ax, ay, bx, by, cx, cy = p[a, 0] - x, p[a, 1] - y, p[b, 0] - x, p[b, 1] - y, p[c, 0] - x, p[c, 1] - y
    aa, bb, cc = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    return ax * (by * cc - bb * cy) - ay * (bx * cc - bb * cx) + aa * (bx * cy - by * cx) > 0


@njit(cache=True)
def _locate(T, cell, x, y):
    """Cell that holds (x, y), walking from `cell`; -1 outside the hull, or when the walk goes round in circles."""
    for step in range(T.count[1] + 8):
        moved = False
        for turn in range(3):
            i = (turn + step) % 3
            if _turn(T.points, T.cells[cell, (i + 1) % 3], T.cells[cell, (i + 2) % 3], x, y) < 0:
                cell = T.across[cell, i]
                moved = True
                break
        if not moved or cell < 0:
            return cell
    return -1


@njit(cache=True, inline="always")
def _distance2(p, a, b, x, y):
    """Squared distance of (x, y) from the segment a b, mm^2."""
    dx, dy = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1]
    s = ((x - p[a, 0]) * dx + (y - p[a, 1]) * dy) / (dx * dx + dy * dy)
    s = min(1.0, max(0.0, s))
    return (x - p[a, 0] - s * dx) ** 2 + (y - p[a, 1] - s * dy) ** 2


@njit(cache=True)
def _insert(T, x, y, gap, depth, start, hollow, rim, outer):
    """Insert one point; its index, or -1 when it is outside, closer than `gap` mm to a node or `depth` to the
    outline.

    `hollow` holds the cells of the cavity, `rim` (k, 2) its edges and `outer` (k,) the cells behind them.
    """
    cell = _locate(T, start, x, y)
    if cell < 0:
        return -1
    T.count[3] = cell
    p = T.points
    if gap > 0 and T.inside[cell] == 0:
        return -1
    for i in range(3):  # spares most of the refused points the cavity
        a = T.cells[cell, i]
        if (p[a, 0] - x) ** 2 + (p[a, 1] - y) ** 2 < gap * gap:
            return -1
    T.count[2] += 1
    stamp = T.count[2]
    hollow[0], n_hollow, n_rim, k = cell, 1, 0, 0
    T.stamp[cell] = stamp
    while k < n_hollow:
        t = hollow[k]
        k += 1
        for i in range(3):
            a, b, other = T.cells[t, (i + 1) % 3], T.cells[t, (i + 2) % 3], T.across[t, i]
            if other >= 0 and T.stamp[other] == stamp:
                continue
            walled = other < 0 or T.inside[other] != T.inside[t]
            if not walled and _encircles(p, T.cells[other, 0], T.cells[other, 1], T.cells[other, 2], x, y):
                if n_hollow == CAVITY:
                    return -1
                T.stamp[other] = stamp
                hollow[n_hollow] = other
                n_hollow += 1
                continue
            # By Delaunay's property the nearest node and the nearest visible wall are on the cavity's rim.
            if (
                n_rim == CAVITY
                or (p[a, 0] - x) ** 2 + (p[a, 1] - y) ** 2 < gap * gap
                or (walled and _distance2(p, a, b, x, y) < depth * depth)
                or _turn(p, a, b, x, y) <= 0
            ):
                return -1
            rim[n_rim, 0], rim[n_rim, 1], outer[n_rim] = a, b, other
            n_rim += 1
    if n_rim != n_hollow + 2:
        return -1
    return _fill(T, x, y, hollow, n_hollow, rim, outer, n_rim)


@njit(cache=True)
def _fill(T, x, y, hollow, n_hollow, rim, outer, n_rim):
    """Join the new node (x, y) to every edge of the rim; its index."""
    node, side = T.count[0], T.inside[hollow[0]]
    T.points[node, 0], T.points[node, 1] = x, y
    T.count[0] += 1
    for k in range(n_rim):
        if k < n_hollow:
            t = hollow[k]
        else:
            t = T.count[1]
            T.count[1] += 1
        a, b, other = rim[k, 0], rim[k, 1], outer[k]
        T.cells[t, 0], T.cells[t, 1], T.cells[t, 2] = node, a, b
        T.across[t, 0], T.inside[t] = other, side
        T.slot[a], T.home[a], T.home[node] = t, t, t
        if other >= 0:
            for i in range(3):
                if T.cells[other, i] != a and T.cells[other, i] != b:
                    T.across[other, i] = t
    for k in range(n_rim):
        t, following = T.slot[rim[k, 0]], T.slot[rim[k, 1]]
        T.across[t, 1], T.across[following, 2] = following, t
    T.count[3] = T.home[node]
    return node


@njit(cache=True)
def insert(T, points, sizes, parents, near, deep):
    """Insert `points` (k, 2) mm in order; the indices of the new nodes, (k,), -1 where a point was refused.

    A point is refused closer than `near * size` to a node or `deep * size` to the outline, and outside it; size 0
    asks for no room at all. The search starts at the node `parents[k]`, or where the last one ended (-1).
    """
    nodes = np.full(len(points), -1)
    hollow, rim, outer = np.empty(CAVITY, np.int64), np.empty((CAVITY, 2), np.int64), np.empty(CAVITY, np.int64)
    for k in range(len(points)):
        if T.count[0] == len(T.points):
            break
        start = T.home[parents[k]] if parents[k] >= 0 else T.count[3]
        h = sizes[k]
        nodes[k] = _insert(T, points[k, 0], points[k, 1], near * h, deep * h, start, hollow, rim, outer)
        if nodes[k] >= 0:
            T.sizes[nodes[k]] = h
    return nodes


@njit(cache=True)
def mark_inside(T, first, n):
    """Mark the cells inside the closed loop of nodes first .. first + n - 1; (n,) whether each loop edge is there.

    An edge from one loop node to the next has the inside on its left; the marks then spread to the cells between.
    """
    there = np.zeros(n, np.bool_)
    stack = np.empty(T.count[1], np.int64)
    top = 0
    T.inside[: T.count[1]] = -1
    for t in range(T.count[1]):
        for i in range(3):
            a, b = T.cells[t, (i + 1) % 3] - first, T.cells[t, (i + 2) % 3] - first
            if a < 0 or b < 0:
                continue
            if b == (a + 1) % n:
                there[a] = True
                T.inside[t] = 1
            elif a == (b + 1) % n:
                T.inside[t] = 0
        if T.inside[t] >= 0:
            stack[top] = t
            top += 1
    while top:
        top -= 1
        t = stack[top]
        for i in range(3):
            other = T.across[t, i]
            if other >= 0 and T.inside[other] < 0:
                T.inside[other] = T.inside[t]
                stack[top] = other
                top += 1
    return there


@njit(cache=True)
def holes(T, limit):
    """Centres (k, 2) mm of inside cells whose circumscribed circle is wider than `limit` times their nodes' size;
    (k,) nodes.
    """
    p = T.points
    centres, parents = np.empty((T.count[1], 2)), np.empty(T.count[1], np.int64)
    k = 0
    for t in range(T.count[1]):
        if T.inside[t] != 1:
            continue
        a, b, c = T.cells[t]
        bx, by, cx, cy = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[c, 0] - p[a, 0], p[c, 1] - p[a, 1]
        d = 2 * (bx * cy - by * cx)
        if d <= 0:
            continue
        bb, cc = bx * bx + by * by, cx * cx + cy * cy
        ux, uy = (cy * bb - by * cc) / d, (bx * cc - cx * bb) / d
        if ux * ux + uy * uy > (limit * (T.sizes[a] + T.sizes[b] + T.sizes[c]) / 3) ** 2:
            centres[k, 0], centres[k, 1], parents[k] = p[a, 0] + ux, p[a, 1] + uy, a
            k += 1
    return centres[:k], parents[:k]
