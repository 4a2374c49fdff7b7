"""Measured displacements of the outline, interpolated along it between the mouths of cuts."""

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.rim import Rim
from xfemnav.mechanics.space import Space

#: Where measured points are farther apart than this along the outline, the skull's own condition holds between them.
MEASURED_GAP_MM = 20.0
#: A measured point farther than this from the outline is refused.
MEASURED_OFF_MM = 10.0


def measured_at(space: Space, rim: Rim, measured) -> tuple[np.ndarray, np.ndarray]:
    """Which rim points (k,) lie between measured ones, and their displacements (k, 2) mm, linear along the outline.

    measured (m, 4 or 5): x, y, ux, uy mm and, where it matters, side (+1 left, -1 right).
    Raises XfemnavError E408 when the measured points lie off the outline.
    """
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
