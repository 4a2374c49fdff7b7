"""Slices and frames. Most tests rest on one law: a slice of a function of world position shows that function."""

import nibabel
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from tests.images import ORDERS, affine_of, image_of, stored
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.frames.slices import PLANES, plane_points, take_slice, to_nifti, values_on
from xfemnav.imaging.organ.masks import clean
from xfemnav.imaging.reading.gate import read_image

GRADIENT = np.array([3.0, -5.0, 0.7])
TILT = Rotation.from_euler("xyz", (20, -15, 12), degrees=True).as_matrix()


def ramp(shape=(7, 9, 5), affine=None, f=lambda world: world @ GRADIENT):
    """Image whose voxels hold f(world position)."""
    affine = affine_of(TILT * [0.8, 1.3, 2.1]) if affine is None else affine
    world = np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
    return image_of(f(world), affine)


def assert_shows(slice, f=lambda world: world @ GRADIENT):
    """Every pixel of the slice holds f at the world position that the slice gives it."""
    np.testing.assert_allclose(slice.values, f(slice.to_world(slice.pixel_centres())), atol=1e-10)


def code_of(call, *args, **kwargs) -> str:
    with pytest.raises(XfemnavError) as failure:
        call(*args, **kwargs)
    return failure.value.code


def saved(folder, values, affine, name="mask.nii"):
    nibabel.Nifti1Image(values, affine).to_filename(folder / name)
    return folder / name


# Frames ---------------------------------------------------------------------------------------------------------------

def test_plane_coordinates_of_an_unrotated_image_are_world_coordinates():
    image = ramp(affine=affine_of(np.diag([0.8, 1.3, 2.1])))
    for plane, (first, second, normal) in PLANES.items():
        slice = take_slice(image, plane=plane, index=2)
        np.testing.assert_array_equal(slice.axes, np.eye(3)[[first, second, normal]])
        np.testing.assert_array_equal(slice.origin, image.affine[[first, second], 3])
        np.testing.assert_allclose(slice.offset, image.affine[normal, 3] + 2 * image.affine[normal, normal])


@pytest.mark.parametrize("plane", PLANES)
def test_every_storage_order_gives_the_same_slice(plane):
    truth = take_slice(ramp(), plane=plane, position_mm=take_slice(ramp(), plane=plane, index=1).offset + 0.1)
    assert_shows(truth)
    for order, flips in ORDERS:
        slice = take_slice(stored(ramp(), order, flips), plane=plane, position_mm=truth.offset + 0.1)
        for name in ("values", "origin", "spacing", "axes", "offset", "thickness"):
            np.testing.assert_allclose(getattr(slice, name), getattr(truth, name), atol=1e-12, err_msg=name)
        assert slice.plane == plane


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-40, 40)] * 3), st.sampled_from(ORDERS), st.sampled_from(sorted(PLANES)),
       st.tuples(*[st.floats(0.2, 4)] * 3))
def test_a_slice_shows_its_place_in_any_oblique_image(angles, order, plane, spacing):
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    image = stored(ramp(affine=affine_of(rotation * spacing)), *order)
    slice = take_slice(image, plane=plane, index=1)
    assert_shows(slice)
    np.testing.assert_allclose(slice.axes @ slice.axes.T, np.eye(3), atol=1e-12)
    # "nearest to +R, +A, +S" is a matching of all three axes; under 40 degree turns each one still points forwards.
    assert (np.diag(slice.axes[:, list(PLANES[plane])]) > 0).all()


def test_a_tilted_gantry_is_no_shear_of_the_slice():
    linear = np.diag([1.0, 1.0, 3.0])
    linear[1, 2] = 1.2  # each slice is shifted along A, as CT with a tilted gantry stores it
    slice = take_slice(ramp(affine=affine_of(linear)), index=3)
    assert_shows(slice)
    assert slice.thickness == pytest.approx(3.0)
    header = to_nifti(slice, slice.values).header
    assert int(header["qform_code"]) == 0 and int(header["sform_code"]) == 2  # no quaternion holds a tilt


def test_sheared_pixels_are_refused_and_rounding_is_not():
    linear = np.eye(3)
    linear[0, 1] = 0.05
    assert code_of(take_slice, ramp(affine=affine_of(linear)), index=0) == "E111"
    linear[0, 1] = 3e-4
    slice = take_slice(ramp(affine=affine_of(linear)), index=0)
    assert abs(slice.axes[0] @ slice.axes[1]) < 1e-9
    truth = slice.to_world(slice.pixel_centres()) @ GRADIENT
    assert abs(slice.values - truth).max() < 3e-4 * 9 * np.linalg.norm(GRADIENT)  # the skew times the extent


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-100, 100)] * 2), min_size=1, max_size=5), st.sampled_from(sorted(PLANES)))
def test_world_and_plane_are_inverse(points, plane):
    slice = take_slice(ramp(), plane=plane, index=2)
    world = slice.to_world(points)
    back, distance = slice.from_world(world + 0.7 * slice.axes[2])
    np.testing.assert_allclose(back, points, atol=1e-10)
    np.testing.assert_allclose(distance, 0.7, atol=1e-10)


