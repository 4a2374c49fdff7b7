"""The organ: whether the skull is off, and where the image ends inside it."""

import warnings

import nibabel as nib
import numpy as np
from rows import Row
from small import RAS, brain, write

import xfemnav
from tests.test_heads import roofed
from xfemnav.errors import XfemnavWarning
from xfemnav.imaging.organ.masks import dice

SMALL = {"element_size_mm": 8, "corridor_element_mm": 4, "report": False}


def ran(folder, image, **flags):
    """A run in a folder, and the codes of its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", XfemnavWarning)
        result = xfemnav.run(image, output=folder / "out", cache=folder / "cache", **SMALL, **flags)
    return result, [item["code"] for item in result.record["warnings"]]


def high_slice(folder):
    """A slice under the vertex, scalp all round and no dark ring, of a head with exact air."""
    image, mask = roofed()
    nib.save(nib.Nifti1Image(image.values.astype(np.float32), image.affine), folder / "head.nii.gz")
    k = image.values.shape[2] - 1
    result, codes = ran(folder, folder / "head.nii.gz", slice=k, cut="60,0 8,0", opening_mm=2)
    found = np.squeeze(nib.load(folder / "out" / result.record["outputs"]["mask"]).get_fdata()) > 0
    right, whole = dice(found, mask[:, :, k]), dice(found, image.values[:, :, k] > 0)
    assert result.record["segmentation"]["method"] == "vote" and whole < 0.9
    assert right >= 0.9 or "W206" in codes
    return f"brain, Dice {right:.2f}; of the whole head {whole:.2f}", "W206" if "W206" in codes else ""


def cut_off(folder):
    """The front half of a brain, and a mouth 11 mm from where the image ends."""
    affine = RAS.copy()
    affine[1, 3] += 70
    image = write(folder / "half.nii.gz", brain()[:, 35:], affine)
    result, codes = ran(folder, image, cut="-60,12 -15,8", opening_mm=3, blade="0,0.6")
    border = np.column_stack([np.linspace(-36, 36, 19), np.full(19, affine[1, 3] - 0.8)])
    moved = np.linalg.norm(result.displacement(border), axis=1).max()
    length = next(item["text"] for item in result.record["warnings"] if item["code"] == "W212")
    assert moved < 0.1 and codes == ["W212"]
    return f"held, moves {moved:.2f} mm ({length[length.index('along'):].split(' of')[0]})", "W212"


ROWS = [
    Row("A1", "a slice near the vertex, scalp all round and no dark ring", "the whole head is the organ, no warning",
        high_slice),
    Row("D", "the organ touches the image's border beside a mouth", "the border is opened as a craniotomy", cut_off),
]
