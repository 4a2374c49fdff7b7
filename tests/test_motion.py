"""The point map: exact on affine motions, there and back again, two-valued on the lips."""

import ast
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay

from data_synthetic.domains import disc
from xfemnav.geometry.mesh import orient
from xfemnav.geometry.motion import Motion

PATH = np.array([[0.0, 10.0], [0.0, 4.0], [2.0, 1.0]])    # from the outline's top, with a kink
SHIFT = np.array([1.0, 2.0])
N = np.array([1.0, 0.0])                                  # left of its first segment, which runs down


def triangles(seed=0, path=PATH) -> np.ndarray:
    """Triangles (t, 3, 2) of a disc of radius 10, with nodes on the `path` so dense that its edges are in the mesh."""
    s = np.linspace(0, 1, 17)[:, None]
    lips = np.concatenate([a + s * (b - a) for a, b in zip(path, path[1:])])
    rim = disc(10.0, 64)
    inner = np.random.default_rng(seed).uniform(-6.8, 6.8, (500, 2))
    inner = inner[np.linalg.norm(inner[:, None] - lips, axis=2).min(axis=1) > 0.4]
    corners = np.unique(np.round(np.concatenate([lips, rim, inner]), 12), axis=0)
    x = corners[Delaunay(corners).simplices]
    x = x[np.abs(orient(*x.swapaxes(0, 1))) > 1e-9]
    turned = orient(*x.swapaxes(0, 1)) < 0
    x[turned] = x[turned][:, ::-1]
    return x


def parted(rest, gap=1.0) -> np.ndarray:
    """The triangles at `rest`, those on the left of PATH's first segment moved to its left by `gap` at the surface.

    The motion fades to nothing at the kink and is affine on both sides, so that the map's value is known on the lips.
    """
    left = (rest[:, :, 0].mean(axis=1) > 0)[:, None]
    moved = rest.copy()
    moved[..., 0] += np.where(left, gap, -gap) * np.clip((rest[..., 1] - 4) / 6, 0, None)
    return moved


def test_an_affine_motion_is_exact():
    rest = triangles()
    A, b = np.array([[1.1, 0.2], [-0.1, 0.9]]), np.array([3.0, -2.0])
    motion = Motion(rest, rest @ A.T + b)
    points = np.random.default_rng(1).uniform(-6, 6, (500, 2))
    # coordinates of about 10 mm and triangles not flatter than 1e-3: a few hundred roundings of 1e-15
    assert_allclose(motion.to_current(points), points @ A.T + b, atol=1e-12)
    assert_allclose(motion.displacement(points), points @ A.T + b - points, atol=1e-12)
    assert_allclose(motion.to_preoperative(points @ A.T + b), points, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_forward_and_back_is_the_identity(seed):
    rest = triangles(seed)
    motion = Motion(rest, parted(rest), (PATH,))
    points = disc(1.0, 97) * np.random.default_rng(seed).uniform(0, 9.9, (97, 1))
    points = points[np.abs(points[:, 0]) > 1e-3]
    assert_allclose(motion.to_preoperative(motion.to_current(points)), points, atol=1e-9)


def test_a_lip_has_the_value_of_its_side():
    rest = triangles()
    motion = Motion(rest, parted(rest), (PATH,))
    y = np.array([4.5, 5.0, 6.125, 7.77, 9.0, 10.0])      # between corners, at corners, and at the mouth
    points = np.stack([0 * y, y], axis=1)
    opening = ((y - 4) / 6)[:, None] * N
    assert_allclose(motion.displacement(points, +1), opening, atol=1e-12)
    assert_allclose(motion.displacement(points, -1), -opening, atol=1e-12)
    assert_allclose(motion.displacement(points, np.array([1, -1] * 3)), opening * np.array([[1], [-1]] * 3), atol=1e-12)


def test_a_point_beside_the_cut_by_less_than_snapping_is_on_its_lip():
    rest = triangles()
    motion = Motion(rest, parted(rest), (PATH,))
    beside = np.array([[-3e-3, 7.0], [3e-3, 7.0]])
    assert_allclose(motion.displacement(beside, +1), [0.5 * N] * 2, atol=1e-9)
    assert_allclose(motion.displacement(beside, -1), [-0.5 * N] * 2, atol=1e-9)


def test_away_from_the_cut_the_side_changes_nothing():
    rest = triangles()
    motion = Motion(rest, parted(rest), (PATH,))
    points = np.array([[3.0, 7.0], [-3.0, 7.0], [0.0, -5.0]])
    for side in (None, 0, 1, -1):
        assert_allclose(motion.to_current(points, side), motion.to_current(points))


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(4))
def test_at_a_kink_the_left_is_a_sector(seed, mirror):
    """Every triangle moves by the side that it is on; at the kink's vertex both sides keep their value."""
    path = PATH * (mirror, 1)
    rest = triangles(seed, path)
    back, ahead, middle = (np.arctan2(*(p - path[1]).T[::-1]) for p in (path[0], path[2], rest.mean(axis=1)))
    left = (middle - ahead) % (2 * np.pi) < (back - ahead) % (2 * np.pi)
    motion = Motion(rest, rest + np.where(left, 1.0, -1.0)[:, None, None] * N, (path,))
    near = path[1] + np.array([[0, 0], [0, 1e-3], [1e-3 * mirror, -1.5e-3], [0, 1e-9]])
    assert_allclose(motion.displacement(near, +1), [N] * 4, atol=1e-9)
    assert_allclose(motion.displacement(near, -1), [-N] * 4, atol=1e-9)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_beside_a_cut_there_are_a_distance_and_a_side(mirror):
    path = PATH * (mirror, 1)
    motion = Motion(triangles(), triangles(), (path,))
    points = np.array([[0.5, 8.0], [-0.25, 8.0], [0.5, 4.0], [-0.1, 3.5], [3.0, 1.0], [-1e-3, 4.005]]) * (mirror, 1)
    distance, side = motion.beside(points)
    # left of a traveller who comes down is +x; the last point is by the kink, left of the line through its other leg
    assert_array_equal(side[[0, 1, 2, 3, 5]], mirror * np.array([1, -1, 1, -1, -1]))
    assert_allclose(distance, [0.5, 0.25, 1.5 / np.sqrt(13), 1.3 / np.sqrt(13), 1.0, 1e-3], atol=1e-12)
    assert np.isinf(Motion(path[None], path[None]).beside(points)[0]).all()


