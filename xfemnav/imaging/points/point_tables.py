"""Points as text, one a line: 3D Slicer's .fcsv, tables with named columns (.csv, .tsv), the .tag of MINC.

Each reader takes the text of a file, its name for messages and the stem that the points are called by, and raises
E308; each writer gives the text. A coordinate is a decimal number: no NaN, no infinity, nothing else that Python's
float takes.
"""

import csv
import io
import re
from dataclasses import replace

import numpy as np

from xfemnav.imaging.points.point_set import LPS, RAS, Form, PointSet, point_set, shown, unusable

NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")  # linear in time
LINE_END = re.compile(r"\r\n?|\n")
NO_LABEL = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")  # what a label on one line cannot hold
FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
PLACED = "2", ""  # of the positions undefined, preview, defined, missing of Slicer
FCSV_FRAMES = {"0": RAS, "RAS": RAS, "1": LPS, "LPS": LPS}
QUOTED = r'"(?:\\.|[^"\\\n])*"?'  # one that is not closed ends with its line
TAG_COMMENT = re.compile(rf"({QUOTED})|[%#][^\n]*")
TAG_TOKEN = re.compile(rf'{QUOTED}|;|[^\s";]+')
TAG_HEAD = "MNI Tag Point File"
SEPARATORS, AXES, LABELS, MISSING = (",", "\t", ";"), ("xyz", "ras", "lps"), ("label", "name"), "n/a"
BIDS = "\t", "xyz"
DEFINED = {"1": True, "true": True, "": True, "0": False, "false": False}


def read_fcsv(text: str, file: str, stem: str) -> PointSet:
    """Fiducials of a .fcsv file of Slicer 4 (CoordinateSystem = 0) or 5 (LPS), whose columns may be fewer."""
    header, rows = {}, []
    for number, line in enumerate(LINE_END.split(text), 1):
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            header[key.strip().lower()] = value.strip()
        elif line.strip() and _status(fields := _fields(line, number, file)) in PLACED:
            rows.append((number, fields))
    frame = header.get("coordinatesystem", "").upper()
    if frame not in FCSV_FRAMES:
        what = ("counts in voxels of an image that it does not name (CoordinateSystem IJK). Save it in LPS."
                if frame in ("2", "IJK") else
                f"does not say its frame (CoordinateSystem {shown(frame)}). Write '# CoordinateSystem = LPS' or RAS at "
                "its top.")
        raise unusable(file, what)
    names = [name.strip().lower() for name in header.get("columns", FCSV_COLUMNS).split(",")]
    places = _places(names, "xyz", file)
    points = [_coordinates([_at(fields, k) for k in places], number, file) for number, fields in rows]
    labels = [_at(fields, names.index("label")) if "label" in names else "" for _, fields in rows]
    return point_set("Fiducial", stem, np.reshape(points, (-1, 3)) * FCSV_FRAMES[frame] + 0.0, labels, file)


def _status(fields: list[str]) -> str:
    """The positionStatus of a fiducial, which Slicer 5 writes with a last entry behind those that the header names."""
    return fields[-2].strip() if len(fields) == len(FCSV_COLUMNS.split(",")) + 2 else ""


