"""Bad input through the command line: each fault has its code, its exit status and one line; never a wrong file.

One table. The numbers are those of the project's list of faults; every case holds the same invariants: the exit status
is that of the code, the message is one line, no public file is left, and the same command works without the fault.
"""

import errno
import gzip
import json
import os
import struct

import jsonschema
import meshio
import nibabel as nib
import numpy as np
import pytest
from small import CUT, OPEN, QUICK, RAS, brain, write, xfemnav

from xfemnav.errors import FAULTS
from xfemnav.pipeline.keeping import disk
from xfemnav.pipeline.running.runfile import run_schema

GOOD = {"cut": CUT, "lips": OPEN}


def patched(folder, offset, form, *values):
    """The brain's NIfTI file with a header field overwritten."""
    data = bytearray(gzip.decompress(write(folder / "good.nii.gz").read_bytes()))
    struct.pack_into("<" + form, data, offset, *values)
    (folder / "patched.nii").write_bytes(data)
    return folder / "patched.nii"


def with_value(folder, value):
    values = brain()
    values[30, 30] = value
    return write(folder / "odd.nii.gz", values)


def torn(folder, keep):
    path = write(folder / "torn.nii.gz")
    data = path.read_bytes()
    path.write_bytes(data[:int(keep * len(data))])
    return path


def flipped(folder, place):
    path = write(folder / "flipped.nii.gz")
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 4
    path.write_bytes(data)
    return path


def raw_torn(folder):
    path = folder / "torn.nii"
    path.write_bytes(gzip.decompress(write(folder / "good.nii.gz").read_bytes())[:-5000])
    return path


def text(folder, content, name="image.nii"):
    (folder / name).write_bytes(content)
    return folder / name


def pipe(folder):
    os.mkfifo(folder / "pipe.nii")
    return folder / "pipe.nii"


