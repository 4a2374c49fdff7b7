"""The pull-back: exact maps, every pixel once, cavities where the tissue has left, values and labels kept."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay

from benchmarks.probes import sample
from data_synthetic.domains import area, disc, gyrated
from xfemnav.geometry.mesh import orient
from xfemnav.imaging.carrying.warp import covered, enclosed, pull_back, update

# Pixel centres over [-30, 30] x [-40, 40] mm.
ORIGIN, SPACING, SHAPE = np.array([-30.0, -40.0]), np.array([1.0, 0.8]), (61, 101)


def centres(origin=ORIGIN, spacing=SPACING, shape=SHAPE) -> np.ndarray:
    return origin + np.moveaxis(np.indices(shape), 0, -1) * spacing


def positive(corners) -> np.ndarray:
    """The triangles (t, 3, 2) that are not flat, each turning left."""
    twice = orient(*corners.swapaxes(0, 1))
    return np.where((twice > 0)[:, None, None], corners, corners[:, ::-1])[np.abs(twice) > 1e-9]


def tiling(points) -> np.ndarray:
    """Delaunay triangles (t, 3, 2) of points (n, 2)."""
    return positive(points[Delaunay(points).simplices])


def scattered(seed, n=400) -> np.ndarray:
    """Triangles (t, 3, 2) that tile the rectangle [-25, 25] x [-35, 35]."""
    corners = np.array([[-25.0, -35], [25, -35], [25, 35], [-25, 35]])
    return tiling(np.concatenate([corners, np.random.default_rng(seed).uniform(-1, 1, (n, 2)) * (25, 35)]))


def pulled(rest, moved):
    return pull_back(rest, moved, ORIGIN, SPACING, SHAPE)


def within_rectangle(points) -> np.ndarray:
    """Whether points (..., 2) are in the rectangle of `scattered`; those on its outline, but for rounding, are."""
    return (np.abs(points) <= np.array([25, 35]) + 1e-9).all(axis=-1)


@pytest.mark.parametrize("seed", range(3))
def test_an_affine_motion_is_exact(seed):
    A, b = np.array([[0.9, 0.15], [-0.1, 1.05]]), np.array([2.3, -1.1])
    rest = scattered(seed)
    result = pulled(rest, rest @ A.T + b)
    exact = (centres() - b) @ np.linalg.inv(A).T
    # Delaunay's flattest triangles here are 1e-2 mm high: 40 mm x 1e-16 / 1e-2, twice over
    assert_allclose(result.resting[result.tissue], exact[result.tissue], atol=1e-11)
    assert_array_equal(result.tissue, within_rectangle(exact))
    assert_allclose(result.field[result.tissue], (exact - centres())[result.tissue], atol=1e-11)
    assert (result.field[~result.tissue] == 0).all()
    # F is a quotient of differences: rounding of 40 mm over triangles 1e-2 mm high
    assert_allclose(result.F, np.broadcast_to(A, result.F.shape), atol=1e-11)
    assert_array_equal([result.box.min(axis=0), result.box.max(axis=0)],
                       [f(result.resting, axis=(0, 1)) for f in (np.nanmin, np.nanmax)])
    assert_array_equal(result.places, np.where(result.tissue[..., None], result.resting, centres()))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 300), snapped=st.booleans())
def test_every_pixel_of_a_conforming_mesh_is_in_one_triangle(seed, n, snapped):
    """Also when corners and edges lie on pixel centres, and the corners of neighbours differ by rounding."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([np.array([[-25.0, -35.2], [25, -35.2], [25, 35.2], [-25, 35.2]]),
                             rng.uniform(-1, 1, (n, 2)) * (25, 35)])
    if snapped:
        points = np.unique(np.round((points - ORIGIN) / SPACING) * SPACING + ORIGIN, axis=0)
    rest = tiling(points)
    moved = rest * (1 + rng.choice([-1, 0, 1], rest.shape) * 2.0**-52)
    result = pulled(rest, moved)
    inside = (np.abs(centres()) <= np.array([25, 35.2]) + 1e-9).all(axis=-1)
    assert_array_equal(result.tissue, inside)
    assert_array_equal(result.count, inside)
    assert not result.folded.any()
    assert_allclose(result.resting[inside], centres()[inside], atol=1e-6)


