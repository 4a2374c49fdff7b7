"""A run made again from the scenario that it wrote: the same bytes, whatever was given and however it was started."""

import json

import numpy as np
import pytest
from small import CUT, QUICK, RAS, brain, write, xfemnav

import xfemnav as package
from tests.images import image_of
from tests.test_dicom import write_series

STEPS = """xfemnav = 1
image = "head.nii.gz"
points = ["targets.csv"]
[mesh]
element_size_mm = 8.0
corridor_element_mm = 4.0
[tissue]
labels = "labels.nii.gz"
by_label.4 = { kind = "ventricle" }
[load]
gravity = [0.0, -1.0]
[[cut]]
name = "approach"
points = [[-60, 10], [-15, 5]]
[[retract]]
cut = "approach"
side = "left"
normal_mm = 3.0
[[resect]]
name = "tumour"
label = 7
[[companion]]
image = "labels.nii.gz"
kind = "label"
[[step]]
name = "open"
acts = ["gravity", "approach"]
[[step]]
name = "resect"
acts = ["tumour"]
"""


def files(folder) -> dict[str, bytes]:
    """All that lies in an output folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def told(folder) -> dict:
    """The record, without what is of this run alone: the command, seconds, and what came from the cache."""
    record = json.loads((folder / "run.json").read_text())
    del record["argv"]
    for stage in record["stages"]:
        del stage["seconds"], stage["status"]
    return record


def same_again(home, capfd, *more, into="again"):
    """The run in `home`/out made again from its scenario, without the cache: the same bytes of every file."""
    first, again = home / "out", home / into
    scenario = json.loads((first / "run.json").read_text())["outputs"]["scenario"]
    code = xfemnav(capfd, "run", "--scenario", first / scenario, "-o", again, "-w", home / "another-cache", *more)[0]
    assert code == json.loads((first / "run.json").read_text())["exit_code"]
    was, now = files(first), files(again)
    assert was.keys() == now.keys() and len(was) > 10
    assert [name for name in was if was[name] != now[name] and name != "run.json"] == []
    assert told(first) == told(again)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def labels() -> np.ndarray:
    """A ventricle 4 and a tumour 7 at the end of the cut."""
    x, y = np.indices((64, 72)) * 2.0 + np.array([-63, -71])[:, None, None]
    return np.select([np.hypot(x + 12, y - 5) < 8, np.hypot(x - 10, y) < 9], [7, 4], 0).astype(np.uint8)


def test_flags_with_a_mask_labels_and_what_goes_along(home, capfd):
    write(home / "head.nii.gz")
    write(home / "mask.nii.gz", (brain() > 0).astype(np.uint8))
    write(home / "labels.nii.gz", labels())
    (home / "targets.csv").write_text("r,a,s,label\n-20,20,10,a\n")
    given = ("--mask", "mask.nii.gz", "--labels", "labels.nii.gz", "--resect", "label=7", "--companion",
             "label=labels.nii.gz", "--points", "targets.csv", "--cut", CUT, "--left=2,1", "--interp", "cubic")
    assert xfemnav(capfd, "run", "head.nii.gz", *given, *QUICK, "-o", "out", "-w", "cache")[0] == 0
    same_again(home, capfd, "--no-report")


def test_steps_with_the_report(home, capfd):
    write(home / "head.nii.gz")
    write(home / "labels.nii.gz", labels())
    (home / "targets.csv").write_text("r,a,s,label\n-20,20,10,a\n")
    (home / "steps.toml").write_text(STEPS)
    xfemnav(capfd, "run", "--scenario", "steps.toml", "-o", "out", "-w", "cache")
    same_again(home, capfd)


def volume(n: int = 3) -> np.ndarray:
    """The brain on `n` slices, darker from one to the next."""
    return np.stack([brain() * (1 - 0.05 * k) for k in range(n)], axis=2)


def test_a_slice_of_a_volume_with_its_mask_from_python(home, capfd):
    write(home / "volume.nii.gz", volume())
    write(home / "masks.nii.gz", (volume() > 0).astype(np.uint8))
    package.run("volume.nii.gz", mask=home / "masks.nii.gz", slice_mm=12, cut=[[-60, 10], [-15, 5]], opening_mm=4,
                element_size_mm=8, corridor_element_mm=4, report=False, output="out", cache="cache")
    same_again(home, capfd, "--no-report")


@pytest.mark.filterwarnings("ignore")
def test_a_folder_of_dicom(home, monkeypatch, capfd):
    """Given as '.', it has the name that it has from elsewhere."""
    write_series(image_of(volume(), RAS), home / "series")
    monkeypatch.chdir(home / "series")
    code = xfemnav(capfd, "run", ".", "--slice", "1", "--cut", CUT, "--opening-mm", "4", *QUICK, "-o", home / "out",
                   "-w", home / "cache")[0]
    assert code == 0
    monkeypatch.chdir(home)
    same_again(home, capfd, "--no-report")


def test_elsewhere_only_the_ways_to_the_files_differ(home, capfd):
    write(home / "head.nii.gz")
    for folder in ("out", "deep/er/again"):
        given = ("head.nii.gz",) if folder == "out" else ("--scenario", "out/scenario.toml")
        more = ("--cut", CUT, "--opening-mm", "4", *QUICK) if folder == "out" else ("--no-report",)
        assert xfemnav(capfd, "run", *given, *more, "-o", folder, "-w", "cache")[0] == 0
    was, now = files(home / "out"), files(home / "deep/er/again")
    assert [name for name in was if was[name] != now[name]] in (["run.json", "scenario.toml"],
                                                                ["scenario.toml", "run.json"])
    assert now["scenario.toml"] == was["scenario.toml"].replace(b'"../head', b'"../../../head')
