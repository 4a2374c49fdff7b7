"""Finite strains: patch tests, rotations, derivatives, the linear limit, large openings, contact, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_synthetic import domains
from tests.meshes import BRAIN, FREE, HARD_SKULL, cut_in, disc, jittered, mapped, measured_outline, posed, turn
from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import orient
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.mechanics.conditions.constraints import stack, vector_rows
from xfemnav.mechanics.conditions.lips import Retraction, crossings
from xfemnav.mechanics.rules import Skull
from xfemnav.mechanics.solving import hyperelastic
from xfemnav.mechanics.solving.hyperelastic import organ
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue import neo_hookean
from xfemnav.mechanics.tissue.elasticity import Material, Tissue

MESH = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
DISC = disc()
STRETCHED = turn(0.5) @ np.array([[1.2, 0.1], [0.0, 0.9]])
PATHS = {
    "no cut": (),
    "mouth": ((-1, 4.13), (6.37, 5.21)),
    "internal": ((3.3, 4.13), (8.37, 5.21)),
    "through": ((-1, 4.13), (13, 5.21)),
}


def outline_moved(path, move, tissue=BRAIN):
    """The rectangle with its outline moved by `move`(points, side), and a cut whose lips are free."""
    cuts = (cut_in(MESH, *path, internal=path == PATHS["internal"]),) if path else ()
    if cuts:
        outline = measured_outline(MESH, cuts[0], move)
    else:
        ends = MESH.points[np.unique(MESH.boundary_facets)]
        outline = np.column_stack([ends, move(ends, np.zeros(len(ends)))])
    return posed(MESH, cuts, tissue, FREE, boundary_displacement=outline, lips="free", model="neo-hookean")


def opened(mesh, move, path=((0, 75), (0, 30)), blade=(0.0, 0.5), skull=HARD_SKULL, tissue=BRAIN, **how):
    """The retraction disc: the left lip moved by `move` mm and the right one back."""
    lips = tuple(Retraction(0, side, displacement_mm=tuple(side * np.asarray(move)), blade=blade) for side in (1, -1))
    return posed(mesh, (cut_in(mesh, *path),), tissue, skull, lips, **{"model": "neo-hookean"} | how)


@pytest.mark.parametrize("state", ["strain", "stress"])
@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_a_uniform_stretch_and_rotation_is_exact(path, state):
    """20 % of stretch, 10 % of squeeze and shear, turned by 29 degrees: u = (F - 1) x to 1e-10 of the largest.

    Outline and lips move along, the latter held at every crossing with a mesh edge.
    """

    def move(points, side):
        return points @ (STRETCHED - np.eye(2)).T

    problem = outline_moved(path, move, tissue=Material(3.0, 0.45, state))
    held = [problem.constraints]
    for side in (1, -1) if path else ():
        points, _, parts = crossings(problem.space, 0, side, hold_tip=True)
        held.append(vector_rows(problem.space.basis_in(points, parts), move(points, side), 0))
    problem = replace(problem, constraints=stack(held, problem.space.enrichment.n_dof))
    solution = solve(problem)
    assert_allclose(solution.moved, solution.rest @ STRETCHED.T, atol=1e-10 * np.abs(solution.moved).max())
    # The strain's components are quotients of displacements by elements.
    green = (STRETCHED.T @ STRETCHED - np.eye(2)) / 2
    assert_allclose(solution.strain - (green[0, 0], green[1, 1], green[0, 1]), 0, atol=1e-9)
    assert_allclose(solution.largest_strain, np.abs(np.linalg.eigvalsh(green)).max(), atol=1e-9)
    mu, lam = BRAIN.lame_in([0])
    density = neo_hookean.energy(STRETCHED[None], mu, lam, state == "stress")[0]
    assert_allclose(solution.energy, density * MESH.volumes.sum(), rtol=1e-9)


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_a_finite_rotation_stores_no_energy(path):
    """The outline turned by 40 degrees, lips free; halves that a cut parts also drawn apart: W <= 1e-12 E d^2.

    The linear model, from which the guess comes, takes the rotation for a strain.
    """
    apart = path == PATHS["through"]

    def move(points, side):
        centred = points - (6.0, 5.0)
        return centred @ (turn(0.7) - np.eye(2)).T + apart * side[:, None] * turn(0.7)[:, 1] * 2.0

    problem = outline_moved(path, move)
    solution = solve(problem)
    assert solution.energy <= 1e-12 * BRAIN.young_kpa * solution.max_displacement_mm**2
    centre = solution.rest.mean(axis=1)
    above = np.sign(orient(*np.array(PATHS["through"], float), centre))
    exact = solution.rest + move(solution.rest.reshape(-1, 2), np.repeat(above, 3)).reshape(-1, 3, 2)
    assert_allclose(solution.moved, exact, atol=1e-8)
    assert solve(replace(problem, rules=replace(problem.rules, model="linear"))).energy > 1e-3


@pytest.mark.parametrize("tip_enrichment", ["none", "topological", "geometric"])
def test_forces_and_stiffness_are_derivatives_of_the_energy(tip_enrichment):
    """Along random directions, by central differences of step 1e-6: to 1e-7 of the whole."""
    problem = opened(DISC, (1.0, -0.3), skull=Skull(), tip_enrichment=tip_enrichment)
    whole, rng = organ(problem), np.random.default_rng(1)
    smooth = turn(0.3) @ np.array([[1.1, 0.2], [0, 0.95]]) - np.eye(2)
    U = np.zeros((len(problem.load) // 2, 2))
    n = len(DISC.points)
    U[:n] = DISC.points @ smooth.T
    heaviside = problem.enrichment.kind == 1
    U[heaviside] = U[problem.enrichment.node[heaviside]]
    U = U.ravel() + 0.01 * rng.standard_normal(U.size) * np.repeat(problem.enrichment.kind <= 1, 2)
    step, force, K = 1e-6, whole.slope(U), whole.stiffness(U)
    for _ in range(5):
        d = rng.standard_normal(U.size)
        there, back = U + step * d, U - step * d
        assert whole.admits(there)
        slope = (whole.potential(there) - whole.potential(back)) / (2 * step)
        assert abs(slope - force @ d) <= 1e-7 * np.abs(force * d).sum()
        change = (whole.slope(there) - whole.slope(back)) / (2 * step)
        assert np.abs(change - K @ d).max() <= 1e-6 * (abs(K) @ np.abs(d)).max()


@pytest.mark.parametrize("state", ["strain", "stress"])
@pytest.mark.parametrize("lips", ["mortar", "pointwise"])
def test_a_small_opening_is_the_linear_answer(lips, state):
    """Opened by 1 % of the cut's length: to 1 %; by a tenth of that: to .1 %, for the difference is of second order."""
    worst = []
    for opening in (0.4, 0.04):
        nonlinear = opened(DISC, (opening / 2, 0), lip_constraint=lips, tissue=Material(3.0, 0.45, state))
        a, b = solve(replace(nonlinear, rules=replace(nonlinear.rules, model="linear"))), solve(nonlinear)
        worst.append(np.linalg.norm(b.moved - a.moved, axis=2).max() / a.max_displacement_mm)
        assert_allclose(b.linear_difference_mm, worst[-1] * a.max_displacement_mm, rtol=1e-12)
        for one, other in zip(a.retractor, b.retractor):
            assert_allclose(one.force_mN_per_mm, other.force_mN_per_mm, atol=0.02 * np.abs(one.force_mN_per_mm).max())
        assert b.load_steps == 1
    assert worst[0] <= 0.01
    assert worst[1] <= 0.15 * worst[0]