def rgb(folder):
    colour = np.zeros((8, 8, 1), dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")])
    nib.save(nib.Nifti1Image(colour, RAS), folder / "rgb.nii.gz")
    return folder / "rgb.nii.gz"


def ellipse():
    x, y = np.indices((64, 72)) * 2.0 + np.array([-63, -71])[:, None, None]
    return (x / 45) ** 2 + (y / 55) ** 2 < 1


def dumbbell():
    x, y = np.indices((64, 72)) * 2.0 + np.array([-63, -71])[:, None, None]
    return ((x**2 + (y - 35) ** 2 < 25**2) | (x**2 + (y + 35) ** 2 < 25**2) | (abs(x) < 6) & (abs(y) < 40)).astype("u1")


def image_of(make):
    return lambda folder: {"image": make(folder)}


def mask_of(values, affine=RAS):
    return lambda folder: {"flags": ("--mask", write(folder / "mask.nii.gz", np.asarray(values, "u1"), affine))}


def cut(points, *flags):
    return lambda folder: {"cut": points, "flags": flags}


def flags(*given):
    return lambda folder: {"flags": given}


def lips(*given):
    return lambda folder: {"lips": given}


def scenario(body):
    def make(folder):
        write(folder / "head.nii.gz")
        (folder / "case.toml").write_text(f'xfemnav = 1\nimage = "head.nii.gz"\n{body}')
        return {"image": None, "cut": None, "lips": (), "flags": ("--scenario", folder / "case.toml")}
    return make


def mesh_file(content):
    def make(folder):
        path = folder / "mine.vtu"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            meshio.Mesh(*content).write(path)
        return {"flags": ("--mesh", path)}
    return make


SHIFT = np.eye(4)
SHIFT[0, 3] = 5
FLAT = ([[0, 0, 10], [10, 0, 10], [20, 1e-9, 10]], [("triangle", [[0, 1, 2]])])
FAR = ([[-80, 60, 10], [-60, 60, 10], [-60, 76, 10]], [("triangle", [[0, 1, 2]])])
ABOVE = ([[0, 0, 50], [10, 0, 50], [0, 9, 50]], [("triangle", [[0, 1, 2]])])
SCENARIO_CUT = "[[cut]]\npoints = [[-60, 10], [-15, 5]]\n"

# (row in the list of faults, code, what is done to the run)
CASES = {
    "NaN voxel": (1, "E103", image_of(lambda f: with_value(f, np.nan))),
    "infinite voxel": (2, "E103", image_of(lambda f: with_value(f, np.inf))),
    "4-D": (3, "E121", image_of(lambda f: write(f / "4d.nii.gz", np.stack([brain()[..., None]] * 2, -1)))),
    "colour": (4, "E122", image_of(rgb)),
    "complex": (5, "E122", image_of(lambda f: write(f / "c.nii.gz", brain().astype(np.complex64)))),
    "constant": (6, "E202", image_of(lambda f: write(f / "c.nii.gz", np.full((64, 72), 7.0)))),
    "empty mask": (7, "E201", mask_of(np.zeros((64, 72)))),
    "full mask": (8, "E203", mask_of(np.ones((64, 72)))),
    "mask of another shape": (9, "E204", mask_of(np.ones((32, 36)))),
    "mask elsewhere": (9, "E204", mask_of(ellipse(), SHIFT @ RAS)),
    "zero affine": (11, "E110", image_of(lambda f: patched(f, 280, "12f", *[0.0] * 12))),
    "NaN affine": (12, "E110", image_of(lambda f: patched(f, 280, "12f", *[float("nan")] * 12))),
    "gzip ends early": (17, "E101", image_of(lambda f: torn(f, 0.6))),
    "gzip byte flipped": (18, "E101", image_of(lambda f: flipped(f, 0.5))),
    "gzip CRC flipped": (18, "E101", image_of(lambda f: flipped(f, 0.9999))),
    "raw file ends early": (19, "E101", image_of(raw_torn)),
    "header claims too much": (20, "E102", image_of(lambda f: patched(f, 40, "8h", 3, *[32767] * 3, 1, 1, 1, 1))),
    "nine dimensions": (22, "E105", image_of(lambda f: patched(f, 40, "h", 9))),
    "negative dimension": (22, "E105", image_of(lambda f: patched(f, 42, "h", -64))),
    "unknown data type": (22, "E105", image_of(lambda f: patched(f, 70, "h", 77))),
    "empty file": (23, "E106", image_of(lambda f: text(f, b""))),
    "text": (23, "E106", image_of(lambda f: text(f, b"not an image at all\n" * 40))),
    "pipe": (25, "E106", image_of(pipe)),
    "folder": (25, "E106", image_of(lambda f: f)),
    "device": (25, "E106", image_of(lambda f: "/dev/zero")),
    "missing": (25, "E100", image_of(lambda f: f / "nowhere.nii.gz")),
    "missing mask": (25, "E100", flags("--mask", "nowhere.nii.gz")),
    "cut outside": (26, "E301", cut("-90,90 -60,80")),
    "cut in LPS": (26, "E301", cut("70,40 58,33")),
    "cut deep inside": (27, "E302", cut("-10,0 10,0")),
    "cut of one point": (28, "E303", cut("-60,10")),
    "cut of equal points": (28, "E303", cut("-60,10 -60,10")),
    "cut crosses itself": (29, "E304", cut("-60,0 -10,0 -10,20 -30,-20")),
    "cut splits the brain": (30, "E306", lambda f: {
        "cut": "-20,0 20,0", "flags": ("--mask", write(f / "m.nii.gz", dumbbell()), "--skull", "free"), "lips": ()}),
    "cut through the whole": (32, "E306", lambda f: {"cut": "-70,0 70,0", "flags": ("--skull", "free"), "lips": ()}),
    "cut re-enters": (32, "E305", cut("-70,0 -30,0 -70,20 -20,20")),
    "folded": (34, "E401", lips("--opening-mm", "70")),
    "displacement NaN": (35, "E780", lips("--left", "nan,1")),
    "displacement 1e999": (35, "E780", lips("--left", "1e999,1")),
    "displacement as text": (35, "E780", scenario(
        SCENARIO_CUT + '[[retract]]\nside = "left"\ndisplacement_mm = ["12", 1]\n')),
    "blade beyond the cut": (36, "E402", flags("--blade", "0.2,1.4")),
    "blade backwards": (36, "E402", flags("--blade", "0.6,0.2")),
    "a negative opening": (36, "E780", lips("--opening-mm", "-4")),
    "lips pushed into each other": (36, "E405", lips("--left=-3", "--right=-3")),
    "Poisson 0.5": (37, "E404", flags("--poisson", "0.5")),
    "Young 0": (37, "E404", flags("--young-kpa", "0")),
    "blade without a lip": (36, "E780", lambda f: {"lips": (), "flags": ("--blade", "0,0.5")}),
    "tip held without pointwise lips": (36, "E780", flags("--hold-tip")),
    "elements too small": (38, "E207", flags("--element-size-mm", "0.001", "--corridor-element-mm", "0.001")),
    "elements too large": (38, "E207", flags("--element-size-mm", "500", "--corridor-mm", "0")),
    "path out of the folder": (49, "E781", scenario(SCENARIO_CUT.replace("[[cut]]", 'mask = "../m.nii"\n[[cut]]'))),
    "nested scenario": (50, "E780", scenario("x = " + "[" * 100_000)),
    "long scenario": (50, "E780", scenario("# " + "x" * 1_000_001)),
    "unknown key": (50, "E780", scenario(SCENARIO_CUT + "[mesh]\nelment_size_mm = 3\n")),
    "VTU that is text": (54, "E209", mesh_file(b"hello")),
    "VTU that ends early": (54, "E209", mesh_file(b'<VTKFile type="UnstructuredGrid"><UnstructuredGrid>')),
    "VTU with entities": (54, "E209", mesh_file(b'<!DOCTYPE x [<!ENTITY a "a">]><VTKFile>&a;</VTKFile>')),
    "mesh of flat triangles": (54, "E209", mesh_file(FLAT)),
    "mesh beside the organ": (54, "E209", mesh_file(FAR)),
    "mesh off the slice": (54, "E209", mesh_file(ABOVE)),
}


@pytest.mark.parametrize("name", CASES)
def test_fault(name, tmp_path, tmp_path_factory, capfd, monkeypatch):
    _, expected, spoil = CASES[name]
    monkeypatch.chdir(tmp_path)
    case = {"image": write(tmp_path / "good-head.nii.gz"), "flags": ()} | GOOD | spoil(tmp_path)
    arguments = [*filter(None, [case["image"]]), *QUICK, *case["lips"], *case["flags"]]
    if case["cut"]:
        arguments += ["--cut", case["cut"]]
    cache = tmp_path_factory.getbasetemp() / "faults-cache"  # shared, so that good stages are computed once
    code, stdout, stderr = xfemnav(capfd, "run", *arguments, "-o", "out", "-w", cache)

    errors = [line for line in stderr.splitlines() if line.startswith("E")]
    assert len(errors) == 1 and errors[0].split()[0] == expected, stderr
    assert "Traceback" not in stdout + stderr and len(errors[0]) < 1500
    assert code == FAULTS[expected].exit_code
    left = {path.name for path in (tmp_path / "out").glob("*")} if (tmp_path / "out").exists() else set()
    if expected == "E401":
        assert json.loads((tmp_path / "out" / "run.json").read_text())["status"] == "untrusted"
        return
    assert left <= {"run.json"}
    if left:
        record = json.loads((tmp_path / "out" / "run.json").read_text())
        jsonschema.validate(record, run_schema())
        assert record["status"] == "failed" and record["error"]["code"] == expected and record["outputs"] == {}


def test_required_rows_are_all_in_the_table():
    """Rows 31 and 46 to 48 are laws of their own: perturbed tips (test_subcells), flips and stale keys (test_cache)."""
    required = {1, 3, 6, 7, 9, 11, 12, 17, 18, 20, 23, 25, 26, 27, 28, 29, 30, 34, 35, 37, 38}
    assert required <= {row for row, *_ in CASES.values()}


def run(tmp_path, capfd, *arguments):
    code, stdout, _ = xfemnav(capfd, "run", *arguments, *QUICK, "--cut", CUT, *OPEN, "-o", tmp_path / "out",
                              "-w", tmp_path / "cache", "--json")
    return code, json.loads(stdout)


def test_the_same_command_works_when_the_fault_is_gone(tmp_path, capfd):
    image = write(tmp_path / "head.nii.gz")
    good = image.read_bytes()
    image.write_bytes(good[:-9])
    assert run(tmp_path, capfd, image)[0] == 65
    image.write_bytes(good)
    assert run(tmp_path, capfd, image)[0] == 0


def test_value_for_nan_mends_it(tmp_path, capfd):
    values = brain()
    values[0, 0] = np.nan
    image = write(tmp_path / "odd.nii.gz", values)
    assert run(tmp_path, capfd, image)[0] == 65 and run(tmp_path, capfd, image, "--nan", "0")[0] == 0


def test_second_component_and_holes_of_a_mask_are_cleaned_and_told(tmp_path, capfd):
    """Row 10."""
    mask = ellipse()
    mask[2:5, 2:5], mask[30:32, 30:32] = True, False
    code, record = run(tmp_path, capfd, write(tmp_path / "head.nii.gz"), "--mask",
                       write(tmp_path / "mask.nii.gz", mask.astype("u1")))
    assert code == 0 and "W205" in [item["code"] for item in record["warnings"]]
    assert abs(record["segmentation"]["area_mm2"] - ellipse().sum() * 4) <= 4


def test_gzip_without_its_ending_is_read_and_told(tmp_path, capfd):
    """Row 24."""
    image = write(tmp_path / "head.nii.gz").rename(tmp_path / "head.nii")
    code, record = run(tmp_path, capfd, image)
    assert code == 0 and "W107" in [item["code"] for item in record["warnings"]]


def test_internal_cut_is_allowed_when_asked_for(tmp_path, capfd):
    """Row 27."""
    code, _, stderr = xfemnav(capfd, "run", write(tmp_path / "head.nii.gz"), "--cut", "-25,0 25,0", "--internal",
                              *QUICK, "-o", tmp_path / "out", "-w", tmp_path / "cache")
    assert code == 0, stderr


@pytest.mark.parametrize("name", ["ü ñ 脑.nii.gz", "two words.nii.gz", "new\nline.nii.gz", "-x.nii.gz",
                                  "b" * 240 + ".nii.gz", "ü" * 124 + ".nii.gz",
                                  "esc\x1b[31m.nii.gz", os.fsdecode(b"not-\xff-utf8.nii.gz")])
def test_any_file_name_works_and_no_terminal_obeys_it(tmp_path, capfd, name):
    """Rows 55 and 59."""
    image = write(tmp_path / "x.nii.gz").rename(tmp_path / name)
    code, record = run(tmp_path, capfd, "-v", image.absolute())
    assert code == 0 and (tmp_path / "out" / record["outputs"]["updated"]).is_file()
    code, stdout, stderr = xfemnav(capfd, "run", image.absolute(), *QUICK, "--cut", "90,90 91,91",
                                   "-o", tmp_path / "out")
    assert code == 65 and "\x1b" not in stdout + stderr


def test_output_never_takes_the_place_of_an_input(tmp_path, capfd):
    """Row 56."""
    first = run(tmp_path, capfd, write(tmp_path / "head.nii.gz"))[1]
    mask = tmp_path / "out" / first["outputs"]["mask"]
    before = mask.read_bytes()
    code, failed = run(tmp_path, capfd, tmp_path / "head.nii.gz", "--mask", mask)
    assert code == 73 and failed["error"]["code"] == "E731" and mask.read_bytes() == before


def test_output_of_the_last_run_may_be_an_input_but_not_in_its_own_folder(tmp_path, capfd):
    """It would be removed there, as the earlier run's."""
    first = run(tmp_path, capfd, write(tmp_path / "head.nii.gz"))[1]
    updated = tmp_path / "out" / first["outputs"]["updated"]
    code, failed = run(tmp_path, capfd, updated)
    assert code == 73 and failed["error"]["code"] == "E731" and updated.is_file()
    moved = updated.rename(tmp_path / updated.name)
    assert run(tmp_path, capfd, moved, "--stop-after", "segment")[0] == 0 and moved.is_file()


def test_scenario_table_and_foreign_files_in_the_output_folder_are_never_overwritten(tmp_path, capfd):
    """Row 56: what no run recorded there is not ours, whatever its name."""
    image, out = write(tmp_path / "head.nii.gz"), tmp_path / "out"
    out.mkdir()
    (out / "case.toml").write_text("xfemnav = 1\n")
    for name, flags in (("report.html", ()), ("head_desc-updated.json", ()), ("run.json", ()),
                        ("figure.png", ("--scenario", out / "figure.png")),
                        ("head_mesh.vtu", ("--boundary-displacement", out / "head_mesh.vtu"))):
        content = "xfemnav = 1\n" if "--scenario" in flags else "x,y,ux,uy\n-45,0,0,0\n45,0,0,0\n"
        (out / name).write_text(content)
        code, failed = run(tmp_path, capfd, image, *flags)
        assert code == 73 and failed["error"]["code"] == "E731" and name in failed["error"]["text"]
        assert (out / name).read_text() == content and {path.name for path in out.iterdir()} == {"case.toml", name}
        (out / name).unlink()
    assert run(tmp_path, capfd, image, "--scenario", out / "case.toml")[0] == 0


def test_a_file_that_somebody_wrote_into_the_record_is_not_removed(tmp_path, capfd):
    """Only names that a run gives are the run's, wherever else a record lists them."""
    image, out = write(tmp_path / "head.nii.gz"), tmp_path / "out"
    assert run(tmp_path, capfd, image)[0] == 0
    record = json.loads((out / "run.json").read_text())
    mine = ("notes.txt", "thesis.pdf", "run.json.bak", "case.toml")
    record["outputs"] |= {f"mine{k}": name for k, name in enumerate(mine)}
    record["claims"] = [*mine, "../head.nii.gz", ".."]
    (out / "run.json").write_text(json.dumps(record))
    for name in mine:
        (out / name).write_text("mine")
    assert run(tmp_path, capfd, image, "--opening-mm", "3")[0] == 0
    assert all((out / name).read_text() == "mine" for name in mine) and image.exists()


def test_a_run_that_fails_leaves_an_earlier_result_as_it_is(tmp_path, capfd, monkeypatch):
    image, out = write(tmp_path / "head.nii.gz"), tmp_path / "out"
    assert run(tmp_path, capfd, image)[0] == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def left():
        return {path.name: path.read_bytes() for path in out.iterdir()}

    assert run(tmp_path, capfd, image, "--skull-ramp-mm", "nan")[0] == 78 and left() == before
    assert run(tmp_path, capfd, tmp_path / "head.nii.gz", "--slice", "9")[0] == 65 and left() == before
    full = OSError(errno.ENOSPC, "No space left on device")
    with monkeypatch.context() as patched:  # the disk is full when the new files are written
        patched.setattr(disk.os, "fsync", lambda handle: (_ for _ in ()).throw(full))
        assert run(tmp_path, capfd, image, "--opening-mm", "3")[0] == 74 and left() == before
    assert run(tmp_path, capfd, image, "--opening-mm", "3")[0] == 0 and left() != before


def test_names_too_long_for_any_disk_are_one_error(tmp_path, capfd):
    name = "x" * 300
    for flags in ((name + ".nii.gz",), ("head.nii.gz", "--mask", name), ("head.nii.gz", "--mesh", name),
                  ("head.nii.gz", "--scenario", name), ("head.nii.gz", "--boundary-displacement", name)):
        write(tmp_path / "head.nii.gz")
        code, failed = run(tmp_path, capfd, *(flag if flag.startswith("-") else tmp_path / flag for flag in flags))
        assert code == 66 and failed["error"]["code"] == "E100", flags
