"""The whole chain on a small brain: what is computed again and what is not, and what the output folder holds."""

import gzip
import json
import random
import shutil
import warnings
from pathlib import Path

import jsonschema
import meshio
import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from scipy.ndimage import binary_erosion
from small import CUT, OPEN, QUICK, RAS, brain, write, xfemnav

from xfemnav.pipeline.asking.config import configure
from xfemnav.pipeline.asking.scenario import problems
from xfemnav.pipeline.asking.settings import STAGES
from xfemnav.pipeline.keeping import keys
from xfemnav.pipeline.keeping.names import CARRIED, NAMES, OWN_NAME, PAGES, WITH_SIDECAR, public_name, sidecar_name
from xfemnav.pipeline.running.runfile import run_schema
from xfemnav.pipeline.stages import stage_segment
from xfemnav.pipeline.stages.inputs import recorded

ROLES = {"mask", "mesh", "solution", "cuts", "updated", "cavity", "overlap", "lips", "field", "transform", "scenario"}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with an image and a cache that is filled once."""
    folder = tmp_path_factory.mktemp("chain")
    write(folder / "sub-01_T1w.nii.gz")
    return folder


@pytest.fixture
def run(home, capfd, monkeypatch):
    """Run the command on the image; the record and the stages' states by name."""
    monkeypatch.chdir(home)

    def command(*flags, image="sub-01_T1w.nii.gz", output="out", code=0, base=(*QUICK, "--cut", CUT, *OPEN)):
        got, stdout, stderr = xfemnav(capfd, "run", image, "-o", output, "-w", "cache", "--json", *base, *flags)
        assert got == code, stderr
        record = json.loads(stdout)
        jsonschema.validate(record, run_schema())
        assert record == json.loads((home / output / "run.json").read_text())
        return record, {stage["name"]: stage["status"] for stage in record["stages"]}

    command()
    return command


def ran(states):
    """Names of the stages that were computed."""
    return [name for name, state in states.items() if state != "cached"]


def test_second_run_computes_nothing_and_leaves_the_same_bytes(run, home):
    before = {path.name: path.read_bytes() for path in (home / "out").iterdir() if path.name != "run.json"}
    _, states = run()
    assert ran(states) == [] and list(states) == list(STAGES)
    assert before == {path.name: path.read_bytes() for path in (home / "out").iterdir() if path.name != "run.json"}
    fresh, states = run("--force", output="fresh")
    assert ran(states) == list(STAGES)
    for role, name in fresh["outputs"].items():
        assert (home / "fresh" / name).read_bytes() == before[name], role


def test_a_change_computes_what_depends_on_it_and_nothing_else(run):
    assert ran(run("--fill", "7")[1]) == ["warp"]
    assert ran(run("--interp", "nearest")[1]) == ["warp"]
    assert ran(run("--blade", "0,0.6")[1]) == ["constrain", "solve", "warp"]
    assert ran(run("--craniotomy-mm", "15")[1]) == ["constrain", "solve", "warp"]
    assert ran(run("--element-size-mm", "9")[1]) == ["mesh", "constrain", "solve", "warp"]
    assert ran(run("--force-from", "solve")[1]) == ["solve", "warp"]


def test_name_and_packing_of_the_input_change_nothing(run, home):
    renamed = shutil.copy(home / "sub-01_T1w.nii.gz", home / "renamed.nii.gz")
    unpacked = home / "unpacked.nii"
    unpacked.write_bytes(gzip.decompress((home / "sub-01_T1w.nii.gz").read_bytes()))
    repacked = home / "repacked.nii.gz"
    repacked.write_bytes(gzip.compress(unpacked.read_bytes(), 1))
    for image in (renamed, unpacked, repacked):
        assert ran(run(image=image, output="elsewhere")[1]) == []


def test_dry_run_says_what_would_run_and_runs_nothing(run, home, capfd):
    base = ("run", "sub-01_T1w.nii.gz", "-w", "cache", *QUICK, "--cut", CUT, *OPEN, "--dry-run")
    code, stdout, _ = xfemnav(capfd, *base)
    assert code == 0 and stdout.count(" cached ") == 5
    code, stdout, _ = xfemnav(capfd, *base, "--poisson", "0.31", "-o", "never")
    assert [line.split()[1] for line in stdout.splitlines()] == ["cached", "cached", "would", "would", "would"]
    assert not (home / "never").exists()


