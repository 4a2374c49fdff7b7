"""Successive steps, resections, tissues and companions through the command: what acts when, and what is kept."""

import json

import jsonschema
import nibabel as nib
import numpy as np
import pytest
from small import RAS, brain, write, xfemnav

from xfemnav.pipeline.running.result import Result
from xfemnav.pipeline.running.runfile import run_schema

SCENARIO = """
xfemnav = 1
image = "head.nii.gz"
points = ["marks.csv"]
[[cut]]
name = "approach"
points = [[-60, 10], [-22, 6]]
[[retract]]
name = "left blade"
side = "left"
cut = "approach"
normal_mm = 2.0
blade = [0.0, 0.7]
[[retract]]
name = "right blade"
side = "right"
cut = "approach"
normal_mm = 2.0
blade = [0.0, 0.7]
[[resect]]
name = "tumour"
label = 7
[[companion]]
image = "dseg.nii.gz"
kind = "label"
[tissue]
labels = "dseg.nii.gz"
by_label.7 = { kind = "tumour" }
[load]
gravity = [0.0, -1.0]
[mesh]
element_size_mm = 7.0
corridor_element_mm = 3.5
[[step]]
name = "shift"
acts = ["gravity"]
[[step]]
name = "cut"
acts = ["approach"]
[[step]]
name = "open"
acts = ["left blade", "right blade"]
[[step]]
name = "take out"
acts = ["tumour"]
[[step]]
name = "release"
ends = ["left blade", "right blade", "gravity"]
"""
DISC = 9.0  # radius of label 7, about (-14, 5)
ALL = ("constrain", "solve", "warp")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("steps")
    write(folder / "head.nii.gz")
    x, y = np.indices((64, 72)) * 2.0 + np.array([-63, -71])[:, None, None]
    labels = np.where(np.hypot(x + 14, y - 5) < DISC, 7, np.where(brain() > 600, 2, 0)).astype(np.uint8)
    nib.save(nib.Nifti1Image(labels[:, :, None], RAS), folder / "dseg.nii.gz")
    (folder / "marks.csv").write_text("x,y,z,label\n14,-5,10,core\n-20,30,10,behind\n")
    return folder


@pytest.fixture
def run(home, capfd, monkeypatch):
    monkeypatch.chdir(home)

    def command(text, *flags, output="out", code=0):
        (home / "case.toml").write_text(text)
        got, stdout, stderr = xfemnav(capfd, "run", "--scenario", "case.toml", "-o", output, "-w", "cache", "--json",
                                      *flags)
        assert got == code, stderr
        record = json.loads(stdout)
        jsonschema.validate(record, run_schema())
        return record

    return command


def states(record):
    return {(stage["name"], stage.get("step", "")): stage["status"] for stage in record["stages"]}


def image(home, record, role, output="out"):
    return np.asarray(nib.load(home / output / record["outputs"][role]).dataobj)[:, :, 0]


def test_each_step_acts_in_its_turn(run, home):
    record = run(SCENARIO)
    names = [step["name"] for step in record["steps"]]
    assert names == ["shift", "cut", "open", "take out", "release"]
    by_name = {step["name"]: step for step in record["steps"]}
    moved = {name: step["checks"]["max_displacement_mm"] for name, step in by_name.items()}
    cavity = {name: image(home, record, f"cavity:{name}" if name != "release" else "cavity").sum() * 4.0
              for name in names}
    assert moved["shift"] > 1 and by_name["shift"]["cuts"] == [] and cavity["shift"] == 0
    assert [cut["name"] for cut in by_name["cut"]["cuts"]] == ["approach"] and by_name["cut"]["retractor"] == []
    assert len(by_name["open"]["retractor"]) == 2
    wedge = 0.7 * by_name["open"]["cuts"][0]["length_mm"] * 4.0  # the blades hold it open by 2 + 2 mm
    assert cavity["open"] > max(0.7 * wedge, cavity["cut"])
    assert cavity["take out"] - cavity["open"] == pytest.approx(np.pi * DISC**2, rel=0.35)
    # Nothing acts any more: the tissue lies where it lay, and only what was taken out is missing.
    assert moved["release"] < 1e-9
    assert cavity["release"] == pytest.approx(by_name["release"]["resections"][0]["area_mm2"], rel=0.1)  # 2 mm
    resting, now = image(home, record, "updated"), brain()
    kept = image(home, record, "cavity") == 0
    assert np.abs(resting - now)[kept].max() < 1e-3
    assert record["checks"] == by_name["release"]["checks"]


