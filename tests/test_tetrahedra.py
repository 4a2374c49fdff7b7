"""The pull-back in space: every voxel once, exact maps, values kept, whatever way voxels are counted."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from tests.blocks import block
from xfemnav.geometry.mesh import volumes
from xfemnav.imaging.carrying.warp import covered, pull_back, update

ORIGIN, SHAPE = np.array([-15.0, -14.0, -12.0]), (31, 29, 25)
STRAIGHT = np.eye(3)
OBLIQUE = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix() * (1.1, -0.9, 1.2)
HALF = np.array([10.0, 9.0, 8.0])


def tiling(seed, n=60, snapped=False) -> np.ndarray:
    """Tetrahedra (t, 4, 3) mm that tile the box of HALF about 0, with corners on voxels where `snapped`."""
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3) * HALF
    inner = np.random.default_rng(seed).uniform(-1, 1, (n, 3)) * HALF
    points = np.concatenate([corners, np.rint(inner) if snapped else inner])
    x = np.unique(points, axis=0)
    x = x[Delaunay(x).simplices]
    x = x[abs(volumes(x)) > 1e-9]
    turned = volumes(x) < 0
    x[turned] = x[turned][:, [0, 1, 3, 2]]
    return x


def lattice(steps=STRAIGHT):
    """A lattice of SHAPE about 0: its middle voxel's centre is there."""
    return -steps @ (np.array(SHAPE) // 2), steps, SHAPE


def centres(steps=STRAIGHT) -> np.ndarray:
    origin, _, shape = lattice(steps)
    return np.moveaxis(np.indices(shape), 0, -1) @ steps.T + origin


@pytest.mark.parametrize("seed", range(12))
def test_every_voxel_of_a_conforming_mesh_is_in_one_tetrahedron(seed):
    """Also when corners, edges and faces lie on voxels' centres, and neighbours' corners differ by rounding."""
    rest = tiling(seed, 20 * (seed % 4), snapped=seed % 2 == 0)
    moved = rest * (1 + np.random.default_rng(seed).choice([-1, 0, 1], rest.shape) * 2.0**-52)
    result = pull_back(rest, moved, *lattice())
    inside = (abs(centres()) <= HALF + 1e-9).all(axis=-1)
    assert_array_equal(result.tissue, inside)
    assert_array_equal(result._whole(result.count == 1), inside)
    assert not result.folded.any()


def test_voxels_on_faces_of_a_regular_block_are_counted_once():
    rest = block(3, 6).corners
    for shift in (0.0, 0.5, 1e-9, 1 / 3):
        result = pull_back(rest, rest, np.full(3, shift), np.eye(3) / 2, (13, 13, 13))
        assert_array_equal(result.tissue, result._whole(result.count == 1))
        assert result.tissue.sum() == round((6 - shift + 1e-8) // 0.5 + 1) ** 3


@pytest.mark.parametrize("steps", [STRAIGHT, OBLIQUE], ids=["straight", "oblique"])
def test_an_affine_motion_is_exact(steps):
    rest = tiling(1)
    A, b = np.array([[0.9, 0.15, 0.05], [-0.1, 1.05, 0.02], [0.03, -0.04, 0.97]]), np.array([2.3, -1.1, 0.7])
    result = pull_back(rest, rest @ A.T + b, *lattice(steps))
    exact = (centres(steps) - b) @ np.linalg.inv(A).T
    assert_array_equal(result.tissue, (abs(exact) <= HALF + 1e-9).all(axis=-1))
    # rounding of 30 mm over tetrahedra 1e-2 mm high
    assert_allclose(result.resting[result.tissue], exact[result.tissue], atol=1e-11)
    assert_allclose(result.field[result.tissue], (exact - centres(steps))[result.tissue], atol=1e-11)
    assert_allclose(result.F, np.broadcast_to(A, result.F.shape), atol=1e-10)
    assert (result.field[~result.tissue] == 0).all() and np.isnan(result.resting[~result.tissue]).all()


@pytest.mark.parametrize("interp", ["linear", "nearest", "cubic"])
def test_tissue_that_does_not_move_keeps_its_image(interp):
    image = np.random.default_rng(0).normal(size=SHAPE)
    rest, here = tiling(2, 200), lattice(OBLIQUE)
    same = update(image, covered(rest, *here), pull_back(rest, rest, *here), interp)
    if interp == "cubic":
        assert_allclose(same.updated, image, atol=1e-6)
    else:
        assert_array_equal(same.updated, image.astype(same.updated.dtype))
    assert not (same.cavity.any() or same.overlap.any() or same.vacated.any())


def test_linear_images_move_exactly_and_labels_stay_labels():
    rest, here = tiling(3), lattice(OBLIQUE)
    moved = rest + 1.5 * np.sin(rest[..., [1, 2, 0]] / 6)
    result, slope = pull_back(rest, moved, *here), np.array([0.7, -0.4, 1.3])
    organ = covered(rest, *here)
    found = update(centres(OBLIQUE) @ slope, organ, result)
    voxels = np.nan_to_num((result.resting - here[0]) @ np.linalg.inv(OBLIQUE).T)
    inner = result.tissue & ((voxels > 0) & (voxels < np.array(SHAPE) - 1)).all(axis=-1)
    assert_allclose(found.updated[inner], (result.resting @ slope)[inner], atol=1e-5)  # float32
    labels = np.random.default_rng(0).integers(0, 9, SHAPE).astype(np.int16)
    carried = update(labels, organ, result, "nearest", fill=0)
    assert carried.updated.dtype == np.int16
    nearest = np.clip(np.rint(voxels), 0, np.array(SHAPE) - 1)[result.tissue].astype(int)
    assert_array_equal(carried.updated[result.tissue], labels[tuple(nearest.T)])
    assert_array_equal(found.cavity, organ & ~result.tissue)


def test_the_image_goes_on_beyond_its_outermost_voxels():
    rest = tiling(4)
    result = pull_back(rest, rest - [20.0, 0, 0], *lattice())
    ramp = np.broadcast_to(np.arange(31.0)[:, None, None], SHAPE)
    found = update(np.ascontiguousarray(ramp), np.zeros(SHAPE, bool), result)
    # rests at x + 20, voxel 15 + x + 20
    assert_array_equal(found.updated[:6, 14, 12], [20, 21, 22, 23, 24, 25])


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
@pytest.mark.parametrize("flips", [(1, 1, 1), (-1, 1, -1), (1, -1, 1)])
def test_no_storage_order_changes_what_is_where(order, flips):
    """Where tissue overlaps, too: the first tetrahedron has the voxel in all of them."""
    rest = tiling(5)
    moved = rest + 3 * np.sin(rest[..., [1, 2, 0]] / 3)    # it folds
    straight = pull_back(rest, moved, *lattice(OBLIQUE))
    turn = np.eye(3)[:, list(order)] * flips
    shape = np.array(SHAPE)[list(order)]
    ends = np.where(np.array(flips) > 0, 0, shape - 1)
    steps = OBLIQUE @ turn
    origin = lattice(OBLIQUE)[0] - steps @ ends
    stored = pull_back(rest, moved, origin, steps, tuple(shape))

    def back(values):
        return values[tuple(slice(None, None, f) for f in flips)].transpose(*np.argsort(order), *range(3, values.ndim))

    assert straight.overlap.any() and straight.folded.any()
    assert_array_equal(back(stored.tissue), straight.tissue)
    assert_array_equal(back(stored.overlap), straight.overlap)
    assert_allclose(back(stored.resting), straight.resting, atol=1e-9)


def test_where_tissue_lies_twice_it_counts_and_folded_tissue_gives_way():
    rest = tiling(6, 0)
    other = rest + np.array([30.0, 0, 0])
    twice = pull_back(np.concatenate([rest, other]), np.concatenate([rest, rest]), *lattice())
    inside = twice.tissue
    strictly = (abs(centres()) < HALF - 1e-3).all(axis=-1)
    assert_array_equal(twice.simplices_of(inside) < len(rest), True)
    assert twice.overlap[strictly].mean() > 0.9    # but for centres on inner faces
    mirrored = rest * [-1.0, 1, 1]
    folded = pull_back(np.concatenate([rest, other]), np.concatenate([mirrored, rest]), *lattice())
    assert folded.folded.any()
    on = folded._whole(folded.count == 1) & strictly
    assert (folded.resting[on][:, 0] > 15).mean() > 0.9


def test_what_lies_off_the_lattice_is_nowhere():
    rest = tiling(7, 0)
    for shift in ([100.0, 0, 0], [0, -100.0, 0]):
        result = pull_back(rest, rest + shift, *lattice())
        assert not result.tissue.any() and result.places_of(np.ones(SHAPE, bool)).shape == (np.prod(SHAPE), 3)
    none = pull_back(rest[:0], rest[:0], *lattice())
    assert not none.tissue.any()
    flat = np.repeat(rest[:1], 1, axis=0)
    flat[0, 3] = flat[0, :3].mean(axis=0)
    assert not pull_back(rest[:1], flat, *lattice()).tissue.any()


def test_rows_are_the_whole_in_parts():
    rest = tiling(8)
    result = pull_back(rest, rest + np.array([2.0, 1.0, 0.5]), *lattice(OBLIQUE))
    wanted = np.random.default_rng(0).random(SHAPE) < 0.5
    parts = [result.places_of(wanted[a:a + 7], a) for a in range(0, SHAPE[0], 7)]
    assert_array_equal(np.concatenate(parts), result.places_of(wanted))
    expected = np.where(result.tissue[..., None], result.resting, centres(OBLIQUE))[wanted]
    assert_allclose(result.places_of(wanted), expected, atol=1e-12)
    assert_array_equal(result.simplices_of(wanted) >= 0, result.tissue[wanted])
