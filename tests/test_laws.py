"""Laws of mechanics that hold in the plane and in space alike, each on the same cuts of a block."""

from math import factorial
from types import SimpleNamespace

import numpy as np
import pytest
from blocks import KINDS, block
from numpy.testing import assert_allclose
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import area_vectors
from xfemnav.geometry.solid.levels import Level
from xfemnav.geometry.solid.split import split
from xfemnav.mechanics.conditions.bodies import free_motions, rigid_motions, sort_out
from xfemnav.mechanics.conditions.constraints import SKULL, eliminate, normal_rows, vector_rows
from xfemnav.mechanics.conditions.loads import KPA_PER_MM, dead_loads, pressure_load, weight_load
from xfemnav.mechanics.conditions.nitsche import _tractions
from xfemnav.mechanics.conditions.skull import skull_conditions
from xfemnav.mechanics.rules import Gravity, Loads, Skull
from xfemnav.mechanics.solving.minimise import minimise
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.quadrature import gauss_in_simplex, simplex_rule
from xfemnav.mechanics.space.rim import rim_points
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, Tissue, hooke, plain_blocks, stiffness

SIZES = {2: 5, 3: 3}
BRAIN = Material(3.0, 0.4)
both = pytest.mark.parametrize("d", [2, 3])


def space_of(d, *levels):
    mesh = block(d, SIZES[d])
    parts = split(mesh, levels)
    return Space(mesh, parts, enrich(mesh, parts))


def plane(d, seed, *, through=0.5):
    """Signed distance (n,) from a tilted plane through the block."""
    normal = np.array([1.0, 0.31, -0.17])[np.random.default_rng(seed).permutation(3)][:d]
    mesh = block(d, SIZES[d])
    return (mesh.points - through * SIZES[d] - 0.137) @ (normal / np.linalg.norm(normal))


def network(d, kind):
    """Levels of a cut, and the number of bodies that it leaves."""
    one, two, end = plane(d, 0), plane(d, 3), plane(d, 1)
    return {"none": ((), 1), "through": ([Level(one)], 2), "crossing": ([Level(one), Level(two)], 4),
            "branch": ([Level(one), Level(two, [one])], 3), "end": ([Level(one, [end])], 1)}[kind]


NETWORKS = ("none", "through", "crossing", "branch", "end")


def inside(parts, rng):
    """A point (s, d) in each simplex of the parts."""
    return np.einsum("sa,sai->si", rng.dirichlet(np.ones(parts.corners.shape[1]), len(parts.corners)), parts.corners)


@both
@pytest.mark.parametrize("kind", KINDS)
def test_functions_are_a_partition_of_unity_and_hold_linear_fields(kind, d):
    rng = np.random.default_rng(d)
    space = space_of(d, *kind(block(d, SIZES[d]), rng))
    points, parts = inside(space.parts, rng), space.parts.part
    assert_allclose(space.basis_in(points, parts).sum(axis=1), 1, atol=1e-12)
    G, shift = rng.normal(size=(d, d)), rng.normal(size=d)
    U = space.mesh.points[space.enrichment.node] @ G.T + shift
    assert_allclose(space.basis_in(points, parts) @ U, points @ G.T + shift, atol=1e-11)
    found = np.stack([along @ U for along in space.gradient_in(points, parts)], axis=-1)
    assert_allclose(found, np.broadcast_to(G, found.shape), atol=1e-11)


@both
@pytest.mark.parametrize("kind", KINDS)
def test_fields_jump_on_cuts_alone(kind, d):
    rng = np.random.default_rng(d)
    space = space_of(d, *kind(block(d, SIZES[d]), rng))
    U, parts = rng.normal(size=space.enrichment.n_rows), space.parts
    one, other = (space.basis_in(parts.middles, side) @ U for side in parts.joins.T)
    assert_allclose(one, other, atol=1e-7)  # contacts are found to 1e-8 of a face
    at = parts.lips.facets.mean(axis=1)
    left, right = (space.basis_in(at, side) @ U for side in parts.lips.parts.T)
    torn = (space.enrichment.dof[parts.lips.parts[:, 0]] != space.enrichment.dof[parts.lips.parts[:, 1]]).any(axis=1)
    assert (np.abs(left - right)[~torn] < 1e-12).all() and (np.abs(left - right)[torn] > 1e-12).all()


