"""Tissue that cannot stay beside a resection: what it encloses, and what hangs on by less than an element.

What is left of the organ is opened by a disc one element wide (Matheron): eroded by its radius, then dilated. Bodies of
the eroded tissue hold to each other by less than an element; what the opening loses is narrower than one. Both go with
the resection where they are its doing: the organ itself is opened in the same way. A strip that joins two bodies that
stay is a bridge, and stays.
"""

from dataclasses import dataclass

import numpy as np
import shapely

from xfemnav.errors import warn
from xfemnav.geometry.plane.resection import polygons, shared_out, without_slivers
from xfemnav.limits import SHRED_WIDTH

LADDER = 1.5  # from one width to the next where the mesh is graded
CORNER = 0.5  # of a width squared: what the opening loses at a corner of the tissue is less
HANGING = 0.25  # of the resections' area: what hangs on at the surface and is larger stays
SLACK = 0.05  # of a width: arcs are polygons
HOLES = 0.05  # of the resections' area: so much of holes under the size is filled without a word
TOUCH_MM = 1e-6


@dataclass(frozen=True, eq=False)
class Elements:
    """Where the elements of a mesh are, (m, 2) mm, and their sizes (m,) mm, cut off at the widest that is a shred."""

    places: np.ndarray
    sizes: np.ndarray

    @classmethod
    def of(cls, mesh) -> "Elements":
        """Those of a mesh."""
        return cls(mesh.corners.mean(axis=1), np.minimum(mesh.sizes, SHRED_WIDTH.value))

    def beside(self, line) -> np.ndarray:
        """Sizes (k,) of the elements within about one of a geometry; of the nearest where there is none."""
        low, high = np.reshape(line.bounds, (2, 2)) + self.sizes.max() * np.array([[-1], [1]])
        boxed = np.flatnonzero(((self.places >= low) & (self.places <= high)).all(axis=1))
        boxed = boxed if len(boxed) else np.arange(len(self.sizes))
        off = shapely.distance(line, shapely.points(self.places[boxed]))
        near = boxed[off <= self.sizes[boxed]]
        return self.sizes[near if len(near) else boxed[[np.argmin(off)]]]

    def widths(self, line) -> list[float]:
        """Sizes of elements along a line, from the largest in steps of LADDER."""
        sizes = self.beside(line)
        low, high = np.percentile(sizes, (10, 90))
        steps = int(np.log(max(high / low, 1.0)) / np.log(LADDER))
        return [float(high if steps else np.median(sizes)) / LADDER**k for k in range(steps + 1)]


def without_shreds(resections, boundary, elements: Elements, *, least_mm2: float, hold: bool = False, held=()):
    """The resections, a tuple, each with the tissue beside it that cannot stay; warns W210 of its area and place.

    boundary : (b, 2) mm, the organ's outline. least_mm2 : holes under this size are filled without a word. hold :
    larger enclosed pieces stay, since something will hold them. held : lines that blades hold; nothing goes that would
    leave less than an element of one.
    """
    organ = shapely.Polygon(boundary)
    region = shapely.union_all([resection.region for resection in resections])
    gone = _afloat(organ, region, elements, least_mm2, hold)
    holes = [part for part in gone if part.area < least_mm2 and not _touch(part, organ.exterior)]
    gone = [part for part in gone if part not in holes]
    for width in elements.widths(region.boundary):
        whole = shapely.union_all([region, *holes, *gone])
        gone += _shreds(organ, whole, width, elements)
    whole = shapely.union_all([region, *holes, *gone])
    gone = _released(gone + _afloat(organ, whole, elements, least_mm2, hold), held, region, elements)
    told = gone + holes * (sum(part.area for part in holes) > HOLES * region.area)
    if told:
        _tell(resections, organ, region, told)
    return shared_out(resections, shapely.union_all([*holes, *gone]), organ)


