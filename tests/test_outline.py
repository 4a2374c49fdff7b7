"""Outline and signed distance: finer than a pixel, and always a simple polygon."""

import warnings

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.ndimage import binary_fill_holes, gaussian_filter

from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.organ.masks import one_piece
from xfemnav.imaging.organ.outline import outline_of, rings_of_mask

ORIGIN = np.array([-31.0, 12.0])


def centres(shape, spacing):
    return ORIGIN + np.moveaxis(np.indices(shape), 0, -1) * spacing


def ellipse(shape, spacing, semi_axes):
    """Mask of an ellipse in mm at a place between pixels, and its centre."""
    centre = ORIGIN + (np.array(shape) - 1) / 2 * spacing + [0.21, -0.34]
    return (((centres(shape, spacing) - centre) / semi_axes) ** 2).sum(axis=-1) < 1, centre


def signed_distance(mask, spacing):
    """Distance (n1, n2) mm of the pixel centres from the outline of `mask`, negative inside."""
    outline = shapely.Polygon(outline_of(mask, (0.0, 0.0), spacing))
    points = shapely.points(np.moveaxis(np.indices(mask.shape), 0, -1) * np.asarray(spacing, float))
    return np.where(shapely.contains(outline, points), -1, 1) * shapely.distance(outline.exterior, points)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 0.5), (0.5, 1.5), (2.0, 0.7)])
def test_disc_is_found_finer_than_a_pixel(spacing):
    shape = tuple(int(100 / s) for s in spacing)
    mask, centre = ellipse(shape, np.array(spacing), (40.0, 40.0))
    radius = np.linalg.norm(outline_of(mask, ORIGIN, spacing) - centre, axis=1)
    # Where the edge runs along a pixel row, the mask itself does not know it better than half a pixel.
    assert abs(radius - 40).max() < 0.6 * max(spacing)
    assert np.sqrt(np.mean((radius - 40) ** 2)) < 0.3 * max(spacing)  # a staircase has 1 / sqrt(12) along rows alone
    distance = signed_distance(mask, spacing)
    exact = np.linalg.norm(centres(shape, np.array(spacing)) - centre, axis=-1) - 40
    assert abs(distance - exact).max() < 0.6 * max(spacing)
    assert abs((distance - exact).mean()) < 0.1 * max(spacing)


@settings(max_examples=20, deadline=None)
@given(st.floats(12, 40), st.floats(12, 40), st.floats(0.5, 1.5), st.floats(0.5, 1.5))
def test_area_is_that_of_the_mask(a, b, s1, s2):
    spacing = np.array([s1, s2])
    mask, _ = ellipse(tuple((100 / spacing).astype(int)), spacing, (a, b))
    area = shapely.Polygon(outline_of(mask, ORIGIN, spacing)).area
    # Smoothing is curvature flow: it takes sigma^2 / 2 times the total curvature 2 pi, whatever the shape: 3.1 pixels.
    assert area == pytest.approx((mask.sum() - np.pi) * s1 * s2, rel=0.003)


@pytest.mark.filterwarnings("ignore:W207")
@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1.2, 4), st.floats(0.3, 0.7))  # no finer than the smoothing
def test_outline_of_any_blob_is_one_simple_loop(seed, size, share):
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(40, 50)), size)
    mask = one_piece(noise > np.quantile(noise, share))
    loop = outline_of(mask, ORIGIN, (1.0, 1.2))
    polygon = shapely.Polygon(loop)
    assert polygon.is_valid and polygon.exterior.is_ccw and len(loop) >= 4
    assert np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).min() > 0
    # What lies inside is more than half organ after the smoothing, or a hole. Strands thinner than it may be lost.
    inside = shapely.contains_xy(polygon, *centres(mask.shape, (1.0, 1.2)).reshape(-1, 2).T).reshape(mask.shape)
    smooth = gaussian_filter(np.pad(mask, 5).astype(float), 1.0) > 0.499  # corners 1e-3 pixels apart are one
    assert not (inside & ~binary_fill_holes(smooth)[5:-5, 5:-5]).any()


