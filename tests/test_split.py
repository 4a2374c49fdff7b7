"""Level sets split a mesh: volumes, borders and pieces, for one maker in the plane and in space."""

import numpy as np
import pytest
from blocks import KINDS, block, interpolated, located
from meshes import cut_in, jittered
from numpy.testing import assert_allclose
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from xfemnav.geometry.mesh import area_vectors
from xfemnav.geometry.plane.subcells import embed
from xfemnav.geometry.solid.levels import Level, snapped
from xfemnav.geometry.solid.split import split
from xfemnav.mechanics.rules import Basis
from xfemnav.mechanics.space.enrichment import enrich

SIZES = {2: 6, 3: 4}
NOTHING = 1e-9  # mm: rounding of functions of a few mm


def bodies(parts):
    """Number (p,) of the connected piece of each part."""
    one, other = parts.joins.T
    return connected_components(coo_array((np.ones(len(one)), (one, other)), (parts.n_parts,) * 2), directed=False)[1]


def check(mesh, cuts):
    """What holds for every placement: cells are filled, and what bounds each piece closes about its volume."""
    parts = split(mesh, cuts)
    assert (parts.volumes > 0).all() and np.bincount(parts.part, minlength=parts.n_parts).all()
    assert_allclose(np.bincount(parts.cell[parts.part], parts.volumes), mesh.volumes, rtol=1e-12)
    body = bodies(parts)
    size = np.bincount(body[parts.part], parts.volumes)
    gone = np.bincount(body, parts.removed) > 0
    assert (np.bincount(body, ~parts.removed)[gone] == 0).all()  # nothing joins what stays to what goes
    closed, filled = np.zeros((len(size), mesh.dim)), np.zeros(len(size))
    for facets, part, sign in ((parts.rim.facets, parts.rim.parts, 1), (parts.walls.facets, parts.walls.parts, 1),
                               (parts.lips.facets, parts.lips.parts[:, 0], 1),
                               (parts.lips.facets, parts.lips.parts[:, 1], -1)):
        area = sign * area_vectors(facets)
        np.add.at(closed, body[part], area)
        np.add.at(filled, body[part], np.einsum("bi,bi->b", facets.mean(axis=1), area) / mesh.dim)
    # Contacts under 1e-8 of a face are none: some of these go around a piece.
    assert_allclose(closed[~gone], 0, atol=1e-7)
    assert_allclose(filled[~gone], size[~gone], atol=1e-7)
    return parts


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_random_placements_fill_their_cells_and_close(kind, d):
    rng = np.random.default_rng(d)
    for _ in range(12):
        check(block(d, SIZES[d]), kind(block(d, SIZES[d]), rng))


def check_by_values(mesh, cuts, parts, per_cell=4):
    """The functions themselves, read between the nodes, say the same: no part and no join lies across a cut, lips lie
    on theirs, and what a fine grid finds joined is one body."""
    body, d = bodies(parts), mesh.dim
    fields = [snapped(mesh, np.vstack([cut.phi, cut.bounds])) for cut in cuts]
    corners = parts.corners.reshape(-1, d)
    points, links = _grid(mesh, per_cell)
    own = body[_parts_at(mesh, parts, points)]
    sure = np.ones(len(links), bool)
    for k, field in enumerate(fields):
        phi, *bounds = interpolated(mesh, field, corners).reshape(len(field), -1, d + 1)
        inside = np.all([bound.max(axis=1) < -NOTHING for bound in bounds], axis=0)
        assert not (inside & (phi.max(axis=1) > NOTHING) & (phi.min(axis=1) < -NOTHING)).any()
        phi, *bounds = interpolated(mesh, field, parts.middles)
        on = (np.abs(phi) < NOTHING) & np.all([bound < -NOTHING for bound in bounds], axis=0)
        assert not (on & ~_alike(mesh, field, parts)).any()
        middle = parts.lips.facets[parts.lips.cut == k].mean(axis=1)
        phi, *bounds = interpolated(mesh, field, middle)
        assert (np.abs(phi) < NOTHING).all() and all((bound < NOTHING).all() for bound in bounds)
        sure &= _surely_joined(mesh, field, points, links)
    assert (own[links[sure, 0]] == own[links[sure, 1]]).all()


