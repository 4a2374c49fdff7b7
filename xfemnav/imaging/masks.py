"""What every mask becomes before it is used: one component without holes."""

import numpy as np
from scipy import ndimage

from xfemnav.errors import XfemnavError, warn


def largest_component(mask: np.ndarray) -> np.ndarray:
    """The largest 4-connected component of a mask (n1, n2); all False when there is none."""
    labels, n = ndimage.label(mask)
    return labels == 1 + np.argmax(np.bincount(labels.ravel())[1:]) if n else np.zeros(mask.shape, bool)


def clean(mask: np.ndarray, spacing) -> np.ndarray:
    """Largest component of `mask` (n1, n2) with its holes filled: ventricles are inside the organ.

    Raises E201 when nothing is left and E203 when there is no background; warns W205 with what changed in mm^2.
    """
    mask = np.asarray(mask, bool)
    kept = largest_component(mask)
    filled = ndimage.binary_fill_holes(kept)
    if not kept.any():
        raise XfemnavError("E201", f"the mask is empty: none of its {mask.size} pixels is set. Give another --mask.")
    if filled.all():
        raise XfemnavError("E203", f"the mask covers the whole slice of {mask.shape[0]} x {mask.shape[1]} pixels, so "
                                   "the organ has no outline. Give a mask with background around it.")
    pixel = float(np.prod(spacing))
    dropped, holes = (mask & ~filled).sum() * pixel, (filled & ~kept).sum() * pixel
    if dropped or holes:
        warn("W205", f"the mask was cleaned: {filled.sum() * pixel:.0f} mm2 kept, {dropped:.1f} mm2 in other "
                     f"components dropped, {holes:.1f} mm2 of holes filled.")
    return filled
