"""Facets of parts: contacts, lips and rim close around every part; a cut drawn the other way exchanges its lips."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests import cuts
from tests.meshes import cut_in, jittered
from xfemnav.geometry.mesh import orient
from xfemnav.geometry.plane.bisection import REACH
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.dissection import dissect
from xfemnav.geometry.plane.partition import segments_of
from xfemnav.geometry.plane.snapping import SEVER
from xfemnav.geometry.plane.subcells import embed

MESH = jittered(12.0, 10.0, 1.0, 0.25)
NETWORKS = ["generic", "internal", "crossing", "branch", "kinks_in_a_cell", "two_tips_in_a_cell", "right_through",
            "along_edges", "tip_on_a_node", "sharp_turn", "beside_a_row_of_nodes"]


def snapped(name, seed):
    network = cuts.POSITIONS[name](MESH, np.random.default_rng(seed))
    return embed(MESH, tuple(cut_in(MESH, *path, internal=internal) for path, internal in network))


def dissected(paths, tips):
    segments = segments_of(paths)
    return segments, dissect(MESH.corners, MESH.cells, MESH.neighbours, MESH.sizes, segments, tips)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("seed", range(4))
def test_contacts_lips_and_rim_go_once_around_every_part(name, seed):
    """Around each part, tissue on the left, their moments are its area (Green)."""
    split = snapped(name, seed)
    segments, (_, _, (joins, contacts), (lips, spans), (rim, outline), _) = dissected(split.paths, split.fronts.at)
    line = segments.rows[lips[:, 0]]
    faces = line[:, None, :2] + spans[:, :, None] * line[:, None, 2:4]
    contacts, outline = contacts.reshape(-1, 2, 2), outline.reshape(-1, 2, 2)
    ends = np.concatenate([contacts, contacts[:, ::-1], faces, faces[:, ::-1], outline])
    part = np.concatenate([joins[:, 0], joins[:, 1], lips[:, 1], lips[:, 2], rim[:, 0]])
    middle = MESH.corners.mean(axis=1)[split.cell]
    twice = orient(middle[part], ends[:, 0], ends[:, 1])
    # A contact shorter than SEVER h is none, and one part has fewer than ten; the part is about h wide.
    slack = 10 * SEVER * MESH.sizes.max() ** 2
    area = np.bincount(split.part, split.volumes, split.n_parts)
    assert_allclose(np.bincount(part, twice / 2, split.n_parts), area, atol=slack)


@pytest.mark.parametrize("name", NETWORKS[:4])
def test_a_cut_drawn_from_its_tip_has_its_lips_exchanged(name):
    split = snapped(name, 1)
    _, (*_, (_, to), (there, _), _, _) = dissected(split.paths, split.fronts.at)
    _, (*_, (_, fro), (back, _), _, _) = dissected([path[::-1] for path in split.paths], split.fronts.at)
    middles = [np.sort(np.round(ends.reshape(-1, 2, 2).mean(axis=1) @ (1, 1.7e-3), 7)) for ends in (to, fro)]
    assert_allclose(*middles, atol=2e-7)  # rounded to 1e-7
    # Parts are numbered in the order in which lines split a cell, so cells are compared.
    cell = split.cell
    there, back = (np.sort(cell[rows[:, 1:3]], axis=1) for rows in (there, back))
    assert_array_equal(np.unique(there, axis=0), np.unique(back, axis=0))


def test_lips_of_a_segment_follow_each_other():
    """In travel order, without gap or overlap beyond what is too short to cut."""
    split = embed(MESH, (Cut([(1.3, 5.1), (6.2, 4.7), (10.1, 6.3)]),))
    segments, (_, _, _, (lips, spans), _, _) = dissected(split.paths, split.fronts.at)
    assert (np.diff(lips[:, 0]) >= 0).all()
    for s, length in enumerate(segments.rows[:, 4]):
        low, high = spans[lips[:, 0] == s].T
        assert_allclose([low[0], high[-1]], [0, length], atol=REACH * MESH.sizes.max())
        assert_allclose(low[1:], high[:-1], atol=REACH * MESH.sizes.max())