def test_labels_and_landmarks_go_with_the_last_step(run, home):
    record = run(SCENARIO)
    labels = image(home, record, "companion:dseg")
    assert labels.dtype == np.uint8 and set(np.unique(labels)) <= {0, 2, 7}
    assert (labels == 7).sum() < 12, "what is left of the tumour is the rim of its smoothed outline"
    assert record["points"] == [{"file": "marks.csv", "n": 2, "tissue": 1, "on_a_cut": 0, "resected": 1, "outside": 0}]
    text = (home / "out" / record["outputs"]["points"]).read_text()
    assert "behind" in text and "core" not in text
    markups = json.loads((home / "out" / record["outputs"]["points-markups"]).read_text())
    assert [point["label"] for point in markups["markups"][0]["controlPoints"]] == ["behind"]


def test_a_step_that_changes_leaves_the_earlier_ones_in_the_cache(run):
    run(SCENARIO)
    again = states(run(SCENARIO))
    assert set(again.values()) == {"cached"}
    changed = states(run(SCENARIO.replace('acts = ["tumour"]', 'acts = ["tumour"]\nends = ["gravity"]').replace(
        ', "gravity"]\n', "]\n")))
    ran = {key for key, state in changed.items() if state != "cached"}
    assert ran == {(name, "take out") for name in ALL}


def test_steps_are_in_the_report_with_their_pictures(run, home):
    record = run(SCENARIO)
    page = (home / "out" / record["outputs"]["report"]).read_text()
    assert page.count("data:image/png") == 5 and "<td>take out</td>" in page
    for name in ("shift", "cut", "open", "take out"):
        assert (home / "out" / record["outputs"][f"figure:{name}"]).stat().st_size > 10_000


def test_what_is_drawn_in_the_current_slice_goes_back_to_rest(run, home):
    """The same tissue is cut when the cut is drawn where it lies now."""
    def after_shift(record, folder):
        return Result(home / folder, record, "shift")

    planned = SCENARIO.replace("[mesh]\n", "[mesh]\ncorridor = [[-60, 10], [-10, 5]]\n")  # one mesh for both
    first = run(planned, "--no-report")
    drawn = np.array([[-41.0, 7.0], [-31.5, 6.5], [-22.0, 6.0]])
    now = after_shift(first, "out").to_current(drawn)
    assert np.abs(now - drawn).max() > 0.5
    text = ", ".join(f"[{x!r}, {y!r}]" for x, y in now.tolist())
    step = 'name = "cut"\nacts = ["approach"]'
    redrawn = planned.replace("[[-60, 10], [-22, 6]]", f"[{text}]").replace(step, f'{step}\nframe = "current"')
    same = run(redrawn, "--no-report", output="redrawn")
    path = np.array(same["cuts"][0]["path"])
    # As it is snapped to the mesh: by up to a thousandth of an element.
    assert np.abs(path[-1] - after_shift(same, "redrawn").to_preoperative(now[-1])).max() < 1e-3
    # The skull is open about the mouth as it is drawn, which moves the tissue of the first step a little too.
    assert np.linalg.norm(path[-1] - drawn[-1]) < 0.1 < np.linalg.norm(now[-1] - drawn[-1])


DRAWN_LATER = """
xfemnav = 1
image = "head.nii.gz"
[[cut]]
name = "approach"
points = [[-60, 10], [-22, 6]]
[load]
gravity = [0.0, -1.0]
[mesh]
element_size_mm = 7.0
corridor_element_mm = 3.5
corridor = [[-60, 10], [-10, 5]]
[[step]]
name = "shift"
acts = ["gravity"]
[[step]]
name = "cut"
acts = ["approach"]
ends = ["gravity"]
frame = "current"
"""


