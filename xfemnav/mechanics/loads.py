"""Forces on the tissue beside the retractors': its weight, and pressures on walls and outline.

Both are dead loads: they keep the direction and place that they have at rest, as small strains imply.
"""

from dataclasses import dataclass

import numpy as np

from xfemnav.geometry.removal import wall_of
from xfemnav.geometry.snapping import SNAP
from xfemnav.mechanics.quadrature import tip_rule
from xfemnav.mechanics.space import Space

#: Weight of a kilogramme per cubic metre, as kPa/mm: 9.80665 N/kg.
KPA_PER_MM = 9.80665e-6


@dataclass(frozen=True)
class Gravity:
    """Weight of the tissue: `direction` (2,) in the plane, its length the share of gravity there.

    Tissue farther along the direction than `fluid_level_mm` floats: its weight is that of the difference of the
    densities. None: no fluid, as after drainage of the cerebrospinal fluid. Densities in kg/m^3.
    """

    direction: tuple[float, float]
    density: float = 1000.0
    fluid_density: float = 1007.0
    fluid_level_mm: float | None = None

    def force(self, points) -> np.ndarray:
        """Force (k, 2) kPa/mm on the tissue at points (k, 2) mm."""
        down = np.asarray(self.direction, float)
        density = np.full(len(points), self.density)
        if self.fluid_level_mm is not None:
            density -= self.fluid_density * (points @ down > self.fluid_level_mm * np.linalg.norm(down))
        return KPA_PER_MM * density[:, None] * down


@dataclass(frozen=True)
class Pressure:
    """`kpa` on the wall of the resection with index `resection`, or on the outline (None); positive into the tissue."""

    kpa: float
    resection: int | None = None


def dead_loads(space: Space, gravity: Gravity | None, pressures: tuple[Pressure, ...], resections=()) -> np.ndarray:
    """Nodal forces (n_dof,) mN per mm of thickness of the weight and of all pressures."""
    load, split = np.zeros(space.enrichment.n_dof), space.parts
    if gravity is not None:
        load += weight_load(space, gravity)
    for pressure in pressures:
        if pressure.resection is None:
            load += pressure_load(space, split.rim.facets, split.rim.parts, pressure.kpa)
        else:
            k = pressure.resection
            own = wall_of(split.walls, resections[k], k, 4 * SNAP * space.mesh.sizes[split.cell[split.walls.parts]])
            load += pressure_load(space, split.walls.facets[own], split.walls.parts[own], pressure.kpa)
    return load


def weight_load(space: Space, gravity: Gravity) -> np.ndarray:
    """Nodal forces (n_dof,) mN per mm of thickness of the weight of the tissue that is left.

    Plain and Heaviside functions are linear on each triangle, so one point is exact; the level of a fluid is followed
    to the triangle.
    """
    split = space.parts
    left, about_tip = ~split.removed[split.part], np.isin(split.part, space.branch_parts)
    plain, about_tip = left & ~about_tip, left & about_tip
    points, weights, parts = split.corners[plain].mean(axis=1), split.volumes[plain], split.part[plain]
    if about_tip.any():
        at, w, owner = tip_rule(split.corners[about_tip], split.fronts.at)
        points, weights = np.concatenate([points, at]), np.concatenate([weights, w])
        parts = np.concatenate([parts, split.part[about_tip][owner]])
    return (space.basis_in(points, parts).T @ (weights[:, None] * gravity.force(points))).ravel()


def pressure_load(space: Space, ends, parts, kpa: float) -> np.ndarray:
    """Nodal forces (n_dof,) mN per mm of a pressure on facets (k, 2, 2) mm of parts (k,), tissue on their left."""
    t, w = np.polynomial.legendre.leggauss(4)
    along = ends[:, 1] - ends[:, 0]
    points = ends[:, None, 0] + (t[:, None] + 1) / 2 * along[:, None]
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)  # as long as the facet
    force = kpa * np.repeat(inward, len(t), axis=0) * np.tile(w / 2, len(ends))[:, None]
    return (space.basis_in(points.reshape(-1, 2), np.repeat(parts, len(t))).T @ force).ravel()
