"""Linear conditions on the degrees of freedom: C U = d and their exact elimination, G U + gap >= 0, means of zero."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq, qr, solve_triangular
from scipy.sparse import csc_array, csr_array, vstack
from scipy.sparse.csgraph import connected_components

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array

SKULL = -1
#: A condition whose part independent of the others is smaller than this follows from them.
DEPENDENT = 1e-10


@dataclass(frozen=True, eq=False)
class Constraints:
    """Conditions C U = d: `C` (m, n_dof) sparse, `d` (m,) mm; `group` (m,) is the retraction's index or SKULL."""

    C: csr_array
    d: np.ndarray
    group: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "C", csr_array(self.C))
        object.__setattr__(self, "d", frozen_array(self.d, float, (self.C.shape[0],), "d"))
        object.__setattr__(self, "group", frozen_array(self.group, np.int64, (self.C.shape[0],), "group"))


@dataclass(frozen=True, eq=False)
class Contacts:
    """Conditions G U + gap >= 0 mm: `G` (g, n_dof) sparse, `gap` (g,) mm at rest.

    Each is a mean over a hat: `cut` (g,) the cut whose lips it keeps apart, SKULL between outline and skull; `points`
    (g, d) mm its place; `hats` (g, 3) mm where the hat begins, peaks and ends along the cut, or beside the point of
    the outline.
    """

    G: csr_array
    gap: np.ndarray
    cut: np.ndarray
    points: np.ndarray
    hats: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "G", csr_array(self.G))
        g = self.G.shape[0]
        for name, kind, shape in (
            ("gap", float, (g,)),
            ("cut", np.int64, (g,)),
            ("points", float, (g, None)),
            ("hats", float, (g, 3)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), kind, shape, name))

    @property
    def lengths(self) -> np.ndarray:
        """Length (g,) mm on which each condition's force acts: the hat's integral."""
        return (self.hats[:, 2] - self.hats[:, 0]) / 2


@dataclass(frozen=True, eq=False)
class Means:
    """Conditions C U = 0, `C` (m, n_dof), on bodies that move freely without them, with rows over a whole body.

    `pins` (m,): as many degrees of freedom; with these at rest no body can move rigidly.
    """

    C: csr_array
    pins: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "C", csr_array(self.C))
        object.__setattr__(self, "pins", frozen_array(self.pins, np.int64, (self.C.shape[0],), "pins"))


def stack(parts: list[Constraints], n_dof: int) -> Constraints:
    """All conditions of several lists as one."""
    parts = [p for p in parts if len(p.d)]
    if len(parts) < 2:
        return parts[0] if parts else Constraints(csr_array((0, n_dof)), np.empty(0), np.empty(0))
    return Constraints(
        vstack([p.C for p in parts], format="csr"),
        np.concatenate([p.d for p in parts]),
        np.concatenate([p.group for p in parts]),
    )


def vector_rows(B, values, group: int) -> Constraints:
    """Conditions u_i = value_i, all components, from scalar rows B (k, n_rows) and values (k, d) mm; row d k + i."""
    values = np.asarray(values, float)
    C = each_component(B, values.shape[1])
    return Constraints(C, values.ravel(), np.full(C.shape[0], group))


def each_component(B, d: int) -> csr_array:
    """B (k, n) for each component of a vector by itself, (d k, d n): entry (r, c) becomes (d r + i, d c + i)."""
    B = csr_array(B)
    count = np.diff(B.indptr)
    at = np.arange(B.nnz) + (d - 1) * np.repeat(B.indptr[:-1], count)
    data, indices = np.empty(d * B.nnz), np.empty(d * B.nnz, dtype=B.indices.dtype)
    for i in range(d):
        data[at], indices[at] = B.data, d * B.indices + i
        at = at + np.repeat(count, count)
    starts = np.concatenate([[0], np.cumsum(np.repeat(count, d))])
    return csr_array((data, indices, starts), (d * B.shape[0], d * B.shape[1]))


def normal_rows(B, normals, values, group: int) -> Constraints:
    """Conditions n . u = value from scalar rows B (k, n_rows), unit normals (k, d), values (k,) mm."""
    B, d = csr_array(B), np.shape(normals)[1]
    data = B.data[:, None] * np.repeat(normals, np.diff(B.indptr), axis=0)
    columns = d * B.indices[:, None] + np.arange(d, dtype=B.indices.dtype)
    C = csr_array((data.ravel(), columns.ravel(), d * B.indptr), (B.shape[0], d * B.shape[1]))
    return Constraints(C, values, np.full(C.shape[0], group))


