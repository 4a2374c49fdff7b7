"""The finite element space of Eq. (4), and its one operator: the matrix B with u(points) = B U.

Constraint rows, loads, moved corners, strains and quadrature all read the basis through it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.parts import Parts
from xfemnav.mechanics.space.branch import branch_functions, branch_gradients, polar
from xfemnav.mechanics.space.enrichment import Enrichment
from xfemnav.mechanics.space.quadrature import simplex_rule, tip_rule


@dataclass(frozen=True, eq=False)
class Space:
    """A mesh, what the cuts do to it, and the table of basis functions."""

    mesh: Mesh
    parts: Parts
    enrichment: Enrichment

    def basis_in(self, points, parts) -> csr_array:
        """B (k, n_rows) with u = B U at points (k, d) mm, each taken in the part (k,) given: it decides the lip."""
        at, rows, values = self.values_in(points, parts)
        shape = (len(points), self.enrichment.n_rows)
        corners = self.mesh.dim + 1
        if len(at) == corners * len(points):  # no branch functions: the rows are complete as they come
            return csr_array((values, rows, np.arange(0, len(at) + 1, corners)), shape)
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

    def gradient_in(self, points, parts) -> tuple[csr_array, ...]:
        """The d matrices (k, n_rows), 1/mm, of the basis functions' derivatives along each axis."""
        at, rows, gradients = self.gradients_in(points, parts)
        shape = (len(points), self.enrichment.n_rows)
        return tuple(csr_array((along, (at, rows)), shape) for along in gradients.T)

    def rule(self, chosen, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (q, d) mm, weights (q,) mm^d and parts (q,) for integrals over the `chosen` simplices (s,) bool.

        Exact up to `degree` 1 or 2; where branch functions live by the tips' own rule.
        """
        split = self.parts
        about_tip = np.isin(split.part, self.branch_parts)
        plain, about_tip = chosen & ~about_tip, np.flatnonzero(chosen & about_tip)
        points = simplex_rule(split.corners[plain], degree)
        n, points = points.shape[1], points.reshape(-1, self.mesh.dim)
        found = points, np.repeat(split.volumes[plain] / n, n), np.repeat(split.part[plain], n)
        if not len(about_tip):
            return found
        points, weights, owner = tip_rule(split.corners[about_tip], split.fronts.at)
        return tuple(map(np.concatenate, zip(found, (points, weights, split.part[about_tip][owner]))))

    @cached_property
    def _entry_start(self):
        """First entry of each part in the table of branch functions, and one past the last (p + 1,)."""
        return np.searchsorted(self.enrichment.entry_part, np.arange(self.parts.n_parts + 1))

    @cached_property
    def branch_parts(self) -> np.ndarray:
        """Parts (k,) on which branch functions live."""
        return np.unique(self.enrichment.entry_part)

    def _hats(self, points, parts):
        """Nodal shape functions, c = d + 1: point (c k,), row (c k,), value (k, c), gradient (k, c, d)."""
        cell = self.parts.cell[parts]
        gradient = self.mesh.gradients[cell]
        hats = np.einsum("kai,ki->ka", gradient, points - self.mesh.points[self.mesh.cells[cell, 0]])
        hats[:, 0] += 1
        return np.repeat(np.arange(len(points)), hats.shape[1]), self.enrichment.dof[parts].ravel(), hats, gradient

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
        """The blending ramp of each entry, from its nodal functions' values or gradients (e, d + 1, ...)."""
        return np.einsum("ea,ea...->e...", self.enrichment.entry_ramp[entry], values)

    def gradients_in(self, points, parts) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All basis functions at points (k, d) mm in parts (k,): point (e,), basis function (e,), gradient (e, d)."""
        table, points, parts = self.enrichment, np.asarray(points, float), np.asarray(parts)
        at, rows, hats, gradient = self._hats(points, parts)
        entry, who = self._entries(parts)
        if not len(entry):
            return at, rows, gradient.reshape(len(at), -1)
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
