"""Filling a gap: bridges are linear and monotone, end at the lips, and tissue is carried on by one pixel."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import binary_dilation

from tests.motions import GRID, MOVED, REST
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.gaps import NOWHERE, bridged, extended
from xfemnav.imaging.carrying.warp import covered, pull_back

TISSUE = Motion(REST, MOVED)


@pytest.fixture(scope="module")
def motion():
    return pull_back(REST, MOVED, GRID.origin, GRID.spacing, GRID.shape)


@pytest.fixture(scope="module")
def empty(motion):
    return covered(REST, GRID.origin, GRID.spacing, GRID.shape) & ~motion.tissue


@pytest.fixture(scope="module")
def rim(motion):
    return binary_dilation(motion.tissue, np.ones((3, 3))) & ~motion.tissue


def strips(edge=9.5, gap=4.0, stretch=1.0):
    """Triangles at rest and moved of a strip that ends at `edge` and stays, and of one beyond it that moves up by `gap`
    and is stretched."""
    low = np.array([[[-1, -1], [30, -1], [30, edge]], [[-1, -1], [30, edge], [-1, edge]]], float)
    high = low * (1, -1) + np.array([0, 2 * edge])
    return np.concatenate([low, high]), np.concatenate([low, (high - (0, edge)) * (1, stretch) + (0, edge + gap)])


def test_the_bridge_is_linear_across_a_straight_gap():
    """A strip moved up beyond a strip at rest: between them the field goes from one to the other in equal steps."""
    pulled = pull_back(*strips(), np.zeros(2), np.ones(2), (20, 20))
    empty = ~pulled.tissue
    field = bridged(pulled, empty)
    assert_array_equal(np.flatnonzero(empty[7]), [10, 11, 12, 13])
    assert_allclose(field[7, 9:15, 1], [0, -0.8, -1.6, -2.4, -3.2, -4], atol=1e-12)
    assert_array_equal(field[~empty], pulled.field[~empty])


@pytest.mark.parametrize("edge", [9.05, 9.3, 9.5, 9.8])
def test_the_bridge_ends_at_the_lips(edge):
    """From lip to lip the field falls by the gap, wherever in a pixel they are, so that all of it rested on the cut."""
    rest, moved = strips(edge, stretch=1.3)
    pulled = pull_back(rest, moved, np.zeros(2), np.ones(2), (20, 20))
    field = bridged(pulled, ~pulled.tissue, Motion(rest, moved))
    n = np.flatnonzero(~pulled.tissue[7])
    assert_allclose(n + field[7, n, 1], edge, atol=2**-11)    # the halvings of the search
    # between the last pixel of tissue and the first of the gap: t (1 - t) pixels at most, t being where the lip is
    lip = (np.floor(edge) + field[7, int(edge), 1]) * (1 - edge % 1) + (n[0] + field[7, n[0], 1]) * (edge % 1)
    assert abs(lip - edge) <= 0.25 + 2**-11


@pytest.mark.parametrize("tissue", [None, TISSUE], ids=["pixels", "lips"])
def test_a_bridge_stays_between_its_ends(motion, empty, tissue):
    """A harmonic function has no extrema inside, and the lips' motion is that of the corners of their triangles."""
    field = bridged(motion, empty, tissue)
    assert np.isfinite(field).all()
    for k in range(2):
        ends = (motion.field if tissue is None else np.stack([*REST - MOVED]))[..., k]
        assert field[..., k].min() >= min(ends.min(), 0) - 1e-12
        assert field[..., k].max() <= max(ends.max(), 0) + 1e-12


def test_tissue_keeps_its_field_and_the_outline_takes_its_neighbours_along(motion, empty, rim):
    outside = ~motion.tissue & ~empty
    for field in (bridged(motion, empty), bridged(motion, empty, TISSUE), extended(motion, empty)):
        assert_array_equal(field[motion.tissue], motion.field[motion.tissue])
        assert_array_equal(field[outside & ~rim], 0)
        i, j = np.argwhere(outside & rim)[::37].T
        for a, b in zip(i, j):    # the value is that of tissue among the eight neighbours
            near = np.zeros_like(rim)
            near[a - 1:a + 2, b - 1:b + 2] = True
            assert (field[a, b] == motion.field[near & motion.tissue]).all(axis=-1).any()


def test_nothing_to_bridge(motion, rim):
    field = bridged(motion, np.zeros(GRID.shape, bool), TISSUE)
    assert_array_equal(field[~rim], motion.field[~rim])


def test_tissue_is_extended_by_one_pixel_and_no_more(motion, empty, rim):
    away = np.abs(extended(motion, empty)).max(axis=-1) == NOWHERE
    assert away.any()
    assert_array_equal(away, empty & ~rim)