def read_columns(text: str, file: str, stem: str, unit: float | None = None) -> PointSet:
    """Points of a table with a header: commas, semicolons or tabs between its columns.

    r,a,s are RAS and l,p,s LPS, as 3D Slicer writes its tables. x,y,z between commas or semicolons are LPS, as ANTs and
    ITK count. Between tabs they are those of BIDS: RAS in mm of `unit`, or what nobody says (None), and then they are
    taken as RAS mm, and the form is not `stated`. Columns mean what they are called, in small or large letters: `label`
    or `name` the labels; rows whose `defined` is 0, or whose coordinates are n/a or empty, were never placed and are
    left out. All further columns are kept in `columns`.
    """
    separator, axes = separated(text)
    if not separator:
        raise unusable(file, f"starts with {shown(text.lstrip()[:60])}; its first line must name its columns: r,a,s "
                             "(RAS) or l,p,s or x,y,z (LPS), one of them, and label if there are some.")
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        table = [(lines.line_num, row) for row in lines if any(row)]
    except csv.Error as error:
        raise unusable(file, f"is no table: {error}.") from None
    header = [name.strip() for name in table[0][1]]
    while not header[-1]:
        header.pop()  # spreadsheets write empty columns behind the last
    names = [name.lower() for name in header]
    if len(set(names)) < len(names):
        raise unusable(file, f"has two columns of one name: {shown(separator.join(header))}.")
    places = _places(names, axes, file)
    rows = [(number, row) for number, row in table[1:] if _is_placed(row, names, places, number, file)]
    points = [_coordinates([_at(row, k) for k in places], number, file) for number, row in rows]
    label = next((header[names.index(name)] for name in LABELS if name in names), None)
    texts = {name: tuple(_at(row, k) for _, row in rows) for k, name in enumerate(header) if k not in places}
    labels = texts.pop(label) if label else [""] * len(rows)
    form = Form(tuple(header), separator, tuple(header[k] for k in places), label, tuple(LPS))
    if (separator, axes) == BIDS:
        form = replace(form, signs=tuple(RAS), unit=unit or 1.0, stated=unit is not None)
    elif axes == "ras":
        form = replace(form, signs=tuple(RAS))
    points = np.reshape(points, (-1, 3)) * form.unit * form.signs + 0.0
    return point_set("points", stem, points, labels, file, texts, form)


def separated(text: str) -> tuple[str, str]:
    """What separates the columns that the first line of a text names, and which three are coordinates; "" for none."""
    head = LINE_END.split(text[:4096].lstrip("\r\n "), maxsplit=1)[0]
    for separator in SEPARATORS:
        names = {name.strip().strip('"').lower() for name in head.split(separator)}
        found = [axes for axes in AXES if set(axes) <= names]
        if len(found) == 1:
            return separator, found[0]
    return "", ""


def _is_placed(row: list[str], names: list[str], places: list[int], number: int, file: str) -> bool:
    """Whether a row of a table has a place: it does not say that it is undefined, its coordinates are there, and none
    is n/a."""
    if "defined" in names:
        word = _at(row, names.index("defined")).strip().lower()
        if word not in DEFINED:
            raise unusable(file, f"has {shown(word)} in line {number} as `defined`, which is 1 or 0.")
        if not DEFINED[word]:
            return False
    words = [_at(row, k).strip().lower() for k in places]
    return any(words) and MISSING not in words


def read_tag(text: str, file: str, stem: str) -> PointSet:
    """Points of a MINC .tag file, world RAS mm: those in the first volume, when there are two."""
    text = TAG_COMMENT.sub(lambda match: match[1] or "", LINE_END.sub("\n", text))
    volumes = re.search(r"^[ \t]*Volumes\s*=\s*([12])\s*;", text, re.MULTILINE)
    start = re.search(r"^[ \t]*Points\s*=", text, re.MULTILINE)
    if not text.lstrip().startswith(TAG_HEAD) or not volumes or not start:
        raise unusable(file, f"does not have the lines '{TAG_HEAD}', 'Volumes = 1;' (or 2) and 'Points =' of a .tag "
                             "file. Write it again.")
    wanted, first = 3 * int(volumes[1]), text.count("\n", 0, start.end()) + 1
    points, labels = [], []
    for number, line in enumerate(text[start.end():].split("\n"), first):
        tokens = TAG_TOKEN.findall(line)
        record = tokens[:tokens.index(";")] if ";" in tokens else tokens
        if record:
            # numbers, perhaps weight, structure and patient, perhaps a label
            if len(record) - wanted not in (0, 1, 3, 4):
                raise unusable(file, f"has {len(record)} entries in line {number}; a point of {wanted // 3} volumes "
                                     f"has {wanted} numbers and may have 3 more and a label.")
            points.append(_coordinates(record[:wanted], number, file)[:3])
            labels.append(_unquoted(record[-1]) if len(record) - wanted in (1, 4) else "")
        if ";" in tokens:
            break
    else:
        raise unusable(file, "ends without the ';' behind its last point. Copy it again.")
    return point_set("points", stem, points, labels, file)


