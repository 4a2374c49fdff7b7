"""What a stage may read: the values of finished stages, and the input files, each loaded when it is first asked for."""

import hashlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.pipeline.asking.config import Config
from xfemnav.pipeline.asking.parameters import ReadParams
from xfemnav.pipeline.keeping.cache import Entry

# Volume and value for NaN are the image's alone: what to do about another file that would need them.
REMEDIES = {
    "E121": "holds several volumes, and ⟦volume⟧ is the image's alone. Save the one that counts as a file of its own.",
    "E103": "has NaN or infinite voxels, and ⟦nan⟧ is the image's alone. Save it with numbers in their place.",
}
STEPWISE = ("constrain", "solve", "warp")  # the stages that every step has of its own


@dataclass(frozen=True)
class Warned:
    """A coded warning as it is kept: its code and its text."""

    code: str
    text: str


@dataclass(frozen=True)
class Done:
    """A finished stage: how it came ('ran', 'cached', 'healed'), its entry, what it reported, and the key figure of
    that in a few words (`line`); its step, "" for none."""

    name: str
    step: str
    status: str
    seconds: float
    entry: Entry
    facts: dict
    warnings: tuple[Warned, ...]
    line: str

    def public(self) -> dict[str, Path]:
        """Public files of the stage in the cache, by the first part of their name."""
        folder = self.entry.folder / "public"
        return {path.name.split(".")[0]: path for path in sorted(folder.iterdir())} if folder.is_dir() else {}


@dataclass
class Inputs:
    """What a stage may read: values of earlier stages and input files, each loaded when it is first asked for.

    `digests` are those of files that are decoded from their bytes; `step` is the index of the step under way. Stages of
    steps before the last are kept as "solve:0", "solve:1", ...
    """

    config: Config
    step: int = -1
    done: dict[str, Done] = field(default_factory=dict)
    values: dict[str, object] = field(default_factory=dict)
    images: dict[str, object] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)

    def label(self, stage: str, step: int | None = None) -> str:
        """What a stage of the step under way, or of another, is kept as."""
        step = self.step if step is None else step
        last = step in (-1, len(self.config.steps) - 1)
        return stage if last or stage not in STEPWISE else f"{stage}:{step}"

    def value(self, stage: str, step: int | None = None):
        """Value of a finished stage, of the step under way unless another is named."""
        label = self.label(stage, step)
        if label not in self.values:
            from xfemnav.pipeline.keeping.store import load

            self.values[label] = load(self.done[label].entry.folder)
        return self.values[label]

    @property
    def files(self) -> dict[str, Path]:
        """Input files by role."""
        return self.config.files

    def image(self, role: str):
        """The decoded image of an input file. What reading warns of was told when the file was digested."""
        if role not in self.images:
            with recorded():
                self.images[role] = self.decoded(role)
        return self.images[role]

    def content(self, role: str) -> bytes:
        """The bytes of a file of tracts or a surface, the same that were digested. Raises E101 where they changed."""
        data = bounded_bytes(self.files[role], self.config.limit)
        if hashlib.sha256(data).hexdigest() != self.digests[role]:
            raise changed(self.files[role])
        return data

    def reading(self, role: str) -> ReadParams:
        """How a file is read: pixel sizes given by hand are those of the mask too, and NaN in a mask is background."""
        own = self.config.read
        background = ReadParams(nan=0.0, nifti_frame=own.nifti_frame)
        return {"image": own, "mask": replace(background, spacing=own.spacing),
                "template": replace(background, nan=None)}.get(kind(role), background)

    def decoded(self, role: str):
        """Read and decode an input file; companions with all their values a voxel."""
        from xfemnav.imaging.carrying.kinds import read_companion
        from xfemnav.imaging.reading.gate import read_image

        read, path, limit = self.reading(role), self.files[role], self.config.max_memory_gb
        try:
            for item in self.config.carry.companions:
                if item.role == role and item.kind not in ("points", "streamlines"):
                    return read_companion(path, item.kind, max_memory_gb=limit, nifti_frame=read.nifti_frame)
            return read_image(path, volume=read.volume, nan=read.nan, spacing=read.spacing, max_memory_gb=limit,
                              nifti_frame=read.nifti_frame)
        except XfemnavError as error:
            if role == "image" or error.code not in REMEDIES:
                raise
            text = f"{kind(role).replace('_', ' ')} {path.name} {REMEDIES[error.code]}"
            raise XfemnavError(error.code, text) from None


def bounded_bytes(path: Path, limit: int) -> bytes:
    """Bytes of a regular file of at most `limit` bytes. Raises E100, E101, E102, E106."""
    from xfemnav.imaging.reading.content import file_bytes

    return file_bytes(path, limit)


def kind(role: str) -> str:
    """'companion' of 'companion:flair': a role without the name of its file."""
    return role.partition(":")[0]


def drawn_after(params) -> set[int]:
    """The steps in whose deformed slices cuts or resections of a problem were drawn."""
    drawn = (item.drawn_after for item in (*params.cuts, *params.resections))
    return {step for step in drawn if step is not None}


def changed(path: Path) -> XfemnavError:
    """E101 of a file that another program writes to."""
    return XfemnavError("E101", f"{path.name} changed while it was read. Run again when it is written to no more.")


@contextmanager
def recorded() -> Iterator[list[Warned]]:
    """Collect the coded warnings of a block, each once; other warnings pass on."""
    found: list[Warned] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", XfemnavWarning)
        yield found
    for item in caught:
        if isinstance(item.message, XfemnavWarning):
            warned = Warned(item.message.code, item.message.text)
            if warned not in found:
                found.append(warned)
        else:
            warnings.warn_explicit(item.message, item.category, item.filename, item.lineno)
