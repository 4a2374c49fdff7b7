"""Solving: lips where they should be, forces in balance, convergence to Williams' field, the tip's flip."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from benchmarks.probes import basis_at
from benchmarks.verification import plane
from data_synthetic import domains
from data_synthetic.fields import Williams
from tests.eq_4 import paper_coefficients
from tests.meshes import BRAIN, HARD_SKULL, cut_in, disc, jittered, measured_outline, posed
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.mechanics.conditions.lips import Retraction, crossings, lip_quadrature
from xfemnav.mechanics.rules import Arc, Skull
from xfemnav.mechanics.solving import minimise
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.space.quadrature import tip_rule
from xfemnav.mechanics.tissue.elasticity import Material, stiffness

MESH = disc()
CUT = cut_in(MESH, (3, 80), (1.7, 12.3))
PAPER = np.array([(3.5, -1.0), (-3.5, 1.0)])  # the paper's magnitudes, signs such that a cut going down opens


def both(blade=(0.0, 0.5), move=PAPER):
    return tuple(Retraction(0, s, displacement_mm=tuple(m), blade=blade) for s, m in zip((1, -1), move))


def eq_4(space, U, points, nodes_of, side):
    """Eq. (4) as printed, at points of the cut on one lip: H = side, theta = side * pi."""
    paper, mesh = paper_coefficients(space, U), space.mesh
    r = np.linalg.norm(points - space.parts.fronts.at[0], axis=1)
    theta = np.full(len(points), side * np.pi)
    s = np.sqrt(r)
    F = np.stack([s * np.sin(theta / 2), s * np.cos(theta / 2),
                  s * np.sin(theta / 2) * np.sin(theta), s * np.cos(theta / 2) * np.sin(theta)], axis=1)
    u = np.zeros((len(points), 2))
    for n, (x, cell) in enumerate(zip(points, nodes_of)):
        i = mesh.cells[cell]
        phi = np.linalg.solve(np.vstack([mesh.points[i].T, np.ones(3)]), [*x, 1.0])
        u[n] = phi @ (paper["u"][i] + side * paper["a"][i]) + phi @ np.einsum("l,ali->ai", F[n], paper["c"][i])
    return u


@pytest.mark.parametrize("hold_tip", [False, True])
def test_pointwise_lips_by_eq_4(hold_tip):
    """Every crossing on either lip has its displacement to 1e-10 mm; the tip cell's are free unless it is held."""
    problem = posed(MESH, (CUT,), BRAIN, HARD_SKULL, both(None), lip_constraint="pointwise", hold_tip=hold_tip)
    solution, space = solve(problem), problem.space
    tip_cell = space.parts.cell[space.parts.touch[0, 1]]
    for side, given in zip((1, -1), PAPER):
        points, _, parts = crossings(space, 0, side, hold_tip=True)
        cells = space.parts.cell[parts]
        free = shapely.distance(shapely.Polygon(MESH.corners[tip_cell]), shapely.points(points)) < 1e-9
        assert len(points) > 10 and free.sum() == 1
        off = np.linalg.norm(eq_4(space, solution.U, points, cells, side) - given, axis=1)
        assert off[~free].max() <= 1e-10
        assert (off[free].max() <= 1e-10) == hold_tip
    # Ahead of the tip, where a plane cut would go on, there is no jump.
    tip, travel = space.parts.fronts.at[0], space.parts.fronts.travel[0]
    ahead = tip + np.linspace(0.1, 20, 40)[:, None] * travel
    across = 1e-14 * np.array([-travel[1], travel[0]])
    jump = (basis_at(space, ahead + across) - basis_at(space, ahead - across)) @ solution.U
    assert np.abs(jump).max() <= 1e-12


def test_holding_the_tip_turns_more_tissue_inside_out():
    """The paper left the tip's cell free because elements flipped there: holding it, more area is inverted."""
    mesh = disc(70.0, 4.0)
    cut = cut_in(mesh, (3, 80), (1.7, 12.3))
    free, held = (
        solve(posed(mesh, (cut,), BRAIN, Skull(), both(None, 2 * PAPER), lip_constraint="pointwise", hold_tip=hold))
        for hold in (False, True)
    )
    assert held.inverted_mm2 > free.inverted_mm2 + 0.1
    assert held.energy > free.energy


