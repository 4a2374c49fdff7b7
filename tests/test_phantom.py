"""The phantom: its scene and motion are what they say, its truth is true, its files say the same."""

from itertools import permutations, product

import nibabel as nib
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.ndimage import distance_transform_edt

from benchmarks.probes import sample
from data_synthetic import domains, files
from data_synthetic.fields import frame
from data_synthetic.phantom import (
    BRAIN,
    CSF,
    GM,
    GRIDS,
    LENGTH,
    MOUTH,
    OPEN,
    TIP,
    TRAVEL,
    TUMOUR,
    VENTRICLE,
    WM,
    Grid,
    Phantom,
    boundary_displacement,
    cut_path,
    landmarks,
    outline,
    perfect_solution,
    side_of,
)
from xfemnav.geometry.mesh import orient
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.warp import covered, pull_back, update


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return Phantom()


@pytest.fixture(scope="module")
def solution(phantom):
    return perfect_solution(phantom)


def brain_points(n=2000, seed=0) -> np.ndarray:
    p = np.random.default_rng(seed).uniform(-86, 86, (n, 2))
    return p[np.isin(Phantom().labels_at(p), BRAIN)]


def local(points) -> np.ndarray:
    """Coordinates (n, 2) of the cut: along TRAVEL from the tip, and to its left."""
    return (points - TIP) @ frame(TRAVEL).T


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_areas(grid):
    labels = Phantom(grid=grid).labels
    pixel = np.prod(grid.spacing)
    # Counting pixel centres in a convex region errs by some (perimeter / spacing)^(2/3) pixels; 2 % of the small ones.
    assert np.isin(labels, BRAIN).sum() * pixel == pytest.approx(np.pi * 68 * 84, rel=1e-3)
    assert (labels == VENTRICLE).sum() * pixel == pytest.approx(2 * np.pi * 5 * 18, rel=0.025)
    assert (labels == TUMOUR).sum() * pixel == pytest.approx(np.pi * 11**2, rel=0.025)
    assert set(np.unique(labels)) == set(range(8))


def test_the_outline_is_the_mask_and_starts_at_the_mouth(phantom):
    loop = outline()
    assert domains.area(loop) == pytest.approx(phantom.mask.sum() * 0.64, rel=1e-3)
    assert_allclose(loop[0], MOUTH)
    assert_allclose(MOUTH, [56.508, 48.877], atol=1e-3)      # 1.065 mm beyond the entry point
    assert np.isin(phantom.labels_at(loop * 0.999), BRAIN).all() and (phantom.labels_at(loop * 1.001) == CSF).all()


def test_the_cut():
    assert_allclose(TIP, [25.449, 22.013], atol=1e-3)
    assert_allclose(TRAVEL, [-0.7563, -0.6542], atol=1e-4)
    start, end = cut_path()
    assert not np.isin(Phantom().labels_at([start]), BRAIN).any()
    assert_allclose(end, TIP)
    assert local(np.array([[40.0, 20.0]]))[0, 1] > 0 and side_of([[40.0, 20.0]]) == 1    # left is towards lower y here


@pytest.mark.parametrize("tumour, label", [("beside", GM), ("crossed", TUMOUR)])
def test_only_the_second_tumour_is_crossed(tumour, label):
    along = TIP - np.linspace(0, LENGTH, 400)[:, None] * TRAVEL
    met = set(np.unique(Phantom(tumour).labels_at(along)))
    assert met == {GM, WM} | {label}


def test_the_motion():
    """The opening is 6 sqrt(s / 40) at s from the tip; the largest and mean motion, and a divergence, as published."""
    s = np.array([1.0, 10.0, 40.0])
    lips = TIP - s[:, None] * TRAVEL
    jump = OPEN.displacement(lips, 1) - OPEN.displacement(lips, -1)
    assert_allclose(jump @ frame(TRAVEL)[1], 6 * np.sqrt(s / 40), rtol=1e-12)
    points = brain_points()
    size = np.linalg.norm(Phantom().displacement(points), axis=1)
    assert size.max() < 3.1 and size.mean() == pytest.approx(1.10, abs=0.03)    # of 1,500 random places
    G = OPEN.gradient(points)
    assert np.trace(OPEN.gradient(np.array([[20.0, -30.0]]))[0]) == pytest.approx(0.00554, abs=5e-6)
    X, Y = local(points).T
    smooth = (np.hypot(X, Y) > 1) & (np.abs(np.arctan2(Y, X)) < 3)
    assert np.linalg.det(np.eye(2) + G)[smooth].min() >= 1.0


@pytest.mark.parametrize("motion", ["open", "retract", "rigid"])
def test_resting_places_invert_the_motion(motion):
    phantom, points = Phantom(motion=motion), brain_points()
    assert_allclose(phantom.resting_places(points + phantom.displacement(points)), points, atol=1e-9)


def test_one_face_of_the_retraction_stays_at_the_mouth():
    field, entry = Phantom(motion="retract").motion_field, (TIP - LENGTH * TRAVEL)[None]
    assert_allclose(field.displacement(entry, -1), 0, atol=1e-12)
    assert_allclose(np.linalg.norm(field.displacement(entry, 1)), 6, rtol=1e-12)


