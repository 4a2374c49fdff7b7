"""Messages call settings by marks, which the command line, Python and scenarios turn into their own words."""

import ast
import inspect
import json
import re
import warnings
from pathlib import Path

import click
import pytest
from small import CUT, OPEN, QUICK, write, xfemnav

import xfemnav as package
from xfemnav.errors import FAULTS, XfemnavError
from xfemnav.imaging.reading.gate import read_image
from xfemnav.naming import ARGUMENTS, MARK, kept, said, told
from xfemnav.pipeline.asking.flags import keys
from xfemnav.pipeline.asking.scenario import Scenario
from xfemnav.pipeline.asking.settings import FLAGS, KEYS, TABLE
from xfemnav_cli import main, telling

SOURCES = sorted((Path(__file__).parents[1] / "xfemnav").rglob("*.py"))
FOREIGN = {"--to-scanner"}  # options of other programs
OPTION = re.compile(r"(?<![\w-])(--[a-z][\w-]*|-[ow](?![\w-]))")


def strings(path):
    """Every text in a module, docstrings too: (line, text)."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def options() -> set[str]:
    """Names of all options of the command line."""
    def of(command):
        inner = command.commands.values() if isinstance(command, click.Group) else ()
        long = [name for p in command.params for name in p.opts if name.startswith("--")]
        plain = {p.name for p in command.params if isinstance(p, click.Argument)}
        return {name[2:].replace("-", "_") for name in long}.union(plain, *map(of, inner))

    return of(main.cli)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_no_text_below_the_command_line_names_an_option(path):
    found = {(line, name) for line, text in strings(path) for name in OPTION.findall(text) if name not in FOREIGN}
    assert not found or path.name == "naming.py"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_every_setting_that_a_text_names_exists_at_every_edge(path):
    of_python = {*inspect.signature(package.run).parameters, *TABLE,
                 *inspect.signature(package.Result.warp).parameters,
                 *inspect.signature(package.Result.landmarks).parameters}
    for line, text in strings(path):
        for name in re.findall(r"⟦!?(\w+)", text):
            if path.name != "naming.py":
                assert name in options() and name in of_python, f"line {line}: {name}"


def test_the_check_of_texts_sees_an_option():
    assert OPTION.findall("give --mask FILE, or another folder with -o.") == ["--mask", "-o"]
    assert not OPTION.findall("x,y -22,18 and -- a dash - or sub-01 and gzip-t")


def test_every_key_is_one_of_the_scenario():
    for place in {**FLAGS, **KEYS}.values():
        section = Scenario.model_json_schema()
        definitions = section["$defs"]
        for part in place.split("."):
            found = section["properties"][part]
            reference = re.search(r"#/\$defs/(\w+)", json.dumps(found))
            section = definitions[reference[1]] if reference else {}


@pytest.mark.parametrize("text, flags, arguments, of_scenario", [
    ("⟦lip_constraint=mortar⟧", "--lip-constraint mortar", 'lip_constraint="mortar"',
     'solve.lip_constraint = "mortar"'),
    ("⟦corridor_element_mm=0.5⟧", "--corridor-element-mm 0.5", "corridor_element_mm=0.5",
     "mesh.corridor_element_mm = 0.5"),
    ("⟦spacing=0.9,0.9⟧", "--spacing 0.9,0.9", "spacing=(0.9, 0.9)", "spacing = [0.9, 0.9]"),
    ("⟦space=ras|lps⟧", "--space ras|lps", 'space="ras"|"lps"', 'space = "ras"|"lps"'),
    ("⟦mask=FILE⟧", "--mask FILE", "mask=FILE", "mask = FILE"),
    ("⟦mask⟧", "--mask", "mask", "mask"),
    ("⟦internal=True⟧", "--internal", "internal=True", "cut.internal = true"),
    ("⟦right=-3.5,1⟧", "--right=-3.5,1", "right=(-3.5, 1)", "retract.displacement_mm = [-3.5, 1] (right)"),
    ("⟦opening_mm=7.3⟧", "--opening-mm 7.3", "opening_mm=7.3", "retract.normal_mm = 3.65 (left and right)"),
    ("⟦lip_force=left=-2,3⟧", "--lip-force left=-2,3", 'lip_force="left=-2,3"',
     "retract.force_mN_per_mm = [-2, 3] (left)"),
    ("⟦cut=x,y x,y ...⟧", '--cut "x,y x,y ..."', 'cut="x,y x,y ..."', "cut.points = [[x,y], [x,y], ...]"),
    ("⟦!left⟧", "--left", "left", "--left"),
    ("⟦output⟧", "-o", "output", "-o"),
    ("no mark, and an odd ⟦ one⟧", *["no mark, and an odd ⟦ one⟧"] * 3),
])
def test_a_setting_as_each_edge_calls_it(text, flags, arguments, of_scenario):
    assert (said(text, telling.FLAGS), said(text), said(text, keys(telling.FLAGS))) == (flags, arguments, of_scenario)


def test_where_all_settings_are_listed():
    assert said("⟦!?⟧", keys(telling.FLAGS)) == said("⟦?⟧", telling.FLAGS) == "See `xfemnav run --help`."
    assert said("⟦?⟧", keys(telling.FLAGS)) == "See `xfemnav schema` for every key."
    assert "help(xfemnav.run)" in said("⟦?⟧")


def test_an_error_is_told_to_users_of_python_unless_an_edge_says_otherwise():
    error = XfemnavError("E120", "say which one: ⟦slice=0⟧ to 4.")
    assert str(error) == "E120 say which one: slice=0 to 4." and error.message == str(error)[5:]
    assert error.told(telling.FLAGS) == "E120 say which one: --slice 0 to 4."
    error.names = keys(telling.FLAGS)
    assert error.told(telling.FLAGS) == "E120 say which one: slice.index = 0 to 4."


def test_a_record_of_one_edge_is_told_by_another():
    item = kept("W206", "give ⟦mask=FILE⟧.", telling.FLAGS)
    assert item["text"] == "give --mask FILE." and told(item, ARGUMENTS) == "give mask=FILE."
    assert kept("W302", "merged.") == {"code": "W302", "text": "merged."}


def test_no_remedy_keeps_a_mark():
    for fault in FAULTS.values():
        for text in (fault.cause, fault.remedy):
            assert "⟦" not in said(text) and all(MARK.search(part + "⟧") for part in re.findall(r"⟦[^⟧]*", text))


def test_a_warning_in_the_cache_is_told_as_the_edge_that_reads_it_does(tmp_path, capfd):
    """W211, of a cached stage: in a run by the command, one by Python, one by a scenario, and in their reports."""
    path = write(tmp_path / "a.nii.gz")
    given = ("--cut", CUT, *OPEN, *QUICK[:4], "--fill", 650, "-w", tmp_path / "cache")
    code, _, stderr = xfemnav(capfd, "run", path, *given, "-o", tmp_path / "flags")
    assert code == 0 and "W211" in stderr and "Leave --fill out" in stderr
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = package.run(path, cut=CUT, opening_mm=4, element_size_mm=8, corridor_element_mm=4, fill=650,
                           output=tmp_path / "python", cache=tmp_path / "cache").record
    assert any("Leave fill out" in str(item.message) for item in caught)
    assert any("Leave fill out" in item["text"] and "⟦fill⟧" in item["marked"] for item in made["warnings"])
    assert all(stage["status"] == "cached" for stage in made["stages"])
    (tmp_path / "a.toml").write_text('xfemnav = 1\nimage = "a.nii.gz"\n')
    code, _, stderr = xfemnav(capfd, "run", "--scenario", tmp_path / "a.toml", *given, "-o", tmp_path / "scenario")
    assert code == 0 and "Leave warp.fill out" in stderr
    pages = {(tmp_path / folder / "report.html").read_text() for folder in ("flags", "python", "scenario")}
    assert all("Leave warp.outside = " in page and "Leave warp.fill out" in page and "⟦" not in page for page in pages)


def test_a_failure_of_a_scenario_names_its_keys_and_what_was_typed(tmp_path, capfd):
    write(tmp_path / "a.nii.gz", read_image(write(tmp_path / "b.nii.gz")).values.repeat(2, axis=2))
    (tmp_path / "a.toml").write_text('xfemnav = 1\nimage = "a.nii.gz"\n[[cut]]\npoints = [[-60, 10], [-15, 5]]\n')
    run = ("run", "--scenario", tmp_path / "a.toml", "-w", tmp_path / "cache", "-o", tmp_path / "out")
    code, _, stderr = xfemnav(capfd, *run)
    assert code == 65 and "E120" in stderr and "slice.index = 0 to 1" in stderr
    code, _, stderr = xfemnav(capfd, *run, "--left", "3,4,5")
    assert code == 78 and "--left: wants" in stderr and "xfemnav run --help" in stderr
    with pytest.raises(XfemnavError, match=r"left: wants .*help\(xfemnav.run\)"):
        package.run(scenario=tmp_path / "a.toml", left="3,4,5")
