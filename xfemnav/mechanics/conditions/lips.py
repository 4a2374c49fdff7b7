"""Conditions and forces on the two lips of a cut.

The stable default, 'mortar', holds a lip in the mean over hat functions of spacing 2 h along the held span: one row a
hat. The paper's own, 'pointwise' (Eqs. 5 and 6), has one row at every crossing of the cut with a mesh edge; it locks
under refinement, and is kept because it is the paper's.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.chart import Chart
from xfemnav.geometry.plane.cut import left_normals
from xfemnav.mechanics.conditions.constraints import Constraints, vector_rows
from xfemnav.mechanics.conditions.lip_patches import held_patch, patch_points
from xfemnav.mechanics.rules import LEFT, LipRules, Retraction
from xfemnav.mechanics.space.quadrature import gauss
from xfemnav.mechanics.space.space import Space


@dataclass(frozen=True, eq=False)
class LipQuadrature:
    """Gauss points on one lip: points (q, d) mm, weights (q,) mm^(d-1), arc (q,) mm, in space the depth, parts (q,),
    those across the cut (q,), left normals (q, d)."""

    points: np.ndarray
    weights: np.ndarray
    arc: np.ndarray
    parts: np.ndarray
    across: np.ndarray
    normals: np.ndarray


def lip_quadrature(space: Space, cut: int, side: int, span, breaks=(), n: int = 4) -> LipQuadrature:
    """n Gauss points on each piece of a lip inside `span` (from, to) mm; pieces end at cell edges and at `breaks`.

    In space n^2 in each triangle of what is inside a window (2, 3) of chart coordinates, see `lip_patches`.
    """
    split = space.parts
    own = 0 if side == LEFT else 1
    if np.ndim(span) > 1:
        points, weights, depth, facet, normals = patch_points(split.lips, cut, span, min(n, 2))
        return LipQuadrature(points, weights, depth, split.lips.parts[facet, own], split.lips.parts[facet, 1 - own],
        normals)
    facets = np.flatnonzero(split.lips.cut == cut)
    cuts = np.unique(np.concatenate([split.lips.arc[facets].ravel(), np.asarray(breaks, float), span]))
    cuts = cuts[(cuts >= span[0]) & (cuts <= span[1])]
    middle = (cuts[1:] + cuts[:-1]) / 2
    order = facets[np.argsort(split.lips.arc[facets, 0])]
    facet = order[np.clip(np.searchsorted(split.lips.arc[order, 0], middle) - 1, 0, len(order) - 1)]
    on = (middle > split.lips.arc[facet, 0]) & (middle < split.lips.arc[facet, 1]) & (np.diff(cuts) > 0)
    low, high, facet = cuts[:-1][on], cuts[1:][on], facet[on]
    t, w = gauss(n)
    arc = (low[:, None] + (high - low)[:, None] * (t + 1) / 2).ravel()
    weights = ((high - low)[:, None] * w / 2).ravel()
    facet = np.repeat(facet, n)
    (a0, a1), ends = split.lips.arc[facet].T, split.lips.facets[facet]
    fraction = ((arc - a0) / (a1 - a0))[:, None]
    points = (1 - fraction) * ends[:, 0] + fraction * ends[:, 1]
    travel = ends[:, 1] - ends[:, 0]
    travel /= np.linalg.norm(travel, axis=1)[:, None]
    normals = np.stack([-travel[:, 1], travel[:, 0]], axis=1)
    return LipQuadrature(points, weights, arc, split.lips.parts[facet, own], split.lips.parts[facet, 1 - own], normals)


def held_length(space: Space, cut: int, span) -> float:
    """Length mm of the lips of a cut inside `span` (from, to) mm."""
    return float(np.diff(np.clip(space.parts.lips.arc[space.parts.lips.cut == cut], *span)).sum())


def held_span(space: Space, cuts: tuple[Chart, ...], retraction: Retraction) -> tuple[float, float]:
    """Held part of the lip (from, to) mm from the mouth; shortened to stay two cells short of a tip (W404, of a blade
    that was given).

    Where a resection took the tissue of the cut, the blade holds what is left. Raises XfemnavError E402 when that is
    nothing.
    """
    split, k = space.parts, retraction.cut
    arcs = split.lips.arc[split.lips.cut == k]
    if not len(arcs):
        raise XfemnavError("E402", f"cut '{cuts[k].name}' has no tissue on its two sides, so no blade can hold it.")
    end = float(np.linalg.norm(np.diff(split.paths[k], axis=0), axis=1).sum())
    asked = (np.asarray(retraction.blade if retraction.blade is not None else (0.0, 1.0)) * end).tolist()
    start, stop = asked
    for tip_end, is_last in ((-1, True), (0, False)):
        if not ((split.fronts.cut == k) & (split.fronts.end == tip_end)).any():
            continue
        facet = np.flatnonzero(split.lips.cut == k)
        facet = facet[np.argmax(split.lips.arc[facet, 1])] if is_last else facet[np.argmin(split.lips.arc[facet, 0])]
        margin = 2 * float(space.mesh.sizes[split.cell[split.lips.parts[facet]]].max())
        limit = end - margin if is_last else margin
        start, stop = (start, min(stop, limit)) if is_last else (max(start, limit), stop)
    if stop - start <= 1e-9:
        raise XfemnavError(
            "E402",
            f"nothing of cut '{cuts[k].name}' ({end:.1f} mm) is left for the blade to hold; use a longer cut "
            "or smaller elements (⟦corridor_element_mm⟧).",
        )
    given = retraction.blade is not None and retraction.blade_given
    if given and max(start - asked[0], asked[1] - stop) > 1e-9:
        warn(
            "W404",
            f"the blade on cut '{cuts[k].name}' came within two elements ({margin:.1f} mm) of a tip and was shortened: "
            f"it holds {start / end:.2f} to {stop / end:.2f} of the cut.",
        )
    left = np.clip(arcs, start, stop)
    left = left[left[:, 1] - left[:, 0] > 1e-9]
    if not len(left):
        raise XfemnavError(
            "E402",
            f"the tissue that the blade should hold, {start:.1f} to {stop:.1f} mm along cut '{cuts[k].name}', is "
            "resected or cut loose; hold another part, or leave the retraction out.",
        )
    return float(left.min()), float(left.max())


def held_spans(
    space: Space, cuts: tuple[Chart, ...], retractions: tuple[Retraction, ...], rules: LipRules
) -> np.ndarray:
    """Held part (r, 2) mm of each lip, in space windows (r, 2, 3); for pointwise rows without a blade the whole lip, as
    in the paper."""
    if space.parts.lips.at.shape[-1] > 1:
        return np.array([held_patch(space, cuts, r) for r in retractions]).reshape(-1, 2, 3)
    spans = [(0.0, np.inf) if rules.pointwise and r.holds and r.blade is None else held_span(space, cuts, r)
             for r in retractions]
    return np.array(spans).reshape(-1, 2)


def mortar_rows(space: Space, retraction: Retraction, span, group: int) -> Constraints:
    """Mean displacement over hats of spacing 2 h along the span: integral of hat_k (u - given) = 0."""
    knots = knots_along(space, retraction.cut, span)
    q = lip_quadrature(space, retraction.cut, retraction.side, span, knots)
    hat, value = hats_at(q.arc, knots)
    weights, given = value * q.weights, retraction.displacement(q.normals)
    at, rows, basis = space.values_in(q.points, q.parts)
    # Both of a point's hats take all of its basis functions.
    entries = (weights[:, at] * basis).ravel(), (hat[:, at].ravel(), np.tile(rows, 2))
    means = [np.bincount(hat.ravel(), (weights * u).ravel(), len(knots)) for u in given.T]
    return vector_rows(csr_array(entries, (len(knots), space.enrichment.n_rows)), np.stack(means, axis=1), group)


def knots_along(space, cut, span, spacing=2.0):
    """Ends of the hats: `spacing` local element sizes apart, or a little more."""
    split = space.parts
    facets = np.flatnonzero(split.lips.cut == cut)
    facets = facets[np.argsort(split.lips.arc[facets, 0])]
    h = space.mesh.sizes[split.cell[split.lips.parts[facets]]].mean(axis=1)
    low, high = np.clip(split.lips.arc[facets], *span).T
    count = np.concatenate([[0.0], np.cumsum((high - low) / (spacing * h))])
    arc = np.concatenate([low[:1], high])
    n = max(1, int(np.floor(count[-1] + 1e-9)))
    return np.interp(np.linspace(0, count[-1], n + 1), count, arc)


def hats_at(arc, knots) -> tuple[np.ndarray, np.ndarray]:
    """The two piecewise linear hats (2, q) that are not zero at the arc positions (q,), and their values (2, q)."""
    k = np.clip(np.searchsorted(knots, arc, side="right") - 1, 0, len(knots) - 2)
    t = (arc - knots[k]) / (knots[k + 1] - knots[k])
    return np.stack([k, k + 1]), np.stack([1 - t, t])


def crossings(space: Space, cut: int, side: int, hold_tip: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the cut crosses mesh edges: points (k, 2) mm, arc (k,) mm, parts (k,) on the side given.

    The crossings of the cells that hold a tip are left out, as in the paper, unless `hold_tip`.
    """
    split = space.parts
    facets = np.flatnonzero(split.lips.cut == cut)
    tip_cells = split.cell[split.touch[np.isin(split.touch[:, 0], np.flatnonzero(split.fronts.cut == cut)), 1]]
    arc, points = split.lips.arc[facets].ravel(), split.lips.facets[facets].reshape(-1, 2)
    parts = np.repeat(split.lips.parts[facets, 0 if side == LEFT else 1], 2)
    keep = split.lips.on_face[facets].ravel().copy()
    about_tip = np.isin(split.cell[split.lips.parts[facets]], tip_cells).any(axis=1)
    tip_arcs = split.lips.arc[facets[about_tip]].ravel()
    if not hold_tip and len(tip_arcs):
        keep &= np.abs(arc[:, None] - tip_arcs).min(axis=1) > 1e-9
    at_tip = (np.linalg.norm(points[:, None] - split.fronts.at, axis=2) < 1e-9).any(axis=1)
    keep &= ~at_tip
    _, first = np.unique(np.round(arc[keep], 9), return_index=True)
    return points[keep][first], arc[keep][first], parts[keep][first]


