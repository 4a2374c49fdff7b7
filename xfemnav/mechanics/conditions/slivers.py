"""Tissue that is thin, or hangs on by little: strips in which elements are too stiff, and blades that hold shreds."""

import numpy as np
import shapely
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from xfemnav.errors import warn
from xfemnav.limits import SHRED_AREA, SHRED_WIDTH_HELD, STRIP_ELEMENTS
from xfemnav.mechanics.conditions.lips import lip_quadrature
from xfemnav.mechanics.space.space import Space

#: Lines that make less than this angle run along each other; others only meet.
ALONG = np.deg2rad(20.0)
#: A strip is at least so many times as long as it is wide, and as an element.
LONG = 2.0
#: Samples of a held lip.
SAMPLES = 40


def warn_of_strips(space: Space, cuts, resections) -> None:
    """W306 where a lip or a wall runs along another, or along the outline, with too few elements between them."""
    if space.parts.lips.at.shape[-1] > 1:  # of sheets in space nothing is known yet
        return
    lines = _Boundary(space, cuts, resections)
    width, other, size = lines.across()
    thin = np.flatnonzero(width < STRIP_ELEMENTS.value * size)
    told = set()
    for own in lines.runs(thin):
        length, narrow, h = lines.length[own].sum(), width[own], size[own].mean()
        pair = frozenset((lines.name[own[0]], lines.name[other[own[0]]]))
        if pair in told or length < LONG * max(narrow.mean(), h) or length < STRIP_ELEMENTS.value * h:
            continue
        told.add(pair)
        x, y = lines.middle[own[narrow.argmin()]]
        first, second = lines.name[own[0]], lines.name[other[own[0]]]
        beside = "itself" if first == second else second
        fine = np.floor(10 * narrow.mean() / STRIP_ELEMENTS.value) / 10
        warn(
            "W306",
            f"{first} runs along {beside} for {length:.1f} mm, {narrow.min():.1f} to {narrow.max():.1f} mm from it, "
            f"near ({x:.1f}, {y:.1f}) mm: a strip of under {STRIP_ELEMENTS.value:g} elements, here of {h:.1f} mm, is "
            f"too stiff; use ⟦corridor_element_mm={max(fine, 0.1):g}⟧ or less there, or do not trust how it bends.",
        )


class _Boundary:
    """What bounds tissue, facet by facet (f,): its ends, the side on which tissue is, its cell's size and its name.

    Both sides of a lip come after each other; the outline's facets, of which none is asked about, come last.
    """

    def __init__(self, space, cuts, resections):
        split = space.parts
        lips = np.concatenate([split.lips.facets, split.lips.facets[:, ::-1]])
        self.ends = np.concatenate([lips, split.walls.facets, split.rim.facets])  # tissue on the left of each
        parts = np.concatenate([split.lips.parts[:, 0], split.lips.parts[:, 1], split.walls.parts, split.rim.parts])
        self.size = space.mesh.sizes[split.cell[parts]]
        walls = [f"the wall of '{resections[k].name}'" if k >= 0 else "a wall" for k in split.walls.source]
        lips = [f"cut '{cuts[k].name}'" for k in split.lips.cut]
        self.name = np.array([*lips, *lips, *walls, *["the outline"] * len(split.rim.parts)])
        self.asked = len(self.name) - len(split.rim.parts)
        self.middle, travel = self.ends.mean(axis=1), self.ends[:, 1] - self.ends[:, 0]
        self.length = np.linalg.norm(travel, axis=1)
        self.travel = travel / self.length[:, None]

    def across(self):
        """From the middle of each facet that is asked about, across the tissue: how far (n,) mm the next facet is, its
        number, and the size (n,) mm of the elements; infinitely far where that does not run along."""
        n = self.asked
        inward = np.stack([-self.travel[:n, 1], self.travel[:n, 0]], axis=1)
        reach, hair = STRIP_ELEMENTS.value * self.size[:n, None], 1e-3 * self.size[:n, None]
        rays = shapely.linestrings(np.stack([self.middle[:n] + x * inward for x in (hair, reach)], axis=1))
        facets = shapely.linestrings(self.ends)
        ray, facet = shapely.STRtree(facets).query(rays, predicate="intersects")
        far = shapely.distance(shapely.points(self.middle[ray]), shapely.intersection(rays[ray], facets[facet]))
        order = np.lexsort((far, ray))
        first = order[np.unique(ray[order], return_index=True)[1]]
        ray, facet, far = ray[first], facet[first], far[first]
        slope = np.abs(self.travel[ray, 0] * self.travel[facet, 1] - self.travel[ray, 1] * self.travel[facet, 0])
        width, other = np.full(n, np.inf), np.zeros(n, dtype=int)
        width[ray], other[ray] = np.where(slope < np.sin(ALONG), far, np.inf), facet
        return width, other, self.size[:n]

    def runs(self, chosen):
        """The facets (k,) that were chosen, in groups: of one name, side by side, with gaps of an element at most."""
        if not len(chosen):
            return []
        reach = self.length[chosen].max() + self.size[chosen].max()
        pairs = cKDTree(self.middle[chosen]).query_pairs(reach, output_type="ndarray").reshape(-1, 2)
        a, b = chosen[pairs].T
        along = (self.travel[a] * self.travel[b]).sum(axis=1) > 0.5  # not the other side of the same cut
        pairs = pairs[(self.name[a] == self.name[b]) & along]
        graph = np.zeros((len(chosen),) * 2, dtype=bool)
        graph[tuple(pairs.T)] = True
        _, label = connected_components(graph, directed=False)
        return [chosen[label == k] for k in range(label.max() + 1)]


