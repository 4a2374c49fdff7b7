"""Frames, tables and files that were refused: headers with two frames, columns that mean something, padding, TOML."""

import json

import numpy as np
import pytest
from rows import Row
from small import CUT, RAS, brain, write

import xfemnav
from tests.headers import itk_affine, two_frames
from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.point_files import read_points
from xfemnav.imaging.reading.gate import read_image
from xfemnav.pipeline.asking.config import scenario_problems
from xfemnav.pipeline.stages.inputs import recorded

SMALL = {"element_size_mm": 8, "corridor_element_mm": 4, "report": False, "opening_mm": 4}


def two_places(folder):
    """A coregistered image: `updated` must lie on it in nibabel and in ITK, and the warning say what Slicer shows."""
    path = two_frames(folder / "sub-01_T1w.nii", brain()[:, :, None])
    with recorded() as warned:
        result = xfemnav.run(path, cut=CUT, output=folder / "out", cache=folder / "cache", **SMALL)
    text = next(item.text for item in warned if item.code == "W114")
    assert "The sform was taken" in text and "built on ITK take the qform" in text
    updated = folder / "out" / result.record["outputs"]["updated"]
    np.testing.assert_allclose(itk_affine(updated), itk_affine(path), atol=1e-4)
    np.testing.assert_allclose(result.frame.affine, result.record["input"]["affine"], atol=1e-4)
    apart = text.partition("up to ")[2].partition(" mm")[0]
    return f"told, {apart} mm apart; updated lies on its input in both", "W114"


def tables(folder):
    """3D Slicer's tables, with an unplaced point at the origin, and BIDS electrodes: read, moved, written in kind."""
    path = write(folder / "sub-01_T1w.nii.gz")
    names = {"a.csv": ("label,l,p,s,defined,selected", "F-1,25,-5,10,1,1\nF-2,0,0,0,0,1"),
             "b.tsv": ("label\tr\ta\ts\tdefined", "F-1\t-25\t5\t10\t1\nF-2\t0\t0\t0\t0"),
             "sub-01_electrodes.tsv": ("name\tx\ty\tz", "F-1\t-2.5\t.5\t1\nF-2\tn/a\tn/a\tn/a")}
    for name, lines in names.items():
        (folder / name).write_text("\n".join(lines))
    for place in (folder, folder / "out"):
        place.mkdir(exist_ok=True)
        (place / "sub-01_coordsystem.json").write_text('{"iEEGCoordinateSystem": "ACPC", "iEEGCoordinateUnits": "cm"}')
    result = xfemnav.run(path, cut=CUT, points=[folder / name for name in names], output=folder / "out",
                         cache=folder / "cache", **SMALL)
    places = []
    tables = [name for role, name in sorted(result.record["outputs"].items()) if name.endswith((".csv", ".tsv"))]
    for name, (header, _) in zip(tables, names.values(), strict=True):
        written = folder / "out" / name
        assert written.read_text().splitlines()[0] == header
        places.append(read_points(written).points)
    wanted = result.to_current([[-25.0, 5, 10]])
    assert all(len(found) == 1 and abs(found - wanted).max() < 1e-6 for found in places)
    moved = np.linalg.norm(wanted - [-25, 5, 10])
    return f"one point of two in each, moved {moved:.2f} mm, written with its own columns", ""


def padding(folder):
    """512 zeros behind the voxels, as block devices and some converters leave them."""
    path = write(folder / "a.nii")
    values = read_image(path).values
    path.write_bytes(path.read_bytes() + bytes(512))
    with recorded() as warned:
        assert np.array_equal(read_image(path).values, values)
    return warned[0].text.partition(",")[0], warned[0].code


def mark_of_an_editor(folder):
    """A scenario that begins with a byte-order mark."""
    (folder / "a.toml").write_bytes(b'\xef\xbb\xbfxfemnav = 1\r\nimage = "a.nii.gz"\r\n')
    found = scenario_problems(folder / "a.toml")
    assert len(found) == 2 and "nothing moves" in found[0] and "no file" in found[1]
    return "read: " + found[1].partition(":")[0], ""


def windows(folder):
    """Backslashes in double quotes."""
    (folder / "a.toml").write_text('xfemnav = 1\nimage = "C:\\Users\\me\\a.nii.gz"\n')
    (found,) = scenario_problems(folder / "a.toml")
    assert "single quotes" in found and "with /" in found
    return found[found.index("In double quotes"):], found[:4]


def another_view(folder):
    """A line in an anatomical view of an image that is turned by 19 degrees."""
    turn = np.eye(4)
    cos, sin = np.cos(np.radians(19)), np.sin(np.radians(19))
    turn[1:3, 1:3] = [[cos, -sin], [sin, cos]]
    path = write(folder / "a.nii.gz", affine=turn @ RAS)
    line = {"type": "Line", "coordinateSystem": "RAS", "controlPoints": [{"position": [-60, 0, 12]},
                                                                         {"position": [-10, 20, 12]}]}
    (folder / "cut.mrk.json").write_text(json.dumps({"markups": [line]}))
    with pytest.raises(XfemnavError) as failure:
        xfemnav.run(path, cut=folder / "cut.mrk.json", output=folder / "out", cache=folder / "cache", **SMALL)
    assert "at 19.0 degrees" in str(failure.value) and "Rotate to volume plane" in str(failure.value)
    return "at 19.0 degrees to the slices; Rotate to volume plane", failure.value.code


ROWS = [
    Row("A6", "sform (code 2) and qform (code 1) differ", "sform in silence; updated off its input in ITK", two_places),
    Row("A12", "tables with defined, l,p,s, tabs, n/a", "an unplaced point is moved as a landmark", tables),
    Row("B", "zeros after NIfTI voxels", "E102: its dimensions are wrong", padding),
    Row("B", "a scenario with a byte-order mark", "E780 no TOML", mark_of_an_editor),
    Row("B", "C:\\Users in double quotes", "E780 Invalid hex value", windows),
    Row("B", "a line in an anatomical view, oblique slices", "E307 choose the slice that holds it", another_view),
]
