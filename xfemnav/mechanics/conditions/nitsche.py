"""Nitsche's condition on a lip: consistent traction terms and a penalty, without multipliers.

On the held lip, with m the outward normal and t(u) = s(u) m, the weak form gains
- integral t(u).v - integral t(v).(u - given) + integral beta (u - given).v.
beta = gamma M (length or area of the part that is held) / (volume of the part), uncapped, with M the P-wave modulus and
gamma > 1, keeps the form positive on every part with constant strains, slivers included. Two kinds of parts carry only
the penalty 2 M / h: those under a fifth of their cell, whose traction says little and whose weight would spoil the
conditioning, and those with branch functions, whose strains at the lip no such bound limits.
"""

import numpy as np
from scipy.sparse import csr_array

from xfemnav.mechanics.conditions.constraints import each_component
from xfemnav.mechanics.conditions.lips import LipQuadrature, lip_quadrature
from xfemnav.mechanics.rules import Retraction
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, Tissue

GAMMA = 2.0
SMALL_PART = 0.2


def nitsche_terms(
    space: Space, material: Material | Tissue, retraction: Retraction, span
) -> tuple[csr_array, np.ndarray]:
    """Stiffness (n_dof, n_dof) kPa and load (n_dof,) mN per mm of the condition u = given on a held lip."""
    B, t, beta, weights, given = _lip_operators(space, material, retraction, span)
    w = np.repeat(weights, len(given) // len(weights))
    K = B.T @ B.multiply((beta * w)[:, None]).tocsr() - B.T @ t.multiply(w[:, None]).tocsr()
    K = csr_array(K - t.T @ B.multiply(w[:, None]).tocsr())
    return K, B.T @ (beta * w * given) - t.T @ (w * given)


def nitsche_load(space: Space, material: Material | Tissue, retraction: Retraction, span, U) -> np.ndarray:
    """Load (n_dof,) mN per mm by which the condition also asks for the displacements of the coefficients U (n_dof,)."""
    B, t, beta, weights, _ = _lip_operators(space, material, retraction, span)
    w, given = np.repeat(weights, B.shape[0] // len(weights)), B @ U
    return B.T @ (beta * w * given) - t.T @ (w * given)


def nitsche_traction(
    space: Space, material: Material | Tissue, retraction: Retraction, span, U, under=None
) -> tuple[LipQuadrature, np.ndarray]:
    """Gauss points of the lip and the traction (q, 2) kPa of the retractor there: t(u) - beta (u - given).

    under (n_dof,): coefficients of the displacements from which the given ones count; None: from rest.
    """
    B, t, beta, weights, given = _lip_operators(space, material, retraction, span)
    u = np.asarray(U).ravel()
    traction = t @ u - beta * (B @ u - given - (0 if under is None else B @ under))
    return lip_quadrature(space, retraction.cut, retraction.side, span), traction.reshape(len(weights), -1)


def _lip_operators(space, material, retraction, span):
    """At Gauss points of the lip, components interleaved: B, tractions t (d q, n_dof), beta, given; weights (q,)."""
    q = lip_quadrature(space, retraction.cut, retraction.side, span)
    d = q.points.shape[1]
    volume = np.bincount(space.parts.part, space.parts.volumes, space.parts.n_parts)
    held = np.bincount(q.parts, q.weights, space.parts.n_parts)
    cell = space.parts.cell[q.parts]
    mu, lam = material.moduli_in(cell)
    alone = (volume[q.parts] < SMALL_PART * space.mesh.volumes[cell]) | np.isin(q.parts, space.branch_parts)
    beta = np.where(alone, 2 / space.mesh.sizes[cell], GAMMA * held[q.parts] / volume[q.parts]) * (lam + 2 * mu)
    t = _tractions(space, q, -retraction.side * q.normals * ~alone[:, None], mu, lam)  # none beside a lone penalty
    given = retraction.displacement(q.normals)
    return each_component(space.basis_in(q.points, q.parts), d), t, np.repeat(beta, d), q.weights, given.ravel()


def _tractions(space, q, m, mu, lam):
    """Matrix (d q, n_dof) kPa of the tractions s m on outward normals m (q, d).

    The function with gradient g, along axis k, has t_i = lam m_i g_k + mu (m_k g_i + m.g where i = k).
    """
    at, rows, g = space.gradients_in(q.points, q.parts)
    m, mu, lam, d = m[at], mu[at, None, None], lam[at, None, None], m.shape[1]
    t = lam * m[:, :, None] * g[:, None, :] + mu * g[:, :, None] * m[:, None, :]
    t += mu * (m * g).sum(axis=1)[:, None, None] * np.eye(d)
    i, k = np.indices((d, d))
    at, rows = d * at[:, None, None] + i, d * rows[:, None, None] + k
    return csr_array((t.ravel(), (at.ravel(), rows.ravel())), (d * len(q.points), space.enrichment.n_dof))
