"""A finished run applied to what comes later: as the run itself would have carried it, never over what is there."""

import errno
import gzip
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
from xfemnav.imaging.points.point_files import read_points, write_points
from xfemnav.imaging.points.point_set import PointSet
from xfemnav.imaging.points.stl import FACET
from xfemnav.imaging.points.surface_files import read_surface
from xfemnav.pipeline.keeping import disk, locks
from xfemnav.pipeline.running.apply import Choices, apply, output_name

POINTS = np.array([[5.0, 5.0, 10.0], [-25.0, 20.0, 12.0], [300.0, 0.0, 10.0]])
LABELS = ("in", "near", "far")


def write_tracts(path):
    lines = [[[-10.0, y, 10.0], [10.0, y, 10.5]] for y in (-30.0, 0.0, 30.0)] + [[[-30.0, -10, 10], [-30.0, 30, 10]]]
    header = {"voxel_to_rasmm": np.eye(4), "dimensions": (200, 200, 200), "voxel_sizes": (1, 1, 1),
              "voxel_order": "RAS"} if path.suffix == ".trk" else None
    kind = nib.streamlines.TrkFile if path.suffix == ".trk" else nib.streamlines.TckFile
    kind(Tractogram(lines, affine_to_rasmm=np.eye(4)), header=header).save(str(path))
    return path


