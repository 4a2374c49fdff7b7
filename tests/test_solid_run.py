"""A volume's run as users see it: its record, figure and report, its result in Python, and what it has not."""

import copy
import json
import re
import warnings
from itertools import islice, permutations, product
from types import SimpleNamespace

import jsonschema
import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from matplotlib.figure import Figure
from numpy.testing import assert_allclose
from pages import Tags
from small import xfemnav

import xfemnav as package
from xfemnav.errors import XfemnavError
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.frames.volume import Volume
from xfemnav.pipeline.running.runfile import run_schema
from xfemnav.pipeline.telling import display, solid_figure
from xfemnav.pipeline.telling.methods import CITATIONS
from xfemnav.pipeline.telling.report import CHECKS, worded

R, N, STEP = 30.0, 36, 2.0
AFFINE = np.diag([STEP, STEP, STEP, 1.0])
AFFINE[:3, 3] = -STEP * (N - 1) / 2
COARSE = {"element_size_mm": 8.0, "corridor_element_mm": 4.0}
OPENED = {"dim": 3, "cut": [(-13, 0, 27), (0, 0, 30), (13, 0, 27)], "towards": (0, 0, 8), "opening_mm": 3.0, **COARSE}


def places():
    """Centres (N, N, N, 3) mm of the voxels."""
    return np.moveaxis(np.indices((N, N, N)), 0, -1) * STEP + AFFINE[:3, 3]


def ball():
    """A textured ball of radius R in the voxels, background 0."""
    x, y, z = np.moveaxis(places(), -1, 0)
    textured = 500 + 40 * np.sin(x / 5) * np.cos(y / 6) + 5 * z
    return np.where(x**2 + y**2 + z**2 < R**2, textured, 0).astype(np.float32)