@pytest.mark.parametrize("lips", ["mortar", "nitsche"])
def test_stable_lips_on_the_default_mesh(lips):
    """3 mm elements, 1 mm in the 12 mm corridor, the paper's opening: lip error at 200 points a lip, rms <= .03 mm."""
    loop = domains.disc(70.0)
    path = [(0.0, 75.0), (1.7, 22.3)]
    mesh = distmesh(loop, SizeField(3.0, 1.0, 12.0, (path,)))
    cut = cut_in(mesh, *path)
    solution = solve(posed(mesh, (cut,), BRAIN, Skull(), both((0.0, 0.8)), lip_constraint=lips))
    print(f"{lips}: {len(mesh.points)} nodes, lip error rms {solution.lip_error_rms_mm:.4f}, "
          f"largest {solution.lip_error_max_mm:.3f} mm")
    assert solution.lip_error_rms_mm <= 0.03


@pytest.mark.parametrize("lips", ["mortar", "nitsche", "pointwise"])
def test_the_reported_lip_error_is_that_of_the_field(lips):
    problem = posed(MESH, (CUT,), BRAIN, HARD_SKULL, both(), lip_constraint=lips)
    solution = solve(problem)
    errors = []
    for retraction, span in zip(problem.retractions, problem.spans):
        q = lip_quadrature(problem.space, 0, retraction.side, span, np.linspace(*span, 801), n=2)
        u = problem.space.basis_in(q.points, q.parts) @ solution.U
        errors.append((np.linalg.norm(u - retraction.displacement_mm, axis=1), q.weights))
    rms = np.sqrt(sum((e**2 * w).sum() for e, w in errors) / sum(w.sum() for _, w in errors))
    # The error peaks at the blade's end, within a two-hundredth of its length: 200 points against 1600 differ by that.
    assert_allclose(solution.lip_error_rms_mm, rms, rtol=0.25)
    largest = max(e.max() for e, _ in errors)
    assert 0.5 * largest < solution.lip_error_max_mm <= 1.001 * largest


def skull_springs():
    """The skull's own springs: on the part of a facet that lies beyond the hard switch."""
    return posed(MESH, (CUT,), BRAIN, HARD_SKULL).springs


@pytest.mark.parametrize("lips", ["mortar", "nitsche", "pointwise"])
def test_work_of_the_retractors_is_the_energy(lips):
    """Clapeyron: 2 W = sum of force times displacement, when the skull is hard and each lip moves by one vector."""
    solution = solve(posed(MESH, (CUT,), BRAIN, HARD_SKULL, both(), lip_constraint=lips))
    U = solution.U.ravel()
    work = sum(np.dot(r.force_mN_per_mm, m) for r, m in zip(solution.retractor, PAPER))
    # Nitsche's force acts on a lip that is where it should be only up to the lip error: .4 mm on this 7 mm mesh.
    tolerance = 0.15 if lips == "nitsche" else 1e-8
    assert_allclose(work, 2 * solution.energy + U @ (skull_springs() @ U), rtol=tolerance)
    for r, move in zip(solution.retractor, PAPER):
        assert np.dot(r.force_mN_per_mm, move) > 0 and r.mean_pressure_kPa > 0  # one pushes to move tissue


@pytest.mark.parametrize("tip_enrichment", ["topological", "geometric", "none"])
@pytest.mark.parametrize("lips", ["mortar", "pointwise"])
def test_a_blade_among_tip_functions_does_its_work(lips, tip_enrichment):
    """Clapeyron again: the force is that of the functions as they are combined, not of each by itself."""
    move = (3.5, -1.0)
    blade = Retraction(0, 1, displacement_mm=move, blade=(0.0, 0.8))
    how = {"lips": "free", "lip_constraint": lips, "tip_enrichment": tip_enrichment}
    problem = posed(MESH, (CUT,), BRAIN, HARD_SKULL, (blade,), **how)
    solution = solve(problem)
    U = solution.U.ravel()
    work = np.dot(solution.retractor[0].force_mN_per_mm, move)
    assert_allclose(work, 2 * solution.energy + U @ (problem.springs @ U), rtol=1e-8)


