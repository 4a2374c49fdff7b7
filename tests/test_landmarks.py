"""Landmarks: exact where the motion is, two-valued on cuts, and told what they are in."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_synthetic.phantom import MOUTH, OPEN, TIP, TRAVEL, Phantom, landmarks, outline, perfect_solution
from tests.images import affine_of, image_of
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.landmarks import moved_points, resting_points
from xfemnav.imaging.frames.slices import take_slice

PHANTOM = Phantom()
REST, MOVED = perfect_solution(PHANTOM)
CUT = np.array([MOUTH, TIP])
MOTION = Motion(REST, MOVED, (CUT,))
TURN = np.array([[0.96, -0.28, 0.0], [0.224, 0.768, -0.6], [0.168, 0.576, 0.8]])    # an oblique axial slice
FRAME = take_slice(image_of(np.zeros((8, 8, 4)), affine_of(TURN * 2.0)), index=1)
NOW = outline(720)[np.r_[0:720, 0]]
NOW = NOW + OPEN.displacement(NOW, np.r_[-1, np.where((NOW[1:-1] - TIP) @ [-TRAVEL[1], TRAVEL[0]] >= 0, 1, -1), 1])
# Resected: the triangles within 6 mm of (-30, -20).
GONE = np.linalg.norm(REST.mean(axis=1) - [-30, -20], axis=1) < 6
RESECTED = Motion(REST[~GONE], MOVED[~GONE], (CUT,))


def test_landmarks_move_with_the_tissue_and_back():
    found = moved_points(landmarks(), FRAME, MOTION, REST)
    exact = landmarks() + PHANTOM.displacement(landmarks())
    # chords of the motion over triangles of up to 2 mm: h^2 / 8 |u''| = .01 mm at 5 mm from the tip
    assert_allclose(found.moved, exact, atol=0.01)
    assert found.flag == ("tissue",) * 20
    assert np.isnan(found.lips).all()
    back = resting_points(found.moved, FRAME, MOTION, NOW)
    assert_allclose(back.moved, landmarks(), atol=1e-9)
    assert back.flag == ("tissue",) * 20


@pytest.mark.parametrize("half", [0.0, 1.5, -40.0])
def test_world_points_keep_their_distance_from_the_plane(half):
    plane = landmarks()
    world = FRAME.to_world(plane) + half * FRAME.axes[2]
    for there, motion in ((moved_points(plane, FRAME, MOTION, REST), moved_points(world, FRAME, MOTION, REST)),
                          (resting_points(plane, FRAME, MOTION, NOW), resting_points(world, FRAME, MOTION, NOW))):
        at, distance = FRAME.from_world(motion.moved)
        assert_allclose(at, there.moved, atol=1e-9)
        assert_allclose(distance[np.isfinite(distance)], half, atol=1e-9)
        assert motion.flag == there.flag


def test_a_point_on_a_cut_has_two_values():
    points = MOUTH + np.array([[5.0], [17.3]]) * TRAVEL
    found = moved_points(points, FRAME, MOTION, REST)
    left, right = (points + OPEN.displacement(points, side) for side in (1, -1))
    assert found.flag == ("on a cut",) * 2
    assert np.isnan(found.moved).all()
    assert_allclose(found.lips, np.stack([left, right], axis=1), atol=0.01)
    assert_allclose(moved_points(points, FRAME, MOTION, REST, side=1).moved, found.lips[:, 0])
    assert_allclose(moved_points(points, FRAME, MOTION, REST, side=[1, -1]).moved, found.lips[[0, 1], [0, 1]])
    world = moved_points(FRAME.to_world(points) + FRAME.axes[2], FRAME, MOTION, REST)
    assert_allclose(world.lips, FRAME.to_world(found.lips) + FRAME.axes[2], atol=1e-9)


def test_where_the_lips_share_a_value_it_is_the_point_s():
    closed = Motion(REST, REST, (CUT,))
    found = moved_points([MOUTH + 9 * TRAVEL], FRAME, closed, REST)
    assert found.flag == ("on a cut",)
    assert_allclose(found.moved, found.points, atol=1e-9)


def test_of_a_lip_that_was_resected_the_other_is_left():
    side = np.sign((REST.mean(axis=1) - TIP) @ [-TRAVEL[1], TRAVEL[0]])
    right_lip = (side < 0) & (np.linalg.norm(REST.mean(axis=1) - MOUTH, axis=1) < 15)
    motion = Motion(REST[~right_lip], MOVED[~right_lip], (CUT,))
    point = [MOUTH + 7 * TRAVEL]
    found = moved_points(point, FRAME, motion, REST)
    assert found.flag == ("on a cut",) and np.isnan(found.lips[0, 1]).all()
    assert_array_equal(found.moved, found.lips[:, 0])
    assert moved_points(point, FRAME, motion, REST, side=-1).flag == ("resected",)


def test_points_without_tissue_say_why():
    gap = MOUTH + sum(OPEN.displacement(MOUTH[None], side)[0] for side in (1, -1)) / 2 + 8 * TRAVEL
    forth = moved_points([[-30, -20], [80, 0], [np.nan, 0], [-30, 20]], FRAME, RESECTED, REST)
    assert forth.flag == ("resected", "outside", "outside", "tissue")
    assert_array_equal(np.isnan(forth.moved[:, 0]), [True, True, True, False])
    back = resting_points([gap, [90.0, 0], [-30, 20]], FRAME, RESECTED, NOW)
    assert back.flag == ("in the cut", "outside", "tissue")
    assert_array_equal(np.isnan(back.moved[:, 0]), [True, True, False])
