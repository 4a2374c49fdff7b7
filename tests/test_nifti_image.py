"""NIfTI headers beside nibabel's: the same frames are read, the same bytes are written."""

import nibabel as nib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from xfemnav.imaging.nifti_header import FIELDS, best_affine, quaternion, rotation, unpacked
from xfemnav.imaging.nifti_image import VECTOR, NiftiImage

HEADERS = {348: nib.Nifti1Header, 540: nib.Nifti2Header}
SIZES = st.tuples(*[st.floats(0.2, 5)] * 3)
ANGLES = st.tuples(*[st.one_of(st.floats(-180, 180), st.sampled_from([-90, 0, 90, 180]))] * 3)


def affine_of(angles, sizes, flip):
    """A turned and maybe mirrored frame (4, 4), its first voxel off the origin."""
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() * sizes * [1, 1, -1 if flip else 1]
    affine[:3, 3] = -71.3, 12.25, 40
    return affine


@pytest.mark.parametrize("length", FIELDS)
def test_the_fields_are_those_of_nibabel(length):
    theirs = HEADERS[length]().structarr.dtype
    assert FIELDS[length].itemsize == length and FIELDS[length].names == theirs.names
    assert {name: FIELDS[length].fields[name][1] for name in theirs.names} == {
        name: theirs.fields[name][1] for name in theirs.names}


@settings(max_examples=100, deadline=None)
@given(ANGLES, SIZES, st.booleans(), st.sampled_from([348, 540]), st.sampled_from("<>"), st.sampled_from("sq-"),
       st.integers(1, 4))
def test_a_frame_is_read_as_nibabel_reads_it(angles, sizes, flip, length, order, form, n_axes):
    header = HEADERS[length](endianness=order)
    header.set_data_shape((7, 5, 3, 2)[:n_axes])
    header["pixdim"][1:4] = sizes
    if form != "-":
        (header.set_sform if form == "s" else header.set_qform)(affine_of(angles, sizes, flip), 1)
    raw = unpacked(header.binaryblock + bytes(9), length, order)
    assert np.array_equal(best_affine(raw), header.get_best_affine())


@pytest.mark.parametrize("field, value", [("pixdim", -1), ("pixdim", 0.5), ("quatern_b", 1.2)])
def test_a_qform_that_is_none_is_refused(field, value):
    header = nib.Nifti1Header()
    header.set_qform(np.eye(4), 1)
    if field == "pixdim":
        header[field][1 if value < 0 else 0] = value
    else:
        header[field] = value
    with pytest.raises((ValueError, nib.spatialimages.HeaderDataError)):
        header.get_best_affine()
    with pytest.raises(ValueError, match="should be"):
        best_affine(unpacked(header.binaryblock, 348, "<"))


@settings(max_examples=100, deadline=None)
@given(ANGLES)
def test_quaternion_and_rotation_undo_each_other(angles):
    """The eigenvectors of a 4 x 4 matrix, a few roundings of numbers up to 1."""
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    q = quaternion(R)
    assert q[0] >= 0
    np.testing.assert_allclose(rotation(*q), R, rtol=0, atol=1e-14)
    np.testing.assert_allclose(rotation(*(3 * q)), R, rtol=0, atol=1e-14)


@settings(max_examples=60, deadline=None)
@given(ANGLES, SIZES, st.booleans(), st.sampled_from([np.uint8, np.int16, np.int64, np.float32, np.float64]),
       st.sampled_from([(4, 5, 1), (1, 5, 3), (4, 1, 3, 1, 3)]))
def test_the_bytes_are_those_that_nibabel_writes(angles, sizes, flip, dtype, shape):
    affine = affine_of(angles, sizes, flip)
    values = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    theirs = nib.Nifti1Image(values, affine, dtype=dtype)
    theirs.set_sform(affine, 2)
    theirs.set_qform(affine, 2)
    theirs.header.set_xyzt_units("mm")
    if len(shape) == 5:
        theirs.header.set_intent("vector")
    ours = NiftiImage(values, affine, 2, VECTOR if len(shape) == 5 else 0)
    assert ours.to_bytes() == theirs.to_bytes()
    assert np.array_equal(ours.as_nibabel().get_fdata(), values)


def test_tilted_slices_have_no_qform():
    affine = affine_of((0, 0, 0), (1, 1, 3), False)
    affine[1, 2] = 1.2
    header = NiftiImage(np.zeros((3, 4, 1), np.uint8), affine, 2).as_nibabel().header
    assert int(header["qform_code"]) == 0 and int(header["sform_code"]) == 2
