"""The motion on a grid: other programs resample and carry points as xfemnav does, in every plane and storage order."""

import resource
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import distance_transform_edt

from data_synthetic.phantom import TIP
from tests.motions import GRID, LAS, MIXED, MOVED, REST, SCENES, THICKNESS, finer, landing, slice_in
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.gaps import NOWHERE, bridged, extended
from xfemnav.imaging.carrying.transform import MARGIN, backward, forward, itk_transform, roomy, write_transform
from xfemnav.imaging.carrying.vectors import LPS, write_nrrd
from xfemnav.imaging.carrying.warp import covered, pull_back
from xfemnav.imaging.frames.slices import to_nifti

# Headers of NIfTI hold float32, 1e-5 mm at 100 mm; the promise is a hundred times wider.
EXACT = 1e-3
TISSUE = Motion(REST, MOVED)
FIELDS = {gaps: backward(slice_in(), REST, TISSUE, gaps) for gaps in ("bridged", "extended")}
MOTION = pull_back(REST, MOVED, GRID.origin, GRID.spacing, GRID.shape)


def carried(transform, slice, points, off=0.0) -> np.ndarray:
    """Plane points (n, 2) mm that ITK's transform makes of `points` (n, 2) `off` mm off the plane."""
    world = (slice.to_world(points) + off * slice.axes[2]) * LPS
    plane, distance = slice.from_world(np.array([transform.TransformPoint(p.tolist()) for p in world]) * LPS)
    assert_allclose(distance, off, atol=1e-6)    # nothing leaves its plane; fields in files are float32
    return plane


@pytest.mark.parametrize("gaps", FIELDS)
@pytest.mark.parametrize("scene", SCENES, ids=str)
def test_itk_looks_where_the_tissue_of_each_pixel_rested(scene, gaps, tmp_path):
    slice = slice_in(*scene)
    assert_allclose([slice.origin, slice.spacing], [GRID.origin, GRID.spacing], atol=1e-9)
    write_transform(tmp_path / "t.h5", slice, FIELDS[gaps])
    found = landing(slice, sitk.ReadTransform(str(tmp_path / "t.h5")), tmp_path)
    assert_allclose(found[MOTION.tissue], MOTION.resting[MOTION.tissue], atol=EXACT)
    away = np.abs(FIELDS[gaps]).max(axis=-1) == NOWHERE
    assert_array_equal(np.isnan(found[..., 0]), away)


@pytest.mark.parametrize("gaps, at_lips", [("bridged", 0.5), ("extended", 0.15)])
def test_between_the_pixels_tissue_is_off_by_a_part_of_a_pixel_at_lips_only(gaps, at_lips, tmp_path):
    """Sampled four times as fine. At a lip across the axes both directions bridge, each at most a quarter pixel wrong;
    extended, what is wrong there is the strain. So it is at the tip either way, where no pixel is in the gap. Away
    from lips and outline: the second difference of the field, h^2 u'' / 8."""
    slice = slice_in()
    origin, spacing, grid = finer(slice, 4, 3)
    found = landing(slice, itk_transform(slice, FIELDS[gaps]), tmp_path, grid)
    motion = pull_back(REST, MOVED, origin, spacing, found.shape[:2])
    error = np.linalg.norm(found - motion.resting, axis=-1) / GRID.spacing[0]
    assert np.isfinite(error[motion.tissue]).all()    # no tissue is lost
    steps = distance_transform_edt(motion.tissue) / 4    # pixels
    from_tip = origin + np.moveaxis(np.indices(steps.shape), 0, -1) * spacing - TIP
    at_tip = np.linalg.norm(from_tip, axis=-1) < 4 * GRID.spacing[0]    # u'' grows as r^-3/2
    assert error[motion.tissue].max() < 0.5
    assert error[motion.tissue & ~at_tip].max() < at_lips
    assert error[(steps > 2) & ~at_tip].max() < 5e-3


