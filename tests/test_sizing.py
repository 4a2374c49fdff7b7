"""Laws of the size field: its values where they are prescribed, its slope everywhere else."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.sizing import SizeField, distance_to_path, is_inside, sample_inside

PATH = np.array([[0.0, 0], [10, 0], [16, 8]])
SQUARE = np.array([[-5.0, -5], [5, -5], [5, 5], [-5, 5], [-5, -5]])
ROUNDING = 1e-12  # mm, on distances of tens of mm


@pytest.fixture
def points():
    return np.random.default_rng(2).uniform(-30, 40, (400, 2))


def test_distances_are_those_of_shapely(points):
    theirs = shapely.distance(shapely.LineString(PATH), shapely.points(points))
    assert_allclose(distance_to_path(points, PATH), theirs, atol=ROUNDING)
    assert_allclose(distance_to_path(points, PATH[:1]), np.linalg.norm(points - PATH[0], axis=1), atol=ROUNDING)


def test_inside_is_that_of_shapely(points):
    angle = np.linspace(0, 6.2, 50)
    star = (20 + 9 * np.cos(5 * angle))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.array_equal(is_inside(points, star), shapely.contains_xy(shapely.Polygon(star), points))
    inside, box = sample_inside(star, 100)
    assert shapely.contains_xy(shapely.Polygon(star), inside).all()
    # Boxes on the outline are wrong by half each at most: outline / box width boxes.
    assert abs(len(inside) * box / shapely.Polygon(star).area - 1) < 0.02


def test_uniform_in_the_corridor_and_far_away(points):
    size = SizeField(3.0, 1.0, 6.0, (PATH,), growth=0.25)
    distance = distance_to_path(points, PATH)
    assert_allclose(size(points)[distance <= 6], 1, atol=0)
    assert_allclose(size(points)[distance >= 6 + 2 / 0.25], 3, atol=0)


def test_no_corridor_size_or_no_path_is_uniform(points):
    for size in (SizeField(3.0), SizeField(3.0, None, 12.0, (PATH,)), SizeField(3.0, 1.0, 12.0)):
        assert_allclose(size(points), 3, atol=0)


def test_closed_region_is_fine_inside_and_grows_from_its_edge():
    size = SizeField(3.0, 1.0, 100.0, (SQUARE,), growth=0.2)
    assert_allclose(size([[0, 0], [4.9, -4.9], [5, 0], [10, 0], [5, 25]]), [1, 1, 1, 2, 3], atol=ROUNDING)


def test_focus_points_have_their_size_and_growth():
    size = SizeField(3.0, focus=(((0, 0), 0.1), ((50, 0), 0.5, 0.1)), growth=0.25)
    assert_allclose(size([[0, 0], [4, 0], [50, 0], [50, 5]]), [0.1, 1.1, 0.5, 1.0], atol=ROUNDING)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.05, 0.4), st.floats(0, 15), st.integers(0, 2**31))
def test_size_never_grows_faster_than_asked(growth, width, seed):
    rng = np.random.default_rng(seed)
    size = SizeField(4.0, 0.5, width, (PATH, SQUARE), (((3, -9), 0.05),), growth)
    a, b = rng.uniform(-40, 40, (2, 300, 2))
    b = a + rng.uniform(0, 1, (300, 1)) * (b - a)
    assert (np.abs(size(a) - size(b)) <= growth * np.linalg.norm(a - b, axis=1) + ROUNDING).all()


@pytest.mark.parametrize(
    "sizes",
    [{"element_mm": 0}, {"element_mm": np.nan}, {"element_mm": 3, "corridor_element_mm": -1},
     {"element_mm": 3, "growth": 0}, {"element_mm": 3, "focus": (((0, 0), 0.0),)}],
)
def test_sizes_must_be_positive(sizes):
    with pytest.raises(XfemnavError, match="E207"):
        SizeField(**sizes)
