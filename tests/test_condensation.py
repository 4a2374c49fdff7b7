"""A condensed organ answers as the whole one: compliance, moved cuts in every setting, contact; and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_synthetic import domains
from tests.meshes import BRAIN, cut_in, outline, posed
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.geometry.plane.window import near_cells, window
from xfemnav.mechanics.conditions.skull import skull_conditions
from xfemnav.mechanics.live.condensation import condense, with_rim
from xfemnav.mechanics.live.incision import CutThrough, OutOfReach, incise
from xfemnav.mechanics.live.lip_modes import lip_modes
from xfemnav.mechanics.live.live_motion import LiveMotion, Soup
from xfemnav.mechanics.rules import Basis, LipRules, Retraction, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, Tissue, stiffness

# Both solve the same equations in another order; what remains is rounding times the condition of either, and the mark
# for a live answer.
ROUNDING_MM = 1e-9
PLAN = np.array([[0.0, 76.0], [1.0, 32.0]])
SKULL = Skull(craniotomy_mm=15.0)
POINTWISE = LipRules(lip_constraint="pointwise")


@pytest.fixture(scope="module")
def mesh():
    return distmesh(domains.disc(70.0), SizeField(6.0, 2.5, 12.0, (PLAN,)))


@pytest.fixture(scope="module")
def organ(mesh):
    return condense(mesh, BRAIN, SKULL, PLAN, mouths=PLAN[:1] * 70 / 76)


def both(mesh, organ, cut, left, right, lips="contact", **how):
    """The batch's solution, and the nodes' displacements, the triangles and the blades' forces of the condensed one."""
    moves = {1: left, -1: right}
    blades = tuple(Retraction(0, side, displacement_mm=move, blade=(0.1, 0.7)) for side, move in moves.items() if move)
    whole = solve(posed(mesh, (cut,), organ.material, organ.skull, blades, lips=lips, **how))
    incision = incise(organ, (cut,), Basis(how.get("tip_enrichment")))
    modes = lip_modes(incision, blades, LipRules(lip_constraint=how.get("lip_constraint", "mortar")))
    amounts = np.concatenate([[*move, 0.0] for move in moves.values() if move])
    answer = modes.free(amounts)
    if lips == "contact" and (pressing := modes.pressing(amounts)) is not None:
        answer = answer + pressing
    U, own = (field[..., 0] for field in modes.carried(answer.u[:, None]))
    return whole, LiveMotion(Soup(organ, incision), U, own), answer


def assert_same(mesh, whole, live, answer):
    assert_allclose(live.U, whole.U[: len(mesh.points)], atol=ROUNDING_MM)
    assert len(live.moved) == len(whole.moved)
    key = [np.lexsort(np.round(rest.mean(axis=1), 6).T) for rest in (live.soup.rest, whole.rest)]
    assert_allclose(live.soup.rest[key[0]], whole.rest[key[1]], atol=1e-12)
    assert_allclose(live.moved[key[0]], whole.moved[key[1]], atol=ROUNDING_MM)
    forces = [blade.force_mN_per_mm for blade in whole.retractor]
    assert_allclose(answer.force, forces, atol=1e-7 * np.abs(forces).max())


def test_compliance_is_the_inverse_of_the_stiffness(mesh, organ):
    """A force on the nodes of a patch far from the skull gives displacements whose stiffness gives the force back."""
    nodes = np.argsort(np.linalg.norm(mesh.points - [0, 50], axis=1))[:12]
    G = organ.compliance.among(nodes)
    assert_allclose(G, G.T, atol=1e-12 * np.abs(G).max())
    forces = np.zeros((len(mesh.points), 2, 1))
    forces[nodes, :, 0] = np.random.default_rng(0).normal(size=(12, 2))
    u = organ.solve(forces)
    assert_allclose(G @ forces[nodes].ravel(), u[nodes].ravel(), atol=1e-12 * np.abs(u).max())
    space = posed(mesh, (), BRAIN, SKULL).space
    inner = np.setdiff1d(np.arange(len(mesh.points)), mesh.boundary_facets)
    back = (stiffness(space, BRAIN) @ u.ravel()).reshape(-1, 2)
    assert_allclose(back[inner], forces[inner, :, 0], atol=1e-10 * np.abs(forces).max())


@pytest.mark.parametrize("seed", range(6))
def test_a_cut_anywhere_in_its_corridor_moves_as_in_the_whole_organ(mesh, organ, seed):
    rng = np.random.default_rng(seed)
    path = PLAN + rng.uniform(-5, 5, (2, 2))
    middle = path.mean(axis=0, keepdims=True) + rng.uniform(-3, 3, (1, 2))
    cut = cut_in(mesh, *np.concatenate([path[:1], middle, path[1:]]))
    left, right = rng.uniform((1, -2), (4, 2)), rng.uniform((-4, -2), (-1, 2))
    assert_same(mesh, *both(mesh, organ, cut, tuple(left), tuple(right)))


