"""Cuts in a volume as users draw them: curves on the cortex and planes, in any frame, as sheets in the world."""

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.geometry.solid.sheet import Sheet
from xfemnav.geometry.solid.sweep import flat, swept
from xfemnav.imaging.frames.volume import Volume, world_points


def sheets(cuts, field, volume: Volume) -> tuple[Sheet, ...]:
    """The sheets of drawn cuts in an organ whose distance (n,) mm at points (n, 3) mm is `field`.

    A cut has a `name`, `points` in `space` and a `craniotomy`; its `form` is "Plane", of four corners in turn about its
    normal, or that of a curve on the surface, swept `towards` a point in `towards_space`, and to `depth_mm`. Raises
    XfemnavError E301 to E303 of what is no cut.
    """
    found = []
    for cut in cuts:
        points = world_points(volume, cut.points, cut.space)
        if cut.form == "Plane":
            sides = np.stack([points[1] - points[0], points[3] - points[0]])
            size = np.linalg.norm(sides, axis=1)
            axes = np.vstack([sides / size[:, None], np.cross(*sides) / size.prod()])
            found.append(flat(field, points.mean(axis=0), axes, size, name=cut.name, craniotomy=cut.craniotomy))
            continue
        if cut.towards is None and cut.depth_mm is None:
            raise XfemnavError("E303", f"cut '{cut.name}' is a curve without a depth; give ⟦towards=X,Y,Z⟧, its deep "
                                       "end, "
                                       "or ⟦depth_mm=D⟧.")
        towards = None if cut.towards is None else world_points(volume, [cut.towards], cut.towards_space)[0]
        found.append(swept(field, points, towards=towards, depth_mm=cut.depth_mm, name=cut.name,
                           craniotomy=cut.craniotomy))
    return tuple(found)
