"""Words for where in the patient a cut enters, which lip is which, and where a resection lies."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import Rotation
from small import CUT, OPEN, QUICK, write, xfemnav

from tests.images import ORDERS, affine_of, image_of, stored
from xfemnav.geometry.plane.cut import Cut
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.pipeline.telling.bearings import Bearings, told, towards

PLAIN = np.eye(3)
MIDDLE = np.array([10.0, 20.0, 30.0])  # of a ball, RAS mm: its left half is not the left of the origin


def ball(turn=PLAIN, code=2):
    """A volume with a ball of 40 mm, turned against the world."""
    size = 61
    affine = affine_of(turn * 2.0, MIDDLE - turn @ np.full(3, size - 1.0))
    centre = (size - 1) / 2
    values = (np.linalg.norm(np.indices((size,) * 3) - centre, axis=0) * 2 < 40).astype(float)
    return image_of(values, affine, code=code)


def bearings_in(plane, image=None):
    image = ball() if image is None else image
    slice = take_slice(image, plane=plane, index=30)
    return Bearings(slice, slice.values > 0), slice


def words(plane, start, end, image=None, mouth=True):
    """What is said of a cut between two places in the world."""
    bearings, slice = bearings_in(plane, image)
    return bearings.of_cut(Cut(slice.from_world(np.array([start, end], float))[0], mouth=mouth))


@pytest.mark.parametrize("plane, start, end, place, lips", [
    ("axial", (-30, 20, 30), (0, 20, 30), "enters on the patient's left, 20 mm in front of the origin, 30 mm above it",
     "the lip on its left lies towards the patient's front, the one on its right towards the back"),
    ("axial", (50, 0, 30), (20, 0, 30), "enters on the patient's right, level with the origin, 30 mm above it",
     "the lip on its left lies towards the patient's back, the one on its right towards the front"),
    ("axial", (11, 60, 30), (11, 30, 30), "enters near the patient's middle, 60 mm in front of the origin, 30 mm above",
     "the lip on its left lies towards the patient's right, the one on its right towards the left"),
    ("axial", (-18, -8, 30), (10, 20, 30), "enters on the patient's left, 8 mm behind the origin, 30 mm above it",
     "the lip on its left lies towards the patient's left and front, the one on its right towards the right and back"),
    ("coronal", (10, 20, 70), (10, 20, 40), "enters near the patient's middle, 20 mm in front of the origin, 70 mm",
     "the lip on its left lies towards the patient's right, the one on its right towards the left"),
    ("coronal", (-30, 20, -10), (0, 20, -10), "enters on the patient's left, 20 mm in front of the origin, 10 mm below",
     "the lip on its left lies towards the patient's head, the one on its right towards the feet"),
    ("sagittal", (10, 60, 0), (10, 30, 0), "enters 10 mm right of the origin, 60 mm in front of it, at its height",
     "the lip on its left lies towards the patient's feet, the one on its right towards the head"),
])
def test_where_a_cut_enters_in_every_plane(plane, start, end, place, lips):
    found = words(plane, start, end)
    assert place in found and found.endswith(lips)


@pytest.mark.parametrize("order, flips", ORDERS[::7])
def test_it_does_not_depend_on_how_the_file_is_stored(order, flips):
    plain = words("axial", (-30, 20, 30), (0, 20, 30))
    bearings, slice = bearings_in("axial", stored(ball(), order, flips))
    assert bearings.of_cut(Cut(slice.from_world(np.array([(-30.0, 20, 30), (0, 20, 30)]))[0])) == plain


def test_an_oblique_slice_is_told_by_the_world():
    """Turned by 20 degrees about the axis from left to right: the lip above the cut is in front and above."""
    turn = Rotation.from_euler("x", 20, degrees=True).as_matrix()
    start, end = MIDDLE - 40 * turn[:, 0], MIDDLE
    found = words("axial", start, end, ball(turn))
    assert "enters on the patient's left, 20 mm in front of the origin, 30 mm above it" in found
    assert "the lip on its left lies towards the patient's front," in found
    steep = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    assert "towards the patient's front and head," in words("axial", start, end, ball(steep))


def test_a_cut_without_a_mouth_and_a_resection():
    assert words("axial", (0, 20, 30), (20, 20, 30), mouth=False).startswith(
        "begins inside the organ on the patient's left, 20 mm in front")
    bearings, slice = bearings_in("axial")
    x, y = slice.from_world(np.array([[30.0, 10, 30]]))[0][0]
    taken = SimpleNamespace(region=shapely.Point(x, y).buffer(5), area_mm2=78.5)
    assert bearings.of_resection(taken) == ("takes 78 mm2 out on the patient's right, 10 mm in front of the origin, "
                                            "30 mm above it")


def test_a_header_without_a_position_says_nothing_of_the_patient():
    found = words("axial", (-30, 20, 30), (0, 20, 30), ball(code=0))
    assert "does not say where in the patient" in found and "left" not in found


def test_between_two_directions_both_are_told():
    assert towards([1, 0.4, 0]) == "right" and towards([1, 0.5, 0]) == "right and front"
    assert towards([-0.5, -1, -0.6]) == "back and feet"


def test_it_is_said_on_stdout_in_the_record_and_under_the_verdict(tmp_path, capfd):
    path = write(tmp_path / "head.nii.gz")
    run = ("run", path, "--cut", CUT, *OPEN, *QUICK[:4], "-w", tmp_path / "cache", "-o", tmp_path / "out")
    for _ in range(2):  # from the cache too
        code, out, _ = xfemnav(capfd, *run, "--resect", "5,-20 15,-20 15,-10 5,-10", "--skull", "contact")
        wanted = ("cut 'cut' enters on the patient's left, 8 mm in front of the origin, 10 mm above it; the lip "
                  "on its left lies towards the patient's front, the one on its right towards the back")
        assert code == 0 and f"where      {wanted}" in out and "resection 'resection' takes 100 mm2 out" in out
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert told(record)[0] == wanted
    page = (tmp_path / "out" / "report.html").read_text()
    verdict, sentence = page.index('role="status"'), page.index("enters on the patient")
    assert verdict < sentence < page.index("<h2>")
    assert "enters" not in xfemnav(capfd, *run, "-q")[1]
