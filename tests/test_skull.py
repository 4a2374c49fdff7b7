"""The outline: fixed, sliding, free or in contact, open about the mouth, ramped, in arcs, or moved as measured."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_synthetic import domains
from tests.meshes import BRAIN, cut_in, disc, jittered, measured_outline, outline, posed, space_of
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.mechanics.conditions import skull as module
from xfemnav.mechanics.conditions.constraints import SKULL
from xfemnav.mechanics.rules import Arc, Gravity, Measured, Retraction, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.space.enrichment import BRANCH
from xfemnav.mechanics.tissue.elasticity import Material

MESH = disc()
CUT = cut_in(MESH, (3, 80), (1.7, 12.3))
SPACE = space_of(MESH, CUT)
MOUTH = SPACE.parts.paths[0][:1]
BOX = jittered(40.0, 30.0, 2.0, 0.25, seed=3)


def skull_conditions(*args):
    """The conditions and the springs."""
    found = module.skull_conditions(*args)
    return found.constraints, found.springs


def plain_field(space, u):
    """Coefficients of a continuous field u(x)."""
    own = space.enrichment.kind < BRANCH
    return np.where(own[:, None], u(space.mesh.points[space.enrichment.node]), 0.0)


def held_nodes(space, constraints):
    """Nodes whose displacement a single-entry condition holds."""
    C = constraints.C.copy()
    C.data[np.abs(C.data) < 1e-12] = 0
    C.eliminate_zeros()
    single = np.flatnonzero(np.diff(C.indptr) == 1)
    return np.unique(space.enrichment.node[C.indices[C.indptr[single]] // 2])


def test_an_unknown_skull_is_refused():
    with pytest.raises(ValueError, match="soft"):
        Skull("soft")


def test_without_a_mouth_the_whole_outline_is_held():
    space = space_of(MESH)
    constraints, springs = skull_conditions(space, Skull("fixed"), np.empty((0, 2)), BRAIN)
    assert_allclose(held_nodes(space, constraints), np.unique(MESH.boundary_facets))
    assert not springs.nnz and (constraints.group == SKULL).all() and not constraints.d.any()


@pytest.mark.parametrize("ramp", [0.0, 4.0])
def test_the_skull_is_open_about_the_mouth(ramp):
    constraints, _ = skull_conditions(SPACE, Skull("fixed", 20.0, ramp), MOUTH, BRAIN)
    rim = np.unique(MESH.boundary_facets)
    beyond = np.linalg.norm(MESH.points[rim] - MOUTH, axis=1) >= 20 + ramp
    assert_allclose(held_nodes(SPACE, constraints), rim[beyond])


def test_a_free_outline_has_no_conditions():
    constraints, springs = skull_conditions(SPACE, Skull("free"), MOUTH, BRAIN)
    assert not constraints.C.shape[0] and not springs.nnz


def test_the_ramp_is_the_integral_of_its_springs():
    """Energy of a rigid shift: 1/2 integral of k over the ramp, k = (E / 2 mm) x / (1 - x), on a straight outline."""
    space = space_of(BOX, Cut([(20.0, 0.0), (20.3, 9.1)]))
    _, springs = skull_conditions(space, Skull("fixed", 5.0, 8.0), np.array([[20.0, 0.0]]), BRAIN)
    assert abs(springs - springs.T).max() <= 1e-14 * abs(springs).max()
    # Only facets in the first half of the ramp: bring them alone to move by 1 mm in x.
    shift = plain_field(space, lambda x: np.stack([np.abs(x[:, 0] - 20) < 9, 0 * x[:, 0]], axis=1)).ravel()
    # The outline's nodes lie 2 mm apart: u = 1 up to |x - 20| = 8, then falls linearly to 0 at 10.
    s = 5 + (np.arange(200000) + 0.5) / 200000 * 5
    x, u = (s - 5) / 8, np.clip((10 - s) / 2, 0, 1)
    k = BRAIN.young_kpa / 2 * x / (1 - x)
    wanted = 2 * (k * u**2).sum() * 5 / 200000 / 2
    assert_allclose(shift @ (springs @ shift) / 2, wanted, rtol=1e-3)  # 32 points a facet across k's onset


def test_the_ramp_grows_from_the_craniotomy_on():
    _, springs = skull_conditions(SPACE, Skull("fixed", 20.0, 12.0), MOUTH, BRAIN)
    distance = np.linalg.norm(MESH.points - MOUTH, axis=1)
    stiff = springs.diagonal()[0 : 2 * len(MESH.points) : 2]
    a, b = MESH.points[MESH.boundary_facets].swapaxes(0, 1)
    h = np.linalg.norm(b - a, axis=1).max()
    assert_allclose(stiff[distance < 20 - h], 0, atol=1e-25)
    inner = np.setdiff1d(np.arange(len(MESH.points)), np.unique(MESH.boundary_facets))
    assert_allclose(stiff[inner], 0, atol=1e-25)  # their hat functions are 1e-16 on the outline, and squared
    rim = np.unique(MESH.boundary_facets)
    ramp = rim[(distance[rim] > 20) & (distance[rim] < 32)]
    assert (stiff[ramp] > 0).all()
    assert (np.diff(stiff[ramp][np.argsort(distance[ramp])][::2]) > 0).all()  # every second: left and right alternate


def test_springs_follow_the_tissue_s_stiffness():
    one, two = (skull_conditions(SPACE, Skull("fixed"), MOUTH, Material(E))[1] for E in (3.0, 6.0))
    assert_allclose(two.toarray(), 2 * one.toarray(), rtol=1e-12)


def test_sliding_lets_a_disc_turn_but_not_shift():
    space = space_of(MESH)
    constraints, _ = skull_conditions(space, Skull("sliding"), np.empty((0, 2)), BRAIN)
    turned = plain_field(space, lambda x: np.stack([-x[:, 1], x[:, 0]], axis=1)).ravel()
    # Nodes of a regular polygon have radial mean normals, as far as the mesh's boundary nodes are evenly spaced.
    assert np.abs(constraints.C @ turned).max() < 0.05 * 70
    shifted = plain_field(space, lambda x: np.ones_like(x)).ravel()
    assert np.abs(constraints.C @ shifted).max() > 1
    assert len(constraints.d) == len(np.unique(MESH.boundary_facets))


def test_sliding_normals_point_outwards_and_have_length_one():
    mesh = distmesh(domains.ellipse(40, 60), 6.0)
    space = space_of(mesh)
    C = skull_conditions(space, Skull("sliding"), np.empty((0, 2)), BRAIN)[0].C.toarray()
    rows = C.reshape(len(C), -1, 2)
    node = np.abs(rows).sum(axis=2).argmax(axis=1)
    normal = rows[np.arange(len(rows)), node]
    assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-12)
    exact = mesh.points[node] / np.array([40.0, 60.0]) ** 2
    exact /= np.linalg.norm(exact, axis=1)[:, None]
    assert (np.einsum("ki,ki->k", normal, exact) > np.cos(0.15)).all()  # facets of 6 mm on a radius of 27 mm and more


def measured_on(loop, u, *more):
    return np.column_stack([loop, u, *more])


def test_a_measured_linear_field_is_met_at_every_node():
    """Interpolation along straight facets is exact for a linear field measured at the nodes."""
    space = space_of(MESH)
    G = np.array([[0.01, 0.002], [0.0, -0.004]])
    loop = outline(MESH)
    constraints, springs = skull_conditions(
        space, Skull("fixed", measured=Measured(measured_on(loop, loop @ G.T))), np.empty((0, 2)), BRAIN
    )
    U = plain_field(space, lambda x: x @ G.T).ravel()
    assert_allclose(constraints.C @ U, constraints.d, atol=1e-12)
    assert not springs.nnz
    assert_allclose(held_nodes(space, constraints), np.unique(MESH.boundary_facets))


def test_measured_values_are_interpolated_along_the_outline():
    """Every second node measured, in any order: the others get the mean by arc length."""
    space = space_of(MESH)
    loop = outline(MESH)
    rng = np.random.default_rng(0)
    chosen = np.arange(0, len(loop) - 1, 2)
    value = rng.normal(size=(len(chosen), 2))
    shuffled = rng.permutation(len(chosen))
    skull = Skull("free", measured=Measured(measured_on(loop[chosen][shuffled], value[shuffled])))
    constraints, _ = skull_conditions(space, skull, np.empty((0, 2)), BRAIN)
    U = np.zeros((space.enrichment.n_rows, 2))
    U.ravel()[constraints.C.indices] = constraints.d
    at = U[MESH.boundary_loops[0]]
    assert_allclose(at[chosen], value, atol=1e-12)
    a, b, c = loop[chosen[3]], loop[chosen[3] + 1], loop[chosen[4]]
    t = np.linalg.norm(b - a) / (np.linalg.norm(b - a) + np.linalg.norm(c - b))
    assert_allclose(at[chosen[3] + 1], (1 - t) * value[3] + t * value[4], atol=1e-12)


def test_far_from_measured_points_the_skull_holds():
    """Between points more than 20 mm apart nothing was measured: there the skull's own condition acts."""
    space = space_of(MESH)
    top = outline(MESH)[outline(MESH)[:, 1] > 40]
    constraints, _ = skull_conditions(
        space, Skull("fixed", measured=Measured(measured_on(top, np.ones_like(top)))), np.empty((0, 2)), BRAIN
    )
    d = np.zeros(space.enrichment.n_dof)
    d[constraints.C.indices] = constraints.d
    y = MESH.points[MESH.boundary_loops[0], 1]
    u = d.reshape(-1, 2)[MESH.boundary_loops[0]]
    assert_allclose(u[y > 40], 1)
    assert_allclose(u[y < 40], 0)