def eliminate(constraints: Constraints) -> tuple[np.ndarray, csc_array]:
    """All U that satisfy C U = d, as U = U0 + T q: U0 (n_dof,) mm, T (n_dof, n_free) with orthonormal columns.

    Conditions on a single degree of freedom fix it; the others are solved block by block with a pivoted QR
    factorisation, so redundant conditions do no harm. Raises XfemnavError E403 where conditions contradict each other.
    """
    C, d = constraints.C.tocsr(), np.array(constraints.d)
    n_dof = C.shape[1]
    C.eliminate_zeros()
    U0, fixed = np.zeros(n_dof), np.zeros(n_dof, dtype=bool)
    single = np.flatnonzero(np.diff(C.indptr) == 1)
    at = C.indices[C.indptr[single]]
    U0[at] = d[single] / C.data[C.indptr[single]]
    fixed[at] = True
    refuse_contradiction(C[single] @ U0 - d[single], d)
    rest = np.setdiff1d(np.arange(len(d)), single)
    C, d = C[rest], d[rest] - C[rest] @ U0
    size = _row_norms(C)
    C = csr_array(C @ csr_array((np.where(fixed, 0.0, 1.0), (np.arange(n_dof), np.arange(n_dof))), (n_dof, n_dof)))
    C.eliminate_zeros()
    # A row that acts on fixed unknowns alone, but for rounding, holds or contradicts them.
    settled = _row_norms(C) <= DEPENDENT * size
    refuse_contradiction(d[settled] / size[settled], constraints.d)
    C, d = C[np.flatnonzero(~settled)], d[~settled]
    fixed[np.unique(C.indices)] = True
    untouched = np.flatnonzero(~fixed)
    rows, columns, data = [untouched], [np.arange(len(untouched))], [np.ones(len(untouched))]
    n_free = len(untouched)
    alone = _alone(C)
    for block_columns, normals, own in _by_width(C, np.flatnonzero(alone)):
        size = np.linalg.norm(normals, axis=1)
        U0[block_columns] = normals * (d[own] / size**2)[:, None]
        Z = _complements(normals / size[:, None])
        at = n_free + np.arange(Z.shape[0] * Z.shape[2]).reshape(len(Z), 1, -1)
        each = np.broadcast_arrays(block_columns[:, :, None], at, Z)
        for found, own in zip((rows, columns, data), each):
            found.append(own.ravel())
        n_free += at.size
    C, d = C[np.flatnonzero(~alone)], d[~alone]
    for block_rows, block_columns in _blocks(C):
        c = C[block_rows][:, block_columns].toarray()
        scale = np.linalg.norm(c, axis=1)
        Q, R, pivot = qr((c / scale[:, None]).T, pivoting=True)
        rank = int((np.abs(np.diag(R)) > DEPENDENT).sum())
        target = (d[block_rows] / scale)[pivot]
        y = solve_triangular(R[:rank, :rank], target[:rank], trans="T")
        refuse_contradiction(R[:rank, rank:].T @ y - target[rank:], target)
        U0[block_columns] = Q[:, :rank] @ y
        Z = Q[:, rank:]
        rows.append(np.repeat(block_columns, Z.shape[1]))
        columns.append(np.tile(n_free + np.arange(Z.shape[1]), Z.shape[0]))
        data.append(Z.ravel())
        n_free += Z.shape[1]
    T = csc_array((np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))), (n_dof, n_free))
    return U0, T


def _alone(C):
    """Rows (m,) bool of which no other row has an unknown."""
    shared = np.bincount(C.indices, minlength=C.shape[1]) > 1
    return np.bincount(np.repeat(np.arange(C.shape[0]), np.diff(C.indptr)), shared[C.indices], C.shape[0]) == 0


def _by_width(C, rows):
    """Of those rows each kind with w entries: the unknowns (k, w), their factors (k, w), and which rows (k,)."""
    for width in np.unique(np.diff(C.indptr)[rows]):
        own = rows[np.diff(C.indptr)[rows] == width]
        at = C.indptr[own][:, None] + np.arange(width)
        yield C.indices[at], C.data[at], own


def _complements(normals):
    """Orthonormal directions (k, w, w - 1) across unit vectors (k, w): Householder's reflection of each to its largest
    axis, without that."""
    k, w = normals.shape
    largest = np.abs(normals).argmax(axis=1)
    turned = normals.copy()
    turned[np.arange(k), largest] += np.sign(normals[np.arange(k), largest])
    H = np.eye(w) - 2 * turned[:, :, None] * turned[:, None] / (turned**2).sum(axis=1)[:, None, None]
    others = (largest[:, None] + 1 + np.arange(w - 1)) % w
    return np.take_along_axis(H, others[:, None], axis=2)


def _row_norms(C):
    return np.sqrt(C.multiply(C).sum(axis=1))


def _blocks(C):
    """Groups of rows that share columns: (rows, columns) of each."""
    if not C.nnz:
        return
    n, label = connected_components((abs(C) @ abs(C).T), directed=False)
    for k in range(n):
        rows = np.flatnonzero(label == k)
        columns = np.unique(C[rows].indices)
        if len(columns):
            yield rows, columns


def refuse_contradiction(mismatch, d) -> None:
    """Raise E403 where conditions are missed by `mismatch` (k,) mm, of what `d` (m,) mm asks."""
    if len(mismatch) and np.abs(mismatch).max() > 1e-6 * max(1.0, np.abs(d).max(initial=0)):
        raise XfemnavError(
            "E403",
            f"two conditions on the same tissue differ by {np.abs(mismatch).max():.3g} mm; "
            "give each lip one blade over each span, and hold no lip where the skull is fixed.",
        )


def multipliers(constraints: Constraints, reaction) -> np.ndarray:
    """Forces lambda (m,) of the conditions on the lips from the unbalanced nodal forces (n_dof,) = C' lambda.

    Conditions of the skull count only where they act on the same unknowns as a lip's; elsewhere their entry is 0.
    """
    C = constraints.C.tocsr()
    columns = np.unique(C[np.flatnonzero(constraints.group != SKULL)].indices)
    rows = np.flatnonzero(np.diff(C[:, columns].tocsr().indptr))
    dense = C[rows][:, columns].toarray()
    scale = np.linalg.norm(dense, axis=1)
    forces = np.zeros(C.shape[0])
    solution, *_ = lstsq((dense / scale[:, None]).T, reaction[columns], cond=1e-12, lapack_driver="gelsy")
    forces[rows] = solution / scale
    return forces
