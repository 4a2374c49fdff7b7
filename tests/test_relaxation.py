"""Relaxation: flips give Delaunay triangles, no step turns a cell over, neighbours stay right, the outline is kept."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose
from scipy.spatial import Delaunay

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.rail import outline_nodes, rail_nodes
from xfemnav.geometry.plane.relaxation import flip, lift_worst, mean_quality, truss


@pytest.fixture
def disc():
    """Random nodes in a disc of radius 10 mm: p, cells, across, h, rail, as the relaxation takes them."""
    angle = 2 * np.pi * np.arange(90) / 90
    circle = 10 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rail = outline_nodes(circle, lambda points: np.full(len(points), 1.5))
    rng = np.random.default_rng(6)
    inner = rng.uniform(-9, 9, (250, 2))
    p = np.concatenate([rail_nodes(rail), inner[np.linalg.norm(inner, axis=1) < 9]])
    mesh = Mesh(p, Delaunay(p).simplices)
    return p, mesh.cells.copy(), mesh.neighbours.copy(), np.full(len(p), 1.5), rail


def assert_sound(p, cells, across, rail):
    """Positive cells, right neighbours, the outline's nodes on the outline at the places that the rail says."""
    mesh = Mesh(p, cells)
    assert np.array_equal(across, mesh.neighbours)
    n = len(rail.places)
    assert_allclose(shapely.distance(shapely.LinearRing(rail.points[:-1]), shapely.points(p[:n])), 0, atol=1e-12)
    assert_allclose(rail_nodes(rail._replace(places=rail.places % rail.ticks[-1])), p[:n], atol=1e-12)
    assert np.array_equal(np.sort(mesh.boundary_loops[0]), np.arange(n))
    assert_allclose(mesh.volumes.sum(), shapely.Polygon(p[:n]).area, rtol=1e-12)


def test_flips_restore_delaunays_triangles(disc):
    p, cells, across, h, rail = disc
    truss(p, cells, across, h, rail, 15)
    n = len(rail.places)
    p[n:] += np.random.default_rng(7).uniform(-0.15, 0.15, p[n:].shape)
    assert Mesh(p, cells).volumes.min() > 0  # still a mesh, no more Delaunay's
    wanted = {frozenset(cell) for cell in Delaunay(p).simplices.tolist()}
    assert wanted != {frozenset(cell) for cell in cells.tolist()}
    flip(p, cells, across)
    assert wanted == {frozenset(cell) for cell in cells.tolist()}
    assert_sound(p, cells, across, rail)


def test_truss_makes_random_nodes_even(disc):
    p, cells, across, h, rail = disc
    before = mean_quality(p, cells)
    assert_allclose(before, Mesh(p, cells).quality.mean(), rtol=1e-12)
    for _ in range(4):
        truss(p, cells, across, h, rail, 15)
    assert mean_quality(p, cells) > max(0.93, before)
    assert_sound(p, cells, across, rail)


def test_no_cell_turns_over_whatever_the_sizes(disc):
    """Wanted lengths that differ a thousandfold from node to node would push nodes through each other."""
    p, cells, across, h, rail = disc
    h *= 10 ** np.random.default_rng(8).uniform(-1.5, 1.5, len(h))
    truss(p, cells, across, h, rail, 30)
    assert_sound(p, cells, across, rail)


def test_truss_slides_the_outlines_nodes_apart(disc):
    """Nodes of a circle that stand in pairs end evenly spaced, since their bars press."""
    p, cells, across, h, rail = disc
    n = len(rail.places)
    rail.places[:] += np.where(np.arange(n) % 2, -0.15, 0.15)
    p[:n] = rail_nodes(rail)
    mesh = Mesh(p, Delaunay(p).simplices)
    cells, across = mesh.cells.copy(), mesh.neighbours.copy()
    for _ in range(6):
        truss(p, cells, across, h, rail, 15)
    spacing = np.diff(rail.places)
    assert abs(spacing[::2].mean() - spacing[1::2].mean()) < 0.1  # .6 at the start
    assert_sound(p, cells, across, rail)


def test_nodes_that_are_not_free_stay(disc):
    p, cells, across, h, rail = disc
    rail = rail._replace(free=np.zeros(len(rail.free), bool))
    before = p[: len(rail.places)].copy()
    truss(p, cells, across, h, rail, 15)
    lift_worst(p, cells, across, h, rail, 0.95, 4)
    assert np.array_equal(p[: len(rail.places)], before)


def test_search_lifts_the_worst_cell_and_the_mean(disc):
    p, cells, across, h, rail = disc
    truss(p, cells, across, h, rail, 15)
    before = Mesh(p, cells).quality
    lift_worst(p, cells, across, h, rail, 0.95, 4)
    after = Mesh(p, cells).quality
    assert after.min() > before.min() and after.mean() > before.mean()
    assert_sound(p, cells, across, rail)
