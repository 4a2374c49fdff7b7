"""The command itself: exit codes, what is printed where, signals, concurrency, a full disk, and the small commands."""

import errno
import itertools
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jsonschema
import pytest
from small import CUT, OPEN, QUICK, write, xfemnav

from tests.test_chain import ROLES
from xfemnav.pipeline.asking.scenario import problems
from xfemnav.pipeline.keeping import disk, kernels, locks
from xfemnav.pipeline.running.runfile import run_schema
from xfemnav.pipeline.stages import stage_mesh
from xfemnav_cli.main import main
from xfemnav_cli.telling import printable

XFEMNAV = [sys.executable, "-c", "from xfemnav_cli.main import main; main()"]


@pytest.fixture
def head(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XFEMNAV_CACHE", str(tmp_path / "cache"))
    return write(tmp_path / "head.nii.gz")


def command(head, *more):
    return ["run", str(head), *QUICK, "--cut", CUT, *OPEN, *more]


def outputs(folder):
    """Bytes of every file that run.json names."""
    record = json.loads((folder / "run.json").read_text())
    jsonschema.validate(record, run_schema())
    return {role: (folder / name).read_bytes() for role, name in record["outputs"].items()}


# What is said, and where --------------------------------------------------------------------------------------------

def test_help_imports_no_numerics_and_no_schema():
    code = ("import sys; sys.argv = ['xfemnav', 'run', '--help']\nfrom xfemnav_cli.main import main\n"
            "try: main()\nexcept SystemExit: pass\n"
            "heavy = {'numpy', 'scipy', 'pydantic', 'nibabel', 'matplotlib', 'rich', 'jinja2'} & set(sys.modules)\n"
            "assert not heavy, heavy")
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "--tip-enrichment" in done.stdout


def test_a_cached_run_imports_no_numerics(head, capfd):
    assert xfemnav(capfd, *command(head))[0] == 0
    code = (f"import sys; sys.argv = {['xfemnav', *command(head)]!r}\nfrom xfemnav_cli.main import main\n"
            "try: main()\nexcept SystemExit as end: assert end.code == 0\n"
            "heavy = {'numpy', 'scipy', 'nibabel', 'matplotlib', 'numba'} & set(sys.modules)\nassert not heavy, heavy")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.count(" cached ") == 5, done.stderr


@pytest.mark.parametrize("wanted, told", [((), False), (("-W", "default"), True)])
def test_a_librarys_warning_is_told_to_those_who_ask_for_it(wanted, told):
    code = ("import warnings\nfrom xfemnav.pipeline.running import runfile\nfrom xfemnav_cli.main import main\n"
            "runfile.run_schema = lambda: warnings.warn('a library is in doubt', RuntimeWarning)\n"
            "main(['schema', 'run'])")
    done = subprocess.run([sys.executable, *wanted, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and ("in doubt" in done.stderr) == told


def test_stdout_has_one_line_a_stage_and_the_place_of_the_results(head, capfd):
    code, stdout, _ = xfemnav(capfd, *command(head))
    lines = stdout.splitlines()
    assert code == 0 and [line.split()[:2] for line in lines[:5]] == [
        [name, "ran"] for name in ("segment", "mesh", "constrain", "solve", "warp")]
    assert lines[5].startswith("where      cut 'cut' enters on the patient's left, ")
    assert lines[6].split() == ["results", "head_xfemnav"] and len(lines) == 7


def test_json_is_alone_on_stdout_and_quiet_says_nothing(head, capfd):
    code, stdout, stderr = xfemnav(capfd, *command(head, "--json"))
    assert code == 0 and json.loads(stdout)["status"] == "complete" and "segment" in stderr
    assert xfemnav(capfd, *command(head, "-q"))[1:] == ("", "")
    code, stdout, stderr = xfemnav(capfd, *command(head, "--json", "--poisson", "0.5"))
    assert code == 65 and json.loads(stdout)["error"]["code"] == "E404" and stderr.splitlines()[-1].startswith("E404 ")


def test_a_first_run_says_once_that_it_compiles_kernels(head, capfd, monkeypatch):
    def told(*more):
        return xfemnav(capfd, *command(head, *more))[2].count("compiling ")

    xfemnav(capfd, *command(head))
    for stage in kernels.SLOW:
        (Path(os.environ["NUMBA_CACHE_DIR"]) / f"{stage}.compiled").unlink()
    assert told() == 0  # nothing is computed
    assert told("--force", "--stop-after", "segment") == 0  # no slow ones
    assert told("--force") == 1 and told("--force") == 0


def test_usage_errors_are_exit_2(head, capfd):
    for wrong in (["run", "--no-such"], ["nothing"], ["run", str(head), "--slice", "x"], ["run", "--skull", "y"]):
        code, stdout, stderr = xfemnav(capfd, *wrong)
        assert code == 2 and "Usage" in stderr and stdout == ""


def test_a_bug_is_told_as_one(head, capfd, monkeypatch):
    def broken(value, inputs):
        raise RuntimeError("wrong\x1b[31m")

    monkeypatch.setattr(stage_mesh, "facts", broken)
    code, _, stderr = xfemnav(capfd, *command(head))
    assert code == 70 and stderr.splitlines()[-1].startswith("E900 ")
    assert "Traceback" not in stderr and "\x1b" not in stderr
    record = json.loads((head.parent / "head_xfemnav" / "run.json").read_text())
    jsonschema.validate(record, run_schema())
    assert record["status"] == "failed" and record["exit_code"] == 70
    assert "Traceback" in xfemnav(capfd, *command(head, "-vv"))[2]


@pytest.mark.parametrize("arguments", [["schema"], ["run"]])
def test_reader_that_goes_away_is_no_traceback(head, arguments):
    """Row 42, SIGPIPE: `xfemnav ... | head -0`."""
    arguments = command(head) if arguments == ["run"] else arguments
    process = subprocess.Popen([*XFEMNAV, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    stderr, _ = process.stderr.read(), process.wait()
    assert b"Traceback" not in stderr and b"Exception" not in stderr
    if arguments[0] == "run":
        record = json.loads((head.parent / "head_xfemnav" / "run.json").read_text())
        jsonschema.validate(record, run_schema())
        assert process.returncode == 141 == record["exit_code"] and record["status"] == "interrupted"
    process.stderr.close()


@pytest.mark.parametrize("streams, wanted", [("> /dev/full", 74), ("2> /dev/full", 0), ("> /dev/full 2>&1", 74),
                                             ("2>&-", 0), (">&-", 0), ("<&- >&- 2>&-", 0)])
@pytest.mark.parametrize("more", ["", " --json"])
def test_a_run_is_whole_where_nothing_can_be_said(head, capfd, streams, wanted, more):
    """A full or closed stdout or stderr is no reason to lose a result, nor to write a text into its files."""
    assert xfemnav(capfd, *command(head, "-o", "spoken"))[0] == 0
    line = shlex.join([*XFEMNAV, *command(head, "-o", "mute")])
    done = subprocess.run(["sh", "-c", f"{line}{more} {streams}"], capture_output=True, text=True)
    assert done.returncode == wanted and "Traceback" not in done.stderr
    assert outputs(head.parent / "mute") == outputs(head.parent / "spoken")


@pytest.mark.parametrize("line", ["--help", "schema", "doctor", "check case.toml", "cache ls"])
def test_a_text_that_cannot_be_written_is_no_bug(head, line):
    (head.parent / "case.toml").write_text("xfemnav = 1\n")
    done = subprocess.run(["sh", "-c", f"{shlex.join(XFEMNAV)} {line} > /dev/full"], capture_output=True, text=True)
    assert done.returncode in ((78, 74) if line.startswith("check") else (74,)) and "E900" not in done.stderr
    assert "Traceback" not in done.stderr


def test_names_from_a_scenario_and_a_cache_cannot_drive_the_terminal(head, capfd):
    (head.parent / "case\x1b[2J.toml").write_text('xfemnav = 1\nimage = "head.nii.gz"\n"\\u001b[31mred" = 1\n')
    for arguments in (("check", "case\x1b[2J.toml"), ("cache", "ls", "-w", "c\x1b[2J")):
        code, stdout, stderr = xfemnav(capfd, *arguments)
        assert code in (0, 78) and stdout and "\x1b" not in stdout + stderr


def test_printable_keeps_a_message_on_one_line():
    assert printable("a\nb\x1b[31m\udcff ü") == "a\\nb\\x1b[31m\\udcff ü"


# Stopped, crowded out, out of room ----------------------------------------------------------------------------------

def test_two_runs_in_one_folder_wait_for_each_other(head):
    pair = [subprocess.Popen([*XFEMNAV, *command(head, "--fill", fill)], stdout=subprocess.DEVNULL,
                             stderr=subprocess.PIPE, text=True) for fill in "12"]
    texts = [process.communicate(timeout=120)[1] for process in pair]
    assert [process.returncode for process in pair] == [0, 0], texts
    assert sum("waiting" in text for text in texts) <= 1
    assert outputs(head.parent / "head_xfemnav").keys() == ROLES


def killed_at_rename(n, arguments):
    """Run in a child that dies by SIGKILL just before its n-th rename; True if it got through instead."""
    child = os.fork()
    if child == 0:
        real, count = os.replace, itertools.count(1)

        def replace(source, target):
            if next(count) == n:
                os.kill(os.getpid(), signal.SIGKILL)
            real(source, target)

        os.replace = replace
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        try:
            main(arguments)
        except SystemExit as end:
            os._exit(end.code or 0)
    return os.waitpid(child, 0)[1] == 0


def test_death_before_any_rename_leaves_one_whole_run_or_a_folder_that_says_so(head, capfd):
    """A new opening changes most public files, one after the other: never a mixture under a complete record."""
    out = head.parent / "head_xfemnav"
    one, other = command(head), command(head, "--opening-mm", "3")
    xfemnav(capfd, *other, "-o", "other")
    new = outputs(head.parent / "other")
    for deaths in itertools.count():
        assert xfemnav(capfd, *one)[0] == 0
        old = outputs(out)
        if killed_at_rename(deaths + 1, other):
            break
        assert outputs(out) in ({}, old)
    assert deaths >= 6 and outputs(out) == new  # run.json, the solution, four images, and run.json again


def chaos(head, capfd, kills):
    """Two runs at once, both killed at random moments, over and over: whatever is left is whole and true."""
    out = head.parent / "head_xfemnav"
    start = time.monotonic()
    assert xfemnav(capfd, *command(head))[0] == 0
    truth = outputs(out)
    warm = time.monotonic() - start
    rng = random.Random(5)
    for n in range(kills // 2):
        if n % 3 == 0:
            shutil.rmtree(head.parent / "cache", ignore_errors=True)
        pair = [subprocess.Popen([*XFEMNAV, *command(head)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
                for _ in range(2)]
        time.sleep(rng.uniform(0.2, 1.0) * max(1.0, min(warm, 2.0)))
        for process in pair:
            process.kill()
            process.wait()
        left = outputs(out)
        assert left in ({}, truth)
        assert all((out / path.name).read_bytes() in truth.values() for path in out.glob("[!.]*.gz"))
    assert xfemnav(capfd, *command(head))[0] == 0 and outputs(out) == truth
    assert not list(out.glob(".*"))  # the last run removed what the killed ones left


def test_killed_runs_leave_nothing_wrong(head, capfd):
    chaos(head, capfd, 20)


@pytest.mark.slow
def test_killed_runs_leave_nothing_wrong_200_times(head, capfd):
    chaos(head, capfd, 200)


def test_full_disk_at_any_write_is_one_error_and_resumable(head, capfd, monkeypatch):
    """Row 40: the n-th fsync finds no space, for n = 1, 4, 7, ... until a run gets through."""
    real, countdown = os.fsync, [0]

    def fsync(handle):
        countdown[0] -= 1
        if countdown[0] == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    monkeypatch.setattr(disk.os, "fsync", fsync)
    out, failures = head.parent / "head_xfemnav", 0
    for n in range(1, 400, 3):
        countdown[0] = n
        code, _, stderr = xfemnav(capfd, *command(head))
        if code == 0:
            break
        assert code == 74 and stderr.splitlines()[-1].startswith("E501 "), stderr
        assert not (out / "run.json").exists() or outputs(out) == {}
        failures += 1
    assert failures > 5 and outputs(out).keys() == ROLES


def test_unwritable_cache_is_a_warning_and_unwritable_output_an_error(head, capfd):
    """Row 45; a file in the way, because root may write anywhere."""
    blocked = head.parent / "blocked"
    blocked.write_text("")
    code, _, stderr = xfemnav(capfd, *command(head, "-w", str(blocked / "cache")))
    assert code == 0 and "W602 " in stderr
    code, _, stderr = xfemnav(capfd, *command(head, "-o", str(blocked / "out")))
    assert code == 73 and stderr.startswith("E502 ")


def test_disk_without_locks_is_one_error(head, capfd, monkeypatch):
    """Row 45: flock on a network disk that has none."""
    def flock(handle, kind):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locks.fcntl, "flock", flock)
    code, _, stderr = xfemnav(capfd, *command(head))
    assert code == 73 and stderr.splitlines()[-1].startswith("E502 ")


# The other commands -------------------------------------------------------------------------------------------------

def test_stage_commands_end_after_their_stage(head, capfd):
    base = [str(head), "-o", "part"]
    mesh = [*base, "--element-size-mm", "8", "--corridor-element-mm", "4", "--cut", CUT]
    for stage, arguments, roles in (("segment", base, {"mask"}), ("mesh", mesh, {"mask", "mesh"}),
                                    ("constrain", [*mesh, *OPEN], {"mask", "mesh"}),
                                    ("solve", [*mesh, *OPEN], {"mask", "mesh", "solution", "cuts"})):
        code, stdout, stderr = xfemnav(capfd, stage, *arguments)
        done = [line for line in stdout.splitlines()[:-1] if not line.startswith("where")]
        assert code == 0 and done[-1].startswith(stage), stderr
        assert outputs(head.parent / "part").keys() == roles | {"scenario"}


def test_cache_can_be_listed_verified_and_pruned(head, capfd):
    xfemnav(capfd, *command(head))
    code, stdout, _ = xfemnav(capfd, "cache", "ls")
    assert code == 0 and stdout.splitlines()[-1].startswith("6 entries")  # the input's digest and five stages
    assert xfemnav(capfd, "cache", "verify")[0] == 0
    victim = sorted((head.parent / "cache" / "entries").glob("*/*/facts.json"))[0]
    victim.write_bytes(victim.read_bytes() + b" ")
    code, stdout, _ = xfemnav(capfd, "cache", "verify")
    assert code == 65 and "1 were damaged" in stdout
    assert xfemnav(capfd, "cache", "prune")[0] == 0 and len(list((head.parent / "cache").rglob("facts.json"))) == 5
    assert xfemnav(capfd, "cache", "prune", "--days", "0")[0] == 0
    assert not list((head.parent / "cache").rglob("facts.json"))


@pytest.mark.parametrize("name", ["report.html", "public/figure.png", "public/mesh.vtu"])
def test_a_damaged_entry_is_told_with_its_code_whatever_it_holds(head, capfd, name):
    drawn = [each for each in command(head) if each != "--no-report"]
    assert xfemnav(capfd, *drawn)[0] == 0
    damaged, = (head.parent / "cache" / "entries").glob(f"*/*/{name}")
    damaged.write_bytes(b"")
    code, _, stderr = xfemnav(capfd, *drawn)
    told = json.loads((head.parent / "head_xfemnav" / "run.json").read_text())["warnings"]
    assert code == 0 and [item["code"] for item in told] == ["W601"]
    assert [line.split()[0] for line in stderr.splitlines()] == ["W601"]


def test_check_lists_every_problem(head, capfd):
    path = head.parent / "case.toml"
    path.write_text('xfemnav = 1\nimage = "head.nii.gz"\n[[cut]]\npoints = [[0, 0], [1, 1]]\n')
    assert xfemnav(capfd, "check", path) == (0, f"{path}: no problem found\n", "")
    path.write_text('xfemnav = 2\nimage = "no.nii"\nspace = "mni"\n[meshh]\n')
    code, stdout, _ = xfemnav(capfd, "check", path)
    assert code == 78 and len(stdout.splitlines()) == 5
    path.write_text("""
xfemnav = 1
tissue = {young_kpa = -1, poisson = 0.5}
solve = {hold_tip = true}
cut = [{name = "a", points = [[0, 0]]}, {name = "b", points = [[1, 1], [1, 1]]},
       {name = "c", points = [[1e999, 0], [1, 1]]}]
retract = [{cut = "a", side = "left", displacement_mm = [1e999, 0]},
           {cut = "b", side = "left", normal_mm = 1, blade = [0.6, 0.2]}]
""")
    code, stdout, _ = xfemnav(capfd, "check", path)
    places = [line.split(":")[0].split(" ")[0] for line in stdout.splitlines()]
    assert code == 78 and sorted(places) == ["cut.0", "cut.1", "cut.2.points.0.0", "retract.0.displacement_mm.0",
                                             "retract.1", "solve", "tissue.poisson", "tissue.young_kpa"]


def test_schemas_are_schemas(capfd):
    for which in ("scenario", "run"):
        code, stdout, _ = xfemnav(capfd, "schema", which)
        assert code == 0
        jsonschema.Draft202012Validator.check_schema(json.loads(stdout))
    asked = {"xfemnav": 1, "image": "a.nii", "cut": [{"points": [[0, 0], [1, 1]]}]}
    schema = json.loads(xfemnav(capfd, "schema")[1])
    jsonschema.validate(asked, schema)
    assert problems(asked) == []
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(asked | {"spase": "ras"}, schema)


def test_demo_runs_the_papers_experiment(head, capfd):
    code, stdout, stderr = xfemnav(capfd, "demo", "-o", "demo", "--no-report", "--element-size-mm", "6",
                                   "--corridor-element-mm", "3", "--json")
    record = json.loads(stdout)
    assert code == 0 and record["slice"]["offset"] == 18.0 and record["parameters"]["cut"][0]["points"] == [
        [-54.7, 41.5], [-22.0, 18.0]], stderr
    assert [item["displacement_mm"] for item in record["parameters"]["retract"]] == [[3.5, 1.0], [-3.5, -1.0]]
    assert 100 < record["checks"]["cavity_mm2"] < 300  # two parallel lips 5.7 mm apart over 38 mm, closing at the tip
