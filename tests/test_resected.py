"""Resections of labels and masks through the whole chain: steps, specks, what is enclosed, and blades beside them."""

import warnings
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from tests import small
from xfemnav import run
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.pipeline.asking.config import configure

AFFINE = np.diag([1.0, 1.0, 2.0, 1.0])
AFFINE[:2, 3] = -50, -60
X, Y = np.indices((100, 120)) + AFFINE[:2, 3][:, None, None]
BRAIN = (X / 45) ** 2 + (Y / 55) ** 2 < 1
RADIUS = np.hypot(X - 12, Y)


def nested():
    """A ring of label 4 about a disc of label 1, with bits of label 3 off it."""
    labels = np.select([RADIUS < 8, RADIUS < 12], [1, 4], 0)
    labels[20:23, 30:33], labels[22, 90] = 3, 3
    return labels.astype(np.uint8)


def ran(folder, labels=None, scenario="", **flags):
    """The result of a quick run on a brain, and what it warned of: codes and texts."""
    image = small.write(folder / "brain.nii.gz", BRAIN * (500.0 + X), AFFINE)
    if labels is not None:
        small.write(folder / "seg.nii.gz", labels, AFFINE)
    text = 'xfemnav = 1\nimage = "brain.nii.gz"\n[tissue]\nlabels = "seg.nii.gz"\n' + scenario
    if scenario:
        (folder / "scenario.toml").write_text(text)
        flags["scenario"] = folder / "scenario.toml"
    elif labels is not None:
        flags["labels"] = folder / "seg.nii.gz"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", XfemnavWarning)
        result = run(None if scenario else image, output=folder / "out", report=False, element_size_mm=4, **flags)
    return result, [f"{item['code']} {item['text']}" for item in result.record["warnings"]]


def areas(record):
    return {item["name"]: item["area_mm2"] for item in record["resections"]}


SINKING = {"gravity": "0.3,0", "skull": "contact"}


def test_a_list_takes_what_its_labels_hold_together(tmp_path):
    result, told = ran(tmp_path, nested(), resect="label=1,3,4", **SINKING)
    assert areas(result.record) == {"resection": pytest.approx(np.sum(RADIUS < 12) - np.pi, rel=0.01)}
    assert [text.split(":")[0] for text in told] == ["W208 10 mm2 of labels 1, 3, 4 of seg.nii.gz stay"]


def test_a_resection_of_specks_beside_others_takes_nothing_and_is_told(tmp_path):
    result, told = ran(tmp_path, nested(), resect=["label=1", "label=3", "label=4"], **SINKING)
    assert set(areas(result.record)) == {"resection 1", "resection 3"}
    assert sum(areas(result.record).values()) == pytest.approx(np.sum(RADIUS < 12) - np.pi, rel=0.01)
    assert [text.split(":")[0] for text in told] == ["W208 10 mm2 of label 3 of seg.nii.gz stay"]
    assert len(result.record["pieces"]) == 1


def test_specks_alone_are_no_resection(tmp_path):
    with pytest.raises(XfemnavError, match=r"E311 resection 'resection' takes nothing: 10 mm2 of label 3 of seg.nii.gz "
                                           r"on this slice are in bits under 12.6 mm2"):
        ran(tmp_path, nested(), resect="label=3", **SINKING)
    pressed = ('[[resect]]\nname = "a"\nlabel = [1, 4]\n[[resect]]\nname = "b"\nlabel = 3\n'
               '[[load.pressure]]\non = "b"\nkpa = 0.1\n')
    with pytest.raises(XfemnavError, match="E311 resection 'b' takes nothing"):
        ran(tmp_path, nested(), pressed)


def test_the_size_is_asked_for(tmp_path):
    result, told = ran(tmp_path, nested(), resect="label=1,3,4", min_resection_mm=1, **SINKING)
    assert sum(areas(result.record).values()) > np.sum(RADIUS < 12) - np.pi + 4
    assert [text.split(":")[0] for text in told] == ["W208 1 mm2 of labels 1, 3, 4 of seg.nii.gz stay"]


STEPS = """
[boundary]
skull = "contact"
[load]
gravity = [0.3, 0.0]
[[resect]]
name = "core"
label = 1
[[resect]]
name = "rim"
label = 4
[[resect]]
name = "drawn"
outline = [[-30.0, -8.0], [-14.0, -8.0], [-14.0, 8.0], [-30.0, 8.0]]
[[step]]
name = "one"
acts = ["core"]
[[step]]
name = "two"
acts = ["rim", "drawn"]
frame = "current"
"""


