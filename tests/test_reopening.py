"""A run opened again: its folder moved with its image or alone; its image moved, changed, gone, or zipped anew."""

import contextlib
import gzip
import json
import os
import shutil

import jsonschema
import nibabel as nib
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small import CUT, QUICK, brain, write, xfemnav

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.asking.config import configure
from xfemnav.pipeline.running.reopening import run_problems
from xfemnav.pipeline.running.result import Result
from xfemnav.pipeline.running.runfile import run_schema


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A study: an image with its run in a folder beside it, a mask, a drawn cut and landmarks in a third."""
    home = tmp_path_factory.mktemp("made")
    for name in ("study/anat", "study/runs", "drawn"):
        (home / name).mkdir(parents=True)
    write(home / "study/anat/head.nii.gz")
    write(home / "drawn/mask.nii.gz", (brain() > 0).astype(np.uint8))
    (home / "drawn/cut.csv").write_text("r,a,s\n-60,10,10\n-15,5,10\n")
    (home / "drawn/targets.csv").write_text("r,a,s,label\n-20,20,10,a\n")
    drawn = home / "drawn"
    done = configure_and_run(home / "study/anat/head.nii.gz", home / "study/runs/out", home / "cache",
                             cut=drawn / "cut.csv", mask=drawn / "mask.nii.gz", points=drawn / "targets.csv")
    assert done.trusted
    return home


def configure_and_run(image, output, cache, **flags):
    import xfemnav as package

    return package.run(image, opening_mm=4, element_size_mm=8, corridor_element_mm=4, report=False, output=output,
                       cache=cache, **flags)


@pytest.fixture
def study(made, tmp_path):
    """A copy of the study, in which the place where the image was is that of the copy."""
    home = tmp_path / "home"
    shutil.copytree(made, home)
    path = home / "study/runs/out/run.json"
    path.write_text(path.read_text().replace(str(made), str(home)))
    return home


def again(capfd, scenario, *more):
    """(exit code, stderr, record or None) of a run of a scenario, from a folder of its own."""
    out = scenario.parent.parent / "again"
    code, _, stderr = xfemnav(capfd, "run", *more, "--scenario", scenario, "-o", out, "--no-report")
    return code, stderr, json.loads((out / "run.json").read_text()) if out.exists() else None


def test_the_record_says_where_the_inputs_were(made):
    record = json.loads((made / "study/runs/out/run.json").read_text())
    jsonschema.validate(record, run_schema())
    inputs = record["inputs"]
    assert {place: item["path"] for place, item in inputs.items()} == {
        "image": "../../anat/head.nii.gz", "mask": "../../../drawn/mask.nii.gz",
        "cut.0.markups": "../../../drawn/cut.csv", "points.0": "../../../drawn/targets.csv"}
    for place, item in inputs.items():
        assert os.path.samefile(item["absolute"], made / "study/runs/out" / item["path"])
        assert ("content" in item) == (place in ("image", "mask")) and len(item["sha256"]) == 64
    assert inputs["image"]["sha256"] == record["input"]["sha256"]


def test_a_run_that_fails_says_where_its_inputs_were(tmp_path, capfd):
    write(tmp_path / "head.nii.gz")
    (tmp_path / "mask.nii.gz").write_bytes(b"nothing")
    code, *_ = xfemnav(capfd, "run", tmp_path / "head.nii.gz", "--mask", tmp_path / "mask.nii.gz", "--cut", CUT, *QUICK,
                       "-o", tmp_path / "out", "-w", tmp_path / "cache")
    record = json.loads((tmp_path / "out/run.json").read_text())
    jsonschema.validate(record, run_schema())
    assert code and record["status"] == "failed" and "sha256" in record["inputs"]["image"]
    assert record["inputs"]["mask"]["path"] == "../mask.nii.gz"


def test_all_is_as_it_was_from_any_folder(study, monkeypatch, capfd):
    monkeypatch.chdir("/")
    out = study / "study/runs/out"
    assert np.array_equal(Result.load(out).preoperative.values, brain().astype(float))
    assert xfemnav(capfd, "check", out) == (0, f"{out}: no problem found\n", "")
    monkeypatch.chdir(out)
    assert Result.load(".").preoperative.values.any() and run_problems(out) == []
    code, stderr, record = again(capfd, out / "scenario.toml", "-w", study / "cache")
    assert code == 0 and stderr == "" and {stage["status"] for stage in record["stages"]} == {"cached"}


def problems(out) -> list[str]:
    """Code and place of each problem of a run."""
    return [str(error).split(": ")[0] for error in run_problems(out)]


def moved_together(study):
    return shutil.move(study, study.with_name("elsewhere")) / "study/runs/out"


def run_moved_alone(study):
    (study.parent / "deep/er").mkdir(parents=True)
    return study.parent / "deep/er" / shutil.move(study / "study/runs/out", study.parent / "deep/er/out").name


def run_moved_to_another_patient(study):
    """From there the way leads to an image that is called the same."""
    other = study / "other/runs/out"
    (other.parent.parent / "anat").mkdir(parents=True)
    other.parent.mkdir()
    write(other.parent.parent / "anat/head.nii.gz", 2 * brain())
    return shutil.move(study / "study/runs/out", other)


def packed_anew(study):
    image = study / "study/anat/head.nii.gz"
    before = image.read_bytes()
    image.write_bytes(gzip.compress(gzip.decompress(before), compresslevel=1, mtime=5))
    assert image.read_bytes() != before
    return study / "study/runs/out"


@pytest.mark.parametrize("happens", [moved_together, run_moved_alone, run_moved_to_another_patient, packed_anew])
def test_what_has_moved_is_found_by_its_bytes(study, capfd, happens):
    out = happens(study)
    assert np.array_equal(Result.load(out).preoperative.values, brain().astype(float))
    assert run_problems(out) == []
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    code, stderr, record = again(capfd, out / "scenario.toml")
    assert (code, stderr, record["warnings"]) == (0, "", [])
    after = {path.name: path.read_bytes() for path in (out.parent / "again").iterdir()}
    differ = {name for name in before if before[name] != after[name]}
    assert before.keys() == after.keys() and differ <= {"run.json", "scenario.toml"}
    assert Result.load(out).landmarks([[-20.0, 20.0]]).flag == ("tissue",)


@pytest.mark.parametrize("gone", [False, True])
def test_an_image_that_has_moved_is_asked_for_with_both_places(study, capfd, gone):
    image, out = study / "study/anat/head.nii.gz", study / "study/runs/out"
    now = image.with_name("new.nii.gz")
    shutil.move(image, now)
    if gone:
        now.unlink()
    out = shutil.move(out, study / "runs-of-2025")
    nearby = study.parent / "anat/head.nii.gz"
    for ask in (lambda: Result.load(out).preoperative, lambda: configure(scenario=out / "scenario.toml")):
        with pytest.raises(XfemnavError) as caught:
            ask()
        text = caught.value.message
        assert caught.value.code == "E100" and str(image) in text and str(nearby) in text
        assert "or give image" in text
    code, stdout, _ = xfemnav(capfd, "check", out)
    assert code == 66 and stdout.startswith("E100 image: ") and len(stdout.splitlines()) == 1
    if not gone:
        assert Result.load(out, image=now).preoperative.values.any()
        assert again(capfd, out / "scenario.toml", now)[:2] == (0, "")
    with pytest.raises(XfemnavError, match=r"E100 image: nothing at .*nowhere"):
        _ = Result.load(out, image=study / "nowhere").preoperative
    assert Result.load(out).landmarks([[-20.0, 20.0]]).flag == ("tissue",), "which needs no image"


def test_an_image_that_has_changed_is_told(study, capfd):
    out, image = study / "study/runs/out", study / "study/anat/head.nii.gz"
    write(image, brain() + 1)
    with pytest.raises(XfemnavError, match=r"E702 image: .*head.nii.gz is not what it was"):
        _ = Result.load(out).preoperative
    with pytest.raises(XfemnavError, match="E702"):
        _ = Result.load(out, image=image).preoperative
    code, stdout, _ = xfemnav(capfd, "check", out)
    assert code == 65 and stdout.startswith("E702 image: ")
    code, stderr, record = again(capfd, out / "scenario.toml")
    assert code == 0 and "W702 image: head.nii.gz is not what it was" in stderr
    assert [item["code"] for item in record["warnings"]] == ["W702"]
    assert again(capfd, out / "scenario.toml", "--strict")[0] == 65
    assert again(capfd, out / "scenario.toml", image)[1] == "", "given by hand, it is meant"


@pytest.mark.parametrize("name", ["mask.nii.gz", "cut.csv", "targets.csv"])
def test_every_other_input_is_told_too(study, capfd, name):
    path, out = study / "drawn" / name, study / "study/runs/out"
    place = {"mask.nii.gz": "mask", "cut.csv": "cut.0.markups", "targets.csv": "points.0"}[name]
    if name == "mask.nii.gz":
        mask = np.asarray(nib.load(path).dataobj)[:, :, 0].copy()
        mask[30] = mask[30] * (np.arange(72) > 20)
        write(path, mask)
    else:
        path.write_text(path.read_text() + "-15,6,10\n")
    assert problems(out) == [f"E702 {place}"]
    code, stderr, _ = again(capfd, out / "scenario.toml")
    assert code == 0 and f"W702 {place}: {name} " in stderr
    path.unlink()
    assert problems(out) == [f"E100 {place}"]
    with pytest.raises(XfemnavError, match=rf"E100 {place}: nothing at [^ ]*{name}\. Put it back"):
        configure(scenario=out / "scenario.toml")


def test_a_scenario_that_was_edited_is_one_like_any_other(study, capfd):
    """What it names otherwise now is not compared with what was."""
    out = study / "study/runs/out"
    write(study / "study/anat/other.nii.gz", brain() + 1)
    text = (out / "scenario.toml").read_text()
    (out / "scenario.toml").write_text(text.replace("anat/head.nii.gz", "anat/other.nii.gz"))
    assert again(capfd, out / "scenario.toml")[:2] == (0, "")


def test_outputs_that_are_gone_are_told(study):
    out = study / "study/runs/out"
    (out / "scenario.toml").unlink()
    (out / json.loads((out / "run.json").read_text())["outputs"]["solution"]).unlink()
    assert sorted(problems(out)) == ["E100 outputs.scenario", "E100 outputs.solution"]
    assert run_problems(out.parent)[0].message.startswith("no run.json")


VALUES = st.sampled_from([None, 1, [], {}, "", "\0", "/dev/zero", "/dev/stdin", ".", "/", "fifo", "\x1b[2J", "a" * 5000,
                          {"path": "x"}, {"path": "fifo", "absolute": "fifo", "sha256": "0" * 64}, "-1", 1e400])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(["image", "mask", "points.0", "cut.0.markups"]),
       st.sampled_from([(), ("path",), ("absolute",), ("sha256",), ("content",), ("more",)]), VALUES,
       st.sampled_from(["inputs", "parameters"]))
def test_no_damage_of_the_record_is_a_bug_or_hangs(study, place, keys, value, part):
    """Somebody may have edited run.json: each way to open the run gives a result or a code."""
    out = study / "study/runs/out"
    path = out / "run.json"
    before = path.read_text()
    if not os.path.lexists(out / "fifo"):
        os.mkfifo(out / "fifo")
    record = json.loads(before)
    if keys and part == "inputs":
        record[part][place][keys[0]] = value
    else:
        record[part][place] = value
    try:
        path.write_text(json.dumps(record))
        assert all(isinstance(error, XfemnavError) for error in run_problems(out))
        for ask in (lambda: Result.load(out).preoperative, lambda: configure(scenario=out / "scenario.toml")):
            with contextlib.suppress(XfemnavError):
                ask()
    finally:
        path.write_text(before)
