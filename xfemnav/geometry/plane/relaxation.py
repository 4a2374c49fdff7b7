"""Even out a triangulation without triangulating again: edge flips, truss forces, a search about the worst nodes.

`p` (n, 2) mm, `cells` (m, 3) counter-clockwise and `across` (m, 3), the cell opposite each corner or -1, are changed in
place, and so are the places of the first nodes, which slide on the `rail` of the outline. No step turns a cell over.
Everything is compiled by numba and bounded.
"""

import numpy as np
from numba import njit

from xfemnav.geometry.plane.rail import rail_point

FAIR = 0.8  # a star without a cell worse than this is improved in its mean, others in their worst cell
FLAT = 0.05  # a step that leaves a cell less than this fraction of its area is undone at the cell's nodes


@njit(cache=True, inline="always")
def _quality(p, a, b, c):
    """q = 2 r_in / r_out of the triangle a b c, with the sign of its area (up to the exact 0 of a flat one)."""
    abx, aby, acx, acy = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[c, 0] - p[a, 0], p[c, 1] - p[a, 1]
    bcx, bcy = acx - abx, acy - aby
    twice = abx * acy - aby * acx
    ab, ac, bc = np.sqrt(abx * abx + aby * aby), np.sqrt(acx * acx + acy * acy), np.sqrt(bcx * bcx + bcy * bcy)
    # r_in = 2A / (a + b + c), r_out = abc / 4A
    return 4 * twice * abs(twice) / ((ab + ac + bc) * ab * ac * bc)


@njit(cache=True)
def mean_quality(p, cells):
    """Mean quality of the cells."""
    total = 0.0
    for t in range(len(cells)):
        total += _quality(p, cells[t, 0], cells[t, 1], cells[t, 2])
    return total / len(cells)


@njit(cache=True)
def flip(p, cells, across):
    """Flip edges until every one is Delaunay: the two angles that face it add to no more than pi (Lawson 1977)."""
    for _ in range(50):
        n_flips = 0
        for t in range(len(cells)):
            for i in range(3):
                u = across[t, i]
                if u < t:
                    continue
                j = 0 if across[u, 0] == t else (1 if across[u, 1] == t else 2)
                a, b, c, d = cells[t, i], cells[t, (i + 1) % 3], cells[t, (i + 2) % 3], cells[u, j]
                abx, aby, acx, acy = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[c, 0] - p[a, 0], p[c, 1] - p[a, 1]
                dcx, dcy, dbx, dby = p[c, 0] - p[d, 0], p[c, 1] - p[d, 1], p[b, 0] - p[d, 0], p[b, 1] - p[d, 1]
                cross_a, dot_a = abx * acy - aby * acx, abx * acx + aby * acy
                cross_d, dot_d = dcx * dby - dcy * dbx, dcx * dbx + dcy * dby
                # sin(alpha + delta) < 0, by a margin that rounding cannot bridge, so that no edge flips to and fro
                if cross_a * dot_d + dot_a * cross_d >= -1e-9 * (cross_a * cross_d + abs(dot_a * dot_d)):
                    continue
                if _quality(p, a, b, d) <= 0 or _quality(p, a, d, c) <= 0:
                    continue
                behind_bd, behind_dc = across[u, (j + 1) % 3], across[u, (j + 2) % 3]
                behind_ca, behind_ab = across[t, (i + 1) % 3], across[t, (i + 2) % 3]
                cells[t, 0], cells[t, 1], cells[t, 2] = a, b, d
                cells[u, 0], cells[u, 1], cells[u, 2] = a, d, c
                across[t, 0], across[t, 1], across[t, 2] = behind_bd, u, behind_ab
                across[u, 0], across[u, 1], across[u, 2] = behind_dc, behind_ca, t
                for k in range(3):
                    if behind_bd >= 0 and across[behind_bd, k] == u:
                        across[behind_bd, k] = t
                    if behind_ca >= 0 and across[behind_ca, k] == t:
                        across[behind_ca, k] = u
                n_flips += 1
                break
        if n_flips == 0:
            return


@njit(cache=True)
def _step(p, move, cells, h, rail):
    """Move the nodes by `move` (n, 2) mm, at most .2 h each, those of the outline by its part along their rail.

    Nodes of cells that would become flat stay.
    """
    old, places = p.copy(), rail.places.copy()
    for a in range(len(p)):
        length = np.hypot(move[a, 0], move[a, 1])
        if length == 0 or (a < len(places) and not rail.free[a]):
            continue
        scale = min(1.0, 0.2 * h[a] / length)
        if a < len(places):
            b, c = (a + 1) % len(places), (a - 1) % len(places)
            tx, ty = old[b, 0] - old[c, 0], old[b, 1] - old[c, 1]
            rail.places[a] += scale * (move[a, 0] * tx + move[a, 1] * ty) / np.hypot(tx, ty) / h[a]
            p[a] = rail_point(rail, rail.places[a])
        else:
            p[a, 0] += scale * move[a, 0]
            p[a, 1] += scale * move[a, 1]
    undone = True
    while undone:  # each pass brings back at least one node, so there are at most n
        undone = False
        for t in range(len(cells)):
            a, b, c = cells[t]
            new = (p[b, 0] - p[a, 0]) * (p[c, 1] - p[a, 1]) - (p[b, 1] - p[a, 1]) * (p[c, 0] - p[a, 0])
            was = (old[b, 0] - old[a, 0]) * (old[c, 1] - old[a, 1]) - (old[b, 1] - old[a, 1]) * (old[c, 0] - old[a, 0])
            if new < FLAT * was:
                for k in (a, b, c):
                    if p[k, 0] != old[k, 0] or p[k, 1] != old[k, 1]:
                        p[k, 0], p[k, 1] = old[k, 0], old[k, 1]
                        if k < len(places):
                            rail.places[k] = places[k]
                        undone = True