@pytest.mark.parametrize("order, flips", ORDERS[::5])
def test_voxel_indices_are_those_of_the_file(order, flips):
    image = stored(ramp(), order, flips)
    slice = take_slice(image, plane="coronal", index=1)
    across = slice.array_axes[2]
    ijk = np.array([1, 1, 1])
    ijk[[a for a in range(3) if a != across]] = 2, 3
    plane, _ = slice.from_world(slice.voxels_to_world(np.delete(ijk, across)[None]))
    np.testing.assert_allclose(slice.from_world(slice.voxels_to_world(ijk[None]))[0], plane)
    pixel = np.rint((plane - slice.origin) / slice.spacing).astype(int)[0]
    assert slice.values[tuple(pixel)] == image.values[tuple(ijk)]


# Choosing a slice -----------------------------------------------------------------------------------------------------

def test_a_volume_needs_a_choice_that_exists():
    image = ramp(affine=affine_of(np.diag([1.0, 1.0, 2.0]), (0, 0, 10.0)))  # five axial slices at 10 .. 18 mm
    with pytest.raises(XfemnavError, match=r"E120 .* 5 axial slices; .* slice=0 to 4, or slice_mm=10 to 18"):
        take_slice(image)
    for wrong in ({"index": 5}, {"index": -1}, {"position_mm": 8.9}, {"position_mm": 19.1}, {"position_mm": np.nan},
                  {"plane": "coronal"}, {"plane": "sagittal", "index": 7}):
        assert code_of(take_slice, image, **wrong) == "E120"
    assert take_slice(image, position_mm=9.1).index == 0 and take_slice(image, position_mm=14.9).index == 2


def test_midway_between_two_slices_every_storage_order_takes_the_same():
    image = ramp(affine=affine_of(np.diag([1.0, 1.0, 2.0]), (0, 0, 10.0)))
    offsets = {take_slice(stored(image, *order), position_mm=13.0).offset for order in ORDERS}
    assert offsets == {14.0}


@pytest.mark.parametrize("plane, axis", [("sagittal", 0), ("coronal", 1), ("axial", 2)])
def test_one_slice_takes_its_own_plane(plane, axis):
    image = ramp()
    one = ramp(tuple(1 if k == axis else n for k, n in enumerate(image.values.shape)))
    for order, flips in ORDERS[::7]:
        slice = take_slice(stored(one, order, flips))
        assert slice.plane == plane
        assert_shows(slice)
    assert code_of(take_slice, one, plane=next(p for p in PLANES if p != plane)) == "E120"
    assert code_of(take_slice, one, position_mm=take_slice(one).offset + 5) == "E120"


def test_a_line_of_voxels_is_no_slice():
    assert code_of(take_slice, ramp((7, 1, 1))) == "E105"


# Points of a user -----------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("plane, lps", [("axial", (-1, -1)), ("coronal", (-1, 1)), ("sagittal", (-1, 1))])
def test_points_in_every_space_are_the_same_place(plane, lps):
    image = ramp()
    slice = take_slice(image, plane=plane, index=2)
    voxels = np.array([[1.0, 2.0], [3.5, 4.0]])
    wanted, _ = slice.from_world(slice.voxels_to_world(voxels))
    world = slice.to_world(wanted)
    for space, points in (("voxel", voxels), ("voxel", np.insert(voxels, slice.array_axes[2], 2, axis=1)),
                          ("ras", wanted), ("ras", world), ("lps", wanted * lps), ("lps", world * [-1, -1, 1])):
        np.testing.assert_allclose(plane_points(slice, points, space), wanted, atol=1e-10)


def test_points_off_the_slice_are_refused_beyond_half_its_thickness():
    slice = take_slice(ramp(), index=2)
    point = slice.to_world([[1.0, 2.0], [3.0, 4.0]])
    point[1] += slice.axes[2] * slice.thickness * 0.49
    np.testing.assert_allclose(plane_points(slice, point), [[1, 2], [3, 4]], atol=1e-9)
    point[1] += slice.axes[2] * slice.thickness * 0.02
    with pytest.raises(XfemnavError, match=r"E307 point 2 .* 1\.07 mm off"):  # .51 of 2.1 mm
        plane_points(slice, point)
    for bad in ([[1.0]], [1.0, 2.0], [[np.nan, 1.0]], [[1, 2, 3, 4]]):
        assert code_of(plane_points, slice, bad) == "E780"


