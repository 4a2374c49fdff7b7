"""Morphology with discs whose radius is any real number of pixels, by distances; background lies around the array."""

import math

import numpy as np
from scipy import ndimage


def depth(mask: np.ndarray) -> np.ndarray:
    """Distance, pixels, of each True pixel to the nearest False one or the array's surroundings; 0 elsewhere."""
    return ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]


def erode(mask: np.ndarray, radius: float) -> np.ndarray:
    """Pixels (n1, n2) bool of `mask` farther than `radius` pixels from its outside."""
    return depth(mask) > radius


def dilate(mask: np.ndarray, radius: float) -> np.ndarray:
    """`mask` (n1, n2) bool with all pixels within `radius` pixels of it."""
    return ndimage.distance_transform_edt(~mask) <= radius if mask.any() else mask


def opened(mask: np.ndarray, radius: float) -> np.ndarray:
    """Parts of `mask` that a disc of `radius` reaches."""
    return dilate(erode(mask, radius), radius)


def sealed(mask: np.ndarray, radius: float) -> np.ndarray:
    """`mask` with its holes filled, and the bays whose mouth a disc of `radius` cannot pass.

    A closing, but for what lies behind a narrow mouth: there it fills a space of any size (a Sylvian fissure).
    """
    margin = math.ceil(radius) + 1
    grown = ndimage.binary_fill_holes(dilate(np.pad(mask, margin), radius))
    return erode(grown, radius)[(slice(margin, -margin),) * 2]
