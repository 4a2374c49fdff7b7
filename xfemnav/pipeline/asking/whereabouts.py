"""Where the inputs of a run lie: told in run.json, and found again when the run is opened later and elsewhere.

The folder of a run may have been moved together with its image, or alone, or the image alone. A file is looked for
where it lay as seen from the folder, and where it lay altogether, and is known by its bytes, not by its name.
"""

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import file_bytes
from xfemnav.pipeline.asking.flags import printed
from xfemnav.pipeline.asking.scenario_file import seen_from, whole
from xfemnav.pipeline.asking.settings import FLAGS
from xfemnav.pipeline.keeping.keys import digest, file_digest
from xfemnav.pipeline.keeping.names import PAGES, RECORD

ALONE = (".nii", ".nii.gz", ".mgz", ".mgh")  # one file is the image: no library is needed to digest it


@dataclass(frozen=True)
class Known:
    """An input as run.json has it: its path from the folder of the run, its whole path then, the sha256 of its bytes,
    and the digest of what is decoded from them ("" of what is no image)."""

    path: str
    absolute: str
    sha256: str
    content: str = ""


def bytes_digest(place: str, path: Path, max_memory_gb: float) -> str:
    """sha256 of the bytes of the input at a place of the scenario: of a file, or of all files of an image that may lie
    in several, or of a table of points and what says its frame. Raises E100, E102, E106, and OSError."""
    if place.startswith(("streamlines.", "surfaces.")):
        return hashlib.sha256(file_bytes(path, int(max_memory_gb * 1e9))).hexdigest()
    table = place.startswith("points.") or place.endswith(".markups")
    named_alone = path.name.lower().endswith(ALONE) and not os.path.isdir(path)
    if not (table or named_alone or place in ("mesh.file", "boundary.displacement")):
        from xfemnav.imaging.reading.gate import content_digest

        return content_digest(path, max_memory_gb=max_memory_gb)
    if not os.path.isfile(path):
        file_bytes(path, 0)  # refuses it, with the reason
    if table:
        from xfemnav.imaging.points.coordsystem import beside

        if words := beside(path):
            return digest([file_digest(path), file_digest(words)])
    return file_digest(path)


def told(named: dict[str, Path], folder: Path, known: dict[str, dict], digested: Callable[[str, Path], str]) -> dict:
    """What run.json in `folder` says of the inputs `named`, by place.

    `known` are the digests of those that the run has read; the others, drawn cuts and the like, are `digested` now.
    """
    found = {}
    for place, path in named.items():
        found[place] = {"path": printed(seen_from(folder, path)), "absolute": printed(whole(path))}
        try:
            found[place] |= known.get(place) or {"sha256": digested(place, path)}
        except (OSError, XfemnavError):  # it is not there, and why says the error of the run
            continue
    return found


def inputs_of(record: dict) -> dict[str, Known]:
    """The inputs that a record tells, by place, without those that the run did not come to read."""
    return {place: Known(item["path"], item["absolute"], item["sha256"], item.get("content", ""))
            for place, item in record.get("inputs", {}).items() if "sha256" in item}


def inputs_of_scenario(path: Path) -> dict[str, Known]:
    """The inputs of the run that wrote the scenario at `path`, by place; none where no run did."""
    from xfemnav.pipeline.keeping.record import read_record

    if path.name != "".join(PAGES["scenario"]) or not os.path.isfile(path.with_name(RECORD)):
        return {}
    try:
        record = read_record(path.parent)
    except XfemnavError:
        return {}
    return inputs_of(record) if record["outputs"].get("scenario") == path.name else {}


def find(place: str, known: Known, folder: Path, max_memory_gb: float, given: Path | None = None) -> tuple[Path, bool]:
    """Where an input of the run in `folder` lies now, if not at the place `given`, and whether its bytes are those of
    then. Raises E100, and what `bytes_digest` does."""
    places = [folder / known.path, Path(known.absolute)] if given is None else [Path(given)]
    there = [path for path in dict.fromkeys(places) if os.path.exists(path)]
    for path in there:
        if bytes_digest(place, path, max_memory_gb) == known.sha256:
            return path, True
    if there:
        return there[0], False
    if given is not None:
        raise XfemnavError("E100", f"{place}: nothing at {given}. Correct the path.")
    seen, was = whole(places[0]), str(places[1])
    where = f" (as it lay from the folder of the run), nor at {was} (where it was)" if seen != was else ""
    raise XfemnavError("E100", f"{place}: nothing at {seen}{where}. {_mend(place)}")


def found_again(files: dict[str, Path], scenario: Path, max_memory_gb: float) -> tuple[dict, dict]:
    """The `files` of the scenario of a run, by place, where they lie now, and those of other bytes as they were known.
    Raises E100 with all that are gone."""
    known, changed, gone, found = inputs_of_scenario(scenario), {}, [], dict(files)
    for place, path in files.items():
        if place in known and whole(path) == whole(scenario.parent / known[place].path):  # else it was edited
            try:
                found[place], same = find(place, known[place], scenario.parent, max_memory_gb)
            except XfemnavError as error:
                if error.code != "E100":
                    raise
                gone.append(error.text)
                continue
            if not same:
                changed[place] = known[place]
    if gone:
        raise XfemnavError("E100", " ".join(gone))
    return found, changed


def _mend(place: str) -> str:
    """How to tell where a file is now."""
    option = "image" if place == "image" else next((name for name, own in FLAGS.items() if own == place), None)
    return f"Put it back, or give ⟦!{option}⟧." if option else "Put it back, or correct its path in scenario.toml."
