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
from numba import njit

from xfemnav.geometry.mesh import Mesh, frozen_array
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.plane.partition import HERE
from xfemnav.mechanics.rules import Basis
from xfemnav.mechanics.space.angles import centroids, torn, touched_parts, unwrap
from xfemnav.mechanics.space.branch import branch_functions, polar

STANDARD, HEAVISIDE, BRANCH = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Enrichment:
    """One row per scalar basis function; the only map of degrees of freedom (row r, component i -> d r + i).

    node (n,): the node of each row; kind (n,): STANDARD (row i is node i's, on the piece that holds the node),
    HEAVISIDE (a further piece), or BRANCH + l for F_{l+1}, l = 0..3; tip (n,): the tip of a branch row, else -1;
    shift (n,): F_l(x_i) of a branch row, else 0.
    dof (p, d + 1): row of the function of each part's local nodes.
    Branch functions by part, sorted by part: entry_part, entry_node (local), entry_row (of F_1; F_2.. follow),
    entry_angle (unwrapped angle of the part about the tip) (e,), and entry_ramp (e, d + 1): the blending ramp's nodal
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
            ("dof", np.int64, (n, n)),
            ("entry_part", np.int64, (n,)),
            ("entry_node", np.int64, (n,)),
            ("entry_row", np.int64, (n,)),
            ("entry_angle", float, (n,)),
            ("entry_ramp", float, (n, n)),
            ("body", np.int64, (n,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), kind, shape, name))

    @property
    def n_rows(self) -> int:
        """Number of scalar basis functions."""
        return len(self.node)

    @property
    def n_dof(self) -> int:
        """Number of degrees of freedom: d components a basis function."""
        return (self.dof.shape[1] - 1) * self.n_rows

    @cached_property
    def heaviside_nodes(self) -> np.ndarray:
        """Set J: nodes whose support is cut in two or more pieces."""
        return np.unique(self.node[self.kind == HEAVISIDE])

    @cached_property
    def tip_nodes(self) -> np.ndarray:
        """Set K: nodes with branch functions."""
        return np.unique(self.node[self.kind >= BRANCH])


def enrich(mesh: Mesh, split: Parts, basis: Basis = Basis()) -> Enrichment:
    """Find the pieces of every node's support and the nodes that carry branch functions.

    Topological ones are the paper's. Geometric ones have the blending ramp of the corrected XFEM (Fries 2008): R is the
    sum of the nodal shape functions of the nodes near the tip, whose cells' nodes all carry N_i R (F_l - F_l(x_i)).
    """
    dof, node, body = _pieces(mesh, split)
    kind = np.where(np.arange(len(node)) < len(mesh.points), STANDARD, HEAVISIDE)
    rows, entries, first = [], [], len(node)
    if not basis.plain and len(split.fronts.at):
        middle = centroids(split)
        for tip in range(len(split.fronts.at)):
            if basis.geometric:
                own = basis.tip_radius_mm
                radius = own if own is not None else default_radius(mesh, split, tip)
                table = _within_radius(mesh, split, dof, middle, tip, radius)
            else:
                table = _at_tip(mesh, split, dof, middle, tip)
            for i, shift, parts, local, angle, ramp in table:
                rows.append((i, tip, shift))
                entries.append((parts, local, np.full(len(parts), first), angle, ramp))
                first += 4
    part, local, row, angle, ramp = (
        [np.concatenate(column) for column in zip(*entries)]
        if entries
        else (np.empty(0, int), np.empty(0, int), np.empty(0, int), np.empty(0), np.empty((0, dof.shape[1])))
    )
    order = np.argsort(part, kind="stable")
    return Enrichment(
        node=np.concatenate([node, np.repeat([r[0] for r in rows], 4).astype(int)]),
        kind=np.concatenate([kind, np.tile(BRANCH + np.arange(4), len(rows))]),
        tip=np.concatenate([np.full(len(node), -1), np.repeat([r[1] for r in rows], 4).astype(int)]),
        shift=np.concatenate([np.zeros(len(node)), *(r[2] for r in rows)]),
        dof=dof,
        entry_part=part[order],
        entry_node=local[order],
        entry_row=row[order],
        entry_angle=angle[order],
        entry_ramp=ramp[order],
        body=body,
    )


def default_radius(mesh: Mesh, split: Parts, tip: int) -> float:
    """Radius mm of geometric enrichment: a fifth of the cut, but no less than four elements, for short cuts."""
    path = split.paths[split.fronts.cut[tip]]
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    h = mesh.sizes[split.cell[touched_parts(split, tip)]].mean()
    return float(max(length / 5, 4 * h))


def _pieces(mesh, split):
    """Rows of the functions N_i 1_piece: dof (p, d + 1) and the node (n,) of each; and the body (p,) of each part."""
    cells = mesh.cells[split.cell]
    label, body = _connected(cells, split.joins, split.through)
    # The standard row of a node is the piece that holds the node; of several that touch it, the largest that is left.
    node_of = np.empty(label.max() + 1, dtype=int)
    node_of[label] = cells.ravel()
    area = np.bincount(label, np.repeat(np.bincount(split.part, split.volumes, len(cells)), cells.shape[1]))
    holds, gone = np.zeros((2, len(node_of)), dtype=bool)
    holds[label[_held(mesh, split, cells)]] = True
    gone[label] = np.repeat(split.removed, cells.shape[1])
    rank = np.lexsort((np.arange(len(node_of)), -area, gone, ~holds, node_of))
    head = np.concatenate([[True], np.diff(node_of[rank]) != 0])
    row = np.empty(len(node_of), dtype=int)
    row[rank[head]] = node_of[rank[head]]
    row[rank[~head]] = len(mesh.points) + np.arange((~head).sum())
    node = np.concatenate([np.arange(len(mesh.points)), node_of[rank[~head]]])
    return row[label].reshape(cells.shape), node, body


@njit(cache=True)
def _connected(cells, joins, through):
    """Number of the piece that each local node of each part, (d + 1) part + local, is in; and of each part's body."""
    pieces, bodies, n = np.arange(cells.size), np.arange(len(cells)), cells.shape[1]
    for j in range(len(joins)):
        p, q = joins[j]
        _join(bodies, p, q)
        for local in range(n):
            if through[j, local] >= 0:
                _join(pieces, n * p + local, n * q + through[j, local])
    _number(pieces)
    _number(bodies)
    return pieces, bodies


