"""Quadrature on simplices, and on triangles adapted to the r^(-1/2) strains at a tip."""

from functools import cache

import numpy as np
from numba import njit

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array, orient

#: A triangle is subdivided until it is no larger than this times its distance to the nearest tip.
NEAR = 1.0
NEEDLE = 0.3  # a triangle with less area than this, times half its longest edge squared, is a needle
DEEPEST, MOST = 200, 100_000  # most times that a triangle is divided, and most pieces of one
SMOOTH = ((0.1, 3), (0.3, 4), (NEAR, 6))  # up to this ratio of size to distance, the collapsed rule of so many points
ANGLE = np.pi / 3  # largest angle of a triangle at a tip; wider ones are bisected
LOPSIDED = 4.0  # largest ratio of its two edges at the tip; beyond, the radius varies too fast along the far edge


@cache
def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points (n,) in -1..1 and their weights."""
    points, weights = np.polynomial.legendre.leggauss(n)
    return frozen_array(points, float, (n,), "points"), frozen_array(weights, float, (n,), "weights")


def simplex_rule(corners, degree: int) -> np.ndarray:
    """Points (s, q, k) mm in simplices (s, n + 1, k) mm, of equal weight, whose mean is exact up to `degree` 1 or 2."""
    n = corners.shape[1] - 1
    if degree == 1:
        return corners.mean(axis=1, keepdims=True)
    near = (1 - 1 / np.sqrt(n + 2)) / (n + 1)  # Stroud (1971)
    return (near * np.ones((n + 1, n + 1)) + (1 - (n + 1) * near) * np.eye(n + 1)) @ corners


@cache
def gauss_in_simplex(dim: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Shares (n^dim, dim + 1) of a simplex's corners and weights (n^dim,), of sum 1: Gauss's rule, collapsed."""
    t, w = gauss(n)
    u, weights = ((t + 1) / 2,) * dim, np.ones(1)
    for i in range(dim):
        weights = np.multiply.outer(weights, w / 2 * (dim - i) * u[i] ** (dim - 1 - i)).ravel()
    u = np.stack(np.meshgrid(*u, indexing="ij"), axis=-1).reshape(-1, dim)
    ahead = np.cumprod(np.hstack([np.ones((len(u), 1)), u]), axis=1)  # what is left for the corners from i on
    return ahead - np.hstack([ahead[:, 1:], np.zeros((len(u), 1))]), weights


@cache
def _unit_square(n_radial, n_angular):
    """Gauss points and weights of the unit square."""
    (s, ws), (t, wt) = gauss(n_radial), gauss(n_angular)
    s, t = (s + 1) / 2, (t + 1) / 2
    return np.repeat(s, n_angular), np.tile(t, n_radial), np.outer(ws, wt).ravel() / 4


def _collapsed(n):
    s, t, w = _unit_square(n, n)
    return s, t, w * s


def _polar(n_radial, n_angular):
    s, t, w = _unit_square(n_radial, n_angular)
    return s**2, t, w * 2 * s**3


def collapsed_rule(corners, n) -> tuple[np.ndarray, np.ndarray]:
    """Points (k, n*n, 2) and weights (k, n*n) of Gauss's rule collapsed to the first corner; exact to degree 2n - 2."""
    rho, eta, w = _collapsed(n)
    a, b, c = corners.swapaxes(0, 1)
    outer = (1 - eta)[None, :, None] * (b - a)[:, None] + eta[None, :, None] * (c - a)[:, None]
    return a[:, None] + rho[None, :, None] * outer, w[None] * orient(a, b, c)[:, None]


