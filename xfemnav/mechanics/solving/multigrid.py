"""Conjugate gradients with smoothed aggregation (Vanek, Mandel & Brezina 1996), by PyAMG: for matrices too large to
factor.

Every basis function of the pieces of a cut organ has its node's place, so the rigid motions at the nodes are the near
null space, and enrichment asks for nothing more.
"""

from contextlib import contextmanager

import numpy as np
import pyamg
from scipy.sparse import bsr_matrix, csr_array
from scipy.sparse.linalg import cg

from xfemnav.errors import XfemnavError
from xfemnav.interruption import checkpoint
from xfemnav.mechanics.solving.factor import Factor

#: Relative residual at which an answer is taken.
TOLERANCE = 1e-10
#: Many times as many iterations as any problem took.
MOST = 1000
#: Blocks of a node's unknowns are strongly coupled above this.
STRENGTH = 0.08
#: Nodes of the coarsest level, at most, which is solved directly.
COARSEST = 50


def by_multigrid(A, motions, owner) -> Factor:
    """The inverse of A (n, n), sparse, symmetric and positive definite, by iteration.

    motions (n, m): what A hardly resists, the rigid motions; owner (n,): the node of each unknown. Its `solve` raises
    XfemnavError E407 where it does not converge.
    """
    d = _dimension(motions.shape[1])
    place, size = _places(owner, d)
    A, B = _padded(csr_array(A), place, size, d), np.zeros((size, motions.shape[1]))
    B[place] = motions
    with _same_random_numbers():
        levels = pyamg.smoothed_aggregation_solver(
            A, B=B, strength=("symmetric", {"theta": STRENGTH}), smooth=("jacobi", {"omega": 4 / 3}),
            presmoother=("gauss_seidel", {"sweep": "forward"}), postsmoother=("gauss_seidel", {"sweep": "backward"}),
            improve_candidates=None, max_coarse=COARSEST)
    inverse = levels.aspreconditioner(cycle="V")

    def one(b):
        padded = np.zeros(size)
        padded[place] = b
        found, failed = cg(A, padded, rtol=TOLERANCE, atol=0.0, maxiter=MOST, M=inverse,
                           callback=lambda _: checkpoint())
        if failed:
            raise XfemnavError("E407", f"conjugate gradients did not converge in {MOST} iterations; are some tissues "
                                       "1e6 times as stiff as others? If not, this is a bug: please report it with the "
                                       "run's parameters.")
        return found[place]

    def solve(b):
        b = np.asarray(b, float)
        return one(b) if b.ndim == 1 else np.stack([one(each) for each in b.T], axis=1).reshape(b.shape)

    return Factor(solve, iterated=True)


def _dimension(n_motions):
    """d of d (d + 1) / 2 rigid motions."""
    return int((np.sqrt(8 * n_motions + 1) - 1) / 2)


def _places(owner, d):
    """Where each unknown goes (n,) that every node has d, in the order of the nodes; and how many these are."""
    order = np.argsort(owner, kind="stable")
    _, first, count = np.unique(owner[order], return_index=True, return_counts=True)
    rank = np.arange(len(owner)) - np.repeat(first, count)
    blocks = -(-count // d)
    start = np.cumsum(blocks) - blocks
    place = np.empty(len(owner), int)
    place[order] = d * np.repeat(start, count) + rank
    return place, int(d * blocks.sum())


def _padded(A, place, size, d):
    """A (n, n) with its unknowns at their places, in blocks of d, and as stiff as the rest where there are none."""
    free = np.ones(size, bool)
    free[place] = False
    free = np.flatnonzero(free)
    rows = np.repeat(place, np.diff(A.indptr))
    at = np.concatenate([rows, free]), np.concatenate([place[A.indices], free])
    data = np.concatenate([A.data, np.full(len(free), A.diagonal().mean())])
    return bsr_matrix(csr_array((data, at), (size, size)), blocksize=(d, d))


@contextmanager
def _same_random_numbers():
    """PyAMG estimates spectral radii from random vectors: from the same ones every time."""
    state = np.random.get_state()  # noqa: NPY002 - those of PyAMG are global
    np.random.seed(0)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002
