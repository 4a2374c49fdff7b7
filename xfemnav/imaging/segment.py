"""Organ segmentation of one slice: slice -> one-component mask without holes.

Ventricles and sulci are inside: they are labels, not holes. A mask that is given wins; a skull-stripped slice is
filled; else three methods vote. Whatever comes out is the user's to judge: a doubtful mask warns, with reasons.
"""

from dataclasses import dataclass, field

import numpy as np

from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging.masks import clean
from xfemnav.imaging.slices import Slice
from xfemnav.imaging.stripped import foreground, is_stripped
from xfemnav.imaging.vote import largest_otsu
from xfemnav.imaging.working import working_copy


@dataclass(frozen=True, eq=False)
class Segmentation:
    """`mask` (n1, n2) bool on the slice's pixels, the `method` that made it, and `info`: its figures."""

    mask: np.ndarray
    method: str
    info: dict = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "mask", frozen_array(self.mask, bool, (None, None), "mask"))


def segment(slice: Slice, *, method: str = "auto", mask=None, skull: str = "auto") -> Segmentation:
    """Mask of the organ in `slice`."""
    if mask is not None:
        return Segmentation(clean(mask, slice.spacing), "mask")
    work = working_copy(slice)
    if method == "auto" and skull != "on" and (skull == "stripped" or is_stripped(slice)):
        return Segmentation(clean(foreground(slice), slice.spacing), "stripped")
    return Segmentation(clean(work.back(largest_otsu(work)), slice.spacing), "otsu")