def test_beside_a_mouth_each_lip_has_its_own_value():
    """Points at the mouth itself, told apart by their side; left of a cut that enters downwards is +x."""
    loop = outline(MESH)
    left = (loop - MOUTH[0]) @ np.array([1.0, 0.0]) > 0
    u = np.where(left[:, None], (1.0, 0.5), (-2.0, 0.0))
    at_mouth = np.array([[*MOUTH[0], 1.4, 0.7, 1], [*MOUTH[0], -2.6, 0.3, -1]])
    measured = np.vstack([measured_on(loop, u, np.zeros(len(loop))), at_mouth])
    constraints, _ = skull_conditions(SPACE, Skull("fixed", measured=Measured(measured)), MOUTH, BRAIN)
    # A point a hair inside each lip at the mouth: its value by the conditions alone.
    split = SPACE.parts
    for side, column, value in ((1, 0, (1.4, 0.7)), (-1, 1, (-2.6, 0.3))):
        part = split.lips.parts[np.argmin(split.lips.arc[:, 0]), column]
        row = SPACE.basis_in(MOUTH, [part]).toarray()[0]
        C = constraints.C.toarray()[0::2, 0::2]
        weights, *_ = np.linalg.lstsq(C.T, row, rcond=None)
        assert_allclose(C.T @ weights, row, atol=1e-10, err_msg=f"side {side}: the lip's end is not held")
        assert_allclose(weights @ constraints.d.reshape(-1, 2), value, atol=1e-6)  # sides are kept 1e-6 mm apart