def test_a_hanging_corner_leaves_no_hole():
    """Two small triangles meet a large one along its edge, whose middle is no corner of the large one."""
    a, b, c, d = np.array([[-20.0, -30], [17, 31], [-21, 29], [22, -28]])
    middle = a + 0.37 * (b - a)
    rest = positive(np.array([[a, b, c], [a, middle, d], [middle, b, d]]))
    whole = positive(np.array([[a, b, c], [a, b, d]]))
    assert_array_equal(pulled(rest, rest).count, covered(whole, ORIGIN, SPACING, SHAPE))


def test_tissue_at_rest_keeps_its_values_to_the_last_bit():
    rest = scattered(5)
    image = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32).astype(float)
    for interp in ("linear", "nearest"):
        result = update(image, covered(rest, ORIGIN, SPACING, SHAPE), pulled(rest, rest), interp)
        assert_array_equal(result.updated, image)
        assert not result.cavity.any() and not result.overlap.any()


def wedge(opening: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A disc of radius 24 cut along x = 0 from its top to its middle, opened there by `opening` mm at the rim.

    Rest and moved triangles (t, 3, 2), and the corners (3, 2) of the gap.
    """
    rim = disc(24.0, 96)
    fan = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1, axis=0)], axis=1)
    rings = [s * fan for s in (0.25, 0.5, 0.75, 1.0)]
    quads = [np.concatenate([np.stack([i[:, 1], o[:, 1], o[:, 2]], 1), np.stack([i[:, 1], o[:, 2], i[:, 2]], 1)])
             for i, o in zip(rings, rings[1:])]
    rest = np.concatenate([rings[0], *quads])
    moved = rest.copy()
    pull = opening / 2 * np.clip(rest[..., 1], 0, None) / 24
    moved[..., 0] += np.where(rest[..., 0].mean(axis=1, keepdims=True) > 0, pull, -pull)
    return rest, moved, np.array([[0, 0], [opening / 2, 24], [-opening / 2, 24]])


@pytest.mark.parametrize("opening", [3.0, 6.0, 9.0])
def test_the_cavity_is_the_gap(opening):
    rest, moved, gap = wedge(opening)
    fine = dict(origin=np.array([-29.95, -29.95]), spacing=np.array([0.1, 0.1]), shape=(600, 600))
    result = update(np.ones((600, 600)), covered(rest, **fine),
                    pull_back(rest, moved, **fine), fill=-7)
    x, y = np.moveaxis(centres(**fine), -1, 0)
    inside = result.cavity & (np.abs(x) < opening / 2)
    # a pixel belongs by its centre: off by half a pixel's width (.05 mm) along the outline (2 x 24 mm) at the very most
    assert inside.sum() * 0.01 == pytest.approx(area(gap), abs=0.05 * 48)
    assert (result.updated[inside] == -7).all()
    in_gap = (y > 0) & (y < 23.5) & (np.abs(x) < opening / 2 * y / 24 - 1e-9)
    assert result.cavity[in_gap].all()
    assert not (result.cavity & (y < 0)).any()


def test_slivers_between_mask_and_mesh_are_no_cavity():
    """A pixel outside the mesh's chords keeps its value, though a round mask would hold it."""
    rim = disc(24.0, 12)
    rest = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1, axis=0)], axis=1)
    image = np.random.default_rng(0).uniform(1, 2, SHAPE)
    result = update(image, covered(rest, ORIGIN, SPACING, SHAPE), pulled(rest, rest))
    assert not result.cavity.any()
    assert_array_equal(result.updated, image.astype(np.float32))


def test_an_outline_encloses_what_its_triangles_cover():
    for loop in (disc(24.0, 37, centre=(3.3, -2.1)), gyrated(20.0, 5.0, 7, 300) + np.array([25.0, 0.3])):
        middle = loop.mean(axis=0)
        fan = np.stack([np.broadcast_to(middle, loop.shape), loop, np.roll(loop, -1, axis=0)], axis=1)
        assert_array_equal(enclosed(loop, ORIGIN, SPACING, SHAPE), covered(fan, ORIGIN, SPACING, SHAPE))
        assert_array_equal(enclosed(loop[::-1], ORIGIN, SPACING, SHAPE), enclosed(loop, ORIGIN, SPACING, SHAPE))


def test_a_loop_that_crosses_itself_encloses_what_it_goes_around_once():
    bow_tie = np.array([[-20.5, -20.2], [20.5, 20.2], [20.5, -20.2], [-20.5, 20.2]])
    x, y = np.moveaxis(centres(), -1, 0)
    inside = (np.abs(x) < 20.5) & (np.abs(y) < np.abs(x) * 20.2 / 20.5)
    assert_array_equal(enclosed(bow_tie, ORIGIN, SPACING, SHAPE), inside)