def test_edited_helper_in_mechanics_spares_the_mesh(run, tmp_path, capfd, monkeypatch):
    """Row 48: keys cover the code that a stage can reach."""
    copy = shutil.copytree(keys.PACKAGE, tmp_path / "xfemnav", ignore=shutil.ignore_patterns("__pycache__"))
    digest_of = keys.code_digest.__wrapped__
    monkeypatch.setattr(keys, "code_digest", lambda layers: digest_of(layers, copy))
    base = ("run", "sub-01_T1w.nii.gz", "-w", "cache", *QUICK, "--cut", CUT, *OPEN, "--dry-run")

    def states():
        return [line.split()[1] for line in xfemnav(capfd, *base)[1].splitlines()]

    run()
    assert states() == ["cached"] * 5
    for edited, expected in (("mechanics/space/branch.py", ["cached", "cached", "would", "would", "would"]),
                             ("geometry/mesh.py", ["would"] * 5)):
        (copy / edited).write_text((copy / edited).read_text() + "# edited\n")
        assert states() == expected, edited


def test_damaged_entry_is_healed_and_said(run, home):
    record, _ = run()
    before = (home / "out" / record["outputs"]["updated"]).read_bytes()
    rng = random.Random(3)
    for stage in ("solve", "mesh"):
        key = next(item["key"] for item in record["stages"] if item["name"] == stage)
        victim = home / "cache" / "entries" / key[:2] / key / "value.npz"
        data = bytearray(victim.read_bytes())
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        victim.write_bytes(data)
        healed, states = run()
        assert states[stage] == "healed" and ran(states) == [stage]
        assert "W601" in [item["code"] for item in healed["warnings"]]
        assert (home / "out" / record["outputs"]["updated"]).read_bytes() == before


def test_stop_after_leaves_what_was_asked_for(run):
    record, states = run("--stop-after", "mesh", output="part")
    assert list(states) == ["segment", "mesh"] and set(record["outputs"]) == {"mask", "mesh", "scenario"}


def test_outputs_are_what_their_roles_promise(run, home):
    """Names, grids, frames and marks of every public file."""
    record, _ = run("--fill", "-5")
    folder, outputs = home / "out", record["outputs"]
    assert set(outputs) == ROLES and outputs["updated"] == "sub-01_desc-updated_T1w.nii.gz"
    source = nib.load(home / "sub-01_T1w.nii.gz")
    images = {role: nib.load(folder / name) for role, name in outputs.items() if name.endswith(".nii.gz")}
    for role, image in images.items():
        assert np.allclose(image.affine, source.affine) and image.shape[:3] == source.shape, role
        assert (folder / outputs[role].replace(".nii.gz", ".json")).is_file()
        assert (folder / outputs[role]).read_bytes()[4:8] == bytes(4)  # no time of day in the gzip header
    updated, cavity, mask = (images[role].get_fdata() for role in ("updated", "cavity", "mask"))
    assert images["updated"].get_data_dtype() == np.float32
    assert cavity.any() and (updated[cavity > 0] == -5).all()
    outside = (mask == 0) & (cavity == 0)
    assert np.mean(updated[outside] == source.get_fdata()[outside]) > 0.99  # but for pixels that tissue moved over
    assert record["checks"]["cavity_mm2"] == cavity.sum() * 4
    field = images["field"]
    assert field.shape == (64, 72, 1, 1, 3) and field.header["intent_code"] == 1007
    solution = meshio.read(folder / outputs["solution"])
    assert [block.type for block in solution.cells] == ["triangle"] and np.allclose(solution.points[:, 2], 10)
    assert solution.point_data["displacement"].shape == (len(solution.points), 3)
    assert set(solution.cell_data) == {"strain", "det_F", "piece"}
    lips = np.round(solution.points, 6)
    assert len(np.unique(lips, axis=0)) < len(lips)  # the lips are double