def test_the_linear_model_reports_no_difference():
    solution = solve(opened(DISC, (2.0, 0), model="linear"))
    assert (solution.linear_difference_mm, solution.load_steps, solution.newton_iterations) == (0.0, 1, 1)


def test_the_retractors_work_is_the_energys_change():
    """dW = sum of force times change of displacement, by the mean force of two openings: error of third order.

    The penalty of the hard skull stores a share, by springs.
    """
    solved = []
    for opening in (3.0, 3.02):
        problem = opened(DISC, (opening, -0.5))
        solution = solve(problem)
        U = solution.U.ravel()
        solved.append((solution.energy + U @ (problem.springs @ U) / 2, solution.retractor))
    (W, forces), (more, others) = solved
    mean = [(np.asarray(a.force_mN_per_mm) + b.force_mN_per_mm)[0] / 2 for a, b in zip(forces, others)]
    assert_allclose(more - W, 0.02 * (mean[0] - mean[1]), rtol=1e-5)
    assert all(r.mean_pressure_kPa > 0 for r in forces)


def test_turning_the_whole_problem_turns_the_answer():
    R = turn(0.6)
    first = solve(opened(DISC, (4.0, 0.5)))
    turned = solve(opened(mapped(DISC, R), R @ (4.0, 0.5), path=np.array(((0, 75), (0, 30))) @ R.T))
    assert_allclose(turned.moved, first.moved @ R.T, atol=1e-7)
    assert_allclose(turned.energy, first.energy, rtol=1e-9)


