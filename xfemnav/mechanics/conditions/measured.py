"""Measured displacements of the outline, interpolated along it between measured points, and never beyond the last."""

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.space.rim import Rim
from xfemnav.mechanics.space.space import Space

#: Where measured points are farther apart than this along the outline, the skull's own condition holds between them.
MEASURED_GAP_MM = 20.0
#: A measured point farther than this from the outline is refused.
MEASURED_OFF_MM = 10.0
#: A place of the outline this near to a mouth, mm, is the mouth, and lies on one of its sides; points of the lips lie
#: nearer to it, and anything nearer than a hair is the same place.
SAME_MM, BESIDE_MM, HAIR_MM = 1e-6, 1e-7, 1e-9
#: Outlines are known to about a pixel, so a parted lip whose last point is as near to the mouth is measured up to it.
PIXEL_MM = 1.0


def measured_at(space: Space, rim: Rim, measured, pulled=()) -> tuple[np.ndarray, np.ndarray]:
    """Which rim points (k,) lie between measured ones, and their displacements (k, 2) mm, linear along the outline.

    measured (m, 4 or 5): x, y, ux, uy mm and, where it matters, side (+1 left, -1 right). Between two points on the two
    sides of a mouth the outline is one, as if there were no cut, unless a blade acts on a lip of that cut (`pulled`:
    the numbers of such cuts) or the points have moved apart: then nothing is known up to the last point of each lip.
    Raises XfemnavError E408 when the measured points lie off the outline.
    """
    split, mesh = space.parts, space.mesh
    if measured.ndim != 2 or measured.shape[1] not in (4, 5) or not np.isfinite(measured[:, :4]).all():
        raise XfemnavError("E408", "measured boundary displacements need the columns x,y,ux,uy (and side), all finite.")
    outline = shapely.LinearRing(mesh.outline)
    off = outline.distance(shapely.points(measured[:, :2]))
    if off.max(initial=0.0) > MEASURED_OFF_MM:
        x, y = measured[np.argmax(off), :2]
        raise XfemnavError(
            "E408", f"measured point ({x:.1f}, {y:.1f}) mm is {off.max():.1f} mm from the outline; check its frame."
        )
    mouths, entering, cut = _mouth_arcs(split, outline)
    arc = shapely.line_locate_point(outline, shapely.points(measured[:, :2]))
    if measured.shape[1] == 5:
        arc = _beside_mouth(arc, measured[:, 4], mouths, entering, outline.length)
    order = np.argsort(arc, kind="stable")
    at, u = arc[order], measured[order, 2:4]
    at, holds = _stretches(at, u, outline, mouths, np.isin(cut, list(pulled)))
    return _between(at, u, holds, outline.length, *_rim_arcs(rim, outline, mouths))


def refuse_nothing(known) -> None:
    """Raise XfemnavError E408 where none of the rim points (k,) is known."""
    if not known.any():
        raise XfemnavError(
            "E408", "the measured motion holds nothing: nothing of the outline lies between measured points up to "
                    f"{MEASURED_GAP_MM:g} mm apart; give points closer to each other."
        )


def _stretches(at, u, outline, mouths, pulled):
    """Place (m,) mm of each point, and whether the outline moves as measured from there to the next point, counter-
    clockwise; from the last to the first.

    mouths (c,) mm, and whether a blade pulls at one (c,). A lip's last point is its end if it is as near as a pixel.
    """
    total = outline.length
    length, ahead = np.mod(np.roll(at, -1) - at, total), np.mod(mouths - at[:, None], total)
    inside = (ahead > HAIR_MM) & (ahead < length[:, None] - HAIR_MM)
    before, after = (
        shapely.get_coordinates(outline.interpolate(np.mod(mouths + d, total))) for d in (-PIXEL_MM, PIXEL_MM)
    )
    parted = inside & ((np.roll(u, -1, axis=0) - u) @ (after - before).T > HAIR_MM)
    holds = (length <= MEASURED_GAP_MM) & ~(parted | (inside & pulled)).any(axis=1) & (len(at) > 1)
    at = at.copy()
    for k, mouth in zip(*np.nonzero(parted)):
        if ahead[k, mouth] < PIXEL_MM:
            at[k] = np.mod(mouths[mouth] - BESIDE_MM, total)
        if length[k] - ahead[k, mouth] < PIXEL_MM:
            at[(k + 1) % len(at)] = np.mod(mouths[mouth] + BESIDE_MM, total)
    return at, holds


def _between(at, u, holds, total, arc, beside):
    """Which places arc (k,) mm lie on a stretch that `holds` (m,), its ends included, and their displacements (k, 2).

    beside (k,) mm: the same places, but on their own side of a mouth.
    """
    known, values, length = np.zeros(len(arc), dtype=bool), np.zeros((len(arc), 2)), np.mod(np.roll(at, -1) - at, total)
    # A measured point itself lies in the stretches on both its sides.
    for hair in (-HAIR_MM, HAIR_MM):
        # -1, before the first point, is the stretch that comes from the last.
        k = np.searchsorted(at, np.mod(beside + hair, total), side="right") - 1
        after = np.mod(arc - at[k] + SAME_MM, total) - SAME_MM
        t = np.clip(after / np.maximum(length[k], HAIR_MM), 0, 1)[:, None]
        new = holds[k] & ~known
        values[new] = ((1 - t) * u[k] + t * np.roll(u, -1, axis=0)[k])[new]
        known |= new
    return known, values


def _rim_arcs(rim, outline, mouths):
    """Place (k,) mm of rim points along the outline; and the same, but beside a mouth, on the facet's side, where the
    point is one."""
    total = outline.length
    arc, middle = (shapely.line_locate_point(outline, shapely.points(x)) for x in (rim.points, rim.middles))
    ahead = np.sign(_signed(middle - arc, total))
    at_mouth = (np.abs(_signed(arc[:, None] - mouths, total)) < SAME_MM).any(axis=1)
    return arc, np.mod(arc + SAME_MM * ahead * at_mouth, total)


def _signed(along, total):
    """Lengths along a closed line of length `total`, the short way round."""
    return np.mod(along + total / 2, total) - total / 2


def _mouth_arcs(split, outline):
    """Every place where a cut meets the outline: position (m,) mm along it, +1 if the cut enters, -1 if it leaves, and
    the cut's number."""
    ends = np.array([path[end] for path in split.paths for end in (0, -1)]).reshape(-1, 2)
    on = outline.distance(shapely.points(ends)) < SAME_MM
    sense, cut = np.tile([1, -1], len(split.paths)), np.repeat(np.arange(len(split.paths)), 2)
    return shapely.line_locate_point(outline, shapely.points(ends[on])), sense[on], cut[on]


def _beside_mouth(arc, side, mouths, entering, total):
    """Put measured points with a side on that side of a mouth nearer than 5 mm (or a fiftieth of a short outline).

    With tissue on the left of the outline, the lip on the left of a cut that enters ends before the mouth, and that of
    one that leaves, right through the organ, begins after it.
    """
    arc = arc.copy()
    for mouth, sense in zip(mouths, entering):
        ahead = _signed(arc - mouth, total)
        wrong = (np.abs(ahead) < min(5.0, total / 50)) & (side * sense * ahead >= 0) & (side != 0)
        arc[wrong] = np.mod(mouth - BESIDE_MM * sense * side[wrong], total)
    return arc
