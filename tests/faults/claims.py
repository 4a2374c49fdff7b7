"""What must hold of the files of a run after a fault, whatever the fault: nothing half, nothing wrong, nothing foreign.

Shared by the faults at every call, those in one process, the full file system and the signals.
"""

import hashlib
import json
from pathlib import Path

from jsonschema import Draft202012Validator

from xfemnav.pipeline.running.runfile import run_schema

RECORD = Draft202012Validator(run_schema())
FINISHED = ("complete", "untrusted")
REFUSED = (73, 74)  # exits of what cannot be written


def files_in(folder: Path) -> dict[str, bytes]:
    """Bytes of every file below a folder, by relative name."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*"))
            if path.is_file()}


def state(files: dict[str, bytes]) -> str:
    """Digest of files by name: of a record, what the next run asks of it."""
    found = hashlib.sha256()
    for name, data in files.items():
        if name.endswith("run.json"):
            record = json.loads(data)
            data = json.dumps([record.get(part) for part in ("status", "outputs", "claims")]).encode()
        found.update(f"{name}\0{len(data)}\0".encode() + data)
    return found.hexdigest()


def public(files: dict[str, bytes]) -> dict[str, bytes]:
    """Those that a reader sees, without the record, which holds seconds; and without the report where it says that an
    entry of the cache was damaged, or could not be written."""
    record = json.loads(files.get("run.json", "{}"))
    odd = ["report.html"] if any(item["code"] in ("W601", "W602") for item in record.get("warnings", ())) else []
    return {name: data for name, data in files.items() if not name.startswith(".") and name not in ("run.json", *odd)}


def differ(some: dict[str, bytes], others: dict[str, bytes]) -> set[str]:
    """Names of files that are not the same in both; a report may be in one only."""
    return {name for name in some.keys() | others.keys() if some.get(name) != others.get(name)
            and not (name == "report.html" and None in (some.get(name), others.get(name)))}


def entries(cache: Path) -> dict[str, bytes]:
    """Files of all entries of a cache under their own names."""
    return {name: data for name, data in files_in(cache / "entries").items() if "/." not in f"/{name}"}


def check_said(code: int, stdout: str, stderr: str, allowed: set[int]) -> None:
    """The exit is one of those allowed, and one line says why. No traceback, no bug."""
    text = f"exit {code}\n{stdout}\n{stderr}"
    assert code in allowed, text
    assert not any(word in text for word in ("Traceback", "E900", "Exception ignored", "Error in ")), text
    if code in REFUSED:
        assert sum(line.startswith("E5") for line in stderr.splitlines()) == 1, text


def check_left(out: Path, old: dict[str, bytes], new: dict[str, bytes], code: int | None, *, recorded=True) -> None:
    """What stands in `out` after an exit with `code` (None: it was killed): files as they were in `old` or as in `new`;
    a finished record only beside all the files that it names, and after exit 0 always."""
    files = files_in(out)
    left, record = public(files), json.loads(files.get("run.json", "{}"))
    if record:
        RECORD.validate(record)
    wrong = [name for name, data in left.items() if data not in (old.get(name), new.get(name))]
    assert not wrong, f"neither as before nor right: {wrong}"
    finished = record.get("status") in FINISHED
    if finished:
        assert files.keys() >= set(record["outputs"].values()), "named, and not there"
        assert not differ(left, old) or not differ(left, new), "old and new files under a finished record"
    if code == 0 and recorded:
        assert finished and not differ(left, new), differ(left, new)


def check_cache(cache: Path, old: dict[str, bytes], new: dict[str, bytes]) -> None:
    """Every file of an entry under its own name is as it was, or as it is made without a fault."""
    wrong = [name for name, data in entries(cache).items() if data not in (old.get(name), new.get(name, data))]
    assert not wrong, f"neither as before nor right in the cache: {wrong}"
