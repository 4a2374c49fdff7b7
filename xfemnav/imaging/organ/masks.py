"""What every mask becomes before it is used: true or false in each pixel; the organ's: one component without holes."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from xfemnav.errors import XfemnavError, warn

BRIGHTEST = 99.9  # percentile of what is not 0 that ends the range of a soft mask: single voxels may overshoot
ROUNDING = 1e-6  # of a whole number that a header's slope has scaled


def mask_of(image, values: np.ndarray) -> np.ndarray:
    """The mask (n1, n2) bool in `values` of an image, those on a slice: where they are not 0.

    In a soft mask, an image with fractions, from half of its range on, which is that of the whole image. Two values are
    a mask whatever they are; warns W209 of any other, with what was taken.
    """
    soft = not is_whole(image.values)
    if soft:
        marked = image.values[image.values != 0]
        if marked.min() == marked.max():
            return values != 0
        low, high = float(image.values.min()), float(np.percentile(marked, BRIGHTEST, method="lower"))
        half = (low + high) / 2
        mask = values >= half
        warn("W209", f"{image.name} holds fractions, as a soft mask does: what is {half:.3g} or more is taken, half of "
                     f"its range from {low:.3g} to {high:.3g}; {mask.sum()} pixels.")
        return mask
    mask = values != 0
    if (found := np.unique(values[mask])).size > 1:
        half = (values >= (image.values.min() + image.values.max()) / 2).sum()
        warn("W209", f"{image.name} is no mask of two values, but holds {found.size} beside 0: all that is not 0 is "
                     f"taken, {mask.sum()} pixels. If it is a soft mask in whole numbers, threshold it: {half} pixels "
                     "are half of its range or more.")
    return mask


def is_whole(values: np.ndarray) -> bool:
    """Whether all values are whole numbers, but for the rounding of single precision."""
    return bool((abs(values - np.rint(values)) <= ROUNDING * np.maximum(abs(values), 1)).all())


def components(mask: np.ndarray) -> np.ndarray:
    """Number (n1, n2) of the 4-connected component of each pixel of a mask, in the order of their first pixels.

    Pixels off the mask have -1. Runs of pixels along the rows are nodes of a graph, and an edge joins two that touch.
    """
    starts = _starts(mask)
    run, overlaps = np.cumsum(starts.ravel()).reshape(mask.shape) - 1, _starts(mask[1:] & mask[:-1])
    edges = coo_array((np.ones(overlaps.sum(), bool), (run[:-1][overlaps], run[1:][overlaps])), (starts.sum(),) * 2)
    return np.where(mask, np.append(connected_components(edges, directed=False)[1], -1)[run], -1)


def _starts(mask: np.ndarray) -> np.ndarray:
    """The first pixel (n1, n2) of every run along the rows of a mask."""
    starts = mask.copy()
    starts[:, 1:] &= ~mask[:, :-1]
    return starts


def largest_component(mask: np.ndarray) -> np.ndarray:
    """The largest 4-connected component of a mask (n1, n2); all False when there is none."""
    number = components(mask)
    return number == np.bincount(number[mask]).argmax() if mask.any() else np.zeros(mask.shape, bool)


def filled(mask: np.ndarray) -> np.ndarray:
    """A mask (n1, n2) without its holes: background that no way along rows and columns leads to the slice's edge."""
    ways = components(~np.pad(mask, 1))
    return ways[1:-1, 1:-1] != ways[0, 0]


def touched(mask: np.ndarray) -> np.ndarray:
    """Pixels (n1, ...) of a mask and those that touch them, also across a corner."""
    for axis in range(mask.ndim):
        wide = np.pad(mask, [(1, 1) if k == axis else (0, 0) for k in range(mask.ndim)])
        mask = np.logical_or.reduce([np.take(wide, range(k, k + mask.shape[axis]), axis) for k in range(3)])
    return mask


def one_piece(mask: np.ndarray) -> np.ndarray:
    """Largest component of `mask` (n1, n2) with its holes filled: ventricles are inside the organ.

    Raises E201 when nothing is left and E203 when there is no background.
    """
    mask = np.asarray(mask, bool)
    whole = filled(largest_component(mask))
    if not whole.any():
        raise XfemnavError("E201", f"the mask is empty: none of {mask.size} pixels is organ. Give a ⟦mask=FILE⟧.")
    if whole.all() and not mask.all():
        raise XfemnavError("E203", f"the mask marks what surrounds the organ, {mask.mean():.0%} of the slice up to its "
                                   "edge: it looks inverted, or its background is not 0. Give the organ's pixels.")
    if whole.all():
        raise XfemnavError("E203", f"the mask covers the whole slice of {mask.shape[0]} x {mask.shape[1]} pixels, so "
                                   "the organ has no outline. Give a mask with background around it.")
    return whole


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
