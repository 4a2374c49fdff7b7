"""The mesh generator, on easy and nasty outlines: quality, topology, fidelity, size and grading, what it refuses."""

import time

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose
from scipy import ndimage

from data_synthetic.masks import KINDS, random_mask
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.distmesh import distmesh, expected_nodes
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.imaging.organ.outline import outline_of

RECTANGLE = np.array([[0.0, 0], [7, 0], [7, 16], [0, 16]])


def disc(radius=70.0, n=360):
    angle = 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def brain():
    """Smooth outline of the size and lobes of an axial brain slice, about 15,000 mm^2."""
    angle = 2 * np.pi * np.arange(1400) / 1400
    radius = 68 * (1 + 0.13 * np.cos(2 * angle) - 0.05 * np.cos(6 * angle + 1) + 0.03 * np.sin(11 * angle))
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def dumbbell(width):
    """Two discs of radius 20 mm joined by a bar 30 mm long and `width` mm wide."""
    parts = [shapely.Point(x, 0).buffer(20, 64) for x in (-35, 35)] + [shapely.box(-35, -width / 2, 35, width / 2)]
    return shapely.get_coordinates(shapely.unary_union(parts).exterior)[:-1]


def assert_disc(mesh):
    """One piece without holes: Euler number 1, one boundary loop through no node twice."""
    assert len(mesh.points) - len(mesh.edges) + len(mesh.cells) == 1
    assert len(mesh.boundary_loops) == 1
    assert np.array_equal(np.unique(mesh.cells), np.arange(len(mesh.points)))


def longest_edges(mesh):
    return np.linalg.norm(np.diff(mesh.points[mesh.edges], axis=1)[:, 0], axis=1)


@pytest.mark.parametrize("outline, h", [(disc(), 1.9), (RECTANGLE, 0.16), (brain(), 1.9)])
def test_uniform_mesh_is_good_at_5000_nodes(outline, h):
    mesh = distmesh(outline, h)
    assert 4000 < len(mesh.points) < 6000
    assert mesh.quality.min() >= 0.75 and mesh.quality.mean() >= 0.996
    assert_disc(mesh)


@pytest.mark.parametrize("outline, h", [(disc(), 14.0), (RECTANGLE, 1.2), (brain(), 9.0)])
def test_coarse_mesh_is_good(outline, h):
    mesh = distmesh(outline, h)
    assert mesh.quality.min() >= 0.6 and mesh.quality.mean() >= 0.93
    assert_disc(mesh)


@pytest.mark.parametrize("h", [3.0, 1.0])
def test_edges_have_the_wanted_length(h):
    lengths = longest_edges(distmesh(brain(), h))
    assert_allclose(np.median(lengths), h, rtol=0.05)
    assert lengths.min() > 0.4 * h and lengths.max() < 1.9 * h


def test_nodes_of_the_boundary_lie_on_the_outline_and_come_first():
    outline = brain()
    mesh = distmesh(outline, 3.0)
    loop = np.sort(mesh.boundary_loops[0])
    assert np.array_equal(loop, np.arange(len(loop)))
    away = shapely.distance(shapely.LinearRing(outline), shapely.points(mesh.points[loop]))
    assert_allclose(away, 0, atol=1e-9)
    # A chord of length h on an arc of radius R strays h^2 / 8 R: the tightest radius here is about 10 mm.
    rings = shapely.LinearRing(outline), shapely.LinearRing(mesh.outline)
    assert shapely.hausdorff_distance(*(shapely.segmentize(ring, 0.1) for ring in rings)) < 3**2 / 80 + 0.05


def test_corners_are_nodes_and_the_area_is_exact():
    mesh = distmesh(RECTANGLE, 0.5)
    for corner in RECTANGLE:
        assert np.linalg.norm(mesh.points - corner, axis=1).min() < 1e-12
    assert_allclose(mesh.volumes.sum(), 7 * 16, rtol=1e-12)


def test_rotation_of_the_corner_list_and_clockwise_order_are_welcome():
    for outline in (np.roll(RECTANGLE, 1, axis=0), RECTANGLE[::-1]):
        mesh = distmesh(outline, 1.0)
        assert_allclose(mesh.volumes.sum(), 112, rtol=1e-12)
        assert mesh.quality.min() > 0.6


