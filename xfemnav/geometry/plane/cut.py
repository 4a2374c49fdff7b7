"""A surgical cut: a polyline from its mouth on the organ's outline to its tip."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from shapely.ops import substring

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.mesh import frozen_array

#: A cut that starts inside the organ, but not deeper than this, is prolonged to the outline (mm).
PROLONG_MM = 5.0
#: A cut that starts deeper, but as near as this to another cut, is a branch of it (mm).
BRANCH_MM = 2.0
#: Signs of plane coordinates that were read in another frame, and what to say of them.
FLIPS = {(-1, -1): "", (-1, 1): " (or a left-right flip)"}


@dataclass(frozen=True, eq=False)
class Cut:
    """A cut inside the organ: `path` (k, 2) mm, plane frame, from the mouth (or first tip) to the tip.

    `mouth` tells whether ``path[0]`` lies on the outline; `craniotomy` whether the skull is open about it.
    """

    path: np.ndarray
    name: str = "cut"
    mouth: bool = True
    craniotomy: bool = True

    def __post_init__(self):
        object.__setattr__(self, "path", frozen_array(self.path, float, (None, 2), "path"))
        if len(self.path) < 2:
            raise ValueError("a cut needs two points")

    @cached_property
    def arc(self) -> np.ndarray:
        """Distance (k,) mm along the cut of each point of `path`, from the mouth."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.path, axis=0), axis=1))])

    @property
    def length(self) -> float:
        """Length of the cut, mm."""
        return float(self.arc[-1])

    @property
    def mouth_line(self) -> np.ndarray:
        """Its mouth (1, 2) mm, none of a cut without one."""
        return self.path[: int(self.mouth)]

    def at(self, fraction: float) -> np.ndarray:
        """Point (2,) mm at a fraction of the length: 0 the mouth, 1 the tip."""
        return np.array([np.interp(fraction * self.length, self.arc, self.path[:, i]) for i in (0, 1)])


def left_normals(path) -> np.ndarray:
    """Unit normals (k - 1, 2) to the left of each segment of a path (k, 2): (-dy, dx) for travel (dx, dy)."""
    travel = np.diff(path, axis=0)
    travel = travel / np.linalg.norm(travel, axis=1)[:, None]
    return np.stack([-travel[:, 1], travel[:, 0]], axis=1)


def place_cut(
    path, boundary, name: str = "cut", *, internal: bool = False, craniotomy: bool = True, others=(),
    space: str = "ras",
) -> Cut:
    """Clip a drawn path to the organ and find its mouth.

    Parameters
    ----------
    path : (k, 2) mm, plane frame, as drawn: it may start outside the organ, or a little inside.
    boundary : (b, 2) mm, the organ's (mesh's) outline, a closed loop whose last point is not repeated.
    internal : the cut lies inside, with two tips and no mouth.
    craniotomy : the skull is open about the mouth.
    space : how the path was read (ras, lps), for messages.
    others : paths (k, 2) mm of the other cuts. A cut that starts on one of them, deep inside, is its branch: it has no
        mouth, and its start is put on that cut (W304 when it was moved).

    Raises
    ------
    XfemnavError
        E301 it does not enter; E302 it starts deep inside; E303 no length; E304 it crosses itself;
        E305 it leaves and enters again, or runs along the outline. Warns W301 (prolonged), W302 (repeats), W307.
    """
    path = _without_repeats(np.asarray(path, dtype=float), name)
    _refuse_crossing(path, name)
    organ = shapely.Polygon(boundary)
    line = shapely.LineString(path)
    inside = [
        part
        for part in shapely.get_parts(shapely.line_merge(shapely.intersection(organ, line)))
        if part.geom_type == "LineString" and _is_interior(part, organ)
    ]
    if not inside:
        raise XfemnavError("E301", _never_enters(path, organ, name, space))
    if len(inside) > 1:
        again = np.round(inside[1].coords[0], 1).tolist()
        raise XfemnavError(
            "E305",
            f"cut '{name}' leaves the organ and enters it again at {tuple(again)} mm; "
            "split it into several cuts, or end it inside.",
        )
    _refuse_touching(inside[0], organ, name)
    clipped = np.asarray(inside[0].coords)
    if line.project(shapely.Point(clipped[0])) > line.project(shapely.Point(clipped[-1])):
        clipped = clipped[::-1]
    depth = organ.exterior.distance(shapely.Point(clipped[0]))
    if depth <= 1e-9:
        if internal:
            warn("W307", f"cut '{name}' is said to be internal, and begins outside of the organ: it was given a mouth "
                         f"at {_mm(clipped[0])}. Start it inside, or leave ⟦internal⟧ out.")
        return Cut(clipped, name, mouth=True, craniotomy=craniotomy)
    ends_outside = organ.exterior.distance(shapely.Point(clipped[-1])) <= 1e-9
    if ends_outside and (internal or depth > PROLONG_MM):
        raise XfemnavError(
            "E302",
            f"cut '{name}' is drawn from its tip {_mm(clipped[0])} to its mouth; give its points in the other order, "
            "from the surface inwards.",
        )
    if internal:
        return Cut(clipped, name, mouth=False, craniotomy=False)
    if depth > PROLONG_MM and (joint := _joint(clipped[0], others, name)) is not None:
        start = clipped if np.array_equal(joint, clipped[0]) else np.vstack([joint, clipped])
        return Cut(start, name, mouth=False, craniotomy=False)
    if depth > PROLONG_MM:
        raise XfemnavError(
            "E302",
            f"cut '{name}' starts {depth:.1f} mm inside the organ, at {_mm(clipped[0])}; start it at the "
            f"surface or on another cut, or give ⟦internal=True⟧ for a cut with two tips."
            f"{_would_enter(path, organ, space)}",
        )
    warn("W301", f"cut '{name}' started {depth:.1f} mm inside the outline and was prolonged to it.")
    return Cut(np.vstack([_backwards_to(organ, clipped), clipped]), name, mouth=True, craniotomy=craniotomy)