def test_outline_moves_with_the_origin_and_distance_does_not():
    mask, _ = ellipse((60, 50), np.ones(2), (20, 15))
    loop = outline_of(mask, (0, 0), (1, 1))
    np.testing.assert_allclose(outline_of(mask, (5, -3), (1, 1)), loop + np.array([5, -3]))
    np.testing.assert_allclose(outline_of(mask, (0, 0), (2, 2)), 2 * loop)
    rolled = np.roll(mask, (3, -4), (0, 1))
    np.testing.assert_allclose(np.roll(signed_distance(mask, (1, 1)), (3, -4), (0, 1))[rolled],
                               signed_distance(rolled, (1, 1))[rolled], atol=1e-9)


def test_sign_is_that_of_the_mask():
    mask, _ = ellipse((60, 50), np.ones(2), (20, 15))
    distance = signed_distance(mask, (1, 1))
    assert ((distance < 0) == mask)[abs(distance) > 0.5].all()


def test_an_organ_cut_by_the_edge_of_the_slice_is_closed_there():
    mask = np.zeros((30, 20), bool)
    mask[:12] = True
    loop = outline_of(mask, (0, 0), (1, 1))
    assert shapely.Polygon(loop).area == pytest.approx(12 * 20, rel=0.02)  # rounded corners
    np.testing.assert_allclose(loop.min(axis=0), [-0.5, -0.5], atol=0.05)


@pytest.mark.filterwarnings("ignore:W207")
def test_the_largest_of_several_loops_is_taken():
    mask = np.zeros((60, 40), bool)
    mask[5:30, 5:30], mask[40:50, 5:15] = True, True
    mask[30:40, 9] = True  # a strand that smoothing severs
    assert shapely.Polygon(outline_of(mask, (0, 0), (1, 1))).area == pytest.approx(25 * 25, rel=0.02)


@pytest.mark.parametrize("mask", [np.zeros((9, 9), bool), np.eye(9, dtype=bool)])
def test_a_mask_without_inside_is_refused(mask):
    with pytest.raises(XfemnavError, match="E201"):
        outline_of(mask, (0, 0), (1, 1))


def test_a_part_on_a_thin_neck_is_lost_with_a_warning():
    """A neck of one pixel does not survive smoothing (its middle falls to .38 of the mask); one of three does."""
    mask = np.zeros((60, 40), bool)
    mask[5:30, 5:35] = mask[40:55, 10:30] = True
    mask[30:40, 20] = True
    with pytest.warns(XfemnavWarning, match="W207") as caught:
        outline = outline_of(mask, (0, 0), (1, 1))
    assert outline[:, 0].max() < 40
    lost = float(str(caught[0].message).split()[1])
    assert lost == pytest.approx(15 * 20, rel=0.05)
    mask[30:40, 19:22] = True
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert outline_of(mask, (0, 0), (1, 1))[:, 0].max() > 50


def test_rings_go_around_holes_and_several_components():
    mask = np.zeros((60, 50), bool)
    mask[5:30, 5:30], mask[12:22, 12:22], mask[40:55, 30:45] = True, False, True
    rings = rings_of_mask(mask, (-3.0, 2.0), (0.5, 0.8))
    areas = sorted(shapely.Polygon(ring).area for ring in rings)
    # smoothing with a Gaussian of a pixel takes pi pixels off every outline (and adds them to holes)
    wanted = sorted([(100 - np.pi) * 0.4, (225 - np.pi) * 0.4, (625 - np.pi) * 0.4])
    assert_allclose(areas, wanted, rtol=0.01)  # corners are no small perturbation of a circle
    assert rings_of_mask(np.zeros((9, 9), bool), (0, 0), (1, 1)) == ()
