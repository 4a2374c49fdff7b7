"""Posing: what is refused, patch tests, rigid opening, and answers that turn, flip and scale with the question."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from benchmarks.verification import plane
from data_synthetic import domains
from tests.meshes import (
    BRAIN,
    FREE,
    HARD_SKULL,
    cut_in,
    disc,
    grid,
    jittered,
    mapped,
    measured_outline,
    outline,
    posed,
    turn,
)
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.mechanics.rules import Retraction, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

MESH = disc()
CUT = cut_in(MESH, (3, 80), (1.7, 12.3))
BOTH = (Retraction(0, 1, displacement_mm=(3.5, -1), blade=(0, 0.5)),
        Retraction(0, -1, displacement_mm=(-3.5, 1), blade=(0, 0.5)))
LIPS = ("mortar", "nitsche", "pointwise")


def refused(code, *args, **kind):
    with pytest.raises(XfemnavError) as caught:
        posed(*args, **kind)
    assert caught.value.code == code
    return caught.value.message


def test_unknown_words_are_refused():
    for word in ("lip_constraint", "tip_enrichment"):
        with pytest.raises(ValueError, match="magic"):
            posed(MESH, (CUT,), BRAIN, FREE, **{word: "magic"})


def test_tissue_that_locks_is_named():
    with pytest.warns(XfemnavWarning, match="W405"):
        posed(MESH, (CUT,), Material(poisson=0.49), HARD_SKULL)
    with warnings.catch_warnings():  # in plane stress the tissue is free to thicken
        warnings.simplefilter("error")
        posed(MESH, (CUT,), Material(poisson=0.49, stress_state="stress"), HARD_SKULL)


def test_a_free_organ_that_nothing_holds_is_refused():
    refused("E406", MESH, (CUT,), BRAIN, FREE)
    refused("E406", MESH, (), BRAIN, FREE)
    refused("E406", MESH, (CUT,), BRAIN, FREE, (Retraction(0, 1, force_mN_per_mm=(1, 0), blade=(0, 0.5)),))
    assert posed(MESH, (CUT,), BRAIN, FREE, BOTH[:1]).constraints.d.any()  # one held lip is enough


def test_a_cut_off_piece_that_nothing_holds_is_refused():
    """A dumbbell cut through its bridge, held at one end only: the other end would float."""
    mesh = distmesh(domains.dumbbell(), 4.0)
    cut = cut_in(mesh, (0.3, -30), (1.1, 30))
    loop = outline(mesh)
    right = loop[loop[:, 0] > 10]
    message = refused("E306", mesh, (cut,), BRAIN, FREE,
                      boundary_displacement=np.column_stack([right, np.zeros_like(right)]))
    assert "50" in message.split("%")[0] or "49" in message.split("%")[0]
    posed(mesh, (cut,), BRAIN, Skull("fixed"))  # held at both ends it is legal


def test_a_loose_crumb_is_removed_with_a_warning():
    """A cut across a corner of the outline frees less than an element: W311, and the crumb is not in the result."""
    mesh = grid(10, 10.0)
    cut = Cut([(0.0, 9.55), (0.45, 10.0)])
    loop = outline(mesh)
    below = loop[loop[:, 1] < 5]
    with pytest.warns(XfemnavWarning, match="W311"):
        problem = posed(mesh, (cut,), BRAIN, FREE,
                       boundary_displacement=np.column_stack([below, np.zeros_like(below)]))
    area = np.bincount(problem.parts.part, problem.parts.volumes)
    assert_allclose(area[problem.removed].sum(), 0.45**2 / 2, rtol=1e-9)
    solution = solve(problem)
    assert_allclose(solution.rest_areas.sum(), 100 - 0.45**2 / 2, rtol=1e-9)


def test_two_blades_on_one_span_are_refused_and_beside_each_other_they_are_not():
    one = Retraction(0, 1, normal_mm=1.0, blade=(0.0, 0.4))
    over = Retraction(0, 1, normal_mm=2.0, blade=(0.3, 0.6))
    assert "left" in refused("E403", MESH, (CUT,), BRAIN, HARD_SKULL, (one, over))
    posed(MESH, (CUT,), BRAIN, HARD_SKULL, (one, Retraction(0, 1, normal_mm=1.0, blade=(0.45, 0.6))))
    posed(MESH, (CUT,), BRAIN, HARD_SKULL, (one, Retraction(0, -1, normal_mm=1.0, blade=(0.3, 0.6))))


def test_swapped_lips_are_refused():
    swapped = tuple(Retraction(0, -r.side, displacement_mm=r.displacement_mm, blade=r.blade) for r in BOTH)
    assert "left" in refused("E405", MESH, (CUT,), BRAIN, HARD_SKULL, swapped)
    posed(MESH, (CUT,), BRAIN, HARD_SKULL, swapped[:1])  # one lip alone may be pushed anywhere


@pytest.mark.parametrize("depth", [1e-4, 1e-6, 1e-12])
def test_a_cut_a_hair_inside_the_outline_is_refused_not_lost(depth):
    """Within 1e-3 h of the outline it is snapped onto it, and would open nothing in silence."""
    mesh = grid(10, 10.0)
    message = refused("E305", mesh, (Cut([(0.0, 3.3), (depth, 3.3), (depth, 5.6)]),), BRAIN, Skull("fixed", 2.0, 1.0))
    assert "2.3 mm" in message
    posed(mesh, (Cut([(0.0, 3.3), (0.05, 3.3), (0.05, 5.6)]),), BRAIN, Skull("fixed", 2.0, 1.0))


def test_a_cut_on_top_of_another_is_refused():
    mesh = grid(10, 10.0)
    refused("E305", mesh, (Cut([(0.0, 3.3), (6.1, 3.3)]), Cut([(2.0, 3.3), (5.0, 3.3)], mouth=False)), BRAIN, Skull())


def test_a_short_internal_cut_is_named():
    with pytest.warns(XfemnavWarning, match="W303"):
        posed(MESH, (cut_in(MESH, (3, 3), (9, 4), internal=True),), BRAIN, Skull())


def test_a_craniotomy_only_at_the_mouths_that_have_one():
    kept = cut_in(MESH, (3, 80), (1.7, 12.3), craniotomy=False)
    open_, shut = (posed(MESH, (c,), BRAIN, HARD_SKULL) for c in (CUT, kept))
    assert shut.constraints.C.shape[0] > open_.constraints.C.shape[0]


@pytest.mark.parametrize("lips", LIPS)
def test_a_cut_without_lip_data_is_legal_and_moves_nothing(lips):
    solution = solve(posed(MESH, (CUT,), BRAIN, Skull(), lip_constraint=lips))
    assert not solution.U.any() and solution.energy == 0 and solution.residual == 0


# Patch tests: rounding of a solve of condition < 1e5.
PATCH = 1e-10


@pytest.mark.parametrize("material", [BRAIN, Material(3.0, 0.0), Material(1.0, 0.3, "stress")])
def test_patch_without_a_cut(material):
    """A linear field on the outline is the answer everywhere (PHANTOM's patch: u = (.01 x + .002 y, -.004 y))."""
    G = np.array([[0.01, 0.002], [0.0, -0.004]])
    loop = outline(MESH)
    solution = solve(posed(MESH, (), material, Skull(), boundary_displacement=np.column_stack([loop, loop @ G.T])))
    assert_allclose(solution.moved - solution.rest, solution.rest @ G.T, atol=PATCH)
    assert_allclose(solution.strain, np.tile([0.01, -0.004, 0.001], (len(solution.strain), 1)), atol=PATCH)
    assert_allclose(solution.det_F, 1.01 * 0.996, atol=PATCH)


@pytest.mark.parametrize("tip_enrichment", ["topological", "geometric", "none"])
@pytest.mark.parametrize("ends", [((-1, 7.13), (12.37, 8.71)), ((-1, 8.0), (10.0, 8.0)), ((4.2, 5.1), (11.3, 9.6))])
def test_patch_with_a_cut_whose_faces_the_field_leaves_free(ends, tip_enrichment):
    """Uniaxial stress along a straight cut: its faces are free of traction, so the linear field stays the answer."""
    mesh = jittered(20.0, 16.0, 1.0, 0.0 if ends[1] == (10.0, 8.0) else 0.25, seed=0)
    cut = cut_in(mesh, *ends, internal=ends[0][0] > 0)
    along = (cut.path[-1] - cut.path[0]) / cut.length
    Q = np.array([along, [-along[1], along[0]]])
    strain = np.linalg.solve(plane.stiffness(BRAIN), [0.03, 0.0, 0.0])
    G = Q.T @ np.diag(strain[:2]) @ Q + np.array([[0, 0.02], [-0.02, 0]])
    measured = measured_outline(mesh, cut, lambda x, side: x @ G.T)
    solution = solve(
        posed(mesh, (cut,), BRAIN, Skull(), boundary_displacement=measured, tip_enrichment=tip_enrichment)
    )
    assert_allclose(solution.moved - solution.rest, solution.rest @ G.T, atol=PATCH)


@pytest.mark.parametrize("lips", LIPS)
def test_a_rigid_motion_prescribed_everywhere_is_the_answer(lips):
    """Outline and both lips moved by one translation: no strain, whatever condition holds the lips."""
    shift = np.array([0.7, -0.4])
    both = tuple(Retraction(0, s, displacement_mm=tuple(shift), blade=(0, 0.5)) for s in (1, -1))
    measured = measured_outline(MESH, CUT, lambda x, side: np.tile(shift, (len(x), 1)))
    solution = solve(
        posed(MESH, (CUT,), BRAIN, Skull(), both, lip_constraint=lips, boundary_displacement=measured)
    )
    assert_allclose(solution.moved - solution.rest, np.broadcast_to(shift, solution.rest.shape), atol=PATCH)
    assert solution.energy <= 1e-13 * BRAIN.young_kpa


def rigid(angle, shift):
    """Infinitesimal rigid motion: u = angle x + shift, without strain."""
    return lambda x: angle * np.stack([-x[..., 1], x[..., 0]], axis=-1) + shift


LEFT_MOTION, RIGHT_MOTION = rigid(0.05, (0.3, 1.2)), rigid(-0.08, (-0.4, -0.9))
THROUGH = {
    "generic": ((-1, 3.713), (11, 6.291)),
    "kinked": ((-1, 3.7), (4.4, 6.1), (11, 5.2)),
    "along edges": ((0, 4), (10, 4)),
    "through nodes": ((0, 2), (10, 7)),
    "diagonal edges": ((1, 0), (10, 9)),
    "1e-4 beside nodes": ((-1, 4.0001), (11, 4.0001)),
    "1e-6 beside nodes": ((-1, 4.000001), (11, 4.000001)),
    "corner to corner": ((0, 10), (10, 0)),
}


@pytest.mark.parametrize("name", THROUGH)
@pytest.mark.parametrize("mesh", [grid(10, 10.0), jittered(10.0, 10.0, 1.0, 0.3, seed=4)], ids=["grid", "jittered"])
def test_rigid_opening_of_a_domain_cut_right_through(name, mesh):
    """Problem e: two halves moved rigidly by their outlines. Energy <= 1e-13 E d^2, displacement error <= 1e-12 d."""
    cut = cut_in(mesh, *THROUGH[name])
    # At the mouths each half has its own motion; the kinked cut's ends lie on the straight line of its mouths.
    measured = measured_outline(
        mesh, cut, lambda x, side: np.where(side[:, None] > 0, LEFT_MOTION(x), RIGHT_MOTION(x))
    )
    problem = posed(mesh, (cut,), BRAIN, Skull(), boundary_displacement=measured)
    solution = solve(problem)
    left = (solution.body == _left_body(problem))[:, None, None]
    wanted = np.where(left, LEFT_MOTION(solution.rest), RIGHT_MOTION(solution.rest))
    d = 1.0
    assert np.abs(solution.moved - solution.rest - wanted).max() <= 1e-12 * max(d, np.abs(wanted).max())
    assert solution.energy <= 1e-13 * BRAIN.young_kpa * d**2


def _left_body(problem):
    lip = problem.parts.lips.parts[0, 0]
    return problem.enrichment.body[lip]


@pytest.mark.parametrize("lips", LIPS)
def test_rigid_opening_by_both_lips(lips):
    """The same with free outlines, each half held by its lip alone, moved by a translation."""
    mesh = jittered(10.0, 10.0, 1.0, 0.3, seed=4)
    cut = cut_in(mesh, *THROUGH["generic"])
    both = (
        Retraction(0, 1, displacement_mm=(0.3, 1.2), blade=(0, 1.0)),
        Retraction(0, -1, normal_mm=0.7, blade=(0, 1.0)),
    )
    problem = posed(mesh, (cut,), BRAIN, FREE, both, lip_constraint=lips)
    solution = solve(problem)
    normal = np.array([-np.diff(cut.path, axis=0)[0, 1], np.diff(cut.path, axis=0)[0, 0]]) / cut.length
    left = (solution.body == _left_body(problem))[:, None, None]
    wanted = np.where(left, (0.3, 1.2), -0.7 * normal)
    # Conditions by the lip alone leave the far ends of a half 10 mm away to the rounding of its conditions.
    assert np.abs(solution.moved - solution.rest - wanted).max() <= 1e-11
    assert solution.energy <= 1e-13 * BRAIN.young_kpa


def solved(mesh, path, Q, lips, scale=1.0, young=3.0, kind="fixed"):
    """Both lips moved by vectors that turn, flip and scale with the question."""
    cut = cut_in(mesh, *path)
    flips = np.linalg.det(Q) < 0
    move = scale * np.array([[0.9, -0.2], [-1.1, 0.3]]) @ Q.T
    sides = (-1, 1) if flips else (1, -1)
    both = tuple(Retraction(0, s, displacement_mm=tuple(m), blade=(0, 0.5)) for s, m in zip(sides, move))
    skull = Skull(kind, craniotomy_mm=5.0 * scale, ramp_mm=0.0)
    return solve(posed(mesh, (cut,), Material(young, 0.45), skull, both, lip_constraint=lips))


SMALL = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
PATH = np.array([[4.13, 12.0], [5.21, 4.37]])


@pytest.mark.parametrize("lips, kind", [("mortar", "fixed"), ("nitsche", "fixed"), ("pointwise", "sliding")])
@pytest.mark.parametrize(
    "Q", [turn(np.pi / 6), np.diag([-1.0, 1.0]), np.diag([1.0, -1.0]), turn(2.1) @ np.diag([-1.0, 1.0])],
    ids=["30 degrees", "flip x", "flip y", "turned flip"],
)
def test_turned_and_flipped_questions_have_turned_and_flipped_answers(Q, lips, kind):
    """A flip turns left into right: the lip that was on the left is on the right in the mirror."""
    one = solved(SMALL, PATH, np.eye(2), lips, kind=kind)
    shift = np.array([3.0, -7.0])
    other = solved(mapped(SMALL, Q, shift), PATH @ Q.T + shift, Q, lips, kind=kind)
    n = len(SMALL.points)
    # Solves of condition 1e5 with rounding at coordinates of 10 mm; the rule's points differ about the tip by 1e-9.
    assert_allclose(other.U[:n], one.U[:n] @ Q.T, atol=1e-8)
    assert_allclose(other.energy, one.energy, rtol=1e-7)
    force = {r.side: np.array(r.force_mN_per_mm) for r in one.retractor}
    for r in other.retractor:
        assert_allclose(r.force_mN_per_mm, Q @ force[int(r.side * np.sign(np.linalg.det(Q)))], rtol=1e-6, atol=1e-7)


@settings(derandomize=True, max_examples=5, deadline=None)
@given(st.floats(0.01, 100), st.floats(0.01, 1000), st.sampled_from(LIPS))
def test_scaled_questions_have_scaled_answers(scale, young, lips):
    """Lengths in another unit, a stiffer tissue: displacements go with the length, forces and energy with E."""
    one = solved(SMALL, PATH, np.eye(2), lips)
    other = solved(mapped(SMALL, scale * np.eye(2)), PATH * scale, np.eye(2), lips, scale, young)
    n = len(SMALL.points)
    assert_allclose(other.U[:n], scale * one.U[:n], atol=1e-8 * scale)
    assert_allclose(other.energy, one.energy * young / 3.0 * scale**2, rtol=1e-6)
    for a, b in zip(one.retractor, other.retractor):
        assert_allclose(b.force_mN_per_mm, np.multiply(a.force_mN_per_mm, young / 3.0 * scale), rtol=1e-6)


def test_the_answer_is_linear_in_the_displacements():
    one, two, three = (
        solve(posed(MESH, (CUT,), BRAIN, HARD_SKULL, (Retraction(0, 1, displacement_mm=m, blade=(0, 0.5)),))).U
        for m in ((1.0, 0.0), (0.5, -2.0), (2.5, -2.0))
    )
    assert_allclose(2 * one + two, three, atol=PATCH)


@pytest.mark.parametrize("decimals", [4, 5, 6, 8])
@pytest.mark.parametrize("end", [(1.7, 12.3), (-20.3, 31.1), (33.7, -4.9)])
def test_a_straight_cut_drawn_with_many_points_is_that_cut(end, decimals):
    """Points every .1 mm, rounded to a file's decimals: the same solution as with two points."""
    start = np.array((3.0, 80.0))
    n = int(np.linalg.norm(np.array(end) - start) / 0.1)
    dense = np.round(start + np.linspace(0, 1, n)[:, None] * (np.array(end) - start), decimals)
    cuts = [cut_in(MESH, *path) for path in ((start, end), dense)]
    energy = [solve(posed(MESH, (cut,), BRAIN, HARD_SKULL, BOTH)).energy for cut in cuts]
    assert energy[1] == pytest.approx(energy[0], rel=1e-3)  # the points are off by up to 5e-5 mm, the blade's end too
