"""The two lips of a cut do not pass through each other: frictionless contact, small displacements.

In the mean over hats w of spacing 1.25 h along the cut, as for the lips that a blade holds,

    integral of w (u_left - u_right) . n_left ds >= 0,

divided by the hat's integral: the mean gap, mm. The multiplier is the force with which the lips press on each other;
over the hats it is a continuous, piecewise linear pressure. A row a crossing would lock; hats let the lips pass each
other by a little between their means.

The hats begin anew where the gap has a kink of its own: at bends of the cut, at blades' ends, and where another cut
meets it and the lip's displacement may jump. Where both lips are held there is nothing left to find, and beside removed
tissue no lip.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.sparse import csr_array, vstack

from xfemnav.mechanics.conditions.constraints import SKULL, Contacts, normal_rows
from xfemnav.mechanics.conditions.lips import hats_at, knots_along, lip_quadrature
from xfemnav.mechanics.rules import LEFT, RIGHT, Retraction
from xfemnav.mechanics.space.space import Space

#: Knots are so many elements apart, closer than where a blade holds: forces that cannot pull cannot swing either, and
#: at 2 the lips pass each other by .11 mm between the means (1 mm elements, 3 mm of push), at 1.25 by .05 mm.
SPACING = 1.25
#: A cut that turns by more than this within an element is bent.
BEND = np.deg2rad(20.0)


@dataclass(frozen=True)
class ContactForce:
    """What presses on the lips of a cut, or (`cut` SKULL, -1) on the outline: length mm, mean pressure kPa over it."""

    cut: int
    length_mm: float
    mean_pressure_kPa: float


def lip_contacts(space: Space, retractions: tuple[Retraction, ...], spans, removed) -> Contacts:
    """Non-penetration of the lips of every cut, except where both are held.

    spans (r, 2) mm: the held part of each retraction's lip; removed (p,): parts that are not in the result.
    """
    found = []
    for cut in np.unique(space.parts.lips.cut):
        ends = [x for r, span in zip(retractions, spans) if r.cut == cut and r.holds for x in span]
        for stretch in _stretches(space, cut, _held_on_both(cut, retractions, spans), ends, removed):
            found.append(_stretch_contacts(space, cut, stretch))
    return join(found, space.enrichment.n_dof)


def join(parts: list[Contacts], n_dof: int) -> Contacts:
    """All conditions of several lists as one."""
    parts = [p for p in parts if len(p.gap)]
    if not parts:
        return Contacts(csr_array((0, n_dof)), np.empty(0), np.empty(0), np.empty((0, 2)), np.empty((0, 3)))
    if len(parts) == 1:
        return parts[0]
    rest = (np.concatenate([getattr(p, name) for p in parts]) for name in ("gap", "cut", "points", "hats"))
    return Contacts(vstack([p.G for p in parts], format="csr"), *rest)


def lip_pressure(contacts: Contacts, force, cut: int, arc) -> np.ndarray:
    """Pressure (q,) kPa between the lips of a cut at arc (q,) mm; force (g,) mN per mm, the conditions' multipliers."""
    own = np.flatnonzero((contacts.cut == cut) & (np.asarray(force) > 0))
    begin, peak, end = contacts.hats[own].T[:, :, None]
    arc = np.asarray(arc, float)
    with np.errstate(divide="ignore", invalid="ignore"):  # half hats rise at once
        rising = np.where(arc < peak, (arc - begin) / (peak - begin), 1.0)
        falling = np.where(arc > peak, (end - arc) / (end - peak), 1.0)
    hats = np.where((arc >= begin) & (arc <= end), np.minimum(rising, falling), 0.0)
    return (np.asarray(force)[own] / contacts.lengths[own]) @ hats


def contact_forces(contacts: Contacts, force) -> tuple[ContactForce, ...]:
    """Where surfaces press on each other: one entry for each cut, and for the skull, that touches."""
    found = []
    for cut in np.unique(contacts.cut[force > 0]):
        own = (contacts.cut == cut) & (force > 0)
        length = float(contacts.lengths[own].sum())
        found.append(ContactForce(int(cut), length, float(force[own].sum() / length)))
    return tuple(found)