def test_field_leads_each_pixel_to_its_resting_place(run, home):
    """updated(x) is the old image at x + field(x), the field read as LPS mm."""
    record, _ = run()
    old = nib.load(home / "sub-01_T1w.nii.gz").get_fdata()[:, :, 0]
    new = nib.load(home / "out" / record["outputs"]["updated"]).get_fdata()[:, :, 0]
    field = nib.load(home / "out" / record["outputs"]["field"]).get_fdata()[:, :, 0, 0] * (-1, -1, 1)
    tissue = np.abs(field).max(axis=-1) > 1e-3
    place = (np.indices(old.shape).transpose(1, 2, 0) + field[..., :2] / 2)[tissue]
    i, j = np.floor(place).astype(int).T
    s, t = (place - np.floor(place)).T
    linear = ((1 - s) * (1 - t) * old[i, j] + s * (1 - t) * old[i + 1, j] + (1 - s) * t * old[i, j + 1]
              + s * t * old[i + 1, j + 1])
    assert np.abs(linear - new[tissue]).max() < 1e-2  # float32 field of 1e-6 mm, gradients of 300 a pixel


ORDERS = {"RAS": (), "LAS": (0,), "RPS": (1,), "LPI": (0, 1, 2)}


def test_storage_order_changes_nothing_physical(run, home):
    """One grid in four orders and one transposed: the same motion to 1e-6 mm."""
    reference, _ = run()
    truth = meshio.read(home / "out" / reference["outputs"]["solution"])
    volume = nib.Nifti1Image(brain()[:, :, None], RAS)
    orders = {name: volume.as_reoriented(np.array([[a, -1 if a in flips else 1] for a in range(3)]))
              for name, flips in ORDERS.items()}
    orders["PIR"] = volume.as_reoriented(np.array([[2, 1], [0, -1], [1, -1]]))
    for name, image in orders.items():
        nib.save(image, home / f"{name}.nii.gz")
        record, _ = run(image=f"{name}.nii.gz", output=name)
        solution = meshio.read(home / name / record["outputs"]["solution"])
        assert np.abs(solution.points - truth.points).max() < 1e-6, name
        assert np.abs(solution.point_data["displacement"] - truth.point_data["displacement"]).max() < 1e-6, name
        back = nib.load(home / name / record["outputs"]["updated"])
        assert back.shape == image.shape and np.allclose(back.affine, image.affine)
        again = nib.as_closest_canonical(back).get_fdata()
        assert np.abs(again - nib.load(home / "out" / reference["outputs"]["updated"]).get_fdata()).max() < 1e-3, name


def test_own_mesh_takes_the_place_of_the_mesh_stage(run, home):
    record, _ = run()
    mesh = shutil.copy(home / "out" / record["outputs"]["mesh"], home / "mine.vtu")
    own, _ = run("--mesh", mesh, output="own")
    assert own["mesh"]["n_nodes"] == record["mesh"]["n_nodes"]
    displaced = [meshio.read(home / o / r["outputs"]["solution"]).point_data["displacement"]
                 for o, r in (("out", record), ("own", own))]
    assert np.abs(displaced[0] - displaced[1]).max() < 1e-6


def test_folding_is_marked_untrusted_and_names_an_opening_that_is_safe(run):
    record, _ = run("--opening-mm", "60", code=3, output="folded")
    assert record["status"] == "untrusted" and record["error"]["code"] == "E401"
    assert record["checks"]["inverted_mm2"] > 1 and set(record["outputs"]) == ROLES
    safe = float(record["error"]["text"].split("opening is ")[1].split(" of")[0])
    again, _ = run("--opening-mm", str(60 * safe), output="safe")
    assert again["status"] == "complete" and again["checks"]["inverted_mm2"] <= 1


def test_warnings_are_told_again_when_all_is_cached_and_strict_makes_them_the_error(run, home, capfd):
    prolonged = (*QUICK, *OPEN, "--cut", "-41,9 -15,5")  # starts 3 mm inside
    codes = [[item["code"] for item in run(base=prolonged, output="warned")[0]["warnings"]] for _ in range(2)]
    assert "W301" in codes[0] and codes[0] == codes[1]
    code, _, stderr = xfemnav(capfd, "run", "sub-01_T1w.nii.gz", "-o", "warned", "-w", "cache", "--strict", *prolonged)
    assert code == 65 and "--strict" in stderr
    assert json.loads((home / "warned" / "run.json").read_text())["status"] == "complete"  # the earlier run's
    xfemnav(capfd, "run", "sub-01_T1w.nii.gz", "-o", "strict", "-w", "cache", "--strict", *prolonged)
    failed = json.loads((home / "strict" / "run.json").read_text())
    jsonschema.validate(failed, run_schema())
    assert failed["status"] == "failed" and failed["exit_code"] == 65
    assert [path.name for path in (home / "strict").iterdir()] == ["run.json"]  # no outputs that run.json denies


