"""The point map in space: exact on affine motions, two-valued on sheets, kinked ones too; nearest places."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.blocks import block, interpolated, plane
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.nearest import nearest_on_sheet
from xfemnav.geometry.solid.levels import Level
from xfemnav.geometry.solid.split import split

N = 5
UP = np.array([0.0, 0.0, 1.0])


def cut_block(seed, kinked):
    """A block's simplices cut by a plane or two half planes; the side that each is on, +1 left; the sheet; and which
    are beside it."""
    mesh, rng = block(3, N), np.random.default_rng(seed)
    phi = np.maximum(plane(mesh, rng), plane(mesh, rng)) if kinked else plane(mesh, rng)
    parts = split(mesh, (Level(phi),))
    near = np.zeros(parts.n_parts)
    near[parts.lips.parts[:, 0]], near[parts.lips.parts[:, 1]] = 1, -1
    near, side = near[parts.part], np.sign(interpolated(mesh, phi[None], parts.corners.mean(axis=1))[0])
    side *= side[near == 1][0]
    assert (side == near)[near != 0].all()
    return parts.corners, side, parts.lips.facets[:, ::-1], near != 0    # normals point to the left part


def test_an_affine_motion_is_exact_and_beyond_is_no_tissue():
    rest, rng = block(3, N).corners, np.random.default_rng(0)
    A, b = np.eye(3) + rng.normal(size=(3, 3)) / 10, np.array([3.0, -2.0, 1.0])
    motion = Motion(rest, rest @ A.T + b)
    points = np.concatenate([rng.uniform(0, N, (500, 3)), rest.reshape(-1, 3)[:50], rest.mean(axis=1)[:50],
                             rest[:50, :3].mean(axis=1), rest[:50, :2].mean(axis=1)])
    assert_allclose(motion.to_current(points), points @ A.T + b, atol=1e-12)
    assert_allclose(motion.to_preoperative(points @ A.T + b), points, atol=1e-12)
    out = np.array([[-1e-6, 1, 1], [N + 0.1, 1, 1], [2, 2, -3], [np.nan, 0, 0]])
    assert np.isnan(motion.to_current(out)).all() and not motion.holds(out).any()
    assert motion.holds([[-1e-9, 1, 1]]).all()    # rounding at the border opens nothing


@pytest.mark.parametrize("seed", range(4))
def test_a_lip_has_the_value_of_its_side(seed):
    """On a plane, and on a kinked sheet whose left is no half space: also at the kink, and beside it by snapping."""
    rest, side, sheet, _ = cut_block(seed, seed % 2)
    motion = Motion(rest, rest + side[:, None, None] * UP, (sheet,))
    rng = np.random.default_rng(0)
    w = rng.dirichlet(np.ones(3), len(sheet))
    points = np.concatenate([np.einsum("fk,fki->fi", w, sheet), sheet[:, :2].mean(axis=1), sheet.reshape(-1, 3)])
    for there in (points, points + rng.normal(size=points.shape) * 1e-3):
        there = there[motion.holds(there) & (motion.beside(there)[0] < 9e-3)]
        assert len(there)
        left, right = motion.displacement(there, 1), motion.displacement(there, -1)
        assert_allclose(left, np.broadcast_to(UP, left.shape), atol=1e-9)
        assert_allclose(right, np.broadcast_to(-UP, right.shape), atol=1e-9)
        assert_allclose(abs(motion.displacement(there)), abs(left), atol=1e-9)    # either of them


@pytest.mark.parametrize("seed", range(4))
def test_beside_a_sheet_there_are_a_distance_and_a_side(seed):
    rest, side, sheet, near = cut_block(seed, True)
    motion = Motion(rest, rest, (sheet,))
    middle = rest.mean(axis=1)
    distance, found = motion.beside(middle[near])
    assert_array_equal(found, side[near])
    # dense points on the triangles are nowhere nearer, and somewhere hardly farther
    w = np.random.default_rng(1).dirichlet(np.full(3, 0.5), (len(sheet), 200))
    dense = np.einsum("fpk,fki->fpi", w, sheet).reshape(-1, 3)
    for point, d in zip(middle[near][::40], distance[::40]):
        least = np.linalg.norm(dense - point, axis=1).min()
        assert d <= least + 1e-12 and least - d < 0.2


def test_the_nearest_place_on_a_triangle_is_inside_on_an_edge_or_a_corner():
    sheet = np.array([[[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]])
    points = np.array([[1.0, 1, 2], [2, -3, 0], [5, 5, -1], [-3, -4, 0], [1, 1, 0]])
    _, place, distance, left = nearest_on_sheet(points, sheet)
    assert_allclose(place, [[1, 1, 0], [2, 0, 0], [2, 2, 0], [0, 0, 0], [1, 1, 0]], atol=1e-12)
    assert_allclose(distance, [2, 3, np.sqrt(19), 5, 0], atol=1e-12)
    assert_array_equal(left[[0, 2]], [True, False])


def test_without_cuts_no_side_matters():
    rest = block(3, 2).corners
    motion = Motion(rest, rest + UP)
    assert np.isinf(motion.beside([[1.0, 1, 1]])[0]).all()
    assert_allclose(motion.displacement([[1.0, 1, 1]], 1), [UP])


def test_of_two_sheets_the_nearer_one_has_the_lips():
    mesh = block(3, N)
    parts = split(mesh, (Level(mesh.points[:, 0] - 1.5), Level(mesh.points[:, 0] - 3.5)))
    band = np.digitize(parts.corners.mean(axis=1)[:, 0], [1.5, 3.5])
    sheets = tuple(parts.lips.facets[parts.lips.cut == k][:, ::-1] for k in (0, 1))
    motion = Motion(parts.corners, parts.corners + band[:, None, None] * UP, sheets)
    points = np.array([[1.5, 2.3, 2.6], [3.5, 2.3, 2.6]])
    lips = np.stack([motion.displacement(points, side)[:, 2] for side in (1, -1)])
    assert_allclose(np.sort(lips, axis=0), [[0, 1], [1, 2]], atol=1e-12)
