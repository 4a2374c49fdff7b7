"""The outline: fixed, sliding or free, open about the mouth, ramped, or moved as measured."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_synthetic import domains
from tests.meshes import BRAIN, cut_in, disc, jittered, outline, space_of
from xfemnav.errors import XfemnavError
from xfemnav.geometry.cut import Cut
from xfemnav.geometry.distmesh import distmesh
from xfemnav.mechanics import outline as module
from xfemnav.mechanics.constraints import SKULL
from xfemnav.mechanics.elasticity import Material
from xfemnav.mechanics.enrichment import BRANCH
from xfemnav.mechanics.outline import Skull

MESH = disc()
CUT = cut_in(MESH, (3, 80), (1.7, 12.3))
SPACE = space_of(MESH, CUT)
MOUTH = SPACE.subcells.paths[0][:1]
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
    assert_allclose(held_nodes(space, constraints), np.unique(MESH.boundary_edges))
    assert not springs.nnz and (constraints.group == SKULL).all() and not constraints.d.any()


@pytest.mark.parametrize("ramp", [0.0, 4.0])
def test_the_skull_is_open_about_the_mouth(ramp):
    constraints, _ = skull_conditions(SPACE, Skull("fixed", 20.0, ramp), MOUTH, BRAIN)
    rim = np.unique(MESH.boundary_edges)
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
    a, b = MESH.points[MESH.boundary_edges].swapaxes(0, 1)
    h = np.linalg.norm(b - a, axis=1).max()
    assert_allclose(stiff[distance < 20 - h], 0, atol=1e-25)
    inner = np.setdiff1d(np.arange(len(MESH.points)), np.unique(MESH.boundary_edges))
    assert_allclose(stiff[inner], 0, atol=1e-25)  # their hat functions are 1e-16 on the outline, and squared
    rim = np.unique(MESH.boundary_edges)
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
    assert len(constraints.d) == len(np.unique(MESH.boundary_edges))


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
        space, Skull("fixed"), np.empty((0, 2)), BRAIN, measured_on(loop, loop @ G.T)
    )
    U = plain_field(space, lambda x: x @ G.T).ravel()
    assert_allclose(constraints.C @ U, constraints.d, atol=1e-12)
    assert not springs.nnz
    assert_allclose(held_nodes(space, constraints), np.unique(MESH.boundary_edges))


def test_measured_values_are_interpolated_along_the_outline():
    """Every second node measured, in any order: the others get the mean by arc length."""
    space = space_of(MESH)
    loop = outline(MESH)
    rng = np.random.default_rng(0)
    chosen = np.arange(0, len(loop) - 1, 2)
    value = rng.normal(size=(len(chosen), 2))
    shuffled = rng.permutation(len(chosen))
    constraints, _ = skull_conditions(
        space, Skull("free"), np.empty((0, 2)), BRAIN, measured_on(loop[chosen][shuffled], value[shuffled])
    )
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
        space, Skull("fixed"), np.empty((0, 2)), BRAIN, measured_on(top, np.ones_like(top))
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
    constraints, _ = skull_conditions(SPACE, Skull("fixed"), MOUTH, BRAIN, measured)
    # A point a hair inside each lip at the mouth: its value by the conditions alone.
    sub = SPACE.subcells
    for side, column, value in ((1, 0, (1.4, 0.7)), (-1, 1, (-2.6, 0.3))):
        part = sub.lip_parts[np.argmin(sub.lip_arc[:, 0]), column]
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
        skull_conditions(SPACE, Skull("fixed"), MOUTH, BRAIN, measured)
