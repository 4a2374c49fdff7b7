"""The table of basis functions: which node carries which function, and where it lives.

A *piece* is a connected component of a node's support: parts of cells joined across facets that are not cut. Every
(node, piece) is one basis function N_i 1_piece. A node in one piece has the nodal shape function of Eq. (1); a node
in two pieces is in set J, and its two functions span {N_i, N_i H} (Eq. 2); m pieces give m functions. A node whose
support holds a tip is in set K and has the four products N_i F_l besides (Eq. 3). For a straight cut through convex
supports this is Eq. (4): 2, 4 or 10 degrees of freedom a node.

Branch functions are shifted, N_i (F_l - F_l(x_i)): the span is the same, and the standard coefficients are then the
nodal displacements.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from xfemnav.geometry.mesh import Mesh, frozen_array
from xfemnav.geometry.partition import REACH
from xfemnav.geometry.subcells import Subcells
from xfemnav.mechanics.branch import branch_functions, polar

STANDARD, HEAVISIDE, BRANCH = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Enrichment:
    """One row per scalar basis function; the only map of degrees of freedom (row r, component i -> 2 r + i).

    node (n,): the node of each row; kind (n,): STANDARD (row i is node i's, on the piece that holds the node),
    HEAVISIDE (a further piece), or BRANCH + l for F_{l+1}, l = 0..3; tip (n,): the tip of a branch row, else -1;
    shift (n,): F_l(x_i) of a branch row, else 0.
    dof (p, 3): row of the function of each part's local nodes.
    Branch functions by part, sorted by part: entry_part, entry_node (local), entry_row (of F_1; F_2.. follow),
    entry_angle (unwrapped angle of the part about the tip) (e,), and entry_ramp (e, 3): the blending ramp's nodal
    values on the part's cell, all 1 where there is none.
    body (p,): connected piece of the organ that each part belongs to.
    """

    node: np.ndarray
    kind: np.ndarray
    tip: np.ndarray
    shift: np.ndarray
    dof: np.ndarray
    entry_part: np.ndarray
    entry_node: np.ndarray
    entry_row: np.ndarray
    entry_angle: np.ndarray
    entry_ramp: np.ndarray
    body: np.ndarray

    def __post_init__(self):
        n = None
        for name, kind, shape in (
            ("node", np.int64, (n,)),
            ("kind", np.int8, (n,)),
            ("tip", np.int64, (n,)),
            ("shift", float, (n,)),
            ("dof", np.int64, (n, 3)),
            ("entry_part", np.int64, (n,)),
            ("entry_node", np.int64, (n,)),
            ("entry_row", np.int64, (n,)),
            ("entry_angle", float, (n,)),
            ("entry_ramp", float, (n, 3)),
            ("body", np.int64, (n,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), kind, shape, name))

    @property
    def n_rows(self) -> int:
        """Number of scalar basis functions."""
        return len(self.node)

    @property
    def n_dof(self) -> int:
        """Number of degrees of freedom: two components a basis function."""
        return 2 * self.n_rows

    @cached_property
    def heaviside_nodes(self) -> np.ndarray:
        """Set J: nodes whose support is cut in two or more pieces."""
        return np.unique(self.node[self.kind == HEAVISIDE])

    @cached_property
    def tip_nodes(self) -> np.ndarray:
        """Set K: nodes with branch functions."""
        return np.unique(self.node[self.kind >= BRANCH])


def enrich(mesh: Mesh, subcells: Subcells, tip_enrichment: str = "topological") -> Enrichment:
    """Find the pieces of every node's support and the nodes that hold a tip.

    tip_enrichment: 'topological' (the paper's: nodes whose support holds the tip) or 'none'.
    """
    n_nodes = len(mesh.points)
    dof, node, pieces_of = _pieces(mesh, subcells)
    kind = np.where(np.arange(len(node)) < n_nodes, STANDARD, HEAVISIDE)
    body = _bodies(subcells)
    tables, first = [], len(node)
    if tip_enrichment != "none":
        adjacency = _adjacency(subcells)
        centroids = _centroids(subcells)
        for tip in range(len(subcells.tips)):
            for table in _tip_entries(mesh, subcells, dof, pieces_of, adjacency, centroids, tip):
                tables.append((tip, first, *table))
                first += 4
    branch_node = np.array([t[2] for t in tables], dtype=int)
    shift = np.array([t[3] for t in tables]).reshape(-1, 4)
    parts = [t[4] for t in tables]
    lengths = [len(p) for p in parts]
    entry_part = np.concatenate(parts) if parts else np.empty(0, int)
    order = np.argsort(entry_part, kind="stable")
    entry_node = np.concatenate([t[5] for t in tables]) if parts else np.empty(0, int)
    entry_angle = np.concatenate([t[6] for t in tables]) if parts else np.empty(0)
    entry_row = np.repeat([t[1] for t in tables], lengths).astype(int)
    return Enrichment(
        node=np.concatenate([node, np.repeat(branch_node, 4)]),
        kind=np.concatenate([kind, np.tile(BRANCH + np.arange(4), len(tables))]),
        tip=np.concatenate([np.full(len(node), -1), np.repeat([t[0] for t in tables], 4)]),
        shift=np.concatenate([np.zeros(len(node)), shift.ravel()]),
        dof=dof,
        entry_part=entry_part[order],
        entry_node=entry_node[order],
        entry_row=entry_row[order],
        entry_angle=entry_angle[order],
        entry_ramp=np.ones((len(order), 3)),
        body=body,
    )


def _pieces(mesh, subcells):
    """Rows of the functions N_i 1_piece: dof (p, 3), node (n,), and (part, local) -> row through `dof`."""
    cells = mesh.cells[subcells.part_cell]
    p, q, i, k = subcells.joins.T
    across = i >= 0
    pairs = []
    for nodes in (i, k):
        a, b = p[across], q[across]
        pairs.append((3 * a + _local(cells, a, nodes[across]), 3 * b + _local(cells, b, nodes[across])))
    for local in range(3):
        pairs.append((3 * p[~across] + local, 3 * q[~across] + local))
    one, two = (np.concatenate(side) for side in zip(*pairs))
    size = 3 * len(cells)
    _, label = connected_components(coo_array((np.ones(len(one), bool), (one, two)), (size, size)), directed=False)
    # The standard row of a node is the piece that holds the node; of several that touch it, the largest.
    node_of = np.empty(label.max() + 1, dtype=int)
    node_of[label] = cells.ravel()
    area = np.bincount(label, np.repeat(np.bincount(subcells.part, subcells.areas, len(cells)), 3))
    holds = np.zeros(len(node_of), dtype=bool)
    holds[label[_held(mesh, subcells, cells)]] = True
    rank = np.lexsort((np.arange(len(node_of)), -area, ~holds, node_of))
    head = np.concatenate([[True], np.diff(node_of[rank]) != 0])
    row = np.empty(len(node_of), dtype=int)
    row[rank[head]] = node_of[rank[head]]
    row[rank[~head]] = len(mesh.points) + np.arange((~head).sum())
    node = np.concatenate([np.arange(len(mesh.points)), node_of[rank[~head]]])
    return row[label].reshape(-1, 3), node, row


def _local(cells, parts, nodes):
    return np.argmax(cells[parts] == nodes[:, None], axis=1)


def _held(mesh, subcells, cells):
    """Flat indices (part, local) of the parts that have the node itself as a corner."""
    corner = subcells.corners.reshape(-1, 2)
    part = np.repeat(subcells.part, 3)
    tolerance = REACH * mesh.sizes[subcells.part_cell[part]]
    found = [3 * part[np.hypot(*(corner - mesh.points[cells[part, a]]).T) <= tolerance] + a for a in range(3)]
    return np.unique(np.concatenate(found))


def _bodies(subcells):
    _, body = connected_components(_adjacency(subcells), directed=False)
    return body


def _adjacency(subcells):
    p, q = subcells.joins[:, 0], subcells.joins[:, 1]
    n = subcells.n_parts
    return coo_array((np.ones(len(p)), (p, q)), (n, n)).tocsr()


def _centroids(subcells):
    weight = np.bincount(subcells.part, subcells.areas, subcells.n_parts)
    middle = subcells.corners.mean(axis=1) * subcells.areas[:, None]
    return (
        np.stack([np.bincount(subcells.part, middle[:, i], subcells.n_parts) for i in (0, 1)], axis=1) / weight[:, None]
    )


def _tip_entries(mesh, subcells, dof, pieces_of, adjacency, centroids, tip):
    """For each node of set K: (node, F_l(x_i), parts, local nodes, unwrapped angles of the parts)."""
    x, travel = subcells.tips[tip], subcells.tip_travel[tip]
    touched = subcells.tip_touch[subcells.tip_touch[:, 0] == tip, 1]
    nodes = _nodes_about(mesh, subcells.part_cell[touched], x)
    nodes = [i for i in nodes if not _holds_other_end(mesh, subcells, tip, i)]
    cells = mesh.cells[subcells.part_cell]
    pieces = {}
    for p in touched:
        for a in range(3):
            if cells[p, a] in nodes:
                pieces.setdefault(int(cells[p, a]), int(dof[p, a]))
    inside = np.isin(dof, list(pieces.values())).any(axis=1)
    angle = _unwrap(adjacency, centroids, touched, inside, x, travel)
    tables = []
    for i, row in sorted(pieces.items()):
        parts, local = np.nonzero(dof == row)
        reached = np.isfinite(angle[parts])
        parts, local = parts[reached], local[reached]
        holder = parts[np.argmin(np.linalg.norm(centroids[parts] - mesh.points[i], axis=1))]
        r, theta = polar(mesh.points[[i]], x[None], travel[None], angle[[holder]])
        tables.append((i, branch_functions(r, theta)[0], parts, local, angle[parts]))
    return tables


def _nodes_about(mesh, cells, x):
    """Nodes whose open support holds the point x, which lies in the closed `cells`."""
    nodes, count = np.unique(mesh.cells[np.unique(cells)], return_counts=True)
    on_node = np.hypot(*(mesh.points[nodes] - x).T) <= REACH * mesh.sizes[cells].min()
    if on_node.any():
        return nodes[on_node].tolist()
    return nodes[count == len(np.unique(cells))].tolist()


def _holds_other_end(mesh, subcells, tip, node):
    """True when the cut's other end is a tip inside the node's support: the line of the jump would pass beyond it."""
    same = np.flatnonzero((subcells.tip_cut == subcells.tip_cut[tip]) & (subcells.tip_end != subcells.tip_end[tip]))
    for other in same:
        touched = subcells.tip_touch[subcells.tip_touch[:, 0] == other, 1]
        if node in _nodes_about(mesh, subcells.part_cell[touched], subcells.tips[other]):
            return True
    return False


def _unwrap(adjacency, centroids, start, inside, x, travel):
    """Angle (p,) of each part about the tip, continuous except across the cut; NaN where not reached."""
    raw = np.arctan2(travel[0] * (centroids - x)[:, 1] - travel[1] * (centroids - x)[:, 0], (centroids - x) @ travel)
    angle = np.full(len(centroids), np.nan)
    angle[start] = raw[start]
    some = np.flatnonzero(inside)
    index = np.full(len(centroids), -1)
    index[some] = np.arange(len(some))
    near = adjacency[some][:, some]
    near = near + near.T
    for s in start:
        if index[s] < 0:
            continue
        order, before = breadth_first_order(near, index[s], directed=False)
        for k in order[1:]:
            p, q = some[k], some[before[k]]
            if np.isnan(angle[p]):
                angle[p] = angle[q] + np.mod(raw[p] - angle[q] + np.pi, 2 * np.pi) - np.pi
    return angle
