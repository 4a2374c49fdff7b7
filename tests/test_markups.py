"""Markups of 3D Slicer: what its versions write is read, in one frame, and what is written, Slicer can read."""

import json
import re

import jsonschema
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.markups import write_markups
from xfemnav.imaging.points.point_files import LIMIT_BYTES, PointSet, read_control_points, read_points, write_points

RAS_POINTS = np.array([[-10.5, 20.25, 30.0], [-12.0, 8.125, 31.5], [-20.0, 4.0, 33.0]])
IDENTITY = [-1.0, -0.0, -0.0, -0.0, -1.0, -0.0, 0.0, 0.0, 1.0]

# What schema 1.0.3 asks for, and what Slicer's reader does of it.
SCHEMA = {
    "type": "object", "required": ["@schema", "markups"],
    "properties": {
        "@schema": {"type": "string", "pattern": r"markups-schema-v1\.[0-9]+\.[0-9]+\.json#*$"},
        "markups": {"type": "array", "minItems": 1, "items": {
            "type": "object", "required": ["type", "controlPoints"],
            "properties": {
                "type": {"enum": ["Fiducial", "Line", "Angle", "Curve", "ClosedCurve", "Plane", "ROI"]},
                "name": {"type": "string"}, "coordinateSystem": {"enum": ["LPS", "RAS"]},
                "coordinateUnits": {"enum": ["mm", "um"]},
                "locked": {"type": "boolean"}, "labelFormat": {"type": "string"},
                "controlPoints": {"type": "array", "items": {
                    "type": "object", "required": ["position", "orientation", "positionStatus"],
                    "properties": {
                        "id": {"type": "string"}, "label": {"type": "string"},
                        "position": {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3},
                        "orientation": {"type": "array", "items": {"type": "number"}, "minItems": 9, "maxItems": 9},
                        "selected": {"type": "boolean"}, "visibility": {"type": "boolean"},
                        "positionStatus": {"enum": ["undefined", "preview", "defined"]}}}}}}}}}


def markup(points=RAS_POINTS, kind="Line", frame="LPS", **keys) -> dict:
    """A markup as Slicer 5 writes it, of RAS points; `keys` go in, None takes one out."""
    signs = [-1, -1, 1] if frame in ("LPS", None, 1) else [1, 1, 1]
    items = [{"id": str(i), "label": f"P-{i}", "description": "", "associatedNodeID": "vtkMRMLScalarVolumeNode1",
              "position": (np.array(point) * signs).tolist(), "orientation": IDENTITY, "selected": True,
              "locked": False, "visibility": True, "positionStatus": "defined"} for i, point in enumerate(points, 1)]
    whole = {"type": kind, "coordinateSystem": frame, "coordinateUnits": "mm", "locked": False, "labelFormat": "%N-%d",
             "controlPoints": items, "measurements": [{"name": "length", "enabled": False, "value": float("nan")}],
             "display": {"visibility": True, "opacity": 1.0, "color": [0.4, 1.0, 1.0]}, **keys}
    return {key: value for key, value in whole.items() if value is not None}


def text(*markups, version="1.0.3") -> str:
    address = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema"
    return json.dumps({"@schema": f"{address}/markups-schema-v{version}.json#", "markups": list(markups)})


def saved(folder, content: str | bytes, name="cut.mrk.json"):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refusal(path, **options) -> XfemnavError:
    with pytest.raises(XfemnavError) as failure:
        read_points(path, **options)
    assert "\n" not in str(failure.value) and len(str(failure.value)) < 1000
    return failure.value


# What is read ---------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("frame", ["LPS", "RAS", None, 0, 1])
@pytest.mark.parametrize("version", ["1.0.0", "1.0.3", "1.0.4"])
def test_every_frame_gives_the_same_points(tmp_path, frame, version):
    found = read_points(saved(tmp_path, text(markup(frame=frame), version=version)))
    np.testing.assert_array_equal(found.points, RAS_POINTS)
    assert (found.kind, found.name, found.labels) == ("Line", "cut", ("P-1", "P-2", "P-3"))


