"""The working copy that segmentation runs on: square pixels of 1 mm, intensities in robust units.

Radii are then the same in mm on every scan, and thresholds the same for every scale and offset of the intensities.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from xfemnav.errors import XfemnavError
from xfemnav.imaging.frames.slices import Slice

PIXEL_MM = 1.0
MOST_PIXELS = 2**20
POWERS = 0.2, 5.0  # of tone curves
LEAST_BACKGROUND = 0.03  # of a slice: what is rarer is no constant that a program wrote around the organ


@dataclass(frozen=True, eq=False)
class Working:
    """Copy of a slice: `values` (m1, m2), about 0 in air and 1 in the brightest tissue; square `pixel` mm."""

    values: np.ndarray
    pixel: float
    shape: tuple[int, int]
    ratio: np.ndarray

    def forth(self, values: np.ndarray) -> np.ndarray:
        """`values` (n1, n2) on the slice's pixels, on the copy's (m1, m2)."""
        return resize(values, self.ratio, self.values.shape)

    def back(self, mask: np.ndarray) -> np.ndarray:
        """A mask of the copy on the slice's own pixels, bool (n1, n2)."""
        return resize(mask.astype(float), 1 / self.ratio, self.shape) > 0.5

    def toned(self, level: float, core: np.ndarray) -> "Working":
        """The same with a tone curve, a power, that brings the median brightness of a `core` (m1, m2) to `level`."""
        median = float(np.clip(np.median(self.values[core]), 0.02, 0.98))
        power = float(np.clip(np.log(level) / np.log(median), *POWERS))
        return replace(self, values=np.clip(self.values, 0, None) ** power)


def resize(values: np.ndarray, ratio, shape) -> np.ndarray:
    """`values` on a grid of `shape` whose pixels are `ratio` (2,) of the old ones; both grids cover the same area."""
    ratio = np.asarray(ratio, float)
    smooth = ndimage.gaussian_filter(values, 0.5 * np.sqrt(np.maximum(ratio**2 - 1, 0)), mode="nearest")
    places = [(np.arange(n) + 0.5) * r - 0.5 for n, r in zip(shape, ratio)]
    return ndimage.map_coordinates(smooth, np.meshgrid(*places, indexing="ij"), order=1, mode="nearest")


def working_copy(slice: Slice) -> Working:
    """Square-pixel copy of `slice` in robust units. Raises E202 when all its pixels have one value."""
    values = slice.values
    if values.max() == values.min():
        raise XfemnavError("E202", f"the {slice.plane} slice at {slice.offset:.2f} mm is constant ({values[0, 0]:g}): "
                                   "choose another one, or give ⟦mask=FILE⟧.")
    # Air is darker than any tissue, but a constant that a program wrote there may lie amid the values of tissue.
    outside = background(values)
    if outside.mean() > LEAST_BACKGROUND:
        values = np.where(outside, values.min(), values)
    extent = np.array(values.shape) * slice.spacing
    pixel = max(PIXEL_MM, float(np.sqrt(extent.prod() / MOST_PIXELS)))
    shape = tuple(int(n) for n in np.maximum(np.rint(extent / pixel), 1))
    ratio = np.array(values.shape) / shape
    low, high = robust_range(values)
    return Working((resize(values, ratio, shape) - low) / (high - low), pixel, values.shape, ratio)


def background(values: np.ndarray) -> np.ndarray:
    """Pixels (n1, n2) outside a stripped organ: the commonest value on the slice's edge, where it reaches the edge."""
    levels, counts = np.unique(_edge(values), return_counts=True)
    labels, _ = ndimage.label(values == levels[np.argmax(counts)])
    edge = _edge(labels)
    return np.isin(labels, edge[edge > 0])


def _edge(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])


def robust_range(values: np.ndarray) -> tuple[float, float]:
    """Background level (1st percentile of all) and the 99th percentile of what Otsu's threshold calls bright."""
    low, high = np.percentile(values, 1), np.percentile(values[values > threshold_otsu(values)], 99)
    return (float(low), float(high)) if high > low else (float(values.min()), float(values.max()))
