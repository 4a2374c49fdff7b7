"""Companions: on any grid, in any storage order, they go where the image goes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_synthetic.fields import rigid
from data_synthetic.phantom import MOTIONS, OPEN, TIP, Grid, Phantom, perfect_solution, side_of
from tests.images import ORDERS, affine_of, image_of, stored
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.carrying.companions import carry
from xfemnav.imaging.carrying.warp import covered, pull_back, update
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.reading.formats import NOT_SAID
from xfemnav.imaging.reading.gate import Components, Image
from xfemnav.imaging.reading.nifti import VECTORS

FLOAT32 = 1e-6  # relative: what a result stored as float32 keeps of numbers near 1
TILT = np.array([[0.96, -0.28, 0.0], [0.28 * 0.8, 0.96 * 0.8, -0.6], [0.28 * 0.6, 0.96 * 0.6, 0.8]])    # a rotation
STRAIGHT = np.eye(3)
COARSE = Grid((96, 112), (1.6, 1.6))


class Scene:
    """The phantom in an axial slice at z = 5 mm, its exact motion, and the update of its image."""

    def __init__(self, motion="open", plane="axial"):
        self.phantom = Phantom(motion=motion, grid=COARSE)
        grid = self.phantom.grid
        world = {"axial": np.eye(3), "coronal": np.eye(3)[[0, 2, 1]]}[plane].T    # columns: e1, e2, normal
        affine = affine_of(world * [*grid.spacing, 2.0], world @ [*grid.origin, 5.0])
        volume = np.repeat(self.phantom.image()[:, :, None], 3, axis=2)    # three slices, the middle one at z = 7
        self.image = image_of(volume, affine)
        self.frame = take_slice(self.image, plane=plane, index=1)
        rest, moved = perfect_solution(self.phantom, rays=180, rings=40)
        at = self.frame.origin, self.frame.spacing
        self.pull = pull_back(rest, moved, *at, grid.shape)
        self.organ = covered(rest, *at, grid.shape)
        self.update = self.updated()
        self.tissue = self.pull.tissue

    def updated(self, interp="linear", **options):
        return update(self.frame.values, self.organ, self.pull, interp,
                      **options)

    def in_storage(self, values):
        return self.frame.to_storage(values)

    def on_pixels(self, image):
        """Values (n1, n2, ...) of a carried image; the frames here are stored along e1 first, then e2."""
        return np.asarray(image.dataobj).squeeze(axis=self.frame.array_axes[2])

    def resting_world(self):
        """World mm (n, 3) where the tissue of each tissue pixel rested."""
        return self.frame.to_world(self.pull.resting[self.tissue])


SCENE, TURNED = Scene(), Scene("rigid")


def volume_of(function, spacing=3.0, linear=STRAIGHT, half=(110, 120, 40), nc=None, intent=0, vectors=None):
    """A volume about the origin with a slanted grid, of a function of world points (n, 3)."""
    linear = linear * spacing
    shape = tuple(int(2 * h / spacing) for h in half)
    affine = affine_of(linear, -linear @ ((np.array(shape) - 1) / 2))
    voxels = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    values = function(voxels @ linear.T + affine[:3, 3])
    if nc is None:
        return image_of(values.reshape(shape), affine)
    vectors = VECTORS.get(intent, NOT_SAID) if vectors is None else vectors
    return Components(values.reshape(*shape, nc), affine, intent, "float32", "", "field.nii.gz", vectors=vectors)


@pytest.mark.parametrize("plane", ["axial", "coronal"])
@pytest.mark.parametrize("interp", ["linear", "cubic", "nearest"])
def test_the_image_as_its_own_companion_is_the_updated_image(interp, plane):
    scene = SCENE if plane == "axial" else Scene(plane=plane)
    carried = carry(scene.image, scene.frame, scene.update, kind="continuous", interp=interp)
    wanted = scene.updated(interp).updated
    # float32 rounding of values up to 1000; the spline's prefilter along the third axis adds its own
    assert_allclose(scene.on_pixels(carried), wanted, rtol=FLOAT32, atol=1e-3)
    affine = scene.frame.affine @ np.block([[np.eye(3), np.eye(3)[:, [scene.frame.array_axes[2]]]], [0, 0, 0, 1]])
    assert_allclose(carried.affine, affine, atol=1e-9)
    assert carried.get_data_dtype() == np.float32


@pytest.mark.parametrize("order", range(0, 48, 5))
def test_storage_orders_change_nothing(order):
    image = volume_of(lambda x: np.sin(x[:, 0] / 9) + np.cos(x[:, 1] / 8 + x[:, 2] / 5), 4.0, half=(90, 100, 20))
    wanted = np.asarray(carry(image, SCENE.frame, SCENE.update, kind="continuous").dataobj)
    same = carry(stored(image, *ORDERS[order]), SCENE.frame, SCENE.update, kind="continuous")
    assert_allclose(np.asarray(same.dataobj), wanted, atol=FLOAT32)


@pytest.mark.parametrize("plane", ["axial", "coronal"])
def test_a_slanted_grid_is_sampled_where_the_tissue_rested(plane):
    """Trilinear sampling of a linear function is exact on any grid, so only the place can be wrong."""
    scene = SCENE if plane == "axial" else Scene(plane=plane)
    slope = np.array([0.7, -1.3, 2.1])
    image = volume_of(lambda x: x @ slope + 400, 3.0, TILT, half=(130, 130, 130))
    carried = scene.on_pixels(carry(image, scene.frame, scene.update, kind="continuous"))
    assert_allclose(carried[scene.tissue], scene.resting_world() @ slope + 400, rtol=FLOAT32)
    outside = ~scene.organ & ~scene.tissue
    own = scene.frame.to_world(scene.frame.pixel_centres()[outside])
    assert_allclose(carried[outside], own @ slope + 400, rtol=FLOAT32)
    assert (carried[scene.update.cavity] == 0).all()


@pytest.mark.parametrize("interp, order, constant", [("linear", 2, 1 / 8), ("cubic", 4, 1 / 384)])
def test_a_3_mm_map_follows_the_image(interp, order, constant):
    """A smooth activation, against its formula at the phantom's exact resting places."""
    width = 9.0

    def activation(world):
        return np.exp(-((world - [30.0, 34.0, 7.0]) ** 2).sum(axis=-1) / (2 * width**2))

    image = volume_of(activation, 3.0)
    carried = SCENE.on_pixels(carry(image, SCENE.frame, SCENE.update, kind="continuous", interp=interp))
    places = SCENE.phantom.truth.places
    known = SCENE.tissue & np.isfinite(places[..., 0])
    known &= np.linalg.norm(SCENE.frame.pixel_centres() - TIP, axis=-1) > 3    # there the motion's chords are coarse
    exact = activation(SCENE.frame.to_world(places[known]))
    # C h^p |f^(p)| in each of three axes, |f''| <= 1 / w^2, |f''''| <= 3 / w^4; chords of the motion: .02 mm x 1 / w
    bound = 3 * constant * 3.0**order * {2: 1 / width**2, 4: 3 / width**4}[order] + 0.02 / width
    assert abs(carried[known] - exact).max() < bound
    assert abs(carried[known] - activation(SCENE.frame.to_world(SCENE.frame.pixel_centres()[known]))).max() > 2 * bound