def test_points_up_to_half_a_slice_off_the_plane_are_carried_and_none_of_the_next_slice(tmp_path):
    slice = slice_in("coronal", 15, MIXED)
    write_transform(tmp_path / "t.h5", slice, FIELDS["bridged"])
    transform = sitk.ReadTransform(str(tmp_path / "t.h5"))
    pixels = np.array([[50, 60], [70, 90], [30, 100]])
    points = GRID.origin + GRID.spacing * pixels
    there = points + FIELDS["bridged"][tuple(pixels.T)]
    assert np.linalg.norm(there - points, axis=1).min() > 0.1
    for off in (0, 0.4, -0.4, 0.5, -0.5):
        assert_allclose(carried(transform, slice, points, off * THICKNESS), there, atol=1e-9)
    for off in (1, -1):
        assert_allclose(carried(transform, slice, points, off * THICKNESS), points, atol=1e-9)


def test_forward_is_the_displacement_of_the_tissue_at_rest():
    slice, tissue = slice_in(), TISSUE
    field, centres = forward(slice, TISSUE), slice_in().pixel_centres()
    organ = covered(REST, GRID.origin, GRID.spacing, GRID.shape)
    assert_array_equal(field[~organ], 0)
    assert_allclose(field[organ], tissue.displacement(centres[organ]), atol=1e-6)
    # and it leads back: the new place of a pixel's tissue rested at the pixel, but where tissue lies twice
    back = tissue.to_preoperative((centres + field)[organ])
    assert np.median(np.linalg.norm(back - centres[organ], axis=1)) < 1e-9


def test_what_was_taken_out_does_not_move():
    kept = np.linalg.norm(REST.mean(axis=1) - TIP, axis=1) > 15
    slice = slice_in()
    organ, left = (covered(x, GRID.origin, GRID.spacing, GRID.shape) for x in (REST, REST[kept]))
    assert (organ & ~left).any()
    assert_array_equal(forward(slice, Motion(REST[kept], MOVED[kept]))[organ & ~left], 0)
    field = backward(slice, REST, Motion(REST[kept], MOVED[kept]), "extended")
    hole = slice.pixel_centres() - TIP
    assert (np.abs(field)[np.linalg.norm(hole, axis=-1) < 8] == NOWHERE).all()


@pytest.mark.parametrize("storage", [LAS, MIXED], ids=str)
def test_room_moves_no_pixel(storage):
    """The larger slice has the same pixels at the same places, in its own coordinates and in the file's."""
    slice = replace(slice_in("coronal", 15, storage), values=np.random.default_rng(1).random(GRID.shape))
    points = np.array([GRID.origin - (7.1, 0), -GRID.origin + (0, 3.3)])
    room = roomy(slice, points)
    low = np.rint((slice.origin - room.origin) / slice.spacing).astype(int)
    n1, n2 = GRID.shape
    assert_array_equal(room.values[low[0]:low[0] + n1, low[1]:low[1] + n2], slice.values)
    assert room.values.sum() == pytest.approx(slice.values.sum())
    inside = (points - room.origin) / room.spacing
    assert (inside >= MARGIN - 1e-9).all() and (inside <= np.array(room.values.shape) - 1 - MARGIN + 1e-9).all()
    image = to_nifti(room, room.values, np.float64)
    voxel = np.argwhere(image.get_fdata() == slice.values[5, 9])[0]
    world = image.affine @ [*voxel, 1]
    assert_allclose(world[:3], slice.to_world((slice.origin + slice.spacing * (5, 9))[None])[0], atol=1e-4)
    assert_array_equal(roomy(slice, REST).values, slice.values)    # there is room already


def test_in_a_roomy_grid_tissue_that_leaves_the_image_is_carried():
    slice, shift = slice_in(), np.array([60.0, 0.0])
    moved = REST + shift
    room = roomy(slice, moved)
    transform = itk_transform(room, backward(room, REST, Motion(REST, moved)))
    point = np.array([[120.0, 5.0]])
    assert point[0, 0] > -GRID.origin[0]
    assert_allclose(carried(transform, slice, point), point - shift, atol=1e-9)


