"""The organ in a volume: its mask, or what a skull-stripping tool left."""

import numpy as np
from scipy import ndimage

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.frames.volume import Volume
from xfemnav.imaging.organ.segment import Segmentation
from xfemnav.imaging.organ.stripped import judge
from xfemnav.imaging.reading.gate import Image
from xfemnav.limits import BRAIN_MM3, LEAST_BRAIN_MM3

TOOLS = "SynthStrip (mri_synthstrip), HD-BET (hd-bet) or ANTs (antsBrainExtraction.sh)"


def organ_in(volume: Volume, image: Image, mask: np.ndarray | None, skull: str = "auto") -> Segmentation:
    """The organ in a volume: the largest piece of a `mask` (n1, n2, n3), without holes, or of what is not background in
    a stripped `image`. `skull`: "on" and "stripped" overrule the test for that.

    Raises E201 for an empty mask, E202 for a constant image, E203 for one without background, E205 where the skull is
    in the image and no mask is given. Warns W206 of a size that is no brain's, W212 where the image ends inside it.
    """
    method = "stripped" if mask is None else "mask"
    if mask is None:
        _refuse_heads(image, skull)
        mask = ~_background(image)
    if not mask.any():
        raise XfemnavError("E201", "the mask is empty: no voxel of it is set. Give another ⟦mask=FILE⟧.")
    found = ndimage.binary_fill_holes(_largest(mask))
    if found.all():
        raise XfemnavError("E203", "the mask covers the whole volume: the organ has no surface in it.")
    size = float(found.sum() * volume.spacing.prod())
    if size > BRAIN_MM3.value or (method != "mask" and size < LEAST_BRAIN_MM3.value):
        warn("W206", f"the organ ({method}) has {size / 1000:.0f} ml; a brain has {LEAST_BRAIN_MM3.value / 1000:g} to "
                     f"{BRAIN_MM3.value / 1000:g} ml. Look at it; give ⟦mask=FILE⟧.")
    if volume.border(found):
        warn("W212", "the image ends inside the organ: there is no skull there, and its surface is held. Do not trust "
                     "the "
                     "motion beside it; give an image that holds the whole organ.")
    return Segmentation(found, method, {"volume_mm3": size})


def _refuse_heads(image, skull):
    if image.values.min() == image.values.max():
        raise XfemnavError("E202", f"every voxel of {image.name} is {image.values.flat[0]:g}: there is nothing to "
                                   "find.")
    if skull == "stripped":
        return
    middle = take_slice(image, plane="axial", index=image.values.shape[_axial_axis(image)] // 2)
    if skull == "on" or not judge(middle, image).stripped:
        raise XfemnavError("E205", f"{image.name} shows a head with its skull, in which the brain of a volume is not "
                                   "looked "
                                   f"for; make a mask, by {TOOLS}, and give it: ⟦mask=FILE⟧. If it is stripped "
                                   "already, "
                                   "say so: ⟦skull_on=stripped⟧.")


def _axial_axis(image):
    """The array axis nearest to the world's third."""
    return int(np.argmax(np.abs(image.affine[2, :3]) / np.linalg.norm(image.affine[:3, :3], axis=0)))


def _background(image):
    """Voxels (n1, n2, n3) of the commonest value on the volume's faces that hang together with these."""
    faces = [np.take(image.values, end, axis=axis).ravel() for axis in range(3) for end in (0, -1)]
    levels, counts = np.unique(np.concatenate(faces), return_counts=True)
    same = np.pad(image.values == levels[np.argmax(counts)], 1, constant_values=True)
    labels, _ = ndimage.label(same)
    return (labels == labels[0, 0, 0])[1:-1, 1:-1, 1:-1]


def _largest(mask):
    """The largest piece of a mask (n1, n2, n3) whose voxels share faces."""
    labels, n = ndimage.label(mask)
    return labels == 1 + np.argmax(np.bincount(labels.ravel())[1:]) if n > 1 else np.asarray(mask, bool)
