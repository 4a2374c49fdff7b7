"""The one operator B with u = B U: partition of unity, continuity, jumps, derivatives, and Eq. (4) as printed."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from benchmarks.probes import basis_at, parts_at
from tests import cuts
from tests.eq_4 import paper_coefficients
from tests.meshes import cut_in, disc, grid, jittered, space_of
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.subcells import embed
from xfemnav.mechanics.rules import Basis
from xfemnav.mechanics.space.enrichment import BRANCH, enrich
from xfemnav.mechanics.space.space import Space

MESH = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
# Values of hat functions: coordinates of size 10 over cells of size 1, a few roundings.
EXACT = 1e-12


def place(name, seed, tip_enrichment="topological") -> Space:
    network = cuts.POSITIONS[name](MESH, np.random.default_rng(seed))
    placed = [cut_in(MESH, *path, internal=internal) for path, internal in network]
    return space_of(MESH, *placed, tip_enrichment=tip_enrichment)


def random_points(space, rng, n=2):
    """n random points in each triangle (k, 2), and their parts."""
    weights = rng.dirichlet(np.ones(3), (len(space.parts.corners), n))
    points = np.einsum("tna,tai->tni", weights, space.parts.corners)
    return points.reshape(-1, 2), np.repeat(space.parts.part, n)


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.sampled_from(sorted(cuts.POSITIONS)), st.integers(0, 2**32 - 1))
def test_standard_and_heaviside_functions_add_up_to_one(name, seed):
    space = place(name, seed)
    B = space.basis_in(*random_points(space, np.random.default_rng(seed)))
    plain = space.enrichment.kind < BRANCH
    assert_allclose(B @ plain, 1, atol=EXACT)
    hats = B[:, np.flatnonzero(plain)]
    assert hats.min() > -EXACT and hats.max() < 1 + EXACT


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.sampled_from(sorted(cuts.POSITIONS)), st.integers(0, 2**32 - 1))
def test_linear_fields_are_in_the_space_exactly(name, seed):
    """Standard coefficients are nodal displacements: with no enrichment a linear field is itself, gradient too."""
    space = place(name, seed)
    G, shift = np.array([[0.3, -0.2], [0.1, 0.4]]), np.array([1.0, 2.0])
    plain = space.enrichment.kind < BRANCH
    U = np.where(plain[:, None], MESH.points[space.enrichment.node] @ G.T + shift, 0.0)
    points, parts = random_points(space, np.random.default_rng(seed))
    assert_allclose(space.basis_in(points, parts) @ U, points @ G.T + shift, atol=10 * EXACT)
    for axis, derivative in enumerate(space.gradient_in(points, parts)):
        assert_allclose(derivative @ U, np.tile(G[:, axis], (len(points), 1)), atol=10 * EXACT)


@pytest.mark.parametrize("name", ["generic", "tip_on_an_edge", "tip_on_a_node", "kinks_in_a_cell", "internal"])
def test_derivatives_equal_finite_differences(name):
    space = place(name, 3)
    rng = np.random.default_rng(0)
    # Well inside triangles, so that a step stays in the part, and off the tip.
    middle = space.parts.corners.mean(axis=1)
    size = np.sqrt(space.parts.volumes)
    far = size > 0.05
    points, parts = middle[far], space.parts.part[far]
    U = rng.normal(size=(space.enrichment.n_rows, 2))
    step = 1e-5
    for axis, derivative in enumerate(space.gradient_in(points, parts)):
        e = step * np.eye(2)[axis]
        numeric = (space.basis_in(points + e, parts) - space.basis_in(points - e, parts)) @ U / (2 * step)
        # Step^2 times the third derivative of sqrt(r) at r > .02: 1e-10 * .02^-2.5 = 2e-6, and rounding 1e-16 / step.
        assert_allclose(derivative @ U, numeric, atol=2e-5)


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.sampled_from(sorted(cuts.POSITIONS)), st.integers(0, 2**32 - 1))
def test_the_field_is_continuous_across_every_contact(name, seed):
    """Where two parts touch off the cut, they give one value: no leak of a jump beyond the cut, for any U."""
    space = place(name, seed)
    split, rng = space.parts, np.random.default_rng(seed)
    U = rng.normal(size=(space.enrichment.n_rows, 2))
    across = (split.through < 0).any(axis=1)
    inner = split.joins[across]
    edge = MESH.cells[split.cell[inner[:, 0]]][split.through[across] >= 0].reshape(-1, 2)
    a, b = MESH.points[edge].swapaxes(0, 1)
    network = shapely.union_all([shapely.linestrings(path) for path in split.paths])
    for fraction in (0.1, 0.37, 0.71, 0.93):
        points = a + fraction * (b - a)
        # The contact is the overlap of both parts' facets, where the edge itself is not cut.
        near = shapely.distance(network, shapely.points(points)) > 1e-6
        near &= _touches(split, points, inner[:, 0]) & _touches(split, points, inner[:, 1])
        one, other = (space.basis_in(points[near], inner[near, k]) @ U for k in (0, 1))
        assert_allclose(one, other, atol=100 * EXACT)  # random coefficients of size 3, up to 15 functions


def _touches(split, points, parts):
    """Whether each point (k, 2) lies in the closed part named beside it."""
    inside = np.zeros(len(points), dtype=bool)
    order = np.argsort(split.part, kind="stable")
    start = np.searchsorted(split.part[order], np.arange(split.n_parts + 1))
    for n, (x, p) in enumerate(zip(points, parts)):
        t = split.corners[order[start[p] : start[p + 1]]]
        edge, to = np.roll(t, -1, axis=1) - t, x - t
        inside[n] = ((edge[..., 0] * to[..., 1] - edge[..., 1] * to[..., 0]) > -1e-12).all(axis=1).any()
    return inside


def test_no_jump_ahead_of_the_tip_and_a_full_one_behind():
    space = place("generic", 1)
    split = space.parts
    U = np.random.default_rng(2).normal(size=(space.enrichment.n_rows, 2))
    tip, travel = split.fronts.at[0], split.fronts.travel[0]
    left = np.array([-travel[1], travel[0]])
    ahead = tip + np.linspace(0.05, 2.0, 60)[:, None] * travel
    near = 1e-13 * left  # on both sides of the cut's continuation: the same point but for rounding
    both = [basis_at(space, ahead + side * near) @ U for side in (1, -1)]
    assert_allclose(both[0], both[1], atol=1e-12)  # the field's gradient (size 10) times 2e-13
    ends = split.lips.facets.mean(axis=1)
    jump = (space.basis_in(ends, split.lips.parts[:, 0]) - space.basis_in(ends, split.lips.parts[:, 1])) @ U
    assert (np.linalg.norm(jump, axis=1) > 1e-3).all()


def test_the_jump_closes_as_the_square_root_at_the_tip():
    """Behind the tip, inside its cell, the jump is 2 sqrt(r) times F_1's coefficient: it vanishes at the tip."""
    space = place("generic", 1)
    split, table = space.parts, space.enrichment
    U = np.zeros((table.n_rows, 2))
    U[table.kind == BRANCH] = (0.5, -2.0)  # all K nodes alike: sum of N_i F_1 = F_1 in the tip's cell
    r = np.array([1e-6, 1e-4, 1e-2]) * np.linalg.norm(split.lips.facets[-1, 1] - split.lips.facets[-1, 0])
    points = split.fronts.at[0] - r[:, None] * split.fronts.travel[0]
    jump = (basis_at(space, points, +1) - basis_at(space, points, -1)) @ U
    assert_allclose(jump, 2 * np.sqrt(r)[:, None] * (0.5, -2.0), rtol=1e-6)  # r is rounded at 1e-15 / 1e-6 and summed


