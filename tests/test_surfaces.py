"""Surfaces: points move as landmarks do and keep their order; no face is stretched across a gap, no other is lost."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal

from data_synthetic.phantom import MOUTH, TIP, TRAVEL, Phantom, perfect_solution
from tests.images import affine_of, image_of
from xfemnav.errors import XfemnavWarning
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.landmarks import moved_points
from xfemnav.imaging.carrying.surfaces import move_surface
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.points.surface_files import Surface

REST, MOVED = perfect_solution(Phantom(), rays=180, rings=40)
CUT = np.array([MOUTH, TIP])
MOTION = Motion(REST, MOVED, (CUT,))
TURN = np.array([[0.96, -0.28, 0.0], [0.224, 0.768, -0.6], [0.168, 0.576, 0.8]])    # an oblique axial slice
FRAME = take_slice(image_of(np.zeros((8, 8, 4)), affine_of(TURN * 4.0)), index=1)    # 4 mm thick
LEFT = np.array([-TRAVEL[1], TRAVEL[0]])    # of the cut
GONE = np.linalg.norm(REST.mean(axis=1) - [-30, -20], axis=1) < 9


def surface(points, faces):
    """World points (n, 3) and faces of them, however many corners each has."""
    count = np.array([len(face) for face in faces], int)
    return Surface(points, np.array([k for face in faces for k in face], int), count, "RAS", True,
                   lambda points, kept: b"")


def world(plane, off=0.0):
    plane = np.atleast_2d(plane)
    return FRAME.to_world(plane) + np.broadcast_to(off, len(plane))[:, None] * FRAME.axes[2]


def sphere(centre, radius, n=24):
    """A ball of triangles about a plane point: points (n, 3) world, faces (m, 3)."""
    theta, phi = np.meshgrid(np.linspace(0.05, np.pi - 0.05, n), np.linspace(0, 2 * np.pi, 2 * n, endpoint=False),
                             indexing="ij")
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(2 * n), indexing="ij")
    a, b = i * 2 * n + j, i * 2 * n + (j + 1) % (2 * n)
    faces = np.stack([[a, b, a + 2 * n], [b, b + 2 * n, a + 2 * n]], -1).reshape(3, -1).T
    return world(centre + radius * unit[:, :2], radius * unit[:, 2]), faces


def stretch(moved):
    """The longest that an edge of the faces that are kept is, over what it was."""
    faces = moved.surface.corners.reshape(-1, 3)[moved.kept]
    ends = np.stack([faces, np.roll(faces, 1, axis=1)], -1).reshape(-1, 2)
    before, after = (np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1)
                     for x in (moved.surface.points, moved.points))
    return (after / before).max()


def test_points_move_as_landmarks_in_their_order():
    points, faces = sphere(TIP + 10 * LEFT, 8.0)
    moved = move_surface(surface(points, faces), FRAME, MOTION, REST)
    wanted = moved_points(points, FRAME, MOTION, REST)
    assert moved.flag == wanted.flag == ("tissue",) * len(points)
    assert_array_equal(moved.points, wanted.moved)
    assert moved.kept.all() and set(moved.left_out.values()) == {0}
    assert abs(moved.points - points).max() > 0.5
    assert moved.off == (abs(FRAME.from_world(points)[1]) > 2).sum() and moved.farthest == pytest.approx(8, abs=0.02)


def test_faces_across_a_cut_are_left_out_and_no_others():
    points, faces = sphere(MOUTH + 16 * TRAVEL, 9.0)
    moved = move_surface(surface(points, faces), FRAME, MOTION, REST)
    plane = FRAME.from_world(points)[0][faces]
    across = shapely.intersects(shapely.convex_hull(shapely.multipoints(plane.reshape(-1, 2), indices=np.repeat(
        np.arange(len(faces)), 3))), shapely.LineString(CUT))
    assert_array_equal(~moved.kept, across)
    assert moved.left_out["on a cut"] == across.sum() > 20
    assert stretch(moved) < 1.5 < stretch(move_surface(surface(points, faces), FRAME, Motion(
        REST, MOVED), REST))    # of a motion that does not tell of its cut


def test_a_face_larger_than_the_whole_cut_is_across_it():
    inner = np.array([TIP - 12 * TRAVEL, TIP - 4 * TRAVEL])
    motion = Motion(REST, MOVED, (inner,))
    around = world([TIP - 20 * TRAVEL, TIP + 12 * LEFT, TIP + 8 * TRAVEL, TIP - 12 * LEFT])
    moved = move_surface(surface(around, [[0, 1, 2, 3], [1, 2, 3]]), FRAME, motion, REST)
    assert_array_equal(moved.kept, [False, True])


@pytest.mark.parametrize("side", [1, -1])
def test_a_surface_that_ends_on_a_cut_goes_with_its_lip(side):
    along = MOUTH + np.linspace(5, 20, 6)[:, None] * TRAVEL
    points = world(np.concatenate([along, along + side * 3 * LEFT]))
    faces = [[k, k + 1, k + 6] for k in range(5)] + [[k + 1, k + 7, k + 6] for k in range(5)]
    moved = move_surface(surface(points, faces), FRAME, MOTION, REST)
    assert moved.kept.all()
    assert_allclose(FRAME.from_world(moved.points[:6])[0], MOTION.to_current(along, side), atol=1e-9)


def test_of_faces_on_both_sides_of_a_cut_the_fewer_are_left_out():
    along = MOUTH + np.linspace(5, 20, 6)[:, None] * TRAVEL
    points = world(np.concatenate([along, along + 3 * LEFT, along[:3] - 3 * LEFT]))
    left = [[k, k + 1, k + 6] for k in range(5)] + [[k + 1, k + 7, k + 6] for k in range(5)]
    right = [[k, k + 12, k + 1] for k in range(2)]
    moved = move_surface(surface(points, left + right), FRAME, MOTION, REST)
    assert_array_equal(moved.kept, [True] * 10 + [False] * 2)
    assert moved.left_out["on a cut"] == 2


def test_what_was_resected_is_left_out_and_its_points_stay():
    points, faces = sphere([-30.0, -20], 12.0)
    motion = Motion(REST[~GONE], MOVED[~GONE], (CUT,))
    moved = move_surface(surface(points, faces), FRAME, motion, REST)
    hole = shapely.union_all(shapely.polygons(REST[GONE]))
    corners = FRAME.from_world(points)[0][faces].reshape(-1, 2)
    hulls = shapely.convex_hull(shapely.multipoints(corners, indices=np.repeat(np.arange(len(faces)), 3)))
    clear = shapely.distance(hulls, hole) > 0.05
    assert moved.kept[clear].all() and not moved.kept[shapely.intersects(hulls, hole.buffer(-0.05))].any()
    resected = np.array(moved.flag) == "resected"
    assert_array_equal(moved.points[resected], points[resected])
    assert not np.isin(faces[moved.kept], np.flatnonzero(resected)).any() and resected.any()
    around = world([[-60.0, -45], [0, -45], [0, 5], [-60, 5]])    # all corners in tissue, the hole within
    assert not move_surface(surface(around, [[0, 1, 2, 3]]), FRAME, motion, REST).kept.any()


def test_what_is_outside_stays_and_is_parted_only_where_the_outline_moves():
    still = Motion(REST, REST)
    away = Motion(REST, REST + np.array([3.0, 0]))
    edge = REST.reshape(-1, 2)
    edge = edge[np.linalg.norm(edge, axis=1).argmax()]
    out = edge / np.linalg.norm(edge)
    points = world([edge - 2 * out, edge + 2 * out, edge + 2 * out + [0, 1], edge + 5 * out])
    for motion, kept in ((still, [True, True]), (away, [False, True])):
        moved = move_surface(surface(points, [[0, 1, 2], [1, 2, 3]]), FRAME, motion, REST)
        assert_array_equal(moved.kept, kept)
        assert_array_equal(moved.points[1:], points[1:])
        assert moved.flag == ("tissue", "outside", "outside", "outside")


def test_a_surface_without_faces_or_far_away_does_no_harm():
    moved = move_surface(surface(world([[500.0, 0]], 3.0), []), FRAME, MOTION, REST)
    assert moved.flag == ("outside",) and moved.kept.shape == (0,)
    assert "1 points: 1 outside" in moved.words


def test_doubts_are_told(recwarn):
    outline = 60 * np.column_stack([np.cos(t := np.linspace(0, 2 * np.pi, 60)), np.sin(t)]) + [40, 40]
    points, faces = sphere([40.0, 40], 8.0)
    right = move_surface(surface(points, faces), FRAME, MOTION, REST)
    right.warn_of_frame("a.stl", FRAME, outline)
    assert not [item for item in recwarn if issubclass(item.category, XfemnavWarning)]
    above = move_surface(surface(points + 30 * FRAME.axes[2], faces), FRAME, MOTION, REST)
    above.warn_of_frame("b.stl", FRAME, outline)
    assert "W132" in str(recwarn[-1].message)
    mirrored = move_surface(surface(points * [-1, -1, 1], faces), FRAME, MOTION, REST)
    with pytest.warns(match="W131"):
        mirrored.warn_of_frame("c.stl", FRAME, outline)