@pytest.mark.parametrize(
    "measured",
    [np.zeros((3, 3)), np.full((3, 4), np.nan), np.array([[0.0, 95.0, 1.0, 1.0]]), np.array([[0.0, 0.0, 1.0, 1.0]])],
)
def test_measured_points_that_cannot_be_used_are_refused(measured):
    with pytest.raises(XfemnavError, match="E408"):
        skull_conditions(SPACE, Skull("fixed", measured=Measured(measured)), MOUTH, BRAIN)


# Contact with the skull -----------------------------------------------------------------------------------------------

WEIGHT = Gravity((0.0, -1.0))
BALL = distmesh(domains.ellipse(40, 50), 5.0)


def rests(skull, gravity=WEIGHT, cuts=(), mesh=BALL, **kind):
    problem = posed(mesh, cuts, BRAIN, skull, gravity=gravity, **kind)
    return problem, solve(problem)


def outward(problem, solution):
    """Outward displacement of the outline's nodes, their points, and the forces of the skull (k, 2) on them."""
    own = np.flatnonzero(problem.contacts.cut == SKULL)
    G = problem.contacts.G[own]
    forces = (G.T @ solution.contact_force[own]).reshape(-1, 2)
    return -(G @ solution.U.ravel()), problem.contacts.points[own], forces


