"""The finite element space of Eq. (4), and its one operator: the matrix B with u(points) = B U.

Constraint rows, loads, moved corners, strains and quadrature all read the basis through it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from scipy.sparse import csr_array

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.snapping import SEVER
from xfemnav.mechanics.branch import branch_functions, branch_gradients, polar
from xfemnav.mechanics.enrichment import BRANCH, HEAVISIDE, Enrichment


@dataclass(frozen=True, eq=False)
class Space:
    """A mesh, what the cuts do to it, and the table of basis functions."""

    mesh: Mesh
    parts: Parts
    enrichment: Enrichment

    def basis_in(self, points, parts) -> csr_array:
        """B (k, n_rows) with u = B U at points (k, 2) mm, each taken in the part (k,) given: it decides the lip."""
        at, rows, values = self.values_in(points, parts)
        shape = (len(points), self.enrichment.n_rows)
        if len(at) == 3 * len(points):  # no branch functions: the rows are complete as they come
            return csr_array((values, rows, np.arange(0, len(at) + 1, 3)), shape)
        return csr_array((values, (at, rows)), shape)

    def values_in(self, points, parts) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The entries of `basis_in`, (e,) each: point, basis function, value."""
        points, parts = np.asarray(points, float), np.asarray(parts)
        at, rows, hats, _ = self._hats(points, parts)
        entry, who = self._entries(parts)
        if not len(entry):
            return at, rows, hats.ravel()
        more, values, *_ = self._branch(points[who], entry)
        weight = hats[who, self.enrichment.entry_node[entry]] * self._ramp(hats[who], entry)
        return (np.concatenate([at, np.repeat(who, 4)]), np.concatenate([rows, more.ravel()]),
                np.concatenate([hats.ravel(), (weight[:, None] * values).ravel()]))

    def gradient_in(self, points, parts) -> tuple[csr_array, csr_array]:
        """The two matrices (k, n_rows), 1/mm, of the basis functions' derivatives along the plane's axes."""
        at, rows, gradients = self._gradients(np.asarray(points, float), np.asarray(parts))
        shape = (len(points), self.enrichment.n_rows)
        return tuple(csr_array((gradients[:, i], (at, rows)), shape) for i in (0, 1))

    def basis_at(self, points, side: int | None = None) -> csr_array:
        """B (k, n_rows) at any points (k, 2) mm of the organ; on a cut, `side` +1 is the left lip and -1 the right.

        Raises ValueError for a point outside the mesh or in a resection, or on a cut without a side.
        """
        points = np.asarray(points, float)
        return self.basis_in(points, self.locate(points, side))

    def locate(self, points, side: int | None = None) -> np.ndarray:
        """Part (k,) that holds each point (k, 2) mm and is not resected; see `basis_at`."""
        points = np.asarray(points, float)
        reach = SEVER * float(self.mesh.sizes.min())
        at, triangle = self._tree.query(shapely.points(points), predicate="dwithin", distance=reach)
        triangle = self._left[triangle]
        candidate = self.parts.part[triangle]
        lip = self._nearest_lip(points)
        normal = self._lip_normals[lip] if lip is not None else np.zeros((len(points), 2))
        centre = self.parts.corners[triangle].mean(axis=1)
        # Off the cut every candidate gives the same value; on it, the candidate's side of the lip decides.
        preference = np.einsum("ki,ki->k", centre - points[at], normal[at]) * (side or 0)
        depth = _depth(self.parts.corners[triangle], points[at])
        order = np.lexsort((-depth, -np.sign(preference) * (np.abs(depth) < reach), at))
        first = order[np.concatenate([[True], np.diff(at[order]) != 0])] if len(order) else order
        found = np.full(len(points), -1)
        found[at[first]] = candidate[first]
        if (found < 0).any():
            where = points[found < 0][0]
            raise ValueError(f"point ({where[0]:.3f}, {where[1]:.3f}) mm lies outside the mesh, or was resected")
        return found

    def _nearest_lip(self, points):
        if not len(self.parts.lips.facets):
            return None
        return self._lip_tree.nearest(shapely.points(points))

    @cached_property
    def _left(self):
        return np.flatnonzero(~self.parts.removed[self.parts.part])

    @cached_property
    def _tree(self):
        return shapely.STRtree(shapely.polygons(self.parts.corners[self._left]))

    @cached_property
    def _lip_tree(self):
        return shapely.STRtree(shapely.linestrings(self.parts.lips.facets))

    @cached_property
    def _lip_normals(self):
        d = self.parts.lips.facets[:, 1] - self.parts.lips.facets[:, 0]
        return np.stack([-d[:, 1], d[:, 0]], axis=1) / np.linalg.norm(d, axis=1)[:, None]

    @cached_property
    def _entry_start(self):
        """First entry of each part in the table of branch functions, and one past the last (p + 1,)."""
        return np.searchsorted(self.enrichment.entry_part, np.arange(self.parts.n_parts + 1))

    @cached_property
    def branch_parts(self) -> np.ndarray:
        """Parts (k,) on which branch functions live."""
        return np.unique(self.enrichment.entry_part)

    def _hats(self, points, parts):
        """Nodal shape functions: point (3 k,), row (3 k,), value (k, 3), gradient (k, 3, 2)."""
        cell = self.parts.cell[parts]
        gradient = self.mesh.gradients[cell]
        hats = np.einsum("kai,ki->ka", gradient, points - self.mesh.points[self.mesh.cells[cell, 0]])
        hats[:, 0] += 1
        return np.repeat(np.arange(len(points)), 3), self.enrichment.dof[parts].ravel(), hats, gradient

    def _entries(self, parts):
        """Entries (e,) of the table of branch functions at each point, and which point (e,) they are at."""
        count = self._entry_start[parts + 1] - self._entry_start[parts]
        who = np.repeat(np.arange(len(parts)), count)
        return np.arange(len(who)) + np.repeat(self._entry_start[parts] - np.cumsum(count) + count, count), who

    def _branch(self, points, entry):
        """At a point (e, 2) each: rows (e, 4) of the entry's functions, F_l - F_l(x_i) (e, 4), and r (e,), theta (e,).
        """
        table = self.enrichment
        rows = table.entry_row[entry][:, None] + np.arange(4)
        tip = table.tip[rows[:, 0]]
        r, theta = polar(points, self.parts.fronts.at[tip], self.parts.fronts.travel[tip], table.entry_angle[entry])
        return rows, branch_functions(r, theta) - table.shift[rows], r, theta

    def _ramp(self, values, entry):
        """The blending ramp of each entry, from its nodal functions' values or gradients (e, 3, ...)."""
        return np.einsum("ea,ea...->e...", self.enrichment.entry_ramp[entry], values)

    def _gradients(self, points, parts):
        """All basis functions at each point: point, row, gradient, as flat arrays."""
        table = self.enrichment
        at, rows, hats, gradient = self._hats(points, parts)
        entry, who = self._entries(parts)
        more, f, r, theta = self._branch(points[who], entry)
        travel = self.parts.fronts.travel[table.tip[more[:, 0]]]
        frame = np.stack([travel, np.stack([-travel[:, 1], travel[:, 0]], axis=1)], axis=1)
        df = np.einsum("eli,eij->elj", branch_gradients(np.maximum(r, 1e-300), theta), frame)
        a, ramp = table.entry_node[entry], self._ramp(hats[who], entry)
        hat, dhat = hats[who, a], gradient[who, a]
        weight, dweight = hat * ramp, hat[:, None] * self._ramp(gradient[who], entry) + dhat * ramp[:, None]
        own = weight[:, None, None] * df + f[:, :, None] * dweight[:, None]
        return (np.concatenate([at, np.repeat(who, 4)]), np.concatenate([rows, more.ravel()]),
                np.concatenate([gradient.reshape(-1, 2), own.reshape(-1, 2)]))

    def paper_coefficients(self, U) -> dict[str, np.ndarray]:
        """The coefficients of Eq. (4) as the paper writes it, from those of this basis, U (n_rows, 2) mm.

        Returns u (n_nodes, 2), a (n_nodes, 2) for set J, c (n_nodes, 4, 2) for set K, zero where a node has none.
        Only for one cut with at most two pieces a node. Raises ValueError otherwise.
        """
        table, n = self.enrichment, len(self.mesh.points)
        U = np.asarray(U)
        c = np.zeros((n, 4, 2))
        branch = table.kind >= BRANCH
        c[table.node[branch], table.kind[branch] - BRANCH] = U[branch]
        u, a = U[:n].copy(), np.zeros((n, 2))
        extra = np.flatnonzero(table.kind == HEAVISIDE)
        if len(np.unique(table.node[extra])) < len(extra):
            raise ValueError("a node has more than two pieces: Eq. (4) has one H a node")
        sign = self._row_sides()
        i = table.node[extra]
        u[i] = (U[i] + U[extra]) / 2
        a[i] = (U[i] - U[extra]) / 2 * sign[i, None]
        np.subtract.at(u, table.node[branch], table.shift[branch, None] * U[branch])
        return {"u": u, "a": a, "c": c}

    def _row_sides(self):
        """H (n_rows,) of the piece of each row: the side of the cut of its largest lip part, 0 away from the cut."""
        side = np.zeros(self.enrichment.n_rows)
        length = np.linalg.norm(self.parts.lips.facets[:, 1] - self.parts.lips.facets[:, 0], axis=1)
        for column, sign in ((0, 1.0), (1, -1.0)):
            rows = self.enrichment.dof[self.parts.lips.parts[:, column]]
            np.add.at(side, rows, sign * length[:, None])
        return np.sign(side)


def _depth(corners, points):
    """How far inside its triangle each point lies (k,): the smallest barycentric coordinate times the height, mm."""
    a, b = corners, corners[:, [1, 2, 0]]
    d = b - a
    off = d[..., 0] * (points[:, None, 1] - a[..., 1]) - d[..., 1] * (points[:, None, 0] - a[..., 0])
    return (off / np.linalg.norm(d, axis=2)).min(axis=1)
