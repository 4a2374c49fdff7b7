"""Three ways to find the brain in a slice of a head, and their vote.

Each fails on other slices: the largest bright component where scalp joins brain, the watershed where the skull is
thin, the search where nothing stands out; hence the majority. What is bright depends on the contrast and on how a
scanner or a program maps its signal to grey values, so they vote in several tones, powers of the brightness that bring
the core of the head to set levels, and the vote whose outline looks most like a brain's is taken. All lengths are in mm
on the working copy; the copy's values are about 0 in air and 1 in the brightest tissue.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.measure import regionprops
from skimage.segmentation import watershed

from xfemnav.imaging.organ.discs import depth, dilate, opened, sealed
from xfemnav.imaging.organ.masks import dice, largest_component
from xfemnav.imaging.organ.working import Working

OPEN_MM, CLOSE_MM = 2.0, 6.0  # removes strands of scalp and dura; bridges sulci
THRESHOLDS = (0.7, 0.85, 1.0, 1.15, 1.3)  # of Otsu's
OPENINGS_MM = (1.0, 2.0, 4.0, 6.0)
SCALP_MM = 5.0  # the outermost tissue of a head is never brain
CORE = 0.45  # of the head's greatest depth: deeper is brain
TONES, REFERENCE = (0.35, 0.5, 0.65, 0.8), 0.55  # levels of the core: in which they vote, in which votes are compared
FLUID_MM = 12.0  # how thick the fluid around a brain may be where it is cut aslant; ventricles lie deeper
FLUID, FLUID_RIM = 1.3, 0.35  # of the brain's brightness in depth, and of its rim: in T2 there is bright fluid
DEEP = 0.5  # of the greatest depth
BETWEEN = 0.6  # of the way from the brightness in depth to the fluid's: cortex is half-way
COMMON = 0.1  # Dice: methods of which only two have more in common than this have found noise
ENOUGH = 0.3  # of the brightness: more of a step at the outline is scalp against air


def head_of(work: Working) -> np.ndarray:
    """Everything that is not air (m1, m2), filled.

    Otsu's threshold of the logarithms, so that a tone curve does not move it: air and tissue differ by factors.
    """
    floor = np.percentile(work.values[work.values > 1e-6], 1)
    logs = np.log(np.maximum(work.values, floor))
    shown = logs > threshold_otsu(logs)
    return largest_component(sealed(opened(shown, 1 / work.pixel), 4 / work.pixel))


def from_air(head: np.ndarray) -> np.ndarray:
    """Distance, pixels, of the pixels of a head (m1, m2) from the air: where the image ends inside it is none."""
    return ndimage.distance_transform_edt(head) if not head.all() else np.full(head.shape, np.inf)


def largest_otsu(work: Working) -> np.ndarray:
    """The largest component above Otsu's threshold, filled (m1, m2)."""
    return ndimage.binary_fill_holes(largest_component(work.values > threshold_otsu(work.values)))


def marker_watershed(work: Working, head: np.ndarray) -> np.ndarray:
    """The bright tissue on the core's side of the darkest ring between the head's core and its scalp (m1, m2)."""
    below = depth(head) * work.pixel
    markers = np.where(below > CORE * below.max(), 1, np.where(from_air(head) * work.pixel < SCALP_MM, 2, 0))
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


@dataclass(frozen=True, eq=False)
class Ballot:
    """The vote in one tone: its `mask` (m1, m2), the Dice of each pair of the three methods, and how brain-like its
    outline looks, with the fluid around the brain where that is bright."""

    mask: np.ndarray
    agreement: dict[str, float]
    looks: "Looks"


@dataclass(frozen=True)
class Looks:
    """What a mask's outline looks like, in the reference tone: brightness as a share of the mask's median.

    step: of a rim of 3 mm over a ring beyond it, medians; beyond: the ring's upper quartile; solidity; near: share of
    the rim that lies within 8 mm of the air.
    """

    step: float
    beyond: float
    solidity: float
    near: float

    @property
    def merit(self) -> float:
        """Large for a bright, solid brain in a dark ring, away from the scalp."""
        return min(self.step, ENOUGH) + 4 * self.solidity - 4 * self.near - 2 * self.beyond


def looks_of(mask: np.ndarray, values: np.ndarray, skin: np.ndarray, pixel: float) -> Looks:
    """Looks of a mask (m1, m2), not empty, in a tone of `values`; `skin` (m1, m2): distance from the air, mm."""
    inner, outer = depth(mask) * pixel, ndimage.distance_transform_edt(~mask) * pixel
    rim, ring = mask & (inner <= 3), (outer > 1) & (outer <= 4)
    level = max(float(np.median(values[mask])), 1e-3)
    around = values[ring] if ring.any() else np.zeros(1)
    return Looks(float(np.median(values[rim]) - np.median(around)) / level, float(np.percentile(around, 75)) / level,
                 float(regionprops(mask.astype(np.uint8))[0].solidity), float(np.mean(skin[rim] < SCALP_MM + 3)))


def vote(work: Working, head: np.ndarray) -> tuple[np.ndarray, list[Ballot]]:
    """Majority mask (m1, m2) of the three methods in a `head` (m1, m2), cleaned, and the ballots, the best one first.

    The mask is empty when no tone shows anything.
    """
    below = depth(head) * work.pixel
    core = below > CORE * below.max()
    reference = work.toned(REFERENCE, core).values
    skin = from_air(head) * work.pixel
    found = [_ballot(work.toned(level, core), head, below, skin, reference) for level in TONES]
    ballots = sorted(filter(None, found), key=lambda ballot: -ballot.looks.merit)
    return ballots[0].mask if ballots else np.zeros(head.shape, bool), ballots


def _ballot(work: Working, head: np.ndarray, below: np.ndarray, skin: np.ndarray, reference: np.ndarray):
    """The ballot in the tone of `work`, compared in that of `reference`; None when nothing is found.

    `below`, `skin` (m1, m2): depth in the head, and distance from the air, mm.
    """
    members = {"otsu": largest_otsu(work), "watershed": marker_watershed(work, head),
               "search": best_candidate(work, head)}
    majority = sum(member.astype(int) for member in members.values()) >= 2
    core = central(opened(majority, OPEN_MM / work.pixel), below)
    agreement = {f"{a}-{b}": dice(members[a], members[b]) for a, b in combinations(members, 2)}
    if not core.any() or sorted(agreement.values())[1] < COMMON:
        return None
    mask = sealed(core, CLOSE_MM / work.pixel)
    looks = looks_of(mask, reference, skin, work.pixel)
    return Ballot(_peeled(mask, reference, below, work.pixel), agreement, looks)


def _peeled(mask: np.ndarray, values: np.ndarray, below: np.ndarray, pixel: float) -> np.ndarray:
    """A mask (m1, m2) without the fluid around the brain where that is bright (T2), in the reference tone.

    Near the vertex most of the mask may be fluid: what is brain is told by its depth.
    """
    inner = depth(mask) * pixel
    level, rim = np.median(values[inner > DEEP * inner.max()]), values[mask & (inner <= 3)]
    if np.mean(rim > FLUID * level) < FLUID_RIM:
        return mask
    fluid = values > level + BETWEEN * (np.percentile(rim, 75) - level)
    core = central(opened(mask & ~(fluid & (inner <= FLUID_MM)), OPEN_MM / pixel), below)
    return sealed(core, CLOSE_MM / pixel) & mask if core.any() else mask