@pytest.mark.parametrize("points, words", [
    ([[-30, 0, 7], [30, 5, 7]], "one axial plane of the patient, which is at 20.0 degrees"),
    ([[-30, 0, 7], [0, 3, 7], [30, 5, 7]], "one axial plane of the patient, which is at 20.0 degrees"),
    ([[0, 4, -20], [3, 4, 30]], "one coronal plane of the patient, which is at 90.0 degrees"),
    ([[-30, 0, 0], [30, 10, 10]], "run at up to 29.0 degrees"),
    ([[-30, 0, 0], [30, 10, 10], [0, 30, 0]], "run at up to 33.0 degrees")])
def test_a_line_that_no_slice_can_hold_is_told_with_its_angle(points, words):
    """Slices turned by 20 degrees about the patient's front: a line drawn in an anatomical view leaves them."""
    turn = Rotation.from_euler("y", 20, degrees=True).as_matrix()
    slice = take_slice(ramp((40, 50, 9), affine_of(turn * [2, 2, 3], (-40, -50, 0))), index=4)
    with pytest.raises(XfemnavError, match="E307") as failure:
        plane_points(slice, points)
    assert words in str(failure.value) and "'Rotate to volume plane'" in str(failure.value)
    assert "Choose the slice" not in str(failure.value)


def test_the_slice_that_holds_a_line_is_named():
    slice = take_slice(ramp(), index=1)
    for steps in (2, -3):
        points = slice.to_world([[1.0, 2.0], [3.0, 4.0]]) + slice.axes[2] * slice.thickness * (steps + 0.2)
        with pytest.raises(XfemnavError, match=f"slice_mm={slice.offset + steps * slice.thickness:.4g}"):
            plane_points(slice, points)


# Writing --------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("plane", PLANES)
def test_a_written_slice_is_read_as_the_same_slice(tmp_path, plane):
    for order, flips in ORDERS[::3]:
        image = stored(ramp(), order, flips)
        slice = take_slice(image, plane=plane, index=1)
        written = to_nifti(slice, slice.values, np.float32)
        shape = list(image.values.shape)
        shape[slice.array_axes[2]] = 1
        assert written.shape == tuple(shape) and written.get_data_dtype() == np.float32
        np.testing.assert_allclose(written.affine[:3, :3], image.affine[:3, :3])
        written.to_filename(tmp_path / "slice.nii")
        again = take_slice(read_image(tmp_path / "slice.nii"))
        np.testing.assert_allclose(again.values, slice.values, rtol=1e-6)  # float32 voxels and affine
        for name in ("origin", "spacing", "axes", "offset", "thickness"):
            np.testing.assert_allclose(getattr(again, name), getattr(slice, name), atol=1e-5, err_msg=name)


def test_written_bytes_repeat_and_codes_are_kept():
    for code, wanted in ((4, 4), (0, 1)):
        image = image_of(ramp().values, ramp().affine, code=code)
        slice = take_slice(image, index=1)
        header = to_nifti(slice, slice.values > 0, np.uint8).header
        assert int(header["sform_code"]) == int(header["qform_code"]) == wanted
        assert to_nifti(slice, slice.values).to_bytes() == to_nifti(slice, slice.values).to_bytes()


# Other images on the slice --------------------------------------------------------------------------------------------

def test_values_of_the_same_grid_in_any_order_are_found():
    slice = take_slice(ramp(), plane="coronal", index=3)
    for order, flips in ORDERS[::5]:
        np.testing.assert_array_equal(values_on(stored(ramp(), order, flips), slice), slice.values)
    one = to_nifti(slice, slice.values, np.float64)
    np.testing.assert_allclose(values_on(image_of(one.get_fdata(), one.affine), slice), slice.values)


def test_linear_resampling_of_another_grid_is_exact_for_a_linear_image():
    slice = take_slice(ramp(), index=2)
    other = ramp((40, 40, 40), affine_of(1.1 * np.eye(3), np.array([-40.0, 10.0, -10.0])))
    np.testing.assert_allclose(values_on(other, slice, resample="linear"), slice.values, atol=1e-9)
    nearest = values_on(other, slice, resample="nearest")
    assert abs(nearest - slice.values).max() < abs(GRADIENT).sum() * 0.55 + 1e-9  # half a voxel along each axis
    far = ramp((3, 3, 3), affine_of(np.eye(3), (900.0, 0, 0)))
    assert (values_on(far, slice, resample="linear") == 0).all()


