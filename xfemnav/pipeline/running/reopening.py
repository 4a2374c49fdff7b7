"""A finished run, opened again: whether it is whole, and its inputs, wherever they are now."""

import hashlib
import os
from pathlib import Path

from pydantic import ValidationError

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import file_bytes
from xfemnav.pipeline.asking.scenario import Scenario
from xfemnav.pipeline.asking.whereabouts import Known, find, inputs_of
from xfemnav.pipeline.keeping.names import RECORD
from xfemnav.pipeline.keeping.record import read_record

LARGEST_BYTES = 1 << 34  # of an output


def taken(image, dimension: int, **place):
    """Of an image what a run of this dimension takes: the Slice at a place, `take_slice`'s, or the Volume."""
    from xfemnav.imaging.frames.slices import take_slice
    from xfemnav.imaging.frames.volume import take_volume

    return take_volume(image) if dimension > 2 else take_slice(image, **place)


def preoperative(record: dict, folder: Path, given: Path | None = None):
    """The slice of the image that the run in `folder` has read, or the volume, from where it is now, or from the place
    `given`.

    Raises E100 where it is not found, E701 where the record does not say how it was read, and E702 where it holds
    something else now; what reading raises.
    """
    from xfemnav.imaging.reading.gate import read_image

    asked, known = _settings(record, folder), inputs_of(record).get("image")
    if known is None:
        raise XfemnavError("E701", f"{folder / RECORD} does not say where the image of the run was. Run it again.")
    path, same = find("image", known, folder, asked.max_memory_gb, given)
    image = read_image(path, volume=asked.volume, nan=asked.nan, spacing=asked.spacing, nifti_frame=asked.nifti_frame,
                       max_memory_gb=asked.max_memory_gb)
    if not same and image.digest != known.content:
        raise _changed("image", path)
    return taken(image, asked.dimension, **asked.slice.model_dump())


def refuse_a_volume(result, what: str) -> None:
    """Raise E780 for what the runs of slices alone have; `result` is a Result."""
    if result.dimension > 2:
        raise XfemnavError("E780", f"{what}: the run in {result.folder} is of a volume, which has none yet. Its "
                                   "updated image, cavity, lips and moved mesh are files of the run.")


def refuse_changed(role: str, path: Path, record: dict) -> None:
    """Raise E703 where an output of a run is not what that has written; E100 and E106 where it is no file.

    Records of before have no digests of outputs: theirs are believed.
    """
    known = record.get("digests", {}).get(role)
    if known and hashlib.sha256(file_bytes(path, LARGEST_BYTES)).hexdigest() != known:
        raise XfemnavError("E703", f"outputs.{role}: {path} is not what the run has written, or {RECORD} is of another "
                                   "run. Put the file of then back, or run again.")


def run_problems(folder: Path) -> list[XfemnavError]:
    """What has become of the run in `folder` since: outputs that are gone, inputs that are gone or have changed."""
    try:
        record = read_record(folder)
        limit = _settings(record, folder).max_memory_gb
    except XfemnavError as error:
        return [error]
    found = []
    for role, name in record["outputs"].items():
        try:
            if not os.path.isfile(folder / name):
                raise XfemnavError("E100", f"outputs.{role}: no file at {folder / name}. Run it again.")
            refuse_changed(role, folder / name, record)
        except XfemnavError as error:
            found.append(error)
    for place, known in inputs_of(record).items():
        try:
            _check_input(place, known, folder, limit, record)
        except XfemnavError as error:
            found.append(error)
    return found


def _check_input(place: str, known: Known, folder: Path, limit: float, record: dict) -> None:
    """Raise E100 or E702 where an input is gone or has changed; the image may be packed otherwise."""
    if place == "image":
        preoperative(record, folder)
    elif not (found := find(place, known, folder, limit))[1]:
        raise _changed(place, found[0])


def _changed(place: str, path: Path) -> XfemnavError:
    return XfemnavError("E702", f"{place}: {path} is not what it was when the run was made. Put the file of then back, "
                                "or run again.")


def _settings(record: dict, folder: Path) -> Scenario:
    """The parameters of a record. Raises E701 where somebody has damaged them."""
    try:
        return Scenario.model_validate({"xfemnav": 1} | record["parameters"])
    except (ValidationError, KeyError, TypeError):
        raise XfemnavError("E701", f"the parameters in {folder / RECORD} are no scenario. Run it again.") from None
