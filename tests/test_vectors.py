"""Fields as images: NRRD and NIfTI are read by ITK as the field they were written from, in every storage order."""

import time

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from numpy.testing import assert_allclose, assert_array_equal

from tests.motions import GRID, MIXED, MOVED, REST, SCENES, THICKNESS, landing, slice_in
from tests.test_transform import EXACT, FIELDS, MOTION, carried
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.transform import forward
from xfemnav.imaging.carrying.vectors import field_nifti, vector_nifti, write_nrrd


def itk_field(path) -> sitk.DisplacementFieldTransform:
    """The transform of a field in a file, as any program on ITK makes it."""
    return sitk.DisplacementFieldTransform(sitk.ReadImage(str(path), sitk.sitkVectorFloat64))


def write(path, slice, field):
    if path.suffix == ".nrrd":
        write_nrrd(path, slice, field, "resampling")
    else:
        nib.save(field_nifti(slice, field), path)
    return path


@pytest.mark.parametrize("ending", [".nrrd", ".nii"])
@pytest.mark.parametrize("scene", SCENES, ids=str)
def test_itk_looks_where_the_tissue_of_each_pixel_rested(scene, ending, tmp_path):
    slice = slice_in(*scene)
    for field in FIELDS.values():
        found = landing(slice, itk_field(write(tmp_path / f"field{ending}", slice, field)), tmp_path)
        assert_allclose(found[MOTION.tissue], MOTION.resting[MOTION.tissue], atol=EXACT)


@pytest.mark.parametrize("ending", [".nrrd", ".nii"])
def test_points_half_a_slice_off_the_plane_are_carried(ending, tmp_path):
    slice = slice_in("coronal", 15, MIXED)
    transform = itk_field(write(tmp_path / f"field{ending}", slice, FIELDS["bridged"]))
    pixels = np.array([[50, 60], [70, 90], [30, 100]])
    points = GRID.origin + GRID.spacing * pixels
    for off in (0, 0.5, -0.5):
        assert_allclose(carried(transform, slice, points, off * THICKNESS),
                        points + FIELDS["bridged"][tuple(pixels.T)], atol=EXACT)


def test_slicers_words_are_in_the_header(tmp_path):
    """A field of old points is "modeling": 3D Slicer takes it for the way from old to new and not the other."""
    slice, field = slice_in("sagittal", 25, MIXED), forward(slice_in(), Motion(REST, MOVED))
    write_nrrd(tmp_path / "f.nrrd", slice, field, "modeling")
    header = (tmp_path / "f.nrrd").read_bytes().split(b"\n\n")[0].decode().splitlines()
    assert "space: left-posterior-superior" in header and "kinds: vector domain domain domain" in header
    assert "displacement field type:=modeling" in header
    pixels = np.array([[40, 70], [70, 90]])
    points = GRID.origin + GRID.spacing * pixels
    assert_allclose(carried(itk_field(tmp_path / "f.nrrd"), slice, points), points + field[tuple(pixels.T)], atol=EXACT)
    with pytest.raises(ValueError, match="modeling"):
        write_nrrd(tmp_path / "f.nrrd", slice, field, "forward")


def test_the_nifti_has_the_pixels_of_the_input_and_its_slice_in_the_middle():
    slice = slice_in("coronal", 15, MIXED)
    image = field_nifti(slice, FIELDS["bridged"])
    one = vector_nifti(slice, FIELDS["bridged"] @ slice.axes[:2])
    axis = slice.array_axes[2]
    data = np.asarray(image.dataobj)
    assert image.header["intent_code"] == 1007 and data.shape[axis] == 3 and data.shape[3:] == (1, 3)
    for k in range(3):
        assert_array_equal(data.take([k], axis), np.asarray(one.dataobj))
    middle = np.zeros(4)
    middle[[axis, 3]] = 1
    assert_allclose(image.affine @ middle, one.affine @ [0, 0, 0, 1], atol=1e-4)


def test_nitransforms_reads_the_nifti(tmp_path):
    itk = pytest.importorskip("nitransforms.io.itk")
    nonlinear = pytest.importorskip("nitransforms.nonlinear")
    slice = slice_in("sagittal", 25, MIXED)
    image = itk.ITKDisplacementsField.from_image(field_nifti(slice, FIELDS["bridged"]))
    world = slice.to_world(slice.pixel_centres()[MOTION.tissue])
    assert_allclose(nonlinear.DenseFieldTransform(image).map(world), slice.to_world(MOTION.resting[MOTION.tissue]),
                    atol=EXACT)


def test_the_same_field_gives_the_same_bytes(tmp_path):
    a = write(tmp_path / "a.nrrd", slice_in(), FIELDS["bridged"]).read_bytes()
    time.sleep(1.1)    # gzip counts seconds
    assert write(tmp_path / "b.nrrd", slice_in(), FIELDS["bridged"]).read_bytes() == a
    first, second = (field_nifti(slice_in(), FIELDS["bridged"]).to_bytes() for _ in range(2))
    assert first == second
