"""Masks: their components, holes and rims beside scipy.ndimage's, which takes longer to load than a mask to clean."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from xfemnav.errors import XfemnavError
from xfemnav.imaging.carrying.gaps import neighbours
from xfemnav.imaging.organ.masks import components, filled, largest_component, one_piece, touched
from xfemnav.imaging.organ.outline import MARGIN, SIGMA, _smoothed

ROUND = ndimage.generate_binary_structure(2, 2)


@st.composite
def masks(draw):
    """Speckle of any density, or blobs."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    mask = rng.random(draw(st.tuples(st.integers(1, 40), st.integers(1, 40)))) < draw(st.floats(0, 1))
    return ndimage.binary_dilation(mask, ROUND, draw(st.integers(1, 3))) if draw(st.booleans()) else mask


@settings(max_examples=150, deadline=None)
@given(masks())
def test_components_holes_and_rims_are_those_of_scipy(mask):
    assert np.array_equal(components(mask) + 1, ndimage.label(mask)[0])
    assert np.array_equal(filled(mask), ndimage.binary_fill_holes(mask))
    assert np.array_equal(touched(mask), ndimage.binary_dilation(mask, ROUND))


@settings(max_examples=50, deadline=None)
@given(masks())
def test_the_smoothed_mask_is_scipys_to_the_last_bit_or_two(mask):
    """Two passes of nine products and sums of numbers up to 1: a few units in the last place."""
    wanted = ndimage.gaussian_filter(np.pad(mask, MARGIN).astype(float), SIGMA)
    np.testing.assert_allclose(_smoothed(mask), wanted, rtol=0, atol=4 * np.finfo(float).eps)


@settings(max_examples=50, deadline=None)
@given(masks())
def test_neighbours_come_in_the_order_of_a_distance_transform(mask):
    """The first of the neighbours that holds tissue is the nearest pixel that scipy's transform names."""
    rim = np.argwhere(touched(mask) & ~mask)
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    tissue = np.pad(mask, 1)
    for pixel in rim:
        first = next(step for step in neighbours(2) if tissue[tuple(pixel + step + 1)])
        assert tuple(pixel + first) == tuple(nearest[:, *pixel])


def test_the_largest_component_is_one_and_the_first_of_equals():
    mask = np.zeros((5, 9), bool)
    mask[1:3, 1:3] = mask[1:3, 5:7] = mask[4, 8] = True
    wanted = np.zeros_like(mask)
    wanted[1:3, 1:3] = True
    assert np.array_equal(largest_component(mask), wanted)
    assert not largest_component(np.zeros((3, 4), bool)).any()


@pytest.mark.parametrize("code, full", [("E201", False), ("E203", True)])
def test_a_mask_of_nothing_or_everything_is_refused(code, full):
    with pytest.raises(XfemnavError) as found:
        one_piece(np.full((6, 7), full))
    assert found.value.code == code


def test_a_mask_that_marks_what_surrounds_the_organ_is_told_as_inverted():
    mask = np.ones((20, 20), bool)
    mask[5:15, 5:15] = False
    with pytest.raises(XfemnavError, match=r"E203 .*75% of the slice .*inverted"):
        one_piece(mask)
    with pytest.raises(XfemnavError, match=r"E203 .*covers the whole slice"):
        one_piece(np.ones((5, 5), bool))