def test_a_roomy_field_ends_with_zeros():
    """Tissue that reaches the outermost pixel on each side, and takes its neighbours along."""
    slice = slice_in()
    low, high = slice.pixel_centres()[0, 0], slice.pixel_centres()[-1, -1]
    box = np.array([[low, [high[0], low[1]], high], [low, high, [low[0], high[1]]]])
    room = roomy(slice, box)
    field = backward(room, box, Motion(box, 1.0005 * box))
    assert (field != 0).any(axis=-1)[1:-1, 1:-1].all()
    for border in (field[0], field[-1], field[:, 0], field[:, -1]):
        assert_array_equal(border, 0)


def test_backward_is_the_field_of_the_warp_with_the_gaps_filled():
    empty = covered(REST, GRID.origin, GRID.spacing, GRID.shape) & ~MOTION.tissue
    assert_array_equal(FIELDS["bridged"], bridged(MOTION, empty, TISSUE))
    assert_array_equal(FIELDS["extended"], extended(MOTION, empty))


def test_nitransforms_carries_points_as_the_warp_does(tmp_path):
    """Its points are RAS. On the pixels it takes the field as it is; off the plane it interpolates places by cubics
    that are flat at the border, so that along the normal it is off by a tenth of the thickness."""
    manip = pytest.importorskip("nitransforms.manip")
    slice = slice_in("sagittal", 25, MIXED)
    write_transform(tmp_path / "t.h5", slice, FIELDS["bridged"])
    chain = manip.TransformChain.from_filename(str(tmp_path / "t.h5"), fmt="itk")
    world = slice.to_world(slice.pixel_centres()[MOTION.tissue])
    assert_allclose(chain.map(world), slice.to_world(MOTION.resting[MOTION.tissue]), atol=EXACT)
    for off in (0.5 * THICKNESS, -0.5 * THICKNESS):
        plane, distance = slice.from_world(chain.map(world + off * slice.axes[2]))
        assert_allclose(plane, MOTION.resting[MOTION.tissue], atol=EXACT)
        assert_allclose(distance, off, atol=0.1 * THICKNESS)


def test_the_same_field_gives_the_same_bytes(tmp_path):
    slice = slice_in()
    write_transform(tmp_path / "a.h5", slice, FIELDS["bridged"])
    time.sleep(1.1)    # HDF5 counts seconds
    write_transform(tmp_path / "b.h5", slice, FIELDS["bridged"])
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert sitk.ReadTransform(str(tmp_path / "a.h5")).GetName() == "CompositeTransform"


@pytest.mark.parametrize("write", [write_transform, lambda *stated: write_nrrd(*stated, "modeling")],
                         ids=["h5", "nrrd"])
def test_a_disk_without_room_is_an_error_of_the_system_at_every_size(tmp_path, write):
    """Which the writer of all files tells (E501, E502): nothing leaves the process, nothing is cut off in silence."""
    slice, path = slice_in(), tmp_path / "t"
    write(path, slice, FIELDS["bridged"])
    whole = path.read_bytes()
    for size in (*range(0, len(whole), len(whole) // 25 + 1), len(whole) - 10, len(whole) - 1):
        with room_for(size), pytest.raises(OSError, match=r"too large|No space"):
            write(path, slice, FIELDS["bridged"])
    write(path, slice, FIELDS["bridged"])
    assert path.read_bytes() == whole


@contextmanager
def room_for(n_bytes):
    """Files of this process can hold `n_bytes` at most."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_gaps_have_two_names():
    with pytest.raises(ValueError, match="bridged or extended"):
        backward(slice_in(), REST, TISSUE, "open")


@pytest.mark.parametrize("gaps", FIELDS)
def test_a_known_motion_gives_the_same_field(gaps):
    assert_array_equal(backward(slice_in(), REST, TISSUE, gaps, MOTION), FIELDS[gaps])
