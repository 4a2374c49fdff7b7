"""`xfemnav batch`: a failure stops nothing, what is done is not done again, a killed batch goes on where it was."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import nibabel
import numpy as np
import pytest

from xfemnav_cli.batch import find_items

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
        (tmp_path / name).touch()
    items = find_items(tmp_path, Path("out"))
    assert [(item.image.name, item.folder) for item in items] == [
        ("a.nii.gz", Path("out/a")), ("b.nii", Path("out/b")), ("nothing.nii.gz", Path("out/nothing"))]


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

    write_slice(source, "abroken", 1.5)  # mended: only this one is new
    code, text = finished(batch(source, target, cache))
    assert code == 0 and "2 updated, 0 untrusted, 0 failed" in text
    assert stages(target, "abroken") == {"ran"}
    assert stages(target, "good") == {"cached"}


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

    code, text = finished(batch(source, target, cache))
    assert code == 1 and "10 updated, 0 untrusted, 2 failed" in text
    assert {path: path.stat().st_mtime_ns for path in entries} == entries
    assert all(stages(target, stem) == {"cached"} for stem in done)
    failed = [line.split()[0] for line in text.splitlines() if " failed " in line and not line.startswith("[")]
    assert failed == ["slice03", "slice07"]