@pytest.mark.parametrize("dtype", ["uint8", "int16", "int32", "uint32", "int64"])
def test_labels_keep_their_set_and_their_type(dtype):
    labels = 17 * SCENE.phantom.labels.astype(float) + 3
    image = Image(np.repeat(labels[:, :, None], 3, axis=2), SCENE.image.affine, dtype, 1, "", "dseg.nii.gz")
    carried = carry(image, SCENE.frame, SCENE.update, kind="label", interp="linear", fill=255)
    values = SCENE.on_pixels(carried)
    assert carried.get_data_dtype() == np.dtype(dtype) == values.dtype
    assert set(np.unique(values)) <= {*np.unique(labels), 255}
    assert (values[SCENE.update.cavity] == 255).all()
    truth = np.where(SCENE.phantom.truth.cavity, 255, 17 * SCENE.phantom.truth.labels.astype(float) + 3)
    # the labels' outlines are 1800 mm long; at worst each of their pixels (1.6 mm) differs by rounding to the nearest
    assert (values != truth).mean() < 1800 / 1.6 / truth.size / 2


def test_labels_stored_as_numbers_with_a_point():
    image = replace(SCENE.image, values=np.full(SCENE.image.values.shape, 70000.0))
    assert carry(image, SCENE.frame, SCENE.update, kind="label").get_data_dtype() == np.int32
    image = replace(image, dtype="uint8")    # a scale factor takes them out of their stored type
    assert carry(image, SCENE.frame, SCENE.update, kind="label").get_data_dtype() == np.int32
    image = replace(image, values=np.full(image.values.shape, 1e12))
    assert carry(image, SCENE.frame, SCENE.update, kind="label").get_data_dtype() == np.int64


