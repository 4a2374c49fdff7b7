"""Cuts in space, from a drawn sheet to the solution: by the same mechanics as in the plane."""

import numpy as np
import pytest
from blocks import block
from numpy.testing import assert_allclose

from benchmarks.verification.plates import given_on_rim, plate_problem
from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import Mesh, area_vectors
from xfemnav.geometry.solid.sheet import Sheet
from xfemnav.geometry.solid.split import split
from xfemnav.geometry.solid.sweep import flat, swept
from xfemnav.mechanics.conditions.lip_patches import patch_points
from xfemnav.mechanics.conditions.placing import functions_on
from xfemnav.mechanics.conditions.problem import pose
from xfemnav.mechanics.rules import Basis, Gravity, LipRules, Loads, Retraction, Rules, Skull
from xfemnav.mechanics.solving import multigrid
from xfemnav.mechanics.solving.measures import measure
from xfemnav.mechanics.solving.multigrid import by_multigrid
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

R = 30.0
BRAIN = Material(3.0, 0.45)
RULES = Rules(lips=LipRules("free", "nitsche"))


def depth(points):
    """Signed distance from the surface of a ball of radius R, positive inside."""
    return R - np.linalg.norm(points, axis=-1)


def ball(n=20) -> Mesh:
    """A ball of lattice cells: its border is rough."""
    whole = block(3, n)
    points, size = (whole.points - n / 2) * 2.4 * R / n, 2.4 * R / n
    nodes, cells = np.unique(whole.cells[(depth(points)[whole.cells] > -size / 2).all(axis=1)], return_inverse=True)
    return Mesh(points[nodes], cells.reshape(-1, 4))


def arc(n=9, turn=0.6):
    """A curve on the ball over its north pole, along x."""
    t = np.linspace(-turn, turn, n)
    return R * np.stack([np.sin(t), np.zeros(n), np.cos(t)], axis=1)


def opened(sheet, opening, mesh=None, **skull):
    blades = tuple(Retraction(0, side, normal_mm=opening / 2) for side in (1, -1))
    return pose(ball() if mesh is None else mesh, (sheet,), BRAIN, Skull(**skull), blades, rules=RULES)


def test_a_flat_patch_is_cut_exactly_where_it_lies():
    mesh = block(3, 8)
    inside = lambda points: 8 - points[..., 2]  # noqa: E731 - the block's top is its surface
    axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    sheet = flat(inside, (4.1, 4.2, 6.8), axes, (3.4, 6.0), name="plane")
    parts = split(mesh, (sheet.level(mesh),))
    corners = parts.lips.facets
    assert_allclose(corners[..., 1], 4.2, atol=1e-9)
    assert_allclose(corners[..., 0].min(), 2.4, atol=1e-6)
    assert_allclose(corners[..., 0].max(), 5.8, atol=1e-6)
    assert_allclose(corners[..., 2].min(), 3.8, atol=1e-6)
    lost = 3.4 * 4.2 - np.linalg.norm(area_vectors(corners), axis=1).sum()
    assert 0 <= lost < 1.0  # its two corners in the tissue, cut off by an element
    # Left is where the normal points, along is d x n: chart coordinates are those of the rectangle.
    assert (mesh.points[mesh.cells[parts.cell[parts.lips.parts[:, 0]]]].mean(axis=1)[:, 1] < 4.2 + 1).all()
    depth_share = (8 - corners[..., 2]) / 4.2
    assert_allclose(parts.lips.at[..., 1], depth_share, atol=1e-6)
    along = np.cross([0, 0, -1], [0, -1, 0])
    assert_allclose(parts.lips.at[..., 0], (corners @ along - min(2.4 * along[0], 5.8 * along[0])) / 3.4, atol=1e-6)


@pytest.mark.parametrize("how", [{"depth_mm": 15.0}, {"towards": (0.0, 0.0, 10.0)}])
def test_a_swept_curve_begins_at_the_surface_and_its_left_is_left(how):
    sheet, mesh = swept(depth, arc() * 1.05, **how), ball()
    assert_allclose(np.linalg.norm(sheet.mouth_line, axis=1), R, atol=0.05)
    below = sheet.at[:, 1] >= -1e-9
    assert_allclose(depth(sheet.vertices[below]).min(), 0, atol=0.05)
    parts = split(mesh, (sheet.level(mesh),))
    normals = area_vectors(parts.lips.facets).sum(axis=0)
    # Along +x, head away from the brain: left is t x d, x cross -z, +y; the left part's border faces right.
    assert_allclose(normals / np.linalg.norm(normals), [0, -1, 0], atol=0.05)
    left = parts.corners[np.isin(parts.part, parts.lips.parts[:, 0])].mean(axis=(0, 1))
    assert left[1] > 0
    assert -0.1 < parts.lips.at[..., 1].min() < 0.05 and 0.9 < parts.lips.at[..., 1].max() < 1.02