@pytest.mark.parametrize("how", [
    {"tip_enrichment": "none"}, {"tip_enrichment": "geometric"}, {"lip_constraint": "pointwise"}, {"lips": "free"}])
def test_every_way_of_solving(mesh, organ, how):
    cut = cut_in(mesh, (1.1, 76), (2.3, 33.1))
    assert_same(mesh, *both(mesh, organ, cut, (3.0, 0.4), (-2.5, 0.1), **how))


@pytest.mark.parametrize("skull", [
    Skull("sliding", craniotomy_mm=15.0), Skull(craniotomy_mm=15.0, ramp_mm=0.0), Skull(craniotomy_mm=0.0)])
def test_every_skull_opens_about_the_mouth(mesh, skull):
    """Its springs and its hold move with the mouth, as in the whole organ; with no craniotomy the lips are held."""
    organ = condense(mesh, BRAIN, skull, PLAN, mouths=PLAN[:1] * 70 / 76)
    cut = cut_in(mesh, (-2.2, 76), (1.4, 36.7))
    moves = ((2.0, 0.4), (-2.0, 0.1)) if skull.craniotomy_mm else ((0.5, 0.0), (-0.5, 0.0))
    assert_same(mesh, *both(mesh, organ, cut, *moves))


def test_tissues_differ_from_cell_to_cell(mesh):
    rng = np.random.default_rng(1)
    tissue = Tissue(rng.uniform(2, 9, len(mesh.cells)), rng.uniform(0.3, 0.45, len(mesh.cells)))
    organ = condense(mesh, tissue, SKULL, PLAN, mouths=PLAN[:1] * 70 / 76)
    assert_same(mesh, *both(mesh, organ, cut_in(mesh, (1.0, 76), (0.3, 36.0)), (2.0, 0.4), (-2.0, 0.1)))


@pytest.mark.parametrize("ratio", [10.0, 100.0, 1e3, 1e5, 1e8])
def test_a_stiff_inclusion_beside_the_cut_is_exact_or_refused(mesh, ratio):
    """Never another answer than that of the whole organ: condensing costs twice the digits of the ratio."""
    middle = mesh.points[mesh.cells].mean(axis=1)
    young = np.where(np.linalg.norm(middle - [3, 45], axis=1) < 12, 3.0 * ratio, 3.0)
    organ = condense(mesh, Tissue(young, np.full(len(young), 0.45)), SKULL, PLAN, mouths=PLAN[:1] * 70 / 76)
    cut = cut_in(mesh, (1.0, 76), (0.3, 36.0))
    if ratio <= 100:
        assert_same(mesh, *both(mesh, organ, cut, (2.0, 0.4), (-2.0, 0.1)))
    else:
        with pytest.raises(XfemnavError, match="E407 a stiff inclusion"):
            both(mesh, organ, cut, (2.0, 0.4), (-2.0, 0.1))


def test_what_is_out_of_balance_is_the_rounding_of_the_condensed_stiffness(mesh, organ):
    """The organ's own stiffness tells of an error that is put into the condensed one."""
    incision = incise(organ, (cut_in(mesh, (1.0, 76), (0.3, 36.0)),))
    blades = (Retraction(0, 1, displacement_mm=(2.0, 0.4), blade=(0.1, 0.7)),)
    modes = lip_modes(incision, blades)
    U, _ = modes.carried(modes.u)
    assert np.abs(incision.unbalanced(modes.u, U)).max() < 1e-9 * np.abs(incision.stiff).max()
    k = len(incision.give)
    off = incision.stiff + 1e-5 * np.diag(np.diag(incision.stiff))
    found = replace(incision, stiff=off).unbalanced(modes.u, U)[:k]
    assert_allclose(found, (incision.stiff - off) @ modes.u[:k], atol=1e-9 * np.abs(incision.stiff).max())
    with pytest.raises(XfemnavError, match="E407"):
        replace(modes, incision=replace(incision, stiff=off)).carried(modes.u)


def test_lips_that_touch_press_on_each_other(mesh, organ):
    """One lip pushed onto the other, that nobody holds: the active set of the batch, on the condensed system."""
    cut = cut_in(mesh, (1.0, 76), (0.3, 36.0))
    whole, live, answer = both(mesh, organ, cut, None, (2.0, 0.4))
    assert whole.contact_force.max() > 0
    assert_same(mesh, whole, live, answer)
    free = both(mesh, organ, cut, None, (2.0, 0.4), lips="free")[1]
    assert np.abs(free.U - live.U).max() > 1e-3


