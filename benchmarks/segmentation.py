"""Segmentation of heads whose brain is known, as they are and distorted: how well it is found, and when W206 speaks.

    python -m benchmarks.segmentation [FOLDER] [--page]
    make bench BENCH=segmentation HEADS=FOLDER

Without a folder: the synthetic heads of data_synthetic/heads.py, and the stripped MNI152 of nilearn. A folder holds
images and brain masks (NIfTI; slices, or volumes, of which slices are taken). Names are words joined by `_`. The first
word is the subject. A mask has a word with "mask" in it; an image has one that begins with t1, t2, pd, flair or head,
and none with "mask". What follows that word in the name is the place (`ax`, `cor`, `ax_z+18`, or nothing). An image and
a mask of one subject and one place are a pair: `seg3d_t1_head_ax` and `seg3d_brainmask_ax`, `sub-01_T1w` and
`sub-01_desc-brain_mask`. Images without a mask are run too: how far their masks vary with the distortion is told.

Every slice is segmented in tones of gamma .5, 1 and 2, each as it is, with a bias of 30 % across it, turned by 10 and
20 degrees, cropped at one edge, and with all of these. Results are kept in benchmarks/results/segmentation.json, the
page docs/measured/segmentation.md is written from them; rows of a folder have the images' names and no path.
"""

import json
import os
import re
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.verification.segmentation_page import write_page
from data_synthetic.heads import CONTRASTS, Head
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.frames.slices import Slice, take_slice
from xfemnav.imaging.organ.masks import dice, one_piece
from xfemnav.imaging.organ.segment import segment
from xfemnav.imaging.reading.gate import Image, read_image

RESULTS = Path("benchmarks/results/segmentation.json")
CONTRAST = re.compile(r"^(t1|t2|pd|flair|head)", re.IGNORECASE)
GAMMAS = (0.5, 1.0, 2.0)
CHANGES = {"as it is": {}, "bias": {"bias": 0.3}, "turned 10": {"degrees": 10}, "turned 20": {"degrees": 20},
           "cropped": {"crop": 0.12}, "all": {"bias": 0.3, "degrees": 15, "crop": 0.12}}
PLACES = (0.15, 0.35, 0.5, 0.7, 0.85, 0.95)  # of a mask's extent, in volumes
HEIGHTS = np.arange(0.0, 69.0, 11.0)
STRIPPED = ("axial", -40), ("axial", 18), ("axial", 60), ("coronal", -80), ("coronal", 0), ("sagittal", 30)


@dataclass(frozen=True, eq=False)
class Case:
    """A slice, its brain (n1, n2) where that is known, and the volume that it is of."""

    name: str
    slice: Slice
    brain: np.ndarray | None
    volume: Image | None = None


def synthetic() -> Iterator[Case]:
    """Heads in three contrasts up to the vertex, judged as slices of their volume, and slices of a stripped brain."""
    head = Head()
    for contrast in CONTRASTS:
        values, brain = replace(head, contrast=contrast).volume(HEIGHTS)
        affine = np.diag([*head.grid.spacing, HEIGHTS[1] - HEIGHTS[0], 1.0])
        affine[:3, 3] = *head.grid.origin, HEIGHTS[0]
        volume = Image(values, affine, "float64", 1, "", contrast)
        for k, height in enumerate(HEIGHTS):
            yield Case(f"synthetic {contrast}, {height:.0f} mm up", take_slice(volume, index=k), brain[:, :, k], volume)
    from nilearn.datasets import load_mni152_template

    mni = load_mni152_template(resolution=1)
    volume = Image(np.asarray(mni.dataobj, float), mni.affine, "float64", 4, "", "MNI152")
    for plane, place in STRIPPED:
        slice = take_slice(volume, plane=plane, position_mm=place)
        yield Case(f"MNI152 stripped, {plane} {place}", slice, one_piece(slice.values > 0))


def of_folder(folder: Path) -> Iterator[Case]:
    """The images of a folder with their masks: see the module's docstring."""
    files = sorted(path for path in folder.iterdir() if path.name.endswith((".nii", ".nii.gz")))
    masks = {key: path for path in files if (key := _key(path, mask=True)) is not None}
    for path in files:
        key = _key(path, mask=False)
        if key is not None:
            yield from _slices(path, read_image(path), read_image(masks[key]) if key in masks else None)


