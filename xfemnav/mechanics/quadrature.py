"""Quadrature on triangles, adapted to the r^(-1/2) strains at a tip."""

from functools import cache

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array, orient

#: A triangle is subdivided until it is no larger than this times its distance to the nearest tip.
NEAR = 1.0
NEEDLE = 0.3  # a triangle with less area than this, times half its longest edge squared, is a needle
DEEPEST, MOST = 200, 100_000  # most times that triangles are divided, and most triangles left to divide
ANGLE = np.pi / 3  # largest angle of a triangle at a tip; wider ones are bisected
LOPSIDED = 4.0  # largest ratio of its two edges at the tip; beyond, the radius varies too fast along the far edge


@cache
def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points (n,) in -1..1 and their weights."""
    points, weights = np.polynomial.legendre.leggauss(n)
    return frozen_array(points, float, (n,), "points"), frozen_array(weights, float, (n,), "weights")


@cache
def _unit_square(n_radial, n_angular):
    """Gauss points and weights of the unit square."""
    (s, ws), (t, wt) = gauss(n_radial), gauss(n_angular)
    s, t = (s + 1) / 2, (t + 1) / 2
    return np.repeat(s, n_angular), np.tile(t, n_radial), np.outer(ws, wt).ravel() / 4


def collapsed_rule(corners, n) -> tuple[np.ndarray, np.ndarray]:
    """Points (k, n*n, 2) and weights (k, n*n) of Gauss's rule collapsed to the first corner; exact to degree 2n - 2."""
    s, t, w = _unit_square(n, n)
    return _from_apex(corners, s, t, w * s)


def polar_rule(corners, n_radial=6, n_angular=10) -> tuple[np.ndarray, np.ndarray]:
    """The same with the first corner at a tip, radius = s^2: products of branch functions become polynomials in s."""
    s, t, w = _unit_square(n_radial, n_angular)
    return _from_apex(corners, s**2, t, w * 2 * s**3)


def _from_apex(corners, rho, eta, w):
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
    corners = np.asarray(corners, dtype=float)
    owner = np.arange(len(corners))
    more = 4 if fine else 0
    points, weights, owners = [], [], []

    def emit(rule, chosen, *size):
        x, w = rule(corners[chosen], *size)
        points.append(x.reshape(-1, 2))
        weights.append(w.ravel())
        owners.append(np.repeat(owner[chosen], w.shape[1]))

    for _ in range(DEEPEST):
        if not len(corners):
            break
        edge = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
        diameter = edge.max(axis=1)
        at_tip = np.linalg.norm(corners[:, :, None] - tips, axis=3).min(axis=2) <= 1e-9 * diameter[:, None]
        n_tips = at_tip.sum(axis=1)
        # Turn each triangle so that its tip is first.
        turn = (np.argmax(at_tip, axis=1)[:, None] + np.arange(3)) % 3
        corners = np.take_along_axis(corners, turn[:, :, None], axis=1)
        a, b, c = corners.swapaxes(0, 1)
        angle = np.arctan2(orient(a, b, c), np.einsum("ki,ki->k", b - a, c - a))
        ratio = diameter / np.maximum(_distance(corners, tips), 1e-300)
        leg = np.linalg.norm(np.stack([b - a, c - a]), axis=2)
        sharp = (n_tips == 1) & (angle <= ANGLE) & (leg.max(axis=0) <= LOPSIDED * leg.min(axis=0))
        emit(polar_rule, sharp, 6 + more, 10 + more)
        done = sharp.copy()
        for limit, n in ((0.1, 3), (0.3, 4), (NEAR, 6)):
            smooth = (n_tips == 0) & (ratio <= limit) & ~done
            emit(collapsed_rule, smooth, n + more)
            done |= smooth
        corners, owner, n_tips = corners[~done], owner[~done], n_tips[~done]
        corners, owner = _split(corners, owner, n_tips)
        if len(corners) > MOST:
            break
    if len(corners):
        where = corners[0].mean(axis=0)
        raise XfemnavError(
            "E407",
            f"integration about the tip near ({where[0]:.3f}, {where[1]:.3f}) mm did not end; move the tip a little, "
            "and please report this with the cut's points.",
        )
    return np.concatenate(points), np.concatenate(weights), np.concatenate(owners)


def _distance(corners, tips):
    """Distance (k,) from each triangle to the nearest tip outside it."""
    a, b = corners, corners[:, [1, 2, 0]]
    along = b - a
    t = np.einsum("kemi,kei->kem", tips - a[:, :, None], along) / np.einsum("kei,kei->ke", along, along)[:, :, None]
    foot = a[:, :, None] + np.clip(t, 0, 1)[..., None] * along[:, :, None]
    return np.linalg.norm(foot - tips, axis=3).min(axis=(1, 2))


def _split(corners, owner, n_tips):
    """Bisect triangles with a tip (opposite the wide angle, or between two tips); halve needles, quarter the others."""
    a, b, c = corners[n_tips > 0].swapaxes(0, 1)
    two = n_tips[n_tips > 0] > 1
    # With several tips the longest edge is halved, else the edge opposite the tip at the angle's bisector.
    lb, lc = np.linalg.norm(b - a, axis=1)[:, None], np.linalg.norm(c - a, axis=1)[:, None]
    bisector = (b * lc + c * lb) / (lb + lc)
    one, other = [np.stack([a, b, bisector], 1)[~two]], [np.stack([a, bisector, c], 1)[~two]]
    if two.any():
        a, b, c = _longest_first(np.stack([a, b, c], 1)[two]).swapaxes(0, 1)
        one.append(np.stack([a, (a + b) / 2, c], 1))
        other.append(np.stack([(a + b) / 2, b, c], 1))
    order = np.concatenate([owner[n_tips > 0][~two], owner[n_tips > 0][two]])
    # A quarter of a needle is a needle; halves of its length lie ever farther from the tip.
    away = _longest_first(corners[n_tips == 0])
    a, b, c = away.swapaxes(0, 1)
    needle = orient(a, b, c) < NEEDLE * np.einsum("ki,ki->k", b - a, b - a)
    own = owner[n_tips == 0]
    a, b, c = away[needle].swapaxes(0, 1)
    halves = [np.stack([a, (a + b) / 2, c], 1), np.stack([(a + b) / 2, b, c], 1)]
    a, b, c = away[~needle].swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = [np.stack(x, 1) for x in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    owners = [order, order, own[needle], own[needle], np.tile(own[~needle], 4)]
    return np.concatenate([*one, *other, *halves, *quarters]), np.concatenate(owners)


def _longest_first(corners):
    edge = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
    turn = (np.argmax(edge, axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(corners, turn[:, :, None], axis=1)