def test_stiffer_tissue_everywhere_moves_the_same():
    """Lame's constants by cell: a factor common to all changes forces only; a hard inclusion changes the motion."""
    m = len(DISC.cells)
    first = solve(opened(DISC, (4.0, 0)))
    same = solve(opened(DISC, (4.0, 0), tissue=Tissue(np.full(m, 6.0), np.full(m, 0.45))))
    assert_allclose(same.moved, first.moved, atol=1e-7)
    assert_allclose(same.energy, 2 * first.energy, rtol=1e-7)
    hard = np.linalg.norm(DISC.corners.mean(axis=1) - (-25, 50), axis=1) < 10
    solution = solve(opened(DISC, (4.0, 0), tissue=Tissue(np.where(hard, 30.0, 3.0), np.full(m, 0.45))))
    assert np.linalg.norm(solution.moved - first.moved, axis=2).max() > 0.1


@pytest.mark.parametrize("ramp", [4.0, 0.0])
def test_a_cut_opened_by_ten_millimetres(ramp, monkeypatch):
    """No cell is flipped, and convergence is quadratic: the residual's logarithm nearly doubles at the last step."""
    residuals, step = [], hyperelastic._newton_step

    def watched(organ, T, U, start):
        found = step(organ, T, U, start)
        residuals.append([np.linalg.norm(T.T @ organ.slope(x)) for x in (U, found.U)])
        return found

    monkeypatch.setattr(hyperelastic, "_newton_step", watched)
    problem = opened(distmesh(domains.disc(70.0), 3.0), (5.0, 0), skull=Skull("fixed", 15.0, ramp))
    solution = solve(problem)
    assert solution.inverted_mm2 == 0 and solution.det_F.min() > hyperelastic.LEAST_DET_F
    assert solution.residual <= 1e-8 and solution.newton_iterations <= 8
    (a, b), (same, c) = np.log(residuals[-2:])
    assert abs(b - same) < 1e-6  # no shorter steps at the end
    assert (c - b) / (b - a) >= 1.7 or c < np.log(1e-9)  # or as far as rounding lets it


def test_where_linear_elasticity_folds_tissue():
    """The retraction disc on a run's own mesh, 16 mm wide, a hard switch of the skull: 1.8 mm^2 folded, and none."""
    path = ((0.0, 75.0), (0.0, 30.0))
    mesh = distmesh(domains.disc(70.0), SizeField(3.0, 1.0, 12.0, (path,)))
    problem = opened(mesh, (8.0, 0.0))
    assert solve(replace(problem, rules=replace(problem.rules, model="linear"))).inverted_mm2 > 1.0
    solution = solve(problem)
    assert solution.load_steps > 1
    assert solution.inverted_mm2 == 0 and solution.residual <= 1e-8
    assert solution.linear_difference_mm > 1.0 and solution.largest_strain > 0.3