def test_contact_at_a_bent_tip_knows_only_the_elements_near_it(mesh, organ):
    """The window's largest element is not the organ's."""
    bent = cut_in(mesh, (0, 76), (2, 48), (-1, 39), (0, 38))
    whole, live, answer = both(mesh, organ, bent, (-1.6, -2.7), None)
    assert whole.contact_force.max() > 0
    assert_same(mesh, whole, live, answer)


def test_lips_against_the_skull_contradict_it_as_in_a_run(mesh):
    """Without a craniotomy the mouth's nodes are fixed: pointwise lips that hold them may only stay where they are."""
    organ = condense(mesh, BRAIN, SKULL, PLAN)
    cut = place_cut(np.array([(0.0, 76.0), (1.0, 36.0)]), outline(mesh), craniotomy=False)
    blades = tuple(Retraction(0, side, displacement_mm=(side * 2.0, 0.0), blade=(0.0, 0.7)) for side in (1, -1))
    with pytest.raises(XfemnavError, match="E403"):
        solve(posed(mesh, (cut,), BRAIN, SKULL, blades, lip_constraint="pointwise"))
    modes = lip_modes(incise(organ, (cut,)), blades, POINTWISE)
    with pytest.raises(XfemnavError, match="E403"):
        modes.free(np.array([2.0, 0.0, 0.0, -2.0, 0.0, 0.0]))
    assert np.abs(modes.free(np.zeros(6)).u).max() == 0
    held = [replace(blade, blade=(0.2, 0.7)) for blade in blades]
    assert np.abs(lip_modes(incise(organ, (cut,)), held, POINTWISE).missed).max(initial=0.0) < 1e-9


def test_the_compliance_grows_with_cuts_that_go_farther(mesh):
    organ = condense(mesh, BRAIN, SKULL, PLAN, reach_mm=3.0, mouths=PLAN[:1] * 70 / 76)
    known = len(organ.compliance.nodes)
    assert_same(mesh, *both(mesh, organ, cut_in(mesh, (0, 76), (-14, 20)), (2.0, 0.0), (-2.0, 0.0)))
    assert len(organ.compliance.nodes) > known


def test_a_mouth_within_reach_changes_the_skulls_hold_on_open_facets_alone(mesh):
    organ = condense(mesh, BRAIN, Skull(craniotomy_mm=8.0, ramp_mm=20.0), PLAN, mouths=PLAN[:1] * 70 / 76)
    closed = with_rim(organ.uncut, ~organ.open_facets)
    space, reached = Space(mesh, closed, enrich(mesh, closed)), []

    def hold(mouths):
        found = skull_conditions(space, organ.skull, mouths, BRAIN)
        return [matrix.toarray() for matrix in (found.springs, found.constraints.C)]

    alone = hold(np.empty((0, 2)))
    for angle in np.linspace(0, np.pi / 2, 60):
        mouth = 70 * np.array([[np.sin(angle), np.cos(angle)]])
        reached.append(organ.reaches(mouth))
        if reached[-1]:
            assert all(np.array_equal(one, other) for one, other in zip(hold(mouth), alone)), angle
    assert reached[0] and not reached[-1]


def test_a_mouth_out_of_reach_is_told(mesh, organ):
    with pytest.raises(OutOfReach):
        incise(organ, (cut_in(mesh, (40, 66), (10, 30)),))


def test_a_cut_right_through_is_told(mesh, organ):
    with pytest.raises((CutThrough, OutOfReach)):
        incise(organ, (cut_in(mesh, (-8, 76), (8, 76 - 20), (14, 76)),))


def test_an_organ_that_its_skull_does_not_hold_is_refused(mesh):
    with pytest.raises(ValueError, match="skull"):
        condense(mesh, BRAIN, Skull("free"), PLAN)
    with pytest.raises(XfemnavError, match="E406"):
        condense(mesh, Material(), Skull(craniotomy_mm=150.0), PLAN, mouths=PLAN[:1])


def test_a_window_has_whole_supports_of_the_nodes_near_the_path(mesh):
    part = window(mesh, PLAN)
    near = near_cells(mesh, PLAN)
    assert set(near) <= set(part.cells)
    assert_allclose(part.mesh.corners, mesh.corners[part.cells])
    inside = part.nodes[~part.border]
    assert set(mesh.cells[near].ravel()) <= set(inside)
    supports = np.isin(mesh.cells, inside).any(axis=1)
    assert set(np.flatnonzero(supports)) <= set(part.cells)
