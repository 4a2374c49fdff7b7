"""3D Slicer's markups, .mrk.json: the control points of lines, curves and landmarks.

Read are all versions of schema 1; written is 1.0.3, the one of the released Slicers. A control point whose
`positionStatus` is not "defined" (a missing one counts as defined) was never placed and is left out. `visibility` is
about display alone: Slicer draws a curve through its hidden points, so they are read. Other keys are not looked at,
and may hold NaN, which Slicer writes for measurements without a value.
"""

import json
from pathlib import Path

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.point_set import FARTHEST, LEAST, LPS, RAS, PointSet, point_set, shown, unusable

LIMIT_DEPTH, LIMIT_MARKUPS = 32, 1000
# Slicers before 5.1 read no file whose schema has another address.
SCHEMA = ("https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
          "markups-schema-v1.0.3.json#")
KINDS = tuple(kind for kind in LEAST if kind not in ("points", "Plane"))
# Slicer counts coordinate systems as 0 RAS, 1 LPS where it does not name them.
FRAMES = {"RAS": RAS, "LPS": LPS, "0": RAS, "1": LPS}
MM = {"mm": 1.0, "um": 1e-3}


def control_points(text: str, file: str, stem: str, name: str | None, planes: bool = False) -> tuple[PointSet, str]:
    """The markup `name` in a file's text, or its only one, and how it is interpolated: "linear" or "spline".

    Slicer writes no names into these files: a markup without one is called as the file's `stem`, and with its number
    behind that where there are several. With `planes` a Plane is its four corners, in turn about its normal.
    Raises E308 and E309.
    """
    markups = _markups(text, file)
    names = [_name(markup, f"{stem}-{i + 1}" if len(markups) > 1 else stem) for i, markup in enumerate(markups)]
    markup, name = _chosen(markups, names, name, file)
    kind = markup.get("type")
    if planes and kind == "Plane":
        return point_set(kind, name, _corners(markup, file), ("",) * 4, file), "linear"
    if kind not in KINDS:
        raise unusable(file, f"holds a markup of type {shown(kind)}; points are read of {', '.join(KINDS)}.")
    interpolation = markup.get("curveType", "spline") if kind.endswith("Curve") else "linear"
    if interpolation not in ("linear", "spline"):
        raise unusable(file, f"holds a curve of curveType {shown(interpolation)}; only 'spline' and 'linear' are "
                             "known. Resample it in Slicer.")
    items = markup.get("controlPoints", [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise unusable(file, "has controlPoints that are no list of points. Save it again from Slicer.")
    signs, unit = _frame(markup, file), _unit(markup, file)
    placed = [(i, item) for i, item in enumerate(items, 1) if item.get("positionStatus", "defined") == "defined"]
    points = [_position(item, i, unit, file) for i, item in placed]
    labels = [label if isinstance(label := item.get("label", ""), str) else "" for _, item in placed]
    return point_set(kind, name, np.reshape(points, (-1, 3)) * signs * unit + 0.0, labels, file), interpolation


def _markups(text: str, file: str) -> list[dict]:
    """The markups of a JSON text."""
    too_deep = unusable(file, f"is nested deeper than {LIMIT_DEPTH} levels; it is no file of Slicer's.")
    try:
        raw = json.loads(text)
    except RecursionError:
        raise too_deep from None
    except ValueError as error:
        raise unusable(file, f"is no JSON: {error}. Save it again from Slicer.") from None
    if _depth(raw) > LIMIT_DEPTH:
        raise too_deep
    markups = raw.get("markups") if isinstance(raw, dict) else None
    if not isinstance(markups, list) or not markups or not all(isinstance(markup, dict) for markup in markups):
        raise unusable(file, "holds no list 'markups', so it is no markups file. Save the points from Slicer's Markups "
                             "module as .mrk.json.")
    if len(markups) > LIMIT_MARKUPS:
        raise unusable(file, f"holds {len(markups)} markups; at most {LIMIT_MARKUPS} are read. Save those you need.")
    return markups


def _depth(value) -> int:
    """Levels of nesting, at most one more than the limit, without recursion."""
    depth, level = 0, [value]
    while level and depth <= LIMIT_DEPTH:
        depth += 1
        level = [inner for item in level if isinstance(item, dict | list)
                 for inner in (item.values() if isinstance(item, dict) else item)]
    return depth


def _name(markup: dict, otherwise: str) -> str:
    name = markup.get("name")
    return name.encode("utf-8", "replace").decode() if isinstance(name, str) and name else otherwise


def _chosen(markups: list[dict], names: list[str], name: str | None, file: str) -> tuple[dict, str]:
    """The one markup called `name`, or the only one, and its name."""
    places = [i for i, other in enumerate(names) if name is None or name == other]
    if len(places) == 1:
        return markups[places[0]], names[places[0]]
    listed = ", ".join(f"{shown(other)} ({shown(markup.get('type'))})" for markup, other in
                       list(zip(markups, names))[:10]) + (", ..." if len(names) > 10 else "")
    found = "no markup" if not places else f"{len(places)} markups"
    asked = "" if name is None else f" called {shown(name)}"
    raise XfemnavError("E309", f"{file} holds {found}{asked}: there are {listed}. Say which one by its name, or save "
                               "it alone.")


def _corners(markup: dict, file: str) -> np.ndarray:
    """Corners (4, 3) RAS mm of a Plane, in turn about its normal."""
    unit, signs = _unit(markup, file), _frame(markup, file)
    centre = np.array(_position({"position": markup.get("center")}, 1, unit, file))
    turn, size = _listed(markup, "orientation", (9,), file), _listed(markup, "size", (2, 3), file)
    bounds = _listed(markup, "planeBounds", (4,), file)
    if turn is None:
        turn = _listed(markup, "objectToBase", (16,), file)
        turn = turn if turn is None else turn.reshape(4, 4)[:3, :3]
    size = size[:2] if size is not None else None if bounds is None else np.diff(bounds.reshape(2, 2), axis=1)[:, 0]
    if turn is None or size is None or not (size > 0).all():
        raise unusable(file, "holds a Plane without orientation and size. Give it a size in Slicer's Markups module "
                             "(size "
                             "mode 'absolute'), and save it again.")
    x, y = turn.reshape(3, 3).T[:2]
    halves = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return np.array([centre + (i * size[0] * x + j * size[1] * y) / 2 for i, j in halves]) * signs * unit + 0.0


def _listed(markup: dict, key: str, lengths: tuple[int, ...], file: str) -> np.ndarray | None:
    """The finite numbers (n,) of a list in a markup, None without it."""
    values = markup.get(key)
    if values is None:
        return None
    good = isinstance(values, list) and len(values) in lengths and all(
        isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e9 for x in values)
    if not good:
        raise unusable(file, f"has a {key} of {shown(values)}; it must be {' or '.join(map(str, lengths))} numbers.")
    return np.array(values, float)


def _frame(markup: dict, file: str) -> np.ndarray:
    """Signs (3,) from the file's axes to RAS."""
    stated = markup.get("coordinateSystem", "LPS")
    key = str(stated).upper() if isinstance(stated, str | int) and not isinstance(stated, bool) else ""
    if key not in FRAMES:
        raise unusable(file, f"has the coordinateSystem {shown(stated)}; known are 'LPS' and 'RAS'.")
    return FRAMES[key]


def _unit(markup: dict, file: str) -> float:
    """Millimetres of the file's unit."""
    stated = markup.get("coordinateUnits", "mm")
    coded = isinstance(stated, list) and len(stated) > 1 and stated[1] == "UCUM"
    unit = stated[0] if coded else stated
    if not isinstance(unit, str) or unit not in MM:
        raise unusable(file, f"has the coordinateUnits {shown(stated)}; known are 'mm' and 'um'.")
    return MM[unit]


def _position(item: dict, number: int, unit: float, file: str) -> list:
    """Position (3,) of a control point in the file's own frame and unit."""
    position = item.get("position")
    if not isinstance(position, list) or len(position) != 3 or not all(
            isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= FARTHEST / unit for x in position):
        raise unusable(file, f"has the position {shown(position)} at control point {number}; it must be 3 numbers "
                             f"within {FARTHEST:.0f} mm. Place it again, or mark it as not placed.")
    return position


def write_markups(path, point_sets, *, extra: dict | None = None) -> None:
    """Write `point_sets` as one markups file: LPS, mm, schema 1.0.3. The same content gives the same bytes.

    `extra`: further keys at the top of the file, which Slicer skips. Slicer itself opens the first markup of a file
    of several unless it is asked for the others. It draws a spline through the points of a Curve.
    """
    content = {**(extra or {}), "@schema": SCHEMA, "markups": [_markup(points) for points in point_sets]}
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    Path(path).write_bytes(f"{text}\n".encode("utf-8", "replace"))


def _markup(points: PointSet) -> dict:
    """One entry of a markups file."""
    places = (points.points * LPS + 0.0).tolist()
    return {"type": "Fiducial" if points.kind == "points" else points.kind, "name": points.name,
            "coordinateSystem": "LPS", "coordinateUnits": "mm", "locked": False, "fixedNumberOfControlPoints": False,
            "labelFormat": "%N-%d", "lastUsedControlPointNumber": len(places),
            "controlPoints": [
                # the axes of RAS, in LPS, as Slicer writes them
                {"id": str(i), "label": label, "description": "", "associatedNodeID": "", "position": place,
                 "orientation": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0], "selected": True, "locked": False,
                 "visibility": True, "positionStatus": "defined"}
                for i, (place, label) in enumerate(zip(places, points.labels), 1)]}
