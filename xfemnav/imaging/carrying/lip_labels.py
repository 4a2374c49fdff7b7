"""The lips of an opened cut in the image of today: which pixels they are, and which of the two."""

import numpy as np

from xfemnav.geometry.plane.cut import left_normals
from xfemnav.imaging.carrying.warp import PullBack
from xfemnav.imaging.organ.masks import touched

LEFT, RIGHT = 1, 2
# Tissue next to a gap that rested farther from every cut than this (diagonals of a pixel) is no lip but a wall of what
# was taken out. Its lip is less than one diagonal away, at rest less than two unless it was squeezed to half.
REACH = 2.0
TIE = 1e-9    # mm, between segments that are equally near


def lip_labels(motion: PullBack, gap, rest, cuts) -> np.ndarray:
    """Label (n1, n2) uint8: LEFT or RIGHT for pixels of tissue next to the `gap` (n1, n2) bool, else 0.

    Left and right are the sides of the `cuts`, paths (k, 2) mm, at which the tissue rested, in `motion`'s triangles at
    `rest` (t, 3, 2) mm, which do not cross the cuts. Neighbours across a corner are next to each other.
    """
    labels = np.zeros(motion.tissue.shape, np.uint8)
    beside = motion.tissue & touched(gap)
    if not (cuts and beside.any()):
        return labels
    places, centres = motion.resting[beside], rest[motion.triangle[beside]].mean(axis=1)
    # A pixel on a lip rested on the cut; a step into its own triangle leads off it, to the same side.
    left, distance = _beside(places + 1e-3 * (centres - places), cuts)
    near = distance <= REACH * np.linalg.norm(motion.spacing)
    labels[beside] = np.where(near, np.where(left, LEFT, RIGHT), 0)
    return labels


def _beside(points, paths):
    """Whether each of `points` (n, 2) is left of the nearest of `paths`, and its distance (n,) mm from it."""
    left, distance = np.zeros(len(points), bool), np.full(len(points), np.inf)
    for path in paths:
        from_start, step = points[:, None] - path[:-1], np.diff(path, axis=0)
        along = np.clip(np.einsum("nsi,si->ns", from_start, step) / (step**2).sum(axis=1), 0, 1)
        gap = np.linalg.norm(from_start - along[..., None] * step, axis=-1)
        off = np.einsum("nsi,si->ns", from_start, left_normals(path))
        # At a kink two segments are equally near; the one whose line the point is farther from knows the side.
        nearest = gap.min(axis=1)
        s = np.where(gap <= nearest[:, None] + TIE, abs(off), -1).argmax(axis=1)
        closer = nearest < distance
        left[closer], distance[closer] = off[np.arange(len(s)), s][closer] > 0, nearest[closer]
    return left, distance
