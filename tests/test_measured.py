"""Measured motion of the outline: it holds between measured points, and never beyond the last one of a lip."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.probes import basis_at
from tests.meshes import BRAIN, FREE, cut_in, disc, mapped, outline, posed, space_of
from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import Cut
from xfemnav.mechanics.conditions.measured import measured_at
from xfemnav.mechanics.conditions.skull import skull_conditions
from xfemnav.mechanics.rules import Measured, Retraction, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.space.rim import rim_points

MOUTH, TIP = (0.0, 40.0), (0.0, 12.0)
CUT = Cut([MOUTH, TIP])


@functools.cache
def symmetric(n=40, width=60.0, height=40.0) -> Mesh:
    """A box about the y axis whose triangles are mirror images."""
    x, y = np.linspace(-width / 2, width / 2, n + 1), np.linspace(0, height, round(n * height / width) + 1)
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    node = np.arange(len(points)).reshape(len(x), len(y))
    boxes = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    left = np.broadcast_to(x[:-1, None] < 0, boxes[0].shape).ravel()
    a, b, c, d = (k.ravel() for k in boxes)
    rising, falling = [(a, b, c), (a, c, d)], [(a, b, d), (b, c, d)]
    return Mesh(points, np.concatenate([np.stack([np.where(left, p, q) for p, q in zip(one, other)], axis=1)
                                        for one, other in zip(falling, rising)]))


def sinking(x):
    """A motion with x as its axis of symmetry: the surface sinks about the mouth, and is squeezed."""
    return np.stack([-0.03 * x[:, 0] - 0.2 * np.tanh(x[:, 0] / 8), -0.5 * np.exp(-((x[:, 0] / 15) ** 2))], axis=1)


def measured(half_width, spacing, u=sinking, sides=False):
    """Rows of the top beyond `half_width` of the mouth, as measured, and of the bottom, at rest."""
    x = np.arange(half_width, 30.0, spacing)
    top = np.stack([np.concatenate([-x[::-1], x[x > 0]]), np.full(2 * len(x) - (half_width == 0), 40.0)], axis=1)
    base = np.stack([np.linspace(-30, 30, 13), np.zeros(13)], axis=1)
    rows = np.vstack([np.hstack([top, u(top)]), np.hstack([base, 0 * base])])
    # Left of a cut that goes downwards is +x.
    return np.column_stack([rows, np.sign(rows[:, 0]) * (rows[:, 1] > 1)]) if sides else rows


def known_on_top(rows, cuts=(CUT,), pulled=(), mesh=None):
    """x of the nodes of the top that the measured motion holds, and their displacements."""
    space = space_of(mesh or symmetric(), *cuts)
    rim = rim_points(space)
    known, values = measured_at(space, rim, rows, pulled)
    on = known & (rim.points[:, 1] > 39.99)
    order = np.argsort(rim.points[on, 0])
    return rim.points[on][order, 0], values[on][order]


def change(mesh, skull, rows, weight=None):
    """Largest change of any displacement by the cut, and the largest displacement, mm."""
    kind = {"boundary_displacement": rows, "boundary_weight": weight, "tip_enrichment": "none"}
    cut = solve(posed(mesh, (CUT,), BRAIN, skull, **kind))
    whole = posed(mesh, (), BRAIN, replace(skull, openings=(MOUTH,)), **kind)
    u = basis_at(whole.space, cut.rest.reshape(-1, 2)) @ solve(whole).U
    return np.abs((cut.moved - cut.rest).reshape(-1, 2) - u).max(), np.abs(u).max()


@pytest.mark.parametrize("half_width", [0.0, 3.0, 9.9, 10.1, 15.0, 19.0])
@pytest.mark.parametrize("spacing", [2.5, 7.0])
@pytest.mark.parametrize("skull", [FREE, Skull("fixed")])
def test_a_closed_cut_on_an_axis_of_symmetry_changes_nothing(half_width, spacing, skull):
    """Whatever is measured about its mouth; it is pressed shut all along."""
    off, size = change(symmetric(), skull, measured(half_width, spacing, sides=spacing > 5))
    assert off < 1e-3 and size > 0.4


@pytest.mark.parametrize("half_width", [0.0, 6.0, 12.0])
def test_a_closed_cut_changes_nothing_about_an_outline_on_springs(half_width):
    """Elements of .6 mm: the lips pass each other between the means of the contact, by the less the finer they are."""
    off, size = change(symmetric(96), Skull("fixed"), measured(half_width, 2.5), 3.0)
    assert off < 1e-3 and size > 0.4


def test_the_last_measured_value_is_not_carried_on_to_the_mouth():
    """More than 20 mm between the last points of the two lips: the craniotomy is free there."""
    x, _ = known_on_top(measured(12.0, 3.0))
    assert np.abs(x).min() == 12.0 and np.abs(x).max() == 27.0


def test_a_stretch_ends_where_it_was_measured_and_not_at_the_next_node():
    """Penalty springs hold the measured part of the facet in which it ends: 1.5 M / h on it, nothing beyond."""
    space = space_of(symmetric())
    x = np.arange(-12.6, 12.7, 1.4)
    rows = np.column_stack([x, np.full(len(x), 40.0), np.tile([0.3, -0.2], (len(x), 1))])
    found = skull_conditions(space, replace(FREE, measured=Measured(rows)), np.empty((0, 2)), BRAIN)
    shift = np.tile([0.3, -0.2], (len(space.mesh.points), 1)).ravel()
    assert_allclose(found.constraints.C @ shift, found.constraints.d)
    assert_allclose(found.springs @ shift, found.load, atol=1e-12)
    h = space.mesh.sizes[0]
    modulus = BRAIN.p_wave_in([0])[0]
    wanted = 1.5 * modulus / h * 2 * 0.6 * (0.3**2 + 0.2**2)
    assert shift @ (found.springs @ shift) == pytest.approx(wanted, rel=0.05)  # 32 points to a facet


@pytest.mark.parametrize("sides", [False, True])
def test_over_a_mouth_that_stays_shut_the_outline_is_one(sides):
    x, u = known_on_top(measured(6.0, 3.0, sides=sides))
    middle = np.abs(x) < 6.0
    assert middle.sum() >= 7
    assert_allclose(u[middle, 0], sinking(np.array([[6.0, 0.0]]))[0, 0] * x[middle] / 6, atol=1e-7)


@pytest.mark.parametrize("sides", [False, True])
def test_up_to_a_mouth_that_has_opened_nothing_is_known(sides):
    """The points nearest to it have moved apart: they are the lips' last ones. So, too, when a blade acts on a lip."""
    def apart(x):
        return np.stack([0.5 * np.sign(x[:, 0]), 0 * x[:, 0]], axis=1)

    shut = measured(6.0, 3.0, sides=sides)
    for x, _ in (known_on_top(measured(6.0, 3.0, apart, sides)), known_on_top(shut, pulled={0})):
        assert np.abs(x).min() == 6.0
    blades = tuple(Retraction(0, s, normal_mm=2.0, blade=(0, 0.5)) for s in (1, -1))
    problem = posed(symmetric(), (CUT,), BRAIN, FREE, blades, boundary_displacement=shut)
    solution = solve(problem)
    mouth = np.abs(solution.rest - MOUTH).max(axis=2) < 1e-9
    assert_allclose(np.abs((solution.moved - solution.rest)[mouth][:, 0]), 2, atol=0.3)