def _fields(line: str, number: int, file: str) -> list[str]:
    try:
        return next(csv.reader([line]))
    except csv.Error as error:
        raise unusable(file, f"has a line {number} that is no CSV: {error}.") from None


def _places(names: list[str], axes: str, file: str) -> list[int]:
    if not set(axes) <= set(names):
        raise unusable(file, f"has the columns {shown(','.join(names))}; it needs {','.join(axes)}.")
    return [names.index(axis) for axis in axes]


def _at(fields: list[str], k: int) -> str:
    return fields[k] if k < len(fields) else ""


def _coordinates(texts: list[str], number: int, file: str) -> list[float]:
    """Numbers of the texts in line `number`."""
    numbers = [text.strip() for text in texts]
    if not all(map(NUMBER.fullmatch, numbers)):
        raise unusable(file, f"has {shown(', '.join(texts))} in line {number} where numbers should be.")
    return list(map(float, numbers))


def _unquoted(token: str) -> str:
    return re.sub(r"\\(.)", r"\1", token[1:].removesuffix('"')) if token.startswith('"') else token


def fcsv_text(points: PointSet) -> str:
    """A .fcsv file as Slicer 4.13 writes it, LPS."""
    rows = [[i, *place, 0, 0, 0, 1, 1, 1, 0, _one_line(label), "", ""] for i, (place, label) in
            enumerate(zip(_lps(points), points.labels), 1)]
    return ("# Markups fiducial file version = 4.13\n# CoordinateSystem = LPS\n"
            f"# columns = {FCSV_COLUMNS}\n{_csv(rows)}")


def csv_text(points: PointSet) -> str:
    """A table as it was read; of other points the one that antsApplyTransformsToPoints reads: x,y,z (LPS), t, label."""
    label = ["label"] if any(points.labels) else []
    header = ("x", "y", "z", "t", *label, *(name for name in points.columns if name != "t"))
    return _columns(points, points.form or Form(header, ",", ("x", "y", "z"), *(label or [None]), tuple(LPS)))


def tsv_text(points: PointSet) -> str:
    """A table as it was read; of other points one that 3D Slicer reads: label, r,a,s."""
    header = ("label", "r", "a", "s", *points.columns)
    return _columns(points, points.form or Form(header, "\t", ("r", "a", "s"), "label", tuple(RAS)))


def _columns(points: PointSet, form: Form) -> str:
    places = (points.points * form.signs / form.unit + 0.0).tolist()
    columns = {**points.columns, **dict(zip(form.places, zip(*places))), form.label: map(_one_line, points.labels)}
    columns = {name: tuple(columns[name]) if name in columns else ("0",) * len(places) for name in form.header}
    return _csv([form.header, *zip(*columns.values())], form.separator)


def tag_text(points: PointSet) -> str:
    """A .tag file of one volume, world RAS mm."""
    escaped = (_one_line(label).replace("\\", "\\\\").replace('"', '\\"') for label in points.labels)
    rows = "\n".join(f" {x!r} {y!r} {z!r} \"{label}\"" for (x, y, z), label in zip(points.points.tolist(), escaped))
    return f"{TAG_HEAD}\nVolumes = 1;\n\nPoints =\n{rows};\n"


def _lps(points: PointSet) -> list[list[float]]:
    return (points.points * LPS + 0.0).tolist()


def _one_line(label: str) -> str:
    return NO_LABEL.sub(" ", label)


def _csv(rows, separator: str = ",") -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n", delimiter=separator).writerows(rows)
    return text.getvalue()
