"""A finished run applied to what comes later: as the run itself would have carried it, never over what is there."""

import json
import os
import shutil
import warnings

import nibabel as nib
import numpy as np
import pytest
from nibabel.streamlines import Tractogram
from small import CUT, QUICK, brain, write, xfemnav

import xfemnav as package
from xfemnav.imaging.point_files import read_points, write_points
from xfemnav.imaging.points import PointSet
from xfemnav.pipeline.apply import Choices, apply, output_name

POINTS = np.array([[5.0, 5.0, 10.0], [-25.0, 20.0, 12.0], [300.0, 0.0, 10.0]])
LABELS = ("in", "near", "far")


def write_tracts(path):
    lines = [[[-10.0, y, 10.0], [10.0, y, 10.5]] for y in (-30.0, 0.0, 30.0)] + [[[-30.0, -10, 10], [-30.0, 30, 10]]]
    header = {"voxel_to_rasmm": np.eye(4), "dimensions": (200, 200, 200), "voxel_sizes": (1, 1, 1),
              "voxel_order": "RAS"} if path.suffix == ".trk" else None
    kind = nib.streamlines.TrkFile if path.suffix == ".trk" else nib.streamlines.TckFile
    kind(Tractogram(lines, affine_to_rasmm=np.eye(4)), header=header).save(str(path))
    return path


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder of inputs, and `out`, a run that carried all of them along."""
    home = tmp_path_factory.mktemp("apply")
    write(home / "head.nii.gz")
    write(home / "t2.nii.gz", 900 - brain())
    write(home / "labels.nii.gz", (brain() > 600).astype(np.int16) * 7)
    for name in ("marks.fcsv", "marks.mrk.json"):
        write_points(home / name, PointSet("Fiducial", "marks", POINTS, LABELS))
    write_points(home / "marks.tag", PointSet("points", "marks", POINTS, LABELS))
    write_points(home / "marks.csv", PointSet("points", "marks", POINTS, LABELS, {"who": ("a", "b", "c")}))
    write_tracts(home / "tracts.trk")
    write_tracts(home / "tracts.tck")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        package.run(home / "head.nii.gz", cut=CUT, opening_mm=4.0, element_size_mm=8.0, corridor_element_mm=4.0,
                    companion=(str(home / "t2.nii.gz"), f"label={home / 'labels.nii.gz'}"),
                    points=(str(home / "marks.csv"),), streamlines=(str(home / "tracts.trk"),),
                    report=False, output=home / "out", cache=home / "cache")
    return home


@pytest.fixture
def result(home):
    return package.Result.load(home / "out")


def names(folder):
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


def test_what_is_applied_is_what_the_run_carried(home, result, tmp_path):
    """The run's own files of the same inputs; points of the solution's file are rounded to 1e-6 mm."""
    carried = {role: home / "out" / name for role, name in result.record["outputs"].items()}
    for name, role, kind in (("t2.nii.gz", "companion:t2", None), ("labels.nii.gz", "companion:labels", "label")):
        made = nib.load(apply(result, home / name, tmp_path, Choices(kind=kind)).target)
        wanted = nib.load(carried[role])
        assert made.get_data_dtype() == wanted.get_data_dtype() and np.array_equal(made.affine, wanted.affine)
        assert abs(made.get_fdata() - wanted.get_fdata()).max() < 1e-2
    made = read_points(apply(result, home / "marks.csv", tmp_path).target)
    wanted = read_points(carried["points"])
    assert made.labels == wanted.labels and made.columns == wanted.columns
    assert made.columns["who"] == ("a", "b", "c") and abs(made.points - wanted.points).max() < 1e-5
    made = nib.streamlines.load(apply(result, home / "tracts.trk", tmp_path).target)
    wanted = nib.streamlines.load(carried["streamlines"])
    assert len(made.streamlines) == len(wanted.streamlines) > 4    # one is split at the cut
    assert abs(made.streamlines.get_data() - wanted.streamlines.get_data()).max() < 1e-4


def test_names_are_those_of_a_run(tmp_path):
    table = {
        "head.nii.gz": "head_desc-updated.nii.gz", "sub-01_bold.nrrd": "sub-01_desc-updated_bold.nii.gz",
        "a.mrk.json": "a_desc-updated_points.mrk.json", "a.json": "a_desc-updated_points.mrk.json",
        "a.fcsv": "a_desc-updated_points.fcsv", "t.TRK": "t_desc-updated_streamlines.trk",
    }
    assert {name: output_name(tmp_path / name) for name in table} == table
    assert output_name(tmp_path / "a_desc-updated_points.tag", inverse=True) == (
        "a_desc-updated_points_desc-preoperative_points.tag")
    assert output_name(tmp_path / "sub-01_T1w.mgz", "open it") == "sub-01_step-openit_desc-updated_T1w.nii.gz"
    assert output_name(tmp_path / "head.mha", "open") == "head_step-open_desc-updated.nii.gz"


@pytest.mark.parametrize("name", ["marks.fcsv", "marks.mrk.json", "marks.tag", "marks.csv"])
def test_points_there_and_back(home, result, tmp_path, name):
    there = apply(result, home / name, tmp_path)
    back = apply(result, there.target, tmp_path, Choices(inverse=True))
    assert there.text == "3 points: 2 tissue, 1 outside"
    found = read_points(back.target)
    assert found.labels == LABELS
    assert abs(found.points - POINTS).max() < 1e-5    # what point files keep
    assert abs(read_points(there.target).points - POINTS)[:2].max() > 0.1


def test_points_on_a_cut_are_on_the_lips_asked_for(home, result, tmp_path):
    cut = np.array(result.record["cuts"][0]["path"])
    middle = result.frame.to_world([cut[0] + 0.3 * (cut[1] - cut[0])])
    write_points(tmp_path / "on.csv", PointSet("points", "on", middle, ("m",)))
    both = read_points(apply(result, tmp_path / "on.csv", tmp_path / "both").target)
    assert both.labels == ("m left lip", "m right lip")
    for k, side in enumerate(("left", "right")):
        one = read_points(apply(result, tmp_path / "on.csv", tmp_path / side, Choices(side=side)).target)
        assert one.labels == ("m",) and np.allclose(one.points[0], both.points[k], atol=1e-9)
    write_points(tmp_path / "gap.csv", PointSet("points", "gap", both.points.mean(axis=0)[None], ("g",)))
    gone = apply(result, tmp_path / "gap.csv", tmp_path, Choices(inverse=True))
    assert gone.text == "1 point: 1 in the cut" and len(gone.target.read_text().splitlines()) == 1    # columns alone


def test_nothing_is_overwritten(home, result, tmp_path):
    first = apply(result, home / "marks.csv", tmp_path).target
    before = first.read_bytes()
    for force in (False, True):
        with pytest.raises(package.XfemnavError, match="E731"):    # what this command made, or what exists
            apply(result, home / "marks.csv", tmp_path, force=force, kept=frozenset({first}))
    with pytest.raises(package.XfemnavError, match=r"E731.*--force"):
        apply(result, home / "marks.csv", tmp_path)
    first.write_text("old")
    apply(result, home / "marks.csv", tmp_path, force=True)
    assert first.read_bytes() == before
    (tmp_path / "head_desc-updated.json").write_text("mine")    # a sidecar counts too
    with pytest.raises(package.XfemnavError, match="E731"):
        apply(result, home / "head.nii.gz", tmp_path)
    assert "head_desc-updated.nii.gz" not in names(tmp_path)
    with pytest.raises(package.XfemnavError, match="E731"):    # a file of the run itself
        apply(result, home / "labels.nii.gz", home / "out", force=True)


def test_all_or_nothing(home, result, tmp_path, monkeypatch):
    from xfemnav.imaging import point_files

    def half(path, points):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(point_files, "write_points", half)
    with pytest.raises(package.XfemnavError, match="E501"):
        apply(result, home / "marks.csv", tmp_path / "new")
    assert names(tmp_path) == []


def test_inverse_is_for_points(home, result, tmp_path):
    for name in ("head.nii.gz", "tracts.tck"):
        with pytest.raises(package.XfemnavError, match=r"E780.*--inverse"):
            apply(result, home / name, tmp_path, Choices(inverse=True))


def test_command_goes_on_and_tells(home, tmp_path, capfd):
    (home / "broken.nii.gz").write_bytes(b"\x1f\x8bnothing")
    files = [home / name for name in ("head.nii.gz", "broken.nii.gz", "none.csv", "tracts.tck", "marks.fcsv")]
    code, out, err = xfemnav(capfd, "apply", home / "out", *files, "-o", tmp_path / "new")
    assert code == 1
    assert [line.split(" -> ")[0] for line in out.splitlines()] == [str(files[k]) for k in (0, 3, 4)]
    told = [line for line in err.splitlines() if " E" in line]
    assert len(told) == 2 and f"{files[1]}: E10" in told[0] and f"{files[2]}: E100" in told[1]
    assert "Traceback" not in err
    assert names(tmp_path / "new") == ["head_desc-updated.json", "head_desc-updated.nii.gz",
                                       "marks_desc-updated_points.fcsv", "tracts_desc-updated_streamlines.tck"]
    about = json.loads((tmp_path / "new" / "head_desc-updated.json").read_text())
    assert about["Sources"] == ["head.nii.gz", "head_solution.vtu"] and "Untrusted" not in about


def test_exit_codes(home, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert xfemnav(capfd, "apply", home / "out", home / "none.csv")[0] == 66
    assert xfemnav(capfd, "apply", home, home / "marks.csv")[0] == 66    # no run there
    assert xfemnav(capfd, "apply", home / "out")[0] == 2
    assert xfemnav(capfd, "apply", home / "out", home / "marks.csv", "--step", "open")[0] == 78
    assert xfemnav(capfd, "apply", home / "out", home / "labels.nii.gz", "--kind", "vector")[0] == 65
    assert names(tmp_path) == []
    assert xfemnav(capfd, "apply", home / "out", home / "marks.csv")[0] == 0
    assert names(tmp_path) == ["marks_desc-updated_points.csv"]
    assert xfemnav(capfd, "apply", home / "out", home / "marks.csv")[0] == 73
    assert xfemnav(capfd, "apply", home / "out", home / "marks.csv", "--force")[0] == 0
    code, _, err = xfemnav(capfd, "apply", home / "out", home / "marks.fcsv", home / "marks.fcsv", "--force")
    assert code == 1 and "E731" in err    # the second would replace what the first made


def test_a_run_that_is_not_trusted_marks_what_it_makes(home, tmp_path, capfd):
    code, _, _ = xfemnav(capfd, "run", home / "head.nii.gz", "--cut", CUT, "--opening-mm", "60", *QUICK,
                         "-o", tmp_path / "out", "-w", home / "cache")
    assert code == 3
    code, out, err = xfemnav(capfd, "apply", tmp_path / "out", home / "head.nii.gz", "-o", tmp_path / "new")
    assert code == 3 and "E401" in err and "head_desc-updated.nii.gz" in out
    assert "E401" in json.loads((tmp_path / "new" / "head_desc-updated.json").read_text())["Untrusted"]


def test_options_of_images_do_what_they_say(home, result, tmp_path, capfd):
    apply_to = ("apply", home / "out", home / "head.nii.gz", "-o")
    assert xfemnav(capfd, *apply_to, tmp_path, "--fill", "-9", "--outside", "zero", "--interp", "nearest")[0] == 0
    found = nib.load(tmp_path / "head_desc-updated.nii.gz").get_fdata()[:, :, 0]
    update = result.update
    assert (found[update.cavity] == -9).all() and update.cavity.any()
    assert (found[~update.pull_back.tissue & ~update.cavity & ~update.vacated] == 0).all()
    assert set(np.unique(found)) <= {-9.0, 0.0, *np.unique(brain().astype(float))}


def places(value, at=()):
    """Every place in nested JSON."""
    yield at
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in inside:
        yield from places(inner, (*at, key))


def changed(record, at, value):
    """A copy of a record with another value at a place; None: without it."""
    copy = json.loads(json.dumps(record))
    inner = copy
    for key in at[:-1]:
        inner = inner[key]
    if value is None:
        del inner[at[-1]]
    else:
        inner[at[-1]] = value
    return copy


def test_a_record_that_somebody_has_damaged_is_told_as_damaged(home, tmp_path, capfd):
    """Everything that `apply` relies on is left out, or something else: an error with a code, or what came before."""
    record = json.loads((home / "out" / "run.json").read_text())
    shutil.copytree(home / "out", tmp_path / "run")
    read = ("schema", "status", "outputs", "slice", "cuts", "version")
    relied = [at for at in places(record) if at and at[0] in read]
    assert len(relied) > 40
    codes = set()
    for n, at in enumerate(relied):
        wrong = (None, -1, "x", {}, [], "../head.nii.gz", True, 1e308)
        value = wrong[n % len(wrong)]
        (tmp_path / "run" / "run.json").write_text(json.dumps(changed(record, at, value)))
        code, _, stderr = xfemnav(capfd, "apply", tmp_path / "run", home / "marks.tag", "-o", tmp_path / "t", "--force")
        assert code in (0, 65, 66), (at, value, stderr)
        codes.add(code)
    assert codes >= {0, 65}


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "[" * 100_000, '{"schema": "xfemnav-run/1"}', b"\xff\xfe"])
def test_what_is_no_record_is_told_so(home, tmp_path, capfd, text):
    (tmp_path / "run.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    code, _, stderr = xfemnav(capfd, "apply", tmp_path, home / "marks.tag", "-o", tmp_path)
    assert code == 65 and stderr.startswith("E701")


def test_a_pipe_in_the_place_of_the_record_is_not_waited_for(home, tmp_path, capfd):
    os.mkfifo(tmp_path / "run.json")
    code, _, stderr = xfemnav(capfd, "apply", tmp_path, home / "marks.tag", "-o", tmp_path)
    assert code == 65 and "pipe" in stderr
    code, _, stderr = xfemnav(capfd, "run", home / "head.nii.gz", *QUICK, "--cut", CUT, "-o", tmp_path)
    assert code == 73 and stderr.startswith("E731")
