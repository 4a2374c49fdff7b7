"""Minimise a quadratic energy: 1/2 U'KU - f'U under equalities, eliminated exactly, means, and inequalities.

The inequalities G U + gap >= 0 say that surfaces do not pass through each other (Signorini's conditions). Their
multipliers are the pressing forces: never negative, and zero where there is a gap. K is factored once; what is left is
a small dense problem for the forces alone, solved by an active set whose energy falls at every step, so that it cannot
go round in circles (Lawson & Hanson 1974, Bro & de Jong 1997), and repeated on the true gaps until they are closed.

A mean over a body that nothing else holds couples all of its unknowns, so it is not eliminated: the body is pinned
on as few unknowns as it has free motions, and the pins' forces are then traded for the means' exactly.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lstsq, lu_factor, lu_solve
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.interruption import checkpoint
from xfemnav.limits import RESIDUAL
from xfemnav.mechanics.conditions.constraints import Contacts, Means
from xfemnav.mechanics.solving.factor import NotPositiveDefinite, factor, refined

#: Largest relative residual of a solution that is given out.
RESIDUAL_LIMIT = RESIDUAL.value
#: A gap this much below zero, mm, is rounding; one that is worse than the limit, for each mm (one at least) by which
#: what touches moves, is not given out.
TOUCH_MM, GAP_LIMIT = 1e-10, 1e-9
#: A condition whose part on the free unknowns is smaller than this, relative, is settled by what is held.
SETTLED = 1e-8
#: Held surfaces this far through each other, mm, contradict the condition between them.
CONTRADICTION_MM = 1e-6
#: Added to the unit diagonal of the forces' problem, which repeated conditions make singular.
RIDGE = 1e-12
#: Most repetitions on the true gaps; two or three are the rule.
ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Minimum:
    """U (n_dof,) mm; relative residual; multipliers: force (g,) mN per mm of the contacts, 0 where there is a gap, and
    mean_force (m,) of the means; sway (n_dof,) mm: minus dU / d ln k, what hangs on springs of stiffness k."""

    U: np.ndarray
    residual: float
    force: np.ndarray
    mean_force: np.ndarray
    sway: np.ndarray | None = None


def minimise(
    K,
    load,
    U0,
    T,
    contacts: Contacts | None = None,
    means: Means | None = None,
    by=factor,
    hung=None,
) -> Minimum:
    """The minimum over U = U0 + T q; K (n_dof, n_dof) kPa, load (n_dof,), U0 and T from `eliminate`.

    by: what makes a `Factor` of a matrix on the unknowns q. hung: those springs in K, (n_dof, n_dof) kPa, whose part in
    U is asked for.

    Raises XfemnavError E405 when what is held pushes surfaces through each other; E407 when the energy has no minimum,
    when the residual stays above 1e-8, or when no forces were found that keep the gaps open.
    """
    A = (T.T @ K @ T).tocsc()
    if means is None:
        lu = _factored(A, by)
    else:
        lu = _Held(A, csr_array(means.C @ T).toarray(), csr_array(T.tocsr()[means.pins]), by)
        U0 = U0 + T @ lu.reaching(-(means.C @ U0))
    b = T.T @ (load - K @ U0)
    q, force, sway = refined(lu, A, b), np.zeros(0), None
    if contacts is not None:
        G, gap, force = csr_array(contacts.G @ T), contacts.gap + contacts.G @ U0, np.zeros(len(contacts.gap))
        live = _unsettled(contacts, G, gap, T)
        q, force[live], S = pressed(lu, A, b, q, G[live], gap[live])
        b = b + G.T @ force
        if hung is not None:
            sway = T @ _given_way(lu, T.T @ (hung @ (U0 + T @ q)), G[live], S, force[live] > 0)
    size = np.linalg.norm(b) + np.linalg.norm(T.T @ load)
    rest, mean_force = without_means(b - A @ q, T, means)
    residual = float(np.linalg.norm(rest) / size) if size else 0.0
    if not residual <= RESIDUAL_LIMIT:
        raise XfemnavError(
            "E407",
            f"the linear system was not solved: relative residual {residual:.1e} is above {RESIDUAL_LIMIT:.0e}; "
            "this is a bug, please report it with the run's parameters.",
        )
    return Minimum(U0 + T @ q, residual, force, mean_force, sway)


def without_means(forces, T, means: Means | None):
    """Forces (n_free,) on the unknowns q less what the means take up, and the means' multipliers (m,) that do so."""
    if means is None:
        return forces, np.zeros(0)
    C = csr_array(means.C @ T).toarray()
    taken = np.linalg.lstsq(C.T, forces, rcond=None)[0]
    return forces - C.T @ taken, -taken


def _factored(A, by):
    try:
        return by(A)
    except NotPositiveDefinite as error:
        raise XfemnavError(
            "E407",
            f"the linear system is not positive definite ({error}), so its solution is no minimum of energy; are some "
            "tissues 1e12 times as stiff as others? If not, this is a bug: please report it with the run's parameters.",
        ) from None


