"""Conditions on the organ's outline: the skull, the craniotomy and its ramp, measured displacements."""

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.constraints import SKULL, Constraints, normal_rows, stack, vector_rows
from xfemnav.mechanics.elasticity import Material, Tissue
from xfemnav.mechanics.space import Space

#: Length over which the skull's springs reach the tissue's own stiffness: k = (E / RAMP_STIFFNESS_MM) x / (1 - x).
RAMP_STIFFNESS_MM = 2.0
#: Penalty, in units of M / h, on the held part of a facet that begins free.
STRADDLE_PENALTY = 1.5
#: Where measured points are farther apart than this along the outline, the skull's own condition holds between them.
MEASURED_GAP_MM = 20.0
#: A measured point farther than this from the outline is refused.
MEASURED_OFF_MM = 10.0


@dataclass(frozen=True)
class Skull:
    """The outline is 'fixed', 'sliding' (no normal motion) or 'free', except within `craniotomy_mm` of a mouth.

    From there its grip grows over `ramp_mm` by springs; 0 switches it on at a point.
    """

    kind: str = "fixed"
    craniotomy_mm: float = 20.0
    ramp_mm: float = 4.0

    def __post_init__(self):
        if self.kind not in ("fixed", "sliding", "free"):
            raise ValueError(f"skull {self.kind!r} is not fixed, sliding or free")


@dataclass(frozen=True, eq=False)
class Rim:
    """Points of the outline where it can be held: facet ends, and inner points of facets with branch functions.

    points (k, 2) mm, parts (k,), and of each point's facet: middles (k, 2) mm, outward normals (k, 2), lengths (k,) mm.
    """

    points: np.ndarray
    parts: np.ndarray
    middles: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray


def skull_conditions(
    space: Space, skull: Skull, mouths, material: Material | Tissue, measured=None
) -> tuple[Constraints, csr_array]:
    """Conditions C U = d on the outline and the spring matrix (n_dof, n_dof) kPa of the ramp.

    mouths (m, 2) mm: the mouths about which the skull is open. measured (k, 4 or 5): x, y, ux, uy mm and, where it
    matters, side (+1 left, -1 right): displacements of the outline, interpolated along it.
    Raises XfemnavError E408 when the measured points lie off the outline.
    """
    n_dof = space.enrichment.n_dof
    rim = _rim(space)
    parts = []
    known = np.zeros(len(rim.points), dtype=bool)
    if measured is not None:
        known, values = _measured(space, rim, np.asarray(measured, float))
        parts.append(_vector_conditions(space, rim, known, values[known]))
    if skull.kind != "free":
        held = ~known & (_distance(rim.points, mouths) >= _rigid_from(skull, rim.lengths))
        make = _vector_conditions if skull.kind == "fixed" else _sliding_conditions
        parts.append(make(space, rim, held, np.zeros((held.sum(), 2))))
    springs = csr_array((n_dof, n_dof))
    if skull.kind != "free" and len(mouths):
        b = len(space.subcells.rim_ends)
        springs = _springs(space, skull, mouths, material, ~(known[:b] & known[b : 2 * b]))
    return stack(parts, n_dof), springs


def _rim(space):
    sub = space.subcells
    a, b = sub.rim_ends.swapaxes(0, 1)
    length = np.linalg.norm(b - a, axis=1)
    outward = _outward(a, b)
    every, branched = np.arange(len(a)), np.flatnonzero(np.isin(sub.rim_part, space.branch_parts))
    chosen = [(0.0, every), (1.0, every), (1 / 3, branched), (2 / 3, branched)]
    points = np.concatenate([a[k] + f * (b - a)[k] for f, k in chosen])
    facet = np.concatenate([k for _, k in chosen])
    return Rim(points, sub.rim_part[facet], ((a + b) / 2)[facet], outward[facet], length[facet])


def _outward(a, b):
    """Unit normals (k, 2) away from the tissue of facets a-b with the tissue on their left."""
    d = (b - a) / np.linalg.norm(b - a, axis=1)[:, None]
    return np.stack([d[:, 1], -d[:, 0]], axis=1)


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