def test_the_wedge_is_as_wide_as_the_opening(phantom):
    """166.4 mm2 = integral of 6 sqrt(s / 40) over the cut's 41.065 mm."""
    wide, _ = quad(lambda s: 6 * np.sqrt(s / 40), 0, np.linalg.norm(MOUTH - TIP))
    assert wide == pytest.approx(166.4, abs=0.05)
    X, Y = np.moveaxis(local(phantom.grid.centres()), -1, 0)
    wedge = phantom.truth.cavity & (np.abs(Y) < 3.1) & (X < 0)
    # centres are counted: half a pixel's side (.4 mm) along the mouth's 6 mm at either end
    assert wedge.sum() * 0.64 == pytest.approx(wide, abs=2.5)


def test_truth_holds_each_pixel_once(phantom):
    truth = phantom.truth
    tissue = np.isfinite(truth.places[..., 0])
    assert not (truth.cavity & tissue).any()
    assert (truth.labels[truth.cavity] == 0).all()
    assert_array_equal(np.isin(truth.labels, BRAIN), tissue)
    still = ~tissue & ~phantom.mask
    assert_array_equal(truth.labels[still], phantom.labels[still])


def test_a_rigid_head_has_a_rotated_truth():
    phantom = Phantom(motion="rigid")
    angle = np.radians(-5)
    back = phantom.grid.centres() @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    places = phantom.truth.places
    tissue = np.isfinite(places[..., 0])
    assert_allclose(places[tissue], back[tissue], atol=1e-9)


def test_noise_is_rician_and_repeats(phantom):
    image = phantom.image(3)
    assert_array_equal(image, phantom.image(3))
    air = image[phantom.grid.centres()[..., 0] < -95]
    # Rayleigh: mean sigma sqrt(pi / 2), its standard error .66 sigma / sqrt(n)
    assert air.mean() == pytest.approx(20 * np.sqrt(np.pi / 2), abs=4 * 0.66 * 20 / np.sqrt(air.size))
    assert (image - phantom.image())[phantom.labels == WM].std() == pytest.approx(20, rel=0.05)


def test_contrasts_differ_in_the_tumour_only(phantom):
    points = brain_points()
    flair = Phantom(contrast="flair")
    other = phantom.intensity_at(points) != flair.intensity_at(points)
    assert_array_equal(other, phantom.labels_at(points) == TUMOUR)


def test_boundary_table_has_both_ends_of_the_mouth(phantom):
    table = boundary_displacement(phantom)
    assert_allclose(table[[0, -1], :2], [MOUTH, MOUTH])
    assert_array_equal(table[[0, -1], 4], [-1, 1])
    opening = (table[-1, 2:4] - table[0, 2:4]) @ frame(TRAVEL)[1]
    assert opening == pytest.approx(6 * np.sqrt(np.linalg.norm(MOUTH - TIP) / 40), rel=1e-12)
    assert_array_equal(table[1:-1, 4], side_of(table[1:-1, :2]))


def test_the_perfect_solution_tiles_the_brain(solution):
    rest, moved = solution
    assert (orient(*rest.swapaxes(0, 1)) > 0).all() and (orient(*moved.swapaxes(0, 1)) > 0).all()
    assert orient(*rest.swapaxes(0, 1)).sum() / 2 == pytest.approx(domains.area(outline()), rel=1e-12)


@pytest.fixture(scope="module")
def warped(phantom, solution):
    grid, (rest, moved) = phantom.grid, solution
    pulled = pull_back(rest, moved, grid.origin, grid.spacing, grid.shape)
    organ = covered(rest, grid.origin, grid.spacing, grid.shape)
    return {interp: update(image, organ, pulled, interp)
            for interp, image in (("linear", phantom.image()), ("nearest", phantom.labels))}


def test_warping_along_the_exact_motion_gives_the_true_image(phantom, warped):
    truth, result = phantom.truth, warped["linear"]
    assert (result.cavity != truth.cavity).sum() < 0.02 * truth.cavity.sum()
    tissue = np.isfinite(truth.places[..., 0])
    places = np.where(tissue[..., None], truth.places, 0).reshape(-1, 2)
    kinds = np.where(tissue, phantom.intensity_at(places).reshape(tissue.shape), -1)
    edge = np.zeros(kinds.shape, bool)
    for axis in (0, 1):
        edge |= (np.diff(kinds, axis=axis, prepend=-9) != 0) | (np.diff(kinds, axis=axis, append=-9) != 0)
    inner = tissue & (distance_transform_edt(~edge) > 2)
    error = (result.updated - truth.image)[inner]
    assert inner.sum() > 0.5 * tissue.sum()
    assert np.sqrt(np.mean(error**2)) < 0.01 * truth.image[inner].mean()
    assert (result.updated[result.cavity] == 0).all()