@pytest.mark.parametrize("unit, factor", [(["mm", "UCUM", "millimeter"], 1), (None, 1), ("um", 1e3),
                                          (["um", "UCUM", "micrometer"], 1e3)])
def test_units_are_converted(tmp_path, unit, factor):
    found = read_points(saved(tmp_path, text(markup(RAS_POINTS * factor, coordinateUnits=unit))))
    np.testing.assert_allclose(found.points, RAS_POINTS, atol=1e-12)


def test_points_that_were_never_placed_are_left_out_and_hidden_ones_are_not(tmp_path):
    """As Slicer writes them: a position "" and the status; visibility is about display alone."""
    line = markup([*RAS_POINTS, [0, 0, 0], [1, 1, 1]])
    line["controlPoints"][3].update(position="", positionStatus="undefined")
    line["controlPoints"][4].update(positionStatus="preview")
    line["controlPoints"][1]["visibility"] = False
    del line["controlPoints"][2]["positionStatus"]
    np.testing.assert_array_equal(read_points(saved(tmp_path, text(line))).points, RAS_POINTS)


def test_keys_that_are_not_needed_may_be_missing(tmp_path):
    bare = {"type": "Fiducial", "controlPoints": [{"position": [1, 2, 3]}]}
    found = read_points(saved(tmp_path, json.dumps({"markups": [bare]}), "points.json"))
    assert found.points.tolist() == [[-1, -2, 3]] and found.labels == ("",) and found.name == "points"


def test_duplicate_keys_and_a_byte_order_mark_do_no_harm(tmp_path):
    twice = text(markup()).replace('"type":', '"type": "Plane", "type":')
    np.testing.assert_array_equal(read_points(saved(tmp_path, b"\xef\xbb\xbf" + twice.encode())).points, RAS_POINTS)


@pytest.mark.parametrize("kind", ["Curve", "ClosedCurve"])
def test_curves_go_through_their_control_points_and_keep_their_labels(tmp_path, kind):
    path = saved(tmp_path, text(markup(kind=kind)))
    found = read_points(path)
    there = [found.points.tolist().index(point) for point in RAS_POINTS.tolist()]
    assert there[0] == 0 and (np.diff(there) > 1).all() and len(found.points) > 10
    assert (there[-1] == len(found.points) - 1) == (kind == "Curve")
    assert [found.labels[k] for k in there] == ["P-1", "P-2", "P-3"] and set(found.labels) == {"", "P-1", "P-2", "P-3"}
    np.testing.assert_array_equal(read_control_points(path).points, RAS_POINTS)
    assert len(read_points(path, chord_mm=1.0).points) < len(found.points)


def test_a_linear_curve_is_its_polyline(tmp_path):
    found = read_points(saved(tmp_path, text(markup(kind="Curve", curveType="linear"))))
    np.testing.assert_array_equal(found.points, RAS_POINTS)


def test_one_of_several_markups_is_chosen_by_its_name(tmp_path):
    two = text(markup(name="corridor"), markup(RAS_POINTS + 1, "Fiducial"), markup(kind="ROI"))
    path = saved(tmp_path, two, "plan.mrk.json")
    error = refusal(path)
    assert error.code == "E309" and "'corridor' ('Line'), 'plan-2' ('Fiducial'), 'plan-3' ('ROI')" in error.message
    np.testing.assert_array_equal(read_points(path, name="corridor").points, RAS_POINTS)
    np.testing.assert_array_equal(read_points(path, name="plan-2").points, RAS_POINTS + 1)
    assert refusal(path, name="tumour").code == "E309"
    assert refusal(saved(tmp_path, text(markup(name="a"), markup(name="a"))), name="a").code == "E309"


# What is refused ------------------------------------------------------------------------------------------------------