def _vector_conditions(space, rim, held, values):
    """u = value at the held rim points; a node shared by two facets is held once."""
    B = space.basis_in(rim.points[held], rim.parts[held])
    column = _single(B)
    key = np.where(column >= 0, column, B.shape[1] + np.arange(len(column)))
    _, first = np.unique(key, return_index=True)
    return vector_rows(B[first], values[first], SKULL)


def _sliding_conditions(space, rim, held, _):
    """n . u = 0 at the held rim points, with the mean normal of the facets that meet at a node."""
    B = space.basis_in(rim.points[held], rim.parts[held])
    column = _single(B)
    key = np.where(column >= 0, column, B.shape[1] + np.arange(len(column)))
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    normals = np.zeros((len(first), 2))
    np.add.at(normals, group, rim.normals[held] * rim.lengths[held][:, None])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return normal_rows(B[first], normals, np.zeros(len(first)), SKULL)


def _rigid_from(skull, lengths):
    """Distance (k,) mm from a mouth at which nodes between facets of the given lengths (k,) mm are held rigidly.

    A rigid node acts like a switch .4 h before it. So behind a hard switch nodes nearer than .5 h are left to the
    penalty; at the end of a ramp the springs are stiff already.
    """
    return skull.craniotomy_mm + skull.ramp_mm + (0.5 * lengths if skull.ramp_mm == 0 else np.zeros(len(lengths)))


def _springs(space, skull, mouths, material, unknown):
    """Integral of k u.u (fixed) or k (n.u)^2 (sliding): the ramp, and the held part of facets that begin free.

    On the ramp k = (E / 2 mm) x / (1 - x). Conditions hold nodes, so the grip would begin with the next rigid node:
    where it should be complete but a facet's end is not rigid, it gets the penalty 1.5 M / h, M the P-wave modulus.
    Only facets that are `unknown` (b,): the others move as measured.
    """
    sub = space.subcells
    a, b = sub.rim_ends.swapaxes(0, 1)
    length = np.linalg.norm(b - a, axis=1)
    full = skull.craniotomy_mm + skull.ramp_mm
    ends = np.stack([_distance(a, mouths), _distance(b, mouths)])
    on_the_ramp = (ends.min(axis=0) < _rigid_from(skull, length)) & (ends.max(axis=0) > skull.craniotomy_mm)
    near = np.flatnonzero(on_the_ramp & unknown)
    t, w = _composite_gauss(8, 4)
    points = (a[near, None] + t[None, :, None] * (b - a)[near, None]).reshape(-1, 2)
    weights = np.outer(length[near], w).ravel()
    facet = np.repeat(near, len(t))
    distance = _distance(points, mouths)
    x = (distance - skull.craniotomy_mm) / skull.ramp_mm if skull.ramp_mm > 0 else np.zeros(len(points))
    x = np.clip(x, 0, 0.999)
    cell = sub.part_cell[sub.rim_part[facet]]
    beyond = STRADDLE_PENALTY * material.stiffness_in(cell)[:, 0, 0] / space.mesh.sizes[cell]
    k = weights * np.where(distance >= full, beyond, material.young_in(cell) / RAMP_STIFFNESS_MM * x / (1 - x))
    points, facet, k = points[k > 0], facet[k > 0], k[k > 0]
    B = space.basis_in(points, sub.rim_part[facet])
    if skull.kind == "sliding":
        C = normal_rows(B, _outward(a, b)[facet], np.zeros(len(k)), SKULL).C
        return csr_array(C.T @ C.multiply(k[:, None]).tocsr())
    C = vector_rows(B, np.zeros((len(k), 2)), SKULL).C
    return csr_array(C.T @ C.multiply(np.repeat(k, 2)[:, None]).tocsr())


def _composite_gauss(pieces, n):
    """Points and weights on [0, 1]: n Gauss points in each of equal pieces."""
    t, w = np.polynomial.legendre.leggauss(n)
    return ((np.arange(pieces)[:, None] + (t + 1) / 2) / pieces).ravel(), np.tile(w / 2 / pieces, pieces)