@pytest.mark.parametrize("code, curve, how", [
    ("E301", arc() * 1.9, {"depth_mm": 10.0}), ("E302", arc() * 0.2, {"towards": (0.0, 0.0, 0.0)}),
    ("E303", arc(turn=0.01), {"depth_mm": 10.0}), ("E303", arc(), {"towards": arc()[3]})])
def test_curves_that_are_no_mouth_are_refused(code, curve, how):
    with pytest.raises(XfemnavError) as error:
        swept(depth, curve, **how)
    assert error.value.code == code


def test_a_blade_holds_exactly_its_window():
    mesh = block(3, 8)
    sheet = flat(lambda points: 8 - points[..., 2], (4.1, 4.2, 6.0), [[1, 0, 0], [0, 0, 1], [0, -1, 0]], (6.0, 8.0))
    lips = split(mesh, (sheet.level(mesh),)).lips
    points, weights, _, _, normals = patch_points(lips, 0, [[0.2, 0.1, -np.inf], [0.7, 0.61, np.inf]], 2)
    assert_allclose(weights.sum(), 0.5 * 6.0 * 0.51 * 6.0, rtol=1e-9)
    assert_allclose(normals, np.broadcast_to([0, -1.0, 0], normals.shape), atol=1e-9)
    assert_allclose((8 - points[:, 2]).min() / 6, 0.1, atol=0.06)
    # Gauss's points of a triangle are exact to the second degree.
    mean = (weights * points[:, 2] ** 2).sum() / weights.sum()
    low, high = 8 - 6 * 0.61, 8 - 6 * 0.1
    assert_allclose(mean, (high**3 - low**3) / 3 / (high - low), rtol=1e-9)


def test_halves_that_are_pulled_apart_move_rigidly(monkeypatch):
    """A cut right through, both lips held: each half is a rigid body on its blade."""
    monkeypatch.setattr(multigrid, "TOLERANCE", 1e-14)
    mesh = block(3, 6)
    sheet = flat(lambda points: 6 - points[..., 2], (3.0, 3.13, 3.0), [[1, 0, 0], [0, 0, 1], [0, -1, 0]], (20.0, 20.0))
    shifts = (1, (0.1, -0.5, 0.2)), (-1, (0, 0.3, 0))
    blades = tuple(Retraction(0, side, displacement_mm=shift) for side, shift in shifts)
    found = solve(pose(mesh, (sheet,), BRAIN, Skull("free"), blades, rules=RULES))
    left = found.rest.mean(axis=1)[:, 1] < 3.13
    shift = np.where(left[:, None, None], (0.1, -0.5, 0.2), (0, 0.3, 0))
    assert_allclose(found.moved - found.rest, np.broadcast_to(shift, found.rest.shape), atol=1e-12)
    assert abs(found.energy) < 1e-12 and abs(found.strain).max() < 1e-10


def test_strains_that_leave_the_lips_free_of_traction_are_exact(monkeypatch):
    """The patch test: a linear displacement on the outline, without traction on the cut's plane, goes on inside."""
    monkeypatch.setattr(multigrid, "TOLERANCE", 1e-14)
    mesh, nu = block(3, 6), BRAIN.poisson
    sheet = flat(lambda points: 6 - points[..., 2], (3.1, 3.13, 4.4), [[1, 0, 0], [0, 0, 1], [0, -1, 0]], (4.0, 4.4))
    space = functions_on(mesh, split(mesh, (sheet.level(mesh),)), Basis("none"))
    across = -nu / (1 - nu) * (0.02 - 0.01)
    gradient = np.array([[0.02, 0.03, 0.01], [-0.03, across, 0.02], [0.005, -0.02, -0.01]])
    given = given_on_rim(space, np.arange(len(space.parts.rim.parts)), lambda x, _: x @ gradient.T)
    found = solve(plate_problem(space, (sheet,), BRAIN, [given], np.zeros(space.enrichment.n_dof), "none"))
    assert_allclose(found.moved - found.rest, found.rest @ gradient.T, atol=1e-12)


