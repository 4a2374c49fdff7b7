"""A phantom whose exact motion is known, through the whole pipeline: mask, measured outline, free lips, warp.

The phantom is noise-free and its displacement (the mode-I field of a crack, 6 mm open at the surface) is prescribed on
the outline only; everything inside is the program's. Bounds: what a navigator needs, or what a perfect map would give.
"""

import json

import nibabel as nib
import numpy as np
import pytest
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

import xfemnav
from benchmarks.probes import sample
from benchmarks.verification import plane
from data_synthetic import files
from data_synthetic.phantom import (
    BRAIN,
    GRIDS,
    MOUTH,
    OPEN,
    POISSON,
    TIP,
    TRAVEL,
    TUMOUR,
    TUMOURS,
    WM,
    Phantom,
    boundary_displacement,
    cut_path,
    landmarks,
    outline,
)
from tests.meshes import posed
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.imaging.carrying.warp import pull_back
from xfemnav.mechanics.rules import Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.space.quadrature import tip_rule
from xfemnav.mechanics.tissue.elasticity import Material


def run_phantom(grid, folder, scale=None):
    """The updated phantom on one grid, its intensities on another `scale`: Phantom, Result."""
    phantom = Phantom(grid=GRIDS[grid])
    paths = files.write(phantom, folder)
    if scale is not None:
        image = nib.load(paths["image"])
        scaled = nib.Nifti1Image(scale(image.get_fdata()).astype(np.float32), image.affine)
        nib.save(scaled, paths["image"])
    result = xfemnav.run(
        paths["image"], mask=paths["mask"], cut=cut_path(), boundary_displacement=paths["boundary"],
        companion=(f"label={paths['labels']}", f"continuous={paths['image']}"), report=False,
        output=folder / "out", cache=folder / "cache",
    )
    return phantom, result


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The phantom on its first grid."""
    return run_phantom("A", tmp_path_factory.mktemp("phantom"))


@pytest.fixture(scope="module")
def resting(run):
    """Resting places (n1, n2, 2) mm of the pixels, by the program."""
    phantom, result = run
    grid = phantom.grid
    origin, spacing = grid.centres()[0, 0], np.asarray(grid.spacing)
    return pull_back(result.motion.rest, result.motion.moved, origin, spacing, grid.shape), origin, spacing


def test_landmarks_arrive(run):
    """Target registration error at 20 landmarks: a tenth of the .3 mm that a navigator could notice."""
    phantom, result = run
    error = result.to_current(landmarks()) - (landmarks() + phantom.displacement(landmarks()))
    assert np.linalg.norm(error, axis=1).max() < 0.03


def test_points_go_both_ways(run):
    """Forward then back is the identity off the lips, to the rounding of the stored triangles."""
    _, result = run
    assert np.allclose(result.to_preoperative(result.to_current(landmarks())), landmarks(), atol=1e-6)


def dice(a, b):
    """Dice overlap of two masks."""
    return 2 * (a & b).sum() / (a.sum() + b.sum())


def test_labels_are_as_good_as_the_exact_map_can_make_them(run, resting):
    """Every label within .005 of the Dice that the exact map gets with the same nearest-neighbour sampling."""
    phantom, _ = run
    motion, origin, spacing = resting
    moved = {}
    for name, places in (("exact", phantom.truth.places), ("ours", motion.resting)):
        moved[name] = np.where(
            np.isfinite(places[..., 0]), sample(phantom.labels, origin, spacing, places, "nearest"), 0
        )
    for label in BRAIN:
        truth = phantom.truth.labels == label
        ours, exact = (dice(moved[name] == label, truth) for name in ("ours", "exact"))
        assert ours > exact - 0.005, (label, ours, exact)
        if label in (WM, TUMOUR):
            assert ours >= {WM: 0.99, TUMOUR: 0.98}[label]
    assert dice(motion.tissue, np.isfinite(phantom.truth.places[..., 0])) >= 0.99


def test_the_cavity_is_the_wedge(run):
    """The integral of 6 sqrt(s / 40) mm over the length inside the outline; pixels of .64 mm2 leave some doubt."""
    _, result = run
    length = np.linalg.norm(MOUTH - TIP)
    wedge = 6 * (2 / 3) * length**1.5 / 40**0.5
    assert wedge == pytest.approx(166.4, abs=0.1)
    assert result.record["checks"]["cavity_mm2"] == pytest.approx(wedge, rel=0.05)


def test_the_image_is_right_away_from_edges(run, resting):
    """RMSE under 1 % of the mean signal where two pixels about nothing changes but the scanner's bias."""
    phantom, result = run
    motion, _, _ = resting
    updated = result.warp(phantom.image())
    truth = phantom.truth
    label = np.where(truth.cavity, 0, truth.labels)
    flat = (maximum_filter(label, 5) == minimum_filter(label, 5)) & ~binary_dilation(~motion.tissue, iterations=2)
    centre, radius = TUMOURS[phantom.tumour]
    depth = radius - np.linalg.norm(np.nan_to_num(truth.places) - centre, axis=2)
    flat &= ~((depth > 0) & (depth < 4))  # the enhancing rim is an edge within one label
    error = (updated - truth.image)[flat]
    assert flat.sum() > 15000
    assert np.sqrt((error**2).mean()) < 0.01 * truth.image[flat].mean()


