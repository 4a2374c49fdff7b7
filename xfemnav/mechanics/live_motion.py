"""The motion of a condensed organ: triangles, and points carried by them, with no work far from the cut.

The triangles are those of a `Solution`, so that points and pixels go where a run takes them.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from xfemnav.geometry.affine_map import PiecewiseAffineMap
from xfemnav.geometry.locate import locate
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.window import near_cells
from xfemnav.mechanics.condensation import Condensation
from xfemnav.mechanics.fan import graded_triangles
from xfemnav.mechanics.incision import Incision


@dataclass(frozen=True, eq=False)
class Soup:
    """Triangles of a cut organ at rest: cells as they are, `whole` (c,), then those `near` the cut (t, 3, 2) mm, whose
    corners move by `basis` (3 t, n_rows) times the coefficients of the window's basis. `beside` (b,): cells among the
    whole ones that points on the cut may be in."""

    organ: Condensation
    whole: np.ndarray
    near: np.ndarray
    basis: csr_array
    beside: np.ndarray
    paths: tuple = ()

    @property
    def mesh(self) -> Mesh:
        """The mesh without the cut."""
        return self.organ.mesh

    @cached_property
    def rest(self) -> np.ndarray:
        """All triangles (c + t, 3, 2) mm."""
        return np.concatenate([self.mesh.corners[self.whole], self.near])

    @cached_property
    def is_near(self) -> np.ndarray:
        """Cells (m,) bool that are in pieces, or beside them: a point in one asks the near triangles."""
        near = np.ones(len(self.mesh.cells), dtype=bool)
        near[self.whole] = False
        near[self.beside] = True
        return near


def uncut(organ: Condensation) -> Soup:
    """The triangles of an organ without a cut."""
    return Soup(organ, np.arange(len(organ.mesh.cells)), np.empty((0, 3, 2)), csr_array((0, 0)), np.empty(0, dtype=int))


def soup(incision: Incision) -> Soup:
    """The triangles of a cut organ, finer at the tips."""
    space, window = incision.space, incision.window
    sub, table = space.subcells, space.enrichment
    cut = (table.dof >= len(space.mesh.points)).any(axis=1)
    cut[table.entry_part] = True
    cut[len(space.mesh.cells) :] = True
    cells = np.zeros(len(space.mesh.cells), dtype=bool)
    cells[sub.part_cell[cut]] = True
    rest, part = graded_triangles(space)
    chosen = cells[sub.part_cell[part]]
    rest, part = rest[chosen], part[chosen]
    whole = np.ones(len(incision.organ.mesh.cells), dtype=bool)
    whole[window.cells[cells]] = False
    beside = near_cells(incision.organ.mesh, np.concatenate([cut.path for cut in incision.cuts]))
    return Soup(incision.organ, np.flatnonzero(whole), rest,
                space.basis_in(rest.reshape(-1, 2), np.repeat(part, 3)), beside[whole[beside]],
                tuple(cut.path for cut in incision.cuts))


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
    def all(self) -> PiecewiseAffineMap:
        """The whole motion, both ways: it takes as long to make as an image."""
        return PiecewiseAffineMap(self.soup.rest, self.moved, self.soup.paths)

    @cached_property
    def _close(self) -> PiecewiseAffineMap:
        cells, mesh = self.soup.beside, self.soup.mesh
        rest = np.concatenate([mesh.corners[cells], self.soup.near])
        moved = np.concatenate([(mesh.points + self.U)[mesh.cells[cells]], self.near_moved])
        return PiecewiseAffineMap(rest, moved, self.soup.paths)

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
        near = np.flatnonzero((cell < 0) | self.soup.is_near[cell])
        if len(self.soup.near) and len(near):
            current[near] = self._close.to_current(points[near], side)
        return current

