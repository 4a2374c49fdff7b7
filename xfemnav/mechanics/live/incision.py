"""A cut in a condensed organ: few unknowns, solved densely, for all data of its lips at once.

Unknown are the basis functions of the cells that the cut changes and of the outline about it. Everything else acts on
them by a stiffness that does not depend on the cut (`condensation`). The answer is linear in what the lips do: unit
displacements of each held lip, along each axis and along its own normal, are solved once, and any other data combine
them. Pressing lips add unit forces of their hats, and the active set of the batch chooses among those.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from xfemnav.errors import XfemnavError
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.window import Window, window
from xfemnav.mechanics.conditions.constraints import Constraints
from xfemnav.mechanics.conditions.placing import functions_on, open_mouths, place
from xfemnav.mechanics.conditions.skull import refuse_mouths, skull_conditions
from xfemnav.mechanics.live.condensation import Condensation, chosen, with_rim
from xfemnav.mechanics.rules import Basis
from xfemnav.mechanics.solving.tip_basis import blocks, inverse_roots, vector_tip_basis
from xfemnav.mechanics.space.enrichment import HEAVISIDE, Enrichment
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, plain_blocks, stiffness_of_parts


class OutOfReach(Exception):
    """The cut changes what the organ was condensed with: the skull's hold on nodes far from the plan."""


class CutThrough(Exception):
    """The cut takes a piece off: what holds it is a question for the whole organ."""


