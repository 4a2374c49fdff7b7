"""Lip labels: next to the gap, on the side where the tissue rested, not on walls of a resection."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.ndimage import binary_dilation, label

from data_synthetic.phantom import cut_path, side_of
from tests.motions import GRID, MOVED, REST
from tests.test_motion import PATH, parted, triangles
from xfemnav.imaging.carrying.lip_labels import LEFT, RIGHT, lip_labels
from xfemnav.imaging.carrying.warp import covered, pull_back


def opened(rest, moved, origin, spacing, shape):
    motion = pull_back(rest, moved, origin, spacing, shape)
    return motion, covered(rest, origin, spacing, shape) & ~motion.tissue


@pytest.fixture(scope="module")
def scene():
    motion, gap = opened(REST, MOVED, GRID.origin, GRID.spacing, GRID.shape)
    return motion, gap, lip_labels(motion, gap, REST, [cut_path()])


def test_each_lip_is_the_tissue_of_its_side_next_to_the_gap(scene):
    motion, gap, labels = scene
    assert labels.dtype == np.uint8 and set(np.unique(labels)) == {0, LEFT, RIGHT}
    lips = labels > 0
    assert not (lips & gap).any() and motion.tissue[lips].all()
    assert (binary_dilation(gap, np.ones((3, 3)))[lips]).all()
    assert_array_equal(labels[lips], np.where(side_of(motion.resting[lips]) > 0, LEFT, RIGHT))
    # the two lips are one strip each
    assert all(label(labels == lip, np.ones((3, 3)))[1] == 1 for lip in (LEFT, RIGHT))


def test_turned_round_the_lips_change_places(scene):
    motion, gap, labels = scene
    swapped = lip_labels(motion, gap, REST, [cut_path()[::-1]])
    assert_array_equal(swapped, np.array([0, RIGHT, LEFT], np.uint8)[labels])


def test_a_pixel_on_a_lip_goes_by_its_triangle():
    """Pixel centres on the cut itself, x = 0, moved by whole pixels: the resting place alone does not know the side."""
    box = np.array([[[0, 0], [9, 0], [9, 9]], [[0, 0], [9, 9], [0, 9]]], float)
    rest = np.concatenate([box, box[:, ::-1] * (-1, 1)])
    moved = rest + np.sign(rest.mean(axis=1))[:, None] * (2, 0)
    motion, gap = opened(rest, moved, np.array([-12.0, 1.0]), np.ones(2), (25, 7))
    gap = ~motion.tissue & (abs(np.arange(25) - 12) < 2)[:, None]
    labels = lip_labels(motion, gap, rest, [np.array([[0.0, 0.0], [0.0, 9.0]])])    # travelling up, left is -x
    assert_array_equal(np.argwhere(labels[:, 3])[:, 0], [10, 14])
    assert (labels[10] == LEFT).all() and (labels[14] == RIGHT).all()


def test_at_a_kink_both_segments_count():
    rest = triangles()
    motion, gap = opened(rest, parted(rest), np.full(2, -11.0), np.full(2, 0.25), (89, 89))
    labels = lip_labels(motion, gap, rest, [PATH])
    lips = labels > 0
    assert lips.any()
    left = labels == LEFT    # left of PATH, which runs down, is +x: parted moves it there
    x = motion.resting[..., 0]
    assert (x[left] >= -1e-9).all() and (x[lips & ~left] <= 1e-9).all()


def test_round_a_sharp_kink_it_is_the_outer_side():
    """Nearest to the kink itself, above the first segment's line and yet outside of the bend, which is to the left."""
    path = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 2.0]])
    rest = np.array([[[4.1, -1.0], [7.0, 0.5], [4.1, 3.0]]])
    motion = pull_back(rest, rest, np.array([4.6, 0.3]), np.ones(2), (2, 2))
    assert motion.tissue[0, 0]
    gap = np.zeros((2, 2), bool)
    gap[1, 1] = True
    for cut, side in ((path, RIGHT), (path[::-1], LEFT)):
        assert lip_labels(motion, gap, rest, [cut])[0, 0] == side


def test_walls_of_what_was_taken_out_are_no_lips(scene):
    """A hole away from the cut beside the opened cut: its walls have no side."""
    _, _, labels = scene
    kept = np.linalg.norm(REST.mean(axis=1) - (-20.0, -30.0), axis=1) > 10
    motion = pull_back(REST[kept], MOVED[kept], GRID.origin, GRID.spacing, GRID.shape)
    gap = covered(REST, GRID.origin, GRID.spacing, GRID.shape) & ~motion.tissue
    assert label(gap)[1] > 1
    assert_array_equal(lip_labels(motion, gap, REST[kept], [cut_path()]), labels)


def test_no_gap_and_no_cut(scene):
    motion, gap, _ = scene
    assert not lip_labels(motion, np.zeros_like(gap), REST, [cut_path()]).any()
    assert not lip_labels(motion, gap, REST, []).any()
