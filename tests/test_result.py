"""The Python face: the doctest on the phantom, and what a `Result` answers."""

import doctest
import os
import subprocess
import sys
import time

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from scipy.ndimage import binary_erosion
from small import CUT, brain, write

import xfemnav
from xfemnav.pipeline.keeping import kernels, keys
from xfemnav.pipeline.running import result

COARSE = {"element_size_mm": 8.0, "corridor_element_mm": 4.0, "report": False}


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """The small brain, cut and opened by 4 mm."""
    home = tmp_path_factory.mktemp("result")
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
    assert np.array_equal(again.affine, updated.affine)
    assert np.abs(again.get_fdata() - updated.get_fdata()).max() < 1e-2    # files hold points to 1e-6 mm: 2e-4 here
    assert np.abs(opened.warp(brain()) - again.get_fdata()[:, :, 0]).max() < 1e-2


def test_cavity_and_outline_are_the_runs(opened):
    """The folder tells what the run knew: its triangles, its organ, its outline now."""
    from xfemnav.pipeline.keeping.cache import Cache
    from xfemnav.pipeline.keeping.store import load

    cavity = nib.load(opened.folder / opened.record["outputs"]["cavity"]).get_fdata()[:, :, 0] > 0
    assert cavity.any() and np.array_equal(opened.update.cavity, cavity)
    key = next(stage["key"] for stage in opened.record["stages"] if stage["name"] == "solve")
    solution = load(Cache(opened.folder.parent / "cache").verified(key).folder)
    assert np.abs(opened.outline - solution.outline).max() < 1e-5    # points are rounded to 1e-6 mm


def test_what_the_outline_has_left_is_no_cavity(opened, tmp_path):
    """A free outline draws back from the skull: the same pixels are vacated as in the run."""
    home = opened.folder.parent
    free = xfemnav.run(home / "head.nii.gz", cut=CUT, opening_mm=10.0, skull="free", blade="0,0.6", output=tmp_path,
                       cache=home / "cache", **COARSE)
    pixel = float(np.prod(free.frame.spacing))
    checks = free.record["checks"]
    assert free.update.vacated.sum() * pixel == pytest.approx(checks["vacated_mm2"]) and checks["vacated_mm2"] > 20
    assert free.update.cavity.sum() * pixel == pytest.approx(checks["cavity_mm2"])


@pytest.mark.parametrize("order, signs, name", [("RAS", (1, 1), "r.nii.gz"), ("ARS", (-1, 1), "l.nrrd"),
                                                ("SAR", (-1, -1), "p.mha")])
def test_an_image_on_any_grid_goes_along(opened, tmp_path, order, signs, name):
    """A linear function of the world on 5 mm voxels in any order and format: exact wherever there is tissue."""
    slope = np.array([1.0, 2.0, 3.0])
    axes = ["RAS".index(axis) for axis in order]
    signs = np.array([*signs, 1.0])
    linear = np.zeros((3, 3))
    linear[axes, range(3)] = 5 * signs
    shape = np.array([40, 40, 20])
    first = np.array([0.0, 0, 10]) - linear @ ((shape - 1) / 2)
    voxels = np.moveaxis(np.indices(shape), 0, -1)
    values = ((voxels @ linear.T + first) @ slope).astype(np.float32)
    image = sitk.GetImageFromArray(values.transpose(2, 1, 0).copy())
    flip = np.array([-1.0, -1, 1])
    image.SetOrigin((first * flip).tolist())
    image.SetSpacing([5.0] * 3)
    image.SetDirection((linear / 5 * flip[:, None]).ravel().tolist())
    sitk.WriteImage(image, tmp_path / name)
    found = opened.warp(tmp_path / name)
    frame, tissue = opened.frame, opened.update.pull_back.tissue
    wanted = frame.to_world(opened.update.pull_back.resting[tissue]) @ slope
    assert np.abs(found.get_fdata()[:, :, 0][tissue] - wanted).max() < 1e-3    # float32 of numbers near 400
    assert (found.get_fdata()[:, :, 0][opened.update.cavity] == 0).all()


