"""The doctor: a sound installation passes, and each planted fault of frames, files or folders is found and told."""

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small import xfemnav

from xfemnav.imaging.carrying import companions, landmarks, surfaces, transform, vectors, warp
from xfemnav.imaging.points import markups, point_tables, surface_files
from xfemnav.imaging.reading import conventions, mgh, nrrd
from xfemnav.imaging.reading import nifti_frames as frames
from xfemnav.imaging.selftest import known, roundtrip
from xfemnav.pipeline.keeping import files, kernels
from xfemnav.pipeline.running import doctor

CHECKS = {what: check for what, check, _ in roundtrip.CHECKS}
MIRRORED = np.array([1.0, -1.0, 1.0])    # LPS with the sign of x forgotten


def findings(cache):
    return list(doctor.examine(cache))


def bad(found):
    return {item.what.partition(" ")[0]: item for item in found if item.matter}


def test_this_machine_is_sound(tmp_path, capfd):
    code, out, err = xfemnav(capfd, "doctor", "-w", tmp_path / "cache")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert len(lines) == 6 + len(roundtrip.CHECKS) and all(line.startswith("ok   ") for line in lines)
    assert "SimpleITK" in lines[0] and "numba" in lines[0]
    made = {path.name for path in (tmp_path / "cache").iterdir()}
    assert made == {"CACHEDIR.TAG", "damaged", "entries", "in-use", "locks"}


def test_the_known_scene_is_what_it_says():
    """Inverse maps, and triangles that carry as the closed form does; no voxel's centre on a border."""
    for scene in (known.STRAIGHT, known.OBLIQUE):
        inner = scene.inner()
        assert len(inner) == 40 and np.allclose(scene.resting(scene.now(inner)), inner, atol=1e-12)
        assert np.allclose(scene.plane(scene.world(inner)), inner, atol=1e-12)
        assert np.allclose(scene.turn.T @ scene.turn, np.eye(3)) and np.linalg.det(scene.turn) > 0
        centres = scene.rest.mean(axis=1)
        assert np.allclose(scene.now(centres), scene.moved.mean(axis=1), atol=1e-12)
        for values, affine in (scene.volume(), scene.volume((1, 2, 0), (True, True, False))):
            voxels = np.moveaxis(np.indices(values.shape), 0, -1)
            assert np.allclose(scene.image(voxels @ affine[:3, :3].T + affine[:3, 3]), values, atol=1e-9)
    with pytest.raises(known.Mismatch, match=r"x is off by up to 2, allowed is 0\.1"):
        known.agree("x", [1.0, np.nan, 3.0], [1.0, 1.0, 1.0], 0.1)


@pytest.mark.parametrize("module, name, value, found", [
    (vectors, "LPS", MIRRORED, {"transforms", "fields"}),
    (markups, "LPS", MIRRORED, {"point"}),
    (point_tables, "LPS", MIRRORED, {"point"}),
    (frames, "from_voxel", lambda frame, axis, index: frame, {"NIfTI"}),
    (point_tables, "BIDS", ("\t", "lps"), {"point"}),
    (roundtrip, "pull_back", lambda rest, moved, *grid: warp.pull_back(moved, rest, *grid),
     {"NIfTI", "MGZ", "NRRD", "MetaImage", "DICOM"}),
    (conventions, "LPS", np.diag(MIRRORED), {"vectors", "tensors"}),
    (conventions, "_array_axes", lambda affine, axes: -known.STRAIGHT.turn, {"vectors", "tensors"}),
    (companions, "ORDERS", conventions.ORDERS | {"mrtrix": conventions.ORDERS["fsl"]}, {"tensors"}),
    (roundtrip, "moved_points", lambda points, frame, motion, _: landmarks.resting_points(
        points, frame, motion, known.HALF * roundtrip.AROUND), {"landmarks"}),
    (files, "SAME_MM", 50.0, {"meshes"}),
    (surface_files, "FRAMES", {"ras": np.eye(4), "lps": np.diag([*MIRRORED, 1.0])}, {"surfaces"}),
    (surfaces, "moved_points", lambda points, frame, motion, _: landmarks.resting_points(
        points, frame, motion, known.HALF * roundtrip.AROUND), {"surfaces"}),
])
def test_a_planted_fault_is_found(tmp_path, monkeypatch, module, name, value, found):
    monkeypatch.setattr(module, name, value)
    told = bad(findings(tmp_path))
    assert set(told) == found
    for item in told.values():
        assert item.exit_code == 70 and item.line.startswith(f"BAD  {item.what}: ") and item.mend
        assert "\n" not in item.line


@pytest.mark.parametrize("module, what", [(nrrd, {"NRRD", "vectors", "tensors"}), (mgh, {"MGZ"})])
def test_a_frame_read_with_a_wrong_sign_is_found(tmp_path, monkeypatch, module, what):
    right = module.read_frame

    def mirrored(*given):
        affine, code = right(*given)
        return np.diag([-1.0, 1.0, 1.0, 1.0]) @ affine, code

    monkeypatch.setattr(module, "read_frame", mirrored)
    assert set(bad(findings(tmp_path))) == what


def test_directions_are_told_apart(tmp_path, monkeypatch):
    """A forward field in the place of the backward one."""
    monkeypatch.setattr(roundtrip, "backward", lambda frame, organ, motion: transform.forward(frame, motion))
    assert set(bad(findings(tmp_path))) == {"transforms", "fields"}


def test_a_library_that_is_broken_is_a_finding(tmp_path, monkeypatch, capfd):
    def broken(folder):
        raise RuntimeError("undefined symbol:\n  _ZN3itk")

    monkeypatch.setattr(roundtrip, "CHECKS", (("images by X", broken, "nibabel"), *roundtrip.CHECKS[-1:]))
    code, out, _ = xfemnav(capfd, "doctor", "-w", tmp_path)
    line = next(line for line in out.splitlines() if line.startswith("BAD"))
    assert code == 70 and "RuntimeError: undefined symbol: _ZN3itk. Install another version of nibabel" in line
    assert out.splitlines()[-1].startswith("ok   meshes"), "the others are looked at all the same"


def test_a_library_that_is_missing_is_a_finding(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "LIBRARIES", (*doctor.LIBRARIES, "no-such-library"))
    first = doctor._libraries()
    assert first.exit_code == 70 and "no-such-library is not installed" in first.line


def test_folders(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    refused = doctor._cache(tmp_path / "file")
    assert refused.exit_code == 73 and "E502" in refused.line
    assert doctor._cache(tmp_path / "cache").matter == ""
    monkeypatch.setattr(doctor.fcntl, "flock", lambda stream, kind: None)    # a disk whose locks lock nothing
    idle = doctor._cache(tmp_path / "cache")
    assert idle.exit_code == 73 and "two programs get one lock" in idle.line
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda folder: SimpleNamespace(free=1e6))
    full = doctor._space(tmp_path / "not" / "there", "the cache")
    assert full.exit_code == 74 and "BAD" in full.line


def test_kernels_that_are_not_kept_are_told(monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    found = doctor._kernels()
    assert found.exit_code == 73 and "NUMBA_CACHE_DIR" in found.line
    assert Path(os.environ["NUMBA_CACHE_DIR"]).name.startswith(kernels.NAME)


def test_each_check_leaves_what_it_made_in_its_folder_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "work").mkdir()
    for k, check in enumerate(CHECKS.values()):
        (tmp_path / "work" / str(k)).mkdir()
        check(tmp_path / "work" / str(k))
    assert [path.name for path in tmp_path.iterdir()] == ["work"]
