"""Telling: what is typed wrongly and what is said of it, and words for where a cut lies."""

import os
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO

from rows import Row
from small import CUT, QUICK, write

import xfemnav
from xfemnav_cli.main import main

HALF = ("-60,10", "-15,5")
COARSE = {"element_size_mm": 8, "corridor_element_mm": 4, "report": False}


def typed(folder, *words) -> tuple[int, str]:
    """Exit status of a command in a folder with the image head.nii.gz, and what it says."""
    write(folder / "head.nii.gz")
    said, before = StringIO(), sys.argv
    with chdir(folder), redirect_stdout(said), redirect_stderr(said):
        os.environ["XFEMNAV_CACHE"], kept = str(folder / "cache"), os.environ.get("XFEMNAV_CACHE")
        sys.argv = ["xfemnav", *words]
        try:
            main(list(words))
        except SystemExit as end:
            return end.code or 0, " ".join(said.getvalue().split())
        finally:
            sys.argv = before
            del os.environ["XFEMNAV_CACHE"]
            if kept is not None:
                os.environ["XFEMNAV_CACHE"] = kept
    raise AssertionError("the command did not end")


def unquoted_points(folder):
    code, text = typed(folder, "run", "head.nii.gz", "--cut", *HALF, "--opening-mm", "6")
    assert code == 2 and f'quote it, --cut "{CUT}"' in text
    return text.partition("Error: ")[2], "exit 2"


def unquoted_vector(folder):
    code, text = typed(folder, "run", "head.nii.gz", "--cut", CUT, "--left", "3.5,", "1")
    assert code == 2 and 'quote it, --left "3.5,1"' in text
    return text.partition("Error: ")[2], "exit 2"


def one_number(folder):
    code, text = typed(folder, "run", "head.nii.gz", "--cut", CUT, "--left", "2", "--right", "2", *QUICK)
    assert code == 0 and text.endswith("results head_xfemnav"), "no warning comes after it"
    return "runs: each lip moves 2 mm away from the other", ""


def one_table(folder):
    (folder / "a.toml").write_text('xfemnav = 1\nimage = "head.nii.gz"\n[cut]\npoints = [[-60, 10], [-15, 5]]\n')
    code, text = typed(folder, "check", "a.toml")
    assert code == 78 and "[[cut]]" in text
    return text, "exit 78"


def flat_points(folder):
    (folder / "a.toml").write_text('xfemnav = 1\nimage = "head.nii.gz"\n[[cut]]\npoints = [-60, 10, -15, 5]\n')
    code, text = typed(folder, "check", "a.toml")
    assert code == 78 and "points = [[-60, 10], [-15, 5]]" in text and text.count("cut.0.points") == 1
    return text, "exit 78"


def where(folder):
    code, text = typed(folder, "run", "head.nii.gz", "--cut", CUT, "--opening-mm", "4", *QUICK)
    assert code == 0 and "enters on the patient's left, 8 mm in front of the origin, 10 mm above it" in text
    assert "the lip on its left lies towards the patient's front" in text
    return text.partition("where ")[2].partition(" results")[0], ""


def edges(folder):
    """One error as each edge tells it."""
    image = write(folder / "head.nii.gz")
    code, text = typed(folder, "run", "head.nii.gz", "--cut", CUT, "--poisson", "0.5")
    try:
        xfemnav.run(image, cut=CUT, poisson=0.5, output=folder / "out", cache=folder / "cache", **COARSE)
    except xfemnav.XfemnavError as error:
        assert "--poisson: " in text and "E404 poisson: " in str(error) and code == 65
        return f"{text[:40]} | {str(error)[:40]}", "E404"
    raise AssertionError("it was not refused")


ROWS = [
    Row("D3", "--cut -54.7,41.5 -22,18 without quotes", "No such option '-2'", unquoted_points),
    Row("D3", "--left 3.5, 1 without quotes", "unexpected extra argument (1)", unquoted_vector),
    Row("D2", "--left 2 --right 2", "refused, though a session takes it", one_number),
    Row("D3", "[cut] for [[cut]]", "input should be a valid tuple", one_table),
    Row("D3", "points = [x, y, x, y]", "four times 'input should be a valid tuple'", flat_points),
    Row("D2", "where the cut enters, and which lip is which", "nothing in words", where),
    Row("9", "an error of the mechanics", "names a flag, in Python too", edges),
]
