"""Placing a cut in an organ: clipping, the mouth, and every refusal with its code."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shapely.ops import substring

from data_synthetic import domains
from tests.meshes import turn
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.geometry.chart import Chart
from xfemnav.geometry.plane.cut import PROLONG_MM, Cut, left_normals, place_cut

SQUARE = domains.rectangle(100, 100)  # [-50, 50]^2
# Clipping is one intersection of two lines: a few rounding errors of coordinates of size 100.
CLIP = 1e-12


def refused(code, path, boundary=SQUARE, **kind):
    with pytest.raises(XfemnavError) as caught:
        place_cut(path, boundary, **kind)
    assert caught.value.code == code
    return caught.value.message


def test_a_cut_from_outside_is_clipped_where_it_enters():
    cut = place_cut([(-80, 10), (0, 10), (20, 30)], SQUARE)
    assert_allclose(cut.path, [(-50, 10), (0, 10), (20, 30)], atol=CLIP)
    assert cut.mouth and cut.craniotomy
    assert cut.length == pytest.approx(50 + np.hypot(20, 20))
    assert_allclose(cut.arc, [0, 50, 50 + np.hypot(20, 20)])
    assert_allclose(cut.at(0), cut.path[0])
    assert_allclose(cut.at(1), cut.path[-1])
    assert_allclose(cut.at(25 / cut.length), (-25, 10))


def test_the_walk_goes_as_drawn_from_the_mouth():
    """A cut is drawn mouth first: clipping must not turn it round, or left and right would change places."""
    for path in ([(-80, 10), (0, 0)], [(80, -3), (10, 10)], [(0, -90), (1, 1)]):
        cut = place_cut(path, SQUARE)
        assert (np.diff(cut.path, axis=0)[0] @ np.diff(path, axis=0)[0]) > 0
        assert_allclose(cut.path[-1], path[-1])


def test_a_cut_right_through_keeps_both_ends_on_the_outline():
    cut = place_cut([(-80, 0), (80, 0)], SQUARE)
    assert_allclose(cut.path, [(-50, 0), (50, 0)], atol=CLIP)


def test_a_start_a_little_inside_is_prolonged_backwards_with_a_warning():
    with pytest.warns(XfemnavWarning, match="W301"):
        cut = place_cut([(-48, 4), (0, 28)], SQUARE)
    assert_allclose(cut.path, [(-50, 3), (-48, 4), (0, 28)], atol=CLIP)
    assert cut.mouth


def test_a_start_near_an_outline_that_the_line_does_not_meet_goes_the_short_way():
    with pytest.warns(XfemnavWarning, match="W301"):
        cut = place_cut([(0, 48), (30, 48), (30, 0)], SQUARE)
    assert_allclose(cut.path[0], (0, 50), atol=CLIP)


def test_a_start_deep_inside_wants_internal():
    message = refused("E302", [(-44, 0), (0, 0)])
    assert "6.0 mm" in message and "internal=True" in message
    cut = place_cut([(-44, 0), (0, 0)], SQUARE, internal=True)
    assert not cut.mouth and not cut.craniotomy
    assert_allclose(cut.path, [(-44, 0), (0, 0)])
    assert PROLONG_MM == 5.0  # the depth that the manual states


def test_a_cut_outside_is_refused_and_the_frame_suggested():
    boundary = np.add(SQUARE, (100, 0))
    assert 'did you mean space="lps"' in refused("E301", [(-120, 0), (-60, 3)], boundary)
    assert "did you mean" not in refused("E301", [(0, 200), (3, 160)], boundary)


@pytest.mark.parametrize("path", [[(0, 0), (0, 0)], [(0, 0)], [], [(0, 0), (np.nan, 1)], [(0, 0, 0), (1, 1, 1)]])
def test_a_cut_without_length_is_refused(path):
    refused("E303", path)


def test_repeated_points_are_merged_with_a_warning():
    with pytest.warns(XfemnavWarning, match="W302"):
        cut = place_cut([(-80, 0), (-80, 0), (-10, 0), (-10, 0), (0, 9)], SQUARE)
    assert_allclose(cut.path, [(-50, 0), (-10, 0), (0, 9)], atol=CLIP)


def test_a_crossing_is_refused_with_its_place():
    message = refused("E304", [(-80, 0), (20, 0), (20, 20), (0, 20), (0, -20)])
    assert "(0.0, 0.0)" in message and "1 and 4" in message


def test_a_closed_loop_is_refused():
    refused("E304", [(-10, -10), (10, -10), (10, 10), (-10, -10)], internal=True)


@pytest.mark.parametrize(
    "path",
    [
        [(-80, 0), (0, 0), (0, 80), (20, 80), (20, 0)],  # out and in again
        [(-80, 0), (0, 0), (0, 50), (20, 50), (20, 0)],  # along the outline
        [(-80, 0), (-20, 50), (20, 0)],  # touches the outline from inside
        [(-80, 0), (0, 0), (49.9999999999, 0), (20, 10)],  # the same up to rounding
    ],
)
def test_leaving_and_entering_again_is_refused(path):
    refused("E305", path)


def test_a_cut_along_the_outline_does_not_enter():
    refused("E301", [(-50, -20), (-50, 20)])


def test_left_is_left_when_walking():
    assert_allclose(left_normals(np.array([(0, 0), (2, 0), (2, 3), (0, 3)])), [(0, 1), (-1, 0), (0, -1)])


def test_cuts_are_read_only():
    cut = Cut([(0, 0), (1, 0)])
    with pytest.raises(ValueError):
        cut.path[0] = 7
    with pytest.raises(ValueError):
        Cut([(0, 0)])


numbers = st.floats(-120, 120, allow_nan=False).map(lambda x: round(x, 3))
paths = st.lists(st.tuples(numbers, numbers), min_size=2, max_size=6)


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
@settings(derandomize=True, max_examples=150, deadline=None)
@given(path=paths, angle=st.floats(0, 6.28), internal=st.booleans())
def test_any_path_is_placed_inside_or_refused_with_a_code(path, angle, internal):
    boundary = domains.gyrated(60, 6, 9, 90) @ turn(angle).T
    organ = shapely.Polygon(boundary)
    try:
        cut = place_cut(path, boundary, internal=internal)
    except XfemnavError as error:
        assert error.code in {"E301", "E302", "E303", "E304", "E305"}
        return
    line = shapely.LineString(cut.path)
    # Clipped ends lie on the outline up to rounding; between them the cut stays clear of it.
    assert organ.buffer(1e-9).covers(line)
    assert organ.exterior.distance(substring(line, 1e-6, line.length - 1e-6)) > 1e-9
    assert cut.mouth == (organ.exterior.distance(shapely.Point(cut.path[0])) < 1e-9)
    assert shapely.is_simple(line)
    drawn = shapely.LineString(path)
    inner = [drawn.project(shapely.Point(x)) for x in cut.path[int(cut.mouth) :]]
    assert (np.diff(inner) > 0).all(), "the cut was turned round"


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
@settings(derandomize=True, max_examples=60, deadline=None)
@given(path=paths, quarter=st.integers(0, 3), mirror=st.booleans())
def test_placing_commutes_with_quarter_turns_and_mirrors(path, quarter, mirror):
    Q = np.round(turn(quarter * np.pi / 2)) @ np.diag([1, -1 if mirror else 1])
    boundary = domains.gyrated(60, 6, 9, 90)
    image = boundary @ Q.T
    outcomes = []
    for points, loop in ((path, boundary), (np.array(path) @ Q.T, image[::-1] if mirror else image)):
        try:
            outcomes.append(place_cut(points, loop).path)
        except XfemnavError as error:
            outcomes.append(error.code)
    one, other = outcomes
    if isinstance(one, str) or isinstance(other, str):
        assert isinstance(one, str) and one == other
    else:
        assert_allclose(other, one @ Q.T, atol=1e-9)  # intersections of nearly parallel lines amplify rounding


@pytest.mark.parametrize("internal", [False, True])
def test_a_cut_drawn_from_its_tip_is_told_so(internal):
    """Left and right would be exchanged, and an internal cut would lose its mouth."""
    square = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]])
    with pytest.raises(XfemnavError, match=r"E302 .*from its tip .* other order"):
        place_cut([[20.0, 20.0], [20.0, 50.0]], square, internal=internal)


def test_a_cut_that_starts_on_another_is_its_branch():
    stem = np.array([[-60.0, 0.0], [0.0, 0.0]])
    branch = place_cut([(-20, 0), (-10, 15)], SQUARE, others=[stem])
    assert not branch.mouth and not branch.craniotomy
    assert_allclose(branch.path, [(-20, 0), (-10, 15)])
    with pytest.warns(XfemnavWarning, match=r"W304 .* 1\.50 mm beside"):
        joined = place_cut([(-20, 1.5), (-10, 15)], SQUARE, others=[stem])
    assert_allclose(joined.path, [(-20, 0), (-20, 1.5), (-10, 15)])
    assert "another cut" in refused("E302", [(-20, 2.5), (-10, 15)], others=[stem])
    # Near the outline it is a cut of its own, with the mouth that it was drawn towards.
    with pytest.warns(XfemnavWarning, match="W301"):
        assert place_cut([(-48, 0.5), (-30, 15)], SQUARE, others=[stem]).mouth


def test_a_cut_is_a_chart():
    cut = Cut([[0, 0], [3, 4]], "approach")
    asked = {name: getattr(cut, name) for name, value in vars(Chart).items() if isinstance(value, property)}
    assert asked.pop("mouth_line").tolist() == [[0, 0]]
    assert asked == {"name": "approach", "mouth": True, "craniotomy": True, "length": 5}
