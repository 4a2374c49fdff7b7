"""Stress intensity factors K_I, K_II of a free tip by the interaction integral in its domain form.

I = - integral over A of P_j dq/dx_j + integral over the lips of P_j m_j q, with
P_j = W delta_1j - s_ij u'_i,1 - s'_ij u_i,1: the primed field is the leading term of one mode with unit intensity, W
the mutual energy, q falls smoothly from 1 to 0 with the distance from the tip, m points out of the tissue. On straight,
free lips the second integral is zero; it counts on kinked and curved cuts. (Moran & Shih 1987; Moes et al. 1999.)
Lips that press on each other with p have the traction s_ij m_j = -p m_i, so the second integral gains p m_i u'_i,1 q.
Of mode II u'_i,1 has the same normal component on both lips of a straight cut, where m is opposite: the pressure does
no work on it, and only K_I needs the term.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import shapely

from xfemnav.geometry.mesh import orient
from xfemnav.mechanics.conditions.contact import lip_pressure
from xfemnav.mechanics.conditions.lips import lip_quadrature
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.rules import LEFT, RIGHT
from xfemnav.mechanics.solving.tip_basis import mode_combinations, tip_frame
from xfemnav.mechanics.space.angles import centroids, touched_parts, unwrap
from xfemnav.mechanics.space.branch import branch_gradients, polar
from xfemnav.mechanics.space.quadrature import collapsed_rule
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, hooke

#: q is 1 within this fraction of the domain's radius.
PLATEAU = 0.3
#: Ends of pieces that halve towards a tip, in units of the domain's radius.
HALVES = 2.0 ** -np.arange(30)
PA_SQRT_M = 1e3 * 10**-1.5  # one kPa mm^.5


def stress_intensity(
    space: Space, material: Material, U, tip: int, radius_mm: float, pressure: Callable | None = None
) -> tuple[float, float]:
    """(K_I, K_II) kPa mm^.5 of a tip whose lips nobody holds within `radius_mm`.

    U (n_rows, 2) mm: the coefficients of the solution. pressure(arc (q,) mm) -> (q,) kPa between the lips; None for
    none. The disc must hold no other tip, no held part of a lip and no
    outline but the lips themselves. 1 kPa mm^.5 = 31.6 Pa m^.5.
    """
    split = space.parts
    x, frame = split.fronts.at[tip], tip_frame(split.fronts.travel[tip])
    part_near = np.linalg.norm(split.corners - x, axis=2).min(axis=1) < radius_mm
    inside = np.zeros(split.n_parts, dtype=bool)
    inside[split.part[part_near]] = True
    angle = unwrap(split, centroids(split), tip, inside)
    reached = part_near & np.isfinite(angle[split.part])
    points, weights, owner = _domain_rule(split.corners[reached], x, radius_mm)
    parts = split.part[reached][owner]
    P = _flux(_About(space, material, tip, frame), np.asarray(U), points, parts, angle[parts])
    offset = (points - x) @ frame.T
    r = np.hypot(*offset.T)
    _, slope = _weight(r / radius_mm)
    dq = (slope / radius_mm / r)[:, None] * offset
    integral = -np.einsum("q,mqj,qj->m", weights, P, dq)
    integral += _lip_integral(space, material, np.asarray(U), tip, angle, frame, radius_mm, pressure)
    modulus = material.young_kpa
    if not material.plane_stress:
        modulus /= 1 - material.poisson**2
    K_I, K_II = integral * modulus / 2
    return float(K_I), float(K_II)


@dataclass(frozen=True)
class FreeTip:
    """Intensity of the stress at a tip: K_I opens, K_II shears; from the disc of `radius_mm` about it."""

    cut: int
    point_mm: tuple[float, float]
    K_I_Pa_sqrt_m: float
    K_II_Pa_sqrt_m: float
    radius_mm: float


def free_tips(problem: Problem, U, force) -> tuple[FreeTip, ...]:
    """The stress intensity factors of every tip with a free disc of at least two elements about it.

    The disc keeps off forces inside of the tissue, which the integral leaves out: weight, and what holds a loose piece.
    force (g,) mN per mm: the multipliers of the problem's contacts.
    """
    split, table, found = problem.parts, problem.space.enrichment, []
    if not len(split.fronts.at):
        return ()
    pushed = problem.load.reshape(-1, 2).any(axis=1)
    if problem.means is not None:
        pushed[problem.means.C.indices // 2] = True
    for tip, x in enumerate(split.fronts.at):
        h = problem.mesh.sizes[split.cell[touched_parts(split, tip)]].max()
        radius = 0.9 * _clearance(problem, tip, pushed[table.dof].any(axis=1))
        if radius >= 2 * h:
            material = problem.material.at(split.cell[touched_parts(split, tip)[0]])
            cut = int(split.fronts.cut[tip])
            pressure = partial(lip_pressure, problem.contacts, force, cut) if np.any(force) else None
            K = np.array(stress_intensity(problem.space, material, U, tip, radius, pressure)) * PA_SQRT_M
            found.append(FreeTip(cut, tuple(x.tolist()), float(K[0]), float(K[1]), float(radius)))
    return tuple(found)


def _clearance(problem, tip, pushed):
    """Distance mm from a tip to the nearest outline, tip, cut, tissue but its own, held or loaded lip, or part that is
    `pushed` (p,) bool."""
    split, x = problem.parts, problem.parts.fronts.at[tip]
    own = split.cell[touched_parts(split, tip)[0]]
    moduli = np.stack(problem.material.moduli_in(split.cell))
    other = np.abs(moduli - moduli[:, split.cell == own][:, :1]).max(axis=0) > 1e-9 * moduli.sum(axis=0).max()
    other = (other | pushed)[split.part]
    rim = np.concatenate([split.rim.facets, split.walls.facets])
    distance = [shapely.linestrings(rim), shapely.points(np.delete(split.fronts.at, tip, axis=0))]
    distance.append(shapely.polygons(split.corners[other]))
    distance.append(shapely.linestrings(split.lips.facets[split.lips.cut != split.fronts.cut[tip]]))
    for retraction, span in zip(problem.retractions, problem.spans):
        held = (split.lips.cut == retraction.cut) & (split.lips.arc[:, 0] < span[1]) & (split.lips.arc[:, 1] > span[0])
        distance.append(shapely.linestrings(split.lips.facets[held]))
    return float(min(shapely.distance(lines, shapely.Point(x)).min(initial=np.inf) for lines in distance))


def _weight(s):
    """q and dq/ds of the distance s from the tip in units of the domain's radius: a quintic step."""
    t = np.clip((s - PLATEAU) / (1 - PLATEAU), 0, 1)
    return 1 - t**3 * (10 - 15 * t + 6 * t**2), -30 * t**2 * (1 - t) ** 2 / (1 - PLATEAU)


