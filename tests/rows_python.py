"""Rows of real data: what a user of Python, and a reader of the report, is shown."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from rows import Row

import xfemnav
from xfemnav.pipeline.flags import TABLE


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


ROWS = [
    Row("D", "dir(xfemnav), types of it", "private names, no types", public_names),
    Row("D", "python -m xfemnav", "No module named xfemnav.__main__", as_a_module),
    Row("D", "inspect.signature(xfemnav.run)", "**flags", visible_flags),
    Row("D", "xfemnav.run(..., elment_size_mm=3)", "unknown option", wrong_name),
]
