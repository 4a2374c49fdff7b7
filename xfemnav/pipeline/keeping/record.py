"""A finished run's record, opened again: what of run.json must be there, and of what form, before it is relied on.

Somebody may have edited the file, or half of it may be lost; the program that wrote it may have been another version.
"""

import json
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from xfemnav.errors import FAULTS, XfemnavError
from xfemnav.imaging.reading.content import file_bytes
from xfemnav.pipeline.keeping.names import KNOWN_SCHEMAS, LIMIT_BYTES, OWN_NAME, RECORD, SCHEMA


def _own_name(name: str) -> str:
    if not OWN_NAME.fullmatch(name):
        raise ValueError("no name that a run gives to a file")
    return name


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]  # mm


class _Cut(_Part):
    name: str
    path: Annotated[list[tuple[Coordinate, Coordinate]], Field(min_length=2)] | None = None  # a surface has none


class _Step(_Part):
    name: str
    cuts: list[_Cut]


class _Slice(_Part):
    plane: Literal["axial", "coronal", "sagittal"]


class _Volume(_Part):
    shape: tuple[int, int, int]


class _Parameters(_Part):
    """Those that what comes later is read by."""

    space: Literal["ras", "lps", "voxel"]
    nifti_frame: Literal["auto", "sform", "qform"] = "auto"  # which records of before do not state


class _Error(_Part):
    code: Literal[tuple(FAULTS)]
    text: str


class _Input(_Part):
    path: Annotated[str, Field(min_length=1)]
    absolute: Annotated[str, Field(min_length=1)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] = ""
    content: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] = ""


class _Record(_Part):
    status: Literal["complete", "untrusted", "failed", "interrupted"]
    outputs: dict[str, Annotated[str, AfterValidator(_own_name)]]
    dimension: Literal[2, 3] = 2
    slice: _Slice | None = None
    volume: _Volume | None = None
    parameters: _Parameters | None = None
    cuts: list[_Cut] | None = None
    steps: list[_Step] = []
    inputs: dict[str, _Input] = {}
    digests: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = {}
    error: _Error | None = None

    @model_validator(mode="after")
    def _whole(self):
        grid = self.slice if self.dimension == 2 else self.volume
        if "solution" in self.outputs and None in (grid, self.cuts, self.parameters):
            raise ValueError("it has a solution, but no slice (or volume), no cuts or no parameters")
        if self.dimension == 2 and any(cut.path is None for cut in self.cuts or ()):
            raise ValueError("a cut has no path")
        if self.status == "untrusted" and self.error is None:
            raise ValueError("it is untrusted and does not say why")
        return self


def read_record(folder: Path) -> dict:
    """The record of the run in `folder`. Raises E100 when there is none and E701 when it is no record of ours."""
    path = folder / RECORD
    if not os.path.exists(path):
        missing = f"no {RECORD} in" if os.path.isdir(folder) else "no folder"
        raise XfemnavError("E100", f"{missing} {folder}. Give the output folder of a run.")
    try:
        text = file_bytes(path, LIMIT_BYTES)
        record = json.loads(text)
        if not isinstance(record, dict) or record.get("schema") not in KNOWN_SCHEMAS:
            raise ValueError(f"its schema is not {SCHEMA}")
        # Bytes of file names that are no UTF-8 are halves of characters there, which Python alone takes for a text.
        _Record.model_validate_json(json.dumps(record, ensure_ascii=False).encode(errors="replace"))
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(map(str, first["loc"])) or "it"
        raise XfemnavError("E701", f"{path} is damaged: {place}: {first['msg']}. Run the command again.") from None
    except (ValueError, RecursionError, XfemnavError) as error:
        raise XfemnavError("E701", f"{path} is no {SCHEMA} record ({error}). Run the command again.") from None
    return record
