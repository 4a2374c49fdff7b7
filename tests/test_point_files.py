"""Point files: each format in its own frame gives the same points, comes back as written, and damage gets a code."""

import json
import os
import signal
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.point_files import PointSet, frame_suspicion, read_control_points, read_points, write_points

RAS_POINTS = np.array([[-10.5, 20.25, 30.0], [-12.0, 8.125, 31.5]])

SLICER_4_10 = """# Markups fiducial file version = 4.10
# CoordinateSystem = 0
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
vtkMRMLMarkupsFiducialNode_0,-10.5,20.25,30,0,0,0,1,1,1,0,F-1,,vtkMRMLScalarVolumeNode1
vtkMRMLMarkupsFiducialNode_1,-12,8.125,31.5,0,0,0,1,0,1,0,"F, 2",,
"""
SLICER_4_13 = """# Markups fiducial file version = 4.13
# CoordinateSystem = LPS
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
1,10.5,-20.25,30,0,0,0,1,1,1,0,F-1,,vtkMRMLScalarVolumeNode1,2,0
2,12,-8.125,31.5,0,0,0,1,1,1,0,"F, 2",,,2,0
"""
FEWER_COLUMNS = """# CoordinateSystem = RAS
# columns = id,x,y,z,label
1,-10.5,20.25,30,F-1
2,-12,8.125,31.5,"F, 2"
"""
ANTS = "x,y,z,t,label,comment\n10.5,-20.25,30,0,F-1,first\n12,-8.125,31.5,0,\"F, 2\",\n"
PLAIN = 'label,R,A,S\r\nF-1,-10.5,20.25,30\r\n"F, 2",-1.2e1,8.125,31.5\r\n\r\n'
TAG = """MNI Tag Point File
Volumes = 2;
% Case 1: "landmarks; of" the MRI and US

Points =
 -10.5 20.25 30 40.3 -42.6 27.9 "F-1"
# a remark
 -12 8.125 31.5 34.6 -29.8 29.6 1 0 -1 "F, 2";
"""
TAG_ONE = 'MNI Tag Point File\nVolumes = 1;\nPoints = -10.5 20.25 30 F-1\n-12.0 8.125 31.5 "F, 2"\n;'

FILES = {"old.fcsv": SLICER_4_10, "new.fcsv": SLICER_4_13, "one.fcsv": SLICER_4_13.replace("= LPS", "= 1"),
         "words.fcsv": SLICER_4_10.replace("= 0", "= RAS"), "fewer.fcsv": FEWER_COLUMNS, "ants.csv": ANTS,
         "plain.csv": PLAIN, "two.tag": TAG, "one.tag": TAG_ONE, "crlf.tag": TAG.replace("\n", "\r\n")}

labels = st.text(st.characters(exclude_categories=("Cs", "Cc", "Zl", "Zp")), max_size=8)
# Landmarks of an image are given to 1e-9 mm at most; 1e4 mm is the reader's limit.
coordinates = st.tuples(*[st.floats(-1e4, 1e4)] * 3)


def saved(folder, content: str | bytes, name="points.csv"):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.fixture
def alarm():
    """A read that hangs ends the tests after 10 s."""
    signal.alarm(10)
    yield
    signal.alarm(0)


def code_of(path, **options) -> str:
    with pytest.raises(XfemnavError) as failure:
        read_points(path, **options)
    assert "\n" not in str(failure.value) and len(str(failure.value)) < 400 + len(str(path))
    return failure.value.code


@pytest.mark.parametrize("name", FILES)
def test_every_format_gives_the_same_points(tmp_path, name):
    found = read_points(saved(tmp_path, FILES[name], name))
    np.testing.assert_array_equal(found.points, RAS_POINTS)
    assert found.labels == ("F-1", "F, 2") and found.name == name.split(".")[0]
    assert found.kind == ("Fiducial" if name.endswith("fcsv") else "points")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("other", ["points.txt", "points.fcsv", "points.mrk.json", "POINTS.CSV"])
def test_content_tells_the_format_before_the_name(tmp_path, name, other):
    np.testing.assert_array_equal(read_points(saved(tmp_path, FILES[name], other)).points, RAS_POINTS)


