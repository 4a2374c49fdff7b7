"""Conditions on the organ's outline: the skull, the craniotomy and its ramp, arcs of their own, measured displacements.

Along each facet the outline is 'fixed', 'sliding' (no normal motion), 'free', or in 'contact': it may leave the skull,
without friction, but not pass through it: n . u <= gap, n outward.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array
from xfemnav.mechanics.conditions.arcs import facet_kinds
from xfemnav.mechanics.conditions.bodies import free_motions
from xfemnav.mechanics.conditions.constraints import (
    SKULL,
    Constraints,
    Contacts,
    each_component,
    normal_rows,
    stack,
    vector_rows,
)
from xfemnav.mechanics.conditions.contact import join
from xfemnav.mechanics.conditions.measured import measured_at, refuse_nothing
from xfemnav.mechanics.rules import Measured, Skull
from xfemnav.mechanics.space.rim import rim_points, rim_quadrature
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, Tissue

#: Length over which the skull's springs reach the tissue's own stiffness: k = (E / RAMP_STIFFNESS_MM) x / (1 - x).
RAMP_STIFFNESS_MM = 2.0
#: Penalty, in units of M / h, on the held or measured part of a facet that begins free.
STRADDLE_PENALTY = 1.5
#: Springs, in units of E / mm, on what nothing but contact holds.
WEAK = 1e-6


@dataclass(frozen=True, eq=False)
class OutlineConditions:
    """What acts on the outline: conditions C U = d, springs (n_dof, n_dof) kPa and their load (n_dof,) mN, contacts.

    weak (n_dof, n_dof) kPa: springs for what nothing but the outline's contacts holds.
    """

    constraints: Constraints
    springs: csr_array
    load: np.ndarray
    contacts: Contacts
    weak: csr_array

    def __post_init__(self):
        object.__setattr__(self, "load", frozen_array(self.load, float, (self.springs.shape[0],), "load"))


def hung(space: Space, constraints: Constraints, springs, weak) -> csr_array | None:
    """The `weak` springs of those bodies that conditions and other springs leave free to move; None if there are none.
    """
    table = space.enrichment
    row_body = np.full(table.n_rows, -1)
    row_body[table.dof] = table.body[:, None]
    touching = np.unique(row_body[np.flatnonzero(weak.diagonal()) // space.mesh.dim])
    touching = touching[touching >= 0]  # branch functions belong to no body alone
    loose = [body for body in touching if free_motions(space, constraints, springs, body).shape[1]]
    if not loose:
        return None
    own = np.repeat(np.isin(row_body, loose), space.mesh.dim).astype(float)
    return csr_array(weak.multiply(own[:, None]).multiply(own[None, :]))


def image_ends(skull: Skull, points) -> np.ndarray:
    """Whether the image ends at points (k, d) mm of the outline, (k,) bool."""
    if skull.border is None:
        return np.zeros(len(points), dtype=bool)
    low, high, near, *frame = skull.border
    for rows in np.array(frame):  # the border is that of an image that may lie obliquely
        points = points @ rows[:, :3].T + rows[:, 3]
    return np.min(np.abs(np.stack([points - low, points - high])), axis=(0, 2)) < near


def refuse_mouths(skull: Skull, cuts) -> None:
    """Raises XfemnavError E302 for a cut that enters where the image ends: there is no surface to open."""
    for cut in cuts:
        ends = image_ends(skull, cut.mouth_line)
        if ends.any():
            at = ", ".join(f"{x:.1f}" for x in cut.mouth_line[ends.argmax()])
            raise XfemnavError("E302", f"cut '{cut.name}' enters at ({at}) mm, where the image ends "
                                       "inside the organ: there is no surface to open. Give an image that holds "
                                       "the organ where the cut enters.")


def skull_conditions(
    space: Space, skull: Skull, mouths, material: Material | Tissue, pulled=()
) -> OutlineConditions:
    """Conditions, springs and contacts on the outline.

    mouths (m, 2) mm: the mouths about which the skull is open, beside its own openings. pulled: numbers of the cuts
    that blades act on.
    Raises XfemnavError E408 when the measured points lie off the outline or hold nothing, E409 for arcs that do.
    """
    n_dof = space.enrichment.n_dof
    rim = rim_points(space)
    kinds, gaps = facet_kinds(space, skull)
    ends, mouths = image_ends(skull, rim.middles[: len(kinds)]), np.array([*mouths, *skull.openings])
    kinds[ends] = "fixed"
    known, values = np.zeros(len(rim.points), dtype=bool), np.zeros(rim.points.shape)
    if skull.measured is not None:
        known, values = measured_at(space, rim, np.array(skull.measured.rows), pulled)
    depth = _Depth(space, kinds, skull, mouths)
    rigid = ~known & (ends[rim.facet] | (depth(rim.points) >= _rigid_from(skull, rim.lengths)))
    kind = kinds[rim.facet]
    fixed, sliding = rigid & (kind == "fixed"), rigid & (kind == "sliding")
    parts = [_vector_conditions(space, rim, fixed, np.zeros(rim.points.shape))] if fixed.any() else []
    parts += [_sliding_conditions(space, rim, sliding)] if sliding.any() else []
    springs = _springs(space, skull, depth, kinds, material, ~ends & ~_at_corners(space, known).all(axis=0))
    load = np.zeros(n_dof)
    if skull.measured is not None:
        if skull.measured.weight is None:
            parts.insert(0, _vector_conditions(space, rim, known, values))
        pull, load = _drawn(space, skull.measured, pulled, known, material)
        springs = csr_array(springs + pull)
    touching = ~known & (kind == "contact") & (_distance(rim.points, mouths) >= skull.craniotomy_mm)
    touching[space.mesh.dim * len(kinds) :] = False
    contacts = join([_contacts(space, rim, touching, gaps[rim.facet])] if touching.any() else [], n_dof)
    weak = np.flatnonzero(_at_corners(space, touching).any(axis=0))
    return OutlineConditions(stack(parts, n_dof), springs, load, contacts, _weak(space, weak, material))


def _at_corners(space, chosen):
    """Of `rim_points` (k,) those at the corners (d, b) of the facets (b,)."""
    d, b = space.mesh.dim, len(space.parts.rim.parts)
    return chosen[: d * b].reshape(d, b)


class _Depth:
    """How far points (k, 2) mm of the outline are from where the skull's grip begins, (k,) mm: inside it, positive."""

    def __init__(self, space, kinds, skull, mouths):
        loose = np.isin(kinds, ("free", "contact")) & (len(skull.arcs) > 0)
        self.open = shapely.MultiLineString(list(space.parts.rim.facets[loose])) if loose.any() else None
        self.craniotomy_mm, self.mouths = skull.craniotomy_mm, mouths

    def __call__(self, points):
        depth = _distance(points, self.mouths) - self.craniotomy_mm
        return depth if self.open is None else np.minimum(depth, shapely.distance(self.open, shapely.points(points)))