def nifti(path, values, affine=AFFINE):
    nib.save(nib.Nifti1Image(values, affine), path)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the ball, its mask, a cache, and the finished run in `out`."""
    folder = tmp_path_factory.mktemp("solid")
    image = nifti(folder / "ball.nii.gz", ball())
    mask = nifti(folder / "mask.nii.gz", (ball() > 0).astype(np.uint8))
    result = package.run(image, mask=mask, output=folder / "out", cache=folder / "cache", **OPENED)
    return SimpleNamespace(folder=folder, image=image, mask=mask, cache=folder / "cache", result=result,
                           record=result.record)


def again(made, name, image=None, **changes):
    """The run with other settings, without a report: its record."""
    flags = {name: value for name, value in ({"mask": made.mask} | OPENED | changes).items() if value is not None}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return package.run(image or made.image, output=made.folder / name, cache=made.cache, report=False,
                           **flags).record


def told(made, page):
    """The page of the run, as text on one line."""
    return re.sub(r"\s+", " ", Tags((made.folder / "out" / page).read_text()).text)


def test_its_record_is_of_the_schema_and_a_slices_is_not(made):
    record = json.loads((made.folder / "out/run.json").read_text())
    jsonschema.validate(record, run_schema())
    assert record["dimension"] == 3 and record["status"] == "complete"
    for name, value in (("slice", {"plane": "axial"}), ("energy_uJ_per_mm", 1.0)):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(record | {name: value}, run_schema())
    for wrong in ({"checks": record["checks"] | {"cavity_mm2": 1.0}}, {"dimension": 2}, {"schema": "xfemnav-run/1"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(record | wrong, run_schema())
    flat = copy.deepcopy(record)
    flat["retractor"][0]["force_mN"] = [1.0, 2.0]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(flat, run_schema())


def test_its_page_says_what_the_record_holds(made):
    record, text = made.record, told(made, "report.html")
    for sentence in ("in three dimensions", "isosurface stuffing [3]", "smoothed aggregation [4, 5]",
                     f"{record['mesh']['n_cells']} linear tetrahedra", "The surface was fixed",
                     f"{record['cuts'][0]['depth_mm']:.1f} mm deep", "Every voxel of",
                     f"the opened cavity measured {record['checks']['cavity_mm3']:.0f} mm³",
                     record["cuts"][0]["told"], "force, mNits size", "the A lip", "the P lip"):
        assert sentence in text, sentence
    for word in ("mm²", "in two dimensions", "per mm of thickness", "out of this plane", "plane strain", "triangles",
                 "pixel", "outline"):
        assert word not in text, word
    assert all(citation in text for citation in CITATIONS[3])
    assert "Labelle" in CITATIONS[3][2] and "Persson" in CITATIONS[2][2]
    rows = [name for name in CHECKS if record["checks"].get(worded(name, 3)) is not None]
    assert len(rows) > 12 and all(worded(CHECKS[name][0], 3) in text for name in rows)
    for row in record["retractor"]:
        assert f"({', '.join(f'{x:.2f}' for x in row['force_mN'])})" in text
    assert record["retractor"][0]["force_mN"][1] > 1 > -1 > record["retractor"][1]["force_mN"][1]  # they part along y


def test_a_notebook_shows_its_figure(made):
    card = Tags(made.result._repr_html_())
    assert "Complete" in card.text and "patient's left on the left of axial" in card.text
    assert [attrs["src"][:10] for tag, attrs in card.tags if tag == "img"] == ["data:image"]


def test_the_same_scenario_gives_the_same_bytes(made, capfd):
    code, _, _ = xfemnav(capfd, "run", "--scenario", made.folder / "out/scenario.toml", "-o", made.folder / "same",
                         "-w", made.folder / "other", "-q")
    assert code == 0
    names = made.record["outputs"].values()
    assert {name for name in names if (made.folder / "out" / name).read_bytes()
            != (made.folder / "same" / name).read_bytes()} == set()


def test_the_command_says_where_and_checks_the_run(made, capfd):
    cut = " ".join(",".join(map(str, point)) for point in OPENED["cut"])
    line = ["run", made.image, "--dim", 3, "--mask", made.mask, "--cut", cut, "--towards", "0,0,8", "--opening-mm", 3,
            "--element-size-mm", 8, "--corridor-element-mm", 4, "-o", made.folder / "told", "-w", made.cache]
    code, stdout, _ = xfemnav(capfd, *line, "--dry-run")
    assert code == 0 and stdout.count("cached") == 5
    code, stdout, _ = xfemnav(capfd, *line, "--stop-after", "mesh")
    assert code == 0 and "nodes, quality" in stdout
    code, stdout, stderr = xfemnav(capfd, *line)
    assert code == 0 and "left lip: the anterior one" in stdout + stderr and (made.folder / "told/figure.png").is_file()
    code, stdout, _ = xfemnav(capfd, "check", made.folder / "told")
    assert (code, stdout) == (0, f"{made.folder / 'told'}: no problem found\n")


def test_points_go_with_the_tissue_and_come_back(made):
    result = package.Result.load(made.folder / "out")
    rest = np.array([[0, 4, 26.0], [0, -4, 26], [3, 8, 0]])
    now = result.to_current(rest)
    assert now[0, 1] - rest[0, 1] > 0.8 and now[1, 1] - rest[1, 1] < -0.8  # the anterior lip to the front
    assert_allclose(result.to_preoperative(now), rest, atol=1e-9)
    assert_allclose(result.displacement(rest[0]), now[0] - rest[0])
    assert np.isnan(result.to_preoperative((0, 0, 27.0))).all()  # in the opened cut
    assert (result.organ.cells.shape[1], result.dimension) == (4, 3)
    assert_allclose(result.preoperative.values, ball())
    cavity = nib.load(made.folder / "out" / made.record["outputs"]["cavity"]).get_fdata() > 0
    assert (result.updated.values[cavity] == 0).all()
    centres = places()
    assert np.isnan(result.to_preoperative(centres[cavity])).all()
    solid = (result.frame.values > 0) & ~cavity & (np.linalg.norm(centres, axis=-1) < R - 6)
    whence = result.to_preoperative(centres[solid][::50])
    at = (whence - AFFINE[:3, 3]) / STEP
    from scipy.ndimage import map_coordinates

    assert_allclose(result.updated.values[solid][::50], map_coordinates(ball(), at.T, order=1), atol=1e-2)


@pytest.mark.parametrize("asked", [
    lambda result: result.to_current((0, 0, 25), "left"), lambda result: result.update, lambda result: result.outline,
    lambda result: result.landmarks([(0, 0, 0)]), lambda result: result.streamlines("a.trk"),
    lambda result: result.surface("a.stl"), lambda result: result.warp(ball()),
    lambda result: result.to_current((0, 0)), lambda result: result.write_transform("a.h5")])
def test_what_a_volume_has_not_yet_is_refused(made, asked):
    with pytest.raises(XfemnavError) as found:
        asked(made.result)
    assert found.value.code == "E780" and "volume" in found.value.text


def test_a_session_is_of_a_slice(made):
    with pytest.raises(XfemnavError, match=r"E780.*volume"):
        package.Session(made.image, mask=made.mask, dim=3, corridor=OPENED["cut"], towards=(0, 0, 8))


def test_nothing_is_applied_to_other_files_yet(made, capfd):
    (made.folder / "p.csv").write_text("x,y,z\n0,0,0\n")
    for name in (made.image, made.folder / "p.csv"):
        code, _, stderr = xfemnav(capfd, "apply", made.folder / "out", name, "-o", made.folder / "applied")
        assert code == 78 and "E780" in stderr and "volume" in stderr


@pytest.mark.parametrize("wrong, code", [
    ({"slice_mm": 0.0}, "E780"), ({"resect": "0,0 5,0 5,5"}, "E780"), ({"lips": "contact"}, "E780"),
    ({"model": "neo-hookean"}, "E780"), ({"towards": None}, "E780"), ({"mask": None}, "E205"),
    ({"mask": "shifted"}, "E204")])
def test_what_a_run_refuses(made, wrong, code):
    if wrong.get("mask") == "shifted":
        shifted = AFFINE.copy()
        shifted[0, 3] += 0.7
        wrong = {"mask": nifti(made.folder / "shifted.nii.gz", (ball() > 0).astype(np.uint8), shifted)}
    image = made.image
    if code == "E205":  # a head has a skull about its brain
        outer = np.linalg.norm(places(), axis=-1)
        noise = np.random.default_rng(0).normal(0, 4, outer.shape)
        image = nifti(made.folder / "head.nii.gz", np.where((outer > 31) & (outer < 34), 900, ball() + noise + 20))
        wrong = wrong | {"skull_on": "on"}
    with pytest.raises(XfemnavError) as found:
        again(made, "refused", image, **wrong)
    assert found.value.code == code


def checks(record) -> dict[str, float]:
    """The numbers among a record's checks that depend on what has moved."""
    return {name: value for name, value in record["checks"].items()
            if isinstance(value, float) and name not in ("residual", "overlap_mm3")}


