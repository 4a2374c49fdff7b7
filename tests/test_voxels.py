"""Sampling volumes: exact on what each kind reproduces, one value a voxel, ends where the voxels end."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from xfemnav.imaging.carrying.voxels import sample_volume

SHAPE = (21, 18, 15)
RNG = np.random.default_rng(0)
PLACES = RNG.uniform(3, 11, (400, 2))
MATRIX, SHIFT = np.array([[0.9, 0.2], [-0.1, 0.8], [0.3, 0.4]]), np.array([1.5, 2.0, 0.25])
VOXELS = PLACES @ MATRIX.T + SHIFT
GRID = np.moveaxis(np.indices(SHAPE), 0, -1)


def sampled(values, interp, places=PLACES, matrix=MATRIX, shift=SHIFT):
    return sample_volume(np.ascontiguousarray(values), matrix, shift, places, interp)


def test_trilinear_functions_are_exact():
    def function(x):
        return np.stack([2 + x[..., 0] * x[..., 1] * x[..., 2], x[..., 0] - 3 * x[..., 1]], axis=-1)

    values, seen = sampled(function(GRID), "linear")
    assert seen.all()
    assert_allclose(values, function(VOXELS), rtol=1e-12)


def test_the_spline_interpolates_and_is_of_fourth_order():
    wave = np.sin(GRID[..., :1] / 2.5) * np.cos(GRID[..., 1:2] / 3) * np.sin(GRID[..., 2:] / 2)
    exact = np.sin(VOXELS[:, 0] / 2.5) * np.cos(VOXELS[:, 1] / 3) * np.sin(VOXELS[:, 2] / 2)
    inside = ((VOXELS > 4) & (VOXELS + 5 < SHAPE)).all(axis=1)    # the end condition fades out by there
    bound = (1 / 2.5**4 + 1 / 3**4 + 1 / 2**4) / 384 + 0.27**4    # h^4 / 384 |f''''|, and what is left of the ends
    assert inside.sum() > 50
    assert abs(sampled(wave, "cubic")[0][inside, 0] - exact[inside]).max() < bound
    centres = np.array([[i, j] for i in range(21) for j in range(18)], float)
    flat = np.array([[1.0, 0], [0, 1], [0, 0]]), np.array([0, 0, 7.0])
    assert_allclose(sampled(wave, "cubic", centres, *flat)[0].reshape(21, 18), wave[:, :, 7, 0], atol=1e-8)


@pytest.mark.parametrize("interp", ["linear", "nearest"])
def test_a_voxel_s_centre_has_its_value_to_the_last_bit(interp):
    noise = RNG.normal(size=(*SHAPE, 3))
    centres = np.array([[i, j] for i in range(21) for j in range(18)], float)
    # a scale whose quotients are rounded
    values, seen = sampled(noise, interp, centres * 0.3, np.array([[1 / 0.3, 0], [0, 1 / 0.3], [0, 0]]),
                           np.array([0, 0, 14.0]))
    assert seen.all()
    assert_array_equal(values.reshape(21, 18, 3), noise[:, :, 14])


@pytest.mark.parametrize("interp", ["linear", "nearest", "cubic"])
def test_a_volume_ends_half_a_voxel_on_and_one_slice_has_no_end(interp):
    flat = np.array([[1.0, 0], [0, 1], [0, 0]])
    places = np.array([[-0.49, 5.0], [-0.51, 5], [20.49, 5], [20.51, 5], [3, 17.6]])
    values, seen = sampled(np.ones((*SHAPE, 1)), interp, places, flat, np.zeros(3))
    assert_array_equal(seen, [True, False, True, False, False])
    assert_allclose(values[:, 0], seen, atol=1e-12)
    for shift in (0.0, 40.0):
        values, seen = sampled(np.ones((21, 18, 1, 1)), interp, places[[0]], flat, np.array([0, 0, shift]))
        assert seen.all() and values[0, 0] == pytest.approx(1)


@pytest.mark.parametrize("interp", ["linear", "nearest", "cubic"])
def test_places_of_space_are_sampled_as_those_of_the_plane_in_it(interp):
    noise, R = RNG.normal(size=(*SHAPE, 2)), np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    world = (VOXELS - 3.0) @ R
    values, seen = sample_volume(noise, R, np.full(3, 3.0), world, interp)
    expected, known = sampled(noise, interp)
    assert_array_equal(seen, known)
    assert_allclose(values, expected, atol=1e-12)
    with pytest.raises(ValueError, match="linear, cubic or nearest"):
        sampled(noise, "quintic")
