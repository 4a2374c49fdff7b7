"""Finite strains: equilibrium of a neo-Hookean organ, in coordinates at rest (total Lagrangian).

The energy of all tissue, springs and loads is minimised over the displacements that keep the problem's conditions: by
Newton's method, each of whose steps is a linear problem with the conditions and contacts of the linear solve. What is
prescribed (displacements, loads, gaps to be opened) grows from nothing to all in steps: in one if that goes, else in
ever smaller ones. Conditions, springs and contacts stay those of the shape at rest.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.interruption import checkpoint
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.solving.minimise import CONTRADICTION_MM, RESIDUAL_LIMIT, Minimum, minimise, without_means
from xfemnav.mechanics.space.quadrature import tip_rule
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue import neo_hookean

#: No tissue is squeezed below this part of its area on the way.
LEAST_DET_F = 0.05
#: Newton steps for one part of the load, and in all; after no more than EASY of them the next part is twice as large.
MOST_ITERATIONS, MOST_IN_ALL, EASY = 30, 120, 6
#: The smallest part of the load that is tried.
SMALLEST_STEP = 1 / 100
#: Newton's step is halved at most so often; the energy must fall by this part of what its slope promises.
HALVINGS, DESCENT = 6, 1e-4
#: Where the tangent is not positive definite, points' tangents are made so, with this part of mu at least.
LEAST_STIFFNESS = 1e-3


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """U (n_dof,) mm; residual: relative; what it took.

    tissue (n_dof,) mN: nodal forces of the tissue, per mm of thickness; energy that it stores, kPa mm^2; force (g,):
    multipliers of the contacts; mean_force (m,): those of the means.
    """

    U: np.ndarray
    residual: float
    tissue: np.ndarray
    energy: float
    force: np.ndarray
    mean_force: np.ndarray
    load_steps: int
    newton_iterations: int


@dataclass(frozen=True, eq=False)
class Organ:
    """A problem's potential energy and its derivatives, by its integration points.

    weights (q,) mm^2; gradient (4 q, n_dof) 1/mm: du_i/dx_j at point q in row 4 q + 2 i + j; Lame's constants (q,) kPa.
    """

    problem: Problem
    weights: np.ndarray
    gradient: csr_array
    mu: np.ndarray
    lam: np.ndarray

    def deformation(self, U) -> np.ndarray:
        """F (q, 2, 2) at the integration points."""
        return np.eye(2) + (self.gradient @ U).reshape(-1, 2, 2)

    def admits(self, U) -> bool:
        """Whether no tissue is turned inside out, or nearly so."""
        return bool(np.linalg.det(self.deformation(U)).min() > LEAST_DET_F)

    def stored(self, U) -> float:
        """Energy of the tissue, kPa mm^2."""
        return float(self.weights @ neo_hookean.energy(self.deformation(U), *self._constants))

    def potential(self, U) -> float:
        """Energy of the tissue and springs less the work of the load, kPa mm^2."""
        return self.stored(U) + float(U @ (self.problem.springs @ U)) / 2 - float(self.problem.load @ U)

    def tissue(self, U) -> np.ndarray:
        """Nodal forces (n_dof,) mN of the tissue, per mm of thickness."""
        P = neo_hookean.stress(self.deformation(U), *self._constants)
        return self.gradient.T @ (P * self.weights[:, None, None]).ravel()

    def slope(self, U) -> np.ndarray:
        """Derivative (n_dof,) mN of the potential."""
        return self.tissue(U) + self.problem.springs @ U - self.problem.load

    def stiffness(self, U, convex: bool = False) -> csr_array:
        """Second derivative (n_dof, n_dof) kPa of the potential; if `convex`, of the next convex one."""
        A = neo_hookean.tangent(self.deformation(U), *self._constants)
        if convex:
            values, vectors = np.linalg.eigh(A)
            values = np.maximum(values, LEAST_STIFFNESS * self.mu[:, None])
            A = np.einsum("qst,qt,qut->qsu", vectors, values, vectors)
        K = self.gradient.T @ (_block_diagonal(A * self.weights[:, None, None]) @ self.gradient)
        return csr_array((K + K.T) / 2 + self.problem.springs)

    @property
    def _constants(self):
        return self.mu, self.lam, self.problem.material.plane_stress


def organ(problem: Problem) -> Organ:
    """The organ of a problem: one point in each part with constant strains, and the tip's rule in the others."""
    space, split = problem.space, problem.parts
    plain = np.setdiff1d(np.arange(split.n_parts), space.branch_parts)
    points, weights = space.mesh.corners[split.cell[plain]].mean(axis=1), np.bincount(split.part, split.volumes)[plain]
    parts, about_tip = plain, np.flatnonzero(np.isin(split.part, space.branch_parts))
    if len(about_tip):
        more = tip_rule(split.corners[about_tip], split.fronts.at)
        points, weights = np.concatenate([points, more[0]]), np.concatenate([weights, more[1]])
        parts = np.concatenate([plain, split.part[about_tip][more[2]]])
    return Organ(
        problem, weights, gradient_operator(space, points, parts), *problem.material.lame_in(split.cell[parts])
    )


def gradient_operator(space: Space, points, parts) -> csr_array:
    """Matrix (d^2 k, n_dof), 1/mm: du_i/dx_j at point k (k, d) mm, taken in part (k,), in row d (d k + i) + j."""
    at, rows, gradients = space.gradients_in(points, parts)
    d = gradients.shape[1]
    i, j = np.indices((d, d))
    data, rows, columns = np.broadcast_arrays(gradients[:, None, :], d * (d * at[:, None, None] + i) + j,
                                              d * rows[:, None, None] + i)
    shape = (d**2 * len(points), space.enrichment.n_dof)
    return csr_array((data.ravel(), (rows.ravel(), columns.ravel())), shape)