def test_labels_stay_labels_and_series_are_asked_for(opened, tmp_path):
    labels = (brain() > 600).astype(np.int16) * 7
    found = opened.warp(write(tmp_path / "labels.nii.gz", labels), kind="label")
    assert found.get_data_dtype() == np.int16 and set(np.unique(found.dataobj)) == {0, 7}
    series = write(tmp_path / "series.nii.gz", np.stack([brain(), 2 * brain()], axis=-1)[:, :, None])
    with pytest.raises(xfemnav.XfemnavError, match=r"E131.*several values"):
        opened.warp(series)
    both = opened.warp(series, kind="continuous").get_fdata()[:, :, 0]
    assert np.allclose(both[..., 1], 2 * both[..., 0]) and np.allclose(both[..., 0], opened.warp(brain()), atol=1e-2)
    with pytest.raises(xfemnav.XfemnavError, match="E131"):
        opened.warp(series, kind="vector")


def test_landmarks_both_ways(opened):
    cut = np.array(opened.record["cuts"][0]["path"])
    middle = cut[0] + 0.3 * (cut[1] - cut[0])
    points = np.array([[5.0, 5.0], middle, [200.0, 0.0]])
    found = opened.landmarks(points)
    assert found.flag == ("tissue", "on a cut", "outside")
    assert np.array_equal(found.moved[0], opened.to_current(points[0]))
    assert np.array_equal(opened.landmarks(points, "left").moved[1], found.lips[1, 0])
    between = found.lips[1].mean(axis=0)
    back = opened.landmarks([found.moved[0], between, points[2]], inverse=True)
    assert back.flag == ("tissue", "in the cut", "outside")
    assert np.abs(back.moved[0] - points[0]).max() < 1e-9


def test_resected_tissue_is_cavity(tmp_path):
    """The organ is the whole mesh's: what was taken out has no tissue, and its landmarks are resected."""
    ring = "10,-10 30,-10 30,10 10,10"
    result = xfemnav.run(write(tmp_path / "head.nii.gz"), resect=(ring,), output=tmp_path / "out",
                         cache=tmp_path / "cache", **COARSE)
    assert result.landmarks([[20.0, 0.0], [-20.0, 0.0]]).flag == ("resected", "tissue")
    taken = np.abs(result.frame.pixel_centres() - [20, 0]).max(axis=-1) < 9
    for values in (result.warp(brain(), fill=-5), result.warp(tmp_path / "head.nii.gz", fill=-5).get_fdata()[:, :, 0]):
        assert (values[taken] == -5).all() and (values == -5).sum() < taken.sum() + 60    # one row of pixels around
    result.write_transform(tmp_path / "t.h5", gaps="extended")
    gone = sitk.ReadTransform(tmp_path / "t.h5").TransformPoint((-20.0, 0.0, 10.0))
    assert np.linalg.norm(gone) > 1e3


def test_a_run_with_steps_is_a_result_after_each(tmp_path):
    write(tmp_path / "head.nii.gz")
    (tmp_path / "steps.toml").write_text("""xfemnav = 1
image = "head.nii.gz"
[mesh]
element_size_mm = 8.0
corridor_element_mm = 4.0
[[cut]]
name = "approach"
points = [[-60, 10], [-15, 5]]
[[retract]]
cut = "approach"
side = "left"
normal_mm = 2.0
blade = [0.0, 0.5]
[[resect]]
name = "tumour"
outline = [[-15, -5], [0, -5], [0, 15], [-15, 15]]
[[step]]
name = "open"
acts = ["approach"]
[[step]]
name = "remove"
acts = ["tumour"]
""")
    xfemnav.run(scenario=tmp_path / "steps.toml", output=tmp_path / "out", cache=tmp_path / "cache", report=False)
    after = {name: xfemnav.Result.load(tmp_path / "out", name) for name in ("open", "remove", None)}
    flags = {name: result.landmarks([[-8.0, 0.0]]).flag for name, result in after.items()}
    assert flags == {"open": ("tissue",), "remove": ("resected",), None: ("resected",)}
    for name, role in (("open", "cavity:open"), ("remove", "cavity")):
        cavity = nib.load(tmp_path / "out" / after[name].record["outputs"][role]).get_fdata()[:, :, 0] > 0
        assert np.array_equal(after[name].update.cavity, cavity)
    with pytest.raises(xfemnav.XfemnavError, match=r"E780.*no step 'close'.*open, remove"):
        xfemnav.Result.load(tmp_path / "out", "close")


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


