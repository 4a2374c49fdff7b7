"""Curves are those of 3D Slicer, no chord is farther off than said, and control points are vertices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from xfemnav.imaging.points.splines import LIMIT_VERTICES, drawn

OPEN = [[0, 0, 0], [10, 20, 0], [40, 20, 5], [50, 0, 10]]
CLOSED = [[0, 0, 0], [30, 0, 0], [30, 20, 6], [0, 20, 0]]
# The middle of each piece, by vtkParametricSpline of VTK 9.7 as Slicer sets it up: vtkCardinalSpline in each axis,
# not parametrised by length.
VTK_OPEN = [[2, 7.5, -0.25], [25, 25, 1.875], [48, 7.5, 8.375]]
VTK_CLOSED = [[15, -3.75, -0.5625], [35.625, 10, 3.5625], [15, 23.75, 3.5625], [-5.625, 10, -0.5625]]

coordinates = st.tuples(*[st.floats(-200, 200)] * 3)


def distances(points, vertices):
    """Distance (n,) of points (n, 3) from the polyline through `vertices` (m, 3)."""
    a, along = vertices[:-1], np.diff(vertices, axis=0)
    length2 = np.maximum((along**2).sum(axis=1), 1e-300)
    t = np.clip(((points[:, None] - a) * along).sum(axis=2) / length2, 0, 1)
    return np.linalg.norm(points[:, None] - a - t[..., None] * along, axis=2).min(axis=1)


@pytest.mark.parametrize("control, closed, middles", [(OPEN, False, VTK_OPEN), (CLOSED, True, VTK_CLOSED)])
def test_the_curve_is_that_of_vtk(control, closed, middles):
    vertices, _ = drawn(control, closed, chord_mm=1e-4)
    ring = np.vstack([vertices, vertices[:1]]) if closed else vertices
    assert distances(np.array(middles, float), ring).max() < 1e-4  # the chords' own tolerance


@settings(max_examples=40, deadline=None)
@given(st.lists(coordinates, min_size=3, max_size=8), st.booleans(), st.sampled_from([1.0, 0.05, 0.01]))
def test_chords_keep_their_tolerance_and_control_points_are_vertices(control, closed, chord_mm):
    vertices, at = drawn(control, closed, chord_mm)
    np.testing.assert_array_equal(vertices[at], control)
    assert (np.diff(at) > 0).all()
    ring = np.vstack([vertices, vertices[:1]]) if closed else vertices
    through = np.vstack([control, control[:1]]) if closed else np.array(control)
    curve = CubicSpline(np.arange(len(through)), through, bc_type="periodic" if closed else "clamped")
    fine = curve(np.linspace(0, len(through) - 1, 97))
    assert distances(fine, ring).max() <= chord_mm + 1e-9  # rounding of coordinates of some 100 mm


def test_a_spline_of_two_points_is_their_segment():
    vertices, _ = drawn([[0, 0, 0], [30, 40, 0]], False)
    np.testing.assert_allclose(np.cross(vertices, [30, 40, 0]), 0, atol=1e-11)  # rounding of products of 2000 mm2
    assert (np.diff(vertices[:, 0]) > 0).all() and vertices[-1].tolist() == [30, 40, 0]


def test_turning_and_mirroring_commute_with_drawing():
    """So the frame of a file makes no difference to its curve."""
    mirrored, _ = drawn(np.array(OPEN) * [-1, -1, 1], False)
    np.testing.assert_allclose(mirrored, drawn(OPEN, False)[0] * [-1, -1, 1], atol=1e-13)


def test_a_curve_of_too_many_vertices_is_refused():
    zigzag = np.zeros((20_000, 3))
    zigzag[::2, 0] = 1e4
    with pytest.raises(ValueError, match=f"at most {LIMIT_VERTICES}"):
        drawn(zigzag, False)