def warn_of_slivers(space: Space, cuts, resections, retractions, spans) -> None:
    """W305 for a blade most of whose lip has no tissue behind it but a shred, or what hangs on by a neck as narrow.

    spans (r, 2) mm: the held part of each lip.
    """
    if not retractions or space.parts.lips.at.shape[-1] > 1:
        return
    tissue = _tissue(space, resections)
    for retraction, span in zip(retractions, spans):
        span = span[0], min(span[1], cuts[retraction.cut].length)  # of pointwise rows without a blade it has no end
        q = lip_quadrature(space, retraction.cut, retraction.side, span, np.linspace(*span, SAMPLES + 1), n=1)
        h = float(space.mesh.sizes[space.parts.cell[q.parts]].mean())
        width = max(2 * h, min(SHRED_WIDTH_HELD.value, np.ptp(space.mesh.points, axis=0).max() / 10))
        firm = _firm(tissue, width)
        behind = shapely.points(q.points + retraction.side * width / 2 * q.normals)
        loose = shapely.distance(firm, behind) > width / 4
        share = float(q.weights[loose].sum() / q.weights.sum())
        if share > 0.5:
            x, y = q.points[loose].mean(axis=0)
            side = "left" if retraction.side > 0 else "right"
            warn(
                "W305",
                f"the blade on the {side} lip of cut '{cuts[retraction.cut].name}' holds a sliver over {share:.0%} of "
                f"its length, about ({x:.1f}, {y:.1f}) mm: tissue under {width:.1f} mm wide, or that hangs on by as "
                "little. What is behind it is not retracted; move the blade or the cut, or take the sliver out.",
            )


def _tissue(space, resections):
    """The tissue as a region: the organ without what is resected, slit along the cuts."""
    organ = shapely.Polygon(space.mesh.outline)
    hair = 1e-3 * float(space.mesh.sizes.min())
    gone = [item.region for item in resections]
    drawn = (path for path in space.parts.paths if len(path) > 1)  # of one in a resection nothing is left
    gone += [shapely.LineString(path).buffer(hair, cap_style="flat") for path in drawn]
    return organ.difference(shapely.union_all(gone))


def _firm(tissue, width):
    """What is left of a region when half a `width` is taken off all round, without small bits."""
    left = shapely.get_parts(tissue.buffer(-width / 2))
    return shapely.union_all(left[shapely.area(left) >= SHRED_AREA.value * tissue.area])
