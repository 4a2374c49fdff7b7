"""A resection: closed loops of cuts, and the tissue inside them taken out."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array
from xfemnav.geometry.plane.cut import FLIPS, other_frame

#: Parts and holes of a region whose mean width is smaller than this are drawing noise (mm).
SLIVER_MM = 1e-3
#: A resection that leaves less of the organ than this part takes the whole: what is left are crumbs of its outline.
LEAST_LEFT = 0.01
#: A line as near as this to the outline runs along it (mm).
ON_OUTLINE_MM = 1e-9


@dataclass(frozen=True, eq=False)
class Resection:
    """Tissue taken out of the organ: all points inside an odd number of `rings`.

    rings: closed loops (k, 2) mm, plane frame, without the first point repeated: outlines, their holes, islands in
    those. paths: the lines (k, 2) mm in the organ's interior that must be cut to free it; closed ones end where they
    begin.
    """

    name: str
    rings: tuple
    paths: tuple

    def __post_init__(self):
        for field in ("rings", "paths"):
            lines = tuple(frozen_array(line, float, (None, 2), field) for line in getattr(self, field))
            object.__setattr__(self, field, lines)

    @cached_property
    def region(self) -> shapely.Geometry:
        """The (multi-)polygon of the tissue taken out."""
        return even_odd(self.rings)

    @property
    def area_mm2(self) -> float:
        """Area of the tissue taken out, mm^2."""
        return float(self.region.area)


def place_resection(rings, boundary, name: str = "resection", source: str = "", space: str = "ras") -> Resection:
    """Clip a drawn region to the organ.

    Parameters
    ----------
    rings : closed loops (k, 2) mm, plane frame, as drawn; a point is inside when an odd number of them go around it.
        A loop that leaves the organ takes its surface with it.
    boundary : (b, 2) mm, the organ's (mesh's) outline, a closed loop whose last point is not repeated.
    source, space : what it was drawn by, such as a label and its file, and how points were read, for messages.

    Raises
    ------
    XfemnavError
        E310 it takes nothing of the organ; E311 it has no area; E312 nothing of the organ is left.
    """
    what = f"resection '{name}'" + (f" ({source})" if source else "")
    rings = [_checked(ring, what) for ring in rings]
    drawn, organ = without_slivers(even_odd(rings)), shapely.Polygon(boundary)
    if drawn.is_empty:
        raise XfemnavError("E311", f"{what} has no area; draw a closed loop around the tissue taken out.")
    region = without_slivers(shapely.intersection(drawn, organ))
    if region.is_empty:
        raise XfemnavError("E310", _never_meets(drawn, organ, what, space))
    refuse_all(region, organ, what)
    return _freed(name, region, organ)


def refuse_all(region, organ, what: str) -> None:
    """Raise E312 when a region leaves next to nothing of the organ."""
    if without_slivers(shapely.difference(organ, region)).area < LEAST_LEFT * organ.area:
        raise XfemnavError(
            "E312", f"{what} takes the whole organ ({organ.area:.0f} mm2) out; draw a smaller one."
        )


def place_united(drawn, united, boundary, names, sources, least_mm2: float) -> list[Resection | None]:
    """Clip several regions that belong together to the organ, without what their outlines leave between them.

    Parameters
    ----------
    drawn : the loops of each, as `place_resection` has them; united : the loops of all of them together, which hold
        what lies between: it goes with the region along which it runs for the longest.
    least_mm2 : separate parts of the whole under this size stay.

    A region of which nothing is left is None. Raises what `place_resection` does.
    """
    organ = shapely.Polygon(boundary)
    whole = place_resection(united, boundary, " and ".join(names), ", ".join(sources)).region.geoms if united else ()
    whole = shapely.MultiPolygon([part for part in whole if part.area >= least_mm2])
    placed = []
    for rings, name, source in zip(drawn, names, sources):
        own = place_resection(rings, boundary, name, source) if rings else None
        own = own and _freed(name, without_slivers(shapely.intersection(own.region, whole)), organ)
        placed.append(own if own and own.area_mm2 else None)
    if not any(placed) and not whole.is_empty:  # each is but specks, which the others join
        placed[0] = Resection(names[0], (), ())
    kept = [own for own in placed if own]
    between = shapely.difference(whole, shapely.union_all([own.region for own in kept]))
    shared = iter(shared_out(kept, between, organ))
    return [own and next(shared) for own in placed]


def shared_out(resections, more, organ) -> tuple[Resection, ...]:
    """The resections with some more tissue: each part of it with the one along whose wall it runs for the longest."""
    own = [[] for _ in resections]
    for part in polygons(more).geoms:
        near = shapely.buffer(part, SLIVER_MM, quad_segs=1)
        along = [shapely.intersection(resection.region.boundary, near).length for resection in resections]
        own[int(np.argmax(along))].append(part)
    return tuple(
        _freed(item.name, without_slivers(shapely.intersection(shapely.union_all([item.region, *parts]), organ)), organ)
        if parts else item for item, parts in zip(resections, own)
    )


def _freed(name, region, organ):
    rings = rings_of(region)
    return Resection(name, rings, inner_paths(rings, organ.exterior, ON_OUTLINE_MM))


def even_odd(rings) -> shapely.Geometry:
    """The region (multi-polygon) of all points inside an odd number of closed loops, a tuple of (k, 2) mm."""
    region = shapely.MultiPolygon()
    for ring in rings:
        if len(ring) > 2:
            region = shapely.symmetric_difference(region, shapely.make_valid(shapely.Polygon(ring)))
    return polygons(region)


def rings_of(region) -> tuple[np.ndarray, ...]:
    """All loops (k, 2) mm of a region, outer ones and holes, without the first point repeated."""
    return tuple(
        np.asarray(ring.coords)[:-1]
        for polygon in shapely.get_parts(region)
        for ring in (polygon.exterior, *polygon.interiors)
    )


def inner_paths(rings, outline, near) -> tuple[np.ndarray, ...]:
    """What is left of closed loops, (k, 2) mm each, without the stretches that run along the `outline`.

    near : mm within which the ends and the middle of a stretch count as on the outline. A loop that does not touch it
    stays whole, with its first point repeated.
    """
    paths = []
    for ring in rings:
        closed = np.vstack([ring, ring[:1]])
        ends, middles = (shapely.points(x) for x in (closed, (closed[1:] + closed[:-1]) / 2))
        at_end, at_middle = (shapely.distance(outline, x) <= near for x in (ends, middles))
        cuts = ~(at_end[1:] & at_end[:-1] & at_middle)
        if cuts.all():
            paths.append(closed)
            continue
        first = int(np.argmin(cuts)) + 1  # the loop is read from just behind a stretch on the outline
        cuts, ring = np.roll(cuts, -first), np.roll(ring, -first, axis=0)
        closed = np.vstack([ring, ring[:1]])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], cuts, [False]]).astype(int)))
        paths.extend(closed[start : stop + 1] for start, stop in edges.reshape(-1, 2))
    return tuple(paths)


def polygons(geometry) -> shapely.MultiPolygon:
    """The polygons of a geometry, without lines and points."""
    return shapely.MultiPolygon(
        [part for part in shapely.get_parts(shapely.get_parts(geometry)) if part.geom_type == "Polygon" and part.area]
    )


def without_slivers(region):
    """The region without parts and holes that are thinner, in the mean, than a thousandth of a millimetre."""

    def thick(polygon):
        return polygon.area > SLIVER_MM * polygon.length / 2

    kept = []
    for part in shapely.get_parts(polygons(region)):
        holes = [hole for hole in part.interiors if thick(shapely.Polygon(hole))]
        kept.append(shapely.Polygon(part.exterior, holes))
    return shapely.MultiPolygon([part for part in kept if thick(part)])


def _checked(ring, what):
    ring = np.asarray(ring, dtype=float)
    if ring.ndim != 2 or ring.shape[1:] != (2,) or not np.isfinite(ring).all():
        raise XfemnavError("E311", f"{what} has no finite 2-D points; give a closed loop of them.")
    return ring


def _never_meets(region, organ, what, space):
    distance, at = organ.distance(region), np.asarray(region.centroid.coords)[0]
    where = f"about ({at[0]:.1f}, {at[1]:.1f}) mm, {distance:.1f} mm from it"
    text = f"{what} takes nothing of the organ: it lies {where}."
    for sign in FLIPS:
        if organ.intersects(shapely.transform(region, lambda x, sign=sign: x * sign)):
            meant = other_frame(space, sign)
            return f"{text} With the sign of its coordinates changed it would not: did you mean {meant}?"
    return f"{text} Check the frame of its points: ⟦space=ras|lps|voxel⟧."
