"""The motion as an ITK transform: gaps bridged or extended, points carried as the warp carries pixels, same bytes."""

import time

import numpy as np
import pytest
import SimpleITK as sitk
from numpy.testing import assert_allclose, assert_array_equal

from data_synthetic import files
from data_synthetic.phantom import Grid, Phantom, perfect_solution
from xfemnav.imaging.hdf5 import without_times
from xfemnav.imaging.reading import read_image
from xfemnav.imaging.slices import take_slice
from xfemnav.imaging.transform import LPS, NOWHERE, bridged, extended, itk_transform, write_transform
from xfemnav.imaging.warp import covered, pull_back, sample

GRID = Grid((100, 130), (2.0, 1.6), "LAS", slope=0.05)


@pytest.fixture(scope="module")
def phantom():
    return Phantom(grid=GRID)


@pytest.fixture(scope="module")
def motion(phantom):
    return pull_back(*perfect_solution(phantom, 360, 30), GRID.origin, GRID.spacing, GRID.shape)


@pytest.fixture(scope="module")
def empty(phantom, motion):
    rest, _ = perfect_solution(phantom, 360, 30)
    return covered(rest, GRID.origin, GRID.spacing, GRID.shape) & ~motion.tissue


def taken(phantom, folder, oblique=0.0):
    """The phantom's slice read back from its file."""
    return take_slice(read_image(files.write(phantom, folder, oblique=oblique)["image"]))


def test_the_bridge_is_linear_across_a_straight_gap():
    """A strip moved up beyond a strip at rest: between them the field goes from one to the other in equal steps."""
    low = np.array([[[-1, -1], [30, -1], [30, 9.5]], [[-1, -1], [30, 9.5], [-1, 9.5]]], float)
    high = low * (1, -1) + np.array([0, 19.0])
    rest, moved = np.concatenate([low, high]), np.concatenate([low, high + np.array([0, 4.0])])
    pulled = pull_back(rest, moved, np.zeros(2), np.ones(2), (20, 20))
    empty = ~pulled.tissue
    field = bridged(pulled, empty)
    assert_array_equal(np.flatnonzero(empty[7]), [10, 11, 12, 13])
    assert_allclose(field[7, 9:15, 1], [0, -0.8, -1.6, -2.4, -3.2, -4], atol=1e-12)
    assert_array_equal(field[~empty], pulled.field[~empty])


def test_a_bridge_stays_between_its_ends(motion, empty):
    field = bridged(motion, empty)
    assert np.isfinite(field).all()
    for k in range(2):
        assert field[..., k].min() >= motion.field[..., k].min() - 1e-12
        assert field[..., k].max() <= motion.field[..., k].max() + 1e-12


def test_nothing_to_bridge(motion):
    assert_array_equal(bridged(motion, np.zeros(GRID.shape, bool)), motion.field)


def test_tissue_is_extended_by_one_pixel_and_no_more(motion, empty):
    field = extended(motion, empty)
    away = np.abs(field).max(axis=-1) == NOWHERE
    assert not away[~empty].any() and away.any()
    ring = np.zeros_like(empty)
    padded = np.pad(motion.tissue, 1)
    for i, j in np.ndindex(3, 3):
        ring |= padded[i:i + empty.shape[0], j:j + empty.shape[1]]
    assert_array_equal(away, empty & ~ring)
    assert_array_equal(field[~empty], motion.field[~empty])


@pytest.mark.parametrize("oblique", [0.0, 30.0])
def test_itk_resamples_as_the_warp_does(phantom, motion, empty, tmp_path, oblique):
    slice = taken(phantom, tmp_path, oblique)
    image = sitk.ReadImage(str(tmp_path / "sub-phantom_T1w.nii.gz"), sitk.sitkFloat64)
    transform = itk_transform(slice, extended(motion, empty))
    theirs = sitk.GetArrayFromImage(sitk.Resample(image, transform, sitk.sitkLinear, 0.0))[0].T[::-1]    # LAS
    ours = sample(slice.values, slice.origin, slice.spacing, slice.pixel_centres() + motion.field)
    # headers hold float32: 1e-5 mm at 100 mm, where the image changes by some 500 a mm
    assert_allclose(theirs[motion.tissue], ours[motion.tissue], atol=5e-3)
    deep = np.abs(extended(motion, empty)).max(axis=-1) == NOWHERE
    assert (theirs[deep] == 0).all()


def test_the_file_carries_points_and_has_the_same_bytes(phantom, motion, empty, tmp_path):
    slice, field = taken(phantom, tmp_path), bridged(motion, empty)
    write_transform(tmp_path / "a.h5", slice, field)
    time.sleep(1.1)    # HDF5 counts seconds
    write_transform(tmp_path / "b.h5", slice, field)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    transform = sitk.ReadTransform(str(tmp_path / "a.h5"))
    assert transform.GetName() == "CompositeTransform"
    for i, j in ((50, 60), (70, 90), (30, 100)):
        point = slice.to_world((slice.origin + slice.spacing * (i, j))[None])[0]
        wanted = point + field[i, j] @ slice.axes[:2]
        assert_allclose(LPS * transform.TransformPoint((LPS * point).tolist()), wanted, atol=1e-9)


def test_letters_without_a_checksum_are_left_alone():
    data = b"\x89HDF" + b"OHDR\x02\x20" + bytes(range(80))
    assert without_times(data) == data
    assert without_times(data[:12]) == data[:12]