def _key(path: Path, mask: bool) -> tuple[str, str] | None:
    """Subject and place of a mask, or of an image; None when the name is of neither."""
    words = path.name.split(".nii")[0].split("_")
    masked = [k for k, word in enumerate(words) if "mask" in word.lower()]
    shown = [k for k, word in enumerate(words) if CONTRAST.match(word)]
    if bool(masked) != mask or not (masked or shown):
        return None
    return words[0], "_".join(words[(masked or shown)[-1] + 1:])


def _slices(path: Path, image: Image, mask: Image | None) -> Iterator[Case]:
    name = " ".join(path.name.split(".nii")[0].split("_"))
    if 1 in image.values.shape:
        brain = None if mask is None else one_piece(take_slice(mask).values > 0)
        yield Case(name, take_slice(image), brain)
        return
    axis = take_slice(image, index=0).array_axes[2]
    on = np.flatnonzero(((image if mask is None else mask).values > 0).any(
        axis=tuple(k for k in range(3) if k != axis)))
    for share in PLACES:
        k = int(on[0] + share * (on[-1] - on[0]))
        brain = None if mask is None else one_piece(take_slice(mask, index=k).values > 0)
        yield Case(f"{name} {share:.0%}", take_slice(image, index=k), brain, image)


def distorted(case: Case, gamma: float, bias: float = 0.0, degrees: float = 0.0, crop: float = 0.0) -> Case:
    """The case with its brightness to the power `gamma`, a `bias` across it, turned in its plane, and without the part
    `crop` of what it shows at its left edge."""
    values, brain = case.slice.values, case.brain
    low, high = values.min(), values.max()
    values = (values - low) / (high - low)
    if degrees:
        turn = {"angle": degrees, "reshape": False, "order": 1, "mode": "nearest"}
        values = np.clip(ndimage.rotate(values, **turn), 0, 1)
        brain = None if brain is None else ndimage.rotate(brain.astype(float), **turn) > 0.5
    values = values**gamma
    across = np.linspace(-1, 1, values.shape[0])[:, None]
    values = values * (1 + bias * across)
    if crop:
        shown = np.flatnonzero((values > 0.15).any(axis=1))
        start = shown[0] + int(crop * (shown[-1] - shown[0]))
        values, brain = values[start:], None if brain is None else brain[start:]
    return replace(case, slice=replace(case.slice, values=low + (high - low) * values), brain=brain)


def measured(case: Case) -> dict:
    """One row: Dice with the brain (None where it is not known), method, and whether W206 spoke."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", XfemnavWarning)
        try:
            found = segment(case.slice, volume=case.volume)
        except XfemnavError as error:  # refused: as good as a doubt
            return {"dice": None, "method": error.code, "doubted": True, "mask": None}
    doubted = any(w.message.code == "W206" for w in caught)
    right = None if case.brain is None else dice(found.mask, case.brain)
    return {"dice": right, "method": found.method, "doubted": doubted, "mask": found.mask}


def study(cases: Iterator[Case]) -> Iterator[dict]:
    """A row for every case and distortion."""
    for case in cases:
        plain = None
        for (change, how), gamma in product(CHANGES.items(), GAMMAS):
            row = measured(distorted(case, gamma, **how))
            mask = row.pop("mask")
            if change == "as it is" and (plain is None or gamma == 1.0):
                plain = mask
            same = mask is not None and plain is not None and mask.shape == plain.shape and "degrees" not in how
            yield {"head": case.name, "gamma": gamma, "change": change, **row,
                   "steady": dice(mask, plain) if same else None}


def main(arguments: list[str]) -> None:
    """Measure, unless --page is given, and write the page."""
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if "--page" not in arguments:
        given = next(iter(arguments), os.environ.get("HEADS", ""))
        rows = []
        for row in study(of_folder(Path(given)) if given else synthetic()):
            rows.append(row)
            print("  ".join(f"{x:.3f}" if isinstance(x, float) else str(x) for x in row.values()), flush=True)
        kept["folder" if given else "synthetic"] = rows
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps(kept, indent=0) + "\n")
    write_page(kept)


if __name__ == "__main__":
    main(sys.argv[1:])