@pytest.mark.parametrize("gap", [0.0, 1.5])
def test_the_skull_bears_the_weight_and_lets_the_tissue_leave_it(gap):
    """Equilibrium: its forces carry the weight but for 1e-4, the weak springs' part; above it lets go."""
    problem, solution = rests(Skull("contact", gap_mm=gap))
    out, points, forces = outward(problem, solution)
    assert out.max() <= gap + 1e-9 and out.max() == pytest.approx(gap, abs=1e-9)
    load = problem.load.reshape(-1, 2).sum(axis=0)
    assert_allclose(forces.sum(axis=0), -load, atol=1e-4 * np.abs(load).max())
    pressing = solution.contact_force > 0
    assert pressing[points[:, 1] < -10].all() and not pressing[points[:, 1] > 25].any()  # in between it bulges
    assert out[points[:, 1] > 25].max() < gap - 0.1
    (contact,) = solution.contact
    assert contact.cut == SKULL and 0 < contact.length_mm < 200 and contact.mean_pressure_kPa > 0
    assert solution.residual <= 1e-8


def test_a_gap_that_the_tissue_fills_moves_it_by_the_gap():
    """On a flat floor the block sinks by the gap, and is squeezed as on the floor itself."""
    low, lying = (
        rests(Skull("free", arcs=(Arc((0.1, 0.0), (39.9, 0.0), "contact", gap),)), mesh=BOX)[1] for gap in (2.0, 0.0)
    )
    assert_allclose(low.U[:, 1], lying.U[:, 1] - 2, atol=1e-3)  # the weak springs hold 1e-5 of the weight per mm
    assert low.energy == pytest.approx(lying.energy, rel=1e-3)


def test_without_a_load_contact_moves_nothing():
    solution = rests(Skull("contact"), None)[1]
    assert not solution.U.any() and solution.contact == () and solution.min_gap_mm == 0


def test_a_load_away_from_all_skull_is_refused():
    """The floor alone, and gravity upwards: nothing holds the block, and the weak springs are no holder."""
    with pytest.raises(XfemnavError, match="E406"):
        rests(Skull("free", arcs=(Arc((0.1, 0.0), (39.9, 0.0), "contact"),)), Gravity((0.0, 1.0)), mesh=BOX)


def test_a_lip_pulled_off_the_skull_is_no_longer_held_by_it():
    """A cut opened to one side: with a fixed skull the far side is held; in contact it may slide and leave."""
    blade = (Retraction(0, 1, displacement_mm=(3.0, 0.0), blade=(0, 0.5)),
             Retraction(0, -1, displacement_mm=(3.0, 0.0), blade=(0, 0.5)))
    problem = posed(MESH, (CUT,), BRAIN, Skull("contact"), blade)
    assert problem.hung is None  # the blades hold it
    solution = solve(problem)
    out, points, _ = outward(problem, solution)
    assert out.max() <= 1e-9 and out.min() < -0.1
    assert points[np.argmin(out), 0] < 0  # pulled off on the side that it leaves
    near = np.linalg.norm(points - MOUTH, axis=1)
    assert near.min() >= 20  # the craniotomy is open


def test_what_else_holds_the_tissue_needs_no_weak_springs():
    for skull in (Skull("contact", arcs=(Arc((40.0, 0.0), (0.0, 50.0), "fixed"),)), Skull("fixed"), Skull("free")):
        kind = {"boundary_displacement": measured_on(outline(BALL), 0 * outline(BALL))} if skull.kind == "free" else {}
        assert posed(BALL, (), BRAIN, skull, **kind).hung is None
    assert posed(BALL, (), BRAIN, Skull("contact")).hung is not None


