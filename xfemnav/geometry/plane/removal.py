"""Parts that are taken out: which of them lie in a region, and what is left to see where they were."""

from dataclasses import replace

import numpy as np
import shapely

from xfemnav.geometry.mesh import orient
from xfemnav.geometry.parts import Faces, Parts


def parts_inside(region, corners, part, n_parts) -> np.ndarray:
    """Parts (p,) bool that lie in a region: it holds the centre of their largest triangle, `corners` (s, 3, 2) mm."""
    if region.is_empty:
        return np.zeros(n_parts, dtype=bool)
    area = orient(*corners.swapaxes(0, 1))
    order = np.lexsort((area, part))
    largest = order[np.searchsorted(part[order], np.arange(n_parts), side="right") - 1]
    x, y = corners[largest].mean(axis=1).T
    shapely.prepare(region)
    return shapely.contains_xy(region, x, y)


def walls(facets, parts, removed, resections) -> Faces:
    """Walls (w, 2, 2) mm between parts on their left and right (w, 2), turned to have what stays on the left.

    With each its resection, the nearest, and the first of those that share it; -1 where there is none.
    """
    facets, turned = np.array(facets), removed[parts[:, 0]]
    facets[turned] = facets[turned][:, ::-1]
    # Regions may have been united, and snapped since: the nearest one took what lay beyond the facet.
    middles = shapely.points(facets.mean(axis=1))
    off = [shapely.distance(resection.region, middles) for resection in resections]
    return Faces(facets, np.where(turned, parts[:, 1], parts[:, 0]),
                 np.argmin(off, axis=0) if off else np.full(len(facets), -1))


def wall_of(walls: Faces, resection, k, slack) -> np.ndarray:
    """Facets (w,) bool of the wall of resection k, also where it goes along another's: within `slack` (w,) mm of it."""
    middles = shapely.points(walls.facets.mean(axis=1))
    shared = (walls.source >= 0) & (shapely.distance(resection.region, middles) <= slack)
    return shared | (walls.source == k)


def take_out(parts: Parts, chosen) -> Parts:
    """What is left without the parts `chosen` (p,) bool, bodies of their own: lips on them become walls of nothing."""
    removed = parts.removed | chosen
    gone = removed[parts.lips.parts]
    bare = gone.sum(axis=1) == 1
    wall = parts.walls.rows(~removed[parts.walls.parts])
    new = walls(parts.lips.facets[bare], parts.lips.parts[bare], removed, ())
    touch = parts.touch[~removed[parts.touch[:, 1]]]
    tips = np.unique(touch[:, 0])
    return replace(
        parts,
        removed=removed,
        lips=parts.lips.rows(~gone.any(axis=1)),
        rim=parts.rim.rows(~removed[parts.rim.parts]),
        walls=wall.with_rows(new),
        fronts=parts.fronts.rows(tips),
        touch=np.stack([np.searchsorted(tips, touch[:, 0]), touch[:, 1]], axis=1),
    )
