"""Volumes: where voxels lie does not depend on how the file counts them; what is written lies on what was read."""

from itertools import permutations

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from xfemnav.errors import XfemnavError
from xfemnav.imaging.frames.slices import to_nifti, values_on
from xfemnav.imaging.frames.volume import take_volume
from xfemnav.imaging.reading.gate import Image, read_image

SHAPE = (7, 6, 5)
VALUES = np.arange(np.prod(SHAPE), dtype=np.int16).reshape(SHAPE)
AFFINE = np.eye(4)
AFFINE[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix() * (1.0, 1.5, 2.0)
AFFINE[:3, 3] = -20, 13, 5
ORDERS = [(order, flips) for order in permutations(range(3)) for flips in np.ndindex(2, 2, 2)]


def stored(order=(0, 1, 2), flips=(0, 0, 0), affine=AFFINE):
    """The image as another program counts its voxels: axes in an `order`, and `flips` of those that are turned."""
    turn = np.eye(4)[:, [*order, 3]]
    values = VALUES.transpose(order)
    for axis in np.flatnonzero(flips):
        values, last = np.flip(values, axis), values.shape[axis] - 1
        turn[:3, 3] += turn[:3, axis] * last
        turn[:, axis] *= -1
    return np.ascontiguousarray(values), affine @ turn


def read(tmp_path, values, affine, name="image.nii"):
    nibabel.save(nibabel.Nifti1Image(values, affine), tmp_path / name)
    return read_image(tmp_path / name)


@pytest.mark.parametrize("order, flips", ORDERS)
def test_all_48_storage_orders_have_the_same_voxels_at_the_same_places(tmp_path, order, flips):
    image = read(tmp_path, *stored(order, flips))
    volume = take_volume(image)
    assert volume.values is image.values and volume.thickness == 0
    centres, wanted = volume.pixel_centres().reshape(-1, 3), take_volume(read(tmp_path, VALUES, AFFINE)).pixel_centres()
    by_value = np.empty_like(centres)
    by_value[volume.values.ravel().astype(int)] = centres
    assert_allclose(by_value, wanted.reshape(-1, 3), atol=1e-4)    # the header is float32
    assert_allclose(np.sort(volume.spacing), [1, 1.5, 2], rtol=1e-6)
    assert_allclose(volume.voxels_to_world([[1, 2, 3]])[0], volume.pixel_centres()[1, 2, 3])


@pytest.mark.parametrize("order, flips", ORDERS[::5])
def test_another_storage_order_of_one_grid_is_put_in_its_own(tmp_path, order, flips):
    volume = take_volume(read(tmp_path, *stored(order, flips)))
    image = read(tmp_path, VALUES, AFFINE)
    assert_array_equal(values_on(image, volume), volume.values)
    for axis in range(4):
        affine = AFFINE.copy()
        affine[min(axis, 2), 3 if axis == 3 else axis] += 0.3
        refused(read(tmp_path, VALUES, affine), volume)
    refused(read(tmp_path, VALUES[:-1], AFFINE), volume)


def refused(image, volume):
    with pytest.raises(XfemnavError) as error:
        values_on(image, volume)
    assert error.value.code == "E204"


def test_the_other_frame_that_makes_grids_one_is_named(tmp_path):
    header = nibabel.Nifti1Header()
    header.set_sform(np.diag([1, 1.5, 2, 1]), 2)
    header.set_qform(AFFINE, 3)
    nibabel.save(nibabel.Nifti1Image(VALUES, None, header), tmp_path / "two.nii")
    one = nibabel.Nifti1Image(VALUES, AFFINE)
    one.set_qform(AFFINE, 3)
    nibabel.save(one, tmp_path / "one.nii")
    with pytest.raises(XfemnavError, match='nifti_frame="qform"'):
        values_on(read_image(tmp_path / "one.nii"), take_volume(read_image(tmp_path / "two.nii")))


@pytest.mark.parametrize("how", ["nearest", "linear"])
def test_another_grid_is_resampled_and_ends_where_it_ends(tmp_path, how):
    """A ramp in the world is the same ramp on a grid turned against it."""
    slope, coarse = np.array([1.0, -2, 0.5]), AFFINE.copy()
    coarse[:3, :3] = AFFINE[:3, :3] @ Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix() * 0.8
    image = take_volume(read_of(VALUES))
    ramp = image.pixel_centres() @ slope
    volume = take_volume(Image(np.zeros((9, 8, 7)), coarse, "f8", 1, "", "other"))
    found = values_on(Image(ramp, AFFINE, "f8", 1, "", "ramp"), volume, resample=how)
    voxels = (volume.pixel_centres() - AFFINE[:3, 3]) @ np.linalg.inv(AFFINE[:3, :3]).T
    nearest = np.rint(voxels)
    there = ((nearest >= 0) & (nearest < SHAPE)).all(axis=-1)
    assert there.any() and not there.all()
    if how == "nearest":
        assert_array_equal(found[there], ramp[tuple(nearest[there].T.astype(int))])
    inner = there & ((voxels >= 0) & (voxels <= np.array(SHAPE) - 1)).all(axis=-1)
    off = abs(found - volume.pixel_centres() @ slope)[inner]
    assert off.max() < (1e-6 if how == "linear" else abs(slope @ AFFINE[:3, :3]).sum() / 2)
    assert (found[~there] == 0).all()


def test_points_are_of_the_world_and_none_is_off():
    volume = take_volume(read_of(VALUES))
    points = np.array([[1.0, 2, 3], [np.nan, 0, 0]])
    assert_array_equal(volume.to_world(points), points)
    assert_array_equal(volume.from_world(points)[0], points)
    assert_array_equal(volume.from_world(points)[1], 0)
    assert_array_equal(volume.axes, np.eye(3))


def read_of(values):
    return Image(values, AFFINE, "int16", 1, "", "it")


def test_it_is_written_with_the_frames_that_it_was_read_with(tmp_path):
    header = nibabel.Nifti1Header()
    header.set_sform(AFFINE, 2)
    header.set_qform(np.diag([1, 1.5, 2, 1]), 3)
    nibabel.save(nibabel.Nifti1Image(VALUES, None, header), tmp_path / "two.nii")
    volume = take_volume(read_image(tmp_path / "two.nii"))
    written = to_nifti(volume, volume.values, np.int16)
    assert (int(written.header["sform_code"]), int(written.header["qform_code"])) == (2, 3)
    assert_allclose(written.get_sform(), AFFINE, atol=1e-5)
    assert_allclose(written.get_qform(), np.diag([1, 1.5, 2, 1]), atol=1e-5)
    assert_array_equal(np.asanyarray(written.dataobj), VALUES)


@pytest.mark.parametrize("name", ["image.mgz", "image.nrrd"])
def test_other_formats_have_their_voxels_at_the_same_places(tmp_path, name):
    if name.endswith("mgz"):
        nibabel.save(nibabel.MGHImage(VALUES, AFFINE), tmp_path / name)
    else:
        image = sitk.GetImageFromArray(VALUES.transpose(2, 1, 0))
        lps = np.diag([-1.0, -1, 1]) @ AFFINE[:3]
        spacing = np.linalg.norm(lps[:, :3], axis=0)
        image.SetSpacing(spacing.tolist())
        image.SetOrigin(lps[:, 3].tolist())
        image.SetDirection((lps[:, :3] / spacing).ravel().tolist())
        sitk.WriteImage(image, tmp_path / name)
    volume = take_volume(read_image(tmp_path / name))
    assert_allclose(volume.affine, AFFINE, atol=1e-4)
    assert_array_equal(volume.values, VALUES)
    assert_allclose(to_nifti(volume, VALUES).affine, AFFINE, atol=1e-4)


def test_one_slice_is_no_volume():
    with pytest.raises(XfemnavError) as error:
        take_volume(read_of(VALUES[:, :1]))
    assert error.value.code == "E105"
