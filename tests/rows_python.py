"""Rows of real data: what a user of Python, and a reader of the report, is shown."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from rows import Row
from small import CUT, write

import xfemnav
from xfemnav.pipeline.asking.settings import TABLE


def public_names(folder):
    found = dir(xfemnav)
    assert found == sorted(["Result", "Session", "XfemnavError", "XfemnavWarning", "__version__", "run"])
    assert (Path(xfemnav.__file__).parent / "py.typed").is_file()
    return f"{len(found)} names, typed", ""


def as_a_module(folder):
    done = subprocess.run([sys.executable, "-m", "xfemnav", "--version"], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0 and done.stdout == f"xfemnav, version {xfemnav.__version__}\n"
    return done.stdout.strip(), ""


def visible_flags(folder):
    shown = inspect.signature(xfemnav.run).parameters
    text = inspect.getdoc(xfemnav.run)
    assert all(name in shown and f"    {name}={shown[name].default!r}" in text for name in TABLE)
    return f"{len(TABLE)} flags with their defaults", ""


def wrong_name(folder):
    with pytest.raises(xfemnav.XfemnavError, match="did you mean 'element_size_mm'") as caught:
        xfemnav.run(folder / "head.nii", cut="0,0 1,1", opening_mm=4.0, elment_size_mm=3.0)
    return "did you mean 'element_size_mm'?", caught.value.code


def other_way_round(folder):
    """The same run in both conventions: the letters change sides, and no byte of data."""
    image = write(folder / "head.nii.gz")
    shown = {}
    for way in ("neurological", "radiological"):
        shown[way] = xfemnav.run(image, cut=CUT, opening_mm=4.0, display=way, element_size_mm=8, corridor_element_mm=4,
                                 output=folder / way, cache=folder / "cache")
    first, second = shown.values()
    assert [stage["key"] for stage in first.record["stages"]] == [stage["key"] for stage in second.record["stages"]]
    differ = {path.name for path in first.folder.iterdir()
              if path.read_bytes() != (second.folder / path.name).read_bytes()}
    assert differ == {"figure.png", "report.html", "run.json", "scenario.toml"}
    for way, side in (("neurological", "left"), ("radiological", "right")):
        page = (folder / way / "report.html").read_text()
        assert f"{way.title()} display: the patient&#39;s {side} on the left" in page and "left lip" not in page
    return "figure and report, each says which; data byte for byte the same", ""


def five_steps(folder):
    write(folder / "head.nii.gz")
    (folder / "case.toml").write_text(FIVE)
    result = xfemnav.run(scenario=folder / "case.toml", output=folder / "out", cache=folder / "cache")
    page = (result.folder / "report.html").read_text()
    assert page.count("<img ") == 5 and "Not checked: whether the mask is the organ" in page
    assert all(f'<a href="{name}">' in page for name in result.record["outputs"].values())
    assert len(page.encode()) < 1_700_000
    return f"{len(page.encode()) / 1e6:.2f} MB, with links to all files", ""


FIVE = """xfemnav = 1
image = "head.nii.gz"
mesh = { element_size_mm = 8.0, corridor_element_mm = 4.0 }
cut = [{ points = [[-60, 10], [-15, 5]] }]
retract = [{ side = "left", normal_mm = 2.0 }]
step = [{ name = "a", acts = ["cut", "cut left"] }, { name = "b" }, { name = "c" }, { name = "d" }, { name = "e" }]
"""

def in_a_notebook(folder):
    result = xfemnav.run(write(folder / "head.nii.gz"), cut=CUT, opening_mm=4.0, report=False, element_size_mm=8,
                         corridor_element_mm=4, output=folder / "out", cache=folder / "cache")
    page = result._repr_html_()
    assert page.index("Complete, without warnings") < page.index("<img ") < page.index("<table") < page.index("<a ")
    assert len(page) < 200_000
    return f"{len(page) / 1e3:.0f} kB: verdict, before and after, checks, links to files", ""


ROWS = [
    Row("D", "dir(xfemnav), types of it", "private names, no types", public_names),
    Row("D", "python -m xfemnav", "No module named xfemnav.__main__", as_a_module),
    Row("D", "inspect.signature(xfemnav.run)", "**flags", visible_flags),
    Row("D", "xfemnav.run(..., elment_size_mm=3)", "unknown option", wrong_name),
    Row("D", "a Result in a notebook", "its address in memory", in_a_notebook),
    Row("D", "--display radiological", "neurological alone", other_way_round),
    Row("D", "report of five steps", "6.5 MB, no links", five_steps),
]