@settings(max_examples=40, deadline=None)
@given(rows=st.lists(st.tuples(coordinates, labels), min_size=1, max_size=5))
@pytest.mark.parametrize("suffix", [".mrk.json", ".fcsv", ".csv", ".tsv", ".tag"])
def test_written_points_come_back(tmp_path_factory, suffix, rows):
    points = PointSet("points", "p", [place for place, _ in rows], tuple(label for _, label in rows))
    path = tmp_path_factory.mktemp("round") / f"p{suffix}"
    write_points(path, points)
    again = read_points(path)
    np.testing.assert_allclose(again.points, points.points, rtol=0, atol=1e-9)
    assert again.labels == points.labels
    first = path.read_bytes()
    write_points(path, again)
    assert path.read_bytes() == first


@pytest.mark.parametrize("suffix", [".fcsv", ".csv", ".tag"])
def test_labels_of_tables_stay_on_one_line(tmp_path, suffix):
    points = PointSet("points", "p", RAS_POINTS, ("a\nb\\", 'c\r\n;"%\\n'))
    write_points(tmp_path / f"p{suffix}", points)
    assert read_points(tmp_path / f"p{suffix}").labels == ("a b\\", 'c ;"%\\n')


def test_each_writer_keeps_to_the_frame_of_its_format(tmp_path):
    points = PointSet("Fiducial", "p", RAS_POINTS[:1], ("F",))
    write_points(tmp_path / "p.csv", points)
    assert (tmp_path / "p.csv").read_text() == "x,y,z,t,label\n10.5,-20.25,30.0,0,F\n"
    write_points(tmp_path / "p.tag", points)
    assert '\n -10.5 20.25 30.0 "F";\n' in (tmp_path / "p.tag").read_text()
    write_points(tmp_path / "p.fcsv", points)
    assert "# CoordinateSystem = LPS\n" in (tmp_path / "p.fcsv").read_text()
    assert "\n1,10.5,-20.25,30.0,0,0,0,1,1,1,0,F,,\n" in (tmp_path / "p.fcsv").read_text()
    write_points(tmp_path / "p.tsv", points)
    assert (tmp_path / "p.tsv").read_text() == "label\tr\ta\ts\nF\t-10.5\t20.25\t30.0\n"
    with pytest.raises(XfemnavError, match="E308"):
        write_points(tmp_path / "p.nii.gz", points)


def test_other_columns_of_a_csv_come_back(tmp_path):
    found = read_points(saved(tmp_path, ANTS.replace(",0,", ",7,")))
    assert found.columns == {"t": ("7", "7"), "comment": ("first", "")}
    write_points(tmp_path / "again.csv", found)
    assert read_points(tmp_path / "again.csv").columns == found.columns


# Tables whose columns mean something ----------------------------------------------------------------------------------

SLICER = "label,r,a,s,defined,selected,visible,locked,description"
ROWS = (("F-1", -10.5, 20.25, 30.0, "1,1,0,0,first"), ("far, off", 0, 0, 0, "0,1,1,0,"),
        ("F-2", -12, 8.125, 31.5, "1,0,1,1,"))


def slicer_table(separator=",", axes="ras", end="\n") -> str:
    """A table as 3D Slicer exports it: the second point was never placed, and lies at the origin."""
    signs = (1, 1, 1) if axes == "ras" else (-1, -1, 1)
    lines = [SLICER.replace("r,a,s", ",".join(axes)).split(",")]
    lines += [[f'"{label}"', *(str(sign * x) for sign, x in zip(signs, place)), *rest.split(",")]
              for label, *place, rest in ROWS]
    return "".join(separator.join(line) + end for line in lines)


@pytest.mark.parametrize("axes", ["ras", "lps"])
@pytest.mark.parametrize("separator, name", [(",", "p.csv"), ("\t", "p.tsv"), (";", "p.csv"), ("\t", "p.csv"),
                                             (",", "p.tsv"), ("\t", "p.txt")])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_tables_of_slicer_are_read_and_written_as_they_are(tmp_path, axes, separator, name, end):
    text = slicer_table(separator, axes, end)
    for content in (text, "\ufeff" + text, text.replace("label", "Label").replace("defined", "DEFINED")):
        found = read_points(saved(tmp_path, content, name))
        np.testing.assert_array_equal(found.points, RAS_POINTS)
        assert found.labels == ("F-1", "F-2") and found.columns["visible"] == ("0", "1")
    if name == "p.txt":
        return
    write_points(tmp_path / name, read_points(saved(tmp_path, text, name)))
    first, *rows = (tmp_path / name).read_text().splitlines()
    assert first == text.split(end)[0] and len(rows) == 2
    assert rows[0].split(separator)[4:] == ["1", "1", "0", "0", "first"]
    np.testing.assert_array_equal(read_points(tmp_path / name).points, RAS_POINTS)


