"""Every run that README, docs and Makefile print does what it says, without a warning: coarse here, as printed below.

A page's scenario is saved where the page says; files of yours that README names are stood in for.
"""

import json
import re
import shlex
import shutil
import warnings
from pathlib import Path
from typing import NamedTuple

import pytest
from small import xfemnav

import xfemnav as package
from data_synthetic import files, surgery
from data_synthetic.phantom import Phantom
from xfemnav.errors import XfemnavWarning
from xfemnav.imaging.points.markups import write_markups
from xfemnav.imaging.points.point_set import PointSet

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/**/*.md"))]
COARSE = ("--element-size-mm", "6", "--corridor-element-mm", "1.5", "--no-report")
#: Where a scenario goes that its page gives no name.
UNNAMED = {"README.md": "case.toml", "docs/use/worked-case.md": "out/phantom/approach.toml",
           "docs/use/tissues-and-loads.md": "out/surgery/pressure.toml"}
#: The runs that are there to show what is not to be trusted: exit code and warnings.
SHOWN = {"--lips free": (3, {"W403"})}
APPROACH, TARGETS = [[-54.7, 41.5, 18.0], [-22.0, 18.0, 18.0]], [[-20.0, 33.0, 18.0], [-14.0, 10.0, 18.0]]


class Example(NamedTuple):
    """A command as it is printed, and the page."""

    page: str
    line: str


def scenarios(page: str) -> dict[str, str]:
    """The scenarios that a page prints, by the file that they are saved as."""
    text = (ROOT / page).read_text()
    printed = re.findall(r"^```toml\n(.*?)^```", text, re.M | re.S)
    whole = [scenario for scenario in printed if scenario.startswith("xfemnav = 1\n")]
    names = re.findall(r"[Ss]ave as `([\w/-]+\.toml)`", text)
    if page == "docs/use/steps.md":  # the file is written with the data
        names = ["out/surgery/surgery.toml"]
    return dict(zip([*names, UNNAMED.get(page)], whole, strict=False))


def examples() -> list[Example]:
    """Every run that is printed; a scenario without a command is run too."""
    found = [Example(page, line) for page in PAGES
             for line in re.findall(r"^ {4}(xfemnav (?:run|demo)\b.*)$", (ROOT / page).read_text(), re.M)]
    made = re.findall(r"^\t\$\(BIN\)/(xfemnav (?:run|demo)\b.*)$", (ROOT / "Makefile").read_text(), re.M)
    found += [Example("Makefile", line) for line in made if line not in {example.line for example in found}]
    run = " ".join(example.line for example in found)
    return found + [Example(page, f"xfemnav run --scenario {name}") for page in PAGES for name in scenarios(page)
                    if Path(name).name not in run]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with all data and scenarios of the pages."""
    home = tmp_path_factory.mktemp("examples")
    files.write(Phantom(), home / "out/phantom")
    data = surgery.write(home / "out/surgery")
    for role, name in {"image": "sub-01_T1w", "labels": "dseg", "grey": "motor_tmap"}.items():
        shutil.copy(data[role], home / f"{name}.nii.gz")
    write_markups(home / "approach.mrk.json", [PointSet("Curve", "approach", APPROACH, ("", ""))])
    write_markups(home / "landmarks.mrk.json", [PointSet("Fiducial", "landmarks", TARGETS, ("front", "caudate"))])
    for page in PAGES:
        for name, text in scenarios(page).items():
            (home / name).write_text(text)
    package.run(home / "out/phantom/sub-phantom_T1w.nii.gz", cut="58,50.2 25.4,22", opening_mm=4.0, element_size_mm=6.0,
                corridor_element_mm=1.5, report=False, output=home / "OUT", cache=home / "cache")
    return home


def check(line, home, monkeypatch, capfd, *more):
    """Run a line where its files are, and hold its record against what it is there to show."""
    words = shlex.split(line)
    named = [word for word in words if word.endswith(".toml") and not (home / word).is_file()]
    monkeypatch.chdir(next(home.rglob(named[0])).parent if named else home)
    code, out, err = xfemnav(capfd, *words[1:], *more, "-w", home / "cache", "--json")
    wanted, codes = next((SHOWN[word] for word in SHOWN if word in line), (0, set()))
    assert code == wanted, err
    record = json.loads(out)
    assert {item["code"] for item in record["warnings"]} == codes, record["warnings"]
    assert record["status"] == ("untrusted" if wanted else "complete")


IDS = {"ids": lambda example: f"{Path(example.page).stem}: {' '.join(example.line.split()[1:])[:60]}"}


@pytest.mark.parametrize("example", examples(), **IDS)
def test_an_example_runs_without_a_warning(example, home, monkeypatch, capfd):
    more = COARSE if "--element-size-mm" not in example.line else ()
    check(example.line, home, monkeypatch, capfd, *more)


@pytest.mark.slow
@pytest.mark.parametrize("example", examples(), **IDS)
def test_an_example_runs_as_it_is_printed(example, home, monkeypatch, capfd):
    check(example.line, home, monkeypatch, capfd)


@pytest.mark.parametrize("page", ["README.md", "docs/use/python.md"])
def test_python_of_a_page_runs_as_it_is_printed(page, home, monkeypatch):
    """All blocks in order, one after the other as a reader would; without a warning."""
    monkeypatch.chdir(home)
    monkeypatch.setenv("XFEMNAV_CACHE", str(home / "cache"))
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.M | re.S)
    names = {}
    with warnings.catch_warnings():
        warnings.simplefilter("error", XfemnavWarning)
        for block in blocks:
            exec(compile(block, page, "exec"), names)
    assert blocks and names["result"].trusted


def test_all_pages_with_scenarios_are_here():
    """Nothing that is printed is left out: all whole scenarios have a name, and those of the pages a run."""
    lines = " ".join(example.line for example in examples())
    for page in PAGES:
        whole = re.findall(r"^```toml\nxfemnav = 1\n", (ROOT / page).read_text(), re.M)
        assert len(scenarios(page)) == len(whole), page
        assert None not in scenarios(page), page
        assert all(Path(name).name in lines for name in scenarios(page)), page
    assert {"out/surgery/wide.toml", "case.toml"} <= {name for page in PAGES for name in scenarios(page)}