def _measured(space, rim, measured):
    """Which rim points lie between measured ones, and their displacements (k, 2) mm, linear along the outline."""
    sub, mesh = space.subcells, space.mesh
    if measured.ndim != 2 or measured.shape[1] not in (4, 5) or not np.isfinite(measured[:, :4]).all():
        raise XfemnavError("E408", "measured boundary displacements need the columns x,y,ux,uy (and side), all finite.")
    loop = mesh.points[mesh.boundary_loops[0]]
    outline = shapely.LinearRing(loop)
    off = outline.distance(shapely.points(measured[:, :2]))
    if off.max() > MEASURED_OFF_MM:
        x, y = measured[np.argmax(off), :2]
        raise XfemnavError(
            "E408", f"measured point ({x:.1f}, {y:.1f}) mm is {off.max():.1f} mm from the outline; check its frame."
        )
    total = outline.length
    mouths, entering = _mouth_arcs(sub, outline)
    origin = mouths[0] if len(mouths) else 0.0
    # A facet's end at a mouth belongs to the facet's own side: a point a little inside the facet tells which.
    inside = _arc(outline, rim.points + 1e-6 * (rim.middles - rim.points), origin)
    rim_arc = inside + np.mod(_arc(outline, rim.points, origin) - inside + total / 2, total) - total / 2
    arc = _arc(outline, measured[:, :2], origin)
    if measured.shape[1] == 5:
        arc = _beside_mouth(arc, measured[:, 4], np.mod(mouths - origin, total), entering, total)
    bounds = (
        np.concatenate([np.sort(np.mod(mouths - origin, total)), [total]]) if len(mouths) else np.array([0.0, total])
    )
    known, values = np.zeros(len(rim.points), dtype=bool), np.zeros((len(rim.points), 2))
    for low, high in zip(bounds[:-1], bounds[1:]):
        own, here = (arc >= low) & (arc <= high), (inside >= low) & (inside <= high)
        order = np.argsort(arc[own], kind="stable")
        at, u = arc[own][order], measured[own, 2:4][order]
        if not len(mouths) and len(at):  # the outline closes on itself
            at, u = np.concatenate([[at[-1] - total], at, [at[0] + total]]), np.vstack([u[-1], u, u[0]])
        if len(at):
            gaps = np.concatenate([[at[0] - low], np.diff(at), [high - at[-1]]])
            # A measured point itself lies in the gaps on both its sides.
            around = [gaps[np.searchsorted(at, rim_arc[here] + off)] for off in (-1e-9, 1e-9)]
            known[here] = np.minimum(*around) <= MEASURED_GAP_MM
            values[here] = np.stack([np.interp(rim_arc[here], at, u[:, i]) for i in (0, 1)], axis=1)
    return known, values


def _arc(outline, points, origin):
    return np.mod(shapely.line_locate_point(outline, shapely.points(points)) - origin, outline.length)


def _mouth_arcs(sub, outline):
    """Position (m,) mm along the outline of every place where a cut meets it, and +1 if it enters, -1 if it leaves."""
    ends = np.array([path[end] for path in sub.paths for end in (0, -1)]).reshape(-1, 2)
    on = outline.distance(shapely.points(ends)) < 1e-6
    return shapely.line_locate_point(outline, shapely.points(ends[on])), np.tile([1, -1], len(sub.paths))[on]


def _beside_mouth(arc, side, mouths, entering, total):
    """Put measured points with a side on that side of a mouth nearer than 5 mm (or a fiftieth of a short outline).

    With tissue on the left of the outline, the lip on the left of a cut that enters ends before the mouth, and that of
    one that leaves, right through the organ, begins after it.
    """
    arc = arc.copy()
    for mouth, sense in zip(mouths, entering):
        ahead = np.mod(arc - mouth + total / 2, total) - total / 2
        wrong = (np.abs(ahead) < min(5.0, total / 50)) & (side * sense * ahead >= 0) & (side != 0)
        arc[wrong] = np.mod(mouth - 1e-7 * sense * side[wrong], total)
    return arc