def _stretch_contacts(space, cut, span):
    """Mean gaps over the hats of one stretch (from, to) mm of a cut."""
    knots = knots_along(space, cut, span, SPACING)
    breaks = np.concatenate([knots, _towards_tips(space, cut)])
    q = lip_quadrature(space, cut, LEFT, span, breaks)
    hat, weights = hats_at(q.arc, knots)
    n = len(knots)
    weights = weights * q.weights
    weights /= np.bincount(hat.ravel(), weights.ravel(), n)[hat]
    at, rows, jump = space.values_in(np.tile(q.points, (2, 1)), np.concatenate([q.parts, q.across]))
    m = len(q.arc)
    jump = csr_array((np.where(at < m, jump, -jump), (at % m, rows)), (m, space.enrichment.n_rows))
    means = csr_array((weights.T.ravel(), hat.T.ravel(), np.arange(0, 2 * m + 1, 2)), (m, n)).T
    G = means @ normal_rows(jump, q.normals, np.zeros(m), SKULL).C
    points = np.stack([np.bincount(hat.ravel(), (weights * x).ravel(), n) for x in q.points.T], axis=1)
    hats = np.stack([np.append(knots[0], knots[:-1]), knots, np.append(knots[1:], knots[-1])], axis=1)
    return Contacts(csr_array(G), np.zeros(n), np.full(n, cut), points, hats)


def _towards_tips(space, cut):
    """Arc (k,) mm of pieces that halve towards the cut's tips: Gauss points follow the branch functions there."""
    split = space.parts
    own = np.flatnonzero(split.lips.cut == cut)
    h = space.mesh.sizes[split.cell[split.lips.parts[own]]].max()
    start, stop = split.lips.arc[own].min(), split.lips.arc[own].max()
    pieces = 4 * h * 0.5 ** np.arange(20)
    ends = split.fronts.end[split.fronts.cut == cut]
    return np.concatenate([start + pieces if end == 0 else stop - pieces for end in ends] or [np.empty(0)])


def _stretches(space, cut, held, ends, removed):
    """Parts (from, to) mm of a cut that has two lips, not both held, between blades' ends and the cut's own breaks."""
    split = space.parts
    own = np.flatnonzero((split.lips.cut == cut) & ~removed[split.lips.parts].any(axis=1))
    if not len(own):
        return
    own = own[np.argsort(split.lips.arc[own, 0])]
    size = space.mesh.sizes[split.cell[split.lips.parts[own]]].mean(axis=1)
    breaks = np.unique(np.concatenate([_breaks(space, cut, size.mean()), ends]))
    for start, stop in _free(split.lips.arc[own], held, 1e-6 * size.min()):
        ends = [start]
        for x in breaks:
            h = size[np.clip(np.searchsorted(split.lips.arc[own, 0], x) - 1, 0, len(own) - 1)]
            if ends[-1] + h < x < stop - h:
                ends.append(x)
        yield from zip(ends, [*ends[1:], stop])


def _free(intervals, held, hair):
    """The union of sorted intervals (k, 2) without those held, as pairs (from, to) longer than a hair."""
    marks = np.unique(np.concatenate([intervals.ravel(), np.ravel(held)]))
    middle = (marks[1:] + marks[:-1]) / 2
    live = ((intervals[:, :1] < middle) & (middle < intervals[:, 1:])).any(axis=0)
    for a, b in held:
        live &= ~((a < middle) & (middle < b))
    free = []
    for a, b in zip(marks[:-1][live], marks[1:][live]):
        if free and a - free[-1][1] <= hair:
            free[-1][1] = b
        else:
            free.append([a, b])
    return [(a, b) for a, b in free if b - a > hair]


def _held_on_both(cut, retractions, spans):
    """Intervals (from, to) mm of a cut whose left and right lip are both held."""
    held = {side: [s for r, s in zip(retractions, spans) if r.cut == cut and r.side == side and r.holds]
            for side in (LEFT, RIGHT)}
    both = [(max(a[0], b[0]), min(a[1], b[1])) for a in held[LEFT] for b in held[RIGHT]]
    return [(a, b) for a, b in both if b > a]


def _breaks(space, cut, h):
    """Arc (k,) mm, sorted, where hats end: bends of the cut, seen over an element each way, and other cuts on it."""
    paths = space.parts.paths
    line = shapely.LineString(paths[cut])
    corners = shapely.points(paths[cut][1:-1])
    arcs = shapely.line_locate_point(line, corners)
    before, here, after = (
        shapely.get_coordinates(shapely.line_interpolate_point(line, np.clip(arcs + d, 0, line.length)))
        for d in (-h / 2, 0.0, h / 2)
    )
    one, two = here - before, after - here
    turn = np.abs(np.arctan2(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0], (one * two).sum(axis=1)))
    found = [arcs[turn > BEND]]
    for k, path in enumerate(paths):
        if k != cut:
            other = shapely.LineString(path)
            ends = shapely.points(path[[0, -1]])
            touching = ends[shapely.distance(line, ends) < 1e-6 * h]
            meeting = shapely.points(shapely.get_coordinates(shapely.intersection(line, other)))
            found.append(shapely.line_locate_point(line, np.concatenate([meeting, touching])))
    return np.unique(np.concatenate(found))