def test_what_the_outline_draws_back_from_is_vacated_and_no_cavity():
    rest, moved, gap = wedge(6.0)
    rim = disc(24.0, 96)
    rim[:, 0] += 3.0 * np.sign(rim[:, 0]) * np.clip(rim[:, 1], 0, None) / 24
    now = np.concatenate([rim[:24], gap[1:], rim[25:]])    # corner 24 is the mouth: two ends and a straight bridge
    shrink = np.array([1.0, 0.9])
    moved, now = moved * shrink, now * shrink
    result = update(np.ones(SHAPE), covered(rest, ORIGIN, SPACING, SHAPE), pulled(rest, moved),
                    now=enclosed(now, ORIGIN, SPACING, SHAPE), fill=-1)
    y = centres()[..., 1]
    assert not (result.cavity & result.vacated).any()
    assert not result.cavity[(y < 0) | (y > 21.7)].any() and result.vacated[y < -21.7].any()
    assert result.cavity.sum() * 0.8 == pytest.approx(area(gap) * 0.9, abs=0.5 * 48)    # half a pixel along the lips
    assert (result.updated[result.cavity | result.vacated] == -1).all()


def test_resected_tissue_leaves_a_cavity_that_moves_with_the_rest():
    rest = scattered(3)
    kept = np.linalg.norm(rest.mean(axis=1), axis=1) > 8
    image = np.ones(SHAPE)
    result = update(image, covered(rest, ORIGIN, SPACING, SHAPE), pulled(rest[kept], rest[kept]))
    assert_array_equal(result.cavity, covered(rest, ORIGIN, SPACING, SHAPE) & ~pulled(rest[kept], rest[kept]).tissue)
    assert result.cavity[30, 50] and result.updated[30, 50] == 0


def test_outside_is_kept_or_zero():
    rest = scattered(0)
    organ = covered(rest, ORIGIN, SPACING, SHAPE)
    image = np.full(SHAPE, 5.0)
    result = pulled(rest, rest)
    assert (update(image, organ, result).updated == 5).all()
    assert_array_equal(update(image, organ, result, outside="zero").updated, 5.0 * organ)


def test_tissue_that_moves_out_of_the_outline_is_painted_over_the_outside():
    rest = scattered(0)
    result = update(np.arange(61.0)[:, None] * np.ones(SHAPE), covered(rest, ORIGIN, SPACING, SHAPE),
                    pulled(rest, rest + np.array([3.0, 0.0])))
    assert_allclose(result.updated[8:59, 50], np.arange(5, 56), atol=1e-5)
    assert result.cavity[5:8, 50].all() and result.updated[5:8, 50].max() == 0


def test_overlap_is_counted_and_both_lips_are_there():
    rest, moved, _ = wedge(-4.0)
    result = pulled(rest, moved)
    x, y = np.moveaxis(centres(), -1, 0)
    in_gap = (np.abs(x) < 2 * y / 24 - 1e-3) & (y < 22)
    assert (result.count[in_gap] == 2).all()
    assert (result.count[(np.abs(x) > 2 * y / 24 + 1e-3) & (np.hypot(x, y) < 20)] == 1).all()
    assert not result.folded.any()


def test_folded_triangles_are_told_apart():
    """A corner pulled through the edges about it: the sheet covers twice upright where it does once inside out."""
    s = np.linspace(-20.0, 20.0, 9)
    points = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1).reshape(-1, 2)
    cells = Delaunay(points + np.random.default_rng(0).normal(0, 0.1, points.shape)).simplices
    rest = positive(points[cells])
    middle = np.linalg.norm(rest, axis=-1) < 1e-9
    moved = rest + middle[..., None] * np.array([7.0, 0.3]) + np.array([0.1234, 0.0567])    # edges off pixel centres
    assert (orient(*moved.swapaxes(0, 1)) < 0).any()
    result = pulled(rest, moved)
    inner = (np.abs(centres()) < 19).all(axis=-1)
    # The covering degree, upright minus inside out, belongs to the boundary's motion: 1 everywhere inside.
    assert (result.count.astype(int) - result.folded == 1)[inner].all()
    assert_array_equal(result.overlap, result.folded > 0)
    assert result.folded.sum() * 0.8 == pytest.approx(-np.minimum(orient(*moved.swapaxes(0, 1)), 0).sum() / 2, rel=0.1)


