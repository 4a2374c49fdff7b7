"""Skull-stripped slices: how to tell one, and its mask.

Stripping tools write one value outside the brain. A head with its skull may have constant air too (thresholded or
defaced scans), but there the way inwards is bright scalp, dark skull, bright brain; a stripped brain has no such dip.
"""

import numpy as np
from scipy import ndimage

from xfemnav.imaging.masks import largest_component
from xfemnav.imaging.slices import Slice
from xfemnav.imaging.working import robust_range

SPECK_MM2, SPECKLE = 25.0, 0.02  # noisy air: specks below this size on more than this share of the background
DIP = 0.14  # of the brightness in depth: stripped slices stay below .11, heads above .3
RIM_MM = 25.0  # scalp and skull end above this depth


def background(slice: Slice) -> np.ndarray:
    """Pixels (n1, n2) outside a stripped organ: the commonest value on the slice's edge, where it reaches the edge."""
    levels, counts = np.unique(_edge(slice.values), return_counts=True)
    labels, _ = ndimage.label(slice.values == levels[np.argmax(counts)])
    edge = _edge(labels)
    return np.isin(labels, edge[edge > 0])


def _edge(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])


def foreground(slice: Slice) -> np.ndarray:
    """The organ of a stripped slice: the largest part that is not background, with its holes."""
    return ndimage.binary_fill_holes(largest_component(~background(slice)))


def is_stripped(slice: Slice) -> bool:
    """Whether the background is constant and no skull shows on the way inwards."""
    outside = background(slice)
    labels, n = ndimage.label(~outside)
    areas = np.bincount(labels.ravel(), minlength=n + 1)[1:] * slice.spacing.prod()
    constant = outside.mean() > 0.1 and areas[areas < SPECK_MM2].sum() < SPECKLE * outside.sum() * slice.spacing.prod()
    return bool(constant and rim_dip(slice, foreground(slice)) < DIP)


def rim_dip(slice: Slice, organ: np.ndarray) -> float:
    """How far the brightness falls and rises again between the edge of `organ` (n1, n2) and its depth.

    As a share of the brightness in depth; medians over pixels of one depth, in steps of 1 mm or a pixel.
    """
    depth = ndimage.distance_transform_edt(np.pad(organ, 1), slice.spacing)[1:-1, 1:-1]
    reach, step = min(RIM_MM, depth.max() / 2), max(1.0, slice.spacing.max())
    low, _ = robust_range(slice.values)
    deep = np.median(slice.values[depth > reach])
    shells = [slice.values[(depth > d) & (depth <= d + step)] for d in np.arange(0, reach, step)]
    profile = np.array([np.median(shell) - low for shell in shells if shell.size])
    fall = np.minimum(np.maximum.accumulate(profile), deep - low) - profile
    return float(fall.max() / (deep - low)) if deep > low else 0.0
