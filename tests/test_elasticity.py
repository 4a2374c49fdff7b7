"""The stiffness matrix: sizes of Sect. 5, symmetry, rigid motions, known energies, what enrichment costs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.verification import plane
from tests import cuts
from tests.meshes import BRAIN, cut_in, disc, grid, jittered, mapped, space_of, turn
from xfemnav.errors import XfemnavError
from xfemnav.mechanics.solving.hyperelastic import gradient_operator
from xfemnav.mechanics.space.branch import branch_gradients
from xfemnav.mechanics.space.enrichment import BRANCH
from xfemnav.mechanics.space.quadrature import tip_rule
from xfemnav.mechanics.tissue.elasticity import Material, Tissue, hooke, mixed, plain_blocks, stiffness

MESH = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
MATERIALS = [Material(3.0, 0.45), Material(3.0, 0.0, "strain"), Material(0.7, 0.3, "stress"), Material(3.0, 0.499)]


def generic_space(mesh=MESH, tip_enrichment="topological"):
    return space_of(mesh, cut_in(mesh, (-1, 4.13), (6.37, 5.21)), tip_enrichment=tip_enrichment)


@pytest.mark.parametrize(
    "young, nu",
    [(0, 0.3), (-1, 0.3), (np.nan, 0.3), (np.inf, 0.3), (3, 0.5), (3, -0.1), (3, 0.4995), (3, np.nan)],
)
def test_constants_out_of_range_are_refused(young, nu):
    with pytest.raises(XfemnavError, match="E404"):
        Material(young, nu)
    with pytest.raises(XfemnavError, match="E404"):
        Material(3.0, 0.3, "plane")


@pytest.mark.parametrize("material", MATERIALS)
def test_uniaxial_stress(material):
    """Hooke's law: a bar pulled in x strains 1 / E, and -nu / E across; plane strain has its own E and nu there."""
    E, nu = material.young_kpa, material.poisson
    if material.stress_state == "strain":
        E, nu = E / (1 - nu**2), nu / (1 - nu)
    D = plane.stiffness(material)
    assert_allclose(np.linalg.solve(D, [1.0, 0, 0]), [1 / E, -nu / E, 0], rtol=1e-10, atol=1e-13)
    shear = np.linalg.solve(D, [0, 0, 1.0])
    assert_allclose(shear, [0, 0, 1 / material.shear_modulus], rtol=1e-12, atol=1e-13)


def test_kolosov_s_constant():
    assert Material(3.0, 0.45).kappa == pytest.approx(1.2)
    assert Material(3.0, 0.25, "stress").kappa == pytest.approx(2.2)


def test_element_stiffness_is_6_12_or_30_square():
    """Sect. 5: 6 x 6 for a cell without enriched nodes, 12 x 12 for three H nodes, 30 x 30 for three tip nodes."""
    space = generic_space()
    table, cells = space.enrichment, MESH.cells
    kind = np.zeros(len(MESH.points), dtype=int)
    kind[table.heaviside_nodes], kind[table.tip_nodes] = 1, 2
    for wanted, size in ((0, 6), (1, 12), (2, 30)):
        chosen = np.flatnonzero((kind[cells] == wanted).all(axis=1))
        if wanted == 1:  # three H nodes, and the cell itself is cut
            chosen = np.intersect1d(chosen, space.parts.cell[space.parts.lips.parts])
        assert len(chosen)
        for cell in chosen[:5]:
            K = stiffness(space, BRAIN, cells=[cell])
            active = np.flatnonzero(np.abs(K).sum(axis=0))
            assert len(active) == size
            K_c = K[active][:, active].toarray()
            assert_allclose(K_c, K_c.T, rtol=0, atol=1e-14 * np.abs(K_c).max())
            # Three rigid motions a piece cost nothing. A tip cell has four null vectors more, as x F_1, y F_2, x F_4,
            # y F_3 span sin(t/2), sin(3t/2), sin(5t/2) times r^(3/2) only, and x F_2, y F_1, x F_3, y F_4 the cosines:
            # two dependencies a component, which the neighbouring cells lift.
            null = (np.linalg.eigvalsh(K_c) < 1e-12 * np.abs(K_c).max()).sum()
            assert null == {6: 3, 12: 6, 30: 3 + 4}[size]


@pytest.mark.parametrize("name", sorted(cuts.POSITIONS))
def test_symmetric_positive_and_blind_to_rigid_motions(name):
    network = cuts.POSITIONS[name](MESH, np.random.default_rng(7))
    space = space_of(MESH, *[cut_in(MESH, *path, internal=internal) for path, internal in network])
    K, table = stiffness(space, BRAIN), space.enrichment
    size = np.abs(K).max()
    assert np.abs(K - K.T).max() <= 1e-14 * size
    x, own = MESH.points[table.node], (table.kind < BRANCH).astype(float)
    for u in ((own, 0 * own), (0 * own, own), (-own * x[:, 1], own * x[:, 0])):
        # Sums of about 20 terms of K's size times coordinates up to 12, in floating point.
        assert_allclose(K @ np.stack(u, axis=1).ravel(), 0, atol=1e-12 * size)
    v = np.random.default_rng(0).normal(size=(K.shape[0], 20))
    assert (np.einsum("ik,ik->k", v, K @ v) > 0).all()


