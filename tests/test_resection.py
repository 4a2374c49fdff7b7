"""Resections: the region drawn is the region taken out, and what is left is closed by outline and walls."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from tests.meshes import cut_in, grid, jittered, outline
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.removal import take_out
from xfemnav.geometry.plane.resection import inner_paths, place_resection
from xfemnav.geometry.plane.snapping import SNAP
from xfemnav.geometry.plane.subcells import embed
from xfemnav.mechanics.space.enrichment import enrich

MESH = jittered(12.0, 10.0, 1.0, 0.25, seed=25)


def circle(x, y, radius, n=40):
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def box(x0, y0, x1, y1):
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


DRAWN = {
    "inside": ((circle(6, 5, 2),), 1),
    "a hole": ((circle(6, 5, 3), circle(6, 5, 1)), 2),
    "at the surface": ((circle(0, 5, 3),), 1),
    "a corner": ((circle(0, 0, 3),), 1),
    "right through": ((box(4, -1, 7, 11),), 2),
    "three parts": ((circle(6, 5, 2), circle(6, 9.5, 2), box(1, 1, 2, 2)), 3),
    "along edges": ((box(3, 3, 6, 5),), 1),
    "two loops that overlap": ((circle(5, 5, 2), circle(7, 5, 2)), 2),
}


def refused(code, rings):
    with pytest.raises(XfemnavError) as caught:
        place_resection(rings, outline(MESH))
    assert caught.value.code == code
    return caught.value.message


@pytest.mark.parametrize("name", sorted(DRAWN))
@pytest.mark.parametrize("mesh", [MESH, grid(12, 12.0)], ids=["jittered", "grid"])
def test_what_is_drawn_is_taken_out_and_the_rest_is_closed(name, mesh):
    rings, n_paths = DRAWN[name]
    placed = place_resection(rings, outline(mesh), "tumour")
    if mesh is MESH:
        assert len(placed.paths) >= n_paths
    split = embed(mesh, (), (placed,))
    area = np.bincount(split.part, split.volumes)
    gone = area[split.removed].sum()
    assert_allclose(area.sum(), mesh.volumes.sum(), rtol=1e-12)
    # Snapping moves the boundary by up to 2e-3 h.
    length = sum(shapely.LineString(path).length for path in placed.paths)
    assert abs(gone - placed.area_mm2) < 2 * SNAP * mesh.sizes.max() * length
    assert_allclose(np.linalg.norm(np.diff(split.walls.facets, axis=1), axis=2).sum(), length, rtol=1e-2)
    # Green: outline and walls, tissue on their left, enclose what is left.
    (x, y), (u, v) = (ends.T for ends in np.concatenate([split.rim.facets, split.walls.facets]).swapaxes(0, 1))
    assert_allclose((x * v - y * u).sum() / 2, mesh.volumes.sum() - gone, rtol=1e-5)
    assert not split.removed[split.rim.parts].any() and not split.removed[split.walls.parts].any()
    assert (split.walls.source == 0).all()
    centres = split.corners.mean(axis=1)
    deep = shapely.distance(placed.region.boundary, shapely.points(centres)) > 1e-2
    assert (shapely.contains_xy(placed.region, centres) == split.removed[split.part])[deep].all()


def test_even_and_odd():
    """An island in a hole in a blob is taken out again; a loop drawn twice takes nothing."""
    placed = place_resection([circle(6, 5, r) for r in (3, 2, 1)], outline(MESH))
    inside = shapely.contains_xy(placed.region, [(6, 5), (7.5, 5), (8.5, 5), (9.5, 5)])
    assert inside.tolist() == [True, False, True, False]
    refused("E311", [circle(6, 5, 2), circle(6, 5, 2)])


def test_a_region_that_cannot_be_taken_out_is_refused():
    assert "lps" in refused("E310", [circle(-6, 5, 2)])  # mirrored, it would meet the organ
    assert "frame" in refused("E310", [circle(60, 5, 2)])
    refused("E311", [np.array([(1.0, 1.0), (2.0, 2.0)])])
    refused("E311", [np.array([(1.0, 1.0), (2.0, 2.0), (3.0, 3.0)])])
    refused("E311", [np.array([(1.0, np.nan), (2.0, 2.0), (3.0, 1.0)])])
    refused("E312", [box(-1, -1, 13, 11)])


def test_a_region_smaller_than_the_snapping_is_refused():
    mesh = grid(4, 40.0)
    placed = place_resection([circle(13, 12, 5e-3)], outline(mesh))
    with pytest.raises(XfemnavError, match="E311"):
        embed(mesh, (), (placed,))


def test_inner_paths_leave_the_outline_out():
    """A notch on the outline is one open path from surface to surface, wherever its ring starts."""
    line = shapely.LinearRing(box(0, 0, 4, 4))
    ring = np.array([(1.0, 0.0), (3.0, 0.0), (3.0, 1.0), (1.0, 1.0)])
    for turn in range(4):
        (path,) = inner_paths([np.roll(ring, turn, axis=0)], line, 1e-9)
        assert path.tolist() == [[3, 0], [3, 1], [1, 1], [1, 0]]
    (closed,) = inner_paths([ring + 0.5], line, 1e-9)
    assert (closed[0] == closed[-1]).all() and len(closed) == 5


def test_a_cut_that_ends_in_a_resection_has_no_tip_and_lips_only_where_tissue_is_on_both_sides():
    placed = place_resection([circle(6, 5, 2)], outline(MESH))
    on_it = placed.rings[0][np.argmin(placed.rings[0][:, 0])]
    for tip, length in (((6, 5), 4.0), (on_it, 4.0), ((11, 5), 7.0), ((3.5, 5), 3.5)):
        cut = cut_in(MESH, (-1.0, 5.0), tip)
        split = embed(MESH, (cut,), (placed,))
        assert_allclose(np.diff(split.lips.arc).sum(), length, atol=0.02)  # the cut is not quite a diameter
        assert len(split.fronts.at) == (tip[0] in (11, 3.5))
        assert not split.removed[split.lips.parts].any()


def test_a_cut_along_a_wall_has_no_lips_and_the_wall_is_whole():
    placed = place_resection([box(3.3, 3.3, 6.4, 5.5)], outline(MESH))
    whole = embed(MESH, (), (placed,))
    for start, end in (((3.3, 3.3), (6.4, 3.3)), ((4.0, 3.3), (5.0, 3.3 + 1e-7))):
        cut = cut_in(MESH, start, end, internal=True)
        split = embed(MESH, (cut,), (placed,))
        assert not len(split.lips.cut) and not len(split.fronts.at)
        for s in (whole, split):
            assert_allclose(np.linalg.norm(np.diff(s.walls.facets, axis=1), axis=2).sum(), 2 * (3.1 + 2.2), rtol=1e-5)


def test_two_resections_side_by_side_leave_no_wall_between_them():
    left, right = (place_resection([box(a, 3.2, b, 5.4)], outline(MESH), "") for a, b in ((3.3, 5.1), (5.1, 7.3)))
    split = embed(MESH, (), (left, right))
    lengths = np.linalg.norm(np.diff(split.walls.facets, axis=1), axis=2).ravel()
    assert_allclose(lengths.sum(), 2 * (4.0 + 2.2), rtol=1e-4)
    # A facet that passes from one to the other belongs to one of them.
    assert_allclose(np.bincount(split.walls.source, lengths), [2 * 1.8 + 2.2, 2 * 2.2 + 2.2], atol=1.0)
    assert_allclose(split.volumes[split.removed[split.part]].sum(), 4.0 * 2.2, rtol=1e-4)


def test_a_body_taken_out_leaves_walls_where_its_lips_were():
    cut = cut_in(MESH, (-1.0, 5.1), (13.0, 4.9))
    split = embed(MESH, (cut,))
    body = enrich(MESH, split).body
    upper = body == body[np.argmax(split.corners[:, 0, 1][np.argsort(split.part)])]
    left = take_out(split, upper)
    assert not len(left.lips.cut) and (left.walls.source == -1).all()
    (x, y), (u, v) = (ends.T for ends in np.concatenate([left.rim.facets, left.walls.facets]).swapaxes(0, 1))
    kept = split.volumes[~upper[split.part]].sum()
    assert_allclose((x * v - y * u).sum() / 2, kept, rtol=1e-5)
