"""The growing triangulation is Delaunay's, keeps its walls, and refuses what has no room."""

import numpy as np
import shapely
from numpy.testing import assert_allclose
from scipy.spatial import Delaunay

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.delaunay import holes, insert, mark_inside, square

FREE = -1  # no parent: the search starts where the last one ended


def grown(points):
    """Triangulation of `points` (n, 2), and their nodes (n,)."""
    T = square(points.min(axis=0), points.max(axis=0), len(points) + 1000)
    return T, insert(T, points, np.zeros(len(points)), np.full(len(points), FREE), 0.0, 0.0)


def polygon(n=40, radius=10.0):
    """A loop with lobes, (n, 2) mm."""
    angle = 2 * np.pi * np.arange(n) / n
    return (radius * (1 + 0.3 * np.cos(3 * angle)))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def as_mesh(T):
    return Mesh(T.points[: T.count[0]], T.cells[: T.count[1]])


def test_random_points_get_delaunays_triangles():
    points = np.random.default_rng(3).uniform(0, 1, (300, 2))
    T, nodes = grown(points)
    assert np.array_equal(nodes, np.arange(4, 304))
    theirs = Delaunay(T.points[: T.count[0]]).simplices
    assert {frozenset(cell) for cell in T.cells[: T.count[1]].tolist()} == {frozenset(cell) for cell in theirs.tolist()}


def test_neighbours_stay_mutual():
    T, _ = grown(np.random.default_rng(4).normal(size=(200, 2)))
    assert np.array_equal(T.across[: T.count[1]], as_mesh(T).neighbours)


def test_points_on_lines_and_circles_are_triangulated_too():
    x, y = np.meshgrid(np.arange(12.0), np.arange(9.0))
    for points in (np.stack([x.ravel(), y.ravel()], axis=1), polygon() / np.linalg.norm(polygon(), axis=1)[:, None]):
        T, nodes = grown(points)
        assert (nodes >= 0).all()
        mesh = as_mesh(T)  # would refuse a flat or turned cell
        assert_allclose(mesh.volumes.sum(), Mesh(T.points[:4], [[0, 1, 2], [0, 2, 3]]).volumes.sum(), rtol=1e-12)


def test_cells_within_the_loop_are_marked():
    loop = polygon()
    T, _ = grown(loop)
    assert mark_inside(T, 4, len(loop)).all()
    inside = T.cells[: T.count[1]][T.inside[: T.count[1]] == 1]
    assert_allclose(Mesh(T.points[: T.count[0]], inside).volumes.sum(), shapely.Polygon(loop).area, rtol=1e-12)


def test_missing_edge_of_the_loop_is_reported():
    """A fifth node close to the middle of the square's lowest edge hides that edge."""
    loop = np.array([[0.0, 0], [10, 0], [10, 10], [5, 0.1], [0, 10]])
    T, _ = grown(loop)
    assert mark_inside(T, 4, 5).tolist() == [False, True, True, True, True]


def test_points_without_room_or_outside_are_refused():
    loop = polygon()
    T, _ = grown(loop)
    mark_inside(T, 4, len(loop))
    points = np.array([[0.0, 0], [0.5, 0], [1.1, 0], [12.9, 0], [-9, 0], [100, 100]])
    nodes = insert(T, points, np.ones(6), np.full(6, FREE), 1.0, 0.5)
    # the first stays; too near it; far enough; within .5 of the outline's end at 13; beyond its bay at 7; far outside
    assert (nodes >= 0).tolist() == [True, False, True, False, False, False]


def test_walls_survive_the_insertion():
    loop = polygon()
    T, _ = grown(loop)
    mark_inside(T, 4, len(loop))
    points = np.random.default_rng(5).uniform(-13, 13, (500, 2))
    insert(T, points, np.full(500, 0.5), np.full(500, FREE), 0.7, 0.3)
    edges = {frozenset(edge) for edge in as_mesh(T).edges.tolist()}
    assert all(frozenset((4 + a, 4 + (a + 1) % len(loop))) in edges for a in range(len(loop)))
    inside = shapely.contains_xy(shapely.Polygon(loop), T.points[44 : T.count[0]])
    assert inside.all() and len(inside) > 100


def test_holes_are_the_cells_that_are_too_large():
    loop = polygon()
    T, _ = grown(loop)
    mark_inside(T, 4, len(loop))
    T.sizes[: T.count[0]] = 1.0
    centres, parents = holes(T, 2.0)
    assert len(centres) and (np.linalg.norm(centres - T.points[parents], axis=1) > 2).all()
    assert len(holes(T, 100.0)[0]) == 0