def test_a_lip_measured_up_to_its_mouth_is_held_up_to_it():
    """Its last point is a pixel from where the cut enters, or at the mouth with a side."""
    def apart(x):
        return np.stack([0.5 * np.sign(x[:, 0]), 0 * x[:, 0]], axis=1)

    x, u = known_on_top(measured(0.7, 3.0, apart))
    assert (np.abs(x) < 1e-9).sum() == 2 and set(np.sign(u[np.abs(x) < 1e-9, 0])) == {-1.0, 1.0}
    rows = measured(3.0, 3.0, apart, sides=True)
    rows = np.vstack([rows, [[*MOUTH, 0.6, 0, 1], [*MOUTH, -0.4, 0, -1]]])
    x, u = known_on_top(rows)
    assert_allclose(np.sort(u[np.abs(x) < 1e-9, 0]), [-0.4, 0.6], atol=1e-6)


def test_between_two_mouths_nothing_is_known_unless_it_was_measured():
    cuts = Cut([(-3.0, 40.0), (-3.0, 20.0)]), Cut([(3.0, 40.0), (3.0, 20.0)])

    def apart(x):
        return np.stack([0.1 * x[:, 0], 0 * x[:, 0]], axis=1)

    outside = measured(6.0, 3.0, apart)
    assert np.abs(known_on_top(outside, cuts)[0]).min() == 6.0
    between = np.array([[-1.5, 40.0, 0.2, 0.0], [1.5, 40.0, 0.2, 0.0]])
    x, u = known_on_top(np.vstack([outside, between]), cuts)
    inner = x[np.abs(x) < 5]
    assert_allclose(inner[[0, -1]], [-1.5, 1.5])
    assert_allclose(u[np.abs(x) < 2, 0], 0.2)


