"""The pages say what the program does: codes, commands, options, scenarios, keys and links are held against it."""

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest

from xfemnav.errors import FAULTS
from xfemnav.pipeline.asking.scenario import problems
from xfemnav.pipeline.keeping.names import NAMES
from xfemnav.pipeline.telling import errordocs, scenariodocs
from xfemnav.pipeline.telling.report import CHECKS, worded
from xfemnav_cli.main import cli

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FOLDERS = ("use", "reference", "method", "measured")
SOURCES = [*(ROOT / "xfemnav").rglob("*.py"), *(ROOT / "cli").rglob("*.py")]
CODE = re.compile(r"\b[EW]\d{3}\b")


def options(command: click.Command) -> set[str]:
    return {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}


def commands(page: str):
    """The words of every `xfemnav ...` line of the page's indented blocks, without comments."""
    for line in re.findall(r"^ {4}(xfemnav .*)$", page, flags=re.MULTILINE):
        yield shlex.split(line, comments=True)


def links(page: Path) -> list[tuple[str, str]]:
    """Targets in this project of a page's links: file, anchor."""
    return [(target, anchor) for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text())
            if "://" not in target]


def anchors(page: Path) -> set[str]:
    """What a git host calls the headings of a page."""
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
            for heading in re.findall(r"^#+ (.*)$", page.read_text(), flags=re.MULTILINE)}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name, writer", [("errors", errordocs), ("scenario", scenariodocs)])
def test_written_pages_are_those_of_the_program(name, writer):
    again = f"write it again: python -m {writer.__name__} > docs/reference/{name}.md"
    assert (ROOT / f"docs/reference/{name}.md").read_text() == writer.page(), again


MEASURED = ("accuracy", "networks", "finite_strain", "sensitivity", "segmentation", "performance", "volume")
MESHLESS = ("benchmarks.mutations", "tests.fuzz.page")  # they need no mesh of another program's


@pytest.mark.parametrize("name", [*(f"benchmarks.{name}" for name in MEASURED), *MESHLESS])
def test_measured_pages_say_what_is_kept(name, tmp_path):
    """Written again from the kept results, a page is as it stands; and it says which command measured it."""
    if name not in MESHLESS:
        pytest.importorskip("gmsh")
    for folder in ("benchmarks", "tests"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("measured", "figures"):
        (tmp_path / "docs" / folder).mkdir(parents=True)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-m", name, "--page"], cwd=tmp_path, env=environment, check=True)
    page, = (tmp_path / "docs/measured").iterdir()
    assert page.read_text() == (ROOT / "docs/measured" / page.name).read_text()
    assert f"`python -m {name}`" in page.read_text()


def test_every_key_of_a_scenario_is_explained():
    rows = re.findall(r"^\| `(\w+)` \|.*\| ([^|]*) \| [^|]* \|$", scenariodocs.page(), flags=re.MULTILINE)
    assert len(rows) > 30
    assert [key for key, meaning in rows if not meaning.strip()] == ["side"], "left or right says it all"


def test_every_code_has_a_group_and_a_sentence():
    for code, fault in FAULTS.items():
        assert sum(code.startswith(start) for start in errordocs.GROUPS) == 1, code
        assert fault.cause.endswith(".") and fault.remedy.endswith((".", ")", "`")), code
        assert (fault.exit_code == 0) == code.startswith("W"), code


def test_every_code_in_the_program_is_in_the_table_and_every_row_is_used():
    used = set()
    for path in SOURCES:
        if path.name != "errors.py":
            strings = [node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)]
            used |= {code for text in strings if isinstance(text, str) for code in CODE.findall(text)}
    assert used - set(FAULTS) == set(), "raised, but not in the table"
    assert set(FAULTS) - used == set(), "in the table, but never raised"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_command_on_a_page_can_be_parsed(page):
    for words in commands(page.read_text()):
        command, rest = cli, words[1:]
        while isinstance(command, click.Group):
            assert rest and rest[0] in command.commands, words
            command, rest = command.commands[rest[0]], rest[1:]
        with command.make_context("xfemnav", rest, resilient_parsing=False):
            pass


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_option_on_a_page_exists(page):
    known = {"--help"}
    stack = [cli]
    while stack:
        command = stack.pop()
        known |= options(command)
        stack += command.commands.values() if isinstance(command, click.Group) else ()
    own = "\n".join(line for line in page.read_text().splitlines() if "benchmarks" not in line)
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", own)) <= known


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_scenario_on_a_page_is_valid(page):
    for text in blocks(page.read_text(), "toml"):
        assert problems(tomllib.loads(text)) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_python_block_compiles(page):
    for block in blocks(page.read_text(), "python"):
        ast.parse(block)


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_somewhere(page):
    for target, anchor in links(page):
        assert (page.parent / target).exists(), target
        assert not anchor or anchor in anchors(page.parent / target if target else page), f"{target}#{anchor}"