def test_labels_stay_in_their_set_and_type():
    rest = scattered(1)
    labels = np.random.default_rng(0).choice([0, 3, 17, 2**30 + 1], SHAPE).astype(np.int32)
    moved = rest + 0.4 * np.sin(rest[..., ::-1] / 5)
    result = update(labels, covered(rest, ORIGIN, SPACING, SHAPE), pulled(rest, moved), "nearest")
    assert result.updated.dtype == np.int32
    assert set(np.unique(result.updated)) <= set(np.unique(labels))


@pytest.mark.parametrize("interp", ["linear", "cubic", "nearest"])
def test_the_order_of_an_array_in_memory_changes_nothing(interp):
    rest = scattered(0)
    organ, motion = covered(rest, ORIGIN, SPACING, SHAPE), pulled(rest, rest + np.array([3.2, 1.1]))
    image = np.random.default_rng(0).normal(size=SHAPE)
    for same in (np.asfortranarray(image), image[::-1].copy()[::-1]):
        assert_array_equal(update(same, organ, motion, interp).updated,
                           update(image, organ, motion, interp).updated)


@pytest.mark.parametrize("interp", ["linear", "nearest"])
def test_a_pixel_centre_has_its_own_value_to_the_last_bit(interp):
    origin, spacing = np.array([-30.1, 17.3]), np.array([0.7, 0.3])    # (x - origin) / spacing is rounded here
    image = np.random.default_rng(0).normal(size=SHAPE)
    assert_array_equal(sample(image, origin, spacing, centres(origin, spacing), interp), image)


def test_linear_sampling_reproduces_linear_images_and_cubic_reproduces_smooth_ones():
    points = np.random.default_rng(0).uniform((-30, -40), (30, 40), (2000, 2))
    plane = centres() @ np.array([0.3, -0.7]) + 2
    assert_allclose(sample(plane, ORIGIN, SPACING, points), points @ np.array([0.3, -0.7]) + 2, atol=1e-12)
    points = points[np.abs(points / (30, 40)).max(axis=1) < 0.8]    # the spline's end condition fades out by there
    wave = np.sin(centres()[..., 0] / 6) * np.cos(centres()[..., 1] / 7)
    exact = np.sin(points[:, 0] / 6) * np.cos(points[:, 1] / 7)
    errors = {interp: np.abs(sample(wave, ORIGIN, SPACING, points, interp) - exact).max()
              for interp in ("linear", "cubic")}
    # h^2 / 8 |f''| and, for the cubic spline, h^4 / 384 |f''''| in each axis, with the derivatives of the wave
    assert errors["linear"] < (1 / 6**2 + 0.8**2 / 7**2) / 8
    assert errors["cubic"] < 2 * (1 / 6**4 + 0.8**4 / 7**4) / 384
    assert_allclose(sample(wave, ORIGIN, SPACING, centres(), "cubic"), wave, atol=1e-9)


@pytest.mark.parametrize("interp", ["linear", "cubic", "nearest"])
def test_beyond_the_image_its_edge_goes_on(interp):
    image = np.random.default_rng(0).normal(size=SHAPE)
    corner = sample(image, ORIGIN, SPACING, np.array([[-99.0, -99.0], [99.0, 99.0]]), interp)
    assert_allclose(corner, [image[0, 0], image[-1, -1]], atol=1e-6)


def test_points_without_tissue_have_no_value():
    image = np.ones(SHAPE)
    points = np.array([[np.nan, np.nan], [0.0, 0.0]])
    assert_array_equal(sample(image, ORIGIN, SPACING, points), [np.nan, 1])
    assert_array_equal(sample(image, ORIGIN, SPACING, points, "nearest"), [0, 1])
    with pytest.raises(ValueError, match="linear, cubic or nearest"):
        sample(image, ORIGIN, SPACING, points, "quintic")


def test_a_triangle_without_area_deforms_nothing():
    flat = np.array([[[0.0, 0], [1, 1], [2, 2]]])
    assert_array_equal(pulled(flat, 2 * flat).F, [np.eye(2)])


def test_triangles_beyond_the_grid_do_no_harm():
    rest = scattered(0)
    result = pull_back(rest, rest * 50, ORIGIN, SPACING, SHAPE)
    assert_allclose(result.resting, centres() / 50, atol=1e-12)
    none = pull_back(rest, rest + 1000, ORIGIN, SPACING, SHAPE)
    assert not none.tissue.any() and none.box.shape == (0, 2)
