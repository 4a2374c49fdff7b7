"""Lines drawn in the deformed slice, taken back to where the tissue under them rested."""

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.motion import Motion

STEP_MM = 1.0  # a straight line is bent by the motion: it is followed in steps of this length
SIMPLE_MM = 0.01  # points that lie on the line to within this are left out again


def path_at_rest(path, motion: Motion, name: str) -> np.ndarray:
    """Resting place (k, 2) mm of a cut's path (n, 2) mm drawn in the slice as it is now.

    Its ends may lie outside the organ: they go with the tissue next to them on the path. Raises E313 where it crosses
    a place without tissue, such as an opened cut.
    """
    points, resting, known = _followed(path, motion, name)
    first, last = known[0], known[-1]
    if len(known) < last - first + 1:
        gap = points[np.setdiff1d(np.arange(first, last), known)[0]]
        raise XfemnavError("E313", f"'{name}' crosses a place without tissue at ({gap[0]:.1f}, {gap[1]:.1f}) mm of the "
                                   "deformed slice; draw it as several cuts, or in the preoperative one.")
    resting[:first] = points[:first] + resting[first] - points[first]
    resting[last + 1:] = points[last + 1:] + resting[last] - points[last]
    return _simple(resting)


def ring_at_rest(ring, motion: Motion, name: str) -> np.ndarray:
    """Resting place (k, 2) mm of a closed outline (n, 2) mm drawn in the slice as it is now.

    Where it runs through an opened cut or outside the organ, it goes with the tissue on either side of that place along
    the outline, linearly between. Raises E313 when it goes around no tissue.
    """
    points, resting, known = _followed(ring, motion, name, closed=True)
    if len(known) < 3:
        raise XfemnavError("E313", f"'{name}' goes around no tissue of the deformed slice; check where it was drawn.")
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    total = arc[-1] + np.linalg.norm(points[0] - points[-1])
    shift = [np.interp(arc, arc[known], (resting - points)[known, i], period=total) for i in (0, 1)]
    resting = points + np.stack(shift, axis=1)
    return _simple(np.vstack([resting, resting[:1]]))[:-1]


def _followed(path, motion, name, closed=False):
    """Points along the path, where they rested (NaN without tissue), and the indices of those that have tissue."""
    line = shapely.LinearRing(path) if closed else shapely.LineString(path)
    points = shapely.get_coordinates(shapely.segmentize(line, STEP_MM))
    points = points[:-1] if closed else points
    resting = motion.to_preoperative(points)
    known = np.flatnonzero(np.isfinite(resting[:, 0]))
    if not len(known):
        raise XfemnavError("E313", f"'{name}' touches no tissue of the deformed slice; check where it was drawn.")
    return points, resting, known


def _simple(path):
    return shapely.get_coordinates(shapely.simplify(shapely.LineString(path), SIMPLE_MM))