def _joint(start, others, name):
    """The point (2,) of the nearest other cut on which a branch starts; None when all are farther than BRANCH_MM."""
    point, lines = shapely.Point(start), [shapely.LineString(path) for path in others]
    distance = [line.distance(point) for line in lines]
    if not lines or min(distance) > BRANCH_MM:
        return None
    if min(distance) <= 1e-9:
        return start
    warn("W304", f"cut '{name}' started {min(distance):.2f} mm beside another cut and was joined to it.")
    nearest = lines[int(np.argmin(distance))]
    return shapely.get_coordinates(nearest.interpolate(nearest.project(point)))[0]


def _without_repeats(path, name):
    if path.ndim != 2 or path.shape[1:] != (2,) or not np.isfinite(path).all():
        raise XfemnavError("E303", f"cut '{name}' has no finite 2-D points; give at least two different points.")
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    keep = np.concatenate([[True], step > 1e-9])
    if keep.sum() < 2:
        raise XfemnavError(
            "E303",
            f"cut '{name}' has no length: all its points are {_mm(path[0])}; give at least two different points."
            if len(path)
            else f"cut '{name}' has no points; give at least two different points.",
        )
    if not keep.all():
        warn("W302", f"cut '{name}': {int((~keep).sum())} repeated points were merged.")
    return path[keep]


def _refuse_crossing(path, name):
    line = shapely.LineString(path)
    if shapely.is_simple(line) and not shapely.is_ring(line):
        return
    segments = shapely.linestrings(np.stack([path[:-1], path[1:]], axis=1))
    for i in range(len(segments)):
        for j in range(i + 1, len(segments)):
            meet = shapely.intersection(segments[i], segments[j])
            neighbours_touch = j == i + 1 and meet.geom_type == "Point"
            if not meet.is_empty and not neighbours_touch:
                raise XfemnavError(
                    "E304",
                    f"cut '{name}' crosses itself at {_mm(meet.centroid.coords[0])}, between segments "
                    f"{i + 1} and {j + 1}; draw it again or remove vertex {i + 2}.",
                )


def _is_interior(part, organ):
    """True when a part of the path runs inside the organ and not along its outline."""
    return part.length > 1e-9 and organ.exterior.distance(part.interpolate(0.5, normalized=True)) > 1e-9


def _refuse_touching(part, organ, name):
    """Between its ends a cut stays clear of the outline: neither along it nor against it from inside."""
    margin = min(1e-6, part.length / 4)
    between = substring(part, margin, part.length - margin)
    if organ.exterior.distance(between) <= 1e-9:
        where = shapely.shortest_line(organ.exterior, between).coords[0]
        raise XfemnavError(
            "E305", f"cut '{name}' touches the outline again at {_mm(where)}; keep it inside, or end it there."
        )


def other_frame(space: str, sign: tuple[int, int]) -> str:
    """What points may be meant in that were read in `space`, if these signs of theirs are wrong."""
    return f"⟦space={'ras' if space == 'lps' else 'lps'}⟧{FLIPS[sign]}"


def _never_enters(path, organ, name, space):
    distance = organ.distance(shapely.Point(path[0]))
    text = f"cut '{name}' does not enter the organ: the organ is {distance:.1f} mm from its first point {_mm(path[0])}."
    for sign in FLIPS:
        if organ.intersects(shapely.LineString(path * sign)):
            return f"{text} With the sign of its coordinates changed it would: did you mean {other_frame(space, sign)}?"
    return f"{text} Check the frame of the points: ⟦space=ras|lps|voxel⟧."


def _would_enter(path, organ, space):
    """What to say where the path, with other signs, would begin at the surface and enter."""
    for sign in FLIPS:
        start, line = shapely.Point(path[0] * sign), shapely.LineString(path * sign)
        if organ.intersects(line) and (organ.distance(start) > 0 or organ.exterior.distance(start) <= PROLONG_MM):
            return (" With the sign of its coordinates changed it would start there: did you mean "
                    f"{other_frame(space, sign)}?")
    return ""


def _backwards_to(organ, path):
    """Where the first segment, prolonged backwards, meets the outline; the nearest point when that is far."""
    start = path[0]
    back = (start - path[1]) / np.linalg.norm(start - path[1])
    ray = shapely.LineString([start, start + 2 * PROLONG_MM * back])
    hits = shapely.get_coordinates(shapely.intersection(ray, organ.exterior))
    if len(hits):
        return hits[np.argmin(np.linalg.norm(hits - start, axis=1))]
    return shapely.get_coordinates(organ.exterior.interpolate(organ.exterior.project(shapely.Point(start))))[0]


def _mm(point):
    return f"({point[0]:.1f}, {point[1]:.1f}) mm"
