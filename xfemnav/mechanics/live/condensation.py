"""The uncut organ, condensed: its stiffness factored once, and what its nodes feel of each other's forces.

A cut changes the stiffness of the cells near it alone. So all else can be condensed onto the nodes M of those cells,
once and exactly. With G = K^-1 of the uncut organ (its compliance), the stiffness that M feels of everything but those
cells is G_MM^-1 - K_near: the Schur complement of the rest, without the rest. G is kept for the nodes near the planned
cut and grows when others are asked for, by one backsolve a degree of freedom.

Where the skull may be opened by a cut that moves, the organ's outline (`open_facets`) is left without any hold here.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.geometry.locate import Buckets, bucket
from xfemnav.geometry.mesh import Mesh, frozen_array
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.subcells import embed
from xfemnav.geometry.plane.window import near_cells
from xfemnav.mechanics.conditions.constraints import Constraints, eliminate
from xfemnav.mechanics.conditions.skull import skull_conditions
from xfemnav.mechanics.rules import Skull
from xfemnav.mechanics.solving.factor import NotPositiveDefinite, factor
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, Tissue, stiffness

HELD = ("fixed", "sliding")
#: Right-hand sides that are solved at once.
BATCH = 128
#: Most nodes whose compliance is worked out before a cut asks for it.
MOST = 1000
#: Two facets more than the skull's conditions need stay open, so that each begins and ends at held nodes.
FACETS = 2.0


@dataclass(frozen=True, eq=False)
class Condensation:
    """The uncut organ in its skull: `mesh`, `material` (a Tissue has the mesh's cells), `skull`.

    open_facets (b,) bool: facets of the outline, in the order of the mesh's boundary, that hold nothing here;
    held (n_nodes,) bool: nodes that the skull holds beyond them.
    """

    mesh: Mesh
    material: Material | Tissue
    skull: Skull
    open_facets: np.ndarray

    def __post_init__(self):
        if self.skull.kind not in HELD or self.skull.arcs:
            raise ValueError("the organ is condensed in a fixed or sliding skull without arcs")
        object.__setattr__(self, "open_facets", frozen_array(self.open_facets, bool, (None,), "open_facets"))

    @cached_property
    def uncut(self) -> Parts:
        """The mesh without cuts."""
        return embed(self.mesh, ())

    @cached_property
    def _system(self):
        """Factored stiffness of the free unknowns q, T with U = T q and its transpose, and the stiffness of U."""
        rest = with_rim(self.uncut, ~self.open_facets)
        space = Space(self.mesh, rest, enrich(self.mesh, rest))
        outline = skull_conditions(space, self.skull, np.empty((0, 2)), self.material)
        K = stiffness(space, self.material) + outline.springs
        # Nodes between an open facet and another are left to the cut: it knows the normals of both.
        shared = np.zeros(2 * len(self.mesh.points))
        shared[(2 * self.shared_nodes[:, None] + np.arange(2)).ravel()] = 1.0
        _, T = eliminate(chosen(outline.constraints, abs(outline.constraints.C) @ shared == 0))
        A = (T.T @ K @ T).tocsc()
        try:
            found = factor(A, semidefinite=True)
        except NotPositiveDefinite:
            raise XfemnavError(
                "E406",
                "nothing holds the organ beyond the craniotomies that the corridor allows, so it cannot be condensed; "
                "use a smaller craniotomy or reach, or a run of its own for each cut.",
            ) from None
        return found, csr_array(T), csr_array(T.T), csr_array(K)

    @property
    def stiffness(self) -> csr_array:
        """K (2 n_nodes, 2 n_nodes) kPa of the uncut organ, with what its skull resists by."""
        return self._system[3]

    @cached_property
    def held(self) -> np.ndarray:
        """Nodes (n_nodes,) bool that the skull holds, wherever the cut."""
        T = self._system[1]
        size = np.asarray(T.multiply(T).sum(axis=1)).reshape(-1, 2)
        return (size < 0.5).any(axis=1) | (np.diff(T.indptr).reshape(-1, 2) != 1).any(axis=1)

    @cached_property
    def compliance(self) -> "Compliance":
        """G of the nodes that were asked for so far."""
        return Compliance(self.solve, len(self.mesh.points))

    @cached_property
    def buckets(self) -> Buckets:
        """The mesh's cells sorted by place."""
        return bucket(self.mesh.corners)

    @cached_property
    def shared_nodes(self) -> np.ndarray:
        """Nodes (k,) between a facet that is open and one that is not."""
        edges = self.mesh.boundary_facets
        return np.intersect1d(edges[self.open_facets], edges[~self.open_facets])

    @cached_property
    def live_facets(self) -> np.ndarray:
        """Facets (b,) bool whose conditions a cut sets: the open ones, and the next to them."""
        return self.open_facets | np.isin(self.mesh.boundary_facets, self.shared_nodes).any(axis=1)

    @cached_property
    def facet_number(self) -> np.ndarray:
        """Number (m, 3) of the outline's facet opposite each local node of each cell, -1 inside."""
        inside = self.mesh.neighbours >= 0
        return np.where(inside, -1, np.cumsum(~inside).reshape(inside.shape) - 1)

    def solve(self, forces) -> np.ndarray:
        """Displacements (n_nodes, 2, k) mm of the uncut organ under nodal forces (n_nodes, 2, k) mN per mm."""
        found, T, back, _ = self._system
        n, _, k = forces.shape
        return np.asarray(T @ found.solve(back @ forces.reshape(2 * n, k))).reshape(n, 2, k)

    def reaches(self, mouths) -> bool:
        """Whether skull conditions about these mouths (m, 2) mm differ on the open facets alone."""
        if not len(mouths):
            return True
        ends = self.uncut.rim.facets[~self.open_facets]
        gap = np.linalg.norm(ends[:, :, None] - np.asarray(mouths), axis=3).min(initial=np.inf)
        return gap >= _grip(self.skull) + _longest(self.uncut)


def condense(
    mesh: Mesh, material: Material | Tissue, skull: Skull, path, *, reach_mm: float = 6.0, mouths=(), tips=(),
    tip_radius_mm: float = 0.0
) -> Condensation:
    """Condense the organ for cuts that stay within `reach_mm` of a `path` (k, 2) mm, with `mouths` (m, 2) mm and with
    tip functions up to `tip_radius_mm` from `tips` (t, 2) mm.

    The compliance of the MOST nodes nearest to the path, of those within reach, is worked out at once.
    """
    line = shapely.LineString(path)
    ends = mesh.points[mesh.boundary_facets]
    longest = np.linalg.norm(np.diff(ends, axis=1), axis=2).max()
    near = _distance(line, ends.reshape(-1, 2)).reshape(-1, 2).min(axis=1) < reach_mm + FACETS * longest
    if len(mouths):
        gap = np.linalg.norm(ends[:, :, None] - np.asarray(mouths), axis=3).min(axis=(1, 2))
        near |= gap < _grip(skull) + reach_mm + FACETS * longest
    if len(tips):
        gap = np.linalg.norm(ends[:, :, None] - np.asarray(tips), axis=3).min(axis=(1, 2))
        near |= gap < tip_radius_mm + reach_mm + FACETS * longest
    found = Condensation(mesh, material, skull, near)
    distance = _distance(line, mesh.points)
    order = np.argsort(distance, kind="stable")[:MOST]
    nodes = np.zeros(len(distance), dtype=bool)
    nodes[order[distance[order] <= reach_mm]] = True
    nodes[mesh.boundary_facets[near]] = True
    # Sorted across the path, as the nodes of one cut are near to each other.
    along = np.subtract(path[-1], path[0])
    known = np.flatnonzero(nodes & ~found.held)
    found.compliance.among(known[np.argsort(mesh.points[known] @ [-along[1], along[0]])])
    return found


def tip_reach(mesh: Mesh, cut: Cut) -> float:
    """Distance mm from a tip of the cut that its geometric functions do not pass: see `default_radius`."""
    h = mesh.sizes[near_cells(mesh, cut.path)].max()
    return float(max(cut.length / 5, 4 * h) + h)


class Compliance:
    """G = K^-1 between nodes: what forces on some of them do to others. It grows with the nodes that are asked for."""

    def __init__(self, solve, n_nodes: int):
        self._solve, self._place = solve, np.full(n_nodes, -1)
        self.nodes, self._G = np.empty(0, dtype=int), np.empty((0, 0))

    def among(self, nodes) -> np.ndarray:
        """G (2 k, 2 k) mm per mN per mm among nodes (k,); degree of freedom 2 a + i of the node a."""
        missing = nodes[self._place[nodes] < 0]
        if len(missing):
            self._learn(missing)
        at = (2 * self._place[nodes][:, None] + np.arange(2)).ravel()
        return self._G.ravel().take(len(self._G) * at[:, None] + at)

    def _learn(self, missing):
        old, new = len(self.nodes), len(self.nodes) + len(missing)
        self.nodes = np.concatenate([self.nodes, missing])
        if 2 * new > len(self._G):
            # Room for as many again, so that growing by a few does not copy everything each time.
            room = np.zeros((2 * max(new, min(2 * old, new + 500)),) * 2)
            room[: 2 * old, : 2 * old] = self._G[: 2 * old, : 2 * old]
            self._G = room
        for first in range(0, len(missing), BATCH // 2):
            batch = missing[first : first + BATCH // 2]
            k = np.arange(2 * len(batch))
            forces = np.zeros((len(self._place), 2, len(k)))
            forces[np.repeat(batch, 2), k % 2, k] = 1.0
            self._G[: 2 * new, 2 * (old + first) + k] = self._solve(forces)[self.nodes].reshape(2 * new, -1)
        self._G[2 * old : 2 * new, : 2 * old] = self._G[: 2 * old, 2 * old : 2 * new].T
        self._place[missing] = np.arange(old, new)


def with_rim(split: Parts, kept) -> Parts:
    """The same with only the facets of the outline that are `kept` (b,) bool."""
    return replace(split, rim=split.rim.rows(kept))


def chosen(constraints: Constraints, kept) -> Constraints:
    """Only the conditions that are `kept` (m,) bool."""
    kept = np.flatnonzero(kept)
    return Constraints(constraints.C[kept], constraints.d[kept], constraints.group[kept])


def _grip(skull):
    """Distance mm from a mouth at which the skull holds fully."""
    return skull.craniotomy_mm + skull.ramp_mm


def _longest(split):
    return np.linalg.norm(np.diff(split.rim.facets, axis=1), axis=2).max()


def _distance(line, points):
    return shapely.distance(line, shapely.points(points))