@both
@pytest.mark.parametrize("kind", NETWORKS)
def test_each_body_has_its_rigid_motions_and_no_other_motion_is_free(kind, d):
    levels, n_bodies = network(d, kind)
    space = space_of(d, *levels)
    K = stiffness(space, BRAIN).toarray()
    assert len(np.unique(space.enrichment.body)) == n_bodies
    assert (K == K.T).all()
    values = np.linalg.eigvalsh(K / np.sqrt(np.outer(np.diag(K), np.diag(K))))
    free = n_bodies * d * (d + 1) // 2
    assert (np.abs(values[:free]) < 1e-10).all() and values[free] > 1e-8
    row_body = np.empty(space.enrichment.n_rows, int)
    row_body[space.enrichment.dof] = space.enrichment.body[:, None]
    for body in range(n_bodies):
        U = rigid_motions(space.mesh.points[space.enrichment.node]) * (row_body == body)[:, None, None]
        assert_allclose(K @ U.reshape(len(K), -1), 0, atol=1e-10)


@both
@pytest.mark.parametrize("kind", NETWORKS)
def test_the_energy_of_a_linear_field_is_that_of_its_volume(kind, d):
    space = space_of(d, *network(d, kind)[0])
    G = np.random.default_rng(d).normal(size=(d, d))
    U = (space.mesh.points[space.enrichment.node] @ G.T).ravel()
    density = (hooke(G, *(constant[0] for constant in BRAIN.moduli_in([0]))) * G).sum() / 2
    assert_allclose(U @ (stiffness(space, BRAIN) @ U) / 2, density * SIZES[d] ** d, rtol=1e-12)


@both
def test_stiffness_is_the_sum_of_the_parts(d):
    """Beside the plainest assembly: every part's block added where it belongs."""
    space = space_of(d, *network(d, "branch")[0])
    rng, cells = np.random.default_rng(d), len(space.mesh.cells)
    tissue = Tissue(rng.uniform(1, 5, cells), rng.uniform(0.1, 0.45, cells))
    mu, lam = tissue.moduli_in(space.parts.cell)
    volume = np.bincount(space.parts.part, space.parts.volumes)
    blocks = plain_blocks(space.mesh.gradients[space.parts.cell], lam * volume, mu * volume)
    K = np.zeros((space.enrichment.n_dof,) * 2)
    for rows, own in zip(space.enrichment.dof, blocks):
        dof = (d * rows[:, None] + np.arange(d)).ravel()
        K[np.ix_(dof, dof)] += own
    assert_allclose(stiffness(space, tissue).toarray(), K, atol=1e-12 * K.max())


@both
@pytest.mark.parametrize("kind", ["none", "through", "end"])
def test_tension_along_a_cut_does_not_feel_it(kind, d):
    """The patch test: a constant stress that leaves the lips free is found exactly, from the outline alone."""
    mesh = block(d, SIZES[d])
    phi, end = mesh.points[:, 0] - 0.43 * SIZES[d], mesh.points[:, 1] - 0.6 * SIZES[d]
    space = space_of(d, *{"none": (), "through": [Level(phi)], "end": [Level(phi, [end])]}[kind])
    mu, lam = (constant[0] for constant in BRAIN.moduli_in([0]))
    stress = np.zeros((d, d))
    stress[1:, 1:] = np.array([[0.3, 0.1], [0.1, -0.2]])[: d - 1, : d - 1]
    G = stress / (2 * mu) - lam / (2 * mu * (2 * mu + d * lam)) * np.trace(stress) * np.eye(d)
    rim = rim_points(space)
    held = vector_rows(space.basis_in(rim.points, rim.parts), rim.points @ G.T, SKULL)
    K = stiffness(space, BRAIN)
    found = minimise(K, np.zeros(space.enrichment.n_dof), *eliminate(held))
    assert_allclose(found.U.reshape(-1, d), mesh.points[space.enrichment.node] @ G.T, atol=1e-11)