def _afloat(organ, region, elements, least_mm2, hold):
    """Bodies of tissue that a region cuts off altogether: enclosed ones, and crumbs at the surface."""
    bodies = sorted(_bodies(shapely.difference(organ, region)), key=lambda body: -body.area)
    return [body for body in bodies[1:]
            if body.area < least_mm2 or _is_thin(body, elements)
            or not (hold or _touch(body, organ.exterior))]


def _is_thin(body, elements):
    """Whether a body is nowhere as wide as the elements in it."""
    return shapely.buffer(body, -np.median(elements.beside(body)) / 2, quad_segs=4).is_empty


def _shreds(organ, region, width, elements):
    """What hangs on to the rest by less than `width`, and strips narrower than that, beside a region."""
    found, (organ_cores, open_organ) = [], _opened(organ, width)
    for body in _bodies(shapely.difference(organ, region)):
        cores, opened = _opened(body, width)
        if not len(cores):
            continue
        stays = _stay(organ, region, width, cores, organ_cores)
        lost = shapely.difference(shapely.intersection(body, shapely.union_all(open_organ)),
                                  shapely.union_all(opened[stays]))
        for part in _bodies(lost):
            if part.area < CORNER * width**2 or not _touch(part, region):
                continue
            hangs, bridge = _touch(part, cores[~stays]).any(), _touch(part, opened[stays]).sum() > 1
            large = part.area > region.area and not hangs
            if not (bridge or large) and width < np.sqrt(LADDER) * np.mean(elements.beside(part)):
                found.append(shapely.intersection(organ, shapely.buffer(part, SLACK * width, quad_segs=2)))
    return found


def _stay(organ, region, width, cores, organ_cores):
    """Which of the eroded bodies (b,) of a piece of tissue stay: the largest, what does not hang on to it by the
    region's doing, and what is large and at the surface, where the skull may hold it."""
    area = shapely.area(shapely.buffer(cores, width / 2, quad_segs=4))
    point, whole = shapely.STRtree(organ_cores).query(shapely.point_on_surface(cores), predicate="intersects")
    of_organ = np.full(len(cores), -1)
    of_organ[point] = whole
    reach = (1 + SLACK) * width / 2
    surface, beside = (shapely.distance(cores, other) <= reach for other in (organ.exterior, region))
    largest = int(np.argmax(area))
    goes = beside & (of_organ == of_organ[largest]) & ~(surface & (area > HANGING * region.area))
    goes[largest] = False
    return ~goes


def _opened(tissue, width):
    """Bodies (b,) of tissue eroded by half a width, and the same dilated again."""
    cores = shapely.get_parts(polygons(shapely.buffer(tissue, -width / 2, quad_segs=4)))
    return cores, shapely.buffer(cores, (1 + SLACK) * width / 2, quad_segs=4)


def _bodies(tissue):
    return shapely.get_parts(without_slivers(tissue))


def _touch(one, other):
    return shapely.distance(one, other) <= TOUCH_MM


def _released(parts, held, region, elements):
    """The parts without those whose loss would leave a held line less than an element of tissue."""
    for line in held:
        gone = shapely.union_all([region, *parts])
        left, before = (shapely.difference(line, taken).length for taken in (gone, region))
        if left < before - TOUCH_MM and left < np.median(elements.beside(line)):
            parts = [part for part in parts if shapely.intersection(line, part).length <= TOUCH_MM]
    return parts


def _tell(resections, organ, region, parts):
    added = shapely.difference(shapely.intersection(shapely.union_all(parts), organ), region)
    pieces = sorted(_bodies(added), key=lambda part: -part.area)
    x, y = np.asarray(pieces[0].point_on_surface().coords)[0]
    names = " and ".join(f"'{item.name}'" for item in resections)
    more = f" in {len(pieces)} places, the largest {pieces[0].area:.3g} mm2" if len(pieces) > 1 else ""
    warn("W210", f"{added.area:.3g} mm2 of tissue{more} about ({x:.1f}, {y:.1f}) mm go with resection {names}: it "
                 "encloses them, or they hang on by less than an element.")