def pointwise_rows(space: Space, retraction: Retraction, span, group: int, hold_tip: bool) -> Constraints:
    """Eqs. (5) and (6): u = given at every crossing of the held lip with a mesh edge."""
    points, arc, parts = crossings(space, retraction.cut, retraction.side, hold_tip)
    held = (arc >= span[0] - 1e-9) & (arc <= span[1] + 1e-9)
    if not held.any():
        raise XfemnavError(
            "E402",
            "a blade holds no place where its cut crosses a mesh edge, so pointwise conditions hold nothing; use a "
            "longer blade, smaller elements, or ⟦lip_constraint=mortar⟧.",
        )
    path = space.parts.paths[retraction.cut]
    ends = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    segment = np.clip(np.searchsorted(ends, arc[held], side="right") - 1, 0, len(path) - 2)
    given = retraction.displacement(left_normals(path)[segment])
    return vector_rows(space.basis_in(points[held], parts[held]), given, group)


def lip_rows(space: Space, retraction: Retraction, span, group: int, rules: LipRules) -> Constraints:
    """The conditions of a held lip, 'mortar' or 'pointwise'."""
    if rules.pointwise:
        return pointwise_rows(space, retraction, span, group, rules.hold_tip)
    return mortar_rows(space, retraction, span, group)


def lip_load(space: Space, retraction: Retraction, span) -> np.ndarray:
    """Nodal forces (n_dof,) mN, in the plane per mm of thickness, of a force spread evenly over the blade."""
    q = lip_quadrature(space, retraction.cut, retraction.side, span)
    traction = np.asarray(retraction.force_mN_per_mm, float) / q.weights.sum()
    return np.outer(space.basis_in(q.points, q.parts).T @ q.weights, traction).ravel()