@pytest.mark.parametrize("lips", ["mortar", "nitsche", "pointwise"])
def test_retractors_and_skull_are_in_balance(lips):
    """The nodal forces at the skull, from the elastic stiffness alone, and the retractors' add up to nothing."""
    move = np.array([(3.5, -1.0), (-1.5, 2.0)])
    problem = posed(MESH, (CUT,), BRAIN, HARD_SKULL, both(move=move), lip_constraint=lips)
    solution = solve(problem)
    nodal = (stiffness(problem.space, BRAIN) @ solution.U.ravel()).reshape(-1, 2)
    far = np.linalg.norm(MESH.points - CUT.path[0], axis=1) >= 15
    held = np.intersect1d(np.unique(MESH.boundary_facets), np.flatnonzero(far))
    lips_force = np.sum([r.force_mN_per_mm for r in solution.retractor], axis=0)
    size = np.abs([r.force_mN_per_mm for r in solution.retractor]).max()
    # The part of a facet beyond the hard switch is held by a penalty, which carries its share of the skull's force.
    skull = nodal[held].sum(axis=0) + _penalty_force(problem, solution, held)
    assert_allclose(skull + lips_force, 0, atol=1e-8 * size)


def _penalty_force(problem, solution, held):
    force = (skull_springs() @ solution.U.ravel()).reshape(-1, 2)
    force[held] = 0
    return -force[problem.enrichment.kind < 2].sum(axis=0)


def test_a_lip_force_does_its_work():
    """Half the force times the mean displacement of its blade is the energy; forces are reported as given."""
    force = np.array([5.0, 1.0])
    retraction = Retraction(0, 1, force_mN_per_mm=tuple(force), blade=(0.0, 0.5))
    problem = posed(MESH, (CUT,), BRAIN, HARD_SKULL, (retraction,))
    solution = solve(problem)
    q = lip_quadrature(problem.space, 0, 1, problem.spans[0], n=12)
    mean = q.weights @ (problem.space.basis_in(q.points, q.parts) @ solution.U) / q.weights.sum()
    springs = solution.U.ravel() @ (problem.springs @ solution.U.ravel()) / 2
    assert_allclose(solution.energy + springs, force @ mean / 2, rtol=1e-8)
    assert_allclose(solution.retractor[0].force_mN_per_mm, force)
    assert mean @ force > 0


def test_prescribing_the_displacement_that_a_force_gave_gives_the_force_back():
    """Duality, on a lip that moves rigidly: right through, so that the piece moves as a body against a soft skull."""
    mesh = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
    cut = cut_in(mesh, (-1, 4.2), (13, 5.9))
    held = tuple(Retraction(0, s, normal_mm=0.1, blade=(0.2, 0.7)) for s in (1, -1))
    forces = solve(posed(mesh, (cut,), BRAIN, Skull("fixed", 3.0, 2.0), held)).retractor
    again = tuple(
        Retraction(0, r.side, force_mN_per_mm=r.force_mN_per_mm, blade=(0.2, 0.7)) for r in forces
    )
    problem = posed(mesh, (cut,), BRAIN, Skull("fixed", 3.0, 2.0), again)
    solution = solve(problem)
    for retraction, span in zip(again, problem.spans):
        q = lip_quadrature(problem.space, 0, retraction.side, span)
        u = problem.space.basis_in(q.points, q.parts) @ solution.U
        opening = retraction.side * (np.einsum("qi,qi->q", u, q.normals) * q.weights).sum() / q.weights.sum()
        # The even pressure is not the blade's own, which is highest at its ends: the mean opening agrees to a third.
        assert_allclose(opening, 0.1, rtol=0.34)


