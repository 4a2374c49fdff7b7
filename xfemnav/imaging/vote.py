"""Three ways to find the brain in a slice of a head, and their vote.

Each fails on other slices: the largest bright component where scalp joins brain, the watershed where the skull is
thin, the search where nothing stands out; hence the majority. All lengths are in mm on the working copy; the copy's
values are about 0 in air and 1 in the brightest tissue.
"""

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.measure import regionprops
from skimage.segmentation import watershed

from xfemnav.imaging.discs import depth, dilate, opened, sealed
from xfemnav.imaging.masks import largest_component
from xfemnav.imaging.working import Working

OPEN_MM, CLOSE_MM = 2.0, 6.0  # removes strands of scalp and dura; bridges sulci
THRESHOLDS = (0.7, 0.85, 1.0, 1.15, 1.3)  # of Otsu's
OPENINGS_MM = (1.0, 2.0, 4.0, 6.0)
SCALP_MM = 5.0  # the outermost tissue of a head is never brain
CORE = 0.45  # of the head's greatest depth: deeper is brain


def head_of(work: Working) -> np.ndarray:
    """Everything that is not air (m1, m2), filled."""
    bright = work.values > 0.4 * threshold_otsu(work.values)
    return largest_component(sealed(opened(bright, 1 / work.pixel), 4 / work.pixel))


def largest_otsu(work: Working) -> np.ndarray:
    """The largest component above Otsu's threshold, filled (m1, m2)."""
    return ndimage.binary_fill_holes(largest_component(work.values > threshold_otsu(work.values)))


def marker_watershed(work: Working, head: np.ndarray) -> np.ndarray:
    """The bright tissue on the core's side of the darkest ring between the head's core and its scalp (m1, m2)."""
    below = depth(head) * work.pixel
    markers = np.where(below > CORE * below.max(), 1, np.where(below < SCALP_MM, 2, 0))
    smooth = ndimage.gaussian_filter(work.values, 1.5 / work.pixel)
    inside = watershed(-smooth, markers) == 1
    return ndimage.binary_fill_holes(largest_component(inside & (work.values > 0.7 * threshold_otsu(work.values))))


def best_candidate(work: Working, head: np.ndarray) -> np.ndarray:
    """The best of the central components over thresholds and openings (m1, m2): see `score`."""
    otsu, below = threshold_otsu(work.values), depth(head) * work.pixel
    candidates = []
    for threshold in THRESHOLDS:
        bright = work.values > threshold * otsu
        inner = depth(bright)
        for radius in np.divide(OPENINGS_MM, work.pixel):
            core = central(dilate(inner > radius, radius), below)
            grown = bright & dilate(core, radius)
            candidates.append(sealed(grown, CLOSE_MM / work.pixel))
    return max(candidates, key=lambda mask: score(mask, work, below), default=np.zeros(head.shape, bool))


def score(mask: np.ndarray, work: Working, below: np.ndarray) -> float:
    """How much `mask` looks like a brain: a bright rim in a dark ring, solid, and away from the scalp.

    `below` (m1, m2) is the depth in the head, mm. Each term is about 0..1.
    """
    if not mask.any():
        return -np.inf
    inner, outer = depth(mask) * work.pixel, ndimage.distance_transform_edt(~mask) * work.pixel
    rim, ring = mask & (inner <= 3), (outer > 1) & (outer <= 4)
    contrast = np.median(work.values[rim]) - np.median(work.values[ring]) if ring.any() else 0.0
    solidity = regionprops(mask.astype(np.uint8))[0].solidity
    near_scalp = np.mean(below[rim] < SCALP_MM + 3)
    return contrast + solidity - 2 * near_scalp


def central(mask: np.ndarray, below: np.ndarray) -> np.ndarray:
    """The component of `mask` that holds most of the head's depth `below` (m1, m2), mm."""
    labels, n = ndimage.label(mask)
    if n == 0:
        return mask
    return labels == 1 + np.argmax(ndimage.sum_labels(below**2, labels, np.arange(1, n + 1)))


def vote(work: Working, head: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Majority mask (m1, m2) of the three methods in a `head` (m1, m2), cleaned, and the members."""
    members = {"otsu": largest_otsu(work), "watershed": marker_watershed(work, head),
               "search": best_candidate(work, head)}
    majority = sum(member.astype(int) for member in members.values()) >= 2
    core = central(opened(majority, OPEN_MM / work.pixel), depth(head) * work.pixel)
    return sealed(core, CLOSE_MM / work.pixel), members
