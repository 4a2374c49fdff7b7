"""What tissue is measured by: laws of strain, turning and growth on motions that are known."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from xfemnav.geometry.mesh import orient
from xfemnav.mechanics.solving.measures import densest, displacement_gradient, exceeded, measure
from xfemnav.mechanics.tissue.elasticity import Material, Tissue

AREA = 50.0


def strip(F, n=8, model="linear", young=None, moved_part=1.0):
    """A problem and its solution: n by n squares in two triangles each, in all 50 mm^2, of which the left `moved_part`
    of the width moves by F (2, 2), and the rest stays."""
    h = np.sqrt(AREA) / n
    i, j = (index.ravel() for index in np.indices((n, n)))
    a = np.stack([i, j], axis=1) * h
    b, c, d = (a + h * np.array(step) for step in ((1, 0), (1, 1), (0, 1)))
    rest = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    F = np.asarray(F, float)
    moves = np.tile(i < moved_part * n, 2)
    moved = np.where(moves[:, None, None], rest @ F.T, rest)
    H = displacement_gradient(rest, moved)
    strain = np.stack([H[:, 0, 0], H[:, 1, 1], (H[:, 0, 1] + H[:, 1, 0]) / 2], axis=1)
    part = np.arange(len(rest))
    solution = SimpleNamespace(rest=rest, moved=moved, part=part, strain=strain, model=model,
                               det_F=np.linalg.det(np.eye(2) + H), rest_areas=orient(*rest.swapaxes(0, 1)) / 2)
    material = Material() if young is None else Tissue(np.where(moves, *young), np.full(len(rest), 0.45))
    return SimpleNamespace(material=material, parts=SimpleNamespace(cell=part)), solution


def turned(degrees):
    """The rotation by an angle."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s], [s, c]])


@given(st.floats(-80, 80), st.sampled_from([0.25, 0.5, 1.0]))
def test_a_turned_piece_is_misplaced_by_its_size_times_half_the_square_of_its_angle(degrees, part):
    found = measure(*strip(turned(degrees), moved_part=part)).turning
    assert found.degrees == pytest.approx(abs(degrees), abs=1e-9)
    assert found.error_mm == pytest.approx(np.deg2rad(degrees) ** 2 / 2 * np.sqrt(part * AREA), abs=1e-9)


@given(st.floats(0.0, 80))
def test_small_rotations_blow_tissue_up_by_the_square_of_the_tangent(degrees):
    """The linear model's F of a rotation is 1 + skew: its angle is the polar one, its area grows by 1 + tan^2."""
    tangent = np.tan(np.deg2rad(degrees))
    found = measure(*strip([[1, -tangent], [tangent, 1]]))
    assert found.turning.degrees == pytest.approx(degrees, abs=1e-9) and found.main_strain < 1e-12
    assert found.resized_mm2 == pytest.approx(AREA * (tangent**2 > 1)) and found.tripled_mm2 == pytest.approx(
        AREA * (tangent**2 > 2))


@pytest.mark.parametrize("F, resized, tripled", [
    (np.eye(2), 0, 0), (np.diag([1.9, 1.0]), 0, 0), (np.diag([2.1, 1.0]), 1, 0), (np.diag([0.49, 1.0]), 1, 0),
    (np.diag([0.51, 1.0]), 0, 0), (np.diag([2.0, 1.6]), 1, 1), (np.diag([-1.0, 1.0]), 1, 0)])
def test_areas_that_change(F, resized, tripled):
    found = measure(*strip(F, moved_part=0.5))
    assert_allclose([found.resized_mm2, found.tripled_mm2], [resized * AREA / 2, tripled * AREA / 2], atol=1e-9)


@pytest.mark.parametrize("columns, counts", [(1, False), (2, True)])
def test_strain_is_what_a_hundredth_of_the_main_tissue_exceeds(columns, counts):
    """Of 150 columns two are more than a hundredth, one is less."""
    found = measure(*strip(np.diag([1.2, 1.0]), n=150, moved_part=columns / 150))
    assert found.main_strain == pytest.approx(0.2 * counts)


@pytest.mark.parametrize("young, counts", [
    ((3.0, 3.0), True), ((1.6, 3.0), True), ((1.4, 3.0), False), ((9.0, 3.0), True)])
def test_far_softer_tissue_is_left_out(young, counts):
    """A quarter of the tissue is strained, turned and blown up; the other three are the main tissue."""
    F = 3 * turned(60)
    found = measure(*strip(F, moved_part=0.25, young=young))
    assert found.main_young_kpa == 3.0
    assert (found.main_strain > 0.1, found.turning.error_mm > 1, found.tripled_mm2 > 10) == (counts,) * 3


def test_finite_strains_have_rotations_right():
    found = measure(*strip(2 * turned(60), model="neo-hookean"))
    assert found.turning is None and found.tripled_mm2 == pytest.approx(AREA)


def test_places_are_where_it_is():
    found = measure(*strip(2 * turned(60), moved_part=0.25))
    for name in ("main_strain", "resized_mm2", "tripled_mm2", "turning_mm"):
        x, y = found.places[name]
        assert 0 < x < np.sqrt(AREA) / 4 and 0 < y < np.sqrt(AREA), name


def test_the_densest_place_is_no_mean_of_two():
    points = np.array([[1.0, 1.0], [2.0, 2.0], [41.0, 41.0]])
    assert_allclose(densest(points, np.array([1.0, 1.0, 1.5])), [1.5, 1.5])
    assert_allclose(densest(points, np.array([1.0, 1.0, 2.5])), [41.0, 41.0])


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0.1, 1)), min_size=1, max_size=30), st.floats(0.01, 0.99))
def test_so_much_tissue_exceeds_it(pairs, share):
    values, areas = np.array(pairs).T
    area = share * areas.sum()
    found = exceeded(values, areas, area)
    assert areas[values > found].sum() <= area + 1e-9 and areas[values >= found].sum() >= area - 1e-9
