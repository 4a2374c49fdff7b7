"""A few of the changed bits and bytes of `make flips`, and that what must not be is noticed where it is."""

import multiprocessing
import os
import signal
import time

import numpy as np
import pytest

from tests.fuzz import flips, page
from tests.fuzz.intact import FORMATS, Anew, Format, none, whole
from xfemnav.errors import XfemnavError


@pytest.mark.parametrize("name", FORMATS)
def test_a_changed_bit_or_byte_is_refused_or_means_the_same_or_is_what_it_is(name):
    found = flips.tried(FORMATS[name], 4 if name in ("cache", "kernels", "dicom JPEG", "dicom JPEG 2000") else 25, 5)
    assert not set(found["came"]) & set(flips.BAD), found["examples"]


def planted(name: str):
    """A reader with a fault for every file that does not begin with its letter."""
    def read(path):
        if path.read_bytes()[0] == ord("A"):
            return b"value"
        match name:
            case "crash":
                os.kill(os.getpid(), signal.SIGKILL)
            case "hang":
                time.sleep(60)
            case "uncaught":
                raise KeyError("x")
            case "a warning":
                np.float64(1) / np.float64(0)
            case "memory":
                np.ones(13_000_000)  # more than the allocator keeps for the next one
            case "code":
                raise XfemnavError("E101", "damaged")
            case "anew":
                raise Anew
        return b"value" if name == "same" else b"another"
    return read


@pytest.mark.parametrize("name, came", [
    ("crash", "crash"), ("hang", "hang"), ("uncaught", "uncaught"), ("a warning", "uncaught"), ("memory", "memory"),
    ("code", "code"), ("anew", "anew"), ("same", "same"), ("other", "other"), ("covered", "covered")])
def test_what_comes_of_a_change_is_counted(name, came, monkeypatch):
    """Every change is that of the one byte, and the next file is sound again after a crash."""
    def make(folder):
        (folder / "a").write_bytes(b"A")
        return folder / "a"

    monkeypatch.setattr(flips, "SECONDS", 1 if name == "hang" else 10)
    found = flips.tried(Format(make, planted(name), whole if name == "covered" else none), 2)
    assert found["came"] == {came: 2} and bool(found["examples"]) == (came in flips.BAD)
    assert found["codes"] == ({"E101": 2} if name == "code" else {})
    assert not multiprocessing.active_children()


def test_the_page_is_that_of_the_counts():
    assert page.PAGE.read_text() == page.page(), "write it again: python -m tests.fuzz.page"
