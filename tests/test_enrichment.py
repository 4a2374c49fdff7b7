"""The table of basis functions against a brute-force reading of the paper's definitions of J and K (Sect. 4)."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from data_synthetic import domains
from tests import cuts
from tests.meshes import cut_in, disc, grid, jittered, outline, space_of
from xfemnav.geometry.plane.cut import Cut, place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.mechanics.rules import Basis
from xfemnav.mechanics.space.enrichment import BRANCH, HEAVISIDE, STANDARD, enrich

THIN = 1e-9  # mm: the slit that stands for the cut when supports are taken apart by polygon arithmetic


@functools.cache
def supports(mesh):
    """The support of each node: the union of its cells."""
    cells = shapely.polygons(mesh.corners)
    return [shapely.union_all(cells[(mesh.cells == i).any(axis=1)]) for i in range(len(mesh.points))]


def read_the_paper(mesh, path, tip):
    """Sets J and K as Sect. 4 defines them, and the number of pieces (n,) of each node's support minus the cut.

    J: the crack fully intersects the support, so it falls apart. K: the support has the crack tip inside.
    """
    line = shapely.LineString(path)
    pieces = np.ones(len(mesh.points), dtype=int)
    K = set()
    for i, support in enumerate(supports(mesh)):
        if line.intersects(support):
            # The slit reaches a hair beyond the cut's end; slivers of its own width are no pieces.
            apart = shapely.get_parts(support.difference(line.buffer(THIN, cap_style="square")))
            pieces[i] = sum(piece.area > 1e-6 * support.area for piece in apart)
        if support.contains(shapely.Point(tip)) and support.exterior.distance(shapely.Point(tip)) > THIN:
            K.add(i)
    return set(np.flatnonzero(pieces > 1).tolist()), K, pieces


def random_straight_cut(mesh, rng):
    """From outside across the outline to a point in the inner half, away from nodes and edges as random numbers are."""
    loop = outline(mesh)
    middle, reach = loop.mean(axis=0), np.ptp(loop, axis=0).max()
    angle = rng.uniform(0, 2 * np.pi)
    start = middle + reach * np.array([np.cos(angle), np.sin(angle)])
    return place_cut([start, middle + rng.uniform(-0.2, 0.2, 2) * reach], loop)


MESHES = {
    "jittered": lambda: jittered(20.0, 16.0, 1.0, 0.6, seed=6),
    "disc": disc,
    "gyrated": lambda: distmesh(domains.gyrated(60, 4, 5, 180), 6.0),
}


@pytest.mark.parametrize("name, n", [("jittered", 40), ("disc", 30), ("gyrated", 30)])
def test_the_sets_are_those_of_the_paper_on_random_straight_cuts(name, n):
    """100 cuts in all: n_dof = 2 N + 2 |J| + 8 |K|, but for supports that the cut leaves and enters again."""
    mesh, rng = MESHES[name](), np.random.default_rng(11)
    N, dented = len(mesh.points), 0
    for _ in range(n):
        cut = random_straight_cut(mesh, rng)
        space = space_of(mesh, cut)
        table, (path,) = space.enrichment, space.parts.paths
        # A tip that is snapped onto an edge (1e-3 h) has cut the support opposite that edge: read the snapped cut.
        J, K, pieces = read_the_paper(mesh, path, path[-1])
        assert set(table.heaviside_nodes.tolist()) == J
        assert set(table.tip_nodes.tolist()) == K
        # A straight cut takes a convex support into two pieces at most. A dented one (its nodes' cells do not form a
        # convex polygon) may be entered twice: then it has three pieces, and one function more than one H can give.
        more = pieces[pieces > 2] - 2
        dented += more.sum()
        for i in np.flatnonzero(pieces > 2):
            star = supports(mesh)[i]
            assert star.area < star.convex_hull.area * (1 - 1e-9)
        assert table.n_dof == 2 * N + 2 * len(J) + 8 * len(K) + 2 * more.sum()
        # Where the tip is in a dented support that the cut has also taken apart, the node is in both sets.
        for i in J & K:
            star = supports(mesh)[i]
            assert star.area < star.convex_hull.area * (1 - 1e-9)
    print(f"{name}: {n} cuts, {dented} functions more than Eq. (4) for dented supports")
    # Of the badly shaped mesh 29 % of the supports are dented, and 40 cuts meet some twice; the others have hardly any.
    assert (dented > 0) == (name == "jittered")


def test_two_four_or_ten_degrees_of_freedom_a_node():
    mesh = disc()
    table = space_of(mesh, cut_in(mesh, (3, 80), (1.7, 12.3))).enrichment
    count = 2 * np.bincount(table.node)
    kind = np.zeros(len(mesh.points), dtype=int)
    kind[table.heaviside_nodes], kind[table.tip_nodes] = 1, 2
    assert_allclose(count, np.array([2, 4, 10])[kind])
    assert len(table.tip_nodes) == 3  # a tip inside a cell is in the supports of its three nodes


@pytest.mark.parametrize("tip, n_nodes", [((5.3, 4.2), 3), ((5.4, 5.0), 2), ((5.0, 5.0), 1)])
def test_the_nodes_that_hold_a_tip(tip, n_nodes):
    """A tip in a cell: its three nodes; on an edge: the edge's two ends; on a node: that node alone.

    The supports of the nodes opposite that edge, or next to that node, only touch the tip with their boundary.
    """
    mesh = grid(10, 10.0)
    table = space_of(mesh, Cut([(0.0, 3.3), tip])).enrichment
    assert len(table.tip_nodes) == n_nodes
    assert (np.linalg.norm(mesh.points[table.tip_nodes] - tip, axis=1) < 1.2).all()


def test_through_nodes_and_along_edges_the_support_decides():
    """Along a row of nodes: each node on the cut, its end excepted, has its support in two."""
    mesh = grid(10, 10.0)
    table = space_of(mesh, Cut([(0.0, 4.0), (5.0, 4.0)])).enrichment
    on = np.flatnonzero((mesh.points[:, 1] == 4) & (mesh.points[:, 0] < 5))
    assert set(table.heaviside_nodes.tolist()) == set(on.tolist())
    assert mesh.points[table.tip_nodes].tolist() == [[5.0, 4.0]]


def test_rows_keep_their_order():
    """Row i < N is node i's own; then the further pieces; then fours of branch functions, F_1 to F_4."""
    mesh = disc()
    table = space_of(mesh, cut_in(mesh, (3, 80), (1.7, 12.3))).enrichment
    N = len(mesh.points)
    assert_allclose(table.node[:N], np.arange(N))
    assert (table.kind[:N] == STANDARD).all() and (np.diff(table.kind >= BRANCH) >= 0).all()
    n_h = (table.kind == HEAVISIDE).sum()
    assert_allclose(table.kind[N : N + n_h], HEAVISIDE)
    assert_allclose(table.kind[N + n_h :].reshape(-1, 4), np.tile(BRANCH + np.arange(4), (3, 1)))
    assert (table.tip[table.kind >= BRANCH] == 0).all() and (table.tip[table.kind < BRANCH] == -1).all()
    assert table.n_dof == 2 * table.n_rows