def with_position(value) -> str:
    """A file whose second position is the JSON text `value`."""
    line = markup()
    line["controlPoints"][1]["position"] = "HERE"
    return text(line).replace('"HERE"', value)


def deep(n: int) -> str:
    return '{"markups": ' + "[" * n + "]" * n + "}"


BAD = {
    "nan": with_position("[NaN, 0, 0]"), "infinity": with_position("[0, -Infinity, 0]"),
    "1e999": with_position("[1e999, 0, 0]"), "text": with_position('["12", 0, 0]'),
    "bool": with_position("[true, 0, 0]"),
    "null": with_position("null"), "two": with_position("[1, 2]"), "four": with_position("[1, 2, 3, 4]"),
    "empty": with_position('""'), "object": with_position("{}"), "far": with_position("[1e6, 0, 0]"),
    "long integer": with_position(f"[{'9' * 4000}, 0, 0]"), "longer": with_position(f"[{'9' * 5000}, 0, 0]"),
    "missing position": text(markup()).replace('"position"', '"place"', 1),
    "one point": text(markup(RAS_POINTS[:1])), "two of a ring": text(markup(RAS_POINTS[:2], "ClosedCurve")),
    "none": text(markup([], "Fiducial")), "no list": text(markup(controlPoints={})),
    "points are numbers": text(markup(controlPoints=[1, 2])),
    "undefined": text(markup()).replace('"defined"', '"undefined"'),
    "plane": text(markup(kind="Plane")), "no type": text(markup(kind=None)), "list type": text(markup(kind=["Line"])),
    "frame": text(markup(coordinateSystem="IJK")), "frame 2": text(markup(coordinateSystem=2)),
    "frame list": text(markup(coordinateSystem=["LPS"])), "unit": text(markup(coordinateUnits="cm")),
    "unit list": text(markup(coordinateUnits=["mm"])), "unit number": text(markup(coordinateUnits=1)),
    "surface": text(markup(kind="Curve", curveType="shortestSurfaceDistance")),
    "curve type list": text(markup(kind="Curve", curveType=["linear"])),
    "many": '{"markups": [' + "{}, " * 1000 + "{}]}",
    "nothing": text(), "array": "[1, 2, 3]", "another": '{"points": []}', "null markups": '{"markups": [null]}',
    "cut off": text(markup())[:-30], "zero": "", "deep": deep(40), "deeper": deep(100_000), "latin-1": b'{"\xe9": 1}',
    "utf-16": text(markup()).encode("utf-16"), "nul": b"\0" * 100,
}


@pytest.mark.parametrize("case", BAD)
def test_damaged_files_give_one_coded_line(tmp_path, case):
    assert refusal(saved(tmp_path, BAD[case])).code == "E308"


def test_a_large_file_is_not_read(tmp_path):
    path = saved(tmp_path, "")
    with path.open("wb") as file:
        file.truncate(LIMIT_BYTES + 1)
    assert "at most 10 MB" in refusal(path).message


def test_a_long_curve_is_refused_before_it_is_drawn(tmp_path):
    items = [{"position": [9e3 * (i % 2), 0, 0]} for i in range(20_000)]
    assert "vertices" in refusal(saved(tmp_path, text(markup(kind="Curve", controlPoints=items)))).message


def test_names_of_a_file_reach_messages_without_their_control_characters(tmp_path):
    hostile = "\x1b[2J\n<img onerror=x>" + "x" * 5000
    error = refusal(saved(tmp_path, text(*[markup(name=hostile)] * 30)))
    assert error.code == "E309" and "\x1b" not in error.message and error.message.count("<img") == 10


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    | st.sampled_from(["LPS", "RAS", "mm", "um", "Line", "Curve", "ClosedCurve", "Fiducial", "defined", "spline"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
        st.sampled_from(["type", "name", "markups", "position", "positionStatus", "label", "curveType",
                         "controlPoints", "coordinateSystem", "coordinateUnits"]), inner, max_size=5), max_leaves=12)