def _grid(mesh, per_cell):
    """Points (k, d) of a fine grid in a block, off the diagonals on which cells meet, and pairs of neighbours."""
    d, n = mesh.dim, round(mesh.points.max())
    axis = (np.arange(n * per_cell) + 0.5) / per_cell
    points = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1) + np.array([0.111, -0.07, 0.037])[:d] / per_cell
    index = np.arange(len(axis) ** d).reshape((len(axis),) * d)
    links = [np.stack([index.take(range(len(axis) - 1), axis=k).ravel(),
                       index.take(range(1, len(axis)), axis=k).ravel()], axis=1) for k in range(d)]
    return points.reshape(-1, d), np.concatenate(links)


def _surely_joined(mesh, field, points, links):
    """Pairs of points between which a cut, as steep as it may be, does not pass."""
    slope = np.linalg.norm(np.einsum("fca,caj->fcj", field[:, mesh.cells], mesh.gradients), axis=2).max(axis=1)
    far = slope[:, None, None] * np.linalg.norm(points[links[0, 1]] - points[links[0, 0]]) / 2
    phi, *bounds = interpolated(mesh, field, points)[:, links]
    away = (np.sign(phi[:, 0]) == np.sign(phi[:, 1])) & (np.abs(phi) > far[0]).all(axis=1)
    for slack, bound in zip(far[1:], bounds):
        away = away | (bound > slack).all(axis=1)
    return away


def _alike(mesh, field, parts):
    """Whether both parts (j,) of a join lie on one side of a function, or one is a crumb as thin as rounding on it."""
    middle = np.zeros((parts.n_parts, mesh.dim))
    np.add.at(middle, parts.part, parts.corners.mean(axis=1) * parts.volumes[:, None])
    middle /= np.bincount(parts.part, parts.volumes)[:, None]
    one, other = interpolated(mesh, field, middle)[0][parts.joins.T]
    return (one * other > 0) | (np.minimum(np.abs(one), np.abs(other)) < NOTHING)


def _parts_at(mesh, parts, points):
    """The part (k,) that holds each point."""
    cell, _ = located(mesh, points)
    order = np.argsort(parts.cell[parts.part], kind="stable")
    first = np.searchsorted(parts.cell[parts.part][order], np.arange(len(mesh.cells) + 1))
    count = first[cell + 1] - first[cell]
    who = np.repeat(np.arange(len(points)), count)
    simplex = order[np.arange(len(who)) + np.repeat(first[cell] - np.cumsum(count) + count, count)]
    corners = parts.corners[simplex]
    share = np.linalg.solve((corners[:, 1:] - corners[:, :1]).swapaxes(1, 2), (points[who] - corners[:, 0])[..., None])
    depth = np.minimum(share.min(axis=(1, 2)), 1 - share.sum(axis=(1, 2)))
    best = np.lexsort((-depth, who))[np.cumsum(count) - count]
    return parts.part[simplex[best]]


@pytest.mark.parametrize("d", [2, 3])
def test_a_cut_close_to_nodes_goes_through_them(d):
    """Within 1e-3 of an element it would leave parts as thin: it runs along faces, which it cuts all the same."""
    mesh = block(d, SIZES[d])
    parts = split(mesh, (Level(mesh.points[:, 0] - 2 - 5e-4),))
    assert parts.n_parts == len(mesh.cells) and len(np.unique(bodies(parts))) == 2
    assert_allclose(parts.lips.facets[..., 0], 2)
    assert_allclose(area_vectors(parts.lips.facets).sum(axis=0), [-(SIZES[d] ** (d - 1)), *[0] * (d - 1)], atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_lips_have_the_chart_coordinates_of_their_own_cut(d):
    """Those that are linear in place are so on the facets."""
    mesh, rng = block(d, SIZES[d]), np.random.default_rng(d)
    slopes, normals = rng.normal(size=(3, d, d - 1)), np.eye(d)[[0, 1]] + 0.3
    charts = [mesh.points @ slopes[0], mesh.points @ slopes[1], None]
    levels = [Level((mesh.points - 2.3) @ normal, at=at) for normal, at in zip([*normals, normals.sum(axis=0)], charts)]
    lips = split(mesh, tuple(levels)).lips
    assert set(lips.cut) == {0, 1, 2}
    slopes[2] = 0  # without a chart
    assert_allclose(lips.at, lips.facets @ slopes[lips.cut], atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-10, 1e-9, 1e-8, 1e-6, 1e-4, 2e-3])