def test_the_triangles_are_the_map():
    problem = posed(MESH, (CUT,), BRAIN, HARD_SKULL, both())
    solution = solve(problem)
    assert (solution.rest_areas > 0).all()
    assert_allclose(solution.rest_areas.sum(), MESH.volumes.sum(), rtol=1e-12)
    u = problem.space.basis_in(solution.rest.reshape(-1, 2), np.repeat(solution.part, 3)) @ solution.U
    assert_allclose(solution.moved.reshape(-1, 2), solution.rest.reshape(-1, 2) + u, atol=1e-12)
    e, f = solution.moved[:, 1] - solution.moved[:, 0], solution.moved[:, 2] - solution.moved[:, 0]
    assert_allclose(solution.det_F, (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]) / (2 * solution.rest_areas), atol=1e-9)
    assert_allclose(solution.inverted_mm2, solution.rest_areas[solution.det_F <= 0].sum())
    assert solution.max_displacement_mm == pytest.approx(np.linalg.norm(u, axis=1).max())
    share = solution.rest_areas[solution.det_F <= solution.det_F_p01].sum() / solution.rest_areas.sum()
    assert 0.01 <= share < 0.02


def halves(move):
    """A rectangle cut right through: its lower half fixed, its upper half in a skull that it only touches; a blade
    moves the lower lip by `move` mm upwards."""
    mesh = jittered(12.0, 10.0, 0.5, 0.25, seed=25)
    cut = cut_in(mesh, (-1, 5.03), (13, 5.03))
    skull = Skull("contact", 0.0, 0.0, arcs=(Arc((0.0, 3.0), (12.0, 3.0), "fixed"),))
    return posed(mesh, (cut,), BRAIN, skull, (Retraction(0, -1, displacement_mm=(0.0, move), blade=(0.3, 0.6)),))