def test_other_grids_are_refused():
    image, slice = ramp(), take_slice(ramp(), index=2)
    shifted, scaled = image.affine.copy(), image.affine.copy()
    shifted[:3, 3] += 0.5
    scaled[:3, :3] *= 0.5
    for other in (image_of(image.values, shifted), image_of(image.values, scaled), ramp((7, 9, 2)), ramp((8, 9, 5)),
                  ramp((6, 9, 5)), ramp((14, 18, 10), affine_of(image.affine[:3, :3] / 2, image.affine[:3, 3]))):
        with pytest.raises(XfemnavError, match=r"E204 grids differ: image.nii.gz has .* voxels .* 7 x 9 pixels"):
            values_on(other, slice)
    nudged = image.affine.copy()
    nudged[:3, 3] += 0.2 * nudged[:3, 0]  # a fifth of a pixel is another grid, a rounded affine is not
    assert code_of(values_on, image_of(image.values, nudged), slice) == "E204"
    rounded = image.affine + 1e-4
    rounded[3] = 0, 0, 0, 1
    assert values_on(image_of(image.values, rounded), slice).shape == (7, 9)


# Masks ----------------------------------------------------------------------------------------------------------------

def read_mask(path, like, *, resample=False):
    """The organ in a mask file on the pixels of `like`, as a run reads it."""
    return clean(values_on(read_image(path), like, resample="nearest" if resample else None) != 0, like.spacing)


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.9))
def test_a_mask_becomes_one_piece_without_holes(tmp_path_factory, seed, density):
    noise = np.random.default_rng(seed).random((12, 14, 1)) < density
    slice = take_slice(ramp(noise.shape))
    path = saved(tmp_path_factory.getbasetemp(), noise.astype(np.uint8), slice.affine)
    try:
        mask = read_mask(path, slice)
    except XfemnavError as error:
        assert error.code in {"E201", "E203"}
        return
    assert label(mask)[1] == 1 and label(np.pad(~mask, 1, constant_values=True))[1] == 1
    sizes = np.bincount(label(noise[:, :, 0])[0].ravel())[1:]
    assert mask.sum() >= sizes.max()


def test_mask_of_a_slice_or_of_the_volume(tmp_path):
    image = ramp((20, 22, 6))
    slice = take_slice(image, index=4)
    organ = np.zeros(image.values.shape, np.uint8)
    organ[4:15, 5:17, 4], organ[1:19, 1:21, 3] = 7, 1
    wanted = organ[:, :, 4] > 0
    np.testing.assert_array_equal(read_mask(saved(tmp_path, organ, image.affine), slice), wanted)
    other = stored(image_of(organ, image.affine), (2, 0, 1), (True, False, True))
    np.testing.assert_array_equal(read_mask(saved(tmp_path, other.values, other.affine), slice), wanted)
    to_nifti(slice, wanted, np.uint8).to_filename(tmp_path / "one.nii")
    np.testing.assert_array_equal(read_mask(tmp_path / "one.nii", slice), wanted)
    assert code_of(read_mask, saved(tmp_path, organ[1:], image.affine), slice) == "E204"
    coarse = image.affine @ np.diag([2, 2, 1, 1.0])
    path = saved(tmp_path, organ[::2, ::2], coarse)
    assert code_of(read_mask, path, slice) == "E204"
    resampled = read_mask(path, slice, resample=True)
    assert (resampled != wanted).sum() <= np.sum(wanted) - np.sum(wanted[1:-1, 1:-1]) + 2 * (11 + 12)  # its rim


def test_what_was_cleaned_is_reported_in_mm2(tmp_path):
    slice = take_slice(ramp((20, 22, 1), affine_of(np.diag([0.5, 2.0, 1.0]))))
    organ = np.zeros((20, 22, 1), np.uint8)
    organ[2:12, 2:12], organ[5, 5:7], organ[15:18, 15:17] = 1, 0, 1
    with pytest.warns(XfemnavWarning, match=r"W205 .* 100 mm2 kept, 6\.0 mm2 in other components .* 2\.0 mm2 of holes"):
        mask = read_mask(saved(tmp_path, organ, slice.affine), slice)
    assert mask.sum() == 100
    assert code_of(read_mask, saved(tmp_path, 0 * organ, slice.affine), slice) == "E201"
    assert code_of(read_mask, saved(tmp_path, 1 + 0 * organ, slice.affine), slice) == "E203"


def test_a_slice_is_a_grid():
    """Its places are those of its values, in the world and back, and in the order of its file."""
    slice = take_slice(ramp(), plane="axial", index=2)
    asked = {*Grid.__annotations__, *(name for name in vars(Grid) if not name.startswith("_"))}
    assert {"to_world", "axes"} < asked <= set(dir(slice))
    centres = slice.pixel_centres()
    back, off = slice.from_world(slice.to_world(centres.reshape(-1, 2)))
    assert np.allclose(back, centres.reshape(-1, 2)) and np.allclose(off, 0) and slice.spacing.shape == (2,)
