"""Streamlines: they move with the tissue, end at lips, lose what was resected, and nothing else changes."""

import numpy as np
import pytest
import shapely
from nibabel.streamlines import Tractogram, TrkFile
from numpy.testing import assert_allclose, assert_array_equal

from data_synthetic.phantom import MOUTH, OPEN, TIP, TRAVEL, Phantom, perfect_solution, side_of
from tests.images import affine_of, image_of
from xfemnav.geometry.locate import LIP
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.streamlines import move_streamlines
from xfemnav.imaging.frames.slices import take_slice

PHANTOM = Phantom()
REST, MOVED = perfect_solution(PHANTOM, rays=180, rings=40)
CUT = np.array([MOUTH, TIP])
MOTION = Motion(REST, MOVED, (CUT,))
TURN = np.array([[0.96, -0.28, 0.0], [0.224, 0.768, -0.6], [0.168, 0.576, 0.8]])    # an oblique axial slice
FRAME = take_slice(image_of(np.zeros((8, 8, 4)), affine_of(TURN * 4.0)), index=1)    # 4 mm thick
LEFT = np.array([-TRAVEL[1], TRAVEL[0]])    # of the cut
GONE = np.linalg.norm(REST.mean(axis=1) - [-30, -20], axis=1) < 9
CHORDS = 0.05    # mm: the motion's chords over triangles of up to 4 mm
FLOAT32 = 1e-5    # mm: what the files keep of 100 mm


def tracts(*lines, **data):
    return TrkFile(Tractogram([np.asarray(line, np.float32) for line in lines], affine_to_rasmm=np.eye(4), **data))