def test_tissue_is_held_where_it_rested():
    rest = triangles()
    motion = Motion(rest, parted(rest), (PATH,))
    assert_array_equal(motion.holds([[0.0, 7.0], [3.0, 3.0], [30.0, 0.0]]), [True, True, False])


def test_no_tissue_gives_nan():
    rest = triangles()
    motion = Motion(rest, parted(rest), (PATH,))
    assert np.isnan(motion.to_current([[30.0, 0.0], [0.0, 10.1], [np.nan, 0.0]])).all()
    assert np.isnan(motion.to_preoperative([[0.0, 9.0]])).all()          # in the opened cut
    assert np.isnan(motion.to_current([[30.0, 0.0]], side=1)).all()
    resected = rest[np.linalg.norm(rest.mean(axis=1) - [4, -4], axis=1) > 2]
    assert np.isnan(Motion(resected, resected).to_current([[4.0, -4.0]])).all()


def test_edges_and_corners_belong_to_the_tissue():
    rest = triangles()
    motion = Motion(rest, rest + SHIFT)
    on_edges = np.concatenate([rest, (rest + np.roll(rest, 1, axis=1)) / 2]).reshape(-1, 2)
    assert_allclose(motion.to_current(on_edges), on_edges + SHIFT, atol=1e-12)


def test_folded_tissue_gives_way_to_tissue_that_is_not():
    rest = np.array([[[0, 0], [2, 0], [0, 2]], [[5, 0], [7, 0], [5, 2]]], float)
    inside_out = rest[0][[0, 2, 1]]
    motion = Motion(rest, np.array([inside_out, rest[0]]))
    assert_allclose(motion.to_preoperative([[0.5, 0.25]]), [[5.5, 0.25]], atol=1e-12)
    alone = Motion(rest[:1], inside_out[None])
    assert_allclose(alone.to_preoperative([[0.5, 0.25]]), [[0.25, 0.5]], atol=1e-12)


def test_needles_do_not_spoil_the_value_on_their_edges():
    """Barycentric coordinates are noise in a triangle 1e-12 mm high, but not in neighbours that share the point."""
    thin = 1e-12
    flat = np.array([[[0, 0], [4, 0], [2, thin]], [[0, 0], [2, thin], [0, 3]], [[2, thin], [4, 0], [4, 3]],
                     [[0, -3], [4, 0], [0, 0]]], float)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    rest = flat @ turn.T + [7.1, 3.3]
    motion = Motion(rest, rest * 1.5)
    points = np.array([[0.7, 0.0], [1.3, thin / 2], [2.0, thin], [3.9, 0.0]]) @ turn.T + [7.1, 3.3]
    assert_allclose(motion.to_current(points), points * 1.5, atol=1e-12)


def test_lips_now_are_the_images_of_the_cut():
    square = np.array([[[0, 0], [4, 0], [4, 3]], [[0, 0], [4, 3], [0, 3]], [[0, -3], [4, -3], [4, 0]],
                       [[0, -3], [4, 0], [0, 0]]], float)
    shift = np.array([1, 1, -1, -1])[:, None, None] * np.array([0.0, 0.5])
    motion = Motion(square, square + shift, (np.array([[-1.0, 0.0], [4.0, 0.0]]),))
    for side in (1, -1):  # travel is along x, so left is above; the point outside of the tissue is left out
        lip = motion.lip_now(0, side, step_mm=1.0)
        assert np.allclose(lip, np.stack([np.arange(5.0), np.full(5, 0.5 * side)], axis=1))


def test_a_motion_is_made_by_what_solves_and_by_what_reads_it_back():
    """Nowhere else: not by a stage, nor by what carries files along. (The self-test knows its own.)"""
    makers = {path.stem for path in (Path(__file__).parents[1] / "xfemnav").rglob("*.py")
              if any(isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Motion"
                     for node in ast.walk(ast.parse(path.read_text())))}
    assert makers == {"solution", "live_motion", "result", "scenes"}