def _domain_rule(corners, x, radius):
    """Quadrature (points, weights, triangle) where q varies: triangles small against the annulus's width."""
    owner = np.arange(len(corners))
    while True:
        size = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
        large = size > 0.25 * radius
        if not large.any():
            break
        a, b, c = corners[large].swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        corners = np.concatenate([corners[~large], *quarters])
        owner = np.concatenate([owner[~large], np.tile(owner[large], 4)])
    distance = np.linalg.norm(corners - x, axis=2)
    varying = (distance.max(axis=1) > PLATEAU * radius) & (orient(*corners.swapaxes(0, 1)) > 0)
    points, weights = collapsed_rule(corners[varying], 4)
    return points.reshape(-1, 2), weights.ravel(), np.repeat(owner[varying], weights.shape[1])


class _About(NamedTuple):
    """A tip by its number and its frame (2, 2), in a space, in one material."""

    space: Space
    material: Material
    tip: int
    frame: np.ndarray


def _flux(about, U, points, parts, reference, real_traction=True):
    """P_j (2 modes, q, 2) in the tip's frame, of the solution with the unit field of each mode."""
    space, material, tip, frame = about
    mu, lam = (constant[0] for constant in material.moduli_in([0]))
    along = np.stack([g @ U for g in space.gradient_in(points, parts)], axis=2)
    gradient = np.einsum("ai,qij,bj->qab", frame, along, frame)
    unit = _unit_gradient(space, material, points, tip, reference, frame)
    stress, unit_stress = hooke(gradient, mu, lam), hooke(unit, mu, lam)
    P = -np.einsum("mqij,qi->mqj", unit_stress, gradient[:, :, 0])
    if real_traction:
        P -= np.einsum("qij,mqi->mqj", stress, unit[..., 0])
    P[..., 0] += np.einsum("qij,mqij->mq", stress, unit)
    return P


def _unit_gradient(space, material, points, tip, reference, frame):
    """u'_i,j (2 modes, q, 2, 2), 1/mm, of each mode with unit intensity, in the tip's frame."""
    tips = np.broadcast_to(space.parts.fronts.at[tip], points.shape)
    r, theta = polar(points, tips, np.broadcast_to(frame[0], points.shape), reference)
    scale = 1 / (2 * material.shear_modulus * np.sqrt(2 * np.pi))
    return scale * np.einsum("mli,qlj->mqij", mode_combinations(material.kappa), branch_gradients(r, theta))


def _lip_integral(space, material, U, tip, angle, frame, radius, pressure):
    """Integral of P_j m_j q over both lips; the traction of the solution is there the pressure, or nothing."""
    split = space.parts
    cut = split.fronts.cut[tip]
    total = np.zeros(2)
    off = np.linalg.norm(split.lips.facets - split.fronts.at[tip], axis=2).min(axis=1)
    near = (split.lips.cut == cut) & (off < radius)
    span = split.lips.arc[near].min(), split.lips.arc[near].max()
    # Pieces that halve towards the tip follow the r^-1/2 of u'_i,1.
    towards = np.concatenate([span[0] + radius * HALVES, span[1] - radius * HALVES]) if pressure else ()
    for side in (LEFT, RIGHT):
        q = lip_quadrature(space, cut, side, span, towards, n=6)
        outward = -side * q.normals @ frame.T
        weight, _ = _weight(np.linalg.norm(q.points - split.fronts.at[tip], axis=1) / radius)
        inside = (weight > 0) & np.isfinite(angle[q.parts])
        # Where the lip lies on the tip's own line both terms without pressure vanish.
        keep = inside & (np.abs((q.points - split.fronts.at[tip]) @ frame[1]) > 1e-9 * radius)
        if keep.any():
            about = _About(space, material, tip, frame)
            P = _flux(about, U, q.points[keep], q.parts[keep], angle[q.parts[keep]], real_traction=False)
            total += np.einsum("q,mqj,qj->m", (q.weights * weight)[keep], P, outward[keep])
        if pressure is not None:
            unit = _unit_gradient(space, material, q.points[inside], tip, angle[q.parts[inside]], frame)
            pressed = (q.weights * weight)[inside] * pressure(q.arc[inside])
            total += np.einsum("q,qi,mqi->m", pressed, outward[inside], unit[..., 0])
    return total
