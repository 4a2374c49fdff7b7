"""The factorisation of a symmetric positive definite matrix, to be solved for many loads.

By CHOLMOD where scikit-sparse 0.4 is installed (the extra `cholmod`), else by SuperLU ordered for a symmetric pattern.
Both are exact but for rounding, so what is solved with one agrees with the other to the problem's conditioning.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

#: Columns that SuperLU works on at once: with its own 20, a mesh's factor takes a quarter longer.
PANEL = 4
#: A motion whose energy is below this part of the sum of its terms' sizes has none but for rounding.
SINGULAR = 8 * np.finfo(float).eps


class NotPositiveDefinite(ArithmeticError):
    """The matrix is singular, or belongs to an energy without a minimum."""


@dataclass(frozen=True, eq=False)
class Factor:
    """A factored matrix A (n, n): `solve(b)` is A^-1 b for b (n,) or (n, k), by iteration to its own tolerance where
    `iterated`, else to rounding, which one refinement takes off."""

    solve: Callable
    iterated: bool = False


def refined(inverse, A, b) -> np.ndarray:
    """A^-1 b (n,) by an `inverse`, as exact as can be had from it."""
    q = inverse.solve(b)
    return q if inverse.iterated else q + inverse.solve(b - A @ q)


def factor(A, semidefinite: bool = False) -> Factor:
    """Factor A (n, n), sparse, symmetric and positive definite. Raises NotPositiveDefinite.

    `semidefinite` says that A is a sum of squares, and can be no worse than singular: its pivots are not read then,
    which would copy the factor.
    """
    try:
        return by_cholmod(A)
    except ImportError:
        return by_superlu(A, semidefinite)


def by_superlu(A, semidefinite: bool = False) -> Factor:
    """By SuperLU without pivoting."""
    try:
        lu = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, panel_size=PANEL,
                  options={"SymmetricMode": True})
    except RuntimeError as error:  # exactly singular
        raise NotPositiveDefinite(str(error)) from None
    if not semidefinite:
        pivots = lu.U.diagonal()
        if not (pivots > 0).all():
            raise NotPositiveDefinite(f"smallest pivot {pivots.min():.1e}")
    return _unless_singular(A, lu.solve)


def by_cholmod(A) -> Factor:
    """By CHOLMOD, which takes the lower triangle. Raises ImportError without scikit-sparse 0.4: later ones differ."""
    from sksparse.cholmod import CholmodNotPositiveDefiniteError, analyze

    A = csc_matrix(A)
    found = analyze(A, mode="supernodal", ordering_method="amd")  # the other mode takes indefinite matrices too
    try:
        found.cholesky_inplace(A)  # one that failed says so when it is used
        return _unless_singular(A, found)
    except CholmodNotPositiveDefiniteError as error:
        raise NotPositiveDefinite(str(error)) from None


def _unless_singular(A, solve):
    """The factor, if what it answers to an arbitrary load tells of no motion that A does not resist."""
    # The load has a share of every eigenvector, and the answer is mostly the softest one.
    motion = solve(np.random.default_rng(0).normal(size=A.shape[0]))
    motion = motion / np.linalg.norm(motion)
    energy, terms = motion @ (A @ motion), np.abs(motion) @ (abs(A) @ np.abs(motion))
    if not energy > SINGULAR * terms:
        raise NotPositiveDefinite(f"a motion with the energy {energy:.1e} of terms {terms:.1e}")
    return Factor(solve)
