"""The window about a path: it has all cells that the path touches, their neighbours, and what a cut there changes."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal

from tests.meshes import cut_in, jittered
from xfemnav.geometry.plane.subcells import embed
from xfemnav.geometry.plane.window import near_cells, window

MESH = jittered(20.0, 16.0, 1.0, 0.25)
PATHS = {
    "straight": np.array([(-1.0, 7.3), (9.4, 8.1)]),
    "bent": np.array([(3.1, 4.2), (8.4, 9.1), (12.2, 5.3), (13.0, 12.0)]),
    "within a cell": np.array([(7.31, 6.42), (7.35, 6.47)]),
}


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_near_cells_are_those_beside_the_path(path):
    gap = shapely.distance(shapely.polygons(MESH.corners), shapely.linestrings(path))
    near = np.zeros(len(MESH.cells), dtype=bool)
    near[near_cells(MESH, path)] = True
    assert near[gap == 0].all()
    # Of a cell, whether it is on one side of a segment's line, or behind one of its ends: a corner may be left over.
    assert not near[gap > MESH.sizes.max()].any()


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_cells_about_the_ends_are_near_too(path):
    gap = np.linalg.norm(MESH.corners[:, :, None] - path[[0, -1]], axis=3).min(axis=(1, 2))
    near = np.isin(np.arange(len(MESH.cells)), near_cells(MESH, path, 2.5))
    assert near[gap <= 2.5].all()
    assert_array_equal(near[gap > 2.5], np.isin(np.flatnonzero(gap > 2.5), near_cells(MESH, path)))


def test_a_cut_is_the_same_in_its_window():
    cut = cut_in(MESH, *PATHS["straight"])
    part = window(MESH, cut.path)
    whole, own = embed(MESH, (cut,)), embed(part.mesh, (cut,))
    for table, names in (("lips", ("at", "facets", "on_face")), ("fronts", ("at", "travel"))):
        for name in names:
            assert_array_equal(getattr(getattr(whole, table), name), getattr(getattr(own, table), name))
    assert_array_equal(whole.cell[whole.lips.parts], part.cells[own.cell[own.lips.parts]])
    assert_allclose(part.mesh.points, MESH.points[part.nodes])
    crossed = np.unique(part.mesh.cells[own.cell[own.lips.parts]])
    assert not part.border[crossed].any()
