"""Fans: all triangles of a part meet at the tip that it touches, and no vertex is left out."""

import numpy as np
import pytest

from tests import cuts
from tests.meshes import cut_in, jittered
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.subcells import embed

MESH = jittered(12.0, 10.0, 1.0, 0.25)
ROUNDING = 1e-12  # corners of neighbours are computed from the same lines of coordinates up to 12 mm


@pytest.mark.parametrize("tip", [(5.3, 5.2), (6.1, 4.4), (4.9, 5.9)])
def test_all_triangles_of_a_part_at_a_tip_have_it_as_a_corner(tip):
    split = embed(MESH, (Cut([(1.3, 5.1), tip]),))
    t = int(np.argmin(np.linalg.norm(split.fronts.at - tip, axis=1)))
    for part in split.touch[split.touch[:, 0] == t, 1]:
        gap = np.linalg.norm(split.corners[split.part == part] - split.fronts.at[t], axis=2).min(axis=1)
        assert (gap < ROUNDING).all()


@pytest.mark.parametrize("name", ["generic", "crossing", "branch", "kinks_in_a_cell"])
@pytest.mark.parametrize("seed", range(3))
def test_the_ends_of_a_lip_are_corners_of_the_parts_on_its_sides(name, seed):
    network = cuts.POSITIONS[name](MESH, np.random.default_rng(seed))
    split = embed(MESH, tuple(cut_in(MESH, *path, internal=internal) for path, internal in network))
    for ends, parts in zip(split.lips.facets, split.lips.parts):
        corners = [split.corners[split.part == p].reshape(-1, 1, 2) for p in parts]
        near = [np.linalg.norm(own - ends, axis=2).min(axis=0) for own in corners]
        # One side may have the vertex that hangs on the other's facet.
        assert np.min(near, axis=0).max() < ROUNDING
