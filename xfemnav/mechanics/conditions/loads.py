"""Forces on the tissue beside the retractors': its weight, and pressures on walls and outline.

Both are dead loads: they keep the direction and place that they have at rest, as small strains imply.
"""

import numpy as np

from xfemnav.geometry.mesh import area_vectors
from xfemnav.geometry.plane.removal import wall_of
from xfemnav.geometry.plane.snapping import SNAP
from xfemnav.mechanics.rules import Gravity, Loads
from xfemnav.mechanics.space.quadrature import gauss_in_simplex
from xfemnav.mechanics.space.space import Space

#: Weight of a kilogramme per cubic metre, as kPa/mm: 9.80665 N/kg.
KPA_PER_MM = 9.80665e-6


def dead_loads(space: Space, loads: Loads, resections=()) -> np.ndarray:
    """Nodal forces (n_dof,) mN per mm of thickness of the weight and of all pressures."""
    load, split = np.zeros(space.enrichment.n_dof), space.parts
    if loads.gravity is not None:
        load += weight_load(space, loads.gravity)
    for pressure in loads.pressures:
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
    points, weights, parts = space.rule(~space.parts.removed[space.parts.part], degree=1)
    return (space.basis_in(points, parts).T @ (weights[:, None] * _weight(gravity, points))).ravel()


def _weight(gravity, points):
    """Force (k, d) kPa/mm on the tissue at points (k, d) mm."""
    down = np.asarray(gravity.direction, float)
    density = np.full(len(points), gravity.density)
    if gravity.fluid_level_mm is not None:
        density -= gravity.fluid_density * (points @ down > gravity.fluid_level_mm * np.linalg.norm(down))
    return KPA_PER_MM * density[:, None] * down


def pressure_load(space: Space, facets, parts, kpa: float) -> np.ndarray:
    """Nodal forces (n_dof,) mN, in the plane per mm thick, of a pressure on facets (k, d, d) mm of parts (k,)."""
    shares, weights = gauss_in_simplex(space.mesh.dim - 1, 4)
    points = (shares @ facets).reshape(-1, space.mesh.dim)
    force = np.repeat(-kpa * area_vectors(facets), len(weights), axis=0) * np.tile(weights, len(facets))[:, None]
    return (space.basis_in(points, np.repeat(parts, len(weights))).T @ force).ravel()