places = st.sampled_from(["type", "name", "controlPoints", "coordinateSystem", "coordinateUnits", "curveType"])
inner_places = st.sampled_from(["position", "positionStatus", "label"])


@settings(max_examples=150, deadline=None)
@given(kind=st.sampled_from(["Line", "Curve", "ClosedCurve", "Fiducial"]), changed=st.dictionaries(places, values),
       inner=st.dictionaries(inner_places, values))
@example(kind="Line", changed={}, inner={"label": "\ud800"})
@example(kind="Line", changed={"name": "\udfff"}, inner={})
def test_any_json_gives_finite_points_or_a_coded_error(tmp_path_factory, kind, changed, inner):
    whole = markup(kind=kind)
    whole["controlPoints"][1].update(inner)
    path = saved(tmp_path_factory.mktemp("fuzz"), text({**whole, **changed}))
    try:
        found = read_points(path)
    except XfemnavError as error:
        assert error.code in ("E308", "E309")
    else:
        assert np.isfinite(found.points).all() and len(found.points) == len(found.labels)
        write_points(path, found)  # and what was read can be written


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_bytes_give_points_or_a_coded_error(tmp_path_factory, data):
    content = bytearray(text(markup(kind="Curve")).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        read_points(saved(tmp_path_factory.mktemp("bytes"), bytes(content)))
    except XfemnavError as error:
        assert error.code in ("E308", "E309")


# What is written ------------------------------------------------------------------------------------------------------

def sets() -> list[PointSet]:
    return [PointSet("Line", "cut", RAS_POINTS[:2], ("mouth", "tip")),
            PointSet("ClosedCurve", "cavity é", RAS_POINTS / 3, ("", "b", "")),
            PointSet("points", "targets", RAS_POINTS, ("1", "2\n3", '"4"'))]


def test_written_files_are_what_the_schema_asks_for(tmp_path):
    path = tmp_path / "plan.mrk.json"
    write_markups(path, sets(), extra={"xfemnav": {"version": 1}})
    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)
    jsonschema.validate(content, SCHEMA)
    assert content["xfemnav"] == {"version": 1}
    entries = content["markups"]
    assert {point["positionStatus"] for entry in entries for point in entry["controlPoints"]} == {"defined"}
    assert {entry["coordinateSystem"] for entry in entries} == {"LPS"}
    assert entries[0]["controlPoints"][0]["position"] == [10.5, -20.25, 30.0]
    assert [entry["type"] for entry in entries] == ["Line", "ClosedCurve", "Fiducial"]
    # the test of Slicer before 5.1
    old = r"^https://raw\.githubusercontent\.com/slicer/slicer/master/.*markups-schema-v1\.[0-9]+\.[0-9]+\.json#*$"
    assert re.search(old, content["@schema"].lower())


def test_written_points_come_back(tmp_path):
    path = tmp_path / "plan.mrk.json"
    write_markups(path, sets())
    for points in sets():
        again = read_control_points(path, name=points.name)
        np.testing.assert_array_equal(again.points, points.points)  # JSON holds every digit
        assert again.labels == points.labels
        assert again.kind == points.kind.replace("points", "Fiducial")


def test_equal_content_gives_equal_bytes_and_keys_of_the_format_are_not_replaced(tmp_path):
    for name in ("a", "b"):
        write_markups(tmp_path / name, sets(), extra={"markups": 1, "@schema": 2})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    jsonschema.validate(json.loads((tmp_path / "a").read_text(encoding="utf-8")), SCHEMA)


def test_minus_zero_is_not_written(tmp_path):
    write_markups(tmp_path / "a", [PointSet("points", "a", [[0.0, 0.0, 1.0]], ("",))])
    assert json.loads((tmp_path / "a").read_text())["markups"][0]["controlPoints"][0]["position"] == [0.0, 0.0, 1.0]
    assert "-0.0" not in (tmp_path / "a").read_text()
