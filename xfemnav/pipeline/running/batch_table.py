"""The table of a batch, batch.tsv: one row a slice, as BIDS writes tables: tabs, a header, n/a for what is missing."""

import math
import os
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import file_bytes
from xfemnav.pipeline.keeping.disk import write_atomic, writing
from xfemnav.pipeline.telling.report import CHECKS

NAME, LIMIT_BYTES, MISSING = "batch.tsv", 100_000_000, "n/a"
FIRST = ("name", "image", "slice", "slice_mm", "status", "exit_code", "error", "trusted", "warnings")
PARTED = {"lip_error_mm": ("lip_error_mm_max", "lip_error_mm_rms")}
COLUMNS = (*FIRST, *(column for name in CHECKS for column in PARTED.get(name, (name,))), "largest_force_mN_per_mm",
           "forces_mN_per_mm", "seconds", "output")


def row(name: str, image: str, output: str, exit_code: int, seconds: float, record: dict, error: str = "") -> dict:
    """What the table says of a slice: `record` is the run.json of this run, as far as it has come."""
    found = {"name": name, "image": image, "output": output, "exit_code": exit_code, "seconds": round(seconds, 2)}
    found |= {"status": record.get("status", "failed"), "error": record.get("error", {}).get("code", error)}
    plane = record.get("slice", {})
    found |= {"slice": plane.get("index"), "slice_mm": plane.get("offset")}
    if "warnings" in record:
        found["warnings"] = ",".join(sorted({item["code"] for item in record["warnings"]}))
    if found["status"] in ("complete", "untrusted"):
        found["trusted"] = found["status"] == "complete"
    for check, value in record.get("checks", {}).items():
        parts = value.items() if isinstance(value, dict) else ()
        found |= {f"{check}_{part}": inner for part, inner in parts} or {check: value}
    forces = {f"{each['cut']} {each['side']}": each["force_mN_per_mm"] for each in record.get("retractor", ())}
    if forces:
        found["largest_force_mN_per_mm"] = max(math.hypot(*force) for force in forces.values())
        found["forces_mN_per_mm"] = "; ".join(f"{where} {x:.6g},{y:.6g}" for where, (x, y) in forces.items())
    return {column: cell(found.get(column)) for column in COLUMNS}


def cell(value) -> str:
    """A value as the table has it: six digits, true and false, n/a for none; nothing that breaks a row."""
    if value is None or value == "":
        return MISSING
    if isinstance(value, bool):
        return "true" if value else "false"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return "".join(c if c.isprintable() else " " for c in text)


class Table:
    """The rows of a batch in a folder, by name; what an earlier call has left is there until it is made anew."""

    def __init__(self, folder: Path, names: list[str]):
        """Raises E731 where the folder has a batch.tsv of somebody else's."""
        self.path = folder / NAME
        empty = dict.fromkeys(COLUMNS, MISSING)
        self.rows = {name: empty | {"name": cell(name)} for name in names}
        self.rows |= {name: earlier for name, earlier in self._earlier().items() if name in self.rows}

    def put(self, name: str, found: dict) -> None:
        """A row that is new, and the whole table on the disk. Raises E501 and E502."""
        self.rows[name] = found
        lines = ["\t".join(COLUMNS), *("\t".join(each[column] for column in COLUMNS) for each in self.rows.values())]
        with writing(self.path.parent, NAME):
            self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(self.path, ("\n".join(lines) + "\n").encode(errors="backslashreplace"))

    def _earlier(self) -> dict[str, dict]:
        if not os.path.lexists(self.path):
            return {}
        try:
            header, *lines = file_bytes(self.path, LIMIT_BYTES).decode().splitlines()
        except (XfemnavError, ValueError):
            header, lines = "", []
        columns = header.split("\t")
        if columns[:len(FIRST)] != list(FIRST):
            raise XfemnavError("E731", f"{self.path} is no table of a batch, and would be overwritten. Give another "
                                       "folder, or move it.")
        if columns != list(COLUMNS):  # another version's
            return {}
        rows = [line.split("\t") for line in lines]
        return {cells[0]: dict(zip(COLUMNS, cells)) for cells in rows if len(cells) == len(COLUMNS)}
