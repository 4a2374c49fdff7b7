"""What a case gives: the solved problem and its values beside their references; conditioning; energy-norm errors."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, cg, eigsh, splu

from benchmarks.verification import plane
from xfemnav.mechanics.conditions.constraints import eliminate
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.solving.solution import Solution, scaled_basis
from xfemnav.mechanics.space.quadrature import tip_rule
from xfemnav.mechanics.tissue.elasticity import stiffness


@dataclass(frozen=True)
class Value:
    """A computed quantity; `error` is relative to its reference unless a scale is named with it."""

    name: str
    value: float
    reference: float
    error: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """A solved case."""

    problem: Problem
    solution: Solution
    values: tuple[Value, ...]


def relative(name: str, value: float, reference: float) -> Value:
    """A value with its error relative to the reference."""
    return Value(name, float(value), float(reference), float(abs(value / reference - 1)))


def reduced_system(problem: Problem, scaling: str = "block") -> tuple[csc_array, np.ndarray]:
    """Matrix and right side that remain when the conditions are eliminated.

    scaling: 'block' is the solver's own; 'jacobi' scales the diagonal to one; 'none' leaves the basis as it is.
    """
    K = (stiffness(problem.space, problem.material) + problem.springs).tocsc()
    conditions = problem.constraints
    if scaling == "block":
        basis = scaled_basis(problem, K)
        U0, T = eliminate(replace(conditions, C=conditions.C @ basis))
        U0, T = basis @ U0, basis @ T
    else:
        U0, T = eliminate(conditions)
    A, b = csc_array(T.T @ K @ T), T.T @ (problem.load - K @ U0)
    if scaling == "jacobi":
        d = 1 / np.sqrt(A.diagonal())
        A, b = csc_array(A.multiply(d[:, None]).multiply(d[None, :])), d * b
    return A, b


def condition_number(A) -> float:
    """Largest over smallest eigenvalue of a symmetric positive definite matrix, to about a per cent.

    Factored here, because the solver refuses what is singular but for rounding, as a raw basis may be.
    """
    v0 = np.random.default_rng(0).normal(size=A.shape[0])
    largest = eigsh(A, k=1, which="LA", tol=1e-3, v0=v0, return_eigenvectors=False)[0]
    factor = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    inverse = LinearOperator(A.shape, factor.solve)
    return float(largest * eigsh(inverse, k=1, which="LA", tol=1e-3, v0=v0, return_eigenvectors=False)[0])


def cg_iterations(A, b, rtol: float = 1e-8, limit: int = 20_000) -> int:
    """Steps of conjugate gradients to a relative residual of `rtol`; `limit` when it does not get there."""
    steps = [0]

    def count(_):
        steps[0] += 1

    cg(A, b, rtol=rtol, maxiter=limit, callback=count)
    return steps[0]


def energy_error(problem: Problem, U, exact_strain) -> float:
    """Energy norm of the error over that of the exact field; exact_strain(points) -> (q, 3) xx, yy, 2 xy."""
    split, D = problem.parts, plane.stiffness(problem.material)
    points, weights, owner = tip_rule(split.corners, split.fronts.at)
    strain = plane.strains(problem.space, U, points, split.part[owner])
    exact = exact_strain(points)
    norms = [np.einsum("q,qs,st,qt->", weights, e, D, e) for e in (strain - exact, exact)]
    return float(np.sqrt(norms[0] / norms[1]))