def line(a, b, step=0.5, off=0.0):
    """Points (n, 3) RAS mm from plane point `a` to `b`, at most `step` apart, `off` mm above the plane."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    t = np.linspace(0, 1, int(np.ceil(np.linalg.norm(b - a) / step)) + 1)[:, None]
    return FRAME.to_world(a + t * (b - a)) + off * FRAME.axes[2]


def on_plane(points):
    plane, distance = FRAME.from_world(np.asarray(points, float))
    return plane, distance


def test_a_streamline_in_the_tissue_moves_with_it():
    rest = line([-40, 20], [10, 50], off=1.5)
    result = move_streamlines(tracts(rest), FRAME, MOTION, REST)
    plane, distance = on_plane(rest)
    found, still = on_plane(result.file.streamlines[0])
    assert result.flag == ("moved",) and len(found) == len(rest)
    assert_allclose(found, plane + OPEN.displacement(plane, side_of(plane)), atol=CHORDS)
    assert_allclose(still, distance, atol=FLOAT32)


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("off", [0.0, 0.37, "on a point"])
def test_a_streamline_across_a_cut_ends_at_its_lips(way, off):
    """Also when one of its points lies on the cut."""
    at = MOUTH + 12 * TRAVEL
    slant = LEFT + 0.3 * TRAVEL
    a, b = at + way * 10 * slant, at - way * 10.3 * slant
    rest = np.concatenate([line(a, at), line(at, b)[1:]]) if off == "on a point" else line(a, b, off=off)
    result = move_streamlines(tracts(rest), FRAME, MOTION, REST)
    assert result.flag == ("split", "split")
    assert_array_equal(result.source, [0, 0])
    first, second = (on_plane(piece)[0] for piece in result.file.streamlines)
    assert_allclose(first[-1], at + OPEN.displacement(at[None], way)[0], atol=CHORDS)
    assert_allclose(second[0], at + OPEN.displacement(at[None], -way)[0], atol=CHORDS)
    for piece, side in ((first, way), (second, -way)):
        resting = MOTION.to_preoperative(piece[1:-1])
        assert (side * (resting - TIP) @ LEFT > 0).all()
    assert len(first) + len(second) == len(rest) + (1 if off == "on a point" else 2)


def test_a_touch_is_no_crossing():
    at = MOUTH + 12 * TRAVEL - FLOAT32 * LEFT    # beyond the cut, but by no more than files can tell
    rest = np.concatenate([line(at + 8 * LEFT - 3 * TRAVEL, at), line(at, at + 8 * LEFT + 3 * TRAVEL)[1:]])
    result = move_streamlines(tracts(rest), FRAME, MOTION, REST)
    assert result.flag == ("moved",)
    found = on_plane(result.file.streamlines[0])[0]
    touch = np.argmin(np.linalg.norm(on_plane(rest)[0] - at, axis=1))
    assert_allclose(found[touch], at + OPEN.displacement(at[None], 1)[0], atol=CHORDS)


def test_beyond_the_tip_there_is_no_lip():
    at = TIP + 2 * TRAVEL
    result = move_streamlines(tracts(line(at + 9 * LEFT, at - 9 * LEFT)), FRAME, MOTION, REST)
    assert result.flag == ("moved",)


def test_what_ran_through_resected_tissue_is_gone():
    motion = Motion(REST[~GONE], REST[~GONE])
    hole = shapely.union_all(shapely.polygons(REST[GONE]))
    a, b = np.array([-55.0, -22]), np.array([10.0, -16])
    left = shapely.LineString([a, b]).difference(hole)
    result = move_streamlines(tracts(line(a, b, 0.3)), FRAME, motion, REST)
    assert result.flag == ("trimmed",) * len(left.geoms) and len(left.geoms) > 1
    for piece, exact in zip(result.file.streamlines, left.geoms):
        assert_allclose(on_plane(piece)[0][[0, -1]], np.array(exact.coords)[[0, -1]], atol=FLOAT32)
    assert left.length < np.linalg.norm(b - a) - 10
    whole = move_streamlines(tracts(line([-31, -20], [-29, -20])), FRAME, motion, REST, elsewhere="keep")
    assert whole.flag == () and len(whole.file.streamlines) == 0


@pytest.mark.parametrize("half", [None, 5.0])
def test_parts_off_the_slab_are_kept_or_dropped_and_never_moved(half):
    through = FRAME.to_world([[20.0, 40.0]]) + np.linspace(-15, 15, 41)[:, None] * FRAME.axes[2]
    far = line([0, 0], [30, 0], off=12.0)
    in_air = line([90, 0], [90, 20])
    result = move_streamlines(tracts(through, far, in_air), FRAME, MOTION, REST, half_mm=half)
    assert result.flag == ("kept", "trimmed", "kept", "kept", "kept")
    assert_array_equal(result.source, [0, 0, 0, 1, 2])
    pieces = result.file.streamlines
    for piece, face in ((pieces[0], -1), (pieces[2], 1)):
        own = [np.linalg.norm(through - point, axis=1).min() for point in piece]
        assert min(own[0], own[-1]) < FLOAT32 and np.median(own) < FLOAT32
        ends = on_plane(piece[[0, -1]])[1] * face
        assert_allclose(sorted(ends), [half or 2.0, 15.0], atol=FLOAT32)
    plane, distance = on_plane(pieces[1])
    assert_allclose([distance.min(), distance.max()], [-(half or 2.0), half or 2.0], atol=FLOAT32)
    assert_allclose(plane, np.tile(MOTION.to_current([[20.0, 40.0]]), (len(plane), 1)), atol=FLOAT32)
    assert_array_equal(pieces[3], far.astype(np.float32))
    assert_array_equal(pieces[4], in_air.astype(np.float32))
    dropped = move_streamlines(tracts(through, far, in_air), FRAME, MOTION, REST, half_mm=half, elsewhere="drop")
    assert dropped.flag == ("trimmed",)
    assert_array_equal(dropped.file.streamlines[0], pieces[1])


def test_a_long_step_bends_with_the_tissue():
    a, b = TIP + np.array([[-6.0, 20], [8, -30]])
    result = move_streamlines(tracts(FRAME.to_world([a, b])), FRAME, MOTION, REST)
    found = np.concatenate([on_plane(piece)[0] for piece in result.file.streamlines])
    resting = MOTION.to_preoperative(found)
    assert np.linalg.norm(np.diff(resting, axis=0), axis=1).max() <= 1 + FLOAT32
    normal = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
    assert_allclose((resting - a) @ normal, 0, atol=20 * FLOAT32)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_lost_and_nothing_made(seed):
    """Random walks everywhere: the parts are the walk but for what was resected, and all move as their places do."""
    rng = np.random.default_rng(seed)
    walks = [np.cumsum(rng.normal(size=(n, 3)) * rng.choice([0.3, 3, 15]) * [1, 1, 0.1], axis=0)
             + rng.uniform(-40, 40, 3) * [1, 1, 0.1] for n in rng.integers(2, 60, 60)]
    walks = [FRAME.to_world(walk[:, :2] + [20, 20]) + walk[:, 2:] * FRAME.axes[2] for walk in walks]
    still = move_streamlines(tracts(*walks), FRAME, Motion(REST[~GONE], REST[~GONE], (CUT,)), REST)
    assert set(still.flag) == {"kept", "moved", "split", "trimmed"}
    hole = shapely.union_all(shapely.polygons(REST[GONE])).buffer(1e-3)
    for source, walk in enumerate(walks):
        pieces = [still.file.streamlines[k].astype(float) for k in np.flatnonzero(still.source == source)]
        total = sum(np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece in pieces)
        length = np.linalg.norm(np.diff(walk, axis=0), axis=1).sum()
        assert total <= length * (1 + FLOAT32) + FLOAT32
        if not shapely.LineString(on_plane(walk)[0]).intersects(hole):
            assert total == pytest.approx(length, abs=FLOAT32 * len(walk), rel=FLOAT32)
            assert_allclose([pieces[0][0], pieces[-1][-1]], walk[[0, -1]], atol=FLOAT32)

    motion = Motion(REST[~GONE], MOVED[~GONE], (CUT,))
    moved = move_streamlines(tracts(*walks), FRAME, motion, REST)
    assert moved.flag == still.flag
    for flag, here, there in zip(moved.flag, still.file.streamlines, moved.file.streamlines):
        assert np.isfinite(there).all()
        if flag == "kept":
            assert_array_equal(there, here)
            continue
        resting = motion.to_preoperative(on_plane(there)[0])
        inner = np.isfinite(resting[:, 0])    # the ends, at lips, may be out of the tissue by float32
        assert inner[1:-1].all()
        # points within LIP of a cut move as its lip does, so they are off by LIP times a strain of about .1
        assert_allclose(resting[inner], on_plane(here)[0][inner], atol=0.1 * LIP)


def test_data_of_points_and_streamlines_go_along():
    at = MOUTH + 12 * TRAVEL
    crossing, other = line(at + 10 * LEFT, at - 10.3 * LEFT), line([-40, 20], [10, 50])
    along = [np.arange(len(points), dtype=np.float32)[:, None] for points in (other, crossing)]
    along[0][3] = np.nan
    result = move_streamlines(tracts(other, crossing, data_per_point={"number": along},
                                     data_per_streamline={"bundle": [[7.0], [9.0]]}), FRAME, MOTION, REST)
    data = result.file.tractogram
    assert_array_equal(data.data_per_streamline["bundle"].ravel(), [7, 9, 9])
    assert_array_equal(data.data_per_streamline["motion"].ravel(), [1, 2, 2])
    numbers = [values.ravel() for values in data.data_per_point["number"]]
    assert_array_equal(numbers[0], along[0].ravel())
    assert numbers[1][-1] == pytest.approx(numbers[2][0])    # the crossing, between two points
    assert_array_equal(np.concatenate([numbers[1][:-1], numbers[2][1:]]), along[1].ravel())


def test_streamlines_of_one_point_or_none_do_no_harm():
    result = move_streamlines(tracts([[1.0, 2, 3]], line([-40, 20], [10, 50]), [[4.0, 5, 6]]), FRAME, MOTION, REST)
    assert result.flag == ("kept", "moved", "kept")
    assert_array_equal(result.file.streamlines[2], [[4, 5, 6]])
    with pytest.raises(ValueError, match="keep or drop"):
        move_streamlines(tracts([[1.0, 2, 3]]), FRAME, MOTION, REST, elsewhere="leave")