@both
@pytest.mark.parametrize("kind", ["fixed", "sliding"])
def test_the_skull_holds_the_outline(kind, d):
    """Fixed, nothing of it moves; sliding, each side moves along itself."""
    space = space_of(d, *network(d, "through")[0])
    found = skull_conditions(space, Skull(kind, ramp_mm=0.0), np.empty((0, d)), BRAIN)
    _, T = eliminate(found.constraints)
    rng, rim = np.random.default_rng(d), rim_points(space)
    u = space.basis_in(rim.points, rim.parts) @ (T @ rng.normal(size=T.shape[1])).reshape(-1, d)
    on = (rim.points < 1e-9) | (rim.points > SIZES[d] - 1e-9)
    flat = on.sum(axis=1) < 2  # where sides meet, it moves along their mean
    normal = (u * rim.normals).sum(axis=1)
    assert_allclose(normal[flat], 0, atol=1e-11)
    assert flat.any() and np.abs(u[flat]).max() < 1e-12 if kind == "fixed" else np.abs(u[flat]).max() > 0.1


@both
def test_tractions_on_a_lip_are_those_of_the_stress(d):
    """Of a field that strains and turns, in the parts on both sides of a cut."""
    space = space_of(d, *network(d, "through")[0])
    rng, lips = np.random.default_rng(d), space.parts.lips
    G, m = rng.normal(size=(d, d)), area_vectors(lips.facets)
    at = SimpleNamespace(points=lips.facets.mean(axis=1), parts=lips.parts[:, 1])
    mu, lam = BRAIN.moduli_in(space.parts.cell[at.parts])
    U = (space.mesh.points[space.enrichment.node] @ G.T).ravel()
    found = _tractions(space, at, m, mu, lam) @ U
    assert_allclose(found.reshape(-1, d), m @ hooke(G, mu[0], lam[0]), atol=1e-11)


@both
def test_conditions_on_a_component_and_along_a_normal_are_met(d):
    space = space_of(d, *network(d, "crossing")[0])
    rng, points, parts = np.random.default_rng(d), space.parts.corners.mean(axis=1), space.parts.part
    chosen = rng.choice(len(points), 6, replace=False)
    B = space.basis_in(points[chosen], parts[chosen])
    values, normals = rng.normal(size=(6, d)), rng.normal(size=(6, d))
    U0, T = eliminate(vector_rows(B, values, 0))
    U = (U0 + T @ rng.normal(size=T.shape[1])).reshape(-1, d)
    assert_allclose(B @ U, values, atol=1e-11)
    U0, T = eliminate(normal_rows(B, normals, values[:, 0], 0))
    U = (U0 + T @ rng.normal(size=T.shape[1])).reshape(-1, d)
    assert_allclose(((B @ U) * normals).sum(axis=1), values[:, 0], atol=1e-11)


def pinned(space, points):
    """All components held at points (k, d), wherever they lie."""
    mesh = space.mesh
    node = [np.linalg.norm(mesh.points - x, axis=1).argmin() for x in points]
    B = np.zeros((len(node), space.enrichment.n_rows))
    B[range(len(node)), node] = 1
    return vector_rows(B, np.zeros((len(node), mesh.dim)), SKULL)


def no_springs(space):
    return csr_array((space.enrichment.n_dof,) * 2)


@both
def test_a_body_keeps_the_motions_that_nothing_meets(d):
    """A point takes all shifts, a second one the turns that move it, and so on."""
    space = space_of(d)
    corners = SIZES[d] * np.vstack([np.zeros(d), np.eye(d)])
    for held, left in zip(range(d + 2), {2: (3, 1, 0, 0), 3: (6, 3, 1, 0, 0)}[d]):
        motions = free_motions(space, pinned(space, corners[:held]), no_springs(space), space.enrichment.body[0])
        assert motions.shape[1] == left
        assert_allclose(stiffness(space, BRAIN) @ motions, 0, atol=1e-10)