def test_each_place_of_the_outline_touches_once():
    """Also about a tip under the outline, whose functions reach it: the conditions' lengths add up to the outline's."""
    cut = cut_in(BOX, (20.3, 12.0), (20.3, 0.7), internal=True)
    found = module.skull_conditions(space_of(BOX, cut), Skull("contact"), np.empty((0, 2)), BRAIN)
    assert_allclose(found.contacts.lengths.sum(), 140.0)
    assert (found.contacts.lengths > 0.1).all()


# Arcs -----------------------------------------------------------------------------------------------------------------

def test_arcs_run_counter_clockwise_and_later_ones_win():
    space = space_of(BOX)
    arcs = Arc((0.0, 0.0), (40.0, 30.0), "fixed"), Arc((12.0, -1.0), (24.0, 2.0), "free")
    skull = Skull("free", 0.0, 0.0, arcs=arcs)
    constraints, _ = skull_conditions(space, skull, np.empty((0, 2)), BRAIN)
    x = BOX.points[held_nodes(space, constraints)]
    assert (x[:, 1] < 1e-9).any() and (x[:, 0] > 40 - 1e-9).any()
    assert ((x[:, 1] < 1e-9) | (x[:, 0] > 40 - 1e-9)).all()  # below and right, not above and left
    between = (x[:, 1] < 1e-9) & (x[:, 0] > 11) & (x[:, 0] < 25)
    assert not between.any()
    assert set(np.round(x[x[:, 1] < 1e-9, 0])) == {*range(2, 12, 2), *range(26, 42, 2)}  # the ends are left to springs


def test_each_arc_has_its_own_kind():
    space = space_of(BOX)
    skull = Skull("sliding", 0.0, 0.0, arcs=(Arc((0.0, 0.0), (40.0, 0.0), "contact", 0.5),))
    found = module.skull_conditions(space, skull, np.empty((0, 2)), BRAIN)
    assert_allclose(found.contacts.points[:, 1], 0)
    assert_allclose(found.contacts.gap, 0.5)
    assert_allclose(found.contacts.lengths.sum(), 40.0)
    assert_allclose(found.contacts.hats[np.argmin(found.contacts.points[:, 0])], [0, 0, 2])
    down = -found.contacts.G.toarray().reshape(len(found.contacts.gap), -1, 2).sum(axis=1)
    assert_allclose(down, np.tile([0.0, -1.0], (21, 1)), atol=1e-12)
    held = held_nodes(space, found.constraints)
    assert (BOX.points[held, 1] > 0.1).all()


def test_the_grip_of_an_arc_grows_over_the_ramp():
    space = space_of(BOX)
    skull = Skull("free", 0.0, 8.0, arcs=(Arc((0.0, 0.0), (40.0, 0.0), "fixed"),))
    constraints, springs = skull_conditions(space, skull, np.empty((0, 2)), BRAIN)
    held = BOX.points[held_nodes(space, constraints)]
    assert_allclose(np.sort(held[:, 0]), np.arange(8.0, 33.0, 2.0))
    floor = np.flatnonzero(BOX.points[:, 1] == 0)
    k = springs.diagonal()[2 * floor][np.argsort(BOX.points[floor, 0])]
    assert (np.diff(k[:4]) > 0).all()
    assert_allclose(k, k[::-1], rtol=1e-9)


@pytest.mark.parametrize("arc", [
    Arc((0.0, 0.0), (40.0, 90.0), "fixed"), Arc((20.0, 15.0), (40.0, 0.0), "free"), Arc((4.0, 0.0), (4.0, 0.0), "free"),
    Arc((4.1, 0.0), (4.2, 0.0), "contact"), Arc((np.nan, 0.0), (4.2, 0.0), "contact"),
])
def test_arcs_off_the_outline_or_without_a_facet_are_refused(arc):
    with pytest.raises(XfemnavError, match="E409"):
        skull_conditions(space_of(BOX), Skull("free", arcs=(arc,)), np.empty((0, 2)), BRAIN)


