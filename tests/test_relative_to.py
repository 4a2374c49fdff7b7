"""From where a blade's displacement counts: where its lip lies under all else that acts, or its place at rest."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.probes import lip_gaps
from data_synthetic import domains
from tests.meshes import BRAIN, FREE, cut_in, disc, jittered, outline, posed
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.resection import place_resection
from xfemnav.mechanics.conditions.lips import Retraction, lip_quadrature
from xfemnav.mechanics.rules import Arc, Gravity, Pressure, Skull
from xfemnav.mechanics.solving.solution import solve

MESH = disc(70.0, 5.0)
CUT = cut_in(MESH, (3, 80), (1.7, 12.3))
SKULL = Skull("fixed", 35.0)
WEIGHT = Gravity((0.6, -0.8))
BOTH = tuple(Retraction(0, side, normal_mm=4.0, blade=(0.0, 0.6)) for side in (1, -1))
CASES = [("mortar", "topological"), ("nitsche", "topological"), ("pointwise", "none"), ("mortar", "geometric")]


def asked(retractions=(), gravity=WEIGHT, **kind):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "W404")
        return posed(MESH, (CUT,), BRAIN, kind.pop("skull", SKULL), retractions, gravity=gravity, **kind)


def counted(retractions, relative_to):
    return tuple(replace(r, relative_to=relative_to) for r in retractions)


def parted_by(problem, before, after):
    """Mean displacement mm away from the other lip of each held lip, between two solutions."""
    means = []
    for r, span in zip(problem.retractions, problem.spans):
        q = lip_quadrature(problem.space, r.cut, r.side, span)
        u = problem.space.basis_in(q.points, q.parts) @ (after.U - before.U)
        means.append(r.side * q.weights @ (u * q.normals).sum(axis=1) / q.weights.sum())
    return means


@pytest.mark.parametrize("lips,tips", CASES)
def test_blades_part_the_lips_from_where_they_lie(lips, tips):
    """Superposition: without contact the motion is that of the loads and that of the blades alone, one on the other.

    Nearly so by Nitsche's condition, which takes the elements' tractions at a free lip, nearly zero, into account.
    """
    off = 0.01 if lips == "nitsche" else 1e-9
    kind = {"lip_constraint": lips, "tip_enrichment": tips, "lips": "free"}
    lying, alone, both = (solve(asked(*what, **kind)) for what in (((),), (BOTH, None), (BOTH,)))
    assert np.abs(lying.U).max() > 1
    assert_allclose(both.moved - both.rest, (lying.moved - lying.rest) + (alone.moved - alone.rest), atol=off)
    for one, other in zip(both.retractor, alone.retractor):
        assert_allclose(one.force_mN_per_mm, other.force_mN_per_mm, rtol=1e-6 + off)
        assert one.mean_pressure_kPa == pytest.approx(other.mean_pressure_kPa, rel=1e-6 + off)
    assert_allclose([both.lip_error_rms_mm, both.lip_error_max_mm], [alone.lip_error_rms_mm, alone.lip_error_max_mm],
                    atol=1e-8 + off)


def test_from_rest_is_a_choice_and_the_default_of_displacements():
    normal = np.array([CUT.path[0][1] - CUT.path[1][1], CUT.path[1][0] - CUT.path[0][0]]) / CUT.length
    away = tuple(Retraction(0, r.side, displacement_mm=tuple(4.0 * r.side * normal), blade=r.blade) for r in BOTH)
    rest, same, loads = (solve(asked(r)) for r in (counted(BOTH, "rest"), away, counted(away, "loads")))
    assert_allclose(same.U, rest.U, atol=1e-9)
    assert_allclose(loads.U, solve(asked(BOTH)).U, atol=1e-9)
    assert np.abs(loads.U - rest.U).max() > 1


@pytest.mark.parametrize("kind", [{}, {"pressures": (Pressure(0.0),)}, {"gravity": Gravity((0.0, -1.0), 0.0)}])
def test_where_blades_alone_act_they_count_from_rest_to_the_last_bit(kind):
    kind = {"gravity": None} | kind
    loads, rest = (asked(counted(BOTH, how), **kind) for how in ("loads", "rest"))
    assert loads.bare is None
    assert (solve(loads).U == solve(rest).U).all()
    assert asked(counted(BOTH, "rest")).bare is None and asked(BOTH).bare is not None


def test_lips_in_contact_are_parted_from_where_they_touch():
    """A level cut that the weight presses shut; each lip then has its 3 mm, from where both lie."""
    cut = cut_in(MESH, (-80, 3), (10, 2))
    skull, weight = Skull(craniotomy_mm=45.0), Gravity((0.0, -1.0), 10_000.0)
    blades = tuple(Retraction(0, side, normal_mm=3.0, blade=(0.1, 0.6)) for side in (1, -1))
    lying, parted = (solve(posed(MESH, (cut,), BRAIN, skull, r, gravity=weight)) for r in ((), blades))
    problem = posed(MESH, (cut,), BRAIN, skull, blades)
    assert lying.contact and np.abs(lying.moved - lying.rest).max() > 1
    assert_allclose(parted_by(problem, lying, parted), 3.0, atol=1e-8)


def test_a_measured_outline_takes_the_lips_along():
    """The whole outline goes aside, and so do the lips: the blades open them from there."""
    loop = outline(MESH)
    off = np.linalg.norm(loop - CUT.path[0], axis=1) > 15
    rows = np.column_stack([loop, np.tile([2.0, -1.0], (len(loop), 1))])[off]
    kind = {"boundary_displacement": rows, "gravity": None, "skull": FREE}
    still = kind | {"boundary_displacement": rows * [1, 1, 0, 0]}
    aside, at_rest = solve(asked(BOTH, **kind)), solve(asked(BOTH, **still))
    assert_allclose((aside.moved - aside.rest) - (at_rest.moved - at_rest.rest), np.broadcast_to([2.0, -1.0],
                    aside.moved.shape), atol=1e-8)


def test_one_blade_leaves_the_other_lip_to_the_loads():
    """Without contact; the held lip moves by 4 mm from where it lies, along its normal and not along itself."""
    kind = {"lips": "free"}
    one, lying = solve(asked(BOTH[:1], **kind)), solve(asked(**kind))
    problem = asked(**kind)
    arc, gap = lip_gaps(problem.space, one.U - lying.U, 0)
    assert gap[(arc > 2) & (arc < 0.3 * CUT.length)].min() > 2
    assert one.lip_error_rms_mm < 0.2


@pytest.mark.parametrize("model", ["linear", "neo-hookean"])
def test_the_model_s_own_answer_is_counted_from(model):
    lying, parted = (solve(asked(r, model=model, tip_enrichment="none", lips="free")) for r in ((), BOTH))
    problem = asked(BOTH, model=model, tip_enrichment="none", lips="free")
    wanted = problem.counted_from(lying.U.ravel()).constraints
    assert_allclose(wanted.C @ parted.U.ravel(), wanted.d, atol=1e-8)
    own = wanted.group == 0
    assert_allclose((wanted.C @ (parted.U - lying.U).ravel())[own], problem.constraints.d[own], atol=1e-8)


def test_lips_are_judged_by_where_they_come_to_lie():
    """An open wound may be drawn together as far as it gapes; lips that touch, or displacements from rest, may not."""
    together = counted(tuple(replace(r, normal_mm=-0.3, blade=(0.1, 0.4)) for r in BOTH), "loads")
    gaping = Gravity((0.0, 1.0), 15_000.0)  # upwards: the halves part about the mouth
    problem = asked(gravity=gaping)
    arc, gap = lip_gaps(problem.space, solve(problem).U, 0)
    assert gap[(arc > 0.1 * CUT.length) & (arc < 0.4 * CUT.length)].min() > 0.7
    solve(asked(together, gaping))
    for blades, weight in ((together, Gravity((0.0, -1.0))), (counted(together, "rest"), gaping)):
        with pytest.raises(XfemnavError, match="E405"):
            solve(asked(blades, weight))


def test_where_blades_alone_hold_the_organ_it_is_said_what_to_do():
    """Without them it has no place; unless that was asked for, they count from rest."""
    light = Gravity((0.006, -0.008))
    with pytest.raises(XfemnavError, match=r'E406.*relative_to = "rest"'):
        asked(counted(BOTH, "loads"), light, skull=FREE)
    assert (solve(asked(BOTH, light, skull=FREE)).U == solve(asked(counted(BOTH, "rest"), light, skull=FREE)).U).all()


def test_a_piece_that_blades_alone_hold_counts_from_its_mean():
    """A cut right through, and the far side free: the cut-off part has no place of its own but that at rest."""
    mesh = jittered(40.0, 30.0, 2.0, 0.25, seed=3)
    cut = cut_in(mesh, (20.3, -5), (20.3, 35))
    skull = Skull("free", arcs=(Arc((0.0, 30.0), (0.0, 0.0), "fixed"),))
    blade = (Retraction(0, -1, normal_mm=1.0, blade=(0.1, 0.9)),)
    solution = solve(posed(mesh, (cut,), BRAIN, skull, blade, gravity=Gravity((0.0, -1.0))))
    right = solution.rest.mean(axis=1)[:, 0] > 20.3
    assert_allclose((solution.moved - solution.rest)[right].mean(axis=(0, 1))[0], 1.0, atol=0.1)


def test_resected_and_pressed_tissue_is_where_lips_lie():
    """A cavity under pressure moves the lip; normal_mm = 0 leaves it there, and from rest it is pulled back."""
    hole = place_resection([[(10, 20), (30, 20), (30, 40), (10, 40)]], outline(MESH))
    kind = {"resections": (hole,), "pressures": (Pressure(1.0, 0),), "gravity": None}
    blade = (Retraction(0, 1, normal_mm=0.0, blade=(0.1, 0.5)),)
    lying, left, back = (solve(asked(r, **kind)) for r in ((), blade, counted(blade, "rest")))
    assert np.abs(left.U - lying.U).max() < 0.3  # the mean over hats, not every point
    assert np.abs(back.U - lying.U).max() > 1


def test_an_unknown_word_is_refused():
    with pytest.raises(ValueError, match="gravity"):
        Retraction(0, 1, normal_mm=1.0, relative_to="gravity")


def test_a_brain_on_its_skull_is_opened_by_as_much_as_is_asked():
    """Contact on the low side holds it; both lips get 4 mm in the mean from where gravity has taken them."""
    mesh = distmesh(domains.ellipse(50, 65), 5.0)
    cut = cut_in(mesh, (1, 80), (0.3, 30))
    skull = Skull("contact", 20.0, arcs=(Arc((-30.0, -50.0), (30.0, -50.0), "fixed"),))
    blades = tuple(Retraction(0, side, normal_mm=4.0, blade=(0.0, 0.6)) for side in (1, -1))
    lying, parted = (solve(posed(mesh, (cut,), BRAIN, skull, r, gravity=Gravity((0.3, -0.95)))) for r in ((), blades))
    assert np.abs(lying.moved - lying.rest).max() > 2
    assert_allclose(parted_by(posed(mesh, (cut,), BRAIN, skull, blades), lying, parted), 4.0, atol=1e-8)
