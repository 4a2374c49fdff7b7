"""What every mask becomes before it is used: one component without holes."""

import numpy as np
from scipy import ndimage

from xfemnav.errors import XfemnavError, warn


def largest_component(mask: np.ndarray) -> np.ndarray:
    """The largest 4-connected component of a mask (n1, n2); all False when there is none."""
    labels, n = ndimage.label(mask)
    return labels == 1 + np.argmax(np.bincount(labels.ravel())[1:]) if n else np.zeros(mask.shape, bool)


def one_piece(mask: np.ndarray) -> np.ndarray:
    """Largest component of `mask` (n1, n2) with its holes filled: ventricles are inside the organ.

    Raises E201 when nothing is left and E203 when there is no background.
    """
    mask = np.asarray(mask, bool)
    filled = ndimage.binary_fill_holes(largest_component(mask))
    if not filled.any():
        raise XfemnavError("E201", f"the mask is empty: none of {mask.size} pixels is organ. Give a --mask FILE.")
    if filled.all():
        raise XfemnavError("E203", f"the mask covers the whole slice of {mask.shape[0]} x {mask.shape[1]} pixels, so "
                                   "the organ has no outline. Give a mask with background around it.")
    return filled


def clean(mask: np.ndarray, spacing) -> np.ndarray:
    """`one_piece` of a user's mask; warns W205 with what changed, mm^2."""
    mask, whole = np.asarray(mask, bool), one_piece(mask)
    pixel = float(np.prod(spacing))
    dropped, holes = (mask & ~whole).sum() * pixel, (whole & ~mask).sum() * pixel
    if dropped or holes:
        warn("W205", f"the mask was cleaned: {whole.sum() * pixel:.0f} mm2 kept, {dropped:.1f} mm2 in other "
                     f"components dropped, {holes:.1f} mm2 of holes filled.")
    return whole


def dice(a: np.ndarray, b: np.ndarray) -> float:
    """Dice overlap of two masks: 1 the same, 0 disjoint; two empty masks are the same."""
    total = int(np.sum(a)) + int(np.sum(b))
    return 2 * int(np.sum(a & b)) / total if total else 1.0
