"""Lines drawn in the deformed slice: back at rest they lie under the tissue that they were drawn on."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from tests.meshes import disc
from xfemnav.errors import XfemnavError
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.plane.at_rest import path_at_rest, ring_at_rest

MESH = disc(40.0, 4.0)
TURN = np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
SHIFT = np.array([3.0, -2.0])


def turned():
    """The disc turned and shifted as one piece."""
    return Motion(MESH.corners, MESH.corners @ TURN.T + SHIFT)


def opened(width=6.0):
    """The disc with its two halves moved apart along x: a gap about x = 0."""
    middle = MESH.corners.mean(axis=1)[:, 0]
    keep = MESH.corners[np.abs(MESH.corners[:, :, 0]).max(axis=1) < 1e9]
    side = np.where(middle > 0, 1.0, -1.0)
    return Motion(keep, keep + np.stack([side * width / 2, 0 * side], axis=1)[:, None])


def test_a_rigid_motion_is_undone_outside_of_the_organ_too():
    path = np.array([[-60.0, 5.0], [0.0, 0.0], [20.0, 10.0]])
    back = path_at_rest(path @ TURN.T + SHIFT, turned(), "cut")
    # Inside, exactly the drawn path; outside it goes with the tissue at the mouth, which here turns.
    inside = shapely.LineString(back).intersection(shapely.Point(0, 0).buffer(39))
    assert inside.hausdorff_distance(shapely.LineString(path).intersection(shapely.Point(0, 0).buffer(39))) < 0.02
    assert_allclose(back[-1], path[-1], atol=1e-9)


def test_a_line_in_a_bent_slice_is_followed():
    bend = MESH.corners + np.stack([0 * MESH.corners[..., 1], 0.01 * MESH.corners[..., 0] ** 2], axis=-1)
    back = path_at_rest(np.array([[-30.0, 0.0], [30.0, 0.0]]), Motion(MESH.corners, bend), "cut")
    # y = 0 now was y = -.01 x^2 at rest, to the mesh's chords: h^2 / 8 times .02
    assert np.abs(back[:, 1] + 0.01 * back[:, 0] ** 2).max() < 4.0**2 / 8 * 0.02 + 0.02


def test_a_path_across_an_opened_cut_is_refused_and_a_ring_is_not():
    motion = opened()
    with pytest.raises(XfemnavError, match=r"E313 'second' crosses a place without tissue at .*several cuts"):
        path_at_rest(np.array([[-30.0, 0.0], [30.0, 0.0]]), motion, "second")
    ring = np.array([[-20.0, -10.0], [20.0, -10.0], [20.0, 10.0], [-20.0, 10.0]])
    area = shapely.Polygon(ring_at_rest(ring, motion, "tumour")).area
    # 40 mm by 20 mm now, of which the gap (with the mesh's teeth along x = 0) is no tissue
    assert area == pytest.approx((40 - 6) * 20, rel=0.1)


def test_what_touches_no_tissue_is_refused():
    far = np.array([[100.0, 100.0], [120.0, 100.0], [120.0, 120.0]])
    for redraw in (path_at_rest, ring_at_rest):
        with pytest.raises(XfemnavError, match="E313"):
            redraw(far, turned(), "far")


def test_a_ring_over_the_surface_takes_the_surface():
    """Outside of the organ it goes with the tissue beside it, so that no rind stays."""
    still = Motion(MESH.corners, MESH.corners)
    organ = shapely.Polygon(MESH.outline)
    ring = np.array([[20.0, -8.0], [60.0, -8.0], [60.0, 8.0], [20.0, 8.0]])
    taken = shapely.Polygon(ring_at_rest(ring, still, "corridor")).intersection(organ)
    assert taken.area == pytest.approx(shapely.Polygon(ring).intersection(organ).area, rel=1e-6)
    moved = ring @ TURN.T + SHIFT
    again = shapely.Polygon(ring_at_rest(moved, turned(), "corridor")).intersection(organ)
    assert again.area == pytest.approx(taken.area, rel=0.05)  # beyond the organ a turn is no shift