@dataclass(frozen=True, eq=False)
class Incision:
    """A cut in a condensed organ.

    space: mesh, split and basis of the `window` about the cut, whose rim is that of the organ;
    rows (a,): its basis functions that are unknown here; number (n_dof,) the unknown of each degree of freedom;
    give (2 k, 2 k): lower Cholesky factor of the uncut organ's compliance, mm per mN per mm, at the first k rows, the
    nodes, and stiff (2 k, 2 k) kPa the inverse of that compliance; A (n, n) kPa: stiffness of the unknowns q, and
    R (2 a, n) the map u = R q; skull: conditions of the skull that are no plain zeros.
    """

    organ: Condensation
    cuts: tuple[Cut, ...]
    window: Window
    space: Space
    rows: np.ndarray
    number: np.ndarray
    give: np.ndarray
    stiff: np.ndarray
    A: np.ndarray
    R: "Mixing"
    skull: Constraints

    def local(self, C) -> np.ndarray:
        """Conditions (m, n_dof) of the window as a matrix (m, 2 a) on the unknowns; they act on no other."""
        C = C.tocoo()
        dense = np.zeros((C.shape[0], 2 * len(self.rows)))
        np.add.at(dense, (C.row, self.number[C.col]), C.data)
        return dense

    def unbalanced(self, u, U) -> np.ndarray:
        """Forces (2 a, k) mN per mm by which the organ resists the unknowns u (2 a, k) mm more than A tells, when its
        nodes move by U (n_nodes, 2, k) mm, as `expand` has them: the rounding of the condensed stiffness."""
        k, n = len(self.give), len(self.organ.mesh.points)
        nodes = self.window.nodes[self.rows[: k // 2]]
        own = self.organ.stiffness[(2 * nodes[:, None] + np.arange(2)).ravel()]
        force = np.zeros(u.shape)
        force[:k] = own @ U.reshape(2 * n, -1) - self.stiff @ u[:k]
        return force

    def expand(self, u) -> tuple[np.ndarray, np.ndarray]:
        """All coefficients from the unknowns u (2 a, k) mm: those of the organ's nodes (n_nodes, 2, k), and of the
        window's basis (n_rows, 2, k)."""
        k = len(self.give) // 2
        nodes = self.window.nodes[self.rows[:k]]
        forces = np.zeros((len(self.organ.mesh.points), 2, u.shape[1]))
        forces[nodes] = lapack.dpotrs(self.give, u[: 2 * k], lower=True)[0].reshape(k, 2, -1)
        U = self.organ.solve(forces)
        U[nodes] = u[: 2 * k].reshape(k, 2, -1)
        own = np.zeros((self.space.enrichment.n_rows, 2, u.shape[1]))
        own[: len(self.window.nodes)] = U[self.window.nodes]
        own[self.rows] = u.reshape(len(self.rows), 2, -1)
        return U, own


@dataclass(frozen=True, eq=False)
class Mixing:
    """u = R q: the unknowns `plain` (p,) of u are the first of q, those of `tips` (t,) are mixed from the rest by `mix`
    (t, n). Unknowns in neither are zero."""

    size: int
    plain: np.ndarray
    tips: np.ndarray
    mix: np.ndarray

    def __matmul__(self, q):
        u = np.zeros((self.size, *q.shape[1:]))
        u[self.plain], u[self.tips] = q[: len(self.plain)], self.mix @ q[len(self.plain) :]
        return u

    def rows(self, C) -> np.ndarray:
        """C R (m, n) of rows C (m, size)."""
        return np.concatenate([C[:, self.plain], C[:, self.tips] @ self.mix], axis=1)


def incise(organ: Condensation, cuts: tuple[Cut, ...], basis: Basis = Basis()) -> Incision:
    """Cut the organ. Raises OutOfReach, CutThrough, XfemnavError E302, E407."""
    refuse_mouths(organ.skull, cuts)
    space, part = _space(organ, cuts, basis)
    mesh, table, split = space.mesh, space.enrichment, space.parts
    material = _restricted(organ.material, part.cells)
    mouths = open_mouths(split, cuts)
    if not organ.reaches(mouths):
        raise OutOfReach
    outline = skull_conditions(space, organ.skull, mouths, material)
    held = np.zeros(table.n_rows)
    held[: len(mesh.points)] = organ.held[part.nodes]
    fixed, skull = _live(outline.constraints, np.repeat(held, 2))
    # Where a basis function is new, all parts of the cell are integrated anew.
    n = len(mesh.points)
    new = (table.dof >= n).any(axis=1)
    new[table.entry_part] = True
    cells = np.zeros(len(mesh.cells), dtype=bool)
    cells[split.cell[new]] = True
    parts = cells[split.cell]
    needed = np.zeros(table.n_rows, dtype=bool)
    for rows in (table.dof[parts], table.dof[split.lips.parts], table.entry_row[:, None] + np.arange(4),
                 mesh.cells[cells], fixed // 2, skull.C.indices // 2, outline.springs.indices // 2):
        needed[rows] = True
    if needed[held > 0].any():
        raise OutOfReach
    rows = np.flatnonzero(needed)
    number = np.full(2 * table.n_rows, -1)
    number[(2 * rows[:, None] + np.arange(2)).ravel()] = np.arange(2 * len(rows))
    nodes = rows[rows < n]
    give, stiff = _resistance(organ, part, nodes)
    outside = stiff - _plain(mesh, material, np.flatnonzero(cells), nodes)
    plain, tips = _order(table, rows, number[fixed])
    stiffness = stiffness_of_parts(space, material, parts), outline.springs
    K = _gathered(np.concatenate([plain, tips]), number, outside, stiffness)
    A, R = _mixed(space, material, basis, rows, K, plain, tips)
    return Incision(organ, cuts, part, space, rows, number, give, stiff, A, R, skull)


def _space(organ, cuts, basis):
    """Mesh, split and basis of the window about the cuts, and the window."""
    radius = 0.0
    if basis.geometric:
        radius = 2 * (basis.tip_radius_mm or max(max(cut.length for cut in cuts) / 5, 4 * organ.mesh.sizes.max()))
    path = np.concatenate([cut.path for cut in cuts])
    live = organ.uncut.rim.parts[organ.live_facets]
    part = window(organ.mesh, path, radius, live)
    split = place(part.mesh, cuts)
    space = functions_on(part.mesh, with_rim(split, _live_rim(organ, part, split)), basis)
    table = space.enrichment
    # The pieces of a node on the border join outside of the window.
    spurious = (table.kind == HEAVISIDE) & part.border[table.node]
    own = np.where(spurious, table.node, np.arange(table.n_rows))
    table = replace(table, dof=own[table.dof])
    _refuse_through(split, table)
    return replace(space, enrichment=table), part


def _live_rim(organ, part, split):
    """Facets (b,) bool of the window's rim that are live facets of the organ, and not the window's own border."""
    cell = split.cell[split.rim.parts]
    offset = split.rim.facets.mean(axis=1)[:, None] - part.mesh.corners[cell][:, [1, 2, 0]]
    depth = np.abs(np.einsum("bai,bai->ba", part.mesh.gradients[cell], offset))
    facet = organ.facet_number[part.cells[cell], np.argmin(depth, axis=1)]
    return (facet >= 0) & organ.live_facets[facet]


def _refuse_through(split: Parts, table: Enrichment):
    """The parts beside the lips hang together around the tips, or else the cut takes something off."""
    if len(np.unique(table.body[split.lips.parts])) > 1:
        raise CutThrough


def _restricted(material, cells):
    if isinstance(material, Material):
        return material
    return replace(material, young_kpa=material.young_kpa[cells], poisson=material.poisson[cells])


def _resistance(organ, part, nodes):
    """Lower Cholesky factor of the compliance of `nodes` (k,), and its inverse (2 k, 2 k) kPa."""
    give, lost = lapack.dpotrf(organ.compliance.among(part.nodes[nodes]).T, lower=True, overwrite_a=True)
    if not lost:
        lower, lost = lapack.dpotri(give, lower=True)
    if lost:
        raise too_stiff()
    np.einsum("ii->i", lower)[:] /= 2
    return give, lower + lower.T


def too_stiff() -> XfemnavError:
    """What is wrong where the stiffness of the condensed organ is lost in rounding."""
    return XfemnavError(
        "E407",
        "a stiff inclusion beside the cut wants a run: it is so much stiffer than the rest that a session, which "
        "condenses the organ, loses its answer in rounding.",
    )


def _plain(mesh, material, cells, nodes):
    """Stiffness (2 k, 2 k) kPa of uncut `cells` (c,) on nodes (k,)."""
    mu, lam = material.moduli_in(cells)
    K_c = plain_blocks(mesh.gradients[cells], lam * mesh.volumes[cells], mu * mesh.volumes[cells])
    number, n = np.empty(len(mesh.points), dtype=int), 2 * len(nodes)
    number[nodes] = np.arange(len(nodes))
    dof = (2 * number[mesh.cells[cells]][:, :, None] + np.arange(2)).reshape(-1, 6)
    return np.bincount((n * dof[:, :, None] + dof[:, None, :]).ravel(), K_c.ravel(), n * n).reshape(n, n)


def _live(conditions, held) -> tuple[np.ndarray, Constraints]:
    """Degrees of freedom that the skull fixes, and its other conditions; without those on what is `held` (n_dof,)."""
    C = conditions.C
    count = np.diff(C.indptr)
    free = np.bincount(np.repeat(np.arange(len(count)), count), held[C.indices], len(count)) == 0
    single = count == 1
    return C.indices[C.indptr[:-1][free & single]], chosen(conditions, free & ~single)


def _order(table, rows, fixed):
    """Unknowns that are not `fixed`: those of nodes without branch functions (p,), and those of nodes with (t,)."""
    free = np.ones(2 * len(rows), dtype=bool)
    free[fixed] = False
    at_tip = np.repeat(np.isin(table.node[rows], table.tip_nodes), 2)
    return np.flatnonzero(free & ~at_tip), np.flatnonzero(free & at_tip)


def _gathered(order, number, outside, matrices):
    """Sum (n, n) kPa, of the unknowns in their `order` (n,), of `outside`, on the first ones, and symmetric `matrices`
    (n_dof, n_dof), compressed."""
    K, place = np.zeros((len(order),) * 2), np.full(number.max() + 2, -1)
    place[order] = np.arange(len(order))
    at, place = place[: len(outside)], place[number]
    known = np.flatnonzero(at >= 0)
    K[np.ix_(at[known], at[known])] = outside[np.ix_(known, known)]
    for each in matrices:
        i, j = place[np.repeat(np.arange(len(place)), np.diff(each.indptr))], place[each.indices]
        known = (i >= 0) & (j >= 0)
        K[i[known], j[known]] += each.data[known]
    return K


def _mixed(space, material, basis, rows, K, plain, tips):
    """A = R'KR and R, which makes the block of each tip node as in `node_blocks`; K has `plain`, then `tips`.

    The scale of the other unknowns makes no difference to a Cholesky factor.
    """
    p, table = len(plain), space.enrichment
    dofs, T = (2 * rows[:, None] + np.arange(2)).ravel()[tips], np.eye(len(tips))
    if basis.geometric:
        T = vector_tip_basis(space, material).tocsr()[dofs].tocsc()
        T = T[:, np.flatnonzero(np.diff(T.indptr))].toarray()
    block = T.T @ K[p:, p:] @ T
    owner = table.node[dofs // 2][np.argmax(T != 0, axis=0)] if len(tips) else tips
    P = np.zeros((T.shape[1],) * 2)
    for own in blocks(owner):
        square = own[:, :, None], own[:, None, :]
        P[square] = inverse_roots(block[square])
    mix = T @ P[:, P.any(axis=0)]
    n = p + mix.shape[1]
    K[:p, p:n] = K[:p, p:] @ mix
    K[p:n, :p], K[p:n, p:n] = K[:p, p:n].T, mix.T @ K[p:, p:] @ mix
    return K[:n, :n], Mixing(2 * len(rows), plain, tips, mix)
