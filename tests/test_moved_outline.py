"""The organ's outline now: its facets where they have moved, bridged at mouths, and drawn on where tissue is gone."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from xfemnav.geometry.motion import Motion
from xfemnav.geometry.plane.moved_outline import moved_outline

N = 12
ANGLES = 2 * np.pi * np.arange(N) / N
LOOP = 10 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
FAN = np.stack([np.zeros((N, 2)), LOOP, np.roll(LOOP, -1, axis=0)], axis=1)    # triangles about the centre
SHIFT = np.array([2.0, -1.0])
SMOOTH = np.array([[1.1, 0.2], [-0.1, 0.9]])


def area(loop):
    return shapely.Polygon(loop).buffer(0).area


def test_whole_tissue_takes_its_outline_along():
    found = moved_outline(LOOP, Motion(FAN, FAN @ SMOOTH.T))
    assert shapely.Polygon(found).symmetric_difference(shapely.Polygon(LOOP @ SMOOTH.T)).area < 1e-9
    assert area(found) == pytest.approx(area(LOOP) * np.linalg.det(SMOOTH), rel=1e-12)


def test_a_mouth_is_bridged_by_a_straight_line():
    """Halves that part at a cut along x: the outline goes straight from lip to lip."""
    apart = FAN + np.where(FAN[:, 1:2, 1:] + FAN[:, 2:, 1:] > 0, 1, -1) * [0.0, 1.5]
    found = moved_outline(LOOP, Motion(FAN, apart))
    assert area(found) == pytest.approx(area(LOOP) + 3.0 * 20, rel=1e-12)    # 3 mm over the chord of 20


@pytest.mark.parametrize("first", [0, 4, N - 2])    # also where the loop begins
def test_where_tissue_was_taken_the_outline_moves_as_its_ends_do(first):
    kept = np.roll(np.arange(N), -first)[3:]
    moved = FAN[kept] + SHIFT
    found = moved_outline(LOOP, Motion(FAN[kept], moved))
    assert shapely.Polygon(found).symmetric_difference(shapely.Polygon(LOOP + SHIFT)).area < 1e-9


def test_order_of_triangles_and_rounding_change_nothing():
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(N)
    rounded = FAN[shuffled] + rng.uniform(-1e-6, 1e-6, FAN.shape)    # what a file keeps
    found = moved_outline(LOOP, Motion(rounded, FAN[shuffled] @ SMOOTH.T))
    assert_allclose(found, moved_outline(LOOP, Motion(FAN, FAN @ SMOOTH.T)), atol=1e-5)


def test_an_organ_of_which_nothing_is_left_keeps_its_outline():
    assert_allclose(moved_outline(LOOP, Motion(FAN[:0], FAN[:0])), LOOP)
