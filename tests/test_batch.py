"""`xfemnav batch`: a failure stops nothing, what is done is not done again, a killed batch goes on where it was."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import nibabel
import numpy as np
import pytest

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.running.batch_table import Table, row
from xfemnav.pipeline.stages.stage_solve import mean_displacement
from xfemnav_cli import batch as command
from xfemnav_cli.slices import find_items, read_manifest

SCENARIO = """
xfemnav = 1
[[cut]]
points = [[0.0, 40.0], [2.0, 10.0]]
[[retract]]
side = "left"
normal_mm = {opening}
[[retract]]
side = "right"
normal_mm = 1.0
[mesh]
element_size_mm = 4.0
corridor_mm = 0.0
"""


def write_slice(folder: Path, stem: str, opening: float) -> Path:
    """An ellipse of 60 x 70 mm with a texture of its own, cut from the front, and its scenario."""
    x, y = np.meshgrid(np.arange(-40, 41), np.arange(-45, 46), indexing="ij")
    inside = (x / 30) ** 2 + (y / 35) ** 2 < 1
    values = np.where(inside, 500 + 100 * np.cos(x / 5) + 50 * opening, 0).astype(np.float32)
    affine = np.diag([1.0, 1, 1, 1])
    affine[:2, 3] = -40, -45
    nibabel.save(nibabel.Nifti1Image(values[:, :, None], affine), folder / f"{stem}.nii.gz")
    (folder / f"{stem}.toml").write_text(SCENARIO.format(opening=opening))
    return folder / f"{stem}.nii.gz"


def batch(source: Path, target: Path, cache: Path, jobs: int = 2, **options) -> subprocess.Popen:
    command = [sys.executable, "-c", "from xfemnav_cli.main import main; main()", "batch", source, target, f"-j{jobs}"]
    options |= {"env": os.environ | {"XFEMNAV_CACHE": str(cache)}, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, stderr=subprocess.STDOUT, **options)


def finished(process: subprocess.Popen) -> tuple[int, str]:
    text = process.communicate(timeout=300)[0]
    return process.returncode, text


def stages(target: Path, stem: str) -> set[str]:
    return {stage["status"] for stage in json.loads((target / stem / "run.json").read_text())["stages"]}


def test_only_slices_with_a_scenario_of_their_name_are_run(tmp_path):
    for name in ("b.nii", "a.nii.gz", "a.toml", "b.toml", "alone.nii.gz", "nothing.toml", "a.txt"):
        (tmp_path / name).write_text("xfemnav = 1\n")
    items = find_items(tmp_path, Path("out"))
    assert [(item.image.name, item.folder) for item in items] == [
        ("a.nii.gz", Path("out/a")), ("b.nii", Path("out/b")), ("nothing.nii.gz", Path("out/nothing"))]


def table(target: Path) -> dict[str, dict[str, str]]:
    """The rows of batch.tsv by name."""
    header, *lines = (target / "batch.tsv").read_text().splitlines()
    rows = [dict(zip(header.split("\t"), line.split("\t"), strict=True)) for line in lines]
    return {row["name"]: row for row in rows}


def test_slices_of_one_volume_share_it(tmp_path):
    """By the name of the image, by the name that they share with it, or by what they say."""
    for name in ("vol.nii.gz", "vol.z12.toml", "vol.a.z18.toml", "vol.toml", "none.z1.toml"):
        (tmp_path / name).write_text("xfemnav = 1\n")
    (tmp_path / "said.toml").write_text('image = "vol.nii.gz"')
    found = {item.name: item.image and item.image.name for item in find_items(tmp_path, Path("out"))}
    assert found == {"vol.z12": "vol.nii.gz", "vol.a.z18": "vol.nii.gz", "vol": "vol.nii.gz", "said": None,
                     "none.z1": "none.z1.nii.gz"}


def write_volume(folder: Path) -> Path:
    """Three slices, at 0, 5 and 10 mm."""
    image = write_slice(folder, "vol", 1.0)
    values = np.asarray(nibabel.load(image).dataobj)
    nibabel.save(nibabel.Nifti1Image(np.concatenate([values, 0.9 * values, 0.8 * values], axis=2),
                                     np.array([[1, 0, 0, -40], [0, 1, 0, -45], [0, 0, 5, 0], [0, 0, 0, 1.0]])), image)
    (folder / "vol.toml").unlink()
    return image


def test_a_manifest_is_a_command_line_a_row(tmp_path):
    """Paths lead from the manifest, anywhere; the table has a row for each, from any folder."""
    (tmp_path / "study/lists").mkdir(parents=True)
    image = write_volume(tmp_path / "study")
    common = "../vol.nii.gz\t0,40 2,10\t4\t0"
    (tmp_path / "study/lists/slices.tsv").write_text(
        "name\timage\tcut\telement_size_mm\tcorridor_mm\tslice_mm\topening_mm\tstrict\n"
        f"first\t{common}\t0\t3\tn/a\nsecond\t{common}\t10\t2\tfalse\nthird\t{common}\t99\t2\t\n"
        f"strict\t{common}\t5\t0\ttrue\n")
    target = tmp_path / "out"
    code, text = finished(batch(tmp_path / "study/lists/slices.tsv", target, tmp_path / "cache", cwd="/"))
    rows = table(target)
    assert code == 1 and list(rows) == ["first", "second", "third", "strict"], text
    for name, index, place, opening in (("first", "0", "0", 3), ("second", "2", "10", 2)):
        row = rows[name]
        assert (row["slice"], row["slice_mm"], row["status"], row["exit_code"], row["trusted"], row["error"]) == (
            index, place, "complete", "0", "true", "n/a")
        assert float(row["max_displacement_mm"]) == pytest.approx(opening / 2, rel=0.2)
        assert 0 < float(row["mean_displacement_mm"]) < float(row["max_displacement_mm"])
        record = json.loads((target / name / "run.json").read_text())
        assert row["warnings"] == ",".join(sorted({item["code"] for item in record["warnings"]}))
        assert row["lip_error_mm_max"] == f"{record['checks']['lip_error_mm']['max']:.6g}"
        assert float(row["largest_force_mN_per_mm"]) > 0 and row["forces_mN_per_mm"].startswith("cut left ")
        assert (target / row["image"]).samefile(image) and (target / row["output"]).samefile(target / name)
        assert float(row["seconds"]) > 0
    third = rows["third"]
    assert (third["status"], third["exit_code"], third["error"], third["trusted"], third["residual"]) == (
        "failed", "65", "E120", "n/a", "n/a")
    assert rows["strict"]["error"].startswith("W") and rows["strict"]["exit_code"] == "65"


@pytest.mark.parametrize("text, words", [
    ("", ""), ("image\n", "holds no rows"), ("image\tcutt\na\tb\n", "column 'cutt'"),
    ("cut\n0,0 1,1\n", "'image' or 'scen"),
    ("image\tcut\na.nii\n", "line 2 has 1 cells"), ("image\na.nii\na.nii\n", "several rows called 'a'"),
    ("name\timage\n../x\ta.nii\n", "no name of a folder"), ("image\tstrict\na.nii\tperhaps\n", "true or false"),
    ("image\toutput\na.nii\tx\n", "column 'output'")])
def test_a_wrong_manifest_is_told(tmp_path, text, words):
    path = tmp_path / "slices.tsv"
    path.write_text(text)
    if not text:
        with pytest.raises(XfemnavError, match="E106"):
            read_manifest(path, tmp_path / "out")
    else:
        with pytest.raises(click.UsageError, match=words):
            read_manifest(path, tmp_path / "out")


def test_a_manifest_of_commas_and_of_options_as_they_are_typed(tmp_path):
    path = tmp_path / "slices.csv"
    path.write_bytes('\ufeffscenario,--slice-mm,cut,cut\r\nx.toml,3,"0,1 2,3","4,5 6,7"\r\n'.encode())
    item, = read_manifest(path, tmp_path / "out")
    assert item.name == "x" and item.image is None and item.words == (
        "--scenario", str(tmp_path / "x.toml"), "--slice-mm=3", "--cut=0,1 2,3", "--cut=4,5 6,7")


def test_rows_of_before_stay_until_their_slice_has_run(tmp_path):
    """Interrupted and called again, the table has what was done."""
    made = Table(tmp_path, ["a", "b", "c"])
    done = row("a", "a.nii", "a", 0, 1.25, {"status": "complete", "warnings": [{"code": "W409"}, {"code": "W301"}]})
    made.put("a", done)
    assert list(table(tmp_path)) == ["a", "b", "c"] and table(tmp_path)["b"]["status"] == "n/a"
    again = Table(tmp_path, ["c", "a", "new"])
    again.put("c", row("c", "c.nii", "c", -9, 1.0, {}, ""))
    rows = table(tmp_path)
    assert list(rows) == ["c", "a", "new"] and rows["a"] == done and rows["a"]["warnings"] == "W301,W409"
    assert (rows["c"]["status"], rows["c"]["exit_code"]) == ("failed", "-9")
    (tmp_path / "batch.tsv").write_text("name\timage\nmine\t1\n")
    with pytest.raises(XfemnavError, match="E731"):
        Table(tmp_path, ["a"])


@pytest.mark.parametrize("status, trusted", [("complete", "true"), ("untrusted", "false"), ("failed", "n/a"),
                                             ("interrupted", "n/a")])
def test_a_row_says_whether_its_result_is_trusted(status, trusted):
    assert row("a", "", "", 0, 1.0, {"status": status})["trusted"] == trusted


def test_mean_displacement_is_by_area():
    """A motion that is all translation has its length; where half of the area rests, half of it."""
    rest = np.array([[[0, 0], [1, 0], [0, 1]], [[1, 0], [1, 1], [0, 1]], [[0, 0], [-1, 0], [0, -2.0]]])
    shift, first_two = np.array([3.0, 4.0]), np.array([1, 1, 0])[:, None, None]
    assert mean_displacement(rest, rest + shift) == pytest.approx(5.0)
    assert mean_displacement(rest, rest + first_two * shift) == pytest.approx(2.5)


@pytest.mark.parametrize("codes, wanted", [((0, 0), 0), ((0, 3), 1), ((3, 3), 1), ((65, 0), 1)])
def test_a_batch_succeeds_where_every_slice_is_trusted(tmp_path, monkeypatch, codes, wanted):
    for name in "ab":
        write_slice(tmp_path, name, 1.0)
    monkeypatch.setattr(command, "run_items", lambda items, jobs, table: [
        command.Outcome(item, code, {}, "", 0.0) for item, code in zip(items, codes)])
    assert command.batch.callback(tmp_path, tmp_path / "out", 1) == wanted


def test_an_empty_folder_is_a_usage_error(tmp_path):
    code, text = finished(batch(tmp_path, tmp_path / "out", tmp_path / "cache"))
    assert code == 2 and "<stem>.toml" in text


def test_a_failing_slice_stops_no_other_and_nothing_is_done_twice(tmp_path):
    source, target, cache = tmp_path / "in", tmp_path / "out", tmp_path / "cache"
    source.mkdir()
    write_slice(source, "good", 1.0)
    damaged = write_slice(source, "abroken", 1.0)
    damaged.write_bytes(damaged.read_bytes()[:-40])
    lonely = source / "lonely.toml"  # its image was never copied
    lonely.write_text(SCENARIO.format(opening=1.0))

    code, text = finished(batch(source, target, cache))
    assert code == 1
    assert "1 updated, 0 untrusted, 2 failed" in text
    assert "E100" in next(line for line in text.splitlines() if line.startswith("lonely"))
    lonely.unlink()
    assert "E101" in next(line for line in text.splitlines() if line.startswith("abroken"))
    assert stages(target, "good") == {"ran"}
    assert (target / "good" / "report.html").is_file()
    assert {name: (row["status"], row["error"]) for name, row in table(target).items()} == {
        "abroken": ("failed", "E101"), "good": ("complete", "n/a"), "lonely": ("failed", "E100")}

    write_slice(source, "abroken", 1.5)  # mended: only this one is new
    code, text = finished(batch(source, target, cache))
    assert code == 0 and "2 updated, 0 untrusted, 0 failed" in text
    assert stages(target, "abroken") == {"ran"}
    assert stages(target, "good") == {"cached"}

    (source / "good.toml").write_text("xfemnav = 1\ncut = 3\n")  # no run begins, and the record is of the one before
    code, _ = finished(batch(source, target, cache))
    found = table(target)["good"]
    assert code == 1 and (target / "good" / "run.json").exists()
    assert (found["status"], found["trusted"], found["max_displacement_mm"]) == ("failed", "n/a", "n/a")


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_batch_leaves_no_run_behind(tmp_path, signum):
    for k in range(3):
        write_slice(tmp_path, f"slice{k}", 1.0)
    process = batch(tmp_path, tmp_path / "out", tmp_path / "cache", start_new_session=True)
    while not list(tmp_path.glob("out/*")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signum)
    assert finished(process)[0] == 128 + signum
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)  # nobody is left in its group
    assert not (tmp_path / "out" / "slice2").exists(), "what had not begun does not begin"


@pytest.mark.slow
def test_twelve_slices_two_broken_killed_halfway(tmp_path):
    """kill -9 of the batch and all its runs: the next call completes, and touches no entry that was finished."""
    source, target, cache = tmp_path / "in", tmp_path / "out", tmp_path / "cache"
    source.mkdir()
    for k in range(12):
        write_slice(source, f"slice{k:02}", 1.0 + k / 10)
    (source / "slice03.nii.gz").write_bytes(b"no image")
    (source / "slice07.toml").write_text("xfemnav = 1\nunknown = 3\n")

    process = batch(source, target, cache, start_new_session=True)
    while sum(1 for _ in target.glob("*/report.html")) < 4:
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    entries = {path: path.stat().st_mtime_ns for path in cache.rglob("manifest.json")}
    records = {path.parent.name: json.loads(path.read_text()) for path in target.glob("*/run.json")}
    done = {stem for stem, record in records.items() if record["status"] == "complete"}
    assert entries and len(done) >= 3
    told = {name for name, row in table(target).items() if row["status"] == "complete"}
    assert told <= done and len(told) >= 3, "the table is whole at any time"

    code, text = finished(batch(source, target, cache))
    assert code == 1 and "10 updated, 0 untrusted, 2 failed" in text
    assert {path: path.stat().st_mtime_ns for path in entries} == entries
    assert all(stages(target, stem) == {"cached"} for stem in done)
    failed = [line.split()[0] for line in text.splitlines() if " failed " in line and not line.startswith("[")]
    assert failed == ["slice03", "slice07"]
    assert [row["status"] for row in table(target).values()].count("complete") == 10
    assert {name: row["error"] for name, row in table(target).items() if row["status"] == "failed"} == {
        "slice03": "E106", "slice07": "E780"}