def test_outside_is_kept_or_zero_and_the_cavity_filled():
    image = replace(SCENE.image, values=np.full(SCENE.image.values.shape, 5.0))
    values = SCENE.on_pixels(carry(image, SCENE.frame, SCENE.update, kind="continuous", fill=-2, outside="zero"))
    empty = SCENE.update.cavity | SCENE.update.vacated
    assert empty.any() and (values[empty] == -2).all() and (values[SCENE.tissue] == 5).all()
    assert (values[~empty & ~SCENE.tissue] == 0).all()
    drawn_back = SCENE.updated(now=np.zeros_like(SCENE.organ))    # all that is empty is vacated
    assert_array_equal(SCENE.on_pixels(carry(image, SCENE.frame, drawn_back, kind="continuous", fill=-2,
                                             outside="zero")), values)


def gradients_at(scene, motion):
    """Exact deformation gradients (n, 3, 3) in world RAS at the resting places of the tissue pixels."""
    rest = scene.pull.resting[scene.tissue]
    F = np.tile(np.eye(3), (len(rest), 1, 1))
    F[:, :2, :2] += motion.gradient(rest, side_of(rest))
    return F


WAYS = [(0, "world", np.eye(3)), (1006, "file", np.eye(3)), (1006, "world", np.eye(3)),
        (1007, "file", np.diag([-1.0, -1, 1])), (1007, "world", np.diag([-1.0, -1, 1]))]


@pytest.mark.parametrize("intent, axes, signs", WAYS)
def test_vectors_turn_with_the_tissue(intent, axes, signs):
    vector = np.array([0.6, -0.3, 0.5])
    field = volume_of(lambda x: np.tile(vector @ signs, (len(x), 1)), 4.0, nc=3, intent=intent)
    carried = carry(field, TURNED.frame, TURNED.update, kind="vector", axes=axes)
    values = TURNED.on_pixels(carried).reshape(*TURNED.tissue.shape, 3) @ signs
    turn = np.eye(3)
    turn[:2, :2] += rigid(np.radians(5)).G
    assert_allclose(values[TURNED.tissue], np.tile(turn @ vector, (TURNED.tissue.sum(), 1)), atol=FLOAT32)
    still = ~TURNED.tissue & ~TURNED.organ
    assert_allclose(values[still], np.tile(vector, (still.sum(), 1)), atol=FLOAT32)
    assert carried.header["intent_code"] == intent
    assert carried.ndim == (5 if intent else 4)


def turn_in(frame):
    """The scene's rotation by 5 degrees (3, 3) in world RAS, in the plane of its frame."""
    whole = np.eye(3)
    whole[:2, :2] += rigid(np.radians(5)).G
    return frame.axes.T @ whole @ frame.axes


@pytest.mark.parametrize("intent", [0, 1007])
def test_in_a_coronal_slice_the_frame_of_a_file_matters(intent):
    """There LPS and RAS see opposite turns, where they agree on an axial one."""
    scene, vector, signs = Scene("rigid", "coronal"), np.array([0.6, -0.3, 0.5]), [-1, -1, 1] if intent else [1, 1, 1]
    field = volume_of(lambda x: np.tile(vector * signs, (len(x), 1)), 4.0, half=(110, 120, 120), nc=3, intent=intent)
    values = scene.on_pixels(carry(field, scene.frame, scene.update, kind="vector", axes="world"))
    values = values.reshape(*scene.tissue.shape, 3)[scene.tissue] * signs
    assert_allclose(values, np.tile(turn_in(scene.frame) @ vector, (len(values), 1)), atol=FLOAT32)