def test_standard_coefficients_are_the_nodal_displacements():
    """Shifted branch functions vanish at their node, whatever their coefficients."""
    space = place("generic", 4)
    table, split = space.enrichment, space.parts
    U = np.random.default_rng(2).normal(size=(table.n_rows, 2))
    on_cut = np.zeros(len(MESH.points), dtype=bool)
    on_cut[np.unique(MESH.cells[split.cell[split.lips.parts.ravel()]])] = True
    assert on_cut.any()
    assert_allclose(basis_at(space, MESH.points) @ U, U[: len(MESH.points)], atol=100 * EXACT)


@pytest.mark.parametrize("seed", range(4))
def test_eq_4_as_the_paper_writes_it(seed):
    """u_i, a_j, c_k^l from `paper_coefficients` put into Eq. (4) literally, with H by Eq. (2) and F_l by Eq. (3)."""
    space = place("generic", seed)
    U = np.random.default_rng(seed).normal(size=(space.enrichment.n_rows, 2))
    points, parts = random_points(space, np.random.default_rng(seed))
    path = space.parts.paths[0]
    assert len(path) == 2
    direction = (path[1] - path[0]) / np.linalg.norm(path[1] - path[0])
    across = direction[0] * (points - path[1])[:, 1] - direction[1] * (points - path[1])[:, 0]
    clear = np.abs(across) > 1e-9
    points, parts, across = points[clear], parts[clear], across[clear]
    along = (points - path[1]) @ direction
    H = np.sign(across)
    r, theta = np.hypot(along, across), np.arctan2(across, along)
    s = np.sqrt(r)
    F = np.stack([s * np.sin(theta / 2), s * np.cos(theta / 2),
                  s * np.sin(theta / 2) * np.sin(theta), s * np.cos(theta / 2) * np.sin(theta)], axis=1)
    paper = paper_coefficients(space, U)
    cell = space.parts.cell[parts]
    nodes = MESH.cells[cell]
    phi = np.einsum("kai,ki->ka", MESH.gradients[cell], points - MESH.points[nodes[:, 0]])
    phi[:, 0] += 1
    u = np.einsum("ka,kai->ki", phi, paper["u"][nodes])
    u += H[:, None] * np.einsum("ka,kai->ki", phi, paper["a"][nodes])
    u += np.einsum("ka,kl,kali->ki", phi, F, paper["c"][nodes])
    assert_allclose(u, space.basis_in(points, parts) @ U, atol=100 * EXACT)
    assert_allclose(np.flatnonzero(np.abs(paper["a"]).any(axis=1)), space.enrichment.heaviside_nodes)
    assert_allclose(np.flatnonzero(np.abs(paper["c"]).any(axis=(1, 2))), space.enrichment.tip_nodes)