class _Held:
    """The inverse of A (n, n) on the q with C q = 0, where A alone is singular: A q = b + C' mu.

    With pins P, scaled to A's diagonal, A + P'P is positive definite, and q = (A + P'P)^-1 (b + P'z + C'mu) with
    P q = z: a small dense problem for z and mu.
    """

    iterated = False

    def __init__(self, A, C, P, by):
        size = np.sqrt(P.multiply(P).sum(axis=1))
        self.P = csr_array(P.multiply((np.sqrt(A.diagonal().max()) / size)[:, None]))
        self.C, self.lu = C, _factored((A + self.P.T @ self.P).tocsc(), by)
        rows = np.concatenate([self.P.toarray(), C])
        self.moved = self.lu.solve(rows.T.copy())
        small = np.concatenate([self.P @ self.moved, C @ self.moved])
        m = len(C)
        small[:m, :m] -= np.eye(m)
        self.small = lu_factor(small)

    def solve(self, b):
        """q (n,) or (n, k) for b of the same shape."""
        q = self.lu.solve(b)
        return q - self.moved @ lu_solve(self.small, np.concatenate([self.P @ q, self.C @ q]))

    def reaching(self, d):
        """q (n,) with C q = d (m,) that no force but the means' asks for."""
        return self.moved @ lu_solve(self.small, np.concatenate([np.zeros(len(d)), d]))


def _unsettled(contacts, G, gap, T):
    """Conditions (k,) that the free unknowns can act on; the others must be met by what is held."""
    norm = np.sqrt(G.multiply(G).sum(axis=1))
    reach = abs(contacts.G) @ np.sqrt(csr_array(T.multiply(T)).sum(axis=1))
    settled = norm <= SETTLED * reach
    worst = np.argmin(np.where(settled, gap, np.inf)) if settled.any() else None
    if worst is not None and gap[worst] < -CONTRADICTION_MM:
        at = ", ".join(f"{x:.1f}" for x in contacts.points[worst])
        what = "the lips of a cut into each other" if contacts.cut[worst] >= 0 else "the outline through the skull"
        raise XfemnavError(
            "E405",
            f"what is held pushes {what} by {-gap[worst]:.2g} mm at ({at}) mm; "
            "correct the displacements there, or give ⟦lips=free⟧.",
        )
    return np.flatnonzero(~settled)


def pressed(lu, A, b, q, G, gap):
    """q and forces (g,) >= 0 with A q = b + G' force and G q + gap >= 0, each force zero where its gap is open.

    And the gaps that unit forces open, (g, g) mm per mN per mm; None where no force was needed.
    """
    force = np.zeros(len(gap))
    opening = gap + G @ q
    if opening.min(initial=0.0) >= -TOUCH_MM:
        return q, force, None
    give = G @ lu.solve(G.T.toarray())
    scale = 1 / np.sqrt(np.diag(give))
    S = (give + give.T) / 2 * scale[:, None] * scale
    for n in range(ROUNDS):
        checkpoint()
        before, force = force, scale * _complementary(S, force / scale, opening * scale, TOUCH_MM * scale)
        # The first forces may bring back what a load on weak springs has carried far away; then only what changes
        # counts, as the rounding of all would move it again.
        q = refined(lu, A, b + G.T @ force) if n == 0 else q + lu.solve(G.T @ (force - before))
        opening = gap + G @ q
        error = np.where(force > 0, np.abs(opening), -opening).max()
        if error <= TOUCH_MM:
            return q, force, give
    if error <= GAP_LIMIT * max(1.0, (abs(G) @ np.abs(q)).max()):
        return q, force, give
    raise XfemnavError(
        "E407",
        f"the forces between {len(gap)} touching places were not found: a gap is off by {error:.1e} mm; "
        "hold both lips of the cut, or give ⟦lips=free⟧, and please report this with the run's parameters.",
    )


def _given_way(lu, springs, G, give, touching):
    """How q goes on as springs give way, whose forces (n,) these are; what touches (g,) bool goes on touching."""
    q = lu.solve(springs)
    if touching.any():
        S = give[np.ix_(touching, touching)]
        q = q - lu.solve(G[touching].T @ lstsq(S, G[touching] @ q)[0])
    return q


def _complementary(S, x, y, slack):
    """From x >= 0 with gaps y to x' >= 0 with y' = y + S (x' - x) >= -slack, and y'_k = 0 where x'_k > 0.

    S (g, g) symmetric, positive semidefinite, unit diagonal. The energy, whose gradient y is, falls with every step.
    """
    S = S + RIDGE * np.eye(len(S))
    x, y = x.copy(), y.copy()
    passive = x > 0
    if not passive.any():  # a good place to start: all that overlap, without those that would pull
        overlap = np.flatnonzero(y < -slack)
        x[overlap] = np.maximum(_solve(S, overlap, -y), 0)
        y, passive = y + S @ x, x > 0
    stuck = np.zeros(len(x), dtype=bool)
    added = -1
    for _ in range(50 * len(x)):
        while passive.any():
            p = np.flatnonzero(passive)
            step = _solve(S, p, -y)
            leaving = x[p] + step <= 0
            ratio = np.where(leaving, x[p] / np.maximum(-step, 1e-300), np.inf)
            share = min(ratio.min(), 1.0)
            x[p] += share * step
            y = y + share * (S[:, p] @ step)
            if not leaving.any():
                break
            gone = p[ratio <= share]
            # Rounding may send back the one that was just added: it is not asked again.
            stuck[gone[gone == added]] |= share == 0
            x[gone], passive[gone] = 0.0, False
        waiting = ~passive & ~stuck & (y < -slack)
        if not waiting.any():
            break
        added = int(np.argmin(np.where(waiting, y, 0.0)))
        passive[added] = True
    return x


def _solve(S, p, target):
    return cho_solve(cho_factor(S[np.ix_(p, p)]), target[p])