def test_vectors_in_image_axes_come_out_in_those_of_the_slice():
    """The field is stored along P, I, R and the slice along R, A, S: both right-handed, so FSL's x counts backwards."""
    vector = np.array([0.6, -0.3, 0.5])
    axes = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    field = volume_of(lambda x: np.tile(axes.T @ vector * [-1, 1, 1], (len(x), 1)), 4.0, axes, (120, 120, 120), 3)
    assert np.linalg.det(field.affine) > 0
    values = TURNED.on_pixels(carry(field, TURNED.frame, TURNED.update, kind="vector", axes="image"))
    wanted = turn_in(TURNED.frame) @ vector * [-1, 1, 1]
    assert_allclose(values[TURNED.tissue], np.tile(wanted, (TURNED.tissue.sum(), 1)), atol=FLOAT32)


def tensor_of(principal):
    """A prolate tensor along `principal`, eigenvalues 1.7, .4, .2 (1e-3 mm2/s)."""
    e1 = np.asarray(principal) / np.linalg.norm(principal)
    e2 = np.cross(e1, [0.1, 0.2, 1.0])
    e2 /= np.linalg.norm(e2)
    return 1.7 * np.outer(e1, e1) + 0.4 * np.outer(e2, e2) + 0.2 * np.outer(np.cross(e1, e2), np.cross(e1, e2))


FSL, LOWER = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)], [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]


def tensors_in(scene, carried, order):
    values = scene.on_pixels(carried).reshape(*scene.tissue.shape, 6).astype(float)
    D = np.empty((*values.shape[:2], 3, 3))
    for c, (i, j) in enumerate(order):
        D[..., i, j] = D[..., j, i] = values[..., c]
    return D


@pytest.mark.parametrize("intent, axes, order, signs", [
    (0, "world", FSL, [1, 1, 1]), (1005, "world", LOWER, [-1, -1, 1]), (0, "image", FSL, [-1, 1, 1])])
def test_a_rotation_rotates_tensors_in_every_convention(intent, axes, order, signs):
    """"image": these grids are stored along R, A, S, which is right-handed, so FSL's x counts to the left."""
    D, turn = tensor_of([1.0, 0.4, 0.3]), np.eye(3)
    turn[:2, :2] += rigid(np.radians(5)).G
    flip = np.diag(signs)
    stored_as = np.array([(flip @ D @ flip)[i, j] for i, j in order])
    field = volume_of(lambda x: np.tile(stored_as, (len(x), 1)), 4.0, nc=6, intent=intent)
    carried = carry(field, TURNED.frame, TURNED.update, kind="tensor", axes=axes)
    found = flip @ tensors_in(TURNED, carried, order) @ flip
    assert_allclose(found[TURNED.tissue], np.tile(turn @ D @ turn.T, (TURNED.tissue.sum(), 1, 1)), atol=2 * FLOAT32)
    assert carried.ndim == (5 if intent else 4) and carried.header["intent_code"] == intent


def test_tensors_in_an_opening_cut_follow_their_principal_direction():
    principal = np.array([0.8, 0.6, 0.0])
    stored_as = np.array([tensor_of(principal)[i, j] for i, j in FSL])
    field = volume_of(lambda x: np.tile(stored_as, (len(x), 1)), 4.0, nc=6)
    D = tensors_in(SCENE, carry(field, SCENE.frame, SCENE.update, kind="tensor", axes="world"), FSL)[SCENE.tissue]
    eigenvalues, E = np.linalg.eigh(D)
    assert_allclose(eigenvalues, np.tile([0.2, 0.4, 1.7], (len(D), 1)), atol=1e-6)
    wanted = gradients_at(SCENE, MOTIONS["open"]) @ principal
    cosine = abs(np.einsum("ni,ni->n", E[:, :, 2], wanted)) / np.linalg.norm(wanted, axis=1)
    away = np.linalg.norm(SCENE.pull.resting[SCENE.tissue] - OPEN.tip, axis=1)
    # F is constant on triangles of up to h = 3 mm, and varies as K / sqrt(r): by K h / r^1.5 / 2 rad, K = 1.1 mm^.5
    assert (np.arccos(np.minimum(cosine, 1))[away > 10] < 1.1 * 3 / 10**1.5 / 2 + 2e-3).all()
    assert np.degrees(np.arccos(cosine.min())) < 45
    still = np.arccos(np.minimum(abs(E[:, :, 2] @ principal), 1))
    assert still[away > 10].max() > 0.05    # the tissue does turn here