def test_a_half_that_its_lip_presses_into_the_skull_is_held():
    """No load but the lips' own: they press the hanging half onto the skull, which bears it; or nothing moves it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        pressed, at_rest = solve(halves(0.2)), solve(halves(0.0))
    assert {force.cut for force in pressed.contact} == {-1, 0} and pressed.residual < 1e-8
    assert at_rest.max_displacement_mm == 0


def test_a_half_that_its_lip_pushes_away_from_the_skull_drifts():
    mesh = jittered(12.0, 10.0, 0.5, 0.25, seed=25)
    cut = cut_in(mesh, (-1, 5.03), (13, 5.03))
    arcs = (Arc((0.0, 0.0), (12.0, 0.0), "fixed"), Arc((12.0, 10.0), (0.0, 10.0), "free"))
    blade = Retraction(0, -1, displacement_mm=(0.0, 0.2), blade=(0.3, 0.6))
    with pytest.raises(XfemnavError, match=r"E406.*does not bear \d+%"):
        solve(posed(mesh, (cut,), BRAIN, Skull("contact", 0.0, 0.0, arcs=arcs), (blade,)))


def test_a_residual_above_the_limit_is_an_error(monkeypatch):
    monkeypatch.setattr(minimise, "RESIDUAL_LIMIT", -1.0)
    with pytest.raises(XfemnavError, match="E407"):
        solve(posed(MESH, (CUT,), BRAIN, HARD_SKULL, both()))


def energy_norm_error(problem, solution, field):
    """sqrt of the integral of (e - e_h) : D : (e - e_h), and that of the exact field."""
    space, D = problem.space, plane.stiffness(problem.material)
    points, weights, owner = tip_rule(space.parts.corners, space.parts.fronts.at)
    parts = space.parts.part[owner]
    # On which side of the crack's line each part lies: the field's own branch, also for parts on the line itself.
    G = field.gradient(points, np.sign(points[:, 1] - field.tip[1]))
    exact = np.stack([G[:, 0, 0], G[:, 1, 1], G[:, 0, 1] + G[:, 1, 0]])
    found = plane.strains(space, solution.U, points, parts).T
    norms = [np.sqrt(np.einsum("sq,st,tq,q->", e, D, e, weights)) for e in (exact - found, exact)]
    return norms[0] / norms[1]


@pytest.mark.parametrize(
    "tip_enrichment, low, high", [("topological", 0.4, 0.7), ("none", 0.4, 0.7), ("geometric", 0.8, 1.3)]
)
def test_convergence_to_williams_field(tip_enrichment, low, high):
    """Problem d: crack from the left edge to the centre of [-1, 1]^2, K_I = 1, K_II = .5 on the whole outline.

    A zone of enrichment that shrinks with h leaves the rate at h^.5, as without any; a fixed one restores h^1.
    """
    material, tip = Material(1.0, 0.3), (1.003, 1.007)  # the square is [0, 2]^2 here
    field = Williams(tip, (1, 0), K_I=1.0, K_II=0.5, nu=0.3, mu=material.shear_modulus)
    # Odd numbers of cells across: the tip is near a cell's middle on every mesh.
    sizes, errors = 2 / np.array([11, 21, 41]), []
    for h in sizes:
        mesh = jittered(2.0, 2.0, h, 0.2, seed=7)
        cut = cut_in(mesh, (-0.1, tip[1]), tip)
        measured = measured_outline(mesh, cut, lambda x, side: field.displacement(x, side * (x[:, 0] < 1)))
        problem = posed(
            mesh, (cut,), material, Skull(), boundary_displacement=measured, tip_enrichment=tip_enrichment,
            tip_radius_mm=0.4 if tip_enrichment == "geometric" else None,
        )
        errors.append(energy_norm_error(problem, solve(problem), field))
    rate = np.log(errors[0] / errors[-1]) / np.log(sizes[0] / sizes[-1])
    print(f"{tip_enrichment}: errors {np.round(errors, 4)}, rate {rate:.2f}")
    assert low < rate < high


@pytest.mark.parametrize("lips", ["mortar", "pointwise"])
def test_mean_pressure_is_the_normal_traction_also_round_a_corner(lips):
    """Opened along its normals, a lip's work on that displacement is pressure times length times opening, by energy:
    2 x energy = (p_left + p_right) L a."""
    mesh = disc(h=4.0)
    cut = cut_in(mesh, (3, 80), (1.7, 50.3), (20.2, 32.1))
    opening = 1.5
    blades = tuple(Retraction(0, side, normal_mm=opening, blade=(0, 0.7)) for side in (1, -1))
    problem = posed(mesh, (cut,), BRAIN, Skull("fixed", 15.0, 0.0), blades, lip_constraint=lips)
    solution = solve(problem)
    length = problem.spans[0, 1] - problem.spans[0, 0]
    work = sum(force.mean_pressure_kPa for force in solution.retractor) * length * opening
    springs = solution.U.ravel() @ (problem.springs @ solution.U.ravel())
    assert work == pytest.approx(2 * solution.energy + springs, rel=1e-6)


@pytest.mark.parametrize("cuts", [(), (CUT,)])
def test_what_the_cut_costs_is_what_the_matrix_has_more(cuts):
    found, plain = solve(posed(MESH, cuts, BRAIN, HARD_SKULL)), posed(MESH, (), BRAIN, HARD_SKULL)
    assert found.added_nnz == found.nnz - stiffness(plain.space, BRAIN).nnz
    assert (found.added_nnz > 0) == bool(cuts)


def test_along_the_cut_as_drawn_its_lips_are_where_they_are_along_the_snapped_one():
    """A bend and a tip drawn beside nodes are snapped to them, by up to two thousandths of an element."""
    bend, tip = (MESH.points[np.argmin(np.linalg.norm(MESH.points - x, axis=1))] for x in ((2.0, 45.0), (1.0, 20.0)))
    h = MESH.sizes.max()
    cut = cut_in(MESH, (3.0, 80.0), bend + np.array([1e-3, -5e-4]) * h, tip - np.array([1e-3, 0.0]) * h)
    solution = solve(posed(MESH, (cut,), BRAIN, HARD_SKULL, both()))
    drawn, snapped = replace(solution.motion, cuts=(cut.path,)), solution.motion
    moved = shapely.hausdorff_distance(shapely.LineString(cut.path), shapely.LineString(snapped.cuts[0]))
    assert 0 < moved <= 2e-3 * h
    along = shapely.LineString(cut.path)
    points = shapely.get_coordinates(shapely.line_interpolate_point(along, np.linspace(0.02, 0.98, 200) * cut.length))
    points = points[np.linalg.norm(points - cut.path[1], axis=1) > 0.05]  # at a bend a point may change its lip
    for side in (1, -1):
        assert np.linalg.norm(drawn.to_current(points, side) - snapped.to_current(points, side), axis=1).max() < moved
