"""Thin strips, in which elements are too stiff, and blades that hold a shred while the brain stays put."""

import re
import warnings

import numpy as np
import pytest

from data_synthetic import domains
from tests.meshes import BRAIN, cut_in, disc, jittered, outline, posed
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.resection import place_resection
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.limits import STRIP_ELEMENTS
from xfemnav.mechanics.rules import Arc, Retraction, Skull
from xfemnav.mechanics.solving.solution import solve

BOX = jittered(60.0, 30.0, 1.0, 0.25, seed=3)
OPEN = tuple(Retraction(0, side, normal_mm=1.0, blade=(0.1, 0.7)) for side in (1, -1))


def told(code, cuts, retractions=(), mesh=BOX, resections=()):
    """The warnings of a code that a problem brings."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        posed(mesh, tuple(cuts), BRAIN, Skull("fixed", 5.0, 2.0), retractions, resections=resections)
    return [item.message.message for item in found if item.message.code == code]


def hole(mesh, *corners):
    return place_resection([corners], outline(mesh), "cavity")


def slanting(degrees):
    """A cut that enters the box's top at an angle."""
    along = np.array([np.cos(np.deg2rad(degrees)), -np.sin(np.deg2rad(degrees))])
    return cut_in(BOX, *(np.array([12.0, 30.0]) + s * along for s in (-5.0, 25.0)))


# Strips ---------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("depth,thin", [(1.5, True), (2.5, True), (4.0, False), (8.0, False)])
def test_a_strip_over_an_internal_cut_is_told_by_its_elements(depth, thin):
    """Elements of 1 mm: the message has the width, and a size that three of go into it."""
    found = told("W306", [cut_in(BOX, (15, 30 - depth), (40, 30 - depth), internal=True)])
    assert bool(found) == thin
    if thin:
        (text,) = found
        assert f"{depth:.1f} mm from it" in text and "the outline" in text
        size = float(re.search(r"corridor_element_mm=([\d.]+)", text)[1])
        assert depth / STRIP_ELEMENTS.value - 0.1 <= size <= depth / STRIP_ELEMENTS.value


def test_finer_elements_are_no_longer_told():
    cut = [(15, 27.5), (40, 27.5)]
    fine = distmesh(domains.rectangle(60, 30, centre=(30, 15)), SizeField(3.0, 0.7, 4.0, (np.array(cut),)))
    assert not told("W306", [cut_in(fine, *cut, internal=True)], mesh=fine)


def test_a_strip_is_as_much_too_stiff_as_is_said():
    """What the limit stands on: 2.5 elements across are over 15 % too stiff, six of them under 10 %."""
    def gives(size):
        path = np.array([(14.0, 27.5), (41.0, 27.5)])
        mesh = distmesh(domains.rectangle(60, 30, centre=(30, 15)), SizeField(3.0, size, 4.0, (path,)))
        cut = cut_in(mesh, (16, 27.5), (39, 27.5), internal=True)
        push = (Retraction(0, 1, force_mN_per_mm=(0, 0.02), blade=(0.2, 0.8)),)
        below = Skull("free", arcs=(Arc((0, 30), (60, 30), "fixed"),))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "W306")
            return solve(posed(mesh, (cut,), BRAIN, below, push)).max_displacement_mm

    best = gives(0.3)
    assert best / gives(1.0) > 1.15 and best / gives(0.42) < 1.10


def test_strips_between_cuts_walls_and_outline_are_told():
    level = cut_in(BOX, (15, 15), (45, 15), internal=True)
    beside = Cut([(18.0, 17.0), (42.0, 17.2)], name="other", mouth=False)
    (text,) = told("W306", [level, beside])
    assert "cut 'cut' runs along cut 'other'" in text
    wall = hole(BOX, (20, 16.8), (40, 16.8), (40, 24), (20, 24))
    (text,) = told("W306", [level], resections=(wall,))
    assert "the wall of 'cavity'" in text
    (text,) = told("W306", [], resections=(hole(BOX, (15, 20), (45, 20), (45, 28), (15, 28)),))
    assert "the wall of 'cavity' runs along the outline" in text


def test_a_cut_that_turns_back_runs_along_itself():
    (text,) = told("W306", [cut_in(BOX, (15, 15), (40, 15), (41, 16), (40, 17), (16, 17), internal=True)])
    assert "runs along itself" in text


