"""What images mark to be taken out, labels or masks: united, rid of what is under a size, and outlined."""

from dataclasses import dataclass

import numpy as np
import shapely
from skimage import measure

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.frames.slices import Slice, values_on
from xfemnav.imaging.organ.labels import refuse_fractions
from xfemnav.imaging.organ.masks import mask_of
from xfemnav.imaging.organ.outline import rings_of_mask
from xfemnav.imaging.reading.gate import Image

LOST = 0.05  # part of what is marked that may be lost in its outlines without a warning


@dataclass(frozen=True, eq=False)
class Marked:
    """Tissue that an image marks in a slice: `mask` (n1, n2) bool, the `labels` (n1, n2) of its pixels where they tell
    several apart, the `pixel_mm2` that each covers, and its `name` in messages."""

    mask: np.ndarray
    labels: np.ndarray
    pixel_mm2: float
    name: str

    @property
    def area_mm2(self) -> float:
        """Area of all that is marked."""
        return float(self.mask.sum() * self.pixel_mm2)


def marked(image: Image, frame: Slice, labels: tuple[int, ...] | None = None) -> Marked:
    """What has one of some labels, or what a mask marks, in the slice `frame`, whatever grid the image is on.

    Raises E131 for an image that is no label map, and E311 when none of the labels is on the slice; warns W209, and
    W314 of labels that the whole map does not hold.
    """
    values, pixel = values_on(image, frame, resample="nearest"), float(frame.spacing.prod())
    if labels is None:
        mask = mask_of(image, values)
        return Marked(mask, mask.astype(int), pixel, image.name)
    refuse_fractions(image)
    values, name = np.rint(values).astype(int), f"{_counted(labels)} of {image.name}"
    mask = np.isin(values, labels)
    held = ", ".join(str(value) for value in np.unique(values)[:20] if value) or "none"
    if not mask.any():
        raise XfemnavError("E311", f"{name} {'is' if len(labels) < 2 else 'are'} nowhere on this slice, which holds "
                                   f"the labels {held}. Check the number, and that the map covers the slice.")
    absent = tuple(label for label in labels if not (abs(image.values - label) < 0.5).any())
    if absent:
        warn("W314", f"nothing is taken out for {_counted(absent)}, nowhere in {image.name}, which holds the labels "
                     f"{held} on this slice. Check the numbers.")
    return Marked(mask, np.where(mask, values, 0), pixel, name)


def _counted(labels):
    return f"label{'s' * (len(labels) > 1)} " + ", ".join(map(str, labels))


def outlined(found, frame: Slice, least_mm2: float):
    """Closed outlines (k, 2) plane mm, a tuple each, of what several images mark, and those of all of it together.

    Separate bits of the whole under `least_mm2` are in none, and its holes under that are filled. Outlines are smooth:
    each loses pi pixels.
    """
    whole = sizeable(np.logical_or.reduce([item.mask for item in found]), least_mm2 / frame.spacing.prod())
    own = [rings_of_mask(item.mask & whole, frame.origin, frame.spacing) for item in found]
    return own, rings_of_mask(whole, frame.origin, frame.spacing)


def sizeable(mask: np.ndarray, least: float) -> np.ndarray:
    """A mask (n1, n2) without holes, and then without separate bits, of fewer than `least` pixels.

    Bits that touch at a corner are one; a hole does not reach the slice's edge.
    """
    ways = measure.label(np.pad(~mask, 1, constant_values=True), connectivity=1)
    small = np.bincount(ways.ravel()) < least
    small[ways[0, 0]] = False
    whole = mask | small[ways][1:-1, 1:-1]
    bits = measure.label(whole, connectivity=2)
    return whole & (np.bincount(bits.ravel()) >= least)[bits]


def warn_of_left(found: Marked, frame: Slice, region, organ, least_mm2: float) -> None:
    """Warn W208 of tissue in the `organ` that is marked and yet not in the `region` that is taken out.

    Bits of it apart, which are under the size, and what else its smooth outlines leave, when that is much.
    """
    pixel, centres = found.pixel_mm2, frame.origin + np.argwhere(found.mask) * frame.spacing
    mask = found.mask.copy()
    mask[found.mask] = shapely.contains_xy(organ, *centres.T)
    left = mask.copy()
    left[found.mask] &= ~shapely.contains_xy(region, *centres.T)
    bits = measure.label(found.mask, connectivity=2)
    apart = left & ~np.isin(bits, bits[mask & ~left])
    thin = (left & ~apart).sum() * pixel
    if apart.any():
        kinds, n_bits = np.unique(found.labels[apart]), len(np.unique(bits[apart]))
        shares = ", ".join(f"{(found.labels[apart] == kind).sum() * pixel:.3g} mm2 of label {kind}" for kind in kinds)
        what = f"{apart.sum() * pixel:.3g} mm2 of {found.name}" + (f" ({shares})" if len(kinds) > 1 else "")
        largest = np.bincount(bits[apart]).max() * pixel
        why = f"under {least_mm2:.3g} mm2, the disc of ⟦min_resection_mm⟧"
        if largest >= least_mm2:
            why = f"of {largest:.3g} mm2 at most, under two pixels wide" + (f", or {why}" if n_bits > 1 else "")
        warn("W208", f"{what} stay: {n_bits} separate bit{'s' * (n_bits > 1)} {why}.")
    if thin > LOST * mask.sum() * pixel:
        warn("W208", f"{thin:.3g} of {mask.sum() * pixel:.4g} mm2 of {found.name} that are taken out are under two "
                     "pixels wide, and stay.")
