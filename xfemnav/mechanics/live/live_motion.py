"""The motion of a condensed organ: triangles, and points carried by them, with no work far from the cut.

The triangles are those of a `Solution`, so that points and pixels go where a run takes them.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from xfemnav.geometry.locate import locate
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.plane.window import near_cells
from xfemnav.mechanics.live.condensation import Condensation
from xfemnav.mechanics.live.incision import Incision
from xfemnav.mechanics.space.map_triangles import graded_triangles


@dataclass(frozen=True, eq=False)
class Soup:
    """Triangles of the organ at rest, cut or not: cells as they are, then those near the cut, finer at its tips."""

    organ: Condensation
    incision: Incision | None = None

    @property
    def mesh(self) -> Mesh:
        """The mesh without the cut."""
        return self.organ.mesh

    @property
    def cuts(self) -> tuple[np.ndarray, ...]:
        """The cut's path, as it is snapped to the mesh."""
        return () if self.incision is None else self.incision.space.parts.paths

    @cached_property
    def _pieces(self):
        """The window's cells (w,) bool whose motion is not that of their nodes; their triangles, and parts of these."""
        space = self.incision.space
        split, table = space.parts, space.enrichment
        cut = (table.dof >= len(space.mesh.points)).any(axis=1)
        cut[table.entry_part] = True
        cut[len(space.mesh.cells) :] = True
        cells = np.zeros(len(space.mesh.cells), dtype=bool)
        cells[split.cell[cut]] = True
        rest, part = graded_triangles(space)
        chosen = cells[split.cell[part]]
        return cells, rest[chosen], part[chosen]

    @cached_property
    def whole(self) -> np.ndarray:
        """Cells (c,) that move as their nodes do."""
        whole = np.ones(len(self.mesh.cells), dtype=bool)
        if self.incision is not None:
            whole[self.incision.window.cells[self._pieces[0]]] = False
        return np.flatnonzero(whole)

    @cached_property
    def near(self) -> np.ndarray:
        """Triangles (t, 3, 2) mm of the other cells."""
        return np.empty((0, 3, 2)) if self.incision is None else self._pieces[1]

    @cached_property
    def basis(self) -> csr_array:
        """Basis (3 t, n_rows) of the window at the corners of the near triangles."""
        if self.incision is None:
            return csr_array((0, 0))
        _, rest, part = self._pieces
        return self.incision.space.basis_in(rest.reshape(-1, 2), np.repeat(part, 3))

    @cached_property
    def beside(self) -> np.ndarray:
        """Whole cells (b,) that a point on the cut may be in."""
        return np.intersect1d(near_cells(self.mesh, np.concatenate(self.cuts)), self.whole)

    @cached_property
    def rest(self) -> np.ndarray:
        """All triangles (c + t, 3, 2) mm."""
        return np.concatenate([self.mesh.corners[self.whole], self.near])

    @cached_property
    def is_near(self) -> np.ndarray:
        """Cells (m,) bool in which a point asks the near triangles."""
        near = np.ones(len(self.mesh.cells), dtype=bool)
        near[self.whole] = False
        near[self.beside] = True
        return near


@dataclass(frozen=True, eq=False)
class LiveMotion:
    """Displacements U (n_nodes, 2) mm of the organ's nodes, and coefficients own (n_rows, 2) of the window's basis."""

    soup: Soup
    U: np.ndarray
    own: np.ndarray

    @cached_property
    def near_moved(self) -> np.ndarray:
        """The near triangles (t, 3, 2) mm where they are now."""
        return self.soup.near + (self.soup.basis @ self.own).reshape(self.soup.near.shape)

    @cached_property
    def moved(self) -> np.ndarray:
        """All triangles of the soup where they are now."""
        cells = self.soup.mesh.cells[self.soup.whole]
        return np.concatenate([(self.soup.mesh.points + self.U)[cells], self.near_moved])

    @cached_property
    def all(self) -> Motion:
        """The whole motion, both ways: it takes as long to make as an image."""
        return Motion(self.soup.rest, self.moved, self.soup.cuts)

    @cached_property
    def _close(self) -> Motion:
        cells, mesh = self.soup.beside, self.soup.mesh
        rest = np.concatenate([mesh.corners[cells], self.soup.near])
        moved = np.concatenate([(mesh.points + self.U)[mesh.cells[cells]], self.near_moved])
        return Motion(rest, moved, self.soup.cuts)

    def to_current(self, points, side=0) -> np.ndarray:
        """Where the tissue that rested at `points` (n, 2) mm is now; NaN where there is none. `side` +1 left, -1 right.
        """
        mesh = self.soup.mesh
        points = np.array(points, float, ndmin=2)
        cell = locate(points, mesh.corners, self.soup.organ.buckets)
        corner = mesh.cells[cell]
        hats = np.einsum("kai,ki->ka", mesh.gradients[cell], points - mesh.points[corner[:, 0]])
        hats[:, 0] += 1
        current = points + np.einsum("ka,kai->ki", hats, self.U[corner])
        current[cell < 0] = np.nan
        if self.soup.incision is not None:
            near = np.flatnonzero((cell < 0) | self.soup.is_near[cell])
            current[near] = self._close.to_current(points[near], side)
        return current

