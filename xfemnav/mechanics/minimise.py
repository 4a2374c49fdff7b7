"""Minimise a quadratic energy: 1/2 U'KU - f'U under equalities, eliminated exactly, and inequalities.

The inequalities G U + gap >= 0 say that surfaces do not pass through each other (Signorini's conditions). Their
multipliers are the pressures: never negative, and zero where there is a gap. K is factored once; what is left is a
small dense problem for the pressures alone, solved as non-negative least squares (Lawson & Hanson 1974) and then
exactly on the rows that press.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import nnls
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array

#: Largest relative residual of a solution that is given out.
RESIDUAL_LIMIT = 1e-8
#: A gap this much below zero, mm, is rounding.
TOUCH_MM = 1e-10
#: A condition whose part on the free unknowns is smaller than this, relative, is settled by the held lips.
SETTLED = 1e-8


@dataclass(frozen=True, eq=False)
class Contacts:
    """Conditions G U + gap >= 0 mm: `G` (g, n_dof) sparse, `gap` (g,) mm at rest."""

    G: csr_array
    gap: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "G", csr_array(self.G))
        object.__setattr__(self, "gap", frozen_array(self.gap, float, (self.G.shape[0],), "gap"))


@dataclass(frozen=True, eq=False)
class Minimum:
    """U (n_dof,) mm; relative residual; force (g,): multipliers of the contacts, 0 where there is a gap."""

    U: np.ndarray
    residual: float
    force: np.ndarray


def minimise(K, load, U0, T, contacts: Contacts | None = None) -> Minimum:
    """The minimum over U = U0 + T q; K (n_dof, n_dof) kPa, load (n_dof,), U0 and T from `eliminate`.

    Raises XfemnavError E407 when the energy has no minimum, when the residual stays above 1e-8, or when no pressures
    were found that keep the gaps open.
    """
    A = (T.T @ K @ T).tocsc()
    b = T.T @ (load - K @ U0)
    lu = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    if not (lu.U.diagonal() > 0).all():
        raise XfemnavError(
            "E407",
            "the linear system is not positive definite, so its solution is no minimum of energy; "
            "this is a bug, please report it with the run's parameters.",
        )
    q = _refined(lu, A, b)
    force = np.zeros(0)
    if contacts is not None:
        G, gap = csr_array(contacts.G @ T), contacts.gap + contacts.G @ U0
        force = _pressures(lu, G, gap, q)
        if force.any():
            q = _refined(lu, A, b + G.T @ force)
            b = b + G.T @ force
    size = np.linalg.norm(b) + np.linalg.norm(T.T @ load)
    residual = float(np.linalg.norm(b - A @ q) / size) if size else 0.0
    if not residual <= RESIDUAL_LIMIT:
        raise XfemnavError(
            "E407",
            f"the linear system was not solved: relative residual {residual:.1e} is above {RESIDUAL_LIMIT:.0e}; "
            "this is a bug, please report it with the run's parameters.",
        )
    return Minimum(U0 + T @ q, residual, force)


def _refined(lu, A, b):
    q = lu.solve(b)
    return q + lu.solve(b - A @ q)


def _pressures(lu, G, gap, q):
    """Multipliers (g,) >= 0 with gap + G (q + A^-1 G' force) >= 0, zero where that is positive."""
    force = np.zeros(len(gap))
    norm = np.sqrt(G.multiply(G).sum(axis=1))
    live = np.flatnonzero(norm > SETTLED * norm.max(initial=0.0))
    if not len(live) or (gap + G @ q)[live].min() >= -TOUCH_MM:
        return force
    S = G[live] @ lu.solve(G[live].T.toarray())
    scale = 1 / np.sqrt(np.diag(S))
    S = (S + S.T) / 2 * scale[:, None] * scale
    opening = (gap + G @ q)[live] * scale
    force[live] = scale * _complementary(S, opening, TOUCH_MM * scale)
    return force


def _complementary(S, opening, slack):
    """x >= 0 with y = S x + opening >= -slack and x_k y_k = 0; S symmetric, positive semidefinite, unit diagonal."""
    R = cholesky(S + 1e-12 * np.eye(len(S)))
    x, _ = nnls(R, solve_triangular(R, -opening, trans="T"), maxiter=50 * len(S))
    pressing = x > 0
    for _ in range(3 * len(S) + 10):
        x = np.zeros(len(S))
        x[pressing] = _exactly(S[np.ix_(pressing, pressing)], -opening[pressing])
        y = S @ x + opening
        wrong = (pressing & (x < 0)) | (~pressing & (y < -slack))
        if not wrong.any():
            return x
        # One at a time, the worst first: all at once may go round in circles.
        worst = np.argmax(np.where(wrong, np.abs(np.where(pressing, x, y)), -1.0))
        pressing[worst] = ~pressing[worst]
    raise XfemnavError(
        "E407",
        f"the pressures between {len(S)} touching places were not found; "
        "hold both lips of the cut, or give --lips free, and please report this with the run's parameters.",
    )


def _exactly(S, target):
    factor = cho_factor(S + 1e-14 * np.eye(len(S)))
    x = cho_solve(factor, target)
    return x + cho_solve(factor, target - S @ x)