def test_warped_labels_overlap_as_well_as_the_exact_maps(phantom, warped):
    truth, grid = phantom.truth, phantom.grid
    exact = np.where(np.isfinite(truth.places[..., 0]),
                     sample(phantom.labels, grid.origin, grid.spacing, truth.places, "nearest"), truth.labels)

    def dice(labels, label):
        a, b = labels == label, truth.labels == label
        return 2 * (a & b).sum() / (a.sum() + b.sum())

    for label in BRAIN:
        assert dice(warped["nearest"].updated, label) == pytest.approx(dice(exact, label), abs=0.005)
        assert dice(exact, label) > 0.94


def test_landmarks_are_carried_to_their_true_places(phantom, solution):
    motion = Motion(*solution, cuts=(np.array([MOUTH, TIP]),))
    rest = landmarks()
    assert len(rest) == 20 and np.isin(phantom.labels_at(rest), BRAIN).all()
    assert np.abs(local(rest)[local(rest)[:, 0] < 0, 1]).min() > 2
    current = rest + phantom.displacement(rest)
    # triangles of about 1 mm at 40 mm from the tip: h^2 / 8 |u''| < 1e-3 mm
    assert_allclose(motion.to_current(rest), current, atol=1e-3)
    assert_allclose(motion.to_preoperative(current), rest, atol=1e-3)
    lips = TIP - np.array([[5.0], [20.0], [39.0]]) * TRAVEL
    for side in (1, -1):
        assert_allclose(motion.displacement(lips, side), OPEN.displacement(lips, side), atol=1e-3)


ORDERS = ["".join(axes[k] for axes, k in zip([("LR", "PA", "IS")[a] for a in order], signs))
          for order in permutations(range(3)) for signs in product((0, 1), repeat=3)]


def test_all_48_storage_orders_hold_the_same_slice():
    assert len(set(ORDERS)) == 48
    values = np.arange(12.0).reshape(3, 4)
    for order in ORDERS:
        image = files.to_nifti(values, Grid((3, 4), (1.0, 0.8), order), oblique=30)
        assert "".join(nib.aff2axcodes(image.affine)) == order
        back = nib.as_closest_canonical(image)
        assert_array_equal(back.get_fdata()[:, :, 0], values)
        place = Grid((3, 4), (1.0, 0.8)).origin + np.array([2, 2.4])
        # A turn about the R axis changes no plane coordinate: (p.e1, p.e2) of pixel (2, 3) is still its place.
        world = back.affine @ [2, 3, 0, 1]
        assert_allclose(world[:3] @ files.turned(30)[:, :2], place, atol=1e-12)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    small = Grid((50, 65), (4.0, 3.2), "LAS", slope=0.05)
    path = tmp_path_factory.mktemp("phantom")
    return Phantom(grid=small), path, files.write(Phantom(grid=small), path, seed=1)


def test_files_hold_what_the_phantom_says(folder):
    phantom, _, paths = folder
    image = nib.load(paths["image"])
    assert "".join(nib.aff2axcodes(image.affine)) == "LAS" and image.get_data_dtype() == np.int16
    assert_allclose(image.get_fdata()[::-1, :, 0], phantom.image(1), atol=0.0251)    # half of the slope, float32
    assert_array_equal(nib.load(paths["mask"]).get_fdata()[::-1, :, 0], phantom.mask)
    assert_array_equal(nib.load(paths["truth_labels"]).get_fdata()[::-1, :, 0], phantom.truth.labels)
    field = nib.load(paths["truth_field"]).get_fdata()[::-1, :, 0]
    tissue = np.isfinite(phantom.truth.places[..., 0])
    assert_allclose((field + phantom.grid.centres())[tissue], phantom.truth.places[tissue], atol=1e-5)
    assert_allclose(np.loadtxt(paths["boundary"], delimiter=",", skiprows=1), boundary_displacement(phantom), atol=1e-9)


def test_files_are_the_same_bytes_every_time(folder, tmp_path):
    phantom, first, paths = folder
    for role, path in files.write(phantom, tmp_path, seed=1).items():
        assert path.read_bytes() == paths[role].read_bytes(), role
        assert path.relative_to(tmp_path) == paths[role].relative_to(first)


def test_the_markup_is_the_cut_in_lps():
    points = files.markup(cut_path())["markups"][0]["controlPoints"]
    assert_allclose([p["position"] for p in points], np.column_stack([-cut_path(), [0, 0]]), atol=1e-8)


def test_named_outlines_run_counter_clockwise():
    assert domains.area(domains.disc(70, 3600)) == pytest.approx(np.pi * 70**2, rel=1e-5)
    assert domains.area(domains.ellipse(n=3600)) == pytest.approx(np.pi * 68 * 84, rel=1e-5)
    assert domains.area(domains.rectangle(3, 5, (1, 1))) == 15
    assert domains.area(domains.gyrated()) == pytest.approx(np.pi * (60**2 + 6**2 / 2), rel=1e-3)
    two_discs, bridge = 2 * np.pi * 20**2, 8 * 20
    assert domains.area(domains.dumbbell()) == pytest.approx(two_discs + bridge, rel=0.02)