def test_input_that_changes_under_way_is_refused_and_nothing_of_it_is_kept(home, capfd, monkeypatch):
    """The key is of the bytes that were digested: other bytes must not be stored under it."""
    image, later = write(home / "changing.nii.gz"), write(home / "later.nii.gz", 2 * brain())
    monkeypatch.chdir(home)
    command = ("run", image, "-o", "changed", "-w", "cache-of-changes", *QUICK, "--cut", CUT, *OPEN, "--fill", "3")
    assert xfemnav(capfd, *command)[0] == 0
    good = (home / "changed" / "changing_desc-updated.nii.gz").read_bytes()

    of_segment = stage_segment.facts

    def overwrites(value, params, inputs):
        shutil.copy(later, image)
        return of_segment(value, params, inputs)

    monkeypatch.setattr(stage_segment, "facts", overwrites)
    code, _, stderr = xfemnav(capfd, *command, "--force")
    assert code == 65 and "E101 changing.nii.gz changed" in stderr
    monkeypatch.undo()
    monkeypatch.chdir(home)
    write(image)
    assert xfemnav(capfd, *command)[0] == 0
    assert (home / "changed" / "changing_desc-updated.nii.gz").read_bytes() == good


def test_warnings_about_a_file_are_told_of_that_file_alone(run, home):
    """Two names for one content: the cached stages hold nothing of the first name."""
    shutil.copy(home / "sub-01_T1w.nii.gz", home / "misnamed.nii")
    for _ in range(2):
        told = [item["text"] for item in run("--skull-on", "stripped", image="misnamed.nii", output="a")[0]["warnings"]]
        assert any("misnamed.nii is gzip" in text for text in told)
    told = [item["text"] for item in run("--skull-on", "stripped", output="b")[0]["warnings"]]
    assert not any("misnamed" in text for text in told)


def test_a_copy_is_warned_of_under_its_own_name(run, home):
    for name in ("first", "second"):
        shutil.copy(home / "sub-01_T1w.nii.gz", home / f"{name}.nii")
        told = [item["text"] for item in run("--skull-on", "stripped", image=f"{name}.nii", output="a")[0]["warnings"]]
        assert any(f"{name}.nii is gzip" in text for text in told)


