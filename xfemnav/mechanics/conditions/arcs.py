"""Parts of the organ's outline with a kind of their own: where it is fixed, slides, is free, or touches the skull."""

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.conditions.measured import MEASURED_OFF_MM
from xfemnav.mechanics.rules import Skull
from xfemnav.mechanics.space.space import Space


def facet_kinds(space: Space, skull: Skull) -> tuple[np.ndarray, np.ndarray]:
    """Kind (b,) and gap (b,) mm of every facet of the outline: the skull's, but for the facets with middles in an arc.

    Raises XfemnavError E409 for arcs whose ends lie off the outline or hold no facet.
    """
    split, mesh = space.parts, space.mesh
    kinds = np.full(len(split.rim.facets), skull.kind, dtype=object)
    gaps = np.full(len(kinds), float(skull.gap_mm))
    if not skull.arcs:
        return kinds, gaps
    outline = shapely.LinearRing(mesh.outline)
    middles = shapely.points(split.rim.facets.mean(axis=1))
    on = shapely.distance(outline, middles) < 1e-6
    at = shapely.line_locate_point(outline, middles)
    for arc in skull.arcs:
        ends = shapely.points(np.array([arc.start, arc.end], float))
        off = shapely.distance(outline, ends) if np.isfinite(shapely.get_coordinates(ends)).all() else np.inf
        where = f"arc from ({arc.start[0]:.1f}, {arc.start[1]:.1f}) to ({arc.end[0]:.1f}, {arc.end[1]:.1f}) mm"
        if np.max(off) > MEASURED_OFF_MM:
            raise XfemnavError("E409", f"the {where} ends {np.max(off):.1f} mm from the outline; check its frame.")
        start, end = shapely.line_locate_point(outline, ends)
        own = on & (np.mod(at - start, outline.length) < np.mod(end - start, outline.length))
        if not own.any():
            raise XfemnavError("E409", f"the {where} is shorter than the outline's facets; give ends farther apart.")
        kinds[own], gaps[own] = arc.kind, arc.gap_mm
    return kinds, gaps
