"""The project's list of bad inputs and faults, row by row: what each must get, what it gets, and whether that is so.

`pytest -v tests/test_fault_table.py` prints the table. Rows that one run of the command shows are run here, with the
cases of `test_faults` and those below; for the others the table names the test that shows them, which must exist.
"""

import ast
import gzip
import json
import os
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
from small import CUT, OPEN, QUICK, RAS, brain, write, xfemnav
from test_faults import CASES, GOOD, ellipse, flags, image_of, lips, mask_of, patched, scenario

from xfemnav.errors import FAULTS

WELL = "ok"  # what a fault gets that is no fault: exit status 0 and a complete record


def bomb(folder):
    """A slice whose gzip stream goes on with 100 MB of zeros."""
    path = write(folder / "bomb.nii.gz")
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()) + bytes(100_000_000), 1))
    return path


def giant(folder, name):
    """A file of 1 GB that takes no room on the disk."""
    with open(folder / name, "wb") as file:
        file.truncate(1_000_000_000)
    return folder / name


def sheared(folder):
    affine = RAS.copy()
    affine[0, 1] = 0.2
    return write(folder / "sheared.nii.gz", affine=affine)


def no_position(folder):
    write(folder / "good.nii.gz")
    path = patched(folder, 252, "2h", 0, 0)
    return path


def of_json(change=lambda raw: None, *given):
    """A cut from a markups file of Slicer's, after `change` of its content."""
    def make(folder):
        point = {"positionStatus": "defined", "visibility": False}
        markup = {"type": "Line", "coordinateSystem": "RAS", "controlPoints": [
            point | {"label": "mouth", "position": [-60, 10, 10]}, point | {"label": "tip", "position": [-15, 5, 10]}]}
        raw = {"@schema": "markups-schema-v1.0.3.json#", "markups": [markup | {"name": "F"}, markup | {"name": "G"}]}
        raw["markups"] = raw["markups"][:1]
        raw = change(raw) or raw
        path = folder / "cut.mrk.json"
        path.write_text(raw if isinstance(raw, str) else json.dumps(raw))
        return {"cut": path, "flags": given}
    return make


def points_of(raw):
    return raw["markups"][0]["controlPoints"]


def in_lps(raw):
    raw["markups"][0].pop("coordinateSystem")  # Slicer's default is LPS
    for point in points_of(raw):
        point["position"] = [-point["position"][0], -point["position"][1], 10]


def twice(raw):
    raw["markups"].append(raw["markups"][0] | {"name": "G"})


def linked(folder):
    """A scenario whose mask is a link out of its folder."""
    (folder / "inner").mkdir()
    write(folder / "mask.nii.gz", ellipse().astype("u1"))
    write(folder / "inner" / "head.nii.gz")
    (folder / "inner" / "mask.nii.gz").symlink_to(folder / "mask.nii.gz")
    (folder / "inner" / "case.toml").write_text(
        'xfemnav = 1\nimage = "head.nii.gz"\nmask = "mask.nii.gz"\n[[cut]]\npoints = [[-60, 10], [-15, 5]]\n')
    return {"image": None, "cut": None, "lips": (), "flags": ("--scenario", folder / "inner" / "case.toml")}


def dated(folder, seconds):
    path = write(folder / "head.nii.gz")
    os.utime(path, (seconds, seconds))
    return path


def two_parts():
    mask = ellipse()
    mask[2:5, 2:5], mask[30:32, 30:32] = True, False
    return mask


LINE = "[[cut]]\npoints = [[-60, 10], [-15, 5]]\n"
BLADE = '[[retract]]\nname = "{}"\nside = "left"\nnormal_mm = 2\nblade = [{}, {}]\n'
COARSE = {"image": None, "cut": None, "lips": ()}