def test_measured_boundary_is_read_in_the_space_of_the_run(run, home):
    """The same motion in RAS and in LPS; the cut too, while vectors of lips are plane RAS."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rows = np.column_stack([45 * np.cos(angle), 55 * np.sin(angle), 1 + np.cos(angle), -0.5 * np.sin(angle)])
    solved = []
    for space, sign in (("ras", 1), ("lps", -1)):
        np.savetxt(home / f"{space}.csv", sign * rows, delimiter=",", header="x,y,ux,uy", comments="")
        cut = " ".join(f"{sign * x},{sign * y}" for x, y in ((-60, 10), (-15, 5)))
        record, _ = run("--space", space, "--boundary-displacement", f"{space}.csv", output=space,
                        base=(*QUICK, "--left", "0.3,2", "--right", "0.3,-2", "--cut", cut))
        solved.append(meshio.read(home / space / record["outputs"]["solution"]).point_data["displacement"])
    np.testing.assert_allclose(solved[0], solved[1], atol=1e-9)


def test_nan_in_a_mask_is_background_and_a_mask_of_several_volumes_is_refused(run, home, capfd):
    mask = (brain() > 0).astype(np.float32)
    holes = np.where(mask > 0, mask, np.nan)
    one, other = write(home / "mask0.nii.gz", mask), write(home / "masknan.nii.gz", holes)
    found = [run("--mask", path, output="m", base=("--stop-after", "segment"))[0] for path in (one, other)]
    assert found[0]["segmentation"] == found[1]["segmentation"]
    several = write(home / "mask4d.nii.gz", np.stack([mask[..., None]] * 2, -1))
    code, _, stderr = xfemnav(capfd, "segment", "sub-01_T1w.nii.gz", "--mask", several, "-o", "m", "-w", "cache")
    assert code == 65 and stderr.startswith("E121 mask mask4d.nii.gz") and "file of its own" in stderr


def test_spacing_given_by_hand_is_that_of_the_mask_too(run, home):
    values, mask = brain(), (brain() > 0).astype(np.uint8)
    image, organ = write(home / "bare.nii.gz", values, np.eye(4)), write(home / "bare_mask.nii.gz", mask, np.eye(4))
    record, _ = run("--mask", organ, "--spacing", "2,2", image=image, output="bare",
                    base=(*QUICK, *OPEN, "--space", "voxel", "--cut", "1,40 24,38"))
    assert record["slice"]["spacing"] == [2, 2] and record["segmentation"]["area_mm2"] == 4 * mask.sum()


def test_bids_names_keep_their_suffix():
    assert public_name(Path("sub-01_ses-a_desc-x_T1w.nii"), "updated") == "sub-01_ses-a_desc-updated_T1w.nii.gz"
    assert public_name(Path("sub-01_T1w.nii.gz"), "mask") == "sub-01_desc-brain_mask.nii.gz"
    assert public_name(Path("my_head.nii.gz"), "updated") == "my_head_desc-updated.nii.gz"
    carried = [f"{role}:{which}" for role in CARRIED for which in ("motor", "sub-01_task-x_bold", "a b")]
    roles, images = (*NAMES, *PAGES, "updated:open", "figure:open", *carried), ("sub-01_T1w.nii", "a b.mgz", "x" * 250)
    names = [public_name(Path(image), role, ".trk") for role in roles for image in images]
    names += [sidecar_name(name) for name in names if name.endswith(WITH_SIDECAR)]
    assert [name for name in names if not OWN_NAME.fullmatch(name)] == []


def test_recorded_keeps_foreign_warnings_going():
    with pytest.warns(UserWarning, match="foreign"), recorded() as found:
        warnings.warn("foreign", stacklevel=1)
    assert found == []


def test_parameters_of_the_record_are_a_scenario(run):
    record, _ = run()
    assert problems({"xfemnav": 1} | record["parameters"]) == []
    assert configure("x.nii", flags={"cut": (CUT,), "opening_mm": 4.0}).parameters["cut"] == record["parameters"]["cut"]


def test_a_template_moderates_the_segmentation(run, home):
    """Template-moderated classification with the brain's own image as template finds the brain; without one, E206."""
    mask = write(home / "template_mask.nii.gz", (brain() > 0).astype(np.uint8))
    template = ("--segment-method", "svc", "--template", "sub-01_T1w.nii.gz", "--template-mask", mask.name)
    record, states = run(*template, output="svc")
    assert record["segmentation"]["method"] == "svc" and "segment" in ran(states)
    found = np.squeeze(nib.load(home / "svc" / record["outputs"]["mask"]).get_fdata()) > 0
    overlap = 2 * (found & (brain() > 0)).sum() / (found.sum() + (brain() > 0).sum())
    assert overlap > 0.95


def test_itk_resamples_with_the_transform_as_the_run_did(run, home):
    """Away from lips and rims SimpleITK, given the preoperative slice and the transform, makes the updated slice."""
    record, _ = run()
    images = {role: sitk.ReadImage(home / "out" / record["outputs"][role]) for role in ("updated", "cavity")}
    before = sitk.ReadImage(home / "sub-01_T1w.nii.gz", sitk.sitkFloat32)
    transform = sitk.ReadTransform(home / "out" / record["outputs"]["transform"])
    values = {name: sitk.GetArrayFromImage(image)[0] for name, image in images.items()}
    resampled = sitk.GetArrayFromImage(sitk.Resample(before, images["updated"], transform, sitk.sitkLinear))[0]
    tissue = binary_erosion((values["updated"] > 0) & (values["cavity"] == 0), iterations=3)
    assert tissue.sum() > 800
    np.testing.assert_allclose(resampled[tissue], values["updated"][tissue], rtol=1e-5)


def test_lips_that_pass_through_each_other_are_not_trusted(run):
    """One lip pushed 6 mm into the other, which nobody holds: written, but exit 3."""
    record, _ = run("--left", "0,-6", "--lips", "free", base=(*QUICK, "--cut", CUT), output="passed", code=3)
    assert record["status"] == "untrusted" and record["error"]["code"] == "E401"
    assert record["checks"]["overlap_mm2"] > 50 and "W403" in [item["code"] for item in record["warnings"]]
