"""Stiffness of the parts about a tip, where the strains of branch functions are integrated point by point.

At each quadrature point the gradients g of all functions of the part make the moments M += w g g'; the material enters
once a part: K_(a i)(b j) = sum_kl C_ikjl M_(a k)(b l), C the stiffness as a tensor.
"""

import numpy as np
from numba import njit

from xfemnav.mechanics.space import Space

#: Row of the strain (xx, yy, 2 xy) that the derivative of component i along axis k is in.
VOIGT = np.array([[0, 2], [2, 1]])


def tip_blocks(space: Space, points, weights, parts, material) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness blocks (k, 2 f, 2 f) kPa and their basis functions (k, f), -1 beyond a part's own, for the k parts with
    branch functions among `parts` (q,), which the quadrature points (q, 2) mm with weights (q,) mm^2 lie in.
    """
    table, sub = space.enrichment, space.subcells
    order = np.argsort(parts, kind="stable")
    own, start = np.unique(parts[order], return_index=True)
    start = np.append(start, len(order))
    first = np.searchsorted(table.entry_part, [own, own + 1])
    entry = np.concatenate([np.arange(a, b) for a, b in first.T])
    count = first[1] - first[0]
    row = table.entry_row[entry]
    tip = table.tip[row]
    cell = sub.part_cell[own]
    most = 3 + 4 * int(count.max(initial=0))
    M = np.zeros((len(own), 2 * most, 2 * most))
    _moments(
        np.ascontiguousarray(points[order]), weights[order], start,
        space.mesh.gradients[cell], space.mesh.points[space.mesh.cells[cell, 0]],
        np.concatenate([[0], np.cumsum(count)]), table.entry_node[entry], table.entry_angle[entry],
        table.entry_ramp[entry], sub.tips[tip], sub.tip_travel[tip], table.shift[row[:, None] + np.arange(4)], M,
    )
    C = material.stiffness_in(cell)[:, VOIGT][..., VOIGT]
    K = np.einsum("cakbl,cikjl->caibj", M.reshape(len(own), most, 2, most, 2), C, optimize=True)
    K = K.reshape(len(own), 2 * most, 2 * most)
    rows = np.full((len(own), most), -1)
    rows[:, :3] = table.dof[own]
    at = 3 + 4 * (np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count))
    rows[np.repeat(np.arange(len(own)), count)[:, None], at[:, None] + np.arange(4)] = row[:, None] + np.arange(4)
    return (K + K.swapaxes(1, 2)) / 2, rows


@njit(cache=True)
def _moments(points, weights, start, hat_gradient, corner, first, node, angle, ramp, tip, travel, shift, M):
    """Add w g g' at all points to M (k, 2 f, 2 f); entry 2 a + k of g is the derivative of function a along k."""
    g = np.empty(M.shape[1])
    hats, f, by_r, by_theta = np.empty(3), np.empty(4), np.empty(4), np.empty(4)
    for c in range(len(start) - 1):
        n = 2 * (3 + 4 * (first[c + 1] - first[c]))
        for q in range(start[c], start[c + 1]):
            for a in range(3):
                hats[a] = 1.0 if a == 0 else 0.0
                for k in range(2):
                    hats[a] += hat_gradient[c, a, k] * (points[q, k] - corner[c, k])
                    g[2 * a + k] = hat_gradient[c, a, k]
            at = 6
            for e in range(first[c], first[c + 1]):
                x, y = points[q, 0] - tip[e, 0], points[q, 1] - tip[e, 1]
                tx, ty = travel[e]
                along, across = x * tx + y * ty, tx * y - ty * x
                r = max(np.hypot(along, across), 1e-300)
                raw = np.arctan2(across, along)
                theta = angle[e] + (raw - angle[e] + np.pi) % (2 * np.pi) - np.pi
                root = np.sqrt(r)
                s, co, sin, cos = np.sin(theta / 2), np.cos(theta / 2), np.sin(theta), np.cos(theta)
                f[0], f[1], f[2], f[3] = s, co, s * sin, co * sin
                by_theta[0], by_theta[1] = co / 2, -s / 2
                by_theta[2], by_theta[3] = co * sin / 2 + s * cos, -s * sin / 2 + co * cos
                weight, wx, wy = 0.0, 0.0, 0.0
                for a in range(3):
                    weight += ramp[e, a] * hats[a]
                    wx += ramp[e, a] * hat_gradient[c, a, 0]
                    wy += ramp[e, a] * hat_gradient[c, a, 1]
                i = node[e]
                wx, wy = hats[i] * wx + hat_gradient[c, i, 0] * weight, hats[i] * wy + hat_gradient[c, i, 1] * weight
                weight *= hats[i]
                for m in range(4):
                    by_r[m] = f[m] / 2
                    ahead = (cos * by_r[m] - sin * by_theta[m]) / root
                    left = (sin * by_r[m] + cos * by_theta[m]) / root
                    value = root * f[m] - shift[e, m]
                    g[at] = weight * (ahead * tx - left * ty) + value * wx
                    g[at + 1] = weight * (ahead * ty + left * tx) + value * wy
                    at += 2
            for a in range(n):
                wa = weights[q] * g[a]
                for b in range(a + 1):
                    M[c, a, b] += wa * g[b]
        for a in range(n):
            for b in range(a):
                M[c, b, a] = M[c, a, b]