def stored(values, affine, order, signs):
    """`values` and affine with the axes in another `order`, counted backwards where `signs` are -1."""
    turned, steps, first = values.transpose(order), affine[:3, list(order)], affine[:3, 3].copy()
    for axis, sign in enumerate(signs):
        if sign < 0:
            turned = np.flip(turned, axis)
            first = first + steps[:, axis] * (turned.shape[axis] - 1)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = steps * signs, first
    return np.ascontiguousarray(turned), matrix


ORDERS = list(islice(((order, signs) for order, signs in zip(permutations(range(3)), product((-1, 1), repeat=3))), 6))


@pytest.mark.parametrize("order, signs", ORDERS)
def test_a_storage_order_changes_nothing(made, order, signs):
    name = "".join(map(str, order)) + "".join("-+"[sign > 0] for sign in signs)
    image, mask = (nifti(made.folder / f"{name}{what}.nii.gz", *stored(values, AFFINE, order, signs))
                   for what, values in (("image", ball()), ("mask", (ball() > 0).astype(np.uint8))))
    found = again(made, name, image, mask=mask)
    for check, value in checks(made.record).items():
        assert_allclose(checks(found)[check], value, rtol=1e-6, atol=1e-6, err_msg=check)


@pytest.mark.parametrize("suffix", ["nrrd", "mgz"])
def test_a_format_changes_nothing(made, suffix):
    path = made.folder / f"ball.{suffix}"
    if suffix == "nrrd":
        sitk.WriteImage(sitk.ReadImage(str(made.image)), str(path))
    else:
        nib.save(nib.MGHImage(ball(), AFFINE), path)
    found = again(made, suffix, path)
    for check, value in checks(made.record).items():
        assert_allclose(checks(found)[check], value, rtol=1e-6, atol=1e-6, err_msg=check)


def test_tissue_by_label_is_of_that_stiffness(made):
    """All of the ball is of a label, and twice as stiff: forces and energy double, nothing moves otherwise."""
    labels = nifti(made.folder / "labels.nii.gz", (4 * (np.linalg.norm(places(), axis=-1) < R + 4)).astype(np.int16))
    scenario = made.folder / "labels.toml"
    text = (made.folder / "out/scenario.toml").read_text().replace('"../', '"').replace("allow_outside = true\n", "")
    assert "[tissue]\n" in text
    text = text.replace("[tissue]\n", f'[tissue]\nlabels = "{labels.name}"\n')
    scenario.write_text(text + "\n[tissue.by_label.4]\nyoung_kpa = 6.0\n")
    found = package.run(scenario=scenario, output=made.folder / "labelled", cache=made.cache, report=False).record
    assert_allclose(found["energy_uJ"], 2 * made.record["energy_uJ"], rtol=1e-6)
    assert_allclose(found["checks"]["max_displacement_mm"], made.record["checks"]["max_displacement_mm"], rtol=1e-6)