def toy_package(folder):
    """A package called xfemnav with what keeps kernels, and no kernels yet."""
    toy = folder / "xfemnav"
    keeping = (f"keeping/{part}" for part in ("__init__", "kernels", "keys", "disk", "removal"))
    for name in ("__init__", "errors", *(f"pipeline/{part}" for part in ("__init__", "layers", *keeping))):
        (toy / name).parent.mkdir(parents=True, exist_ok=True)
        (toy / f"{name}.py").write_bytes((keys.PACKAGE / f"{name}.py").read_bytes())
    (toy / "__init__.pyi").touch()
    (toy / "geometry").mkdir()
    return toy


def test_kernels_of_other_code_are_not_found(tmp_path, monkeypatch):
    """Numba sees no edit of a helper in another file than its caller's, so every code has a folder of its own."""
    toy = toy_package(tmp_path)
    kernel = "from numba import njit\n{}\n@njit(cache=True)\ndef {}():\n    return {}\n"
    (toy / "geometry" / "caller.py").write_text(
        kernel.format("from xfemnav.geometry.helper import helper", "caller", "helper()"))
    command = ("from xfemnav.pipeline.keeping.kernels import settle_kernel_cache; settle_kernel_cache()\n"
               "from xfemnav.pipeline.keeping.kernels import compiling; new = []\n"
               "from xfemnav.geometry.caller import caller\n"
               "with compiling('mesh', lambda: new.append(1)): print(caller(), bool(new))")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    for value in (1, 2):
        (toy / "geometry" / "helper.py").write_text(kernel.format("", "helper", value))
        (toy / "geometry" / "reader.py").write_text(f"VALUE = {value}\n")
        for new in (True, False):
            got = subprocess.run([sys.executable, "-c", command], cwd=tmp_path, capture_output=True, text=True,
                                 check=True)
            assert got.stdout.split() == [str(value), str(new)]
    assert kernels.made_of(toy) == {toy / "geometry" / f"{name}.py" for name in ("caller", "helper")}
    (toy / "geometry" / "helper.py").write_text("from xfemnav.geometry import (\n    reader,\n)\n" + kernel.format(
        "", "helper", "reader.VALUE"))
    assert toy / "geometry" / "reader.py" in kernels.made_of(toy), "a constant is frozen in a kernel"
    old, forgotten = (tmp_path / f"{kernels.NAME}{16 * letter}" for letter in "ab")
    for folder in (old, forgotten):
        folder.mkdir()
    os.utime(forgotten, (0, 0))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernels.settle_kernel_cache()
    assert old.exists() and not forgotten.exists()
    folders = list((toy / "__pycache__").glob(f"{kernels.NAME}*"))
    assert len(folders) == 2 and all(list(folder.rglob("*caller*.nbc")) for folder in folders)
    modules = [path for path in keys.PACKAGE.rglob("*.py") if "import njit" in path.read_text()]
    assert {path.relative_to(keys.PACKAGE).parts[0] for path in modules} == set(kernels.LAYERS)