def test_no_tip_functions_when_none_are_wanted():
    mesh = disc()
    cut = cut_in(mesh, (3, 80), (1.7, 12.3))
    plain, full = space_of(mesh, cut, tip_enrichment="none").enrichment, space_of(mesh, cut).enrichment
    assert not len(plain.tip_nodes) and full.n_dof - plain.n_dof == 8 * 3
    assert_allclose(plain.heaviside_nodes, full.heaviside_nodes)


def test_a_cut_right_through_makes_two_bodies_and_no_tip():
    mesh = disc()
    table = space_of(mesh, cut_in(mesh, (-80, 11), (80, 14))).enrichment
    assert table.body.max() == 1 and not len(table.tip_nodes)
    # On a piece there is no other function than its own: both halves are plain finite elements.
    assert table.n_rows == len(mesh.points) + len(table.heaviside_nodes)


def test_crossing_cuts_give_a_function_for_each_piece():
    """Two cuts crossing in a cell's middle: its three nodes' supports are in four pieces."""
    mesh = grid(4, 4.0)
    centre = mesh.corners[mesh.corners.mean(axis=1)[:, 0].argsort()[len(mesh.cells) // 2]].mean(axis=0)
    across = [Cut([centre * (1, 0), centre * (1, 0) + (0, 4)]), Cut([centre * (0, 1), centre * (0, 1) + (4, 0)])]
    table = space_of(mesh, *across).enrichment
    held = np.linalg.norm(mesh.points - centre, axis=1) < 0.8
    pieces = np.bincount(table.node)
    assert table.body.max() == 3
    assert (pieces[held] == 4).all()


def test_an_internal_cut_shorter_than_an_element_keeps_no_jump_beyond_its_ends():
    """Both tips in one support: the branch functions' line of discontinuity would run on past the other end."""
    mesh = disc()
    cut = cut_in(mesh, (1.0, 2.0), (2.5, 2.2), internal=True)
    table = space_of(mesh, cut).enrichment
    for tip, other in ((0, 1), (1, 0)):
        nodes = np.unique(table.node[table.tip == tip])
        held = supports(mesh)
        end = shapely.Point(cut.path[[0, -1]][other])
        assert not any(held[i].contains(end) for i in nodes)


def test_tip_functions_ask_the_cut_and_not_the_outline_where_it_ends():
    """With no facet of the outline named, the nodes within a radius are the same: of a mouth, and of two tips."""
    mesh = disc()
    for cut in (cut_in(mesh, (3, 80), (1.7, 12.3)), cut_in(mesh, (-9.0, 2.0), (9.0, 3.0), internal=True)):
        split = space_of(mesh, cut).parts
        bare = replace(split, rim=split.rim.rows([]))
        found, expected = (enrich(mesh, each, Basis("geometric", 1e3)) for each in (bare, split))
        assert np.array_equal(found.node, expected.node)
        # The functions of a tip end before another tip; a mouth does not stop them.
        far = np.linalg.norm(mesh.points[found.node[found.tip == 0]] - split.fronts.at[0], axis=1).max()
        assert (far > cut.length) == cut.mouth


@pytest.mark.parametrize("name", sorted(cuts.POSITIONS))
def test_the_table_is_consistent_wherever_the_cut_lies(name):
    for seed in range(2):
        mesh = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
        network = cuts.POSITIONS[name](mesh, np.random.default_rng(seed))
        space = space_of(mesh, *[cut_in(mesh, *path, internal=inner) for path, inner in network])
        table, split = space.enrichment, space.parts
        assert_allclose(table.node[table.dof], mesh.cells[split.cell])
        assert set(np.unique(table.dof)) == set(np.flatnonzero(table.kind < BRANCH))
        # Two parts of one node's support have the same function exactly when facets join them inside the support.
        assert (table.body[split.joins[:, 0]] == table.body[split.joins[:, 1]]).all()
        assert_allclose(table.kind[table.entry_row], BRANCH)
        assert_allclose(table.node[table.entry_row], mesh.cells[split.cell[table.entry_part], table.entry_node])
        assert (np.diff(table.entry_part) >= 0).all()
