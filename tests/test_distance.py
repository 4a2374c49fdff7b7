"""The signed distance of a mask: near to the true one, without stairs, the same however the mask is stored."""

from itertools import permutations, product

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import distance_transform_edt, gaussian_filter

from benchmarks.verification.solids import OBLIQUE, ball, shape
from xfemnav.errors import XfemnavError
from xfemnav.imaging.organ import distance
from xfemnav.imaging.organ.distance import signed_distance
from xfemnav.imaging.reading.lean import nibabel


def about(radius, n=3000):
    """Points (n, 3) within 3 mm of a sphere, and their depth (n,) mm in it."""
    rng = np.random.default_rng(0)
    way = rng.normal(size=(n, 3))
    depth = rng.uniform(-3, 3, n)
    return way / np.linalg.norm(way, axis=1)[:, None] * (radius - depth)[:, None], depth


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.8, 1.5, 1.0)])
def test_distances_are_those_of_scipy(spacing):
    organ = gaussian_filter(np.random.default_rng(1).normal(size=(22, 18, 20)), 2) > 0
    half = np.where(organ, 1, -1) * min(spacing) / 2
    theirs = distance_transform_edt(organ, sampling=spacing) - distance_transform_edt(~organ, sampling=spacing) - half
    assert_allclose(distance._signed(organ, np.array(spacing)), theirs, atol=1e-5)


@pytest.mark.parametrize("spacing, largest, middle", [
    # The surface of voxels is known to about half of one, and moves inwards by sigma^2 / R.
    ((1.0, 1.0, 1.0), 0.5, 0.17), ((2.0, 2.0, 2.0), 1.1, 0.34), ((0.7, 0.7, 1.2), 0.6, 0.2),
    # At the poles, between two thick slices, there is nothing to see; elsewhere the shape goes on.
    ((1.0, 1.0, 5.0), 2.6, 0.55), ((5.0, 1.0, 1.0), 2.6, 0.55), ((1.0, 3.0, 3.0), 1.3, 0.3),
])
def test_ball_has_its_distance(spacing, largest, middle):
    field = signed_distance(*shape(ball(25), 32, spacing, OBLIQUE))
    points, depth = about(25)
    wrong = field(points) - depth
    assert np.abs(wrong).max() < largest and np.sqrt((wrong**2).mean()) < middle


def test_thick_slices_leave_no_stairs():
    """The slope of a staircase of 5 mm would be 0 on its treads, and turned by 45 degrees on a cone."""
    cone, affine = shape(lambda x, y, z: (np.hypot(x, y) < 20 - z) & (abs(z) < 15), 40, (1.0, 1.0, 5.0))
    field = signed_distance(cone, affine)
    assert field.spacing.max() <= 2 * field.spacing.min()
    angle, z = np.meshgrid(np.linspace(0, 6.2, 50), np.linspace(-8, 8, 17))
    points = np.stack([(20 - z) * np.cos(angle), (20 - z) * np.sin(angle), z], axis=-1).reshape(-1, 3)
    gradient = field.gradient(points)
    gradient /= np.linalg.norm(gradient, axis=1)[:, None]
    normal = -np.stack([np.cos(angle), np.sin(angle), np.ones_like(z)], axis=-1).reshape(-1, 3) / np.sqrt(2)
    assert np.degrees(np.arccos((gradient * normal).sum(axis=1))).max() < 15
    assert np.abs(field(points)).max() < 0.6


def test_48_storage_orders_are_one_field():
    """Of an oblique image, and of one turned by 45 degrees, which is as near to R as to A."""
    mask, _ = shape(lambda x, y, z: ball(9)(x, y, z) | ball(5, 6, 4, 3)(x, y, z), 14, (1.0, 1.0, 3.0))
    corner = np.array([[1, -1, 0], [1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    for turn in (OBLIQUE, corner):
        affine = np.eye(4)
        affine[:3, :3], affine[:3, 3] = turn * (1.0, 1.0, 3.0), (-3.0, 5.5, 7.0)
        first = signed_distance(mask, affine)
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
            to = np.stack([order, signs], axis=1)
            field = signed_distance(nibabel.orientations.apply_orientation(mask, to),
                                    affine @ nibabel.orientations.inv_ornt_aff(to, mask.shape))
            assert_array_equal(field.values, first.values)
            assert_array_equal(field.axes, first.axes)
            assert_allclose(field.origin, first.origin, atol=1e-12)


def test_only_the_organ_is_computed():
    """A small organ in a large image, and its place in it, which is a copy of the same organ's alone."""
    mask, affine = shape(ball(9), 12)
    large = np.zeros((200, 180, 160), bool)
    large[100:124, 90:114, 60:84] = mask
    alone, within = signed_distance(mask, affine), signed_distance(large, affine)
    assert_array_equal(alone.values, within.values)
    assert_allclose(within.origin - alone.origin, [100, 90, 60], atol=1e-12)


def test_an_organ_at_the_border_ends_there():
    """Half a voxel beyond its last one."""
    field = signed_distance(np.ones((20, 20, 20), bool), np.eye(4))
    assert_allclose(field([(-0.5, 10, 10), (10, 19.5, 10), (10, 10, -3.5)]), [0, 0, -3], atol=0.02)


def test_an_empty_mask_has_none():
    with pytest.raises(XfemnavError, match="empty") as caught:
        signed_distance(np.zeros((5, 5, 5), bool), np.eye(4))
    assert caught.value.code == "E201"
