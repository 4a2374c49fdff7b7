"""Nitsche's condition on a lip: consistent traction terms and a penalty, without multipliers.

On the held lip, with m the outward normal and t(u) = s(u) m, the weak form gains
- integral t(u).v - integral t(v).(u - given) + integral beta (u - given).v.
beta = gamma M (held length of the part) / (area of the part), uncapped, with M the P-wave modulus and gamma > 1, keeps
the form positive on every part with constant strains, slivers included. Two kinds of parts carry only the penalty
2 M / h: those under a fifth of their cell, whose traction says little and whose weight would spoil the conditioning,
and those with branch functions, whose strains at the lip no such bound limits.
"""

import numpy as np
from scipy.sparse import csr_array, vstack

from xfemnav.mechanics.constraints import SKULL, vector_rows
from xfemnav.mechanics.elasticity import Material, Tissue, strain_matrices, stress_matrices
from xfemnav.mechanics.lips import LipQuadrature, Retraction, lip_quadrature
from xfemnav.mechanics.space import Space

GAMMA = 2.0
SMALL_PART = 0.2


def nitsche_terms(
    space: Space, material: Material | Tissue, retraction: Retraction, span
) -> tuple[csr_array, np.ndarray]:
    """Stiffness (n_dof, n_dof) kPa and load (n_dof,) mN per mm of the condition u = given on a held lip."""
    B, t, beta, weights, given = _lip_operators(space, material, retraction, span)
    w = np.repeat(weights, 2)
    K = B.T @ B.multiply((beta * w)[:, None]).tocsr() - B.T @ t.multiply(w[:, None]).tocsr()
    K = csr_array(K - t.T @ B.multiply(w[:, None]).tocsr())
    return K, B.T @ (beta * w * given) - t.T @ (w * given)


def nitsche_load(space: Space, material: Material | Tissue, retraction: Retraction, span, U) -> np.ndarray:
    """Load (n_dof,) mN per mm by which the condition also asks for the displacements of the coefficients U (n_dof,)."""
    B, t, beta, weights, _ = _lip_operators(space, material, retraction, span)
    w, given = np.repeat(weights, 2), B @ U
    return B.T @ (beta * w * given) - t.T @ (w * given)


def nitsche_traction(
    space: Space, material: Material | Tissue, retraction: Retraction, span, U, under=None
) -> tuple[LipQuadrature, np.ndarray]:
    """Gauss points of the lip and the traction (q, 2) kPa of the retractor there: t(u) - beta (u - given).

    under (n_dof,): coefficients of the displacements from which the given ones count; None: from rest.
    """
    B, t, beta, _, given = _lip_operators(space, material, retraction, span)
    u = np.asarray(U).ravel()
    traction = t @ u - beta * (B @ u - given - (0 if under is None else B @ under))
    return lip_quadrature(space, retraction.cut, retraction.side, span), traction.reshape(-1, 2)


def _lip_operators(space, material, retraction, span):
    """At Gauss points of the lip, components interleaved: B, tractions t (2q, n_dof), beta, given; weights (q,)."""
    q = lip_quadrature(space, retraction.cut, retraction.side, span)
    B = vector_rows(space.basis_in(q.points, q.parts), np.zeros((len(q.points), 2)), SKULL).C
    m = -retraction.side * q.normals
    area = np.bincount(space.parts.part, space.parts.volumes, space.parts.n_parts)
    length = np.bincount(q.parts, q.weights, space.parts.n_parts)
    cell = space.parts.cell[q.parts]
    D = material.stiffness_in(cell)
    stress = stress_matrices(strain_matrices(space, q.points, q.parts), D)
    alone = (area[q.parts] < SMALL_PART * space.mesh.volumes[cell]) | np.isin(q.parts, space.branch_parts)
    beta = np.where(alone, 2 / space.mesh.sizes[cell], GAMMA * length[q.parts] / area[q.parts]) * D[:, 0, 0]
    # Cauchy: t_x = s_xx m_x + s_xy m_y, t_y = s_xy m_x + s_yy m_y; none where the penalty stands alone.
    mx, my = (m * ~alone[:, None]).T[:, :, None]
    t = vstack([stress[0].multiply(mx) + stress[2].multiply(my), stress[2].multiply(mx) + stress[1].multiply(my)])
    t = csr_array(t)[np.arange(2 * len(m)).reshape(2, -1).T.ravel()]
    given = retraction.displacement(q.normals)
    return B, t, np.repeat(beta, 2), q.weights, given.ravel()