def test_every_page_is_in_the_index_once_with_what_it_answers():
    """And lies in one of the four folders; a figure is on some page."""
    index = ROOT / "docs/README.md"
    rows = re.findall(r"^\| \[([\w-]+)\]\(([\w/.-]+)\) \| (\S.*\?) \|$", index.read_text(), flags=re.MULTILINE)
    assert [f"{Path(target).parent}/{name}.md" for name, target, _ in rows] == [target for _, target, _ in rows]
    pages = {page.relative_to(index.parent).as_posix() for page in PAGES[1:]} - {"README.md"}
    assert sorted(target for _, target, _ in rows) == sorted(pages)
    assert {str(Path(page).parent) for page in pages} == set(FOLDERS)
    shown = {(page.parent / target).resolve() for page in PAGES for target, _ in links(page)}
    assert set((ROOT / "docs").rglob("*.png")) <= shown


def test_every_page_and_figure_that_the_code_names_is_there():
    folders = ("xfemnav", "cli", "tests", "benchmarks", "docs", "data_synthetic")
    for path in [ROOT / "Makefile", *PAGES, *(path for name in folders for path in (ROOT / name).rglob("*.py"))]:
        for name in re.findall(r"\bdocs/[a-z0-9/_-]+\.(?:md|png|py)\b", path.read_text()):
            assert (ROOT / name).exists(), f"{path.name}: {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_code_on_a_page_exists(page):
    assert set(CODE.findall(page.read_text())) <= set(FAULTS)


def test_page_of_outputs_names_every_file_key_and_check():
    text = (ROOT / "docs/reference/outputs.md").read_text()
    schema = json.loads((ROOT / "xfemnav/pipeline/running/run.schema.json").read_text())["properties"]
    names = [name + ":NAME" if name == "companion" else name for name in NAMES]
    for name in [*names, "figure", "report", *schema, *schema["checks"]["properties"]]:
        assert f"`{name}`" in text, name
    shown = {worded(name, dimension) for name in CHECKS for dimension in (2, 3)}
    assert shown == set(schema["checks"]["properties"]), "the report shows every check"


def test_makefile_describes_every_target():
    text = (ROOT / "Makefile").read_text()
    phony = set(re.search(r"^\.PHONY: (.*)$", text, flags=re.MULTILINE)[1].split())
    described = set(re.findall(r"^([a-z0-9-]+):.*## ", text, flags=re.MULTILINE))
    assert phony == described
    assert {"demo", "paper", "batch", "test", "test-all", "lint", "bench"} <= phony


def test_worked_case_is_one_command_in_all_its_places():
    """README, docs and Makefile run the same command, and the picture is of its run."""
    line = next(line.strip() for line in (ROOT / "README.md").read_text().splitlines() if "-o out/worked-case" in line)
    assert line in (ROOT / "docs/use/worked-case.md").read_text()
    assert line in (ROOT / "Makefile").read_text()


@pytest.mark.slow
def test_worked_case_runs_as_it_is_written(tmp_path):
    """Every command, the scenario and the Python block of the page, in a folder of their own."""
    text = (ROOT / "docs/use/worked-case.md").read_text()
    call = "from xfemnav_cli.main import main; main()"
    programs = {"python": [sys.executable], "xfemnav": [sys.executable, "-c", call]}
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XFEMNAV_CACHE": str(tmp_path / "cache")}
    before, after = text.split("## The same as a scenario")
    for part, folder in ((before, tmp_path), (after, tmp_path / "out/phantom")):
        for scenario in blocks(part, "toml"):
            (folder / "approach.toml").write_text(scenario)
        for line in re.findall(r"^ {4}((?:python|xfemnav) .*)$", part, flags=re.MULTILINE):
            name, *words = shlex.split(line)
            subprocess.run([*programs[name], *words], cwd=folder, env=environment, check=True)
    lines = [line.split("#")[0].rstrip() for line in blocks(text, "python")[0].splitlines()]
    shown = "\n".join(f"print({line})" if line.startswith("result.") else line for line in lines)
    done = subprocess.run([sys.executable, "-c", shown], cwd=tmp_path, capture_output=True, text=True, check=True)
    vectors = [[float(x) for x in line.strip("[]").split()] for line in done.stdout.splitlines()]
    assert [len(vector) for vector in vectors] == [2, 2, 2]
    assert json.loads((tmp_path / "out/worked-case/run.json").read_text())["warnings"] == []
