"""Point files of image-guided surgery: a path -> a checked `PointSet` in world RAS mm, and back.

A file is opened once, as a regular file of at most 10 MB, and told by its content, then by its suffix. Tables have at
most 200 000 lines.
"""

import os
import stat
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.imaging import markups
from xfemnav.imaging.markups import write_markups
from xfemnav.imaging.point_tables import TAG_HEAD, csv_text, fcsv_text, read_csv, read_fcsv, read_tag, tag_text
from xfemnav.imaging.points import PointSet, frame_suspicion, unusable
from xfemnav.imaging.splines import drawn

__all__ = ["PointSet", "frame_suspicion", "read_control_points", "read_points", "write_markups", "write_points"]

LIMIT_BYTES, LIMIT_LINES = 10_000_000, 200_000
SUFFIXES = (".mrk.json", ".json", ".fcsv", ".csv", ".tag")
TABLES = {".fcsv": read_fcsv, ".csv": read_csv, ".tag": read_tag}
TEXTS = {".fcsv": fcsv_text, ".csv": csv_text, ".tag": tag_text}


def read_points(path, *, name: str | None = None, chord_mm: float = 0.05) -> PointSet:
    """The points in the file at `path`: .mrk.json, .fcsv, .csv or .tag.

    `name` chooses one of several markups. Frames are the files' own: markups and .fcsv say theirs, .tag is RAS, a .csv
    with the columns r,a,s is RAS, and one with x,y,z is LPS, since that is how antsApplyTransformsToPoints counts.
    Curves are followed as 3D Slicer draws them, with chords at most `chord_mm` off; their control points are among the
    vertices and keep their labels. Raises E100 (no such file), E308 (cannot be used), E309 (several markups).
    """
    points, interpolation = _read(path, name)
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
    """Write `points` in the format of the suffix and in its frame: .mrk.json, .fcsv and .csv LPS, .tag RAS.

    The tables hold labels on one line. Raises E308 for another suffix.
    """
    suffix = _suffix(path)
    if suffix.endswith(".json"):
        write_markups(path, [points])
    elif suffix in TEXTS:
        Path(path).write_bytes(TEXTS[suffix](points).encode("utf-8", "replace"))
    else:
        raise unusable(Path(path).name, f"has no suffix of a point file; give one of {', '.join(SUFFIXES)}.")


def _read(path, name: str | None) -> tuple[PointSet, str]:
    """The control points, and how a line through them is interpolated: "linear" or "spline"."""
    file, text = Path(path).name, _text(path)
    stem = file[:len(file) - len(_suffix(path))] or file
    reader = _reader(text, path)
    if reader is None:
        return markups.control_points(text, file, stem, name)
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
    columns = {name.strip().strip('"').lower() for name in head.partition("\n")[0].split(",")}
    if set("xyz") <= columns or set("ras") <= columns:
        return read_csv
    if _suffix(path) not in SUFFIXES:
        raise unusable(Path(path).name, f"is no point file; give one of {', '.join(SUFFIXES)}.")
    return TABLES.get(_suffix(path))


def _suffix(path) -> str:
    """The suffix of a point file's name in lower case, "" for another one."""
    return next((suffix for suffix in SUFFIXES if Path(path).name.lower().endswith(suffix)), "")


def _text(path) -> str:
    """The text of a regular file; a pipe or device is never waited for."""
    file = Path(path).name or str(path)
    try:
        # O_NONBLOCK: a pipe that nobody writes to opens at once, and is then refused as what it is.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise XfemnavError("E100", f"cannot open {path}: {reason}. Correct the path.") from None
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise unusable(file, "is a folder, pipe or device, not a file. Correct the path.")
        if status.st_size > LIMIT_BYTES:
            raise unusable(file, f"holds {status.st_size} bytes; at most {LIMIT_BYTES} are read. Is it a point file?")
        with os.fdopen(handle, "rb", closefd=False) as stream:
            return stream.read(LIMIT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unusable(file, f"is no UTF-8 text (byte {error.start}). Save it as UTF-8.") from None
    except OSError as error:
        raise unusable(file, f"cannot be read: {error.strerror}. Copy it again.") from None
    finally:
        os.close(handle)