def _distance(points, mouths):
    if not len(mouths):
        return np.full(len(points), np.inf)
    return np.linalg.norm(points[:, None] - np.asarray(mouths), axis=2).min(axis=1)


def _single(B):
    """The column of each row that has one entry, else -1: the condition is on one nodal displacement."""
    B.data[np.abs(B.data) < 1e-12] = 0
    B.eliminate_zeros()
    column = np.full(B.shape[0], -1)
    one = np.diff(B.indptr) == 1
    column[one] = B.indices[B.indptr[:-1][one]]
    return column


def _places(space, rim, chosen):
    """Basis B (k, n_rows) at the chosen rim points; the first of each place, and the place of each: a node that facets
    share is one."""
    B = space.basis_in(rim.points[chosen], rim.parts[chosen])
    column = _single(B)
    key = np.where(column >= 0, column, B.shape[1] + np.arange(len(column)))
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    return B, first, place


def _mean_normals(rim, chosen, n_places, place):
    """Mean normals (n_places, 2) of the facets that meet at each place."""
    normals = np.zeros((n_places, rim.normals.shape[1]))
    np.add.at(normals, place, rim.normals[chosen] * rim.sizes[chosen][:, None])
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def _vector_conditions(space, rim, held, values):
    """u = value at the held rim points."""
    B, first, _ = _places(space, rim, held)
    return vector_rows(B[first], values[held][first], SKULL)


def _sliding_conditions(space, rim, held):
    """n . u = 0 at the held rim points."""
    B, first, place = _places(space, rim, held)
    return normal_rows(B[first], _mean_normals(rim, held, len(first), place), np.zeros(len(first)), SKULL)


def _contacts(space, rim, chosen, gaps):
    """n . u <= gap at the chosen ends of facets, each for half a facet on its sides."""
    B, first, place = _places(space, rim, chosen)
    normals = _mean_normals(rim, chosen, len(first), place)
    starts, lengths = (np.arange(len(chosen)) < len(np.unique(rim.facet)))[chosen], rim.sizes[chosen]
    hats, gap = np.zeros((len(first), 3)), np.full(len(first), np.inf)
    np.add.at(hats[:, 2], place[starts], lengths[starts])
    np.subtract.at(hats[:, 0], place[~starts], lengths[~starts])
    np.minimum.at(gap, place, gaps[chosen])
    outward = normal_rows(B[first], normals, np.zeros(len(first)), SKULL).C
    return Contacts(-outward, gap, np.full(len(first), SKULL), rim.points[chosen][first], hats)


