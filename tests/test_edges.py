"""What the edge takes from users and their programs: any path, any number, any type; never a bug (E900) or a raw error.

The tables are of kinds: a path that loops, that is too long, that may not be read; values that are no setting's.
"""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from small import CUT, OPEN, QUICK, write, xfemnav

import xfemnav as python
from xfemnav.errors import XfemnavError
from xfemnav.pipeline.asking.config import configure

LONG = "n" * 300
RUN = ("run", "head.nii.gz", "--cut", CUT, *OPEN, *QUICK)
FILES = ("mask", "labels", "points", "streamlines", "surfaces", "mesh", "boundary-displacement", "companion")
SCENARIO = """xfemnav = 1
image = "{}"
[[cut]]
points = [[-60, 10], [-15, 5]]
[[retract]]
side = "left"
normal_mm = 2
"""
#: Commands with a path that is no good, and their exit status: 66 nothing there, 73 cannot write, 78 said by `check`.
DOORS = [
    (("run", "{}", "--cut", CUT, "-o", "out"), 66), *(((*RUN, f"--{name}", "{}"), 66) for name in FILES),
    ((*RUN, "--template", "{}", "--template-mask", "{}"), 66), (("run", "head.nii.gz", "--resect", "{}.nii"), 66),
    (("run", "head.nii.gz", "--cut", "{}.csv"), 66), ((*RUN, "-o", "{}"), 73), ((*RUN, "-o", "{}/x"), 73),
    (("run", "--scenario", "{}"), 66),
    (("run", "--scenario", "names.toml", "-o", "out"), 66), (("segment", "{}", "-o", "out"), 66),
    (("apply", "{}", "head.nii.gz"), 66), (("apply", "done", "{}"), 66), (("apply", "done", "{}.csv"), 66),
    (("apply", "done", "head.nii.gz", "-o", "{}"), 73), (("check", "{}"), 66), (("check", "names.toml"), 78),
    (("batch", "{}", "out"), 66), (("batch", "rows.tsv", "{}"), 73), (("doctor", "-w", "{}"), 73),
    (("cache", "ls", "-w", "{}"), 73), (("example", "phantom", "{}"), 73),
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a head, and a finished run of it in `done`."""
    folder = tmp_path_factory.mktemp("finished")
    image = write(folder / "head.nii.gz")
    python.run(image, cut=CUT, opening_mm=4, element_size_mm=8, corridor_element_mm=4, report=False,
               output=folder / "done", cache=folder / "cache")
    return folder


@pytest.fixture
def here(finished, tmp_path, monkeypatch):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XFEMNAV_CACHE", str(tmp_path / "cache"))
    return tmp_path


def looping(folder):
    for name in ("loop", "loop.nii", "loop.csv"):
        (folder / name).symlink_to(name)
    return "loop"


@pytest.mark.parametrize("words, status", DOORS, ids=lambda value: " ".join(value[:1] + value[-2:])
                         if isinstance(value, tuple) else str(value))
@pytest.mark.parametrize("bad", [looping, lambda folder: LONG], ids=["a loop", "a long name"])
def test_no_path_is_a_bug(here, capfd, bad, words, status):
    path = bad(here)
    (here / "names.toml").write_text(SCENARIO.format(path))
    (here / "rows.tsv").write_text(f"image\tcut\n{path}\t{CUT}\n")
    code, out, err = xfemnav(capfd, *(word.format(path) for word in words))
    assert code == status and "E900" not in out + err, out + err


def test_a_folder_that_may_not_be_read_is_told(here):
    """As an ordinary user: root gives up its right to read everything."""
    shut = here / "shut"
    shut.mkdir()
    (shut / "x.toml").write_text(SCENARIO.format("head.nii.gz"))
    shut.chmod(0)
    drop = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    if drop and not shutil.which("setpriv"):
        pytest.skip("root without setpriv")
    program = ("import sys, json; from xfemnav_cli.main import _outcome; "
               "print([_outcome(words) for words in json.loads(sys.argv[1])])")
    commands = [["check", "shut/x.toml"], ["batch", "shut/x.tsv", "out"], ["batch", "shut", "out"],
                [*RUN, "-o", "shut/z"], ["run", "shut/head.nii", "--cut", CUT], ["apply", "shut", "head.nii.gz"],
                ["apply", "done", "shut/a.csv"], ["run", "--scenario", "shut/x.toml"]]
    done = subprocess.run([*drop, sys.executable, "-c", program, json.dumps(commands)], capture_output=True, text=True)
    shut.chmod(0o755)
    assert done.stdout.splitlines()[-1] == "[66, 66, 2, 73, 66, 66, 66, 66]", done.stderr
    assert done.stderr.count("Permission denied") >= 6


NO_PATH = (3, np.zeros((2, 2)), b"abc", "a\0b", "", [3], {}, True, object())
NO_NUMBER = ("6", [3], 10**400, True, 1j, {}, 1e300, -1e300, float("nan"), 10**5000)
NO_POINTS = ([58, 50, 25, 22], np.array([58.0, 50, 25, 22]), {}, [["80", "05"], ["25", "22"]], 3, b"x", [[1, 2], [3]],
             [[1, None], [3, 4]], [[1j, 2], [3, 4]], [[True, 1], [2, 3]], [[10**400, 1], [2, 3]], "1e300,0 2,2",
             "nan,0 2,2")
NO_LIP = ((1, 1), 1, "middle=1,1", "1,1", {"left": 1}, "left=1e300,0", ("left=1,1", 3))
REFUSED = [
    *((name, value) for name in ("image", "scenario", "mask", "labels", "mesh", "companion", "points", "surfaces",
                                 "boundary_displacement") for value in NO_PATH),
    *(("opening_mm", value) for value in NO_NUMBER), *(("left", value) for value in (*NO_NUMBER[2:], "1e300", [1, {}])),
    *(("cut", value) for value in NO_POINTS), *(("resect", value) for value in NO_POINTS),
    *(("lip_force", value) for value in NO_LIP), *(("blade", value) for value in (0.8, {}, [1, 2, 3], [None, 1])),
    *(("young_kpa", value) for value in (1e300, 10**400, "3", True)), ("spacing", [1e300, 1]), ("spacing", "0,1"),
    ("gravity", 3), ("slice", 10**5000), ("slice", -1), ("companion", [("foo", "head.nii.gz")]), ("internal", "no"),
]


@pytest.mark.parametrize("name, value", REFUSED, ids=lambda value: str(type(value).__name__))
def test_what_is_no_setting_is_refused_by_its_name(name, value):
    flags = {"cut": CUT, **({"opening_mm": 2} if name not in ("left", "lip_force") else {})} | {name: value}
    image = flags.pop("image", "head.nii.gz")
    with pytest.raises(XfemnavError) as caught:
        configure(image, flags.pop("scenario", None), flags)
    assert caught.value.code in ("E780", "E404") and caught.value.message.startswith(f"{name}: ")


@pytest.mark.parametrize("key, value", [("normal_mm", 1e300), ("normal_mm", -1e300), ("displacement_mm", [1e300, 0]),
                                        ("force_mN_per_mm", [0, 1e300])])
def test_numbers_of_a_scenario_are_bounded_by_their_key(here, key, value):
    (here / "huge.toml").write_text(SCENARIO.format("head.nii.gz").replace("normal_mm = 2", f"{key} = {value}"))
    with pytest.raises(XfemnavError, match=rf"E780 retract\.0\.{key}.* than or equal to"):
        configure(scenario=here / "huge.toml")


def test_a_number_of_thousands_of_digits_is_no_toml(here):
    (here / "digits.toml").write_text(f"xfemnav = {'1' * 5000}\n")
    with pytest.raises(XfemnavError, match=r"E780 .*digits"):
        configure(scenario=here / "digits.toml")


def test_the_largest_opening_ends_as_too_large(here, capfd):
    """Bounded numbers stay numbers: what the largest does is judged, and is no matrix of NaN."""
    code, _, err = xfemnav(capfd, "run", "head.nii.gz", "--cut", CUT, "--left=1e9", *QUICK, "-o", "huge")
    assert code == 65 and "E406" in err and "a blade is asked for too much" in err, err


NO_ROWS = ([1], [], "a", [[1, 2, 3, 4]], None, [1j, 2], True, [[1, 2], [3]], {}, [["1", "2"]], [10**400, 1])


def test_a_result_refuses_what_are_no_points(here):
    result = python.Result.load("done")
    for ask in (result.to_current, result.to_preoperative, result.displacement, result.landmarks):
        for points in NO_ROWS:
            with pytest.raises(XfemnavError, match="E780 points are numbers"):
                ask(points)
    for call in (python.Result.load, result.streamlines, result.surface, result.write_transform):
        for path in NO_PATH:
            with pytest.raises(XfemnavError, match=r"E780 .*wants the path"):
                call(path)
    for values in (3, None, b"x", [], [[1]]):
        with pytest.raises(XfemnavError, match="E130"):
            result.warp(values)
    assert result.to_current(np.empty((0, 2))).shape == (0, 2)


# What a run has made --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("role", ["solution", "mesh", "mask", "updated"])
def test_outputs_that_are_not_the_runs_are_refused(here, capfd, role):
    name = json.loads((here / "done/run.json").read_text())["outputs"][role]
    data = (here / "done" / name).read_bytes()
    (here / "done" / name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(XfemnavError, match="E703"):
        python.Result.load("done").updated  # noqa: B018
    assert (role == "updated") == (xfemnav(capfd, "apply", "done", "head.nii.gz")[0] == 0)
    code, out, _ = xfemnav(capfd, "check", "done")
    assert code == 65 and f"E703 outputs.{role}: " in out


def test_a_record_of_another_run_is_refused_and_one_of_before_is_read(here):
    record = json.loads((here / "done/run.json").read_text())
    record["digests"]["solution"] = "0" * 64
    (here / "done/run.json").write_text(json.dumps(record))
    with pytest.raises(XfemnavError, match=r"E703 .*another run"):
        python.Result.load("done")
    del record["digests"]
    (here / "done/run.json").write_text(json.dumps(record))
    assert python.Result.load("done").updated.values.any()


def test_an_output_that_is_a_pipe_is_never_waited_for(here):
    path = here / "done" / json.loads((here / "done/run.json").read_text())["outputs"]["solution"]
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(XfemnavError, match=r"E106 .*pipe"):
        python.Result.load("done")


@pytest.mark.parametrize("image", ["head.nii.gz", os.fsdecode(b"head-\xff.nii.gz")])
def test_names_that_are_no_utf_8_can_be_opened_again(here, capfd, image):
    folder = os.fsdecode(b"out-\xff\\ud800")
    write(here / image)
    words = [image if word == "head.nii.gz" else word for word in RUN]
    assert xfemnav(capfd, *words, "-o", folder)[0] == 0
    assert xfemnav(capfd, "apply", folder, "head.nii.gz", "-o", "moved")[0] == 0


@pytest.mark.parametrize("words", [("run", ""), (*RUN, "-o", ""), (*RUN, "-w", ""), (*RUN, "--mask", ""), ("check", ""),
                                   ("apply", "", "x"), ("batch", "", ""), ("cache", "ls", "-w", ""),
                                   ("example", "phantom", "")])
def test_no_text_is_no_path(here, capfd, words):
    code, _, err = xfemnav(capfd, *words)
    assert code == 2 and "an empty text is no path" in err


# What messages say ----------------------------------------------------------------------------------------------------


def test_scenarios_are_told_by_keys_and_flags_by_flags(here, capfd):
    (here / "both.toml").write_text(SCENARIO.format("head.nii.gz") + "[tissue]\npoisson = 0.7\n[slice]\nindex = -1\n")
    _, _, err = xfemnav(capfd, "run", "--scenario", "both.toml", "--young-kpa", "-1")
    assert all(word in err for word in ("tissue.poisson: ", "slice.index: ", "--young-kpa: ")), err
    told = [(("--opening-mm", "nan"), "--opening-mm: "), (("--spacing", "0,1"), "--spacing: "),
            (("--resect", "1,2"), "--resect: "),
            (("--lip-force", "links=1,1"), "--lip-force: "), (("--resect", "label=3"), "--resect: "),
            (("--gravity", "0"), "--gravity: "), (("--companion", "foo=a.nii"), "one of continuous, label")]
    for words, name in told:
        code, _, err = xfemnav(capfd, "run", "head.nii.gz", "--cut", CUT, *words)
        assert code == 78 and name in err, err


def test_a_lip_moved_towards_the_other_is_mended_by_the_key_of_a_scenario(here, capfd):
    (here / "in.toml").write_text(SCENARIO.format("head.nii.gz").replace("= 2\n", "= -2\n"))
    _, _, err = xfemnav(capfd, "run", "--scenario", "in.toml", *QUICK, "-o", "in")
    assert "W411" in err and "give retract.normal_mm = 2 (left)" in err


@pytest.mark.parametrize("name, text, words", [
    ("a.tsv", "image\tname\nhead.nii.gz\tbatch.tsv\n", "no name of a folder"),
    ("a.tsv", "image,cut\nhead.nii.gz,1\n", "tabs between its cells"),
    ("a.csv", "image,cut\n", "holds no rows under a header"), ("a.csv", "", "is empty")])
def test_a_manifest_that_is_none_is_told(here, capfd, name, text, words):
    (here / name).write_text(text)
    assert words in xfemnav(capfd, "batch", name, "out")[2]


def test_a_cut_that_is_said_to_be_internal_and_is_not_is_warned_of():
    from xfemnav.geometry.plane.cut import place_cut

    square = np.array([[0.0, 0], [50, 0], [50, 50], [0, 50]])
    with pytest.warns(python.XfemnavWarning, match="W307"):
        assert place_cut([[-5.0, 25], [25, 25]], square, internal=True).mouth


def test_points_and_tracts_off_the_slice_are_warned_of(here):
    from nibabel.streamlines import Tractogram, save

    result = python.Result.load("done")
    with pytest.warns(python.XfemnavWarning, match="W132 1 of 1 points lie off the slice"):
        result.to_current([0.0, 0.0, 90.0])
    save(Tractogram([np.array([[0.0, 0, 90], [5, 0, 95]])], affine_to_rasmm=np.eye(4)), "far.tck")
    with pytest.warns(python.XfemnavWarning, match="W132 no streamline comes to the slice"):
        result.streamlines("far.tck")
