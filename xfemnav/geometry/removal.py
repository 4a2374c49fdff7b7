"""Parts that are taken out: which of them lie in a region, and what is left to see where they were."""

from dataclasses import replace

import numpy as np
import shapely

from xfemnav.geometry.mesh import orient


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


def walls(ends, parts, removed, resections) -> dict:
    """Facets (w, 2, 2) mm between parts on their left and right (w, 2), turned to have what stays on the left.

    With each its resection, the nearest, and the first of those that share it; -1 where there is none.
    """
    ends, turned = np.array(ends), removed[parts[:, 0]]
    ends[turned] = ends[turned][:, ::-1]
    # Regions may have been united, and snapped since: the nearest one took what lay beyond the facet.
    middles = shapely.points(ends.mean(axis=1))
    off = [shapely.distance(resection.region, middles) for resection in resections]
    return {
        "wall_part": np.where(turned, parts[:, 1], parts[:, 0]),
        "wall_ends": ends,
        "wall_resection": np.argmin(off, axis=0) if off else np.full(len(ends), -1),
    }


def wall_of(subcells, resection, k, slack) -> np.ndarray:
    """Facets (w,) bool of the wall of resection k, also where it goes along another's: within `slack` (w,) mm of it."""
    middles = shapely.points(subcells.wall_ends.mean(axis=1))
    shared = (subcells.wall_resection >= 0) & (shapely.distance(resection.region, middles) <= slack)
    return shared | (subcells.wall_resection == k)


def take_out(subcells, parts):
    """The subcells without the `parts` (p,) bool, bodies of their own: lips on them become walls of no resection."""
    sub, removed = subcells, subcells.removed | parts
    gone = removed[sub.lip_parts]
    new = walls(sub.lip_ends[gone.sum(axis=1) == 1], sub.lip_parts[gone.sum(axis=1) == 1], removed, ())
    lips, rim, wall = ~gone.any(axis=1), ~removed[sub.rim_part], ~removed[sub.wall_part]
    touch = sub.tip_touch[~removed[sub.tip_touch[:, 1]]]
    tips = np.unique(touch[:, 0])
    touch = np.stack([np.searchsorted(tips, touch[:, 0]), touch[:, 1]], axis=1)
    return replace(
        sub,
        **{name: getattr(sub, name)[lips] for name in ("lip_cut", "lip_ends", "lip_arc", "lip_parts", "lip_on_edge")},
        **{name: getattr(sub, name)[rim] for name in ("rim_part", "rim_ends")},
        **{name: getattr(sub, name)[tips] for name in ("tip_cut", "tip_end", "tips", "tip_travel")},
        **{name: np.concatenate([getattr(sub, name)[wall], new[name]]) for name in new},
        tip_touch=touch,
        removed=removed,
    )