def test_gravity_moves_tissue_its_way(made):
    found = package.run(made.image, mask=made.mask, output=made.folder / "heavy", cache=made.cache, report=False,
                        **OPENED | {"opening_mm": None, "gravity": (0, 0, -1)} | COARSE)
    assert found.record["retractor"] == []
    assert found.displacement((0, 8, 24.0))[2] < -0.01


# The figure ----------------------------------------------------------------------------------------------------------

def oblique():
    """A volume whose axes are turned, permuted and counted backwards, with values that say where they are."""
    c, s = np.cos(0.2), np.sin(0.2)
    steps = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])[:, [2, 0, 1]] * [1.5, -2.0, 1.0]
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = steps, (3, 30, -12)
    empty = Volume(np.zeros((16, 20, 24)), affine, 1)
    return Volume(empty.pixel_centres() @ [1.0, 10, 100], affine, 1)


def test_triangles_cross_a_plane_in_their_segments():
    volume = oblique()
    shown = take_slice(volume, plane="coronal", index=9)
    rng = np.random.default_rng(1)
    corners = shown.to_world(rng.normal(0, 9, (40, 3, 2))) + rng.normal(0, 4, (40, 3, 1)) * shown.axes[2]
    height = (corners @ shown.axes[2]) - shown.offset
    crossed = (height.min(axis=1) < 0) & (height.max(axis=1) > 0)
    found = solid_figure.section(corners, shown)
    assert len(found) == crossed.sum() > 10
    for segment, triangle in zip(shown.to_world(found), corners[crossed]):
        shares = np.linalg.lstsq(np.vstack([triangle.T, np.ones(3)]), np.vstack([segment.T, np.ones(2)]), rcond=None)[0]
        assert_allclose(triangle.T @ shares, segment.T, atol=1e-9)
        assert (shares > -1e-9).all() and (abs(shares) < 1e-9).any(axis=0).all()  # on the triangle's edges
    assert len(solid_figure.section(np.empty((0, 3, 3)), shown)) == 0


def test_the_middle_is_that_of_what_opens():
    rest = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[10, 0, 0], [11, 0, 0], [10, 1, 0]]], float)
    shift = np.array([0.0, 3.0])[:, None, None] * [0, 0, 1]
    assert_allclose(solid_figure.middle_of(rest, np.stack([rest + shift, rest - shift])), rest[1].mean(axis=0))
    assert_allclose(solid_figure.middle_of(rest, np.stack([rest, rest])), rest.mean(axis=(0, 1)))


def test_its_planes_go_through_the_middle():
    volume = oblique()
    point = volume.voxels_to_world([[9, 13, 17]])[0]
    for plane in ("axial", "coronal", "sagittal"):
        assert abs(solid_figure._through(volume, plane, point).from_world(point[None])[1][0]) < 1e-9


@pytest.mark.parametrize("plane", ["axial", "coronal", "sagittal"])
def test_a_displacement_is_drawn_where_its_tissue_is(plane):
    """In an oblique volume whose tissue in each voxel has moved by a number that says where it is."""
    volume = oblique()
    index = 5
    shown = take_slice(volume, plane=plane, index=index)
    tissue = np.zeros(volume.values.shape, bool)
    tissue[3:12, 4:15, 2:20] = True
    whence = volume.pixel_centres()
    whence[..., 2] -= volume.values
    update = SimpleNamespace(pull_back=SimpleNamespace(
        tissue=tissue, places_of=lambda wanted: whence[wanted], centres_of=volume.voxels_to_world))
    picture = solid_figure._displacement(Figure().subplots(), volume, shown, update, 9.0).get_array().T
    inside = solid_figure._in(volume, shown, tissue) > 0
    assert inside.any() and (np.ma.getmaskarray(np.ma.masked_invalid(picture)) == ~inside).all()
    assert_allclose(picture[inside], abs(shown.values[inside]), rtol=1e-5)


@pytest.mark.parametrize("way", ["neurological", "radiological"])
def test_the_words_for_a_volume_are_those_of_its_planes(way):
    words = display.in_space(way)
    for plane, axes in {"axial": [[1, 0, 0], [0, 1, 0]], "coronal": [[1, 0, 0], [0, 0, 1]]}.items():
        west = display.edges(plane, axes, way)[0]
        assert f"the patient's {'left' if west == 'L' else 'right'} on the left" in words
    assert display.left_of((0.1, -0.9, 0.2)) == "P" and display.left_of((0.8, 0, 0)) == "R"