@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_cuts_nearly_in_one_plane(d, offset, order):
    """What lies between them may be thinner than rounding; a third one crosses both beside a lattice plane."""
    mesh = block(d, SIZES[d])
    normal = np.array([1.0, -1, 1])[:d] / np.sqrt(d)
    phi = (mesh.points - 2) @ normal
    cuts = [Level(phi), Level(phi + offset), Level(mesh.points[:, 0] - 2 - 2e-3)]
    cuts = tuple(cuts[k] for k in order)
    check_by_values(mesh, cuts, check(mesh, cuts))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_the_functions_themselves_say_the_same(kind, d):
    rng = np.random.default_rng(10 + d)
    for _ in range(6):
        mesh = block(d, SIZES[d])
        cuts = kind(mesh, rng)
        check_by_values(mesh, cuts, check(mesh, cuts))


def pieces(mesh, parts):
    """Volumes of the pieces of each node's support, sorted by node and size: what the basis functions live on."""
    table = enrich(mesh, parts, Basis("none"))
    size = np.bincount(table.dof.ravel(), np.repeat(np.bincount(parts.part, parts.volumes), mesh.dim + 1))
    order = np.lexsort((size, table.node))
    return table.node[order], size[order]


def line(points, one, other):
    """Signed distance (n,) from the line through two points (2,), positive on its left."""
    along = (other - one) / np.linalg.norm(other - one)
    return (points - one) @ np.array([-along[1], along[0]])


@pytest.mark.parametrize("kind", ["through", "end", "crossing", "branch"])
@pytest.mark.parametrize("seed", range(5))
def test_in_the_plane_it_agrees_with_the_exact_one(kind, seed):
    """Straight cuts are exact level sets: lips, pieces of supports and bodies are those of `embed`."""
    mesh, rng = jittered(seed=seed), np.random.default_rng(seed)
    (low, high), middle = mesh.points[[0, -1]], np.array([rng.uniform(7, 13), rng.uniform(6, 10)])
    a = np.array([low[0] - 1, rng.uniform(2, 14)])
    b = middle + 3 * (middle - a)
    top = np.array([rng.uniform(5, 15), high[1] + 1])
    stem = line(mesh.points, a, b)
    across = (mesh.points - middle) @ (b - a) / np.linalg.norm(b - a)
    paths, levels = {
        "through": ([(a, b)], [Level(stem)]),
        "end": ([(a, middle)], [Level(stem, [across])]),
        "crossing": ([(a, b), (top, middle + 3 * (middle - top))],
                     [Level(stem), Level(line(mesh.points, top, middle))]),
        "branch": ([(a, b), (top, middle)], [Level(stem), Level(line(mesh.points, top, middle), [-stem])]),
    }[kind]
    exact = embed(mesh, tuple(cut_in(mesh, *path) for path in paths))
    found = split(mesh, tuple(levels))
    for k in range(len(paths)):
        lengths = [np.linalg.norm(area_vectors(parts.lips.facets[parts.lips.cut == k]), axis=1).sum()
                   for parts in (found, exact)]
        assert_allclose(*lengths, rtol=1e-6)
    for one, other in zip(pieces(mesh, found), pieces(mesh, exact)):
        assert_allclose(one, other, atol=1e-6)
    for name in ("lips", "rim"):
        sums = [area_vectors(getattr(parts, name).facets).sum(axis=0) for parts in (found, exact)]
        assert_allclose(*sums, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_ten_thousand_placements(kind, d):
    """500 of each of ten kinds, in the plane and in space."""
    rng = np.random.default_rng(100 + d)
    for _ in range(500):
        mesh = block(d, int(rng.integers(2, SIZES[d] + 1)))
        cuts = kind(mesh, rng)
        check_by_values(mesh, cuts, check(mesh, cuts))
