"""A real brain with what belongs to it through one run: MNI152 T1, its grey and white matter, a motor t-map of 3 mm.

All of it comes with nilearn, and is carried from where the tissue rested: the run's own field says where, and scipy
looks there in the arrays that nibabel reads. The same volume as .mgz and as a DICOM series gives the same run.
"""

import json
from pathlib import Path

import nibabel as nib
import nilearn
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from small import xfemnav

from tests.images import image_of
from tests.test_dicom import write_series
from xfemnav.imaging.points.point_files import PointSet, read_points, write_points
from xfemnav.pipeline.running.demo import CUT, LIPS, SLICE

DATA = Path(nilearn.__file__).parent / "datasets" / "data"
T1, GREY, WHITE = (DATA / f"mni_icbm152_{kind}_tal_nlin_sym_09a_converted.nii.gz" for kind in ("t1", "gm", "wm"))
MOTOR = DATA / "image_10426.nii.gz"
COARSE = ("--element-size-mm", 6, "--corridor-element-mm", 2, "--no-report")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with tissue classes, the places of the t-map's five highest voxels, and the T1 in three formats."""
    folder = tmp_path_factory.mktemp("mni")
    t1, grey, white, motor = (nib.load(path) for path in (T1, GREY, WHITE, MOTOR))
    classes = np.select([np.asarray(white.dataobj) > 127, np.asarray(grey.dataobj) > 127], [2, 1], 0)
    nib.save(nib.Nifti1Image(classes.astype(np.uint8), white.affine), folder / "classes.nii.gz")
    nib.save(nib.MGHImage(np.asarray(t1.dataobj).astype(np.uint8), t1.affine), folder / "t1.mgz")
    write_series(image_of(np.asarray(t1.dataobj), t1.affine), folder / "series", dtype="u1")
    write_points(folder / "peaks.mrk.json", PointSet("Fiducial", "peaks", peaks(motor), ("",) * 5))
    return folder


def peaks(image):
    """Places (5, 3) RAS mm of the highest voxels of a map in the run's slice, inside the brain."""
    values, k = image.get_fdata(), round((SLICE["slice_mm"] - image.affine[2, 3]) / image.affine[2, 2])
    highest = np.argsort(values[4:-4, 4:-4, k].ravel())[-5:]
    ij = np.column_stack(np.unravel_index(highest, (values.shape[0] - 8, values.shape[1] - 8))) + 4
    world = np.column_stack([ij, np.full(5, k)]) @ image.affine[:3, :3].T + image.affine[:3, 3]
    return np.column_stack([world[:, :2], np.full(5, SLICE["slice_mm"])])


@pytest.fixture
def run(home, capfd, monkeypatch):
    """Run the command on one of the images: the record, and its outputs by role."""
    monkeypatch.chdir(home)

    def command(image, *flags):
        name = Path(image).name.split(".")[0]
        code, stdout, stderr = xfemnav(
            capfd, "run", image, "--slice-mm", SLICE["slice_mm"], "--cut", CUT["cut"][0], "--left", LIPS["left"],
            f"--right={LIPS['right']}", *COARSE, *flags, "-o", f"out-{name}", "-w", "cache", "--json")
        assert code == 0, stderr
        record = json.loads(stdout)
        return record, {role: home / f"out-{name}" / file for role, file in record["outputs"].items()}

    return command


@pytest.fixture
def carried(run):
    """The run with everything that is carried along."""
    return run(T1, "--companion", GREY, "--companion", WHITE, "--companion", MOTOR, "--companion",
               "label=classes.nii.gz", "--points", "peaks.mrk.json")


def resting_places(files):
    """For each pixel of the updated slice, world RAS mm (ni, nj, 3) where its tissue rested, by the field's file."""
    field = nib.load(files["field"])
    ij = np.moveaxis(np.indices(field.shape[:2]), 0, -1)
    world = ij @ field.affine[:3, :2].T + field.affine[:3, 3]
    return world + field.get_fdata()[:, :, 0, 0, :] * (-1, -1, 1)  # vectors are LPS


def looked_up(path, places, order):
    """Values of a volume at world places, by scipy; 0 beyond its voxels."""
    volume = nib.load(path)
    voxels = (places - volume.affine[:3, 3]) @ np.linalg.inv(volume.affine[:3, :3]).T
    return map_coordinates(volume.get_fdata(), np.moveaxis(voxels, -1, 0), order=order, mode="constant")


def test_everything_comes_from_where_the_tissue_rested(carried, home):
    _, files = carried
    cavity = nib.load(files["cavity"]).get_fdata()[:, :, 0] > 0
    places = resting_places(files)
    shift = np.linalg.norm(nib.load(files["field"]).get_fdata(), axis=-1)[:, :, 0, 0]
    tissue = shift > 0.1
    assert tissue.sum() > 3000 and 40 < cavity.sum() < 400 and not (tissue & cavity).any()
    for role, path, order in (("updated", T1, 1), (f"companion:{GREY.name[:-7]}", GREY, 1),
                              (f"companion:{WHITE.name[:-7]}", WHITE, 1), ("companion:image_10426", MOTOR, 1),
                              ("companion:classes", home / "classes.nii.gz", 0)):
        found, wanted = nib.load(files[role]).get_fdata()[:, :, 0], looked_up(path, places, order)
        assert found.shape == (197, 233), role
        wrong = abs(found - wanted) > 2e-3 * abs(wanted).max()  # the field's float32, 1e-6 mm, at edges of 250 a mm
        if order:
            assert not wrong[tissue].any(), role
        else:
            assert wrong[tissue].mean() < 1e-3 and set(np.unique(found)) <= {0, 1, 2}  # half-way between two voxels
        assert (found[cavity] == 0).all(), role
    assert nib.load(files["companion:classes"]).get_data_dtype() == np.uint8


def test_peaks_of_the_map_go_with_the_map(carried, home):
    """At a landmark's new place the carried map has what the map had at its old one: both are linear between voxels
    of 3 mm and pixels of 1 mm, so they differ by the second difference of the 1 mm image, a tenth at a peak."""
    record, files = carried
    assert record["points"][0]["tissue"] == 5
    now = read_points(files["points"]).points
    before, after = looked_up(MOTOR, peaks(nib.load(MOTOR)), 1), looked_up(files["companion:image_10426"], now, 1)
    assert before.min() > 1 and abs(after / before - 1).max() < 0.1
    assert np.linalg.norm(now - peaks(nib.load(MOTOR)), axis=1).max() > 0.01


@pytest.mark.parametrize("other", ["t1.mgz", "series"])
def test_other_formats_give_the_same_run(carried, run, other):
    record, files = carried
    again, others = run(other)
    assert again["input"]["dtype"] == ("uint8" if other == "t1.mgz" else "float64")
    for role in ("updated", "cavity", "field", "mask"):
        one, two = (nib.as_closest_canonical(nib.load(found[role])) for found in (files, others))
        np.testing.assert_allclose(two.affine, one.affine, atol=1e-5)
        here, there = one.get_fdata(), two.get_fdata()
        assert abs(here - there).max() <= 1e-4 * abs(here).max(), role
    for key in ("max_displacement_mm", "cavity_mm2"):
        assert again["checks"][key] == pytest.approx(record["checks"][key], rel=1e-4)