def test_two_pieces_more_have_no_eq_4():
    mesh = grid(4, 4.0)
    space = space_of(mesh, Cut([(0.0, 2.3), (4.0, 2.3)]), Cut([(1.6, 0.0), (1.6, 4.0)]))
    with pytest.raises(ValueError, match="one H"):
        paper_coefficients(space, np.zeros((space.enrichment.n_rows, 2)))


@pytest.mark.parametrize("name", ["generic", "along_edges", "through_two_nodes", "kinks_in_a_cell"])
def test_a_point_on_the_cut_is_taken_on_the_side_asked_for(name):
    space = place(name, 2)
    split = space.parts
    U = np.random.default_rng(3).normal(size=(space.enrichment.n_rows, 2))
    long = np.linalg.norm(split.lips.facets[:, 1] - split.lips.facets[:, 0], axis=1) > 0.05
    for fraction in (0.25, 0.6):
        points = (split.lips.facets[:, 0] + fraction * (split.lips.facets[:, 1] - split.lips.facets[:, 0]))[long]
        for side, column in ((1, 0), (-1, 1)):
            asked = basis_at(space, points, side) @ U
            assert_allclose(asked, space.basis_in(points, split.lips.parts[long, column]) @ U, atol=100 * EXACT)


def test_a_point_anywhere_is_found_in_its_part():
    mesh = disc()
    space = space_of(mesh, cut_in(mesh, (3, 80), (1.7, 12.3)))
    rng = np.random.default_rng(9)
    points, parts = random_points(space, rng, 1)
    assert_allclose(parts_at(space, points), parts)


def test_a_point_outside_is_refused():
    space = place("generic", 1)
    with pytest.raises(ValueError, match="outside the mesh"):
        basis_at(space, np.array([[1.0, 1.0], [-0.5, 5.0]]))


CUTS_INSIDE = {
    "from the outline": ((-1.0, 7.3), (9.1, 8.2)),
    "inside, long": ((4.2, 7.3), (14.9, 8.4)),
    "inside, two elements": ((9.1, 7.3), (11.0, 7.9)),
    "inside, half an element": ((9.1, 7.3), (9.5, 7.5)),
    "kinked near its tip": ((-1.0, 7.3), (9.1, 8.2), (9.9, 6.4)),
}


@pytest.mark.parametrize("tip_enrichment", ["topological", "geometric", "none"])
@pytest.mark.parametrize("name", CUTS_INSIDE)
def test_no_function_jumps_but_on_the_cut(name, tip_enrichment):
    """At the middle of every contact both parts give one value: also beyond a cut's other end, where the line of a
    tip's jump has no cut to lie on."""
    mesh = jittered()
    cut = cut_in(mesh, *CUTS_INSIDE[name], internal="inside" in name)
    split = embed(mesh, (cut,))
    space = Space(mesh, split, enrich(mesh, split, Basis(tip_enrichment, 4.0)))
    p, q = split.joins.T
    jump = space.basis_in(split.middles, p) - space.basis_in(split.middles, q)
    assert abs(jump).max() < 1e-9