ELECTRODES = "name\tx\ty\tz\tsize\nLA1\t-10.5\t20.25\t30\t5\nLA2\tn/a\tn/a\tN/A\tn/a\nLA3\t-12\t8.125\t31.5\t5\n"


def test_electrodes_of_bids_are_ras_and_what_is_not_available_is_left_out(tmp_path):
    path = saved(tmp_path, ELECTRODES, "sub-01_electrodes.tsv")
    found = read_points(path)
    np.testing.assert_array_equal(found.points, RAS_POINTS)
    assert found.labels == ("LA1", "LA3") and found.columns == {"size": ("5", "5")} and not found.form.stated
    write_points(path, found)
    assert path.read_text() == "name\tx\ty\tz\tsize\nLA1\t-10.5\t20.25\t30.0\t5\nLA3\t-12.0\t8.125\t31.5\t5\n"


@pytest.mark.parametrize("system, units, scale", [("ScanRAS", "mm", 1), ("ACPC", "cm", 10), ("acpc", "m", 1000),
                                                  ("MNI152NLin2009cAsym", "mm", 1), ("Other", "mm", None),
                                                  ("fsaverage", "mm", 1), ("n/a", "mm", None)])
def test_the_coordinate_system_stands_beside_the_table(tmp_path, system, units, scale):
    text = ELECTRODES
    if scale:
        text = text.replace("-10.5\t20.25\t30", "\t".join(str(x / scale) for x in RAS_POINTS[0]))
        text = text.replace("-12\t8.125\t31.5", "\t".join(str(x / scale) for x in RAS_POINTS[1]))
    path = saved(tmp_path, text, "sub-01_ses-a_task-rest_space-S_electrodes.tsv")
    stated = {"iEEGCoordinateSystem": system, "iEEGCoordinateUnits": units}
    for name, other in (("sub-01_ses-a_space-S", stated), ("sub-01_ses-a", {"iEEGCoordinateSystem": "CTF"}),
                        ("sub-02_space-S", {}), ("sub-01_ses-a_space-T", {})):
        saved(tmp_path, json.dumps(other), f"{name}_coordsystem.json")
    found = read_points(path)
    np.testing.assert_allclose(found.points, RAS_POINTS, atol=1e-12)
    assert found.form.stated == (scale is not None)
    write_points(path, found)
    np.testing.assert_allclose(read_points(path).points, RAS_POINTS, atol=1e-12)


@pytest.mark.parametrize("content", [
    '{"EEGCoordinateSystem": "CTF", "EEGCoordinateUnits": "mm"}', '{"iEEGCoordinateSystem": "Pixels"}',
    '{"iEEGCoordinateSystem": "ACPC", "iEEGCoordinateUnits": "pixels"}', "[", "[" * 100_000, "\0"])
def test_a_system_that_is_no_place_in_an_image_is_refused(tmp_path, alarm, content):
    path = saved(tmp_path, ELECTRODES, "sub-01_electrodes.tsv")
    saved(tmp_path, content, "sub-01_coordsystem.json")
    assert code_of(path) == "E308"
    saved(tmp_path, ELECTRODES.replace("x\ty\tz", "r\ta\ts"), path.name)  # names that say it need no file
    np.testing.assert_array_equal(read_points(path).points, RAS_POINTS)


def test_of_several_systems_that_fit_alike_none_counts(tmp_path):
    path = saved(tmp_path, ELECTRODES, "sub-01_ses-a_electrodes.tsv")
    for name in ("sub-01", "ses-a"):
        saved(tmp_path, '{"iEEGCoordinateSystem": "ACPC", "iEEGCoordinateUnits": "mm"}', f"{name}_coordsystem.json")
    assert not read_points(path).form.stated


def test_utf_16_is_told_by_its_name(tmp_path):
    with pytest.raises(XfemnavError, match=r"E308 .*UTF-16"):
        read_points(saved(tmp_path, slicer_table("\t").encode("utf-16"), "p.tsv"))


