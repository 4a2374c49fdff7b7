"""Pixels without tissue have the background's value wherever an image is made: a change of scale changes nothing else.

The law: update(a I + b) = a update(I) + b, in the cavity too.
"""

import json
import warnings

import nibabel as nib
import numpy as np
import pytest
from small import CUT, brain, write, xfemnav

import xfemnav as package
from xfemnav.errors import XfemnavWarning
from xfemnav.pipeline.telling import figure

STEPS = """xfemnav = 1
image = "head.nii.gz"
mask = "mask.nii.gz"
[[companion]]
image = "t2.nii.gz"
[mesh]
element_size_mm = 8.0
corridor_element_mm = 4.0
[[cut]]
points = [[-60, 10], [-15, 5]]
[[retract]]
side = "left"
normal_mm = 3.0
blade = [0.0, 0.5]
[[resect]]
name = "core"
outline = [[5, -10], [25, -10], [25, 10], [5, 10]]
[[step]]
name = "open"
acts = ["cut", "cut left"]
[[step]]
name = "resect"
acts = ["core"]
"""
#: Scales of intensity, a and b of a I + b: z-scores, negative numbers, an inverted image, an offset.
SCALES = {"plain": (1.0, 0.0), "z-scored": (1 / 105, -600 / 105), "negative": (1.0, -2000.0), "inverted": (-1.0, 0.0)}


def ct():
    """Air -1000, tissue about the 0 of water."""
    return np.where(brain() > 0, (brain() - 600) / 10, -1000).astype(np.float32)