@pytest.mark.parametrize("cuts", [
    [cut_in(BOX, (30, 40), (30, 12))], [slanting(60)], [slanting(40)], [slanting(25)],
    [cut_in(BOX, (30, 40), (30, 12)), Cut([(30.0, 20.0), (40.0, 15.0)], name="branch", mouth=False)],
    [cut_in(BOX, (30, 40), (30, 12)), Cut([(20.0, 20.0), (45.0, 21.0)], name="across", mouth=False)],
    [cut_in(BOX, (30, 40), (30, 20), (36, 14))], [cut_in(BOX, (30, 40), (30, 2))],
    [cut_in(disc(), (3, 80), (1.7, 12.3))],
], ids=["mouth", "60", "40", "25", "branch", "crossing", "bend", "tip near the outline", "disc"])
def test_where_lines_only_meet_nothing_is_told(cuts):
    mesh = disc() if len(cuts) == 1 and np.abs(cuts[0].path).max() > 60 else BOX
    assert not told("W306", cuts, mesh=mesh)


def test_a_cut_into_a_cavity_makes_no_strip():
    cavity = hole(BOX, (20, 5), (40, 5), (40, 15), (20, 15))
    assert not told("W306", [cut_in(BOX, (30, 40), (30, 10))], resections=(cavity,))


# Blades on slivers ----------------------------------------------------------------------------------------------------

DOWN = cut_in(BOX, (30, 40), (30, 8))  # left of it, walking down, is +x


def test_a_blade_on_brain_is_not_told():
    assert not told("W305", [DOWN], OPEN)
    assert not told("W305", [slanting(40)], OPEN)
    assert not told("W305", [cut_in(disc(), (3, 80), (1.7, 12.3))], OPEN, mesh=disc())
    through = cut_in(BOX, (30, 40), (30, -5))
    assert not told("W305", [through], OPEN)


@pytest.mark.parametrize("width,sliver", [(1.5, True), (2.4, True), (6.0, False)])
def test_a_shred_between_two_cuts_is_named(width, sliver):
    other = Cut([(30.0 + width, 30.0), (30.0 + width, 6.0)], name="other")
    found = told("W305", [DOWN, other], OPEN)
    assert bool(found) == sliver
    if sliver:
        (text,) = found
        assert "left lip of cut 'cut'" in text and "right" not in text


def test_a_shred_beside_a_cavity_is_named():
    cavity = hole(BOX, (31.8, 3), (50, 3), (50, 31), (31.8, 31))
    (text,) = told("W305", [DOWN], OPEN, resections=(cavity,))
    assert "left lip" in text
    assert not told("W305", [DOWN], OPEN, resections=(hole(BOX, (40, 3), (50, 3), (50, 31), (40, 31)),))


def test_a_lump_on_a_narrow_neck_is_named_and_the_brain_behind_stays_put():
    """Some 7 mm square between the cut and three others, on a neck of 1.5 mm."""
    around = Cut([(30.0, 24.0), (37.0, 24.0), (37.0, 17.0), (31.5, 17.0)], name="around", mouth=False)
    blade = (Retraction(0, 1, normal_mm=1.0, blade=(0.29, 0.55)),)
    (text,) = told("W305", [DOWN, around], blade)
    assert "hangs on" in text
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solution = solve(posed(BOX, (DOWN, around), BRAIN, Skull("fixed", 5.0, 2.0), blade))
    middle = solution.rest.mean(axis=1)
    behind = (np.abs(middle[:, 1] - 20.5) < 3) & (middle[:, 0] > 38)
    lump = (np.abs(middle[:, 1] - 20.5) < 3) & (middle[:, 0] > 30) & (middle[:, 0] < 37)
    moved = np.linalg.norm((solution.moved - solution.rest).mean(axis=1), axis=1)
    assert moved[lump].mean() > 3 * moved[behind].mean()


def test_a_whole_lip_held_pointwise_is_judged_without_a_word_of_numpy_s():
    held = tuple(Retraction(0, side, normal_mm=1.0, blade=None) for side in (1, -1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posed(BOX, (DOWN,), BRAIN, Skull("fixed", 5.0, 2.0), held, lip_constraint="pointwise")


def test_a_blade_that_only_pulls_is_judged_too():
    other = Cut([(31.5, 30.0), (31.5, 6.0)], name="other")
    assert told("W305", [DOWN, other], (Retraction(0, 1, force_mN_per_mm=(0.01, 0.0), blade=(0.1, 0.7)),))
