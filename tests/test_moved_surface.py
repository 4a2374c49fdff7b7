"""The closed surface now: what it encloses is the organ as it is, mouths bridged, holes closed."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.solids import AFFINE, FRONT, SHAPE, WALL, N, Opened
from xfemnav.geometry.solid.moved_surface import moved_surface
from xfemnav.geometry.within import within
from xfemnav.imaging.carrying.warp import covered, enclosed, pull_back

LATTICE = AFFINE[:3, 3], AFFINE[:3, :3], SHAPE
STRAIGHT = np.full(3, -2.0), np.eye(3) / 4, (33, 33, 33)    # centres on the surface and its edges
CENTRES = np.moveaxis(np.indices(SHAPE), 0, -1) @ AFFINE[:3, :3].T + AFFINE[:3, 3]


@pytest.mark.parametrize("lattice", [LATTICE, STRAIGHT], ids=["oblique", "straight"])
def test_at_rest_it_is_the_organ(lattice):
    scene = Opened()
    rest, _ = scene.rim
    inside, tissue = enclosed(moved_surface(scene.outline, rest, rest), *lattice), covered(scene.mesh.corners, *lattice)
    assert tissue.sum() > 1000
    if lattice is LATTICE:
        assert_array_equal(inside, tissue)
    else:    # of centres on the surface those of the lower sides
        eroded = covered(scene.mesh.corners * (1 - 1e-6) + 1e-6 * N / 2, *lattice)
        assert (inside | ~eroded).all() and (tissue | ~inside).all()


@pytest.mark.parametrize("gap, lift", [(1.5, 0.0), (1.5, -0.8), (2.5, 0.6)])
def test_a_mouth_is_bridged_straight(gap, lift):
    scene = Opened(gap, lift)
    surface = moved_surface(scene.outline, *scene.rim)
    inside = enclosed(surface, *LATTICE)
    tissue = pull_back(scene.motion.rest, scene.motion.moved, *LATTICE).tissue
    assert (inside | ~tissue).all()
    # a wedge from the front to the lips at the moved top
    x, y, z = np.moveaxis(CENTRES, -1, 0)
    height = (z - FRONT) / (N - FRONT + lift)
    wedge = (abs(x - WALL) < gap / 2 * height) & (height > 0) & (height < 1) & (y > 0) & (y < N)
    assert wedge.sum() > 50
    assert_array_equal(inside & ~tissue, wedge)
    assert_array_equal(within(CENTRES.reshape(-1, 3), surface).reshape(SHAPE), inside)


def test_where_tissue_was_taken_out_at_the_surface_the_resting_surface_goes_on():
    scene = Opened(0.0, ball=True)
    rest, _ = scene.rim
    whole, left = covered(scene.mesh.corners, *LATTICE), scene.motion.rest
    surface = moved_surface(scene.outline, rest, rest)
    assert len(surface) > len(rest)
    assert_array_equal(enclosed(surface, *LATTICE), whole)
    assert (whole & ~covered(left, *LATTICE)).sum() > 10
    shift = np.array([0.1, 0.05, -0.4])
    sunk = enclosed(moved_surface(scene.outline, rest, rest + shift), *LATTICE)
    assert (sunk | ~covered(left + shift, *LATTICE)).all()


def test_between_uneven_lips_the_surface_passes_through_their_middle():
    scene = Opened()
    rest, moved = scene.rim
    raised = moved.copy()    # the lip at large x alone, by .8 mm at the top
    height = np.clip(rest[..., 2] - FRONT, 0, None) / (N - FRONT)
    raised[..., 2] += 0.8 * (rest.mean(axis=1)[:, None, 0] > WALL) * height
    surface, y = moved_surface(scene.outline, rest, raised), 1.3
    probes = np.array([[WALL, y, N + 0.4 - 0.05], [WALL, y, N + 0.4 + 0.05], [3.5, y, N + 0.75], [0.2, y, N + 0.05]])
    assert_array_equal(within(probes, surface), [True, False, True, False])