def test_an_opened_ball_is_symmetric_and_its_blades_press_outwards():
    found = solve(problem := opened(swept(depth, arc(), depth_mm=20.0), 4.0, craniotomy_mm=12.0))
    left, right = found.retractor
    assert found.residual < 1e-8 and found.inverted_mm2 == 0
    assert left.force_mN_per_mm[1] > 10 and right.force_mN_per_mm[1] < -10
    assert_allclose(np.abs(left.force_mN_per_mm[1]), np.abs(right.force_mN_per_mm[1]), rtol=0.05)
    assert left.mean_pressure_kPa > 0.3 and right.mean_pressure_kPa > 0.3
    assert 1.8 < found.max_displacement_mm < 3.0
    measures = measure(problem, found)
    assert 0.01 < measures.main_strain < 0.3 and measures.turning.degrees > 0
    # Work of the blades is twice the energy, for Nitsche's lips up to what they miss.
    work = 2.0 * (left.force_mN_per_mm[1] - right.force_mN_per_mm[1])
    assert_allclose(work, 2 * found.energy, rtol=0.2)


@pytest.mark.parametrize("skull", ["fixed", "sliding"])
def test_a_skull_holds_all_but_the_craniotomy(skull):
    problem = opened(swept(depth, arc(), depth_mm=20.0), 4.0, kind=skull, craniotomy_mm=12.0, ramp_mm=4.0)
    found = solve(problem)
    rim = problem.parts.rim
    u = problem.space.basis_in(rim.facets.reshape(-1, 3), np.repeat(rim.parts, 3)) @ found.U
    u = u.reshape(rim.facets.shape)
    far = np.linalg.norm(rim.facets[:, :, None] - problem.cuts[0].mouth_line, axis=3).min(axis=(1, 2)) > 22
    normals = area_vectors(rim.facets)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    through = np.abs(np.einsum("bai,bi->ba", u, normals)[far]).mean()
    along = np.abs(u[far]).max()
    assert through < 0.05 and (along < 1e-9 if skull == "fixed" else along > 1e-3)


def test_weight_in_space_is_that_of_the_tissue():
    sheet = swept(depth, arc(), depth_mm=20.0)
    loads = Loads(Gravity((0.0, 0.6, -0.8)))
    problem = pose(ball(), (sheet,), BRAIN, Skull(craniotomy_mm=12.0), (), loads=loads, rules=RULES)
    total = problem.load.reshape(-1, 3).sum(axis=0)
    assert_allclose(total, 9.80665e-3 * problem.mesh.volumes.sum() * np.array([0, 0.6, -0.8]), rtol=1e-9)
    assert solve(problem).max_displacement_mm > 1e-3


def test_iterated_and_factored_systems_agree():
    problem = opened(swept(depth, arc(), depth_mm=20.0), 4.0, craniotomy_mm=12.0)
    K = (problem.springs + _stiffness(problem)).tocsc()
    rng = np.random.default_rng(0)
    A, b = K + 1e-3 * K.diagonal().mean() * _eye(K), rng.normal(size=K.shape[0])
    motions = np.ones((K.shape[0], 6)) * rng.normal(size=(K.shape[0], 6))
    inverse = by_multigrid(A, motions, np.arange(K.shape[0]) // 3)
    q = inverse.solve(b)
    assert np.linalg.norm(A @ q - b) < 1e-9 * np.linalg.norm(b)
    again = by_multigrid(A, motions, np.arange(K.shape[0]) // 3).solve(b)
    assert (again == inverse.solve(b)).all()  # to the last bit, whatever random numbers were drawn before


def _stiffness(problem):
    from xfemnav.mechanics.tissue.elasticity import stiffness

    return stiffness(problem.space, problem.material)


def _eye(K):
    from scipy.sparse import eye_array

    return eye_array(K.shape[0], format="csc")


def test_a_sheet_does_not_depend_on_how_its_vertices_are_numbered():
    sheet, mesh = swept(depth, arc(), depth_mm=15.0), ball()
    order = np.random.default_rng(0).permutation(len(sheet.vertices))
    back = np.argsort(order)
    other = Sheet(sheet.vertices[order], back[sheet.triangles], sheet.at[order], sheet.mouth_line)
    one, two = sheet.level(mesh), other.level(mesh)
    assert_allclose(one.phi, two.phi, atol=1e-9)
    assert_allclose(one.bounds, two.bounds, atol=1e-9)