def test_the_gap_is_not_smeared(run):
    """In the middle of the wedge there is nothing but the fill value."""
    phantom, result = run
    centres = phantom.grid.centres()
    along, across = (centres - TIP) @ -TRAVEL, np.abs((centres - TIP) @ np.array([-TRAVEL[1], TRAVEL[0]]))
    middle = (along > 5) & (along < 35) & (across < 3 * np.sqrt(along.clip(0) / 40) - 1)
    assert middle.sum() > 50
    assert (result.warp(phantom.image())[middle] == 0).all()


#: Scales of intensity, and the value of the background on each: there is air of 0 about the phantom's head.
SCALES = {
    "z-scored": (lambda image: (image - 480) / 105, -480 / 105),
    "CT": (lambda image: np.where(image > 0, image / 10 - 50, -1000), -1000),
    "negative": (lambda image: image - 3000, -3000),
}


def stored(result, role):
    """Values of an output, and what its sidecar says of the fill."""
    name = result.record["outputs"][role]
    about = json.loads((result.folder / name.replace(".nii.gz", ".json")).read_text())
    return nib.load(result.folder / name).get_fdata(), about["Fill"]


@pytest.mark.parametrize("name", SCALES)
def test_the_scale_of_intensities_changes_nothing_else(run, tmp_path, name):
    """RMSE and Dice are those of the plain phantom, and the cavity has the background's value, also of companions."""
    scale, background = SCALES[name]
    _, result = run_phantom("A", tmp_path, scale)
    (plain, none), (updated, fill) = stored(run[1], "updated"), stored(result, "updated")
    assert none == 0 and fill == pytest.approx(background)
    labels, wanted = (stored(item, "companion:sub-phantom_dseg")[0] for item in (result, run[1]))
    assert np.array_equal(labels, wanted)    # so that every Dice is the plain one's
    empty = result.frame.to_storage(result.update.cavity | result.update.vacated)
    carried, own = stored(result, "companion:sub-phantom_T1w-2")
    assert empty.sum() > 100 and (updated[empty] == np.float32(fill)).all() and own == fill
    assert (carried[empty] == np.float32(fill)).all() and abs(carried - updated).max() < 1e-3
    inside = ~binary_dilation(plain == 0, iterations=2)    # there a pixel has a part of air, which is far away in CT
    assert abs(updated - scale(plain))[inside].max() < 1e-3
    assert result.record["warnings"] == run[1].record["warnings"]


def test_another_grid_gives_the_same_motion(run, tmp_path):
    """Anisotropic, left-handed, integer storage: other pixels, another outline and mesh, the same tissue to .1 mm."""
    _, other = run_phantom("B", tmp_path)
    assert np.abs(other.to_current(landmarks()) - run[1].to_current(landmarks())).max() < 0.1


def test_energy_error_falls_with_the_root_of_the_element():
    """Topological enrichment: the strain's error in the energy norm goes as h^.5 (the tip's own cells stay coarse)."""
    phantom = Phantom()
    error = []
    for h in (8.0, 4.0, 2.0):
        mesh = distmesh(outline(), h)
        cut = place_cut(cut_path(), mesh.outline)
        material = Material(3.0, POISSON)
        problem = posed(mesh, (cut,), material, Skull(), boundary_displacement=boundary_displacement(phantom))
        split, U = problem.parts, solve(problem).U.ravel()
        points, weights, owner = tip_rule(split.corners, split.fronts.at)
        parts = split.part[owner]
        strain, D = plane.strains(problem.space, U, points, parts), plane.stiffness(material)
        left = np.sign((points - TIP) @ np.array([-TRAVEL[1], TRAVEL[0]]))
        exact = np.linalg.solve(D, material.shear_modulus * OPEN.stress(points, left).T).T
        off, whole = (np.einsum("q,qs,st,qt", weights, e, D, e) for e in (strain - exact, exact))
        error.append(np.sqrt(off / whole))
    rates = np.log2(np.array(error[:-1]) / error[1:])
    assert rates.mean() == pytest.approx(0.5, abs=0.2), (error, rates)