def test_steps_unite_what_acts_and_labels_stay_where_they_were(tmp_path):
    result, told = ran(tmp_path, nested(), STEPS)
    one, two = result.record["steps"]
    assert areas(one) == {"core": pytest.approx(np.sum(RADIUS < 8) - np.pi, rel=0.01)}
    assert areas(two)["core"] + areas(two)["rim"] == pytest.approx(np.sum(RADIUS < 12) - np.pi, rel=0.01)
    assert areas(two)["drawn"] == pytest.approx(16 * 16, rel=0.05)
    assert told == [] and len(two["pieces"]) == 1


def test_a_mask_drawn_in_the_deformed_slice_goes_back_with_the_tissue(tmp_path):
    small.write(tmp_path / "box.nii.gz", ((abs(X + 22) < 8) & (abs(Y) < 8)).astype(np.uint8), AFFINE)
    drawn = 'outline = [[-30.0, -8.0], [-14.0, -8.0], [-14.0, 8.0], [-30.0, 8.0]]'
    result, told = ran(tmp_path, nested(), STEPS.replace(drawn, 'mask = "box.nii.gz"'))
    assert areas(result.record)["drawn"] == pytest.approx(15 * 15, rel=0.05) and told == []


def test_what_a_label_and_an_outline_enclose_goes_too(tmp_path):
    half = np.where((RADIUS < 14) & (RADIUS > 9) & (X < 12), 4, 0)
    lid = ('[boundary]\nskull = "contact"\n[load]\ngravity = [0.3, 0.0]\n'
           '[[resect]]\nname = "half"\nlabel = 4\n[[resect]]\nname = "lid"\n'
           'outline = [[11.0, -14.0], [16.0, -14.0], [16.0, 14.0], [11.0, 14.0]]\n')
    result, told = ran(tmp_path, half.astype(np.uint8), lid)
    (text,) = told
    enclosed = np.sum((RADIUS <= 9) & (X < 11))
    assert text.startswith("W210") and "'half' and 'lid'" in text
    assert float(text.split()[1]) == pytest.approx(enclosed, rel=0.1)
    assert len(result.record["pieces"]) == 1


def test_a_blade_that_holds_the_shell_alone_keeps_it(tmp_path):
    """A cut through a shell of 2 mm into the cavity: without the shell there would be no lip for the blade."""
    mask = small.write(tmp_path / "core.nii.gz", (np.hypot(X + 30, Y) < 12.5).astype(np.uint8), AFFINE)
    cut = {"cut": "-60,0 -30,0", "resect": mask, "corridor_element_mm": 3}
    told = ran(tmp_path, opening_mm=1, **cut)[1]
    assert not [text for text in told if text.startswith("W210")]
    told = ran(tmp_path, gravity="0.3,0", **cut)[1]
    assert [text[:4] for text in told] == ["W210"]


def test_masks_in_a_path_with_any_ending_and_labels_by_a_flag():
    def resected(given, **more):
        (item,) = configure("a.nii.gz", None, {"resect": given} | more).constrain.resections
        return item

    assert resected(Path("m.NII.gz")).mask == 0 and resected("m.mha").mask == 0
    assert resected("label=1, 3,4", labels="l.nii.gz").label == (1, 3, 4)
    assert resected("label=4,4", labels="l.nii.gz").label == (4,)
    for wrong in ("label=", "label=1,,4", "label=1,x", "label=-1", "label=0,1"):
        with pytest.raises(XfemnavError, match=r"E780 .*(wants whole numbers label=N|whole number from 1 on)"):
            resected(wrong, labels="l.nii.gz")


def test_a_soft_mask_on_another_grid_has_the_range_of_its_volume(tmp_path):
    """Half of the organ's range is that of the whole volume, though the slice holds its soft end alone."""
    volume = np.zeros((50, 60, 3))
    at = np.hypot((X[::2, ::2] + 0.5) / 45, (Y[::2, ::2] + 0.5) / 55)
    volume[:, :, 1], volume[:, :, 2] = np.clip((1 - at) * 5 + 0.5, 0, 1) * 0.8, 1.0 * (at < 0.9)
    affine = AFFINE @ np.diag([2.0, 2.0, 1.0, 1.0])
    affine[:3, 3] += 0.5, 0.5, -2.0
    nib.save(nib.Nifti1Image(volume.astype(np.float32), affine), tmp_path / "soft.nii.gz")
    result, told = ran(tmp_path, mask=tmp_path / "soft.nii.gz", resample_mask=True, cut=small.CUT, opening_mm=4)
    wanted = np.pi * 45 * 55 * (1 - (0.5 / 0.8 - 0.5) / 5) ** 2
    assert result.record["segmentation"]["area_mm2"] == pytest.approx(wanted, rel=0.02)
    assert [text[:4] for text in told] == ["W209"]
