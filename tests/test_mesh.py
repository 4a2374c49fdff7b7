"""Laws of the triangle mesh: partition of unity, areas, neighbours, loops, and what it refuses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import Delaunay

from xfemnav.geometry.mesh import Mesh, orient

ROUNDING = 1e-12  # a few hundred operations on numbers of order 1 to 10


@pytest.fixture
def mesh():
    """Delaunay mesh of random points, and of the corners of the square [0, 1]^2, so that its area is 1."""
    rng = np.random.default_rng(1)
    points = np.concatenate([[[0, 0], [1, 0], [1, 1], [0, 1]], rng.uniform(0.05, 0.95, (60, 2))])
    return Mesh(points, Delaunay(points).simplices)


def annulus(n=12):
    """Ring of 2 n triangles between two n-gons."""
    angle = 2 * np.pi * np.arange(n) / n
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    a, b = np.arange(n), (np.arange(n) + 1) % n
    cells = np.concatenate([np.stack([a, a + n, b], axis=1), np.stack([b, a + n, b + n], axis=1)])
    return Mesh(np.concatenate([circle, 2 * circle]), cells)


def test_areas_fill_the_square(mesh):
    assert_allclose(mesh.volumes.sum(), 1, atol=ROUNDING)


def test_gradients_reproduce_linear_fields(mesh):
    slope = np.array([2.0, -3.0])
    values = mesh.points @ slope + 5
    gradients = np.einsum("ca,caj->cj", values[mesh.cells], mesh.gradients)
    # Amplified by the flattest triangle: 1 / its height.
    assert_allclose(gradients, np.tile(slope, (len(mesh.cells), 1)), atol=ROUNDING * np.abs(mesh.gradients).max())


def test_gradients_sum_to_nothing(mesh):
    assert_allclose(mesh.gradients.sum(axis=1), 0, atol=ROUNDING * np.abs(mesh.gradients).max())


# r_in and r_out of the corner of a unit cube.
CORNERS = {2: (1 - 1 / np.sqrt(2), 1 / np.sqrt(2)), 3: (1 / (3 + np.sqrt(3)), np.sqrt(3) / 2)}


@pytest.mark.parametrize("d", CORNERS)
def test_regular_simplices_have_quality_one_and_their_edge_as_size(d):
    regular = np.linalg.cholesky((np.eye(d) + 1) / 2) * 2  # edges from the origin, 2 long, at 60 degrees
    cells, (inner, outer) = [list(range(d + 1))], CORNERS[d]
    mesh = Mesh(np.vstack([np.zeros(d), regular]), cells)
    assert_allclose(mesh.quality, 1, atol=ROUNDING)
    assert_allclose(mesh.sizes, 2, atol=ROUNDING)
    assert_allclose(Mesh(np.vstack([np.zeros(d), np.eye(d)]), cells).quality, d * inner / outer)


def test_neighbours_are_mutual_and_share_the_edge(mesh):
    for cell, across in enumerate(mesh.neighbours):
        for local, other in enumerate(across):
            if other >= 0:
                assert cell in mesh.neighbours[other]
                shared = np.delete(mesh.cells[cell], local)
                assert set(shared) <= set(mesh.cells[other])


def test_each_edge_bounds_one_cell_or_two(mesh):
    assert 3 * len(mesh.cells) == 2 * len(mesh.edges) - len(mesh.boundary_facets)
    assert len(mesh.points) - len(mesh.edges) + len(mesh.cells) == 1  # Euler number of a disc


def test_boundary_has_tissue_on_its_left(mesh):
    (loop,) = mesh.boundary_loops
    x, y = mesh.points[loop].T
    assert_allclose((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2, 1, atol=ROUNDING)


def test_loops_of_a_ring_the_longest_first_and_the_hole_clockwise():
    mesh = annulus()
    outer, inner = mesh.boundary_loops
    assert {*outer} == set(range(12, 24)) and {*inner} == set(range(12))
    turn = orient(*mesh.points[np.stack([inner, np.roll(inner, -1), np.roll(inner, -2)])])
    assert (turn < 0).all()


def test_pinched_mesh_has_no_loops():
    mesh = Mesh([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]], [[0, 1, 2], [0, 3, 4]])
    with pytest.raises(ValueError, match="pinched"):
        _ = mesh.boundary_loops


@pytest.mark.parametrize(
    "points, cells, message",
    [
        ([[0, 0], [1, 0], [0, 1]], [[0, 2, 1]], "turned over"),
        ([[0, 0], [1, 0], [2, 0]], [[0, 1, 2]], "flat"),
        ([[0, 0], [1, 0], [0, 1]], [[0, 1, 3]], "do not exist"),
        ([[0, 0, 0]], np.empty((0, 3)), "shape"),
    ],
)
def test_refuses_what_is_no_mesh(points, cells, message):
    with pytest.raises(ValueError, match=message):
        Mesh(points, cells)


def test_arrays_are_copies_and_read_only():
    points = np.array([[0.0, 0], [1, 0], [0, 1]])
    mesh = Mesh(points, [[0, 1, 2]])
    points[0] = 9
    assert_allclose(mesh.points[0], 0, atol=0)
    with pytest.raises(ValueError, match="read-only"):
        mesh.points[0] = 1
