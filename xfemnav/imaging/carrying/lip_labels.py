"""The lips of an opened cut in the image of today: which pixels they are, and which of the two."""

import numpy as np

from xfemnav.geometry.sides import beside_cuts
from xfemnav.imaging.carrying.solid import SolidPullBack
from xfemnav.imaging.carrying.warp import PullBack
from xfemnav.imaging.organ.masks import touched

LEFT, RIGHT = 1, 2
# Tissue next to a gap that rested farther from every cut than this (diagonals of a pixel) is no lip but a wall of what
# was taken out. Its lip is less than one diagonal away, at rest less than two unless it was squeezed to half.
REACH = 2.0


def lip_labels(motion: PullBack | SolidPullBack, gap, rest, cuts) -> np.ndarray:
    """Label (n1, ...) uint8: LEFT or RIGHT for pixels of tissue next to the `gap` (n1, ...) bool, else 0.

    Left and right are the sides of the `cuts`, as a `Motion` has them, at which the tissue rested, in `motion`'s
    simplices at `rest` (t, d + 1, d) mm, which do not cross the cuts. Neighbours across a corner are next to each
    other.
    """
    labels = np.zeros(motion.tissue.shape, np.uint8)
    beside = motion.tissue & touched(gap)
    if not (cuts and beside.any()):
        return labels
    places, centres = motion.places_of(beside), rest[motion.simplices_of(beside)].mean(axis=1)
    # A pixel on a lip rested on the cut; a step into its own simplex leads off it, to the same side.
    distance, left = beside_cuts(cuts, places + 1e-3 * (centres - places))
    near = distance <= REACH * np.linalg.norm(motion.spacing)
    labels[beside] = np.where(near, np.where(left, LEFT, RIGHT), 0)
    return labels
