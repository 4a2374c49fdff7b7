"""Eq. (4) as the paper writes it, from the coefficients of this basis."""

import numpy as np

from xfemnav.mechanics.space.enrichment import BRANCH, HEAVISIDE
from xfemnav.mechanics.space.space import Space


def paper_coefficients(space: Space, U) -> dict[str, np.ndarray]:
    """The coefficients of Eq. (4) as the paper writes it, from those of this basis, U (n_rows, 2) mm.

    Returns u (n_nodes, 2), a (n_nodes, 2) for set J, c (n_nodes, 4, 2) for set K, zero where a node has none.
    Only for one cut with at most two pieces a node. Raises ValueError otherwise.
    """
    table, n = space.enrichment, len(space.mesh.points)
    U = np.asarray(U)
    c = np.zeros((n, 4, 2))
    branch = table.kind >= BRANCH
    c[table.node[branch], table.kind[branch] - BRANCH] = U[branch]
    u, a = U[:n].copy(), np.zeros((n, 2))
    extra = np.flatnonzero(table.kind == HEAVISIDE)
    if len(np.unique(table.node[extra])) < len(extra):
        raise ValueError("a node has more than two pieces: Eq. (4) has one H a node")
    sign = _row_sides(space)
    i = table.node[extra]
    u[i] = (U[i] + U[extra]) / 2
    a[i] = (U[i] - U[extra]) / 2 * sign[i, None]
    np.subtract.at(u, table.node[branch], table.shift[branch, None] * U[branch])
    return {"u": u, "a": a, "c": c}


def _row_sides(space):
    """H (n_rows,) of the piece of each row: the side of the cut of its largest lip part, 0 away from the cut."""
    lips, side = space.parts.lips, np.zeros(space.enrichment.n_rows)
    length = np.linalg.norm(lips.facets[:, 1] - lips.facets[:, 0], axis=1)
    for column, sign in ((0, 1.0), (1, -1.0)):
        np.add.at(side, space.enrichment.dof[lips.parts[:, column]], sign * length[:, None])
    return np.sign(side)
