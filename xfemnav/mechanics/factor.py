"""The factorisation of a symmetric positive definite matrix, to be solved for many loads.

By CHOLMOD where scikit-sparse is installed (the extra `cholmod`), else by SuperLU ordered for a symmetric pattern.
Both are exact but for rounding, so what is solved with one agrees with the other to the problem's conditioning.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu


class NotPositiveDefinite(ArithmeticError):
    """The matrix is singular, or belongs to an energy without a minimum."""


@dataclass(frozen=True, eq=False)
class Factor:
    """A factored matrix A (n, n): `solve(b)` is A^-1 b for b (n,) or (n, k); `pivots()` (n,), all positive."""

    solve: Callable
    pivots: Callable


def factor(A) -> Factor:
    """Factor A (n, n), sparse, symmetric and positive definite. Raises NotPositiveDefinite."""
    try:
        import sksparse.cholmod  # noqa: F401
    except ImportError:
        return by_superlu(A)
    return by_cholmod(A)


def by_superlu(A) -> Factor:
    """By SuperLU without pivoting."""
    try:
        lu = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:  # exactly singular
        raise NotPositiveDefinite(str(error)) from None
    pivots = lu.U.diagonal()
    if not (pivots > 0).all():
        raise NotPositiveDefinite(f"smallest pivot {pivots.min():.1e}")
    return Factor(lu.solve, lambda: pivots)


def by_cholmod(A) -> Factor:
    """By CHOLMOD, which takes the lower triangle."""
    from sksparse.cholmod import CholmodNotPositiveDefiniteError, cholesky

    try:
        found = cholesky(csc_matrix(A), mode="supernodal")  # the other mode takes indefinite matrices too
        found.logdet()  # a factorisation that failed says so when it is used
    except CholmodNotPositiveDefiniteError as error:
        raise NotPositiveDefinite(str(error)) from None
    return Factor(found, lambda: np.square(found.L().diagonal()))