def test_lattice_is_not_aligned_with_the_axes():
    """Less than a tenth of the inner edges run within 5 degrees of an axis: a lattice along them would have a third."""
    mesh = distmesh(RECTANGLE, 0.25)
    inner = mesh.edges[(mesh.edges >= len(mesh.boundary_loops[0])).all(axis=1)]
    x, y = np.abs(np.diff(mesh.points[inner], axis=1)[:, 0].T)
    assert np.mean(np.minimum(x, y) < np.tan(np.radians(5)) * np.maximum(x, y)) < 0.1


def test_default_grading_on_a_brain():
    outline = brain()
    cut = np.array([[0, 60.0], [3.0, 18.0]])  # 40 mm of it inside
    size = SizeField(3.0, 1.0, 12.0, (cut,))
    mesh = distmesh(outline, size)
    assert 3000 < len(mesh.points) < 6500
    assert mesh.quality.min() >= 0.7 and mesh.quality.mean() >= 0.989
    middles, lengths = mesh.points[mesh.edges].mean(axis=1), longest_edges(mesh)
    ratio = lengths / size(middles)
    assert np.quantile(ratio, 0.99) < 1.3 and np.quantile(ratio, 0.01) > 0.7
    assert lengths[size(middles) == 1].max() < 1.6
    assert_disc(mesh)


@pytest.mark.parametrize("growth", [0.2, 0.3])
def test_focus_points_to_one_part_in_a_thousand(growth):
    focus = (((0, 30), 0.004), ((0, 50), 0.05), ((0, 70), 0.02))
    size = SizeField(4.0, 1.0, 8.0, ([[0, 80], [0, 30]],), focus, growth)
    mesh = distmesh(disc(), size)
    assert mesh.quality.min() >= 0.7 and mesh.quality.mean() >= 0.98
    for point, wanted, *_ in focus:
        cells = np.argsort(np.linalg.norm(mesh.corners.mean(axis=1) - point, axis=1))[:6]
        assert 0.6 < mesh.sizes[cells].mean() / wanted < 1.6
    assert_disc(mesh)


def test_estimate_of_the_number_of_nodes():
    for outline, size in ((disc(), 3.0), (RECTANGLE, 0.3), (brain(), SizeField(3.0, 1.0, 12.0, ([[0, 70], [0, 30]],)))):
        size_at = size if callable(size) else lambda points, size=size: np.full(len(points), size)
        assert_allclose(expected_nodes(outline, size_at), len(distmesh(outline, size).points), rtol=0.05)


def test_same_input_same_bytes():
    size = SizeField(4.0, 1.5, 8.0, ([[0, 80], [0, 30]],))
    one, two = distmesh(brain(), size), distmesh(brain(), size)
    assert one.points.tobytes() == two.points.tobytes() and one.cells.tobytes() == two.cells.tobytes()


@pytest.mark.parametrize("width", [6.0, 3.0, 1.5, 1.0])
def test_narrow_isthmus_is_kept(width):
    mesh = distmesh(dumbbell(width), 3.0)
    assert_disc(mesh)
    assert mesh.quality.min() >= 0.5
    assert_allclose(mesh.volumes.sum(), shapely.Polygon(dumbbell(width)).area, rtol=0.02)


@pytest.mark.parametrize("width", [6.0, 3.0, 1.5, 1.0])
def test_narrow_fjord_is_not_bridged(width):
    fjord = shapely.LineString([[0, 0], [0, 80]]).buffer(width / 2, 32)
    outline = shapely.get_coordinates(shapely.Polygon(disc()).difference(fjord).exterior)[:-1]
    mesh = distmesh(outline, 3.0)
    assert_disc(mesh)
    assert shapely.Polygon(mesh.outline).is_valid
    assert_allclose(mesh.volumes.sum(), shapely.Polygon(outline).area, rtol=0.02)


