"""The Python surface: public names and their types, what `help()` shows of `run`, and `python -m xfemnav`."""

import copy
import inspect
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from pages import Tags
from small import CUT, write

import xfemnav
from data_synthetic import domains
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.pipeline.asking.settings import TABLE
from xfemnav.pipeline.telling import card
from xfemnav_cli.run import run as command

PUBLIC = {"Result", "Session", "XfemnavError", "XfemnavWarning", "__version__", "run"}
TAKERS = {"run": xfemnav.run, "Session": xfemnav.Session}


def python(*arguments, cwd=None):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=cwd)


def test_names_are_the_public_ones_before_and_after_they_are_used():
    code = ("import xfemnav, rlcompleter; before = dir(xfemnav), sorted(xfemnav.__all__);"
            "xfemnav.Session, xfemnav.run; import xfemnav.imaging.frames.slices; from xfemnav import *;"
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


# What a notebook shows -----------------------------------------------------------------------------------------------

EVIL = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The small brain, cut and opened by 4 mm, in out/."""
    home = tmp_path_factory.mktemp("notebook")
    xfemnav.run(write(home / "head.nii.gz"), cut=CUT, opening_mm=4.0, output=home / "out", cache=home / "cache",
                element_size_mm=8, corridor_element_mm=4, report=False)
    return home


@pytest.fixture
def result(home, monkeypatch):
    monkeypatch.chdir(home)
    return xfemnav.Result.load("out")


def changed(result, **facts):
    """The result with other facts in its record."""
    return xfemnav.Result(result.folder, copy.deepcopy(result.record) | facts)


def test_a_notebook_shows_verdict_picture_checks_and_files(result):
    page = result._repr_html_()
    parts = ("Complete, without warnings", "head.nii.gz", "<img ", "Neurological display", "<table", "Not checked: ",
             "<a ", "not a medical device")
    places = [page.index(part) for part in parts]
    assert places == sorted(places)
    found = Tags(page)
    assert [attrs["src"][:22] for tag, attrs in found.tags if tag == "img"] == ["data:image/png;base64,"]
    links = [attrs["href"] for tag, attrs in found.tags if tag == "a"]
    assert links == [f"out/{name}" for name in result.record["outputs"].values()]
    assert all(Path(link).is_file() for link in links)
    assert sum(tag == "tr" for tag, _ in found.tags) == 1 + len(result.record["verdicts"])
    assert len(page) < 200_000 and "left lip" not in page
    assert repr(result) == "<xfemnav.Result in 'out': Complete, without warnings>"


def test_names_in_a_card_cannot_become_markup(result):
    record = result.record
    cuts = [cut | {"name": f"<b>{EVIL}"} for cut in record["cuts"]]
    evil = changed(result, cuts=cuts, status="untrusted", error={"code": "E401", "text": EVIL},
                   warnings=[{"code": "W301", "text": EVIL}], parameters=record["parameters"] | {"image": EVIL},
                   outputs=record["outputs"] | {EVIL: "a'b\"<c>&#?.nii"})
    found = Tags(page := evil._repr_html_())
    assert [attrs.get("src", "")[:5] for tag, attrs in found.tags if tag == "img"] == ["data:"]
    assert not [attrs for _, attrs in found.tags if any(name.startswith("on") for name in attrs)]
    assert not {tag for tag, _ in found.tags} & {"script", "style", "link", "iframe"}
    assert "NOT TO BE TRUSTED" in found.text and found.text.count("alert(1)") >= 4
    assert page.index("NOT TO BE TRUSTED") < page.index("E401") < page.index("<table")
    assert "Not checked" not in page and "NOT TO BE TRUSTED" in repr(evil)


def test_a_card_is_small_whatever_is_in_the_record(result):
    many = [{"code": "W301", "text": "x" * 5000}] * 300
    outputs = result.record["outputs"] | {f"companion:{i}": f"a_{i}.nii.gz" for i in range(500)}
    page = changed(result, warnings=many, outputs=outputs)._repr_html_()
    assert len(page) < 200_000
    assert "and 295 more, in run.json" in page and f"and {len(outputs) - card.FILES} more in the folder" in page
    assert "Complete, 300 warnings" in page


@pytest.mark.parametrize("lost, reason", [("head.nii.gz", "E100"), ("out/head_desc-updated.nii.gz", "E100"),
                                          ("out/head_solution.vtu", "E100")])
def test_a_card_without_its_files_says_so(result, home, lost, reason):
    os.rename(home / lost, home / "elsewhere")
    try:
        page = xfemnav.Result.load("out")._repr_html_()
    finally:
        os.rename(home / "elsewhere", home / lost)
    assert "<img " not in page and f"No picture: {reason}" in page and "<table" in page


def test_a_record_of_an_earlier_version_has_a_card(result):
    """Without verdicts, ways to the inputs, and which way round it was shown."""
    early = {name: fact for name, fact in result.record.items() if name not in ("verdicts", "inputs")}
    early["parameters"] = {name: value for name, value in early["parameters"].items() if name != "display"}
    page = xfemnav.Result(result.folder, early)._repr_html_()
    assert "Complete, without warnings" in page and "No picture: E701" in page


def test_a_session_says_where_it_is():
    session = xfemnav.Session(distmesh(domains.disc(70.0), 12.0), corridor=[[0, 75], [0, 30]])
    assert repr(session) == f"<xfemnav.Session: {len(session.mesh.points)} nodes, uncut>"
    session.cut([[0, 75], [0, 30]])
    session.open(left=1.0, right=1.0)
    assert "nodes, cut from (0.0, 75.0) to (0.0, 30.0), moved by 0." in repr(session)