@pytest.mark.parametrize("material", MATERIALS)
def test_the_energy_of_a_linear_field_is_half_stress_times_strain_times_area(material):
    space, G = generic_space(), np.array([[0.02, 0.01], [-0.03, 0.015]])
    table = space.enrichment
    U = np.where((table.kind < BRANCH)[:, None], MESH.points[table.node] @ G.T, 0.0).ravel()
    strain = np.array([G[0, 0], G[1, 1], G[0, 1] + G[1, 0]])
    wanted = strain @ plane.stiffness(material) @ strain / 2 * MESH.volumes.sum()
    # Branch parts are integrated numerically, but a constant is exact for any rule.
    assert_allclose(U @ (stiffness(space, material) @ U) / 2, wanted, rtol=1e-12)


@pytest.mark.parametrize("name", ["generic", "tip_on_an_edge", "tip_on_a_node", "beside_an_edge", "kinks_in_a_cell"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_quadrature_of_branch_functions_is_good_to_a_millionth(name, seed):
    """The whole stiffness against the finer rule: the measured error of the usual one."""
    network = cuts.POSITIONS[name](MESH, np.random.default_rng(seed))
    space = space_of(MESH, *[cut_in(MESH, *path, internal=internal) for path, internal in network])
    split, D = space.parts, plane.stiffness(BRAIN)
    about = np.flatnonzero(np.isin(split.part, space.branch_parts))
    K = stiffness(space, BRAIN, cells=np.unique(split.cell[space.branch_parts]))
    points, weights, owner = tip_rule(split.corners[about], split.fronts.at, fine=True)
    H = gradient_operator(space, points, split.part[about][owner])
    eps = [H[0::4], H[3::4], H[1::4] + H[2::4]]
    fine = sum(D[s, t] * (eps[s].T @ eps[t].multiply(weights[:, None])) for s in range(3) for t in range(3))
    branch = np.repeat(space.enrichment.kind >= BRANCH, 2)
    error = np.abs((K - fine).toarray()[branch][:, branch]).max()
    assert error <= 1e-6 * np.abs(fine.toarray()[branch][:, branch]).max()


def test_a_branch_function_alone_has_the_energy_of_its_closed_form():
    """All three nodes of the tip's cell with F_1: u = F_1 there. Its energy by an independent rule in polar form."""
    space = generic_space()
    split, table = space.parts, space.enrichment
    cell = split.cell[split.touch[0, 1]]
    K = stiffness(space, BRAIN, cells=[cell])
    travel, tip = split.fronts.travel[0], split.fronts.at[0]
    Q = np.array([travel, [-travel[1], travel[0]]])
    corners = (MESH.corners[cell] - tip) @ Q.T
    t, w = np.polynomial.legendre.leggauss(400)  # the tip lies .003 mm from an edge of its cell
    for l in range(4):
        U = np.zeros((table.n_rows, 2))
        rows = np.flatnonzero(table.kind == BRANCH + l)
        U[rows] = Q[1]
        U[table.node[rows]] = table.shift[rows, None] * Q[1]  # undo the shift
        # Rays from the lip at -pi to that at +pi, each to where it leaves the cell.
        corner_angles = np.sort(np.arctan2(corners[:, 1], corners[:, 0]))
        ends = np.concatenate([[-np.pi], corner_angles, [np.pi]])
        energy = 0.0
        for low, high in zip(ends[:-1], ends[1:]):
            theta = low + (high - low) * (t + 1) / 2
            ray = np.stack([np.cos(theta), np.sin(theta)], axis=1)
            edge = np.roll(corners, -1, axis=0) - corners
            normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
            with np.errstate(divide="ignore"):
                reach = (normal * corners).sum(axis=1) / (ray @ normal.T)
            R = np.where(reach > 0, reach, np.inf).min(axis=1)
            g = branch_gradients(np.ones_like(theta), theta)[:, l]
            strain = np.stack([0 * theta, g[:, 1], g[:, 0]], axis=1)
            # u = F_l in the second direction of the tip's frame; strain goes as r^-1/2: its square times r dr gives R.
            density = np.einsum("qs,st,qt->q", strain, plane.stiffness(BRAIN), strain) / 2
            energy += (high - low) / 2 * (w * density * R).sum()
        assert_allclose(U.ravel() @ (K @ U.ravel()) / 2, energy, rtol=1e-7)


def test_what_enrichment_costs():
    """Added degrees of freedom, entries and memory: those of the table, a small share of the whole."""
    mesh = disc()
    cut = cut_in(mesh, (3, 80), (1.7, 12.3))
    plain, full = (stiffness(space_of(mesh, *c), BRAIN) for c in ((), (cut,)))
    table = space_of(mesh, cut).enrichment
    added = full.shape[0] - plain.shape[0]
    assert added == 2 * len(table.heaviside_nodes) + 8 * len(table.tip_nodes)
    memory = [K.data.nbytes + K.indices.nbytes + K.indptr.nbytes for K in (plain, full)]
    print(f"added {added} of {full.shape[0]} DOFs, {full.nnz - plain.nnz} of {full.nnz} entries, "
          f"{(memory[1] - memory[0]) / 1024:.0f} of {memory[1] / 1024:.0f} kB")
    assert full.nnz - plain.nnz < 0.5 * plain.nnz


@pytest.mark.parametrize("Q", [turn(np.pi / 6), np.diag([-1.0, 1.0]), turn(1.0) @ np.diag([1.0, -1.0])])
def test_turned_and_mirrored_spaces_have_turned_stiffness(Q):
    """U'KU is the same for the turned coefficients; a mirror changes the sign of F_1 and F_4, odd in theta."""
    space = generic_space()
    other_mesh = mapped(MESH, Q, (5.0, -3.0))
    path = space.parts.paths[0] @ Q.T + (5.0, -3.0)
    other = space_of(other_mesh, cut_in(other_mesh, *(path + 0.0)))
    assert other.enrichment.n_dof == space.enrichment.n_dof
    U = np.random.default_rng(1).normal(size=(space.enrichment.n_rows, 2))
    odd = np.isin(space.enrichment.kind, (BRANCH, BRANCH + 3))
    V = (U * np.where(odd & (np.linalg.det(Q) < 0), -1.0, 1.0)[:, None]) @ Q.T
    one, same = (u.ravel() @ (stiffness(s, BRAIN) @ u.ravel()) for u, s in ((U, space), (V, other)))
    # Quadrature points turn with the triangles (error 1e-6 of the branch part where they start at another corner).
    assert_allclose(same, one, rtol=1e-8)


def test_stiffness_does_not_depend_on_the_unit_of_length():
    """In the plane K has no length in it: plain functions keep their entries in another unit."""
    mesh = grid(4, 4.0)
    K = stiffness(space_of(mesh), BRAIN)
    assert_allclose(stiffness(space_of(mapped(mesh, 10 * np.eye(2))), BRAIN).toarray(), K.toarray(), atol=1e-12)


def test_one_tissue_in_all_cells_is_the_material():
    space = generic_space()
    n = len(space.mesh.cells)
    same = Tissue(np.full(n, 3.0), np.full(n, 0.45))
    one, other = stiffness(space, Material(3.0, 0.45)), stiffness(space, same)
    assert abs(one - other).max() <= 1e-14 * abs(one).max()  # the same sums


def test_shares_mix_the_constants_of_lame_and_so_the_stiffness():
    soft, hard = Material(3.0, 0.45), Material(9.0, 0.30)
    tissue = mixed((soft, hard), [[1, 0], [0, 2], [1, 3]])
    one, other = (np.array(each.lame_in([0])) for each in (soft, hard))
    assert_allclose(tissue.lame_in(np.arange(3)), np.hstack([one, other, 0.25 * one + 0.75 * other]), rtol=1e-13)


@pytest.mark.parametrize("state", ["strain", "stress"])
def test_hookes_law_is_that_of_the_plane(state):
    material, H = Material(3.0, 0.4, state), np.array([[[0.02, 0.01], [-0.03, 0.015]]])
    xx, yy, xy = plane.stiffness(material) @ [0.02, 0.015, -0.02]
    assert_allclose(hooke(H, *material.moduli_in([0])), [[[xx, xy], [xy, yy]]], rtol=1e-13)
    assert_allclose(material.p_wave_in([0]), plane.stiffness(material)[0, 0], rtol=1e-13)


def test_stiffness_of_one_triangle_is_that_of_strains_as_columns():
    gradients, D = np.array([[[-1.0, -0.5], [1.0, -0.2], [0.0, 0.7]]]), plane.stiffness(BRAIN)
    B = np.zeros((3, 6))
    B[0, ::2] = B[2, 1::2] = gradients[0, :, 0]
    B[1, 1::2] = B[2, ::2] = gradients[0, :, 1]
    mu, lam = BRAIN.moduli_in([0])
    assert_allclose(plain_blocks(gradients, 2 * lam, 2 * mu)[0], 2 * B.T @ D @ B, rtol=1e-12, atol=1e-13)


def test_tissue_out_of_range_is_refused():
    with pytest.raises(XfemnavError) as caught:
        Tissue([3.0, -1.0], [0.45, 0.45])
    assert caught.value.code == "E404"
