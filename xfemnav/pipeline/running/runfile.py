"""The output folder: public files put in place one by one, each whole, and run.json last of all.

While files are being replaced, run.json says 'interrupted', so that a folder whose run died never looks complete; it
then claims the files that it may have left. Files that no run.json claims are never overwritten, and a run that fails
before anything public changed leaves a complete earlier result as it is.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.imaging.carrying.sidecars import SIDECARS
from xfemnav.imaging.reading.content import file_bytes
from xfemnav.pipeline.keeping.disk import remove_temporaries, write_atomic, write_together, writing
from xfemnav.pipeline.keeping.keys import file_digest
from xfemnav.pipeline.keeping.locks import locked
from xfemnav.pipeline.keeping.names import (
    CARRIED,
    KNOWN_SCHEMAS,
    LIMIT_BYTES,
    NAMES,
    OWN_NAME,
    PAGES,
    RECORD,
    WITH_SIDECAR,
    public_name,
    sidecar_name,
)

DESCRIBED = SIDECARS | {
    "mask": {"Description": "Organ in the slice, holes filled", "Type": "Brain"},
    "updated": {"Description": "The slice after the cut and retraction"},
    "cavity": {"Description": "Pixels of the organ that hold no tissue after the motion", "Type": "ROI"},
    "overlap": {"Description": "Pixels that hold tissue twice after the motion", "Type": "ROI"},
    "field": {"Description": "Resting position minus position; 0 where there is no tissue", "Units": "mm",
              "VectorFrame": "LPS+", "Direction": "output->input"},
    "companion": {"Description": "Another image of the patient after the motion, on the grid of the updated slice"},
}


def json_text(value: dict) -> str:
    """JSON text of a public file: readable, and the same for the same value."""
    return json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n"


def _record_in(path: Path) -> dict | None:
    """The record in a file, None when it is no record of ours; a pipe is never waited for."""
    try:
        record = json.loads(file_bytes(path, LIMIT_BYTES))
        return record if record["schema"] in KNOWN_SCHEMAS else None
    except (XfemnavError, ValueError, KeyError, TypeError, RecursionError):
        return None


def run_schema() -> dict:
    """The JSON Schema of run.json."""
    return json.loads(Path(__file__).with_name("run.schema.json").read_text(encoding="utf-8"))


class OutputFolder:
    """A folder that this process holds; see `output_folder`."""

    def __init__(self, path: Path, image: Path):
        self.path, self.image = path, image
        record = _record_in(path / RECORD) or {}
        self.earlier = _claimed(record)
        self.whole = record.get("status") in ("complete", "untrusted")  # an earlier result that nothing has touched

    def names(self, roles, files: dict[str, tuple[Path, str]]) -> dict[str, str]:
        """Public name of each role; some keep the ending of their file in the cache."""
        endings = {role: "".join(path.suffixes) for role, (path, _) in files.items()}
        return {role: public_name(self.image, role, endings.get(role, "")) for role in roles}

    def publish(self, files: dict[str, tuple[Path, str]], texts: dict[str, str], record: dict,
                words: dict[str, dict]) -> dict[str, str]:
        """Put `files` (role -> path in the cache, sha256) and `texts` (by role) in place; their public names by role.
        `words` (by role) is what the sidecars of this run say more."""
        names = self.names([*files, *texts], files)
        changed = {names[role]: source.read_bytes() for role, (source, sha256) in files.items()
                   if not self._holds(names[role], sha256)}
        written = {names[role]: text.encode() for role, text in texts.items()}
        maker = {"Sources": [self.image.name], "GeneratedBy": [{"Name": "xfemnav", "Version": record["version"]}]}
        described = {role: DESCRIBED[role.partition(":")[0]] for role in files if role.partition(":")[0] in DESCRIBED}
        for role, content in described.items():
            written[sidecar_name(names[role])] = json_text(content | words.get(role, {}) | maker).encode()
        changed |= {name: content for name, content in written.items()
                    if not self._holds(name, hashlib.sha256(content).hexdigest())}
        keep = {*names.values()} | {sidecar_name(names[role]) for role in described}
        under_way = record | {"status": "interrupted", "exit_code": 130, "outputs": {}}

        def begin():
            self.earlier |= keep
            self.write_record(under_way | {"claims": sorted(self.earlier)})
            self.whole = False

        write_together(self.path, changed, begin)
        self.remove_earlier(keep)
        return names

    def write_failure(self, record: dict) -> None:
        """Record a failure and remove what earlier runs left, unless a whole earlier result is there still."""
        if not self.whole:
            self.write_record(record | {"claims": sorted(self.earlier)})  # before: the one that is there may name them
            self.remove_earlier()
            self.write_record(record)

    def write_record(self, record: dict) -> None:
        """Write run.json in one step."""
        write_atomic(self.path / RECORD, json_text(record).encode(errors="backslashreplace"))

    def remove_earlier(self, keep: frozenset[str] | set[str] = frozenset()) -> None:
        """Remove outputs of the earlier run that this one does not make: the folder holds what run.json says."""
        with writing(self.path, "the outputs"):
            for name in self.earlier - keep:
                (self.path / name).unlink(missing_ok=True)

    def refuse_overwriting(self, inputs: list[Path], roles: dict[str, str]) -> None:
        """Raise E731 when an input, or a file that no earlier run made, would be replaced or removed.

        `roles` are those of the run's steps and carried files, beside the fixed ones, with their endings.
        """
        fixed = {role for role in (*NAMES, *PAGES) if role.partition("-")[0] not in CARRIED}
        new = {public_name(self.image, role, ending) for role, ending in ({role: "" for role in fixed} | roles).items()}
        new |= {sidecar_name(name) for name in new if name.endswith(WITH_SIDECAR)}
        targets = {os.path.realpath(self.path / name) for name in self.earlier | new | {RECORD}}
        for path in inputs:
            if os.path.realpath(path) in targets:
                raise XfemnavError("E731", f"the output would overwrite the input {path}. Give another folder with "
                                           "⟦output⟧.")
        foreign = {name for name in new - self.earlier if os.path.lexists(self.path / name)}
        if os.path.lexists(self.path / RECORD) and _record_in(self.path / RECORD) is None:
            foreign.add(RECORD)
        if foreign:
            raise XfemnavError("E731", f"the output would overwrite {', '.join(sorted(foreign))} in {self.path}, which "
                                       "no run of xfemnav has recorded there. Give another folder with "
                                       "⟦output⟧, or move it.")

    def _holds(self, name: str, sha256: str) -> bool:
        """Whether the file is there already with this content."""
        target = self.path / name
        return os.path.isfile(target) and not os.path.islink(target) and file_digest(target) == sha256


def _claimed(record: dict) -> set[str]:
    """Names of the files that a record claims, sidecars too. What a run would give no file is left out: somebody wrote
    it there by hand."""
    outputs, claims = record.get("outputs"), record.get("claims")
    found = [*(outputs.values() if isinstance(outputs, dict) else ()), *(claims if isinstance(claims, list) else ())]
    names = {name for name in found if isinstance(name, str) and OWN_NAME.fullmatch(name)}
    return names | {sidecar_name(name) for name in names if name.endswith(WITH_SIDECAR)}


@contextmanager
def output_folder(path: Path, image: Path, waiting: Callable[[], None]) -> Iterator[OutputFolder]:
    """Make and hold the output folder; `waiting` is called when another run holds it. Raises E501 to E503."""
    if os.path.isfile(path):
        raise XfemnavError("E502", f"the output {path} is a file, and the outputs are several. Give a folder with "
                                   "⟦output⟧.")
    with writing(path.parent, f"the output folder {path.name}"):
        path.mkdir(parents=True, exist_ok=True)
    with locked(path, waiting=waiting):
        with writing(path, "the outputs"):
            remove_temporaries(path)
        yield OutputFolder(path, image)
