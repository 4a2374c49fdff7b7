"""The Python face: the doctest on the phantom, and what a `Result` answers."""

import doctest
import os
import subprocess
import sys

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from scipy.ndimage import binary_erosion
from small import CUT, brain, write

import xfemnav
from xfemnav.pipeline import kernels, keys, result

COARSE = {"element_size_mm": 8.0, "corridor_element_mm": 4.0, "report": False}


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """The small brain, cut and opened by 4 mm."""
    home = tmp_path_factory.mktemp("result")
    with pytest.warns(xfemnav.XfemnavWarning, match="W404"):
        return xfemnav.run(write(home / "head.nii.gz"), cut=CUT, opening_mm=4.0, output=home / "out",
                           cache=home / "cache", **COARSE)


def test_example_of_the_documentation(tmp_path, monkeypatch):
    monkeypatch.setenv("XFEMNAV_CACHE", str(tmp_path))
    found = doctest.testmod(result)
    assert found.attempted > 5 and found.failed == 0


def test_there_and_back_is_where_we_were(opened):
    points = np.random.default_rng(0).uniform((-30, -40), (30, 40), (200, 2))
    current = opened.to_current(points)
    assert np.abs(opened.to_preoperative(current) - points).max() < 1e-9  # affine maps and their inverses, 100 mm wide
    assert np.abs(opened.displacement(points) - (current - points)).max() < 1e-12
    assert np.abs(current - points).max() > 0.1


def test_world_points_keep_their_height_over_the_slice(opened):
    plane = np.array([[0.0, 0.0], [-20.0, 20.0]])
    world = np.column_stack([plane, [10.0, 12.5]])
    assert np.allclose(opened.to_current(world), np.column_stack([opened.to_current(plane), [10.0, 12.5]]), atol=1e-12)
    assert opened.to_current(world[0]).shape == (3,)


def test_a_cut_has_two_sides(opened):
    cut = np.array(opened.record["cuts"][0]["path"])
    middle = cut[0] + 0.3 * (cut[1] - cut[0])
    left, right = opened.to_current(middle, "left"), opened.to_current(middle, "right")
    travel = (cut[1] - cut[0]) / np.linalg.norm(cut[1] - cut[0])
    opening = (left - right) @ (-travel[1], travel[0])
    assert abs(opening - 4.0) <= 2 * opened.record["checks"]["lip_error_mm"]["max"] < 1.0  # each lip has that error
    assert np.array_equal(left, opened.to_current(middle, +1)) and np.array_equal(right, opened.to_current(middle, -1))
    assert np.isnan(opened.to_preoperative((left + right) / 2)).all()


def test_warping_the_image_again_gives_the_updated_image(opened):
    updated = nib.load(opened.folder / opened.record["outputs"]["updated"])
    again = opened.warp(opened.folder.parent / "head.nii.gz")
    assert np.allclose(again.affine, updated.affine)
    assert np.mean(np.abs(again.get_fdata() - updated.get_fdata()) > 1e-2) < 1e-3
    plane = opened.warp(brain())
    assert np.array_equal(plane, again.get_fdata()[:, :, 0])


def test_a_folder_is_a_result(opened):
    loaded = xfemnav.Result.load(opened.folder)
    points = [[5.0, 5.0], [-25.0, 0.0]]
    assert loaded.trusted and np.array_equal(loaded.to_current(points), opened.to_current(points))
    with pytest.raises(xfemnav.XfemnavError, match="E100"):
        xfemnav.Result.load(opened.folder.parent)
    (opened.folder.parent / "run.json").write_text("{}")
    with pytest.raises(xfemnav.XfemnavError, match="E701"):
        xfemnav.Result.load(opened.folder.parent)


def test_wrong_arguments_are_told(tmp_path):
    with pytest.raises(xfemnav.XfemnavError, match=r"E780 opening: unknown option.*nothing moves"):
        xfemnav.run(tmp_path / "head.nii.gz", opening=3)
    assert not hasattr(xfemnav, "nothing")


def test_kernels_have_a_place_where_nothing_can_be_written(monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    assert "NUMBA_CACHE_DIR" in kernels.settle_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] and kernels.settle_kernel_cache() is None


def test_kernels_of_other_code_are_not_found(tmp_path, monkeypatch):
    """Numba sees no edit of a helper in another file than its caller's, so every code has a folder of its own."""
    toy = tmp_path / "xfemnav"
    for name in ("__init__", "errors", *(f"pipeline/{part}" for part in ("__init__", "kernels", "keys", "layers"))):
        (toy / name).parent.mkdir(parents=True, exist_ok=True)
        (toy / f"{name}.py").write_bytes((keys.PACKAGE / f"{name}.py").read_bytes())
    (toy / "geometry").mkdir()
    kernel = "from numba import njit\n{}\n@njit(cache=True)\ndef {}():\n    return {}\n"
    (toy / "geometry" / "caller.py").write_text(
        kernel.format("from xfemnav.geometry.helper import helper", "caller", "helper()"))
    command = ("from xfemnav.pipeline.kernels import settle_kernel_cache; settle_kernel_cache()\n"
               "from xfemnav.geometry.caller import caller; print(caller())")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    for value in (1, 2):
        (toy / "geometry" / "helper.py").write_text(kernel.format("", "helper", value))
        got = subprocess.run([sys.executable, "-c", command], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert got.stdout.strip() == str(value)
    old, forgotten = tmp_path / f"{kernels.NAME}old", tmp_path / f"{kernels.NAME}forgotten"
    for folder in (old, forgotten):
        folder.mkdir()
    os.utime(forgotten, (0, 0))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernels.settle_kernel_cache()
    assert old.exists() and not forgotten.exists()
    folders = list((toy / "geometry" / "__pycache__").glob(f"{kernels.NAME}*"))
    assert len(folders) == 2 and all(list(folder.rglob("*caller*.nbc")) for folder in folders)
    assert {path.parent.name for path in keys.PACKAGE.rglob("*.py") if "import njit" in path.read_text()} == set(
        kernels.LAYERS)


def test_transforms_for_other_programs(opened, tmp_path):
    """Resampled by SimpleITK, "extended" shows background in the middle of a wide gap, "bridged" stretched lips."""
    head = opened.folder.parent / "head.nii.gz"
    with pytest.warns(xfemnav.XfemnavWarning):
        wide = xfemnav.run(head, cut=CUT, opening_mm=12.0, output=tmp_path, cache=head.parent / "cache", **COARSE)
    image = sitk.ReadImage(head, sitk.sitkFloat32)
    cavity = sitk.GetArrayFromImage(sitk.ReadImage(wide._path("cavity")))[0] > 0
    deep = binary_erosion(cavity, np.ones((3, 3)))
    shown = {}
    for gaps in ("bridged", "extended"):
        wide.write_transform(tmp_path / f"{gaps}.h5", gaps=gaps)
        transform = sitk.ReadTransform(tmp_path / f"{gaps}.h5")
        shown[gaps] = sitk.GetArrayFromImage(sitk.Resample(image, image, transform, sitk.sitkLinear, -1.0))[0]
    assert deep.any() and (shown["extended"][deep] == -1).all()
    assert (shown["bridged"][deep] > 0).all()
