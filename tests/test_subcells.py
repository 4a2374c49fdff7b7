"""What cuts do to a mesh: the parts fill their cells, joins and lips are those of the plane, snapping moves little."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tests import cuts
from tests.meshes import cut_in, grid, jittered
from xfemnav.geometry.mesh import orient
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.snapping import SNAP
from xfemnav.geometry.plane.subcells import embed

MESHES = {f"jitter {j}": jittered(12.0, 10.0, 1.0, j, seed=int(100 * j)) for j in (0.0, 0.25, 0.35)}
MESHES["grid"] = grid(10, 10.0)
positions = st.tuples(
    st.sampled_from(sorted(cuts.POSITIONS)), st.sampled_from(sorted(MESHES)), st.integers(0, 2**32 - 1)
)
# Subcell areas are sums of cross products of coordinates of size 10 mm over areas of .5 mm^2: a few hundred roundings.
AREA = 1e-12


def place(position):
    name, mesh, seed = position
    mesh = MESHES[mesh]
    network = cuts.POSITIONS[name](mesh, np.random.default_rng(seed))
    placed = tuple(cut_in(mesh, *path, internal=internal) for path, internal in network)
    return mesh, placed, embed(mesh, placed)


def part_polygons(split):
    """Outline of each part: the union of its triangles."""
    triangles = shapely.polygons(split.corners)
    return [shapely.union_all(triangles[split.part == p], grid_size=0) for p in range(split.n_parts)]


@settings(derandomize=True, max_examples=60, deadline=None)
@given(positions)
def test_parts_fill_their_cells_without_overlap(position):
    mesh, _, split = place(position)
    assert (split.volumes > 0).all()
    cell = split.cell[split.part]
    assert_allclose(np.bincount(cell, split.volumes, len(mesh.cells)), mesh.volumes, rtol=AREA)
    # Areas add up and every triangle lies in its cell: so they cannot overlap either.
    a, b, c = mesh.corners[cell].swapaxes(0, 1)
    inside = [orient(p[:, None], q[:, None], split.corners) for p, q in ((a, b), (b, c), (c, a))]
    assert np.min(inside) > -AREA * 100


@settings(derandomize=True, max_examples=60, deadline=None)
@given(positions)
def test_joins_are_pairs_once_and_between_neighbours(position):
    mesh, _, split = place(position)
    p, q = split.joins.T
    assert (p != q).all()
    # A contact is one unordered pair: both directions would be the same row.
    assert len(np.unique(np.sort(split.joins, axis=1), axis=0)) == len(split.joins)
    cp, cq = split.cell[p], split.cell[q]
    through = (split.through >= 0).sum(axis=1)
    assert (through[cp == cq] == 3).all() and (through[cp != cq] == 2).all()
    j, local = np.nonzero(split.through >= 0)
    assert (mesh.cells[cp[j], local] == mesh.cells[cq[j], split.through[j, local]]).all()


@settings(derandomize=True, max_examples=40, deadline=None)
@given(position=positions, mirror=st.booleans(), start=st.integers(0, 2))
def test_joins_do_not_depend_on_the_numbering(position, mirror, start):
    """Renumbered cells, turned corners: the same parts touch (named by their centroids)."""
    mesh, placed, split = place(position)
    order = np.random.default_rng(start).permutation(len(mesh.cells))
    turned = np.roll(mesh.cells[order], start, axis=1)
    other = embed(type(mesh)(mesh.points, turned), placed)
    assert len(other.joins) == len(split.joins) and other.n_parts == split.n_parts
    assert len(other.lips.cut) == len(split.lips.cut) and len(other.fronts.at) == len(split.fronts.at)

    def contacts(s):
        area = np.bincount(s.part, s.volumes)
        x = [np.bincount(s.part, s.volumes * s.corners.mean(axis=1)[:, k]) / area for k in (0, 1)]
        name = np.round(x[0] + 1.7e-3 * x[1], 7)
        return np.sort(np.sort(name[s.joins], axis=1), axis=0)

    assert_allclose(contacts(other), contacts(split), atol=1e-6)


@pytest.mark.parametrize("name", ["generic", "tip_on_an_edge", "tip_on_a_node", "kinks_in_a_cell", "crossing",
                                  "two_tips_in_a_cell", "branch", "along_edges", "internal", "right_through"])
@pytest.mark.parametrize("seed", [0, 1])
def test_joins_equal_those_of_the_plane(name, seed):
    """Brute force: two parts are joined where their polygons share more than a point of boundary off the cut."""
    _, _, split = place((name, "jitter 0.25", seed))
    polygons = part_polygons(split)
    network = shapely.union_all([shapely.linestrings(path) for path in split.paths]).buffer(1e-7)
    tree = shapely.STRtree(polygons)
    found = set()
    for p, q in tree.query(polygons, predicate="dwithin", distance=1e-9).T:
        if p < q:
            # Facets of neighbours agree up to rounding only: shared boundary is that within 1e-7 mm of both.
            shared = polygons[p].exterior.intersection(polygons[q].exterior.buffer(1e-7)).difference(network)
            if shared.length > 1e-4:
                found.add((int(p), int(q)))
    assert found == {tuple(sorted(pair)) for pair in split.joins.tolist()}


@settings(derandomize=True, max_examples=80, deadline=None)
@given(positions)
def test_lips_cover_the_cuts_and_lie_between_their_two_sides(position):
    _, placed, split = place(position)
    triangle = {p: split.corners[split.part == p] for p in np.unique(split.lips.parts)}
    for k in range(len(placed)):
        own = np.flatnonzero(split.lips.cut == k)
        order = own[np.argsort(split.lips.arc[own, 0])]
        length = np.linalg.norm(np.diff(split.paths[k], axis=0), axis=1).sum()
        low, high = split.lips.arc[order].T
        if position[0] == "grazing":  # what was snapped onto the outline has tissue on one side: no lips
            assert (high > low).all()
            continue
        # Pieces shorter than 1e-6 h are left out; there are fewer than 100.
        assert_allclose([low[0], high[-1], (high - low).sum()], [0, length, length], atol=1e-4)
        assert_allclose(low[1:], high[:-1], atol=1e-5)
    for (a, b), (left, right) in zip(split.lips.facets, split.lips.parts):
        for part, side in ((left, 1), (right, -1)):
            # The lip is on the part's boundary and the part's nearest triangle on its own side.
            middle = (a + b) / 2
            off = orient(a, b, triangle[part]) / np.linalg.norm(b - a) * side
            near = [shapely.polygons(t).distance(shapely.Point(middle)) for t in triangle[part]]
            assert min(near) < 1e-6
            assert off[np.argmin(near)].max() > 0


@settings(derandomize=True, max_examples=60, deadline=None)
@given(positions)
def test_snapping_moves_a_cut_by_a_thousandth_of_an_element(position):
    mesh, placed, split = place(position)
    reach = SNAP * mesh.sizes.max() * 1.5  # a path may be bent through a node after its vertex was moved
    for cut, path in zip(placed, split.paths):
        old, new = shapely.LineString(cut.path), shapely.LineString(path)
        assert shapely.hausdorff_distance(old, new) <= 2 * reach
        assert np.linalg.norm(cut.path[[0, -1]] - path[[0, -1]], axis=1).max() <= reach


@settings(derandomize=True, max_examples=40, deadline=None)
@given(positions)
def test_the_rim_is_the_outline(position):
    mesh, _, split = place(position)
    a, b = mesh.points[mesh.boundary_facets].swapaxes(0, 1)
    length = np.linalg.norm(split.rim.facets[:, 1] - split.rim.facets[:, 0], axis=1)
    assert_allclose(length.sum(), np.linalg.norm(b - a, axis=1).sum(), rtol=AREA)
    # Tissue on the left: the rim turns once around, so the enclosed area is the organ's.
    x, y = split.rim.facets.swapaxes(0, 1)
    assert_allclose((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum() / 2, mesh.volumes.sum(), rtol=AREA)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(positions)
def test_tips_are_ends_inside_the_organ_and_off_other_cuts(position):
    mesh, _, split = place(position)
    organ = shapely.Polygon(mesh.outline)
    expected = 0
    for k, path in enumerate(split.paths):
        others = [shapely.LineString(p) for j, p in enumerate(split.paths) if j != k]
        for end in (0, -1):
            x = shapely.Point(path[end])
            # Closer than the smallest contact (1e-5 h) is on it.
            expected += organ.exterior.distance(x) > 2e-5 and all(x.distance(line) > 2e-5 for line in others)
    assert len(split.fronts.at) == expected
    assert_allclose(np.linalg.norm(split.fronts.travel, axis=1), 1)
    for t, (k, end) in enumerate(zip(split.fronts.cut, split.fronts.end)):
        assert_allclose(split.fronts.at[t], split.paths[k][end])
        assert (split.touch[:, 0] == t).any()
    # Around an inner point the parts that it touches fill a full turn.
    for t in range(len(split.fronts.at)):
        touched = np.isin(split.part, split.touch[split.touch[:, 0] == t, 1])
        corners = split.corners[touched]
        total = 0.0
        for triangle in corners:
            gap = np.linalg.norm(triangle - split.fronts.at[t], axis=1)
            if gap.min() < 1e-6:
                a, b = np.delete(triangle, np.argmin(gap), axis=0) - triangle[np.argmin(gap)]
                total += np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))
        assert_allclose(total, 2 * np.pi, atol=1e-3)  # a tip within 1e-6 of a corner turns its angles by as much


def test_without_cuts_every_cell_is_a_part():
    mesh = MESHES["jitter 0.25"]
    split = embed(mesh, ())
    assert split.n_parts == len(split.corners) == len(mesh.cells)
    assert len(split.joins) == (mesh.neighbours >= 0).sum() // 2
    assert not len(split.lips.cut) and not len(split.fronts.at)
    assert len(split.rim.facets) == len(mesh.boundary_facets)


def test_a_cut_along_edges_splits_no_cell():
    """On edges the lips are the cells themselves: as many parts as cells, and the contacts gone."""
    mesh = grid(10, 10.0)
    split = embed(mesh, (Cut([(0.0, 4.0), (5.0, 4.0)]),))
    assert split.n_parts == len(mesh.cells)
    assert len(split.joins) == (mesh.neighbours >= 0).sum() // 2 - 5
    assert len(split.lips.cut) == 5 and split.lips.on_face.all()
    y = mesh.corners[:, :, 1].mean(axis=1)[split.cell[split.lips.parts]]
    assert (y[:, 0] > 4).all() and (y[:, 1] < 4).all()


@pytest.mark.parametrize("offset", [0.0, *cuts.OFFSETS])
def test_a_cut_beside_a_row_of_nodes_severs_what_it_should(offset):
    """Right through a grid at 1e-1 .. 1e-14 h from a row of nodes: always two bodies, never three, never one."""
    mesh = grid(10, 10.0)
    split = embed(mesh, (Cut([(0.0, 4.0 + offset), (10.0, 4.0 + offset)]),))



    p, q = split.joins.T
    n, body = connected_components(coo_array((np.ones(len(p)), (p, q)), (split.n_parts, split.n_parts)), directed=False)
    assert n == 2
    area = np.bincount(body[split.part], split.volumes)
    assert_allclose(np.sort(area), [40 + 10 * offset, 60 - 10 * offset], atol=2 * SNAP * 10)


def test_a_tip_goes_on_as_it_was_drawn():
    """A node beside the line, just before the tip, bends the snapped cut but not the tip's axis."""
    mesh = grid()
    node = np.array([4.0, 4.0])
    tip = node + np.array([2.5e-3, 0.6e-3])
    split = embed(mesh, (cut_in(mesh, (-1.0, tip[1]), tip),))
    assert (split.paths[0][-2] == node).all()
    np.testing.assert_allclose(split.fronts.travel, [[1.0, 0.0]], atol=1e-12)
