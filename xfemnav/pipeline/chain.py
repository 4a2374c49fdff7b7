"""The chain of stages through the cache: each is looked up by its content key, and computed when it is not there."""

import json
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.pipeline.cache import Cache, Entry
from xfemnav.pipeline.config import STAGES as ORDER
from xfemnav.pipeline.config import Config, ReadParams
from xfemnav.pipeline.keys import canonical, digest, file_digest, stage_key
from xfemnav.pipeline.stages import FIGURE, IMAGING, STAGES, Stage

# --volume and --nan are the image's alone: what to do about another file that would need them.
REMEDIES = {
    "E121": "holds several volumes, and --volume is the image's alone. Save the one that counts as a file of its own.",
    "E103": "has NaN or infinite voxels, and --nan is the image's alone. Save it with numbers in their place.",
}
FACTS, VALUE = "facts.json", ("value.json", "value.npz")


@dataclass(frozen=True)
class Warned:
    """A coded warning as it is kept: its code and its text."""

    code: str
    text: str


@dataclass(frozen=True)
class Done:
    """A finished stage: how it came ('ran', 'cached', 'healed'), its entry, and what it reported."""

    name: str
    status: str
    seconds: float
    entry: Entry
    facts: dict
    warnings: tuple[Warned, ...]

    @property
    def line(self) -> str:
        """The stage's key figure in a few words."""
        return STAGES[self.name].line(self.facts)

    def public(self) -> dict[str, Path]:
        """Public files of the stage in the cache, by role."""
        folder = self.entry.folder / "public"
        return {path.name.split(".")[0]: path for path in sorted(folder.iterdir())} if folder.is_dir() else {}


@dataclass
class Inputs:
    """What a stage may read: values of earlier stages and input files, each loaded when it is first asked for."""

    files: dict[str, Path]
    read: ReadParams
    max_memory_gb: float
    done: dict[str, Done] = field(default_factory=dict)
    values: dict[str, object] = field(default_factory=dict)
    images: dict[str, object] = field(default_factory=dict)

    def value(self, stage: str):
        """Value of a finished stage."""
        if stage not in self.values:
            from xfemnav.pipeline.store import load

            self.values[stage] = load(self.done[stage].entry.folder)
        return self.values[stage]

    def image(self, role: str):
        """The decoded image of an input file. What reading warns of was told when the file was digested."""
        if role not in self.images:
            with recorded():
                self.images[role] = self.decoded(role)
        return self.images[role]

    def reading(self, role: str) -> ReadParams:
        """How a file is read: pixel sizes given by hand are those of the mask too, and NaN in a mask is background."""
        return {"image": self.read, "mask": ReadParams(nan=0.0, spacing=self.read.spacing),
                "template_mask": ReadParams(nan=0.0)}.get(role, ReadParams())

    def decoded(self, role: str):
        """Read and decode an input file."""
        from xfemnav.imaging.reading import read_image

        read, path = self.reading(role), self.files[role]
        try:
            return read_image(path, volume=read.volume, nan=read.nan, spacing=read.spacing,
                              max_memory_gb=self.max_memory_gb)
        except XfemnavError as error:
            if role == "image" or error.code not in REMEDIES:
                raise
            text = f"{role.replace('_', ' ')} {path.name} {REMEDIES[error.code]}"
            raise XfemnavError(error.code, text) from None