@njit(cache=True)
def _join(parent, a, b):
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    while parent[b] != b:
        parent[b] = parent[parent[b]]
        b = parent[b]
    parent[max(a, b)] = min(a, b)


@njit(cache=True)
def _number(parent):
    """From the tree of each set, whose root comes first, to its number."""
    n = 0
    for a in range(len(parent)):
        if parent[a] == a:
            parent[a] = n
            n += 1
        else:
            parent[a] = parent[parent[a]]


def _held(mesh, split, cells):
    """Flat indices (part, local) of the parts that have the node itself as a corner."""
    corner, n = split.corners.reshape(-1, mesh.dim), mesh.dim + 1
    part = np.repeat(split.part, n)
    tolerance = HERE * mesh.sizes[split.cell[part]]
    found = [n * part[np.linalg.norm(corner - mesh.points[cells[part, a]], axis=1) <= tolerance] + a for a in range(n)]
    return np.unique(np.concatenate(found))


def _at_tip(mesh, split, dof, middle, tip):
    """For each node of the paper's set K: node, F_l(x_i), parts, local nodes, unwrapped angles, ramp (none)."""
    touched = touched_parts(split, tip)
    nodes = _nodes_about(mesh, split.cell[touched], split.fronts.at[tip])
    nodes = [i for i in nodes if not _holds_other_end(mesh, split, tip, i)]
    cells = mesh.cells[split.cell]
    # The functions live on the piece that the tip touches.
    pieces = {int(i): int(dof[p, a]) for p in touched for a, i in enumerate(cells[p]) if i in nodes}
    angle = unwrap(split, middle, tip, np.isin(dof, list(pieces.values())).any(axis=1))
    jumping = torn(split, middle, tip, angle)
    for i, row in sorted(pieces.items()):
        parts, local = np.nonzero(dof == row)
        parts, local = _reached(parts, local, angle)
        if not len(parts) or jumping[parts].any():
            continue
        shift = _shift(mesh, split, middle, angle, tip, i, parts)
        yield i, shift, parts, local, angle[parts], np.ones((len(parts), cells.shape[1]))