def tip_rule(corners, tips, fine: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quadrature of functions that behave as sqrt(r) and r^(-1/2) near the tips.

    Parameters
    ----------
    corners : (k, 3, 2) mm triangles; a tip may be a corner but not lie elsewhere on or in a triangle.
    tips : (m, 2) mm.
    fine : use more points, to measure the error of the usual rule.

    Returns
    -------
    points (q, 2) mm, weights (q,) mm^2, and the triangle (q,) that each belongs to.
    """
    points, weights, owner, stuck = _graded(
        np.ascontiguousarray(corners, float), np.asarray(tips, float), *_rules(4 if fine else 0)
    )
    if np.isfinite(stuck).all():
        raise XfemnavError(
            "E407",
            f"integration about the tip near ({stuck[0]:.3f}, {stuck[1]:.3f}) mm did not end; move the tip a little, "
            "and please report this with the cut's points.",
        )
    return points, weights, owner


@cache
def _rules(more):
    """The polar rule and the collapsed ones, one after the other: where each begins, radii and far coordinates in 0..1,
    weights; `more` points than usual a direction. And the ratio of size to distance up to which each will do."""
    rules = [_polar(6 + more, 10 + more), *(_collapsed(n + more) for _, n in SMOOTH)]
    start = np.cumsum([0, *(len(rule[0]) for rule in rules)])
    return start, *(np.concatenate(column) for column in zip(*rules)), np.array([0.0, *(limit for limit, _ in SMOOTH)])


@njit(cache=True)
def _graded(corners, tips, start, rho, eta, weight, limit):
    """Points, weights and owners of the pieces of triangles; and a place where dividing does not end, or NaN."""
    leaves, kinds, owners = np.empty((0, 3, 2)), np.empty(0, np.int64), np.empty(0, np.int64)
    n, stuck = _divide(corners, tips, limit, leaves, kinds, owners)
    leaves, kinds, owners = np.empty((n, 3, 2)), np.empty(n, np.int64), np.empty(n, np.int64)
    _divide(corners, tips, limit, leaves, kinds, owners)
    total = 0
    for i in range(n):
        total += start[kinds[i] + 1] - start[kinds[i]]
    points, weights, owner = np.empty((total, 2)), np.empty(total), np.empty(total, np.int64)
    q = 0
    for i in range(n):
        a, b, c = leaves[i]
        turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        for r in range(start[kinds[i]], start[kinds[i] + 1]):
            for j in range(2):
                points[q, j] = a[j] + rho[r] * ((1 - eta[r]) * (b[j] - a[j]) + eta[r] * (c[j] - a[j]))
            weights[q], owner[q] = weight[r] * turn, owners[i]
            q += 1
    return points, weights, owner, stuck


@njit(cache=True)
def _divide(corners, tips, limit, leaves, kinds, owners):
    """Divide each triangle until its pieces have a rule. Their number, and a place where it does not end, or NaN.

    Triangles with a tip are bisected, opposite the tip at its angle's bisector, or between two tips; of the others
    needles are halved, as a quarter of a needle is a needle and halves of its length lie ever farther from the tip, and
    the rest are quartered. Fills as many `leaves` (k, 3, 2), their rules and owners, as there is room for.
    """
    stack, depth, edge = np.empty((4 * DEEPEST, 6)), np.empty(4 * DEEPEST, np.int64), np.empty(3)
    n = 0
    for k in range(len(corners)):
        top, seen = _push(stack, depth, 0, 0, corners[k, 0], corners[k, 1], corners[k, 2]), 0
        while top > 0:
            top -= 1
            x, deep = stack[top].copy().reshape(3, 2), depth[top]
            seen += 1
            if deep == DEEPEST or seen > MOST:
                return 0, ((x[0, 0] + x[1, 0] + x[2, 0]) / 3, (x[0, 1] + x[1, 1] + x[2, 1]) / 3)
            for a in range(3):
                edge[a] = np.hypot(x[(a + 1) % 3, 0] - x[a, 0], x[(a + 1) % 3, 1] - x[a, 1])
            size, n_tips, apex = max(edge[0], edge[1], edge[2]), 0, 0
            for a in range(2, -1, -1):
                for t in range(len(tips)):
                    if np.hypot(x[a, 0] - tips[t, 0], x[a, 1] - tips[t, 1]) <= 1e-9 * size:
                        n_tips, apex = n_tips + 1, a
                        break
            if n_tips != 1:
                apex = 0 if edge[0] == size else 1 if edge[1] == size else 2
            a, b, c = _point(x, apex), _point(x, (apex + 1) % 3), _point(x, (apex + 2) % 3)
            one, two = edge[apex], edge[(apex + 2) % 3]
            turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            kind = -1
            if n_tips == 1:
                angle = np.arctan2(turn, (b[0] - a[0]) * (c[0] - a[0]) + (b[1] - a[1]) * (c[1] - a[1]))
                if angle <= ANGLE and max(one, two) <= LOPSIDED * min(one, two):
                    kind = 0
            elif n_tips == 0:
                ratio = size / max(_distance(x, tips), 1e-300)
                for r in range(len(limit) - 1, 0, -1):
                    if ratio <= limit[r]:
                        kind = r
            if kind >= 0:
                if n < len(leaves):
                    for i in range(3):
                        # The polar rule begins at the tip, the others where the triangle does.
                        from_corner = (apex + i) % 3 if kind == 0 else i
                        leaves[n, i, 0], leaves[n, i, 1] = x[from_corner, 0], x[from_corner, 1]
                    kinds[n], owners[n] = kind, k
                n += 1
            elif n_tips == 1:
                far = _between(b, c, one / (one + two))
                top = _push(stack, depth, top, deep + 1, a, b, far)
                top = _push(stack, depth, top, deep + 1, a, far, c)
            elif n_tips > 1 or turn < NEEDLE * size**2:
                ab = _between(a, b, 0.5)
                top = _push(stack, depth, top, deep + 1, a, ab, c)
                top = _push(stack, depth, top, deep + 1, ab, b, c)
            else:
                ab, bc, ca = _between(a, b, 0.5), _between(b, c, 0.5), _between(c, a, 0.5)
                top = _push(stack, depth, top, deep + 1, a, ab, ca)
                top = _push(stack, depth, top, deep + 1, ab, b, bc)
                top = _push(stack, depth, top, deep + 1, ca, bc, c)
                top = _push(stack, depth, top, deep + 1, ab, bc, ca)
    return n, (np.nan, np.nan)


@njit(cache=True)
def _point(x, a):
    return x[a, 0], x[a, 1]


@njit(cache=True)
def _between(a, b, t):
    return (1 - t) * a[0] + t * b[0], (1 - t) * a[1] + t * b[1]


@njit(cache=True)
def _push(stack, depth, top, deep, a, b, c):
    for j in range(2):
        stack[top, j], stack[top, 2 + j], stack[top, 4 + j] = a[j], b[j], c[j]
    depth[top] = deep
    return top + 1


@njit(cache=True)
def _distance(x, tips):
    """Distance from a triangle to the nearest tip outside it."""
    nearest = np.inf
    for a in range(3):
        b = (a + 1) % 3
        u, v = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1]
        for k in range(len(tips)):
            p, q = tips[k, 0] - x[a, 0], tips[k, 1] - x[a, 1]
            t = min(max((p * u + q * v) / max(u * u + v * v, 1e-300), 0.0), 1.0)
            nearest = min(nearest, np.hypot(p - t * u, q - t * v))
    return nearest
