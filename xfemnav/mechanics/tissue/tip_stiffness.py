"""Stiffness of the parts about a tip, where the strains of branch functions are integrated point by point.

The gradients g of all functions of a part at its quadrature points make the moments M = sum_q w g g'; Lame's constants
enter once a part: K_(a i)(b j) = lam M_(a i)(b j) + mu (M_(a j)(b i) + M_(a k)(b k) where i = j).
"""

import numpy as np
from numba import njit

from xfemnav.mechanics.space.space import Space


def tip_blocks(space: Space, points, weights, parts, lam, mu) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness blocks (k, 2 f, 2 f) kPa and their basis functions (k, f), -1 beyond a part's own, for the k parts with
    branch functions among `parts` (q,), which the quadrature points (q, 2) mm with weights (q,) mm^2 lie in.

    lam, mu (p,) kPa: Lame's constants of the plane in every part.
    """
    table, split = space.enrichment, space.parts
    order = np.argsort(parts, kind="stable")
    own, start = np.unique(parts[order], return_index=True)
    start = np.append(start, len(order))
    first = np.searchsorted(table.entry_part, [own, own + 1])
    entry = np.concatenate([np.arange(a, b) for a, b in first.T])
    count = first[1] - first[0]
    row = table.entry_row[entry]
    tip = table.tip[row]
    cell = split.cell[own]
    most = 3 + 4 * int(count.max(initial=0))
    g = np.zeros((len(order), 2 * most))
    _weighted_gradients(
        np.ascontiguousarray(points[order]), weights[order], start,
        space.mesh.gradients[cell], space.mesh.points[space.mesh.cells[cell, 0]],
        np.concatenate([[0], np.cumsum(count)]), table.entry_node[entry], table.entry_angle[entry],
        table.entry_ramp[entry], tip, split.fronts.at, split.fronts.travel, table.shift[row[:, None] + np.arange(4)], g,
    )
    M = np.array([each.T @ each for each in np.split(g, start[1:-1])]).reshape(-1, most, 2, most, 2)
    K = lam[own, None, None, None, None] * M
    both = mu[own, None, None, None, None] * M
    K += both.swapaxes(2, 4)
    for i in (0, 1):
        K[:, :, i, :, i] += both[:, :, 0, :, 0] + both[:, :, 1, :, 1]
    K = K.reshape(len(own), 2 * most, 2 * most)
    rows = np.full((len(own), most), -1)
    rows[:, :3] = table.dof[own]
    at = 3 + 4 * (np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count))
    rows[np.repeat(np.arange(len(own)), count)[:, None], at[:, None] + np.arange(4)] = row[:, None] + np.arange(4)
    return (K + K.swapaxes(1, 2)) / 2, rows


@njit(cache=True)
def _weighted_gradients(
    points, weights, start, hat_gradient, corner, first, node, angle, ramp, tip, tips, travels, shift, g
):
    """Fill g (q, 2 f): sqrt(w) times the derivative of function a along axis k at 2 a + k."""
    hats, f, ahead, left = np.empty(3), np.empty(4), np.empty(4), np.empty(4)
    for c in range(len(start) - 1):
        for q in range(start[c], start[c + 1]):
            root_w = np.sqrt(weights[q])
            for a in range(3):
                hats[a] = 1.0 if a == 0 else 0.0
                for k in range(2):
                    hats[a] += hat_gradient[c, a, k] * (points[q, k] - corner[c, k])
                    g[q, 2 * a + k] = root_w * hat_gradient[c, a, k]
            at = 6
            for e in range(first[c], first[c + 1]):
                tx, ty = travels[tip[e]]
                if e == first[c] or tip[e] != tip[e - 1]:
                    x, y = points[q, 0] - tips[tip[e], 0], points[q, 1] - tips[tip[e], 1]
                    along, across = x * tx + y * ty, tx * y - ty * x
                    r = max(np.hypot(along, across), 1e-300)
                    raw = np.arctan2(across, along)
                    theta = angle[e] + (raw - angle[e] + np.pi) % (2 * np.pi) - np.pi
                    root = np.sqrt(r)
                    s, co = np.sin(theta / 2), np.cos(theta / 2)
                    sin, cos = 2 * s * co, co**2 - s**2
                    f[0], f[1], f[2], f[3] = s, co, s * sin, co * sin
                    by_theta = co / 2, -s / 2, co * sin / 2 + s * cos, -s * sin / 2 + co * cos
                    for m in range(4):
                        ahead[m] = (cos * f[m] / 2 - sin * by_theta[m]) / root
                        left[m] = (sin * f[m] / 2 + cos * by_theta[m]) / root
                weight, wx, wy = 0.0, 0.0, 0.0
                for a in range(3):
                    weight += ramp[e, a] * hats[a]
                    wx += ramp[e, a] * hat_gradient[c, a, 0]
                    wy += ramp[e, a] * hat_gradient[c, a, 1]
                i = node[e]
                wx, wy = hats[i] * wx + hat_gradient[c, i, 0] * weight, hats[i] * wy + hat_gradient[c, i, 1] * weight
                weight *= hats[i]
                for m in range(4):
                    value = root * f[m] - shift[e, m]
                    g[q, at] = root_w * (weight * (ahead[m] * tx - left[m] * ty) + value * wx)
                    g[q, at + 1] = root_w * (weight * (ahead[m] * ty + left[m] * tx) + value * wy)
                    at += 2
