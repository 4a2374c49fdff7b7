"""Point files of image-guided surgery: a path -> a checked `PointSet` in world RAS mm, and back.

A file is opened once, as a regular file of at most 10 MB, and told by its content, then by its suffix. Tables have at
most 200 000 lines.
"""

from functools import partial
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.imaging.points import coordsystem, markups
from xfemnav.imaging.points.markups import write_markups
from xfemnav.imaging.points.point_set import POINT_FILE, PointSet, frame_suspicion, unusable
from xfemnav.imaging.points.point_tables import (
    BIDS,
    TAG_HEAD,
    csv_text,
    fcsv_text,
    read_columns,
    read_fcsv,
    read_tag,
    separated,
    tag_text,
    tsv_text,
)
from xfemnav.imaging.points.splines import drawn
from xfemnav.imaging.reading import content

__all__ = ["PointSet", "frame_suspicion", "read_control_points", "read_points", "write_markups", "write_points"]

LIMIT_BYTES, LIMIT_LINES = 10_000_000, 200_000
SUFFIXES = (".mrk.json", ".json", ".fcsv", ".csv", ".tsv", ".tag")
TEXTS = {".fcsv": fcsv_text, ".csv": csv_text, ".tsv": tsv_text, ".tag": tag_text}


def read_points(path, *, name: str | None = None, chord_mm: float = 0.05, planes: bool = False) -> PointSet:
    """The points in the file at `path`: .mrk.json, .fcsv, .csv, .tsv or .tag.

    `name` chooses one of several markups. Frames are the files' own: markups and .fcsv say theirs, .tag is RAS, and
    tables say it by the names of their columns (`read_columns`), or a BIDS coordsystem.json beside them.
    Curves are followed as 3D Slicer draws them, with chords at most `chord_mm` off; their control points are among the
    vertices and keep their labels. With `planes` a Plane of Slicer's is its four corners. Raises E100 (no such file),
    E308 (cannot be used), E309 (several markups).
    """
    points, interpolation = _read(path, name, planes)
    if interpolation == "linear":
        return points
    try:
        vertices, at = drawn(points.points, points.kind == "ClosedCurve", chord_mm)
    except ValueError as error:
        raise unusable(Path(path).name, f"cannot be followed: {error}. Check its control points.") from None
    labels = [""] * len(vertices)
    for k, label in zip(at, points.labels):
        labels[k] = label
    return PointSet(points.kind, points.name, vertices, tuple(labels))


def read_control_points(path, *, name: str | None = None) -> PointSet:
    """The points in the file at `path` as they are stored; see `read_points`."""
    return _read(path, name)[0]


def write_points(path, points: PointSet) -> None:
    """Write `points` in the format of the suffix and in its frame: .mrk.json and .fcsv LPS, .tag RAS, and .csv and .tsv
    as the table had it, else LPS.

    The tables hold labels on one line. Raises E308 for another suffix.
    """
    suffix = _suffix(path)
    if suffix.endswith(".json"):
        write_markups(path, [points])
    elif suffix in TEXTS:
        Path(path).write_bytes(TEXTS[suffix](points).encode("utf-8", "replace"))
    else:
        raise unusable(Path(path).name, f"has no suffix of a point file; give one of {', '.join(SUFFIXES)}.")


def _read(path, name: str | None, planes: bool = False) -> tuple[PointSet, str]:
    """The control points, and how a line through them is interpolated: "linear" or "spline"."""
    file, text = Path(path).name, _text(path)
    stem = file[:len(file) - len(_suffix(path))] or file
    reader = _reader(text, path)
    if reader is None:
        return markups.control_points(text, file, stem, name, planes)
    if name not in (None, stem):
        raise XfemnavError("E309", f"{file} holds one set of points and no names. Leave out {name!a}.")
    if (n_lines := max(text.count("\n"), text.count("\r"))) > LIMIT_LINES:
        raise unusable(file, f"has {n_lines} lines; at most {LIMIT_LINES} are read. Is it a point file?")
    return reader(text, file, stem), "linear"


def _reader(text: str, path):
    """The reader of a table by the file's content, or else its suffix; None for markups."""
    head = text.lstrip()[:4096]
    if head.startswith(("{", "[")):
        return None
    if head.startswith(TAG_HEAD):
        return read_tag
    if head.startswith("#"):
        return read_fcsv
    suffix = _suffix(path)
    found = separated(head)
    if suffix in (".csv", ".tsv") or found[0]:
        system = coordsystem.beside(Path(path)) if found == BIDS else None
        return partial(read_columns, unit=system and coordsystem.unit(system))
    if suffix not in SUFFIXES:
        raise unusable(Path(path).name, f"is no point file; give one of {', '.join(SUFFIXES)}.")
    return {".fcsv": read_fcsv, ".tag": read_tag}.get(suffix)


def _suffix(path) -> str:
    """The suffix of a point file's name in lower case, "" for another one."""
    return next((suffix for suffix in SUFFIXES if Path(path).name.lower().endswith(suffix)), "")


def _text(path) -> str:
    """The text of a point file, its lines ended as they are."""
    try:
        return content.decoded(content.file_bytes(path, LIMIT_BYTES, POINT_FILE))
    except ValueError as error:
        raise unusable(Path(path).name, f"{error}.") from None