def run(folder, values):
    folder.mkdir()
    write(folder / "head.nii.gz", values.astype(np.float32))
    write(folder / "t2.nii.gz", (2 * values + 1).astype(np.float32))
    write(folder / "mask.nii.gz", (brain() > 0).astype(np.uint8))
    (folder / "steps.toml").write_text(STEPS)
    with warnings.catch_warnings():
        warnings.simplefilter("error", XfemnavWarning)    # a good background is no doubt
        return package.run(scenario=folder / "steps.toml", output=folder / "out", cache=folder / "cache", report=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    home = tmp_path_factory.mktemp("blank")
    found = {name: run(home / name, a * brain() + b) for name, (a, b) in SCALES.items()}
    return found | {"CT": run(home / "CT", ct())}


def image(result, role):
    name = result.record["outputs"][role]
    about = json.loads((result.folder / name.replace(".nii.gz", ".json")).read_text())
    return nib.load(result.folder / name).get_fdata()[:, :, 0], about["Fill"]


ROLES = {"updated": (1, 0), "updated:open": (1, 0), "companion:t2": (2, 1)}


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("name", SCALES)
def test_a_change_of_scale_is_one_of_the_result(runs, name, role):
    (a, b), (c, d) = SCALES[name], ROLES[role]
    (plain, none), (found, fill) = image(runs["plain"], role), image(runs[name], role)
    wanted = c * (a * (plain - d) / c + b) + d
    assert abs(found - wanted).max() < 1e-4 * abs(wanted).max()    # float32
    assert none == d and fill == pytest.approx(c * b + d)


@pytest.mark.parametrize("role", ROLES)
def test_the_cavity_in_ct_holds_air(runs, role):
    c, d = ROLES[role]
    found, fill = image(runs["CT"], role)
    result = package.Result.load(runs["CT"].folder, "open") if role == "updated:open" else runs["CT"]
    empty = result.update.cavity | result.update.vacated
    assert empty.sum() > 10 and (found[empty] == -1000 * c + d).all() and fill == -1000 * c + d


@pytest.mark.parametrize("name", ["z-scored", "CT"])
def test_results_and_sessions_are_as_the_run(runs, name, tmp_path):
    result = runs[name]
    values = (ct() if name == "CT" else SCALES[name][0] * brain() + SCALES[name][1]).astype(np.float32)
    updated, fill = image(result, "updated")
    assert abs(result.warp(values) - updated).max() < 1e-3
    assert abs(result.warp(write(tmp_path / "x.nii.gz", values)).get_fdata()[:, :, 0] - updated).max() < 1e-3
    mask = write(tmp_path / "m.nii.gz", (brain() > 0).astype(np.uint8))
    session = package.Session(write(tmp_path / "head.nii.gz", values), corridor=CUT, mask=mask, element_size_mm=8.0,
                              corridor_element_mm=4.0)
    session.cut(CUT)
    session.open(left=3.0, right=3.0)
    for made, blank in ((session.image(), fill), (session.image(2 * values + 1), 2 * fill + 1)):
        assert (made == np.float32(blank)).sum() > (values == np.float32(fill)).sum()    # the cavity, beside the air
    with pytest.warns(XfemnavWarning, match="W211"):
        session.image(fill=0.0)
    with pytest.warns(XfemnavWarning, match=r"W211.*outside=\"zero\""):
        result.warp(values, outside="zero")


def test_the_figure_shows_what_the_file_has(runs, tmp_path, monkeypatch):
    """The panel of the updated slice: the grey of the cavity is that of the file's value in the window."""
    drawn = []
    panels = figure.draw_grey
    monkeypatch.setattr(figure, "draw_grey", lambda panel, slice, values, window: (
        drawn.append((np.array(values), window)), panels(panel, slice, values, window))[1])
    for name in ("CT", "inverted"):
        drawn.clear()
        folder = runs[name].folder.parent
        package.run(scenario=folder / "steps.toml", output=tmp_path / name, cache=folder / "cache")    # with its figure
        values, window = drawn[-1]
        updated, fill = image(runs[name], "updated")
        cavity = runs[name].update.cavity
        assert cavity.any() and (values[cavity] == updated[cavity]).all() and (values[cavity] == fill).all()
        low, high = window
        organ = (ct() if name == "CT" else -brain())[brain() > 0]
        assert low <= np.percentile(organ, 1) and high >= np.percentile(organ, 99)
        assert high - low < 3 * np.ptp(organ)    # the organ is seen


def test_a_fill_among_the_tissue_is_told(tmp_path, capfd):
    write(tmp_path / "head.nii.gz", ct())
    write(tmp_path / "mask.nii.gz", (brain() > 0).astype(np.uint8))
    common = ("run", tmp_path / "head.nii.gz", "--mask", tmp_path / "mask.nii.gz", "--cut", CUT, "--opening-mm", "4",
              "--element-size-mm", "8", "--corridor-element-mm", "4", "--no-report", "-o", tmp_path / "out",
              "-w", tmp_path / "cache")
    for options, warned in (((), ""), (("--fill", "0"), "fill 0 lies among"), (("--fill", "-1000"), ""),
                            (("--outside", "zero"), "--outside zero"), (("--fill", "0"), "fill 0 lies among")):
        code, _, err = xfemnav(capfd, *common, *options)
        assert code == 0 and ("W211" in err) == bool(warned) and warned in err
    assert xfemnav(capfd, *common, "--fill", "0", "--strict")[0] != 0


def test_pixels_that_a_companion_does_not_reach_hold_its_background(runs, tmp_path):
    """Half of the CT is missing: air, not the 0 of water."""
    values, affine = ct()[:40], np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = -63, -71, 10
    with pytest.warns(XfemnavWarning, match="W130"):
        made = runs["CT"].warp(write(tmp_path / "half.nii.gz", values, affine), kind="continuous").get_fdata()[:, :, 0]
    assert (made[45:] == -1000).all() and made[30, 36] > -100


def test_labels_and_what_turns_are_0_without_tissue(runs, tmp_path):
    result = runs["CT"]
    labels = np.where(brain() > 0, 5, 9).astype(np.uint8)    # a background of its own, which is a label
    made = result.warp(write(tmp_path / "x_dseg.nii.gz", labels))
    empty = result.frame.to_storage(result.update.cavity)
    assert set(np.unique(np.asarray(made.dataobj)[empty])) == {0} and made.get_data_dtype() == np.uint8
    wide = result.warp(tmp_path / "x_dseg.nii.gz", fill=-1000)    # what uint8 cannot hold
    assert set(np.unique(np.asarray(wide.dataobj)[empty])) == {-1000} and wide.get_data_dtype() == np.int32
    for fill, code in ((0.5, "E131"), (1e20, "E131"), (float("nan"), "E780"), (float("inf"), "E780")):
        with pytest.raises(package.XfemnavError, match=code):
            result.warp(tmp_path / "x_dseg.nii.gz", fill=fill)
    field = write(tmp_path / "v.nii.gz", np.ones((*brain().shape, 1, 3), np.float32))
    assert not np.asarray(result.warp(field, kind="vector", axes="world", fill=7).dataobj)[empty].any()


def test_what_is_warned_of_companions_is_told_from_the_cache_too(tmp_path):
    write(tmp_path / "head.nii.gz")
    write(tmp_path / "x.nii.gz", np.where(brain() > 600, 2, brain() > 0).astype(np.uint8)[:40])
    told = []
    for name in ("first", "second"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", XfemnavWarning)
            result = package.run(tmp_path / "head.nii.gz", cut=CUT, opening_mm=4.0, element_size_mm=8.0,
                                 corridor_element_mm=4.0, companion=(str(tmp_path / "x.nii.gz"),), report=False,
                                 output=tmp_path / name, cache=tmp_path / "cache")
        told.append([item for item in result.record["warnings"] if item["code"] in ("W130", "W135")])
    assert len(told[0]) == 2 and told[0] == told[1] and result.record["stages"][-1]["status"] == "cached"