def test_what_is_drawn_in_a_slice_that_changes_is_cut_elsewhere(run):
    """The later step asks for the same: what it was drawn in is no other."""
    down, up = (np.array(run(DRAWN_LATER.replace("-1.0]", sign), "--no-report")["cuts"][0]["path"])
                for sign in ("-1.0]", "1.0]"))
    assert np.linalg.norm(down[-1] - up[-1]) > 1.0


def test_a_longer_cut_keeps_mesh_and_segmentation(run):
    """Propagating a cut in its planned corridor."""
    plan = "corridor = [[-60, 10], [0, 4]]\n"
    text = SCENARIO.split("[[step]]")[0].replace("[mesh]\n", "[mesh]\n" + plan)
    run(text, "--no-report")
    longer = states(run(text.replace("[-22, 6]]", "[-22, 6], [-16, 9]]"), "--no-report"))
    assert longer["segment", ""] == longer["mesh", ""] == "cached" and longer["constrain", ""] == "ran"


def test_tissue_that_is_a_hundred_times_as_stiff_moves_a_hundredth(run, home):
    nib.save(nib.Nifti1Image(np.ones((64, 72, 1), np.uint8), RAS), home / "ones.nii.gz")
    text = SCENARIO.split("[[cut]]")[0].replace("points = [\"marks.csv\"]\n", "") + (
        '[load]\ngravity = [0.0, -1.0]\n[mesh]\nelement_size_mm = 7.0\n[tissue]\nlabels = "ones.nii.gz"\n')
    soft = run(text, "--no-report")["checks"]["max_displacement_mm"]
    stiff = run(text + "by_label.1 = { young_kpa = 300.0 }\n", "--no-report")["checks"]["max_displacement_mm"]
    assert stiff == pytest.approx(soft / 100, rel=1e-6)


@pytest.mark.parametrize("flags, code, text", [
    (("--resect", "100,100 120,100 120,120"), 65, "E310"),
    (("--resect", "-99,-99 99,-99 99,99 -99,99"), 65, "E312"),
    (("--resect", "label=9", "--labels", "dseg.nii.gz"), 65, "E311"),
    (("--resect", "label=9"), 78, "needs the map"),
    (("--resect", "missing.mrk.json"), 66, "E100"),
    (("--gravity", "0,-1", "--companion", "missing.nii.gz"), 66, "E100"),
    (("--gravity", "0,-1", "--points", "missing.csv"), 66, "E100"),
    (("--gravity", "3,4"), 78, "load"),
])
def test_what_cannot_be_is_told(home, capfd, monkeypatch, flags, code, text):
    monkeypatch.chdir(home)
    got, _, stderr = xfemnav(capfd, "run", "head.nii.gz", "-o", "refused", "-w", "cache", "--no-report",
                             "--element-size-mm", "8", *flags)
    assert got == code and text in stderr and "Traceback" not in stderr, stderr


def test_resection_from_the_command_line(home, capfd, monkeypatch):
    """A drawn square is missing from the image, and nothing else has changed."""
    monkeypatch.chdir(home)
    got, stdout, stderr = xfemnav(capfd, "run", "head.nii.gz", "-o", "square", "-w", "cache", "--no-report", "--json",
                                  "--element-size-mm", "8", "--resect", "-10,-10 10,-10 10,10 -10,10")
    assert got == 0, stderr
    record = json.loads(stdout)
    assert record["resections"][0]["area_mm2"] == pytest.approx(400, rel=1e-3)
    assert record["checks"]["cavity_mm2"] == pytest.approx(400, abs=2 * 40)  # pixels of 2 mm
    updated, cavity = image(home, record, "updated", "square"), image(home, record, "cavity", "square")
    assert np.abs(updated - brain())[cavity == 0].max() < 1e-3
