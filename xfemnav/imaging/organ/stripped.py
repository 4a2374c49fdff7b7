"""Skull-stripped images: how to tell one, and its mask.

Stripping tools write one value outside the brain. A head with its skull may have constant air too (thresholded or
defaced scans), but there the way inwards is bright scalp, dark skull, bright brain (in CT dim, bright, dim), and a
stripped brain has no such ring. Near the vertex and the occiput the ring lies so aslant that no shell of one depth
shows it: a volume is therefore judged by slices through its middle, and a lone slice that comes close is in doubt.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from xfemnav.imaging.frames.slices import Slice, take_slice
from xfemnav.imaging.organ.masks import largest_component
from xfemnav.imaging.organ.working import LEAST_BACKGROUND, background, robust_range
from xfemnav.imaging.reading.gate import Image
from xfemnav.limits import BRAIN_MM2, RIM_DIP

SPECK_MM2, SPECKLE = 25.0, 0.02  # noisy air: specks below this size on more than this share of the background
DIP = 0.14  # of the brightness in depth: stripped slices stay below .11, heads above .3
RIM_MM = 25.0  # scalp and skull end above this depth
RIM_SHARE = 0.6  # of the greatest depth: there the brain of the last slices is
RING, RING_MM = 1.4, 4.0  # a CT's skull is brighter than brain and scalp by this, and below the scalp
MIDDLE = (0.3, 0.4, 0.5, 0.6, 0.7)  # of a volume's extent: the slices that it is judged by
FEWEST = 5  # slices of a volume that has a middle


class Verdict(NamedTuple):
    """Whether an image is `stripped`; `doubt` says why that is not sure, "" when it is."""

    stripped: bool
    doubt: str = ""


def foreground(slice: Slice) -> np.ndarray:
    """The organ of a stripped slice: the largest part that is not background, with its holes."""
    return ndimage.binary_fill_holes(largest_component(~background(slice.values)))


def judge(slice: Slice, volume: Image | None = None) -> Verdict:
    """Whether the skull is off in a slice: a property of its `volume`, where that has a middle, else of the slice."""
    middle = [] if volume is None else _middle(volume, slice)
    rings, areas = np.transpose([_rim(one) for one in middle or [slice]])
    dip, area = float(np.median(rings)), float(np.median(areas))
    if dip >= DIP or (middle and area > BRAIN_MM2.value):
        return Verdict(False)
    if dip > RIM_DIP.value:
        return Verdict(True, f"below its rim it is darker by {dip:.2f} of its brightness, as if there were a skull "
                             f"(stripped slices: up to {RIM_DIP.value:g})")
    return Verdict(True)


def _middle(volume: Image, slice: Slice) -> list[Slice]:
    """Slices of the same plane through the middle of what a volume shows; none when it is too thin to have one."""
    shown = (volume.values != volume.values.flat[0]).any(axis=slice.array_axes[:2])
    shown = np.flatnonzero(shown)
    if len(shown) < FEWEST:
        return []
    places = {round(float(shown[0] + share * (shown[-1] - shown[0]))) for share in MIDDLE}
    return [take_slice(volume, plane=slice.plane, index=index) for index in sorted(places)]


def _rim(slice: Slice) -> tuple[float, float]:
    """How much of a skull the rim of a slice shows, of the brightness in depth, and the area inside the rim, mm2.

    Infinite where the background is not constant, or where a ring below the rim is far brighter than the depth.
    """
    outside, pixel = background(slice.values), slice.spacing.prod()
    labels, n = ndimage.label(~outside)
    areas = np.bincount(labels.ravel(), minlength=n + 1)[1:] * pixel
    organ = ndimage.binary_fill_holes(largest_component(~outside))
    constant = outside.mean() > LEAST_BACKGROUND and areas[areas < SPECK_MM2].sum() < SPECKLE * outside.sum() * pixel
    dip, ring = rim_profile(slice, organ) if constant else (np.inf, np.inf)
    return dip if ring < RING else np.inf, organ.sum() * pixel


def rim_profile(slice: Slice, organ: np.ndarray) -> tuple[float, float]:
    """How far the brightness falls and rises again between the edge of `organ` (n1, n2) and its depth, as a share of
    the brightness in depth; and how much brighter than both the scalp and the depth a shell between them is.

    Medians over pixels of one depth, in steps of 1 mm or a pixel. Depth is measured from the background: where the
    image ends inside the organ is no rim.
    """
    depth = ndimage.distance_transform_edt(organ, slice.spacing)
    reach, step = min(RIM_MM, RIM_SHARE * depth.max()), max(1.0, slice.spacing.max())
    low, _ = robust_range(slice.values)
    deep = np.median(slice.values[depth > reach]) - low
    if deep <= 0:
        return 0.0, 0.0
    edges = np.arange(0, reach, step)
    shells = [slice.values[(depth > d) & (depth <= d + step)] for d in edges]
    profile = np.array([np.median(shell) - low if shell.size else np.nan for shell in shells]) / deep
    fall = np.minimum(np.fmax.accumulate(profile), 1) - profile
    scalp = np.nanmax(profile[edges < RING_MM], initial=1.0)
    return float(np.nanmax(fall)), float(np.nanmax(profile[edges >= RING_MM], initial=0.0) / scalp)