def ball(title, signs):
    """A binary STL of triangles about (-25, 10, 11) RAS mm, through which the cut goes; its points have these signs."""
    unit = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    faces = unit[[[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]]
    for _ in range(3):
        a, b, c = faces.swapaxes(0, 1)
        ab, bc, ca = (x / np.linalg.norm(x, axis=1)[:, None] for x in (a + b, b + c, c + a))
        parts = (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
        faces = np.concatenate([np.stack(part, 1) for part in parts])
    facets = np.zeros(len(faces), FACET)
    facets["corners"] = (np.array([-25.0, 10, 11]) + 12 * faces) * signs
    return title.ljust(80) + len(faces).to_bytes(4, "little") + facets.tobytes()


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
    (home / "packed.trk.gz").write_bytes(gzip.compress((home / "tracts.trk").read_bytes()))
    (home / "tumour.stl").write_bytes(ball(b"3D Slicer output. SPACE=LPS", [-1, -1, 1]))
    (home / "lesion.stl").write_bytes(ball(b"no frame", [-1, -1, 1]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        package.run(home / "head.nii.gz", cut=CUT, opening_mm=4.0, element_size_mm=8.0, corridor_element_mm=4.0,
                    companion=(str(home / "t2.nii.gz"), f"label={home / 'labels.nii.gz'}"),
                    points=(str(home / "marks.csv"),), streamlines=(str(home / "tracts.trk"),),
                    surfaces=(str(home / "tumour.stl"),),
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
    packed = apply(result, home / "packed.trk.gz", tmp_path)
    assert packed.target.name == "packed_desc-updated_streamlines.trk.gz"
    plain = tmp_path / "tracts_desc-updated_streamlines.trk"
    assert gzip.decompress(packed.target.read_bytes()) == plain.read_bytes()
    moved = apply(result, home / "tumour.stl", tmp_path)
    assert moved.target.read_bytes() == carried["surfaces"].read_bytes()
    (table,) = result.record["surfaces"]
    assert (table["file"], table["frame"], table["faces"]) == ("tumour.stl", "LPS as the file says", 512)
    assert 20 < table["left_out_on_a_cut"] < 200 and table["n"] == table["tissue"] + table["outside"] == 258
    assert f"left out {table['left_out_on_a_cut']} on a cut" in moved.text and not moved.warnings


def test_a_surface_moves_as_its_tissue_in_its_own_frame(home, result, tmp_path):
    for name, choices, frame in (("tumour.stl", Choices(), "LPS as the file says"),
                                 ("lesion.stl", Choices(space="lps"), "LPS as space says")):
        done = apply(result, home / name, tmp_path, choices)
        assert frame in done.text
        before, after = read_surface(home / name, space="lps"), read_surface(done.target, space="lps")
        rest = before.points[np.unique(before.corners)]
        now = after.points[np.unique(after.corners)]
        wanted = result.to_current(rest)
        gap = np.linalg.norm(now[:, None] - np.where(np.isfinite(wanted), wanted, rest)[None], axis=2).min(axis=1)
        assert gap.max() < 1e-4 and done.target.read_bytes()[:80] == (home / name).read_bytes()[:80]
    wrong = apply(result, home / "lesion.stl", tmp_path / "ras")    # the run's own space is RAS
    assert "RAS as space says" in wrong.text


def test_what_is_not_carried_is_told_what_is(home, result, tmp_path, capfd):
    others = {"a.trx": b"PK\3\4", "a.pdf": b"%PDF", "a.vtu": b"<VTKFile/>", "lh.pial": b"\xff\xff\xfe"}
    for name, content in others.items():
        (tmp_path / name).write_bytes(content)
        code, _, err = xfemnav(capfd, "apply", home / "out", tmp_path / name, "-o", tmp_path)
        assert code == 66 or code == 65
        assert all(ending in err for ending in ("NIfTI", ".mrk.json", ".trk.gz", ".vtp", "E106"))
    (tmp_path / "a.trk").write_bytes(b"PK\3\4")
    code, _, err = xfemnav(capfd, "apply", home / "out", tmp_path / "a.trk", "-o", tmp_path)
    assert code == 65 and "E701" in err and ".trk.gz" in err


def test_no_file_that_nobody_claims_is_overwritten(home, tmp_path):
    """Also not by what is named after a carried file, whose ending is its own."""
    out = tmp_path / "out"
    for flag, name in (("streamlines", "tracts.tck"), ("surfaces", "tumour.stl"), ("points", "marks.tag")):
        out.mkdir(exist_ok=True)
        mine = out / f"head_desc-updated_{flag}{(home / name).suffix}"
        mine.write_text("mine")
        with pytest.raises(package.XfemnavError, match="E731"):
            package.run(home / "head.nii.gz", cut=CUT, opening_mm=4.0, element_size_mm=8.0, corridor_element_mm=4.0,
                        report=False, output=out, cache=home / "cache", **{flag: (str(home / name),)})
        assert mine.read_text() == "mine"
        mine.unlink()


def test_names_are_those_of_a_run(tmp_path):
    table = {
        "head.nii.gz": "head_desc-updated.nii.gz", "sub-01_bold.nrrd": "sub-01_desc-updated_bold.nii.gz",
        "a.mrk.json": "a_desc-updated_points.mrk.json", "a.json": "a_desc-updated_points.mrk.json",
        "a.fcsv": "a_desc-updated_points.fcsv", "t.TRK": "t_desc-updated_streamlines.trk",
        "t.trk.gz": "t_desc-updated_streamlines.trk.gz", "tumour.STL": "tumour_desc-updated_surfaces.stl",
        "sub-01_hemi-L_pial.surf.gii": "sub-01_hemi-L_desc-updated_pial.surf.gii",
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
    with pytest.raises(package.XfemnavError, match=r"E731.*force=True"):
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
    from xfemnav.imaging.points import point_files

    def half(path, points):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(point_files, "write_points", half)
    with pytest.raises(package.XfemnavError, match="E501"):
        apply(result, home / "marks.csv", tmp_path / "new")
    assert names(tmp_path) == []


def test_without_temporary_files_nothing_is_applied(home, tmp_path, capfd, monkeypatch):
    def refused(*_, **__):
        raise PermissionError(13, "Permission denied", "/tmp/xfemnav-x")

    monkeypatch.setattr(disk.tempfile, "mkdtemp", refused)
    code, _, stderr = xfemnav(capfd, "apply", home / "out", home / "t2.nii.gz", "-o", tmp_path)
    assert code == 73 and "E502 cannot write temporary files" in stderr and "TMPDIR" in stderr
    assert not list(tmp_path.iterdir())


def test_what_a_killed_one_left_half_written_goes_with_the_next(home, result, tmp_path, monkeypatch):
    """Unless somebody may be writing it: on a disk without locks it stays."""
    left = tmp_path / ".123-4.xfemnav-tmp"
    left.write_text("half")

    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    with monkeypatch.context() as patched:
        patched.setattr(locks.fcntl, "flock", no_locks)
        apply(result, home / "t2.nii.gz", tmp_path)
        assert left.exists()
    apply(result, home / "marks.fcsv", tmp_path)
    assert not left.exists() and len(list(tmp_path.iterdir())) == 3


def test_inverse_is_for_points(home, result, tmp_path):
    for name in ("head.nii.gz", "tracts.tck", "tumour.stl"):
        with pytest.raises(package.XfemnavError, match=r"E780.*inverse"):
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
