"""The random masks are usable, repeatable, and as nasty as their kinds promise."""

import numpy as np
import pytest
from scipy import ndimage

from data_synthetic.masks import KINDS, random_mask


@pytest.mark.parametrize("kind", KINDS)
def test_masks_are_not_empty_and_keep_off_the_edge(kind):
    for seed in range(10):
        mask, spacing = random_mask(np.random.default_rng(seed), kind)
        assert mask.dtype == bool and mask.sum() > 10 and (spacing > 0).all() and spacing.shape == (2,)
        assert not (mask[[0, -1]].any() or mask[:, [0, -1]].any())


def test_same_generator_same_mask():
    (one, spacing), (two, again) = (random_mask(np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(one, two) and np.array_equal(spacing, again)


def masks(kind, n=12):
    return [random_mask(np.random.default_rng(seed), kind)[0] for seed in range(n)]


def test_kinds_keep_their_promise():
    assert any(ndimage.label(mask)[1] > 1 for mask in masks("parts"))
    assert any((ndimage.binary_fill_holes(mask) != mask).any() for mask in masks("holes"))
    assert max(mask.sum() for mask in masks("tiny")) < 500 < 40_000 < min(mask.sum() for mask in masks("huge"))
    # An isthmus is lost when opened by a disc wider than itself; at most 13 pixels.
    assert all(ndimage.label(ndimage.binary_opening(mask, iterations=8))[1] != 1 for mask in masks("isthmus"))
