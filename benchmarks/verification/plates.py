"""Plates with cracks: tractions, displacements given on the outline, and point supports, on a cut mesh."""

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.subcells import embed
from xfemnav.mechanics.conditions.constraints import SKULL, Constraints, Contacts, stack, vector_rows
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.rules import Basis, Rules, Skull
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material


def cut_space(mesh: Mesh, cuts: tuple[Cut, ...], tip_enrichment: str, tip_radius_mm: float | None = None) -> Space:
    """The finite element space of a mesh with cuts."""
    split = embed(mesh, cuts)
    return Space(mesh, split, enrich(mesh, split, Basis(tip_enrichment, tip_radius_mm)))


def plate_problem(
    space: Space,
    cuts: tuple[Cut, ...],
    material: Material,
    conditions: list[Constraints],
    load,
    tip_enrichment: str,
    contacts: Contacts | None = None,
) -> Problem:
    """A problem without skull and retractors."""
    n_dof = space.enrichment.n_dof
    return Problem(
        space=space,
        cuts=cuts,
        material=material,
        skull=Skull("free"),
        retractions=(),
        spans=np.empty((0, 2)),
        constraints=stack(conditions, n_dof),
        springs=csr_array((n_dof, n_dof)),
        load=load,
        removed=np.zeros(space.parts.n_parts, dtype=bool),
        rules=Rules(Basis(tip_enrichment)),
        contacts=contacts,
    )


def rim(space: Space, where: Callable) -> np.ndarray:
    """Facets (k,) of the outline whose middle (b, 2) satisfies `where`."""
    return np.flatnonzero(where(space.parts.rim.facets.mean(axis=1)))


def traction_load(space: Space, facets, traction) -> np.ndarray:
    """Nodal forces (n_dof,) of a constant traction (2,) kPa on facets of the outline."""
    t, w = np.polynomial.legendre.leggauss(4)
    ends = space.parts.rim.facets[facets]
    along = ends[:, 1] - ends[:, 0]
    points = ends[:, None, 0] + (t[:, None] + 1) / 2 * along[:, None]
    weights = np.outer(np.linalg.norm(along, axis=1), w / 2)
    B = space.basis_in(points.reshape(-1, 2), np.repeat(space.parts.rim.parts[facets], len(t)))
    return np.outer(B.T @ weights.ravel(), traction).ravel()


def given_on_rim(space: Space, facets, displacement: Callable) -> Constraints:
    """u = displacement(points (k, d), inside (k, d)) mm at all corners of facets of the outline.

    `inside` are the middles of the facets: at a mouth they tell on which side of the cut the point lies.
    """
    ends = space.parts.rim.facets[facets]
    d = ends.shape[2]
    points, middles = ends.reshape(-1, d), np.repeat(ends.mean(axis=1), d, axis=0)
    B = space.basis_in(points, np.repeat(space.parts.rim.parts[facets], d))
    B.data[np.abs(B.data) < 1e-12] = 0
    B.eliminate_zeros()
    return vector_rows(B, displacement(points, middles), SKULL)


def supports(space: Space, points, components) -> Constraints:
    """u_i = 0 at the nodes nearest to points (k, 2), component i (k,): against rigid motions of a plate in balance."""
    near = [int(np.argmin(np.linalg.norm(space.mesh.points - p, axis=1))) for p in points]
    C = csr_array(
        (np.ones(len(near)), (np.arange(len(near)), 2 * np.array(near) + components)),
        (len(near), space.enrichment.n_dof),
    )
    return Constraints(C, np.zeros(len(near)), np.full(len(near), SKULL))