def _rigid_from(skull, lengths):
    """Depth (k,) mm at which nodes between facets of the given lengths (k,) mm are held rigidly.

    A rigid node acts like a switch .4 h before it. So behind a hard switch nodes nearer than .5 h are left to the
    penalty; at the end of a ramp the springs are stiff already.
    """
    return skull.ramp_mm + (0.5 * lengths if skull.ramp_mm == 0 else np.zeros(len(lengths)))


def _springs(space, skull, depth, kinds, material, unknown):
    """Integral of k u.u (fixed) or k (n.u)^2 (sliding): the ramp, and the held part of facets that begin free.

    On the ramp k = (E / 2 mm) x / (1 - x). Conditions hold nodes, so the grip would begin with the next rigid node:
    where it should be complete but a facet's end is not rigid, it gets the penalty 1.5 M / h, M the P-wave modulus.
    Only facets that are `unknown` (b,): the others move as measured.
    """
    split = space.parts
    ends = np.stack([depth(corners) for corners in split.rim.facets.swapaxes(0, 1)])
    rigid = _rigid_from(skull, _at_corners(space, rim_points(space).lengths)[0])
    on_the_ramp = (ends.min(axis=0) < rigid) & (ends.max(axis=0) > 0)
    near = np.flatnonzero(on_the_ramp & unknown & np.isin(kinds, ("fixed", "sliding")))
    if not len(near):
        return csr_array((space.enrichment.n_dof,) * 2)
    rim, weights = rim_quadrature(space, near)
    distance = depth(rim.points)
    x = np.clip(distance / skull.ramp_mm, 0, 0.999) if skull.ramp_mm > 0 else np.zeros(len(distance))
    cell = split.cell[rim.parts]
    beyond = STRADDLE_PENALTY * material.p_wave_in(cell) / space.mesh.sizes[cell]
    k = weights * np.where(distance >= skull.ramp_mm, beyond, material.young_in(cell) / RAMP_STIFFNESS_MM * x / (1 - x))
    slides = kinds[rim.facet] == "sliding"
    if not slides.any():
        return _spring_matrix(space, rim, k)
    B = space.basis_in(rim.points, rim.parts)
    along = normal_rows(B, rim.normals, np.zeros(len(k)), SKULL).C
    sliding = along.T @ along.multiply((k * slides)[:, None]).tocsr()
    return csr_array(_spring_matrix(space, rim, np.where(slides, 0.0, k)) + sliding)


def _spring_matrix(space, rim, k):
    """Matrix (n_dof, n_dof) kPa of the energy sum k u.u / 2 at rim points, k (q,) kPa."""
    on = np.flatnonzero(k > 0)
    B = space.basis_in(rim.points[on], rim.parts[on])
    scaled = csr_array((B.data * np.repeat(k[on], np.diff(B.indptr)), B.indices, B.indptr), B.shape)
    return each_component(B.T @ scaled, space.mesh.dim)


def _drawn(space, measured: Measured, pulled, known, material):
    """Springs (n_dof, n_dof) kPa and load (n_dof,) mN of the integral of k (u - measured).v, where the motion is known.

    k is the weight. Without one the rim points `known` (q,) are held, and k is the penalty 1.5 M / h on facets of which
    they hold one end, or none, so that a stretch ends where it was measured and not at the next node.
    """
    weight = measured.weight
    if weight is not None and not 0 < weight < np.inf:
        raise XfemnavError("E408", f"measured displacements have the weight {weight:g} kPa/mm; give a positive number.")
    every = np.ones(len(space.parts.rim.parts), dtype=bool)
    facets = np.flatnonzero(every if weight is not None else ~_at_corners(space, known).all(axis=0))
    rim, weights = rim_quadrature(space, facets, pieces=2 if weight is not None else 8)
    also, values = measured_at(space, rim, np.array(measured.rows), pulled)
    refuse_nothing(also if weight is not None else np.concatenate([known, also]))
    cell = space.parts.cell[rim.parts]
    penalty = STRADDLE_PENALTY * material.p_wave_in(cell) / space.mesh.sizes[cell]
    k = (weight if weight is not None else penalty) * weights * also
    load = space.basis_in(rim.points, rim.parts).T @ (k[:, None] * values)
    return _spring_matrix(space, rim, k), load.ravel()


def _weak(space, facets, material):
    """Springs of 1e-6 E / mm along facets of the outline."""
    if not len(facets):
        return csr_array((space.enrichment.n_dof,) * 2)
    rim, weights = rim_quadrature(space, facets, pieces=1, n=2)
    return _spring_matrix(space, rim, WEAK * weights * material.young_in(space.parts.cell[rim.parts]))