def test_lips_that_nobody_holds_do_not_pass_through_each_other():
    """One lip pushed towards the other, which gives way: the gap stays closed, and pressures push apart."""
    mesh = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
    cut = cut_in(mesh, (-1, 4.2), (8, 5.2))
    push = (Retraction(0, 1, normal_mm=-0.8, blade=(0.1, 0.5)),)
    problem = posed(mesh, (cut,), BRAIN, Skull("fixed", 3.0, 1.0), push, model="neo-hookean")
    solution = solve(problem)
    assert solution.residual <= 1e-8
    assert solution.min_gap_mm >= -1e-9
    assert (solution.contact_force >= 0).all() and solution.contact_force.max() > 0
    gap = problem.contacts.G @ solution.U.ravel() + problem.contacts.gap
    assert np.abs(gap * solution.contact_force).max() <= 1e-9
    apart = solve(replace(problem, contacts=None))
    assert (problem.contacts.G @ apart.U.ravel() + problem.contacts.gap).min() < -0.1


def test_too_much_names_the_part_that_was_reached():
    """Lips moved by 25 mm each in a small organ: refused, never an unconverged answer; the part it names is found."""
    mesh = disc(20.0, 4.0)
    how = {"path": ((0, 25), (0, 5)), "skull": Skull("fixed", 6.0, 2.0), "blade": (0.0, 0.4)}
    with pytest.raises(XfemnavError, match="E410") as caught:
        solve(opened(mesh, (25.0, 0.0), **how))
    part = float(caught.value.message.split("beyond ")[1].split(" %")[0]) / 100
    assert 0.05 < part < 1
    safe = solve(opened(mesh, (0.99 * part * 25, 0.0), **how))
    assert safe.inverted_mm2 == 0 and safe.residual <= 1e-8


def test_lips_pulled_by_forces():
    """By a little: as in the linear model. By much: in steps, all free unknowns in balance with the whole force."""
    mesh = disc(20.0, 4.0)
    for pull in (0.05, 35.0):
        lips = tuple(Retraction(0, side, force_mN_per_mm=(side * pull, 0.0), blade=(0.0, 0.4)) for side in (1, -1))
        cut = cut_in(mesh, (0, 25), (0, 5))
        problem = posed(mesh, (cut,), BRAIN, Skull("fixed", 6.0, 2.0), lips, model="neo-hookean", lips="free")
        solution = solve(problem)
        free = np.setdiff1d(np.arange(len(problem.load)), problem.constraints.C.indices)
        assert np.abs(organ(problem).slope(solution.U.ravel())[free]).max() <= 1e-6 * pull
        assert (solution.linear_difference_mm <= 0.02 * solution.max_displacement_mm) == (pull < 1)
        assert (solution.load_steps == 1) == (pull < 1)


def test_nitsches_lips_are_refused():
    with pytest.raises(XfemnavError, match="E411"):
        opened(DISC, (1.0, 0.0), lip_constraint="nitsche")
    with pytest.raises(ValueError, match="model"):
        opened(DISC, (1.0, 0.0), model="ogden")


def test_tip_functions_are_left_out_unless_asked_for():
    """Where a cut slides at its tip they turn tissue inside out at any load (docs/measured/finite-strain.md)."""
    assert opened(DISC, (1.0, 0.0)).rules.basis.tip_enrichment == "none"
    assert opened(DISC, (1.0, 0.0), model="linear").rules.basis.tip_enrichment == "topological"
    asked, plain = (solve(opened(DISC, (3.0, 0.0), tip_enrichment=t)) for t in ("topological", "none"))
    # The same, away from the tip's cells, to a hundredth of the opening, on 7 mm elements.
    assert_allclose(asked.energy, plain.energy, rtol=0.02)