@dataclass
class Chain:
    """One run's way through the stages.

    `force_from` names the first stage that is computed again whatever the cache holds (None: none).
    `started(stage)` and `finished(done)` are told of each stage.
    """

    config: Config
    cache: Cache
    force_from: str | None = None
    started: Callable[[str], None] = lambda stage: None
    finished: Callable[[Done], None] = lambda done: None

    def __post_init__(self):
        self.inputs = Inputs(self.config.inputs(), self.config.read, self.config.max_memory_gb)
        self.input_facts: dict[str, dict] = {}
        self.warned: list[Warned] = []

    def read_inputs(self) -> None:
        """Digest every input file; an image is decoded only when its bytes have not been seen before."""
        for role, path in self.inputs.files.items():
            with recorded() as caught:
                facts, noted = self._mesh_facts(path) if role == "mesh_file" else self._image_facts(role, path)
            self.input_facts[role] = facts
            self.warned += [*caught, *noted]

    def run(self, until: str = "warp") -> dict[str, Done]:
        """All stages up to `until`, by name."""
        for name in ORDER[:ORDER.index(until) + 1]:
            self.started(name)
            done = self._stage(STAGES[name], getattr(self.config, name), self._forced(name))
            self.inputs.done[name] = done
            self.warned += done.warnings
            self.finished(done)
        return self.inputs.done

    def draw(self) -> Done:
        """The figure, drawn or from the cache."""
        return self._stage(FIGURE, None, self.force_from == ORDER[0])

    def plan(self, until: str = "warp") -> list[tuple[str, str, str | None]]:
        """What a run would do: (stage, 'cached' or 'would run', key where it is known already)."""
        rows = []
        for name in ORDER[:ORDER.index(until) + 1]:
            stage = STAGES[name]
            if not all(need in self.inputs.done for need in stage.needs):
                rows.append((name, "would run", None))
                continue
            key = self._key(stage, getattr(self.config, name))
            entry = None if self._forced(name) else self.cache.verified(key)
            rows.append((name, "cached" if entry else "would run", key))
            if entry:
                self.inputs.done[name] = Done(name, "cached", 0.0, entry, {}, ())
        return rows

    def _forced(self, name: str) -> bool:
        return self.force_from is not None and ORDER.index(name) >= ORDER.index(self.force_from)

    def _key(self, stage: Stage, params) -> str:
        read = {need: self.inputs.done[need].entry.content(*VALUE) for need in stage.needs}
        read |= {role: self.input_facts[role]["digest"] for role in stage.files if role in self.input_facts}
        return stage_key(stage.name, stage.layers, stage.libraries, params, read)

    def _stage(self, stage: Stage, params, force: bool) -> Done:
        def build(folder: Path) -> None:
            with recorded() as caught:
                value = stage.compute(params, self.inputs)
                facts = stage.facts(value, self.inputs)
            if value is not None:
                from xfemnav.pipeline.store import save

                save(folder, value)
                self.inputs.values[stage.name] = value
            for role in self.input_facts.keys() & set(stage.files):
                if file_digest(self.inputs.files[role]) != self.input_facts[role]["sha256"]:
                    raise _changed(self.inputs.files[role])
            (folder / "public").mkdir()
            stage.publish(value, self.inputs, folder / "public")
            write_facts(folder, facts, caught)

        start = time.perf_counter()
        with recorded() as healing:
            entry, status = self.cache.obtain(self._key(stage, params), build, force=force)
        facts, caught = read_facts(entry)
        return Done(stage.name, status, time.perf_counter() - start, entry, facts, (*healing, *caught))

    def _image_facts(self, role: str, path: Path) -> tuple[dict, tuple[Warned, ...]]:
        """Digest of the decoded voxels and affine, remembered by the file's name and the digest of its bytes."""
        def build(folder: Path) -> None:
            with recorded() as caught:
                image = self.inputs.images[role] = self.inputs.decoded(role)
            if image.file_digest != raw:
                raise _changed(path)
            write_facts(folder, {"digest": image.digest, "shape": list(image.values.shape), "dtype": image.dtype,
                                 "affine": image.affine.tolist()}, caught)

        if not os.path.isfile(path) or path.stat().st_size > self.config.max_memory_gb * 1e9:
            self.inputs.decoded(role)  # refuses it, with the reason
        raw = file_digest(path)
        # What reading warns of names the file.
        key = stage_key("read", ("imaging",), IMAGING, self.inputs.reading(role), {"raw": raw, "name": path.name})
        facts, noted = read_facts(self.cache.obtain(key, build)[0])
        return facts | {"sha256": raw}, noted

    def _mesh_facts(self, path: Path) -> tuple[dict, tuple[Warned, ...]]:
        if not os.path.isfile(path):
            from xfemnav.pipeline.files import read_vtu

            read_vtu(path, "E209")  # refuses it, with the reason
        raw = file_digest(path)
        return {"digest": raw, "sha256": raw}, ()


def _changed(path: Path) -> XfemnavError:
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
            warned = Warned(item.message.code, item.message.message)
            if warned not in found:
                found.append(warned)
        else:
            warnings.warn_explicit(item.message, item.category, item.filename, item.lineno)


def write_facts(folder: Path, facts: dict, caught: list[Warned]) -> None:
    """Write what a stage reported into its entry."""
    (folder / FACTS).write_bytes(canonical({"facts": facts, "warnings": [vars(item) for item in caught]}))


def read_facts(entry: Entry) -> tuple[dict, tuple[Warned, ...]]:
    """What a stage reported: its facts and its warnings."""
    found = json.loads((entry.folder / FACTS).read_bytes())
    return found["facts"], tuple(Warned(**item) for item in found["warnings"])


def page_key(run: dict) -> str:
    """Key of the report of a run: everything in the record but how it came about."""
    stages = [{"name": stage["name"], "key": stage["key"]} for stage in run["stages"]]
    return digest({"page": run | {"stages": stages}, "code": stage_key("report", ("pipeline",), ("jinja2",), None, {})})
