"""The Python surface: public names and their types, what `help()` shows of `run`, and `python -m xfemnav`."""

import inspect
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import xfemnav
from xfemnav.pipeline.flags import TABLE
from xfemnav_cli.run import run as command

PUBLIC = {"Result", "Session", "XfemnavError", "XfemnavWarning", "__version__", "run"}
TAKERS = {"run": xfemnav.run, "Session": xfemnav.Session}


def python(*arguments, cwd=None):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=cwd)


def test_names_are_the_public_ones_before_and_after_they_are_used():
    code = ("import xfemnav, rlcompleter; before = dir(xfemnav), sorted(xfemnav.__all__);"
            "xfemnav.Session, xfemnav.run; import xfemnav.imaging.slices; from xfemnav import *;"
            "found = rlcompleter.Completer({'xfemnav': xfemnav}).attr_matches('xfemnav.');"
            "print([*before, dir(xfemnav)], [name for name in found if not name.startswith('xfemnav._')])")
    done = python("-c", code)
    names = sorted(PUBLIC)
    assert done.stdout.startswith(str([names] * 3)), done.stderr
    for name in PUBLIC - {"__version__"}:
        assert f"'xfemnav.{name}" in done.stdout
    with pytest.raises(AttributeError, match="nothing"):
        xfemnav.nothing  # noqa: B018


def test_version_is_the_installed_one():
    assert xfemnav.__version__ == version("xfemnav")


def test_package_is_marked_as_typed():
    assert (Path(xfemnav.__file__).parent / "py.typed").is_file()


@pytest.mark.parametrize("owner", [xfemnav.Result, xfemnav.Session, xfemnav.XfemnavError])
def test_all_that_is_public_is_annotated(owner):
    for name, member in vars(owner).items():
        call = getattr(member, "func", None) or getattr(member, "fget", None) or getattr(member, "__func__", member)
        if inspect.isfunction(call) and (not name.startswith("_") or name == "__init__"):
            told = inspect.signature(call)
            given = [each.annotation for each in told.parameters.values() if each.name not in ("self", "cls")]
            assert inspect.Parameter.empty not in given, name
            assert name == "__init__" or told.return_annotation is not inspect.Signature.empty, name


@pytest.mark.parametrize("taker", TAKERS)
def test_every_flag_is_shown_with_its_default_and_meaning(taker):
    shown = inspect.signature(TAKERS[taker]).parameters
    assert set(TABLE) <= set(shown) and all(each.kind is not each.VAR_KEYWORD for each in shown.values())
    assert shown["element_size_mm"].default == 3.0 and shown["skull"].default == "fixed" and shown["cut"].default == ()
    assert "Literal['fixed', 'sliding'" in str(shown["skull"].annotation)
    text = inspect.getdoc(TAKERS[taker] if taker == "run" else TAKERS[taker].__init__)
    for name in TABLE:
        line = next(line for line in text.splitlines() if line.startswith(f"    {name}="))
        assert line.startswith(f"    {name}={shown[name].default!r}") and len(line.partition(": ")[2]) > 5, line
    assert max(map(len, text.splitlines())) <= 120


def test_defaults_are_those_of_the_commands_help():
    """Each option whose help says [a default] says the one that Python shows."""
    shown, compared = inspect.signature(xfemnav.run).parameters, 0
    for option in command.params:
        told = (getattr(option, "help", None) or "").rpartition("[")[2].rstrip("]")
        if option.name in TABLE and isinstance(shown[option.name].default, float | str):
            if told.replace(".", "").isdigit():
                assert float(told) == shown[option.name].default, option.name
            elif told in getattr(option.type, "choices", ()):
                assert told == shown[option.name].default, option.name
            else:
                continue
            compared += 1
    assert compared > 15


@pytest.mark.parametrize("wrong, meant", [
    ("elment_size_mm", "element_size_mm"), ("outputs", "output"), ("position_mm", "slice_mm"),
    ("opening", "opening_mm"), ("slice-mm", "slice_mm"), ("companions", "companion"),
    ("Cut", "cut"), ("--left", "left")])
def test_a_wrong_name_is_told_with_the_one_that_is_meant(wrong, meant):
    with pytest.raises(xfemnav.XfemnavError, match=f"E780 .*{wrong}: unknown option, did you mean '{meant}'") as caught:
        xfemnav.run("head.nii", cut="0,0 1,1", opening_mm=1.0, **{wrong: None})
    assert caught.value.code == "E780"
    with pytest.raises(xfemnav.XfemnavError, match=r"coridor: unknown option, did you mean 'corridor'"):
        xfemnav.Session("head.nii", coridor="0,0 1,1")
    with pytest.raises(xfemnav.XfemnavError, match=r"E780 zzz: unknown option[^,]*$"):
        xfemnav.run("head.nii", cut="0,0 1,1", opening_mm=1.0, zzz=1)


@pytest.mark.parametrize("arguments, code, text", [
    (("--version",), 0, "xfemnav, version"), (("--help",), 0, "Usage: xfemnav "), (("run",), 78, "E780"),
    (("rum",), 2, "Usage: xfemnav "), (("run", "nowhere.nii", "--cut", "0,0 1,1", "--opening-mm", "1"), 66, "E100")])
def test_the_package_is_the_command(tmp_path, arguments, code, text):
    done = python("-m", "xfemnav", *arguments, cwd=tmp_path)
    assert done.returncode == code and text in done.stdout + done.stderr
    assert "__main__" not in done.stdout + done.stderr and "Traceback" not in done.stderr