@pytest.mark.parametrize("status, placed", [("2", True), ("0", False), ("1", False), ("3", False)])
def test_fiducials_that_were_never_placed_are_left_out(tmp_path, status, placed):
    """Slicer 5 writes the position's status and one more entry behind the columns that it names."""
    found = read_points(saved(tmp_path, f"{SLICER_4_13}3,0,0,0,0,0,0,1,1,1,0,F-3,,,{status},0\n", "p.fcsv"))
    assert found.labels == ("F-1", "F, 2", "F-3")[:3 if placed else 2]


def test_rows_without_coordinates_were_never_placed(tmp_path):
    found = read_points(saved(tmp_path, "label,r,a,s,\nF-1,-10.5,20.25,30,\nF-0,,,,\nF-2,-12,8.125,31.5,\n"))
    np.testing.assert_array_equal(found.points, RAS_POINTS)
    assert code_of(saved(tmp_path, "r,a,s\n1,2,3\n1,,3\n")) == "E308"


def test_no_control_point_is_lost_between_the_two_ways_to_read(tmp_path):
    path = saved(tmp_path, TAG, "a.tag")
    np.testing.assert_array_equal(read_control_points(path).points, read_points(path).points)


# What is refused ------------------------------------------------------------------------------------------------------

BAD = {
    "voxels.fcsv": SLICER_4_10.replace("= 0", "= 2"), "ijk.fcsv": SLICER_4_13.replace("LPS", "IJK"),
    "frameless.fcsv": SLICER_4_13.replace("# CoordinateSystem = LPS\n", ""), "headless.fcsv": "1,2,3,4\n",
    "columns.fcsv": FEWER_COLUMNS.replace("id,x,y,z", "id,a,b,c"), "none.fcsv": SLICER_4_13.partition("\n1,")[0],
    "few.fcsv": "# CoordinateSystem = LPS\n1,2,3\n", "field.fcsv": SLICER_4_13 + "1," + "9" * 200_000,
    "nan.csv": "x,y,z\n1,nan,3\n", "inf.csv": "x,y,z\n1,inf,3\n", "1e999.csv": "x,y,z\n1,1e999,3\n",
    "hex.csv": "x,y,z\n1,0x10,3\n", "under.csv": "x,y,z\n1,1_0,3\n", "arabic.csv": "x,y,z\n1,٣,3\n",
    "far.csv": "x,y,z\n1,2e5,3\n", "few.csv": "x,y,z\n1,2\n", "empty.csv": "x,y,z\n", "headless.csv": "1,2,3\n4,5,6\n",
    "both.csv": "x,y,z,r,a,s\n1,2,3,1,2,3\n", "twice.csv": "x,y,z,x\n1,2,3,4\n", "comma.csv": "x;y;z\n1,5;2;3\n",
    "defined.csv": "r,a,s,defined\n1,2,3,maybe\n", "three.csv": "r,a,l,p,s\n1,2,-1,-2,3\n",
    "unplaced.tsv": "x\ty\tz\n1\t2\tn/a\n",
    "spaces.csv": "x y z\n1 2 3\n",
    "two.csv": "x,y\n1,2\n", "digits.csv": "x,y,z\n1,2," + "1" * 100_000 + "x\n",
    "open.tag": TAG.rstrip(";\n"), "volumes.tag": TAG.replace("Volumes = 2;", ""),
    "three.tag": TAG.replace("= 2", "= 3"), "points.tag": TAG.replace("Points =", ""),
    "entries.tag": TAG_ONE.replace(" 30 ", " "), "none.tag": "MNI Tag Point File\nVolumes = 1;\nPoints =\n;\n",
    "one.tag": TAG.replace("Volumes = 2", "Volumes = 1"), "text.tag": TAG.replace("40.3", "x"),
    "headless.tag": TAG[10:],
    "what.txt": "hello", "nothing.csv": "", "image.nii": b"\x5c\x01\0\0", "latin.csv": b"x,y,z,label\n1,2,3,\xe9\n",
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_give_one_coded_line(tmp_path, alarm, name):
    assert code_of(saved(tmp_path, BAD[name], name)) == "E308"


HEADS = {"bare": "", "tag": "MNI Tag Point File\nVolumes = 1;\nPoints =\n", "csv": "x,y,z\n",
         "fcsv": "# CoordinateSystem = 0\n"}


PIECES = ["\n", " ", '"', '\\"', "1", "%\n", "1;", "[", '{"a":', "[],", "1,2,3\n", "1 2 3\n", '1 2 3 "%"\n',
          "1,1,2,3\n", "Volumes ", "\nPoints "]


def read_or_refused(path) -> None:
    try:
        read_points(path)
    except XfemnavError as error:
        assert error.code == "E308"


@pytest.mark.parametrize("piece", PIECES)
@pytest.mark.parametrize("head", HEADS)
def test_no_pattern_looks_at_a_text_again_and_again(tmp_path, alarm, head, piece):
    """300 kB take less than a second; were the time to grow with the square of the size, they would take an hour."""
    read_or_refused(saved(tmp_path, HEADS[head] + piece * (300_000 // len(piece)) + "x"))


@pytest.mark.slow
@pytest.mark.parametrize("head, piece", [("tag", '"'), ("tag", "1;"), ("tag", "1 "), ("csv", ","), ("fcsv", ","),
                                         ("markups", "{},"), ("markups", "[],")])
def test_memory_stays_with_the_size_of_the_largest_files(tmp_path, head, piece):
    """Python keeps some 50 bytes of every small string or list, so a file of them takes up to 50 times its size."""
    head = {**HEADS, "markups": '{"markups": ['}[head]
    path = saved(tmp_path, head + piece * (9_900_000 // len(piece)) + ("{}]}" if "markups" in head else "x"))
    tracemalloc.start()
    try:
        read_or_refused(path)
        assert tracemalloc.get_traced_memory()[1] < 50 * 9_900_000
    finally:
        tracemalloc.stop()


def test_paths_that_hold_no_file(tmp_path, alarm):
    assert code_of(tmp_path / "missing.csv") == "E100"
    assert code_of(tmp_path / "a\0b.csv") == "E100"
    assert code_of(tmp_path) == "E308"
    os.mkfifo(tmp_path / "pipe.csv")
    assert code_of(tmp_path / "pipe.csv") == "E308"
    assert code_of("/dev/zero") == "E308"


def test_a_table_has_no_names(tmp_path):
    path = saved(tmp_path, ANTS, "targets.csv")
    assert code_of(path, name="cut") == "E309"
    assert len(read_points(path, name="targets").points) == 2


@pytest.mark.parametrize("wrong", [{"kind": "Sphere"}, {"points": [[0, 0, np.nan]]}, {"points": [[0, 0]]},
                                   {"labels": ()}, {"columns": {"t": ("1", "2")}}])
def test_a_point_set_holds_what_it_says(wrong):
    with pytest.raises(ValueError):
        PointSet(**{"kind": "points", "name": "p", "points": [[0, 0, 0]], "labels": ("",), **wrong})


@settings(max_examples=200, deadline=None)
@given(name=st.sampled_from(sorted(FILES)), data=st.data())
def test_any_bytes_give_points_or_a_coded_error(tmp_path_factory, name, data):
    content = bytearray(FILES[name].encode())
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.sampled_from(b'"\\;,%#\n\r\0 1.eE-x\xff='))
    try:
        found = read_points(saved(tmp_path_factory.mktemp("bytes"), bytes(content), name))
    except XfemnavError as error:
        assert error.code == "E308"
    else:
        assert np.isfinite(found.points).all() and len(found.points) == len(found.labels)


# Frames ---------------------------------------------------------------------------------------------------------------

def in_ball(points):
    return np.linalg.norm(points - [-40.0, 30.0, 0.0], axis=1) < 25


def test_points_in_the_wrong_frame_are_suspected():
    rng = np.random.default_rng(1)
    points = rng.uniform([-50, 20, -10], [-30, 40, 10], (8, 3))
    assert frame_suspicion(points, in_ball) is None
    assert "0 of 8 points" in frame_suspicion(points * [-1, -1, 1], in_ball)
    assert frame_suspicion(np.vstack([points, 500 + points]) * [-1, -1, 1], in_ball) is not None  # half are enough
    assert frame_suspicion(points + 500, in_ball) is None  # in neither
    assert frame_suspicion(points[:0], in_ball) is None