def test_a_gap_below_zero_and_an_unknown_kind_are_refused():
    with pytest.raises(XfemnavError, match="E409"):
        Skull("contact", gap_mm=-1.0)
    with pytest.raises(XfemnavError, match="E409"):
        Arc((0, 0), (1, 0), "contact", np.inf)
    with pytest.raises(ValueError, match="soft"):
        Arc((0, 0), (1, 0), "soft")


# Measured displacements as springs ------------------------------------------------------------------------------------

def noisy(space_mesh, size, seed=1):
    loop = outline(space_mesh)
    G = np.array([[0.01, 0.002], [0.0, -0.004]])
    return measured_on(loop, loop @ G.T + size * np.random.default_rng(seed).normal(size=loop.shape))


def test_a_heavy_weight_is_the_hard_condition():
    """The difference falls as 1 / weight."""
    measured = noisy(BOX, 0.1)
    hard, *soft = (
        solve(posed(BOX, (), BRAIN, Skull(), boundary_displacement=measured, boundary_weight=w)).U
        for w in (None, 1e3, 1e4, 1e5)
    )
    off = [np.abs(U - hard).max() for U in soft]
    assert off[2] < 1e-3
    assert_allclose([off[0] / off[1], off[1] / off[2]], 10, rtol=0.2)


def test_a_light_weight_damps_noise_and_keeps_rigid_motion():
    """Noise costs energy, so springs give way to it; a rigid motion costs none, and is met at any weight."""
    clean, jitter = noisy(BOX, 0.0), noisy(BOX, 0.1)
    hard, soft = (
        [solve(posed(BOX, (), BRAIN, Skull(), boundary_displacement=m, boundary_weight=w)) for m in (jitter, clean)]
        for w in (None, 0.3)
    )
    rough = [np.sqrt(np.mean((a.U - b.U)[np.unique(BOX.boundary_facets)] ** 2)) for a, b in (hard, soft)]
    assert rough[1] < 0.5 * rough[0]
    assert soft[0].energy < 0.3 * hard[0].energy
    loop = outline(BOX)
    shift = measured_on(loop, np.tile([1.3, -0.4], (len(loop), 1)))
    for w in (1e-3, 1.0):
        U = solve(posed(BOX, (), BRAIN, Skull(), boundary_displacement=shift, boundary_weight=w)).U
        assert_allclose(U, np.tile([1.3, -0.4], (len(U), 1)), atol=1e-8)


def test_weighted_lips_at_a_mouth_have_their_own_values():
    """Halves of a cut box measured apart by weight: each goes its own way."""
    cut = cut_in(BOX, (20.3, -5), (20.3, 35))
    measured = measured_outline(BOX, cut, lambda x, side: side[:, None] * np.array([-0.4, 0.1]))
    solution = solve(posed(BOX, (cut,), BRAIN, Skull(), boundary_displacement=measured, boundary_weight=5.0))
    left = solution.rest.mean(axis=1)[:, 0] < 20.3
    assert_allclose((solution.moved - solution.rest)[left], np.broadcast_to([-0.4, 0.1], (left.sum(), 3, 2)), atol=1e-6)


def test_where_nothing_was_measured_no_spring_pulls():
    """The lower part alone, moved rigidly, and all else free: all of it follows."""
    loop = outline(MESH)
    low = loop[loop[:, 1] < -20]
    measured = measured_on(low, np.tile([0.4, 0.7], (len(low), 1)))
    problem = posed(MESH, (), BRAIN, Skull("free"), boundary_displacement=measured, boundary_weight=2.0)
    assert not problem.springs.diagonal()[2 * np.flatnonzero(MESH.points[:, 1] > 0)].any()
    U = solve(problem).U
    assert_allclose(U, np.tile([0.4, 0.7], (len(U), 1)), atol=1e-9)


@pytest.mark.parametrize("weight", [0.0, -1.0, np.inf, np.nan])
def test_a_weight_that_is_not_positive_is_refused(weight):
    with pytest.raises(XfemnavError, match="E408"):
        posed(BOX, (), BRAIN, Skull(), boundary_displacement=noisy(BOX, 0.0), boundary_weight=weight)