def test_far_from_each_other_points_hold_nothing_between_and_alone_they_are_refused():
    base = measured(0.0, 3.0)[:2]
    assert np.abs(np.diff(known_on_top(measured(2.5, 25.0, sides=True))[0])).max() < 21
    lonely = np.array([[-15.0, 40.0, 0.3, 0.0], [15.0, 40.0, 0.3, 0.0]])
    for rows in (lonely, lonely[:1]):
        for weight in (None, 3.0):
            with pytest.raises(XfemnavError, match=r"E408.*20 mm"):
                posed(symmetric(), (CUT,), BRAIN, Skull("fixed"), boundary_displacement=rows, boundary_weight=weight)
    assert len(known_on_top(base)[0]) > 1


def test_an_outline_without_a_mouth_closes_on_itself():
    """Its first and last points, wherever the count begins, have a stretch between them."""
    mesh = disc()
    loop = outline(mesh)
    space = space_of(mesh)
    rim = rim_points(space)
    for start in (0, 5, 17):
        rows = np.roll(np.hstack([loop, 0.01 * loop]), start, axis=0)
        known, values = measured_at(space, rim, rows)
        assert known.all()
        assert_allclose(values, 0.01 * rim.points, atol=1e-9)


def test_the_mirror_image_has_the_mirror_image_s_motion():
    """A cut that leaves where the other enters; points with sides, on either side of a mouth at a corner of nothing."""
    mirror = np.diag([-1.0, 1.0])
    rows = measured(2.0, 3.0, sides=True)
    rows[:, 2] += 0.2 * np.sign(rows[:, 0])
    x, u = known_on_top(rows)
    other = rows * (-1, 1, -1, 1, -1)
    y, v = known_on_top(other, mesh=mapped(symmetric(), mirror))
    assert_allclose(np.sort(-y), np.sort(x), atol=1e-9)
    assert_allclose(np.sort(-v[:, 0]), np.sort(u[:, 0]), atol=1e-9)


def test_a_cut_right_through_has_two_mouths():
    mesh = symmetric()
    through = cut_in(mesh, (0.0, 45.0), (0.0, -5.0))
    rows = measured(6.0, 3.0)
    rows[:, 2] += np.sign(rows[:, 0]) * (0.8 + 0 * rows[:, 0])
    space = space_of(mesh, through)
    rim = rim_points(space)
    known, _ = measured_at(space, rim, rows)
    near = np.abs(rim.points[:, 0]) < 5.9
    assert not known[near & (rim.points[:, 1] > 39)].any()