def test_damaged_kernels_are_compiled_anew(tmp_path, monkeypatch):
    """A flipped bit in compiled code would be a crash of the interpreter, in every run until somebody looks."""
    toy = toy_package(tmp_path)
    (toy / "geometry" / "one.py").write_text("from numba import njit\n@njit(cache=True)\ndef one():\n    return 1\n")
    command = ("from xfemnav.pipeline.keeping.kernels import settle_kernel_cache; settle_kernel_cache()\n"
               "from xfemnav.geometry.one import one; print(one(), sum(one.stats.cache_hits.values()))")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def run():
        return subprocess.run([sys.executable, "-c", command], cwd=tmp_path, capture_output=True, text=True,
                              check=True).stdout.split()

    assert run() == ["1", "0"] and run() == ["1", "1"]
    folder, = (toy / "__pycache__").glob(f"{kernels.NAME}*")
    for pattern in ("*.nb[ic]", kernels.SEALED):
        for path in folder.rglob(pattern):
            data = bytearray(path.read_bytes())
            for at in range(len(data) // 3, len(data), 97):
                data[at] ^= 0x10
            path.write_bytes(data)
        assert run() == ["1", "0"], pattern
    assert run() == ["1", "1"]


def test_a_seal_holds_what_was_compiled(tmp_path, monkeypatch):
    """What is damaged while another process runs is not sealed by it; what nobody has sealed is not kept."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernels.settle_kernel_cache()
    folder = tmp_path / os.path.basename(os.environ["NUMBA_CACHE_DIR"])
    (folder / "geometry_1").mkdir(parents=True)
    sound, rotten, old, new = (folder / "geometry_1" / f"{name}.nbc" for name in ("sound", "rotten", "old", "new"))
    for path in (sound, rotten):
        path.write_bytes(b"compiled")
    kernels._seal(folder)
    before = rotten.stat()
    rotten.write_bytes(b"comqiled")
    os.utime(rotten, ns=(before.st_atime_ns, before.st_mtime_ns))
    kernels._seal(folder)  # at the end of a process that began before
    for path, age in ((old, 2 * kernels.UNSEALED_S), (new, 0)):
        path.write_bytes(b"compiled")
        os.utime(path, (time.time() - age,) * 2)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernels.settle_kernel_cache()
    assert {path.stem for path in folder.rglob("*.nbc")} == {"sound", "new"}
    sound.write_bytes(b"compiled again")
    kernels._seal(folder)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernels.settle_kernel_cache()
    assert {path.stem for path in folder.rglob("*.nbc")} == {"sound", "new"}


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


@pytest.mark.parametrize("suffix", [".h5", ".nrrd", ".nii.gz"])
def test_transforms_of_every_kind_say_the_same(opened, tmp_path, suffix):
    """Places of now go to where they rested, and with "forward" back: as the tissue does, to the bending of a pixel."""
    points = np.array([[20.0, 10.0], [0.0, -30.0], [-20.0, 25.0], [10.0, 0.0]])
    current = opened.to_current(points)
    flip, frame = np.array([-1.0, -1, 1]), opened.frame
    for direction, here, there in (("backward", current, points), ("forward", points, current)):
        path = tmp_path / f"{direction}{suffix}"
        opened.write_transform(path, direction=direction)
        if suffix == ".h5":
            transform = sitk.ReadTransform(path)
        else:
            transform = sitk.DisplacementFieldTransform(sitk.ReadImage(path, sitk.sitkVectorFloat64))
        found = [transform.TransformPoint((world * flip).tolist()) for world in frame.to_world(here)]
        # |u| is 2 mm and its strain .1 over elements of 4 mm and more: a 2 mm pixel that a kink crosses is off by .05
        assert np.abs(np.array(found) * flip - frame.to_world(there)).max() < 0.05
    with pytest.raises(xfemnav.XfemnavError, match=r"E780.*\.h5, \.nrrd, \.nii\.gz"):
        opened.write_transform(tmp_path / "t.txt")
    with pytest.raises(xfemnav.XfemnavError, match="E502"):
        opened.write_transform(tmp_path / "nowhere" / f"t{suffix}")


def test_a_side_is_left_or_right():
    assert [result.side_number(side) for side in ("left", "right", 1, None)] == [1, -1, 1, None]
    with pytest.raises(xfemnav.XfemnavError, match="E780 side is 'up'"):
        result.side_number("up")