def _block_diagonal(A):
    """The matrix (4 q, 4 q) with the blocks A (q, 4, 4)."""
    n = 4 * len(A)
    columns = np.repeat(np.arange(n).reshape(-1, 1, 4), 4, axis=1)
    return csr_array((A.ravel(), columns.ravel(), np.arange(0, 4 * n + 1, 4)), (n, n))


def equilibrium(problem: Problem, U0, T, linear: Minimum) -> Equilibrium:
    """The equilibrium of the neo-Hookean organ among U = U0 + T q, the displacements that keep the conditions.

    linear: the linear model's answer, a part of which keeps the same part of the conditions and is the first guess.
    Raises XfemnavError E410 when no equilibrium is found for all of the load, with the largest part that has one.
    """
    whole = organ(problem)
    size = _size(whole, U0, T, linear)
    reached, step, U = 0.0, 1.0, np.zeros(len(U0))
    load_steps = iterations = 0
    while reached < 1:
        part = min(reached + step, 1.0)
        partly, guess = replace(whole, problem=_part_of(problem, part)), U + (part - reached) * linear.U
        if reached > 0:
            by_tangent = _newton_step(partly, T, U, guess).U
            guess = by_tangent if whole.admits(by_tangent) else guess
        found = _newton(partly, T, guess, part * size)
        iterations += found.iterations + (reached > 0)
        if found.residual <= RESIDUAL_LIMIT:
            load_steps, reached, U = load_steps + 1, part, found.U
            step *= 2 if found.iterations <= EASY else 1
        elif step / 2 < SMALLEST_STEP or iterations > MOST_IN_ALL:
            raise XfemnavError("E410", _too_much(problem, reached))
        else:
            step /= 2
    forces = found.force, found.mean_force
    return Equilibrium(U, found.residual, whole.tissue(U), whole.stored(U), *forces, load_steps, iterations)


def _size(organ, U0, T, linear):
    """What a residual is measured against, as in the linear solve: the forces on the unknowns before they move."""
    force = organ.problem.load
    if organ.problem.contacts is not None:
        force = force + organ.problem.contacts.G.T @ linear.force
    start = force - organ.stiffness(np.zeros(len(U0))) @ U0
    return float(np.linalg.norm(T.T @ start) + np.linalg.norm(T.T @ force)) or 1.0


def _part_of(problem, part):
    """The problem with a part of its load. An open gap is there at once; one that is to be opened opens in parts."""
    contacts = problem.contacts
    if contacts is not None:
        contacts = replace(contacts, gap=np.maximum(contacts.gap, part * contacts.gap))
    return replace(problem, load=part * problem.load, contacts=contacts)


def _too_much(problem, reached):
    moves = [r.displacement(np.array([[1.0, 0.0]])) for r in problem.retractions if r.holds]
    lips = f" (lips moved by up to {reached * np.linalg.norm(moves, axis=-1).max():.2f} mm)" if moves else ""
    return (
        f"no equilibrium of the neo-Hookean tissue was found beyond {100 * reached:.1f} % of the load{lips}; "
        "ask for no more than that, or use ⟦skull_ramp_mm=4⟧, ⟦tip_enrichment=none⟧, and no ⟦grade_at_data_ends⟧."
    )


def _newton(organ, T, U, size):
    """Newton's method from U, which keeps the conditions; the residual tells whether it ended in equilibrium."""
    contacts = organ.problem.contacts
    force, residual = np.zeros(0 if contacts is None else len(contacts.gap)), np.inf
    for iterations in range(MOST_ITERATIONS * organ.admits(U)):
        checkpoint()
        towards = _newton_step(organ, T, U, U)
        force, before, U = towards.force, U, _descended(organ, U, towards.U - U)
        slope = organ.slope(U) if contacts is None else organ.slope(U) - contacts.G.T @ force
        rest, mean_force = without_means(-(T.T @ slope), T, organ.problem.means)
        residual = float(np.linalg.norm(rest) / size)
        if residual <= RESIDUAL_LIMIT or U is before:
            return _Attempt(U, residual, force, mean_force, iterations + 1)
    return _Attempt(U, residual, force, np.zeros(0), MOST_ITERATIONS * organ.admits(U))


def _newton_step(organ, T, U, start):
    """The minimum over `start` + T q of the energy's quadratic model about U, made convex if it has none."""
    for convex in (False, True):
        K = organ.stiffness(U, convex)
        try:
            return minimise(K, K @ U - organ.slope(U), start, T, organ.problem.contacts, organ.problem.means)
        except XfemnavError as error:
            if convex or error.code != "E407":
                raise


def _descended(organ, U, direction):
    """U + direction, or a shorter step, where the energy falls; U itself where it does not."""
    before = organ.potential(U) if _keeps(organ.problem.contacts, U) else np.inf
    fall = DESCENT * float(organ.slope(U) @ direction)
    for k in range(HALVINGS):
        there = U + 0.5**k * direction
        if not (organ.admits(there) and _keeps(organ.problem.contacts, there)):
            continue
        # Near the minimum the energy falls by less than its rounding.
        if organ.potential(there) <= before + 0.5**k * fall + 1e-12 * abs(before):
            return there
    return U


def _keeps(contacts, U):
    """Whether no surfaces pass through each other."""
    return contacts is None or bool((contacts.G @ U + contacts.gap).min(initial=0.0) >= -CONTRADICTION_MM)


@dataclass(frozen=True, eq=False)
class _Attempt:
    """Where Newton's method ended: U (n_dof,) mm, relative residual, multipliers of contacts and means, steps taken."""

    U: np.ndarray
    residual: float
    force: np.ndarray
    mean_force: np.ndarray
    iterations: int