def _within_radius(mesh, split, dof, middle, tip, radius):
    """The same for every node within `radius` mm of the tip and, under the ramp, the other nodes of their cells."""
    inner = np.linalg.norm(mesh.points - split.fronts.at[tip], axis=1) < min(radius, _behind(mesh, split, tip))
    inner[_nodes_about(mesh, split.cell[touched_parts(split, tip)], split.fronts.at[tip])] = True
    inner[[i for i in np.flatnonzero(inner) if _holds_other_end(mesh, split, tip, i)]] = False
    cells = mesh.cells[split.cell]
    inside = inner[cells].any(axis=1)
    angle = unwrap(split, middle, tip, inside)
    inner[cells[torn(split, middle, tip, angle)]] = False
    inside = inner[cells].any(axis=1)
    parts, local = np.nonzero(np.repeat((inside & np.isfinite(angle))[:, None], cells.shape[1], axis=1))
    order = np.argsort(cells[parts, local], kind="stable")
    parts, local = parts[order], local[order]
    nodes, start = np.unique(cells[parts, local], return_index=True)
    for i, own_parts, own_local in zip(nodes, np.split(parts, start[1:]), np.split(local, start[1:])):
        standard = own_parts[dof[own_parts, own_local] == i]
        shift = _shift(mesh, split, middle, angle, tip, i, standard if len(standard) else own_parts)
        yield int(i), shift, own_parts, own_local, angle[own_parts], inner[cells[own_parts]].astype(float)


def _behind(mesh, split, tip):
    """Distance mm that keeps the enriched cells before the cut's other end; no limit when that is no tip, but a mouth.

    Beyond the other end the angle about this tip has no cut to jump on.
    """
    end = -1 - split.fronts.end[tip]
    if not ((split.fronts.cut == split.fronts.cut[tip]) & (split.fronts.end == end)).any():
        return np.inf
    other = split.paths[split.fronts.cut[tip]][end]
    h = mesh.sizes[split.cell[touched_parts(split, tip)]].max()
    return np.linalg.norm(other - split.fronts.at[tip]) - 1.5 * h


def _reached(parts, local, angle):
    reached = np.isfinite(angle[parts])
    return parts[reached], local[reached]


def _shift(mesh, split, middle, angle, tip, node, parts):
    """F_l (4,) at the node, on the lip of the nearest of the parts."""
    x = mesh.points[[node]]
    holder = parts[np.argmin(np.linalg.norm(middle[parts] - x, axis=1))]
    r, theta = polar(x, split.fronts.at[[tip]], split.fronts.travel[[tip]], angle[[holder]])
    return branch_functions(r, theta)[0]


def _nodes_about(mesh, cells, x):
    """Nodes whose open support holds the point x, which lies in the closed `cells`."""
    nodes, count = np.unique(mesh.cells[np.unique(cells)], return_counts=True)
    on_node = np.hypot(*(mesh.points[nodes] - x).T) <= HERE * mesh.sizes[cells].min()
    if on_node.any():
        return nodes[on_node].tolist()
    return nodes[count == len(np.unique(cells))].tolist()


def _holds_other_end(mesh, split, tip, node):
    """True when the cut's other end is a tip inside the node's support: the line of the jump would pass beyond it."""
    same = np.flatnonzero((split.fronts.cut == split.fronts.cut[tip]) & (split.fronts.end != split.fronts.end[tip]))
    for other in same:
        touched = split.touch[split.touch[:, 0] == other, 1]
        if node in _nodes_about(mesh, split.cell[touched], split.fronts.at[other]):
            return True
    return False
