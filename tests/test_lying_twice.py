"""Tissue that lies twice is told where it is tissue, and not where a pixel's centre meets a hair of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.warp import pull_back
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.reading.gate import Image
from xfemnav.pipeline.stages.stage_warp import lying_twice

SQUARE = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], float)


def overlapping(width, centre=(10.0, 10.0)):
    """Two pieces 8 mm large that overlap by a vertical strip of a `width` mm about a pixel's centre."""
    left, right = np.array(centre) - [8 - width / 2, 4], np.array(centre) - [width / 2, 4]
    moved = np.concatenate([8 * SQUARE + left, 8 * SQUARE + right])
    rest = np.concatenate([8 * SQUARE + left, 8 * SQUARE + right + [40, 0]])
    return SimpleNamespace(rest=rest, moved=moved)


@pytest.mark.parametrize("width, told", [(0.001, False), (0.02, False), (0.2, True), (0.9, True), (3.0, True)])
@pytest.mark.parametrize("pixel", [1.0, 5.0])
def test_a_strip_is_told_by_its_width(width, told, pixel):
    """Where a strip crosses several pixels it is told however thin: a lip has moved through another one."""
    frame = take_slice(Image(np.zeros((20, 20, 1)), np.diag([pixel, pixel, 1, 1.0]), "float64", 1, "", "head"))
    found = overlapping(width)
    motion = pull_back(found.rest, found.moved, frame.origin, frame.spacing, frame.values.shape)
    assert motion.overlap.any()
    twice = lying_twice(motion.overlap, frame, SimpleNamespace(cuts=()), found)
    long = motion.overlap.sum() >= 4
    assert twice.any() == (told or long)
    assert (twice <= motion.overlap).all()


@pytest.mark.parametrize("width, told", [(0.02, False), (0.11, False), (0.13, True), (1.0, True)])
def test_a_sliver_between_lips_that_touch_is_none(width, told):
    """Lips are kept apart in the mean: up to .06 mm beside a pixel's centre is that, more has gone through."""
    frame = take_slice(Image(np.zeros((20, 20, 1)), np.eye(4), "float64", 1, "", "head"))
    rest = np.concatenate([8 * SQUARE + (2, 6), 8 * SQUARE + (10, 6)])
    moved = rest + np.repeat([[[width / 2, 0]], [[-width / 2, 0]]], 2, axis=0)
    motion = Motion(rest, moved, (np.array([[10.0, 14.5], [10, 5.5]]),))
    found = SimpleNamespace(rest=rest, moved=moved, motion=motion)
    overlap = pull_back(rest, moved, frame.origin, frame.spacing, frame.values.shape).overlap
    assert overlap.sum() == 7
    assert lying_twice(overlap, frame, SimpleNamespace(cuts=("cut",)), found).any() == told