@both
@pytest.mark.parametrize("loose", ["refuse", "remove", "hold"])
def test_a_piece_that_nothing_holds_is_refused_removed_or_held_at_its_mean(loose, d):
    at = 0.43 * SIZES[d]
    space = space_of(d, Level(block(d, SIZES[d]).points[:, 0] - at))
    held = SIZES[d] * (np.eye(d)[0] + np.vstack([np.zeros(d), np.eye(d)[1:]]))  # corners of the larger piece
    arguments = space, (SimpleNamespace(name="through"),), (), (), pinned(space, held), no_springs(space), loose
    if loose == "refuse":
        with pytest.raises(XfemnavError, match="E306"):
            sort_out(*arguments)
        return
    with pytest.warns(match="W312" if loose == "remove" else "W313"):
        conditions, means, removed, pieces = sort_out(*arguments)
    assert [piece.fate for piece in pieces] == ["fixed", {"remove": "removed", "hold": "held"}[loose]]
    sizes = np.array([SIZES[d] - at, at]) * SIZES[d] ** (d - 1)
    assert_allclose([piece.area_mm2 for piece in pieces], sizes)
    parts, centre = space.parts, np.zeros(space.parts.n_parts)
    centre[parts.part] = parts.corners[..., 0].mean(axis=1)
    assert (removed == ((centre < at) & (loose == "remove"))).all()
    if loose == "hold":
        assert len(means.pins) == d * (d + 1) // 2
        rng = np.random.default_rng(d)
        f = rng.normal(size=space.enrichment.n_dof)
        found = minimise(stiffness(space, BRAIN), f, *eliminate(conditions), means=means)
        points, weights, own = space.rule(parts.corners[..., 0].mean(axis=1) < at, degree=2)
        u = space.basis_in(points, own) @ found.U.reshape(-1, d)
        assert_allclose(np.einsum("q,qi,qim->m", weights, u, rigid_motions(points)), 0, atol=1e-9)
        assert np.abs(u).max() > 1e-3


@both
def test_weight_and_pressure_add_up(d):
    rng = np.random.default_rng(d)
    middle = SIZES[d] / 2 + rng.uniform(-0.1, 0.1, d)
    mesh = block(d, SIZES[d])
    ball = Level(np.linalg.norm(mesh.points - middle, axis=1) - 0.3 * SIZES[d], takes_out=True)
    space = space_of(d, ball)
    parts = space.parts
    left = parts.volumes[~parts.removed[parts.part]].sum()
    down = rng.normal(size=d)
    weight = weight_load(space, Gravity(tuple(down))).reshape(-1, d)
    assert_allclose(weight.sum(axis=0), KPA_PER_MM * 1000 * left * down, rtol=1e-12)
    # A pressure's work on u = x is the pressure times what the surface holds, on a shift nothing.
    for faces, held in ((parts.rim, -SIZES[d] ** d), (parts.walls, parts.volumes[parts.removed[parts.part]].sum())):
        load = pressure_load(space, faces.facets, faces.parts, 0.7).reshape(-1, d)
        assert_allclose(load.sum(axis=0), 0, atol=1e-10)
        assert_allclose((load * space.mesh.points[space.enrichment.node]).sum(), 0.7 * d * held, rtol=1e-9)
    assert_allclose(dead_loads(space, Loads(Gravity(tuple(down)))), weight.ravel())


@both
@pytest.mark.parametrize("degree", [1, 2])
def test_rules_on_simplices_are_exact(degree, d):
    """Beside the closed form of monomials of barycentric coordinates."""
    points = simplex_rule(np.vstack([np.zeros(d), np.eye(d)])[None], degree)[0]
    shares = np.hstack([1 - points.sum(axis=1, keepdims=True), points])
    assert_allclose(shares.mean(axis=0), 1 / (d + 1), rtol=1e-14)
    if degree > 1:
        wanted = (1 + np.eye(d + 1)) / ((d + 1) * (d + 2))
        assert_allclose(np.einsum("qa,qb->ab", shares, shares) / len(shares), wanted, rtol=1e-14)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_gauss_in_a_simplex_is_exact_to_its_degree(dim):
    shares, weights = gauss_in_simplex(dim, 4)
    assert_allclose(weights.sum(), 1, rtol=1e-14)
    assert_allclose(shares.sum(axis=1), 1, rtol=1e-14)
    for powers in [(5, *[0] * dim), (2, 3, *[0] * (dim - 1)), (0,) * (dim - 1) + (1, 4)]:
        wanted = factorial(dim) * np.prod([factorial(p) for p in powers]) / factorial(dim + sum(powers))
        assert_allclose(weights @ np.prod(shares ** np.array(powers), axis=1), wanted, rtol=1e-12)


@both
def test_area_vectors_close_a_simplex(d):
    mesh = block(d, 2)
    facets = mesh.points[mesh.boundary_facets]
    assert_allclose(area_vectors(facets).sum(axis=0), 0, atol=1e-12)
    assert_allclose((area_vectors(facets) * facets.mean(axis=1)).sum() / d, 2**d)  # outwards
