"""The outline's measured motion, as a table of displacements."""

import csv
import io
import math
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import decoded, file_bytes
from xfemnav.pipeline.asking.flags import numbers

TABLE_BYTES = 10_000_000
TABLE = {"no file": ("E408", "{name} is a folder, pipe or device, not a file. Correct the path."),
         "empty": ("E408", "{name} is empty (0 bytes). Write it again."),
         "large": ("E408", "{name} holds {size}; at most {limit} are read. Is it a table of displacements?"),
         "unread": ("E408", "{name} cannot be read: {reason}. Copy it again.")}


def read_displacements(path: Path) -> tuple[tuple[float, ...], ...]:
    """Rows x, y, ux, uy[, side] (plane mm in the run's space) of a CSV with that header. Raises E100 and E408."""
    try:
        table = list(csv.reader(io.StringIO(decoded(file_bytes(path, TABLE_BYTES, TABLE)), newline="")))
    except (ValueError, csv.Error) as error:
        raise XfemnavError("E408", f"{path.name} is no table: {error}.") from None
    header = [name.strip() for name in table[0]] if table else []
    if header not in (["x", "y", "ux", "uy"], ["x", "y", "ux", "uy", "side"]):
        raise XfemnavError("E408", f"{path.name} starts with {','.join(header)[:60]!r}; its first line must be "
                                   "x,y,ux,uy or x,y,ux,uy,side.")
    rows = [row for row in table[1:] if row]
    for line, row in enumerate(rows, start=2):
        values = numbers(",".join(row))
        if values is None or len(values) != len(header) or not all(map(math.isfinite, values)):
            raise XfemnavError("E408", f"line {line} of {path.name} is not {len(header)} finite numbers: "
                                       f"{str(row)[:200]}.")
    if len(rows) < 2:
        raise XfemnavError("E408", f"{path.name} has {len(rows)} rows; give the motion of at least two points.")
    return tuple(tuple(map(float, row)) for row in rows)
