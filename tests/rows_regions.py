"""Rows of tumours that are resected, of shreds beside a resection, and of soft masks."""

import warnings

import numpy as np

from data_synthetic.tumours import CORE, tumour
from tests import small
from tests.rows import Row
from xfemnav import run
from xfemnav.errors import XfemnavWarning

AFFINE = np.diag([1.0, 1.0, 2.0, 1.0])
AFFINE[:2, 3] = -50, -60
X, Y = np.indices((100, 120)) + AFFINE[:2, 3][:, None, None]
BRAIN = (X / 45) ** 2 + (Y / 55) ** 2 < 1


def ran(folder, **flags):
    """The record of a quick run on a brain of 100 x 120 pixels of 1 mm, and what it warned of, by code."""
    image = small.write(folder / "brain.nii.gz", BRAIN * (500.0 + X), AFFINE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", XfemnavWarning)
        result = run(image, output=folder / "out", cache=folder / "cache", report=False, element_size_mm=4,
                     corridor_mm=0,
                     **flags)
    return result, {item["code"]: item["text"] for item in result.record["warnings"]}


def soft_mask(folder):
    depth = (1 - np.hypot(X / 45, Y / 55)) * 50
    mask = small.write(folder / "soft.nii.gz", np.clip(depth / 12 + 0.5, 0, 1), AFFINE)
    result, told = ran(folder, mask=mask, cut=small.CUT, opening_mm=4)
    area = result.record["segmentation"]["area_mm2"]
    assert abs(area / BRAIN.sum() - 1) < 0.01 and "W209" in told
    return f"{area:.0f} of {BRAIN.sum()} mm2", "W209"


def soft_tumour(folder):
    depth = 12 - np.hypot(X - 15, Y)
    mask = small.write(folder / "soft.nii.gz", 100 * np.clip(depth / 8 + 0.5, 0, 1), AFFINE)
    result, told = ran(folder, resect=mask, gravity="1,0", skull="contact")
    (area,) = (item["area_mm2"] for item in result.record["resections"])
    wanted = np.sum(depth >= 0)
    assert abs(area / wanted - 1) < 0.01 and "W209" in told
    return f"{area:.0f} of {wanted} mm2", "W209"


def core(folder, resect):
    labels = tumour(np.random.default_rng(3), BRAIN.shape, (1, 1), (68, 62), 12.0) * BRAIN
    seg = small.write(folder / "seg.nii.gz", labels, AFFINE)
    result, told = ran(folder, labels=seg, resect=resect, gravity="0.3,0", skull="contact")
    taken, record = sum(item["area_mm2"] for item in result.record["resections"]), result.record
    bits = [item["text"] for item in record["warnings"] if "separate bit" in item["text"]]
    whole = np.isin(labels, CORE).sum() - sum(float(text.split()[0]) for text in bits)
    assert result.trusted and taken > 0.99 * whole and len(record["pieces"]) == 1 and bits
    assert set(told) == {"W208"} | ({"W314"} if resect == "label=1,3,4" else set())
    return f"{taken:.0f} of {whole:.0f} mm2, nothing afloat; {len(bits)} told of specks", "W208"


def enclosed(folder):
    radius = np.hypot(X - 12, Y)
    seg = small.write(folder / "seg.nii.gz", np.where((radius < 14) & (radius > 7), 4, 0).astype(np.uint8), AFFINE)
    result, told = ran(folder, labels=seg, resect="label=4", gravity="1,0", skull="contact")
    (area,) = (item["area_mm2"] for item in result.record["resections"])
    assert abs(area / (np.pi * 14**2) - 1) < 0.02 and "W210" in told and len(result.record["pieces"]) == 1
    return f"{area:.0f} mm2 go: {told['W210'].split(' go with')[0]}", "W210"


def shell(folder):
    mask = BRAIN & (abs(Y) < 15) & (X > 18) & ((X / 43.5) ** 2 + (Y / 53.5) ** 2 < 1)
    small.write(folder / "mask.nii.gz", mask.astype(np.uint8), AFFINE)
    result, told = ran(folder, resect=folder / "mask.nii.gz", gravity="1,0", skull="free", cut="-60,10 -15,5",
                       opening_mm=2)
    (area,) = (item["area_mm2"] for item in result.record["resections"])
    gone = float(told["W210"].split()[0])
    assert abs(gone - (BRAIN & (abs(Y) < 15) & (X > 18) & ~mask).sum()) < 12
    assert abs(area - mask.sum() - gone) < 12 and "about (" in told["W210"]
    return f"{gone:.0f} mm2 of shell go with {mask.sum()} mm2", "W210"


ROWS = [
    Row("A3", "a shell of 1.5 mm beside a resection at the surface", "stays, and is moved by 24 mm", shell),
    Row("A10", "a soft mask of the organ", "all that is not 0: 28 % too large", soft_mask),
    Row("A10", "a soft mask, in percent, of what is resected", "all that is not 0", soft_tumour),
    Row("C1", "the core of a tumour, labels 1 and 4 of three, 3 nowhere", "one label alone",
        lambda folder: core(folder, "label=1,3,4")),
    Row("C2", "one resection for each label of the core", "E311 for specks, E306 between labels, 9 % left",
        lambda folder: core(folder, ["label=1", "label=4"])),
    Row("C3", "an enhancing rim about necrosis, the rim alone", "E306", enclosed),
]
