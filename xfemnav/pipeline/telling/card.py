"""A result as a notebook shows it: the verdict first, the slice before and after, checks beside their limits, files.

Every value is escaped by the template engine, and the size is bounded: names and warnings are other people's text, and
a notebook keeps what it has shown.
"""

import os
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

from xfemnav.errors import XfemnavError
from xfemnav.naming import told
from xfemnav.pipeline.telling.display import NEUROLOGICAL
from xfemnav.pipeline.telling.report import (
    VERDICTS,
    check_rows,
    checked,
    dimension_of,
    display_told,
    embedded,
    template,
)

COLOURS = {"complete": "#1a7f37", "untrusted": "#c8102e"}
MARKS = {"look": " background: #ffe3b0; font-weight: 600;",
         "untrusted": " background: #c8102e; color: #fff; font-weight: 600;"}
WARNINGS, LETTERS, FILES = 5, 400, 60  # most warnings, letters of a text, and links to files
PICTURE_PX = 900


def card(result) -> str:
    """The HTML of a `Result`; what is missing in its folder is said, never raised."""
    record, step = result.record, result.step
    facts = next((each for each in record.get("steps", ()) if each["name"] == step), record)
    warnings, outputs = record.get("warnings", []), list(record["outputs"].items())
    picture, reason = _picture(result)
    display, lips = display_told(record, facts["cuts"], display_of(record))
    return template("card.html").render(
        colour=COLOURS[record["status"]], verdict=verdict(record), title=_short(_title(record)), step=step,
        folder=_short(str(result.folder)), error=_bounded(record.get("error")),
        warnings=[_bounded(each) for each in warnings[:WARNINGS]], left_out=len(warnings[WARNINGS:]),
        picture=embedded(picture), width=PICTURE_PX, reason=_short(reason),
        display=display.capitalize() + "." if picture else "",
        lips=_short(lips) if picture else "",
        checks=[row for row in check_rows({"dimension": dimension_of(record), "verdicts": {}} | facts)
                if row["verdict"]],
        marks=MARKS,
        checked=checked(record) if record["status"] == "complete" and "verdicts" in record else "",
        outputs=[(role, name, _address(result.folder, name)) for role, name in outputs[:FILES]],
        files_left_out=len(outputs[FILES:]),
    )


def verdict(record: dict) -> str:
    """The verdict on a run, with the number of its warnings."""
    n = len(record.get("warnings", ()))
    warned = f", {n} warning{'s' if n > 1 else ''}" if n else ", without warnings"
    return VERDICTS[record["status"]] + (warned if record["status"] == "complete" else "")


def display_of(record: dict) -> str:
    """Which way round a run is shown."""
    return record.get("parameters", {}).get("display", NEUROLOGICAL)


def _picture(result) -> tuple[bytes | None, str]:
    """Before and after, small; or why there is no picture."""
    from xfemnav.pipeline.telling.figure import draw_pair
    from xfemnav.pipeline.telling.palette import reduced

    try:
        if dimension_of(result.record) > 2:
            name = result.record["outputs"].get("figure")
            return (reduced((result.folder / name).read_bytes(), PICTURE_PX), "") if name else (None, "run it with one")
        before, organ = result.preoperative, result.frame.values != 0
        after = replace(result.update, updated=result.updated.values)
        pair = draw_pair(before, organ, result.motion.cuts, after, display_of(result.record))
        return reduced(pair, PICTURE_PX), ""
    except (XfemnavError, OSError) as error:
        return None, str(error)


def _title(record: dict) -> str:
    return Path(record.get("parameters", {}).get("image") or "a run").name


def _address(folder: Path, name: str) -> str:
    """Where a file is as seen from the current folder, which notebooks follow, or altogether."""
    try:
        return quote(os.fsencode(Path(os.path.relpath(folder / name)).as_posix()))
    except ValueError:  # on another drive
        return (folder / name).absolute().as_uri()


def _bounded(item: dict | None) -> dict | None:
    return item and {"code": item["code"], "text": _short(told(item))}


def _short(text: str) -> str:
    return text if len(text) <= LETTERS else text[:LETTERS - 1] + "…"
