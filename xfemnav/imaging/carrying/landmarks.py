"""Landmarks through the motion of the tissue, both ways, each with a word on what it is in.

Points are (n, 2) plane mm or (n, 3) world RAS mm; of a slice world points keep their distance from its plane.
"""

from dataclasses import dataclass

import numpy as np

from xfemnav.errors import warn
from xfemnav.geometry.locate import TOUCH, held
from xfemnav.geometry.mesh import frozen_array
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.within import within
from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.frames.slices import rows_of, warn_of_slice
from xfemnav.imaging.points.point_set import PointSet, frame_suspicion

TISSUE, ON_A_CUT, RESECTED, IN_THE_CUT, OUTSIDE = "tissue", "on a cut", "resected", "in the cut", "outside"


@dataclass(frozen=True, eq=False)
class MovedPoints:
    """`points` (n, d) mm, where they `moved` to (n, d), NaN where nowhere, and for each a `flag`.

    "tissue" moves. "on a cut" has two values, `lips` (n, 2, d) left and right (NaN for all other points, and for a lip
    that was resected); `moved` is that of the side asked for, else the one that both share, else NaN. "resected"
    tissue is gone. "in the cut" is a place now between lips, where nothing rested. "outside" is not the organ.
    """

    points: np.ndarray
    moved: np.ndarray
    lips: np.ndarray
    flag: tuple[str, ...]

    def __post_init__(self):
        points = np.asarray(self.points)
        for name, shape in (("points", points.shape), ("moved", points.shape), ("lips", (len(points), 2, None))):
            object.__setattr__(self, name, frozen_array(getattr(self, name), float, shape, name))


def moved_points(points, frame: Grid, motion: Motion, organ, side=None) -> MovedPoints:
    """Where preoperative `points` are now.

    `organ` (t, d + 1, d) mm: simplices of the whole organ at rest, also of what was resected. `side`: the lip for
    points on a cut, +1 left or -1 right, one for all or (n,); None or 0 for no choice.
    """
    points, plane, distance = _in_plane(points, frame)
    side = np.broadcast_to(0 if side is None else side, len(plane))
    moved = motion.to_current(plane)
    lips = _no_lips(plane)
    near = motion.near(plane)
    lips[near] = np.stack([motion.to_current(plane[near], s) for s in (1, -1)], axis=1)
    on_cut = np.isfinite(lips[..., 0]).any(axis=1)
    moved[on_cut] = _chosen(lips[on_cut], side[on_cut])
    tissue, there = np.isfinite(moved[:, 0]), held(plane, organ)
    flag = np.select([on_cut & (tissue | (side == 0)), tissue, there], [ON_A_CUT, TISSUE, RESECTED], OUTSIDE)
    return _result(points, frame, moved, lips, distance, flag)


def resting_points(points, frame: Grid, motion: Motion, outline) -> MovedPoints:
    """Where the tissue that is now at `points` was preoperatively.

    `outline`: the organ's outline now with its mouths bridged, a closed loop (k, 2) mm or closed triangles (k, 3, 3)
    mm. Where tissue overlaps, the result is one of its places.
    """
    points, plane, distance = _in_plane(points, frame)
    moved = motion.to_preoperative(plane)
    flag = np.select([np.isfinite(moved[:, 0]), within(plane, outline)], [TISSUE, IN_THE_CUT], OUTSIDE)
    return _result(points, frame, moved, _no_lips(plane), distance, flag)


def _no_lips(points) -> np.ndarray:
    """Lips (n, 2, d) of points (n, d) that are on no cut."""
    return np.full((len(points), 2, *points.shape[1:]), np.nan)


def warn_of_points(found: PointSet, name: str, frame: Grid, outline) -> None:
    """W131 and W132 of the landmarks `found` in the file `name`; `outline` is the organ's at their time."""
    if found.form is not None and not found.form.stated:
        warn("W131", f"{name} does not say in which frame its x,y,z count, nor does a coordsystem.json beside it; they "
                     "were read as RAS, as BIDS counts electrodes in an image. Name the columns r,a,s or l,p,s.")
    warn_of_frame(found.points, name, frame, outline, "Check the frame that the file states.")
    warn_of_slice(found.points, name, frame)


def warn_of_frame(points, name: str, frame: Grid, outline, mend: str) -> None:
    """W131 where `points` (n, 3) RAS mm of a file seem to count in another frame.

    `outline`, as in `within`: that of the organ at rest. `mend` says how the frame is set right.
    """
    suspicion = frame_suspicion(points, lambda world: within(frame.from_world(world)[0], outline))
    if suspicion:
        warn("W131", f"{name}: {suspicion} {mend}")


def _chosen(lips, side) -> np.ndarray:
    """Of the `lips` (n, 2, d) that of each `side` (n,); for 0 the only one or the one that both share, else NaN."""
    left, right = lips.swapaxes(0, 1)
    apart = np.linalg.norm(left - right, axis=1) > TOUCH    # False where one is NaN
    either = np.where(np.isnan(left), right, left)
    either[apart] = np.nan
    return np.where((side > 0)[:, None], left, np.where((side < 0)[:, None], right, either))


def _in_plane(points, frame: Grid):
    """The points (n, 2 or 3), where they are on the grid (n, d), and their signed distance (n,) mm from it."""
    points = rows_of(points)
    if points.shape[1] == 2:
        return points, points, np.zeros(len(points))
    return points, *frame.from_world(points)


def _result(points, frame: Grid, moved, lips, distance, flag) -> MovedPoints:
    """The result in the form of `points`: plane or world."""
    if points.shape[1] == 3:
        off = distance[:, None] * frame.axes[2]
        moved, lips = frame.to_world(moved) + off, frame.to_world(lips) + off[:, None]
    return MovedPoints(points, moved, lips, tuple(map(str, flag)))