@njit(cache=True)
def truss(p, cells, across, h, rail, n_steps):
    """Bars in compression push the nodes apart, F = max(L0 - L, 0) (Persson & Strang 2004, section 3).

    L0 is the mean wanted length `h` (n,) mm of a bar's ends, scaled to the actual lengths and by 1.12, so that the
    bars press.
    """
    move = np.empty_like(p)
    for step in range(n_steps):
        if step % 3 == 0:
            flip(p, cells, across)
        actual, wanted = 0.0, 0.0
        for t in range(len(cells)):
            for i in range(3):
                if across[t, i] < t:
                    a, b = cells[t, (i + 1) % 3], cells[t, (i + 2) % 3]
                    actual += (p[b, 0] - p[a, 0]) ** 2 + (p[b, 1] - p[a, 1]) ** 2
                    wanted += ((h[a] + h[b]) / 2) ** 2
        scale = 1.12 * np.sqrt(actual / wanted)
        move[:] = 0
        for t in range(len(cells)):
            for i in range(3):
                if across[t, i] < t:
                    a, b = cells[t, (i + 1) % 3], cells[t, (i + 2) % 3]
                    dx, dy = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1]
                    length = np.sqrt(dx * dx + dy * dy)
                    force = 0.3 * (scale * (h[a] + h[b]) / 2 - length) / length
                    if force > 0:
                        move[a, 0] -= force * dx
                        move[a, 1] -= force * dy
                        move[b, 0] += force * dx
                        move[b, 1] += force * dy
        _step(p, move, cells, h, rail)
    flip(p, cells, across)


@njit(cache=True)
def _stars(cells, n):
    """Cells about each node: `cell[first[a] : first[a + 1]]`."""
    first = np.zeros(n + 1, np.int64)
    for t in range(len(cells)):
        for i in range(3):
            first[cells[t, i] + 1] += 1
    first = np.cumsum(first)
    cell, filled = np.empty(3 * len(cells), np.int64), first[:-1].copy()
    for t in range(len(cells)):
        for i in range(3):
            a = cells[t, i]
            cell[filled[a]] = t
            filled[a] += 1
    return first, cell


@njit(cache=True)
def _star_score(p, cells, first, cell, a):
    """Score of the cells about node `a`: their mean quality; while one is below `FAIR`, its quality less 1."""
    worst, total = 1.0, 0.0
    for k in range(first[a], first[a + 1]):
        t = cell[k]
        q = _quality(p, cells[t, 0], cells[t, 1], cells[t, 2])
        worst, total = min(worst, q), total + q
    return worst - 1 if worst < FAIR else total / (first[a + 1] - first[a])


@njit(cache=True)
def lift_worst(p, cells, across, h, rail, below, rounds):
    """Raise the score of the stars that hold a cell of quality less than `below`, by pattern search on each node."""
    for _ in range(rounds):
        first, cell = _stars(cells, len(p))
        todo = np.zeros(len(p), np.bool_)
        for t in range(len(cells)):
            if _quality(p, cells[t, 0], cells[t, 1], cells[t, 2]) < below:
                for i in range(3):
                    todo[cells[t, i]] = True
        moved = False
        for a in range(len(p)):
            slides = a < len(rail.places)
            if not todo[a] or (slides and not rail.free[a]):
                continue
            best, reach = _star_score(p, cells, first, cell, a), 0.1
            x, y = p[a]
            place = rail.places[a] if slides else 0.0
            for _ in range(8):
                improved, centre = False, place
                for direction in range(2 if slides else 6):
                    if slides:
                        tried = centre + reach * (1 - 2 * direction)
                        p[a] = rail_point(rail, tried)
                    else:
                        tried, angle = 0.0, np.pi / 3 * direction
                        p[a, 0], p[a, 1] = x + reach * h[a] * np.cos(angle), y + reach * h[a] * np.sin(angle)
                    q = _star_score(p, cells, first, cell, a)
                    if q > best + 1e-3:
                        best, improved, place = q, True, tried
                        x, y = p[a]
                p[a, 0], p[a, 1] = x, y
                if improved:
                    moved = True
                else:
                    reach /= 2
                    if reach < 0.004:
                        break
            if slides:
                rail.places[a] = place
        if not moved:
            return
        flip(p, cells, across)
