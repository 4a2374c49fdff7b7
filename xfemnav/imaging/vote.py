"""Three ways to find the brain in a head, and their vote."""

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from xfemnav.imaging.masks import largest_component
from xfemnav.imaging.working import Working


def largest_otsu(work: Working) -> np.ndarray:
    """The largest component above Otsu's threshold, filled (m1, m2)."""
    return ndimage.binary_fill_holes(largest_component(work.values > threshold_otsu(work.values)))
