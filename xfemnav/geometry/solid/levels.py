"""Cuts as level sets: functions given at the nodes of a mesh and linear in each cell.

A cut is where phi = 0 and all its bounds psi < 0; its left lip is where phi > 0. A plane patch is exact. A curved or
kinked sheet is one phi, sampled: two patches that share a dividing plane would leak along it. A branch is bounded by
the phi of its stem. A closed phi takes tissue out, that with phi < 0.
"""

from dataclasses import dataclass

import numpy as np

from xfemnav.geometry.mesh import Mesh, frozen_array

SNAP = 1e-3  # of the element size: values at nodes that are nearer to 0 are 0, so that no part is thinner


@dataclass(frozen=True, eq=False)
class Level:
    """One cut: phi (n,) mm at the nodes, with a slope of about 1; bounds (b, n) mm; whether it takes out phi < 0; at
    (n, c): chart coordinates at the nodes, none without."""

    phi: np.ndarray
    bounds: np.ndarray | None = None
    takes_out: bool = False
    at: np.ndarray | None = None

    def __post_init__(self):
        bounds = np.empty((0, len(self.phi))) if self.bounds is None else self.bounds
        object.__setattr__(self, "phi", frozen_array(self.phi, float, (None,), "phi"))
        object.__setattr__(self, "bounds", frozen_array(bounds, float, (None, len(self.phi)), "bounds"))
        if self.takes_out and len(self.bounds):
            raise ValueError("what takes tissue out is closed: it has no bounds")


def snapped(mesh: Mesh, values: np.ndarray) -> np.ndarray:
    """Values (f, n) mm at the nodes, 0 where they are within SNAP of the mean size of the node's cells."""
    total = np.bincount(mesh.cells.ravel(), np.repeat(mesh.sizes, mesh.dim + 1), len(mesh.points))
    near = SNAP * total / np.maximum(mesh.valences, 1)
    return np.where(np.abs(values) < near, 0.0, values)


def crossed(mesh: Mesh, phi: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Cells (m,) that a cut with snapped values (n,), (b, n) at the nodes passes, or that have a facet on it."""
    own = phi[mesh.cells]
    through = (own.min(axis=1) < 0) & (own.max(axis=1) > 0)
    return (through | ((own == 0).sum(axis=1) >= mesh.dim)) & (bounds[:, mesh.cells].min(axis=2) < 0).all(axis=0)
