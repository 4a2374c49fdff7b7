"""Changes of basis U = T q that keep the system small and well conditioned.

With geometric enrichment the four functions of Eq. (3) at every node, for both components, are nearly dependent: two
*vector* functions a node, the leading displacement fields of mode I and mode II, span what matters. Then the block of K
of each node with branch functions is scaled by its inverse square root, and all other unknowns by their diagonal (the
pieces of a node do not overlap): that gives the conditioning of plain finite elements.
"""

from collections.abc import Iterator

import numpy as np
from scipy.sparse import csc_array, csr_array

from xfemnav.mechanics.space.angles import touched_parts
from xfemnav.mechanics.space.enrichment import BRANCH, Enrichment
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, Tissue

#: Directions of a node's block that are weaker than this, relative to its strongest, follow from the others.
RANK = 1e-10


def mode_combinations(kappa: float) -> np.ndarray:
    """M (2 modes, 4 functions, 2 components), tip frame: mode m displaces in proportion to sum_l M_ml F_l."""
    M = np.zeros((2, 4, 2))
    M[0, 1, 0], M[0, 2, 0], M[0, 0, 1], M[0, 3, 1] = kappa - 1, 1, kappa + 1, -1
    M[1, 0, 0], M[1, 3, 0], M[1, 1, 1], M[1, 2, 1] = kappa + 1, 1, 1 - kappa, 1
    return M


def tip_frame(travel) -> np.ndarray:
    """Rows (2, 2): the tip's own axes, along the cut's travel and to its left."""
    return np.array([travel, [-travel[1], travel[0]]])


def vector_tip_basis(space: Space, material: Material | Tissue) -> csc_array:
    """T (n_dof, n): the identity, but two columns (mode I, mode II) for the eight branch DOFs of each node and tip."""
    table = space.enrichment
    first = np.flatnonzero(table.kind == BRANCH)
    n_plain = 2 * int((table.kind < BRANCH).sum())
    split = space.parts
    # A tip on an edge between two materials takes the first: the span is a choice, not the law.
    cells = [split.cell[touched_parts(split, tip)[0]] for tip in range(len(split.fronts.at))]
    modes = np.array([mode_combinations(material.at(cell).kappa) for cell in cells]).reshape(-1, 2, 4, 2)
    frames = np.array([tip_frame(travel) for travel in space.parts.fronts.travel]).reshape(-1, 2, 2)
    blocks = np.einsum("fmlj,fji->flim", modes[table.tip[first]], frames[table.tip[first]])
    rows = 2 * (first[:, None] + np.arange(4))[:, :, None, None] + np.arange(2)[:, None]
    columns = n_plain + 2 * np.arange(len(first))[:, None, None, None] + np.arange(2)
    rows, columns = np.broadcast_arrays(rows, columns)
    data = np.concatenate([np.ones(n_plain), blocks.ravel()])
    at = (np.concatenate([np.arange(n_plain), rows.ravel()]), np.concatenate([np.arange(n_plain), columns.ravel()]))
    return csc_array((data, at), (table.n_dof, n_plain + 2 * len(first)))


def owners(table: Enrichment, T: csc_array) -> np.ndarray:
    """Block (n,) of each column of T: its node where that has branch functions, else a block of its own."""
    row = T.tocsc().indices[T.tocsc().indptr[:-1]] // 2
    node = table.node[row]
    alone = ~np.isin(node, table.tip_nodes)
    return np.where(alone, len(table.node) + np.arange(len(row)), node)


def node_blocks(K: csc_array, owner) -> csr_array:
    """P (n, m) with P'KP = 1 on every node's own block; directions without stiffness of their own are left out.

    K (n, n) symmetric; owner (n,) the block of each unknown, from `owners`. Unknowns that are alone are only scaled.
    """
    coo = K.tocoo()
    same = owner[coo.row] == owner[coo.col]
    i, j, values = coo.row[same], coo.col[same], coo.data[same]
    rows, columns, data, n_columns = [], [], [], 0
    for unknown in blocks(owner):
        index, place = np.full((2, len(owner)), -1)
        index[unknown], place[unknown] = np.arange(len(unknown))[:, None], np.arange(unknown.shape[1])
        own = index[i] >= 0
        dense = np.zeros((*unknown.shape, unknown.shape[1]))
        np.add.at(dense, (index[i[own]], place[i[own]], place[j[own]]), values[own])
        P = inverse_roots(dense)
        strong = P.any(axis=1)
        column = n_columns + np.cumsum(strong.ravel()).reshape(strong.shape) - 1
        keep = np.broadcast_to(strong[:, None, :], P.shape)
        rows.append(np.broadcast_to(unknown[:, :, None], P.shape)[keep])
        columns.append(np.broadcast_to(column[:, None, :], P.shape)[keep])
        data.append(P[keep])
        n_columns += int(strong.sum())
    at = (np.concatenate(rows), np.concatenate(columns))
    return csr_array((np.concatenate(data), at), (len(owner), n_columns))


def blocks(owner) -> Iterator[np.ndarray]:
    """The unknowns (b, size) of the blocks of each size; owner (n,): the block of each unknown."""
    order = np.argsort(owner, kind="stable")
    _, start, count = np.unique(owner[order], return_index=True, return_counts=True)
    for size in np.unique(count):
        yield order[start[count == size][:, None] + np.arange(size)]


def inverse_roots(K) -> np.ndarray:
    """P (b, n, n) with P'KP = 1 for each of K (b, n, n); its columns without stiffness of their own are zero."""
    # Slivers differ from whole pieces by many orders of magnitude: compare directions at unit diagonal.
    jacobi = 1 / np.sqrt(np.einsum("bii->bi", K))
    values, vectors = np.linalg.eigh(K * jacobi[:, :, None] * jacobi[:, None, :])
    strong = values > RANK * values[:, -1:]
    inverse_root = np.where(strong, 1 / np.sqrt(np.where(strong, values, 1.0)), 0.0)
    return jacobi[:, :, None] * vectors * inverse_root[:, None, :]
