"""Where the data of a retraction stop the solution is singular: finer elements there, for verification.

The held lip's ends, the mouth (a held lip that meets the free outline), the tip, and the places on the outline where
the skull's grip is complete. The cut stays out of the mesh.
"""

import numpy as np
import shapely

from xfemnav.geometry.plane.cut import Cut

# Element size, mm, at each kind of point; from there it grows by GROWTH mm per mm. Measured on the retraction disc:
# .02 mm largest error beyond two elements of the cut at 8,000 nodes.
SWITCH_MM, BLADE_END_MM, MOUTH_MM, TIP_MM = 0.0075, 0.02, 0.05, 0.1
GROWTH = 0.11


def data_ends(outline, cuts: tuple[Cut, ...], blades, grip_mm: float | None) -> tuple:
    """Points of refinement (point (2,) mm, size mm, growth) for a `SizeField`.

    outline (n, 2) mm, the organ's closed loop; blades: (index of the cut, from, to) of every held lip; grip_mm:
    distance from a mouth at which the outline is held, None for a free skull.
    """
    spots = []
    for k, cut in enumerate(cuts):
        spots.append((cut.path[0], MOUTH_MM if cut.mouth else TIP_MM, GROWTH))
        spots.append((cut.path[-1], TIP_MM, GROWTH))
        ends = {end for index, *span in blades for end in span if index == k and 0 < end < 1}
        spots += [(cut.at(end), BLADE_END_MM, GROWTH) for end in sorted(ends)]
        if cut.mouth and cut.craniotomy and grip_mm is not None:
            circle = shapely.Point(cut.path[0]).buffer(grip_mm, quad_segs=256).exterior
            crossings = shapely.get_coordinates(shapely.LinearRing(outline).intersection(circle))
            spots += [(point, SWITCH_MM, GROWTH) for point in crossings]
    return tuple((tuple(np.asarray(point, float).tolist()), size, growth) for point, size, growth in spots)