#: What is run here beside the cases of `test_faults`: (row, what must come of it, what is done to the run).
MORE = {
    "scl_slope NaN": (2, "W104", image_of(lambda f: patched(f, 112, "f", float("nan")))),
    "4-D with --volume": (3, WELL, lambda f: {"flags": ("--volume", "1"), "image": write(
        f / "4d.nii.gz", np.stack([0 * brain()[..., None], brain()[..., None]], -1))}),
    "mask elsewhere with --resample-mask": (9, WELL, lambda f: {
        "flags": ("--resample-mask", "--mask", write(f / "m.nii.gz", ellipse().astype("u1"), np.diag([1, 1, 1, 1.0])
                                                     @ RAS + [[0, 0, 0, 0.7], [0] * 4, [0] * 4, [0] * 4]))}),
    "mask of two parts with a hole": (10, "W205", mask_of(two_parts())),
    "sheared pixels": (14, "E111", image_of(sheared)),
    "no qform or sform": (15, "W112", image_of(no_position)),
    "gzip bomb": (21, "E102", image_of(bomb)),
    "zero dimension": (22, "E105", image_of(lambda f: patched(f, 42, "h", 0))),
    "voxels said to start behind the file": (22, "E101", image_of(lambda f: patched(f, 108, "f", 1e9))),
    "gzip without .gz": (24, "W107", image_of(lambda f: write(f / "x.nii.gz").rename(f / "x.nii"))),
    "internal cut, allowed": (27, WELL, lambda f: {"cut": "-25,0 25,0", "flags": ("--internal",), "lips": ()}),
    "cut with a vertex twice": (28, "W302", lambda f: {"cut": "-60,10 -60,10 -15,5"}),
    "two blades on one lip": (36, "E403", scenario(LINE + BLADE.format("a", 0, 0.5) + BLADE.format("b", 0.4, 0.8))),
    "Poisson negative": (37, "E404", flags("--poisson", "-0.1")),
    "displacement of three numbers": (35, "E780", lips("--left", "3,0,1")),
    "markups out of the folder": (49, "E781", scenario('[[cut]]\nmarkups = "../cut.mrk.json"\n')),
    "absolute path": (49, "E781", scenario('mask = "/etc/passwd"\n' + LINE)),
    "NUL in a path": (49, "E781", scenario('mask = "a\\u0000b"\n' + LINE)),
    "link out of the folder": (49, "E781", linked),
    "key twice": (50, "E780", scenario("nan = 0\nnan = 1\n" + LINE)),
    "scenario of 1 GB": (50, "E780", lambda f: COARSE | {"flags": ("--scenario", giant(f, "case.toml"))}),
    "markups of 1 GB": (50, "E308", lambda f: {"cut": giant(f, "cut.mrk.json")}),
    "nested markups": (50, "E308", of_json(lambda raw: '{"markups": ' + "[" * 100_000)),
    "table of displacements with an object": (51, "E408", lambda f: {
        "flags": ("--boundary-displacement", _text(f / "b.csv", "x,y,ux,uy\ncos\nsystem,1,2,3\n"))}),
    "markups, hidden points": (53, WELL, of_json()),
    "markups, frame left out": (53, WELL, of_json(in_lps)),
    "markups, a point without position": (53, "E308", of_json(lambda raw: points_of(raw)[0].pop("position") and None)),
    "markups, a point never placed": (53, "E308", of_json(
        lambda raw: points_of(raw)[0].update(positionStatus="undefined"))),
    "markups, one point": (53, "E308", of_json(lambda raw: points_of(raw).pop() and None)),
    "markups, frame unknown": (53, "E308", of_json(lambda raw: raw["markups"][0].update(coordinateSystem="IJK"))),
    "two markups": (53, "E309", of_json(twice)),
    "two markups, one named": (53, WELL, of_json(twice, "--markup", "G")),
    "two markups, another named": (53, "E309", of_json(twice, "--markup", "H")),
    "points off the slice": (53, "E307", of_json(lambda raw: points_of(raw)[1].update(position=[-15, 5, 11.1]))),
    "VTU that leads nowhere": (54, "E100", lambda f: {"flags": ("--mesh", f / "nowhere.vtu")}),
    "mesh of quadrangles": (54, "E209", lambda f: {"flags": ("--mesh", _quads(f / "mine.vtu"))}),
    "image of 1970": (57, WELL, image_of(lambda f: dated(f, 0))),
    "image of 2099": (57, WELL, image_of(lambda f: dated(f, 4_070_908_800))),
}

#: Rows that a single run cannot show, or that are laws: the test that shows each.
SHOWN = {
    13: "test_frames.py::test_every_storage_order_gives_the_same_physical_image",
    16: "test_frames.py::test_grids_agree",
    31: "test_subcells.py::test_joins_equal_those_of_the_plane",
    33: "test_subcells.py::test_a_cut_beside_a_row_of_nodes_severs_what_it_should",
    39: "test_distmesh.py::test_random_masks",
    40: "test_cli.py::test_full_disk_at_any_write_is_one_error_and_resumable",
    41: "test_cli.py::test_killed_runs_leave_nothing_wrong",
    42: "test_signals.py::test_a_signal_at_any_time",
    44: "test_cli.py::test_two_runs_in_one_folder_wait_for_each_other",
    45: "test_cli.py::test_unwritable_cache_is_a_warning_and_unwritable_output_an_error",
    46: "test_cache.py::test_every_bit_flip_heals",
    47: "test_cache.py::test_entry_moved_under_another_key_is_not_believed",
    48: "test_chain.py::test_edited_helper_in_mechanics_spares_the_mesh",
    51: "test_store.py::test_pickle_inside_an_array_is_never_loaded",
    52: "test_store.py::test_header_that_claims_more_than_the_file_holds_takes_no_memory",
    55: "test_faults.py::test_any_file_name_works_and_no_terminal_obeys_it",
    56: "test_faults.py::test_output_never_takes_the_place_of_an_input",
    "56a": "test_reading.py::test_the_neighbour_with_a_similar_name_is_not_read",
    58: "test_report.py::test_names_cannot_become_markup",
    59: "test_cli.py::test_printable_keeps_a_message_on_one_line",
    60: "test_fault_table.py::test_threads_change_nothing",
}
ROWS = [*range(1, 61), "56a"]
OPEN_ROWS = {43}  # a process that the system kills for its memory cannot say so itself