def one_slice(offset, thickness=4.0, tilt=0.0):
    """A slice of ones, `offset` mm above the scene's (2 mm thick, at z = 7)."""
    linear = np.array([[1, 0, 0], [0, 1, 0], [0, tilt, 1.0]]) * [2.0, 2.0, thickness]
    return image_of(np.ones((110, 120, 1)), affine_of(linear, (-110.0, -120.0, 7.0 + offset - tilt * 120)), "other.nii")


@pytest.mark.parametrize("offset", [-2.9, 0.0, 2.9])
def test_one_slice_is_taken_in_its_plane(offset):
    values = SCENE.on_pixels(carry(one_slice(offset), SCENE.frame, SCENE.update, kind="continuous"))
    assert (values[SCENE.tissue] == 1).all()


@pytest.mark.parametrize("image, distance", [(one_slice(3.1), "3.10 mm"), (one_slice(-40), "40.00 mm"),
                                             (one_slice(0, tilt=0.1), "mm off")])
def test_one_slice_that_is_another_one_is_refused(image, distance):
    with pytest.raises(XfemnavError, match=f"E130.*{distance}"):
        carry(image, SCENE.frame, SCENE.update, kind="continuous")


def test_a_volume_beside_the_tissue_is_refused_and_one_that_ends_in_it_warned_of():
    image = volume_of(lambda x: np.ones(len(x)), 4.0, half=(110, 120, 20))
    away = image.affine.copy()
    away[2, 3] += 50
    # the lowest voxel's centre is at 50 - 18, its face at 30, and the slice at 7
    with pytest.raises(XfemnavError, match=r"E130.*23\.00 mm"):
        carry(replace(image, affine=away), SCENE.frame, SCENE.update, kind="continuous")
    half = replace(image, values=image.values[:25])
    with pytest.warns(XfemnavWarning, match="W130"):
        values = SCENE.on_pixels(carry(half, SCENE.frame, SCENE.update, kind="continuous"))
    end = half.affine[0, 3] + 24.5 * 4    # the last voxel's face
    rest = SCENE.pull.resting[..., 0]
    assert (values[SCENE.tissue & (rest < end)] == 1).all() and (values[SCENE.tissue & (rest > end)] == 0).all()
    assert np.isfinite(values).all()


def test_a_companion_that_is_not_of_its_kind_is_refused():
    for kind in ("vector", "tensor"):
        with pytest.raises(XfemnavError, match=r"E131.*1 values a voxel"):
            carry(SCENE.image, SCENE.frame, SCENE.update, kind=kind)
    with pytest.raises(XfemnavError, match=r"E131.*whole numbers"):
        carry(replace(SCENE.image, values=SCENE.image.values + 0.5), SCENE.frame, SCENE.update, kind="label")
    with pytest.raises(ValueError, match="linear, cubic or nearest"):
        carry(SCENE.image, SCENE.frame, SCENE.update, kind="continuous", interp="quintic")


def test_a_series_keeps_its_volumes():
    series = volume_of(lambda x: np.stack([x[:, 0], x[:, 1], np.ones(len(x)), x[:, 2]], axis=1), 4.0, nc=4)
    carried = SCENE.on_pixels(carry(series, SCENE.frame, SCENE.update, kind="continuous"))
    world = SCENE.resting_world()
    assert_allclose(carried[SCENE.tissue][:, [0, 1, 3]], world, rtol=FLOAT32, atol=1e-5)
    assert_array_equal(carried[SCENE.tissue][:, 2], 1)
