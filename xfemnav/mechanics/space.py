"""The finite element space of Eq. (4), and its one operator: the matrix B with u(points) = B U.

Constraint rows, loads, moved corners, strains and quadrature all read the basis through it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.parts import Parts
from xfemnav.mechanics.branch import branch_functions, branch_gradients, polar
from xfemnav.mechanics.enrichment import Enrichment


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