def _text(path, content):
    path.write_text(content)
    return path


def _quads(path):
    meshio.Mesh([[-40, -40, 10], [40, -40, 10], [40, 40, 10], [-40, 40, 10]], [("quad", [[0, 1, 2, 3]])]).write(path)
    return path


def outcome(spoil, folder, cache, capfd):
    """What a run gets: its error's code, or "ok", with the codes of its warnings behind."""
    folder.mkdir()
    case = {"image": None, "flags": ()} | GOOD | {"image": write(folder / "good-head.nii.gz")} | spoil(folder)
    arguments = [*filter(None, [case["image"]]), *QUICK, *case["lips"], *case["flags"], "-o", folder / "out",
                 "-w", cache]
    if case["cut"]:
        arguments += ["--cut", case["cut"]]
    code, stdout, stderr = xfemnav(capfd, "run", *arguments, "--json")
    record = json.loads(stdout)
    error = (record.get("error") or {}).get("code")
    assert "Traceback" not in stdout + stderr
    assert code == (FAULTS[error].exit_code if error else 0) and code != 70
    outputs = (folder / "out").glob("*.nii.gz")
    assert error in (None, "E401") or not list(outputs)  # never a file beside an error
    return " ".join([error or WELL, *sorted({item["code"] for item in record.get("warnings", ())})])


def holds(test: str) -> bool:
    """Whether a test of that name is in its file."""
    file, _, name = test.partition("::")
    tree = ast.parse((Path(__file__).parent / file).read_text(encoding="utf-8"))
    return name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def as_wanted(expected: str, got: str) -> bool:
    """Whether what was wanted is among what came, and is the error where there is one."""
    return expected in got.split() and expected.startswith("E") == got.startswith("E")


@pytest.mark.parametrize("name", MORE)
def test_fault(name, tmp_path, tmp_path_factory, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, expected, spoil = MORE[name]
    got = outcome(spoil, tmp_path / "run", tmp_path_factory.getbasetemp() / "faults-cache", capfd)
    assert as_wanted(expected, got), got


def test_what_is_said_to_be_shown_elsewhere_is_there():
    assert [test for test in SHOWN.values() if not holds(test)] == []
    assert {row for row, *_ in (*CASES.values(), *MORE.values())} | {*SHOWN, *OPEN_ROWS} == set(ROWS)


@pytest.mark.slow
def test_every_row_of_the_table(tmp_path, tmp_path_factory, capfd, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    cache = tmp_path_factory.getbasetemp() / "faults-cache"
    table = [(row, test, "shown", "there" if holds(test) else "missing", holds(test)) for row, test in SHOWN.items()]
    for number, (name, (row, expected, spoil)) in enumerate({**CASES, **MORE}.items()):
        got = outcome(spoil, tmp_path / str(number), cache, capfd)
        table.append((row, name, expected, got, as_wanted(expected, got)))
    lines = [f"{row!s:>4}  {name[:72]:72}  {expected:6}  {got:16}  {'ok' if ok else 'NOT AS WANTED'}"
             for row, name, expected, got, ok in sorted(table, key=lambda line: ROWS.index(line[0]))]
    if request.config.getoption("verbose") >= 0:  # the project's own setting is -q, -1
        with capfd.disabled():
            print("\n" + "\n".join([" row  input or fault" + 59 * " " + "wanted  got", *lines]))
    assert all(ok for *_, ok in table), "\n".join(line for line in lines if not line.endswith("  ok"))


@pytest.mark.slow
def test_threads_change_nothing(tmp_path):
    """Row 60: one thread or two, the same motion to 1e-9 mm; the same number twice, the same bytes."""
    image, found = write(tmp_path / "head.nii.gz"), {}
    for run, threads in (("a", "1"), ("b", "2"), ("c", "2")):
        numbers = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), threads)
        command = [sys.executable, "-c", "from xfemnav_cli.main import main; main()", "run", image, "--cut", CUT]
        subprocess.run([*command, *OPEN, *QUICK, "-o", tmp_path / run, "-w", tmp_path / f"cache-{run}", "-q"],
                       check=True, env=os.environ | numbers)
        names = json.loads((tmp_path / run / "run.json").read_text())["outputs"]
        found[run] = {role: tmp_path / run / name for role, name in names.items()}
    motion = {run: meshio.read(files["solution"]).point_data["displacement"] for run, files in found.items()}
    assert np.abs(motion["a"] - motion["b"]).max() < 1e-9
    assert all(path.read_bytes() == found["c"][role].read_bytes() for role, path in found["b"].items())