def test_round_finger_is_followed_to_its_end():
    """The end of a finger, of radius .55 h, is no corner; an edge of length h could cut off .32 h of it."""
    for length in (41.0, 42.0, 43.0, 44.0):
        finger = shapely.LineString([[0, 0], [length, 0]]).buffer(1.65, 32)
        outline = shapely.get_coordinates(shapely.Polygon(disc(30)).union(finger).exterior)[:-1]
        mesh = distmesh(outline, 3.0)
        rings = shapely.LinearRing(outline), shapely.LinearRing(mesh.outline)
        assert shapely.hausdorff_distance(*(shapely.segmentize(ring, 0.1) for ring in rings)) < 0.25 * 3.0
        assert_disc(mesh)


@pytest.mark.parametrize("width", [0.3, 0.1])
def test_shores_of_a_slit_never_cross(width):
    """Nodes that slide along both shores of a crooked slit far thinner than the elements leave the boundary simple."""
    x = np.linspace(-10, 60, 60)
    for bend in (3.0, 5.0, 7.0):
        slit = shapely.LineString(np.stack([x, 4 * np.sin(x / bend)], axis=1)).buffer(width / 2)
        outline = shapely.get_coordinates(shapely.Polygon(disc(40, 90)).difference(slit).exterior)[:-1]
        mesh = distmesh(outline, 5.0)
        assert shapely.Polygon(mesh.outline).is_valid
        assert_disc(mesh)


def test_detail_too_fine_is_refused_with_its_place():
    with pytest.raises(XfemnavError, match=r"E208 .*near \(-?[0-3]?[0-9]\.\d, -?0\.\d\) mm"):
        distmesh(dumbbell(0.05), 6.0)


def test_corner_too_sharp_is_refused_with_its_place():
    with pytest.raises(XfemnavError, match=r"E208 .*near \(\d+\.\d, \d\.\d\) mm"):
        distmesh(np.array([[0, 0], [100.0, 0], [100, 10]]), 3.0)


@pytest.mark.parametrize("h, hint", [(0.2, "larger"), (0.01, "larger"), (1e-6, "larger"), (60.0, "smaller")])
def test_sizes_that_do_not_fit_are_refused_at_once(h, hint):
    start = time.perf_counter()
    with pytest.raises(XfemnavError, match=f"E207 .*{hint}"):
        distmesh(disc(), h)
    assert time.perf_counter() - start < 5  # no mesh was begun: that would take minutes and gigabytes


def test_nodes_that_no_estimate_foresaw_are_refused(monkeypatch):
    """A focus of 1e-6 mm between the points where the estimate samples the size: it misses most of the nodes there."""
    size = SizeField(10.0, focus=(((0.2, 0.1), 1e-6),))
    monkeypatch.setattr("xfemnav.geometry.plane.distmesh.MOST_NODES", int(expected_nodes(disc(), size)) + 1)
    with pytest.raises(XfemnavError, match=r"E207 .*steeper growth"):
        distmesh(disc(), size)


@pytest.mark.parametrize("outline", [[[0, 0], [2, 2], [2, 0], [0, 2]], [[0, 0], [1, 1]], [[0, 0], [1, 0], [np.nan, 1]],
                                     [[0, 0], [5, 0], [9, 0]]])
def test_outlines_without_an_inside_are_refused(outline):
    with pytest.raises(XfemnavError, match="E208"):
        distmesh(np.array(outline, float), 0.2)


def battery(seeds):
    """Quality (k, 2) minimum and mean of the meshes of random masks; topology is checked on the way."""
    figures = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        mask, spacing = random_mask(rng, KINDS[seed % len(KINDS)])
        outline = outline_of(ndimage.binary_fill_holes(mask), (0.0, 0.0), spacing)
        h = np.sqrt(shapely.Polygon(outline).area / 10 ** rng.uniform(1.8, 3.5))
        mesh = distmesh(outline, h)
        assert_disc(mesh)
        figures.append((mesh.quality.min(), mesh.quality.mean()))
    return np.array(figures)


@pytest.mark.filterwarnings("ignore:W207")  # outline_of leaves loose parts out, as it should
def test_random_masks():
    quality = battery(range(40))
    assert quality[:, 0].min() >= 0.5 and quality[:, 1].min() >= 0.95


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:W207")
def test_two_hundred_random_masks():
    quality = battery(range(1000, 1200))
    assert quality[:, 0].min() >= 0.5 and quality[:, 1].min() >= 0.95
