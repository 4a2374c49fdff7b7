"""Stars of the nodes of a mesh of tetrahedra, and nodes moved until the worst cell of their star is fair."""

import numpy as np
from numba import njit

from xfemnav.geometry.solid.field import level, slope

FAIR = 0.6  # a star whose worst cell is better stays as it is
SWEEPS = 8
STEP = 0.3  # of a node's element size: the first step that is tried; halved HALVINGS times
HALVINGS = 5
GAIN = 1e-4  # of the quality: a smaller one is none
ON_SURFACE = 1e-4  # mm that a node on the surface may be off it
POOR, OFF = 0.48, 0.6  # in a gap thinner than a cell a star stays worse: nodes may be off by this share of a cell


def stars(cells, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Cells about each of n nodes: those of node v are `cell[start[v] : start[v + 1]]`."""
    start = np.concatenate([[0], np.cumsum(np.bincount(cells.ravel(), minlength=n))])
    return start, _stars(cells, start)


@njit(cache=True)
def _stars(cells, start):
    free, cell = start[:-1].copy(), np.empty(start[-1], np.int64)
    for c in range(len(cells)):
        for v in cells[c]:
            cell[free[v]] = c
            free[v] += 1
    return cell


@njit(cache=True)
def _quality(p, t):
    """6 sqrt(2) volume over the cube of the root mean square edge, 1 for a regular tetrahedron, with its sign."""
    a, b, c, d = p[t[0]], p[t[1]], p[t[2]], p[t[3]]
    a0, a1, a2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    b0, b1, b2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    c0, c1, c2 = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    six = a0 * (b1 * c2 - b2 * c1) - a1 * (b0 * c2 - b2 * c0) + a2 * (b0 * c1 - b1 * c0)
    # The six squares: |a|^2 + |b|^2 + |c|^2 + |a - b|^2 + |a - c|^2 + |b - c|^2 = 4 sum of squares - |a + b + c|^2
    s0, s1, s2 = a0 + b0 + c0, a1 + b1 + c1, a2 + b2 + c2
    squares = 4 * (a0 * a0 + a1 * a1 + a2 * a2 + b0 * b0 + b1 * b1 + b2 * b2 + c0 * c0 + c1 * c1 + c2 * c2) \
        - (s0 * s0 + s1 * s1 + s2 * s2)
    return np.sqrt(2.0) * six / (squares / 6) ** 1.5


@njit(cache=True)
def _onto_surface(field, x, gradient):
    """Move x (3,) along the gradient to the zero of the field; whether it got there."""
    for _ in range(6):
        value = level(field, x)
        if abs(value) < ON_SURFACE:
            return True
        slope(field, x, gradient)
        steep = gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2
        if steep < 1e-2:
            return False
        for i in range(3):
            x[i] -= value / steep * gradient[i]
    return False


@njit(cache=True)
def _directions():
    """The 14 unit vectors (14, 3) to the faces and corners of a cube."""
    found, n = np.empty((14, 3)), 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                squares = i * i + j * j + k * k
                if squares % 2 == 1:
                    found[n] = np.array([i, j, k]) / np.sqrt(squares)
                    n += 1
    return found


@njit(cache=True)
def _worst(p, cells, around, limit):
    """The worst quality of the cells `around`, or any that is no better than the limit."""
    worst = 2.0
    for c in around:
        worst = min(worst, _quality(p, cells[c]))
        if worst <= limit:
            break
    return worst


@njit(cache=True)
def _improved(p, v, worst, cells, around, reach, held, field, room):
    """Move node v where the worst quality of the cells `around` it is better, as far as steps of `reach` mm and less
    lead; that quality. On the surface a node is `held` (1: on it, 2: near it, 0: not at all)."""
    directions, old, gradient = room
    halvings = k = 0
    step = STEP * reach
    while halvings < HALVINGS:
        old[:] = p[v]
        p[v] += step * directions[k]
        k += 1
        if held == 0 or (_onto_surface(field, p[v], gradient) if held == 1 else abs(level(field, p[v])) < OFF * reach):
            found = _worst(p, cells, around, worst + GAIN)
            if found > worst + GAIN:
                worst, k = found, 0  # once more with the same step
                old[:] = p[v]
        p[v] = old
        if k == len(directions):
            k, halvings, step = 0, halvings + 1, step / 2
    return worst


@njit(cache=True)
def smooth(p, cells, start, star, on_surface, reach, field):
    """Move nodes p (n, 3) mm in place, one at a time, where that makes the worst cell of their star better.

    Nodes `on_surface` (n,) stay on the zero of the field's `Samples`, and near it where stars stay POOR; steps are
    shares of `reach` (n,) mm.
    """
    quality, room = np.empty(len(cells)), (_directions(), np.empty(3), np.empty(3))
    for c in range(len(cells)):
        quality[c] = _quality(p, cells[c])
    for held, least in ((1, FAIR), (2, POOR)):
        for _ in range(SWEEPS):
            moved = False
            for v in range(len(p)):
                around = star[start[v]:start[v + 1]]
                worst = 2.0
                for c in around:
                    worst = min(worst, quality[c])
                if worst < least and _improved(p, v, worst, cells, around, reach[v], held * on_surface[v], field,
                                               room) > worst:
                    moved = True
                    for c in around:
                        quality[c] = _quality(p, cells[c])
            if not moved:
                break


@njit(cache=True)
def shift(p, cells, start, star, nodes, steps):
    """Move `nodes` (k,) of p (n, 3) mm by `steps` (k, 3) in place, one at a time, where no cell of their star is then
    worse than FAIR, or than the worst that it had."""
    for k in range(len(nodes)):
        v = nodes[k]
        around = star[start[v]:start[v + 1]]
        worst = _worst(p, cells, around, -2.0)
        p[v] += steps[k]
        if _worst(p, cells, around, -2.0) < min(worst, FAIR):
            p[v] -= steps[k]
