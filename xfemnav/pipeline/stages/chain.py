"""The chain of stages through the cache: each is looked up by its content key, and computed when it is not there."""

import json
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from xfemnav.interruption import checkpoint
from xfemnav.pipeline.asking.config import Config
from xfemnav.pipeline.asking.settings import STAGES as ORDER
from xfemnav.pipeline.asking.whereabouts import bytes_digest
from xfemnav.pipeline.keeping.cache import Cache, Entry
from xfemnav.pipeline.keeping.keys import canonical, digest, file_digest, stage_key
from xfemnav.pipeline.stages.frame_check import frame_doubts
from xfemnav.pipeline.stages.inputs import (
    STEPWISE,
    Done,
    Inputs,
    Warned,
    changed,
    drawn_after,
    kind,
    recorded,
)
from xfemnav.pipeline.stages.stage import Stage
from xfemnav.pipeline.stages.table import CARRY, FIGURE_OF, IMAGING, SAFE_OF, STAGES_OF

FACTS, VALUE = "facts.json", ("value.json", "value.npz")
FROM_BYTES = ("streamlines", "surfaces")  # kinds of files that are decoded from the bytes that were digested


@dataclass
class Chain:
    """One run's way through the stages.

    `force_from` names the first stage that is computed again whatever the cache holds (None: none).
    `started(stage)` and `finished(done)` are told of each stage; one that is not in the cache is made in the context
    `computing(stage)`.
    """

    config: Config
    cache: Cache
    force_from: str | None = None
    started: Callable[[str], None] = lambda stage: None
    finished: Callable[[Done], None] = lambda done: None
    computing: Callable[[str], AbstractContextManager] = nullcontext

    def __post_init__(self):
        self.inputs = Inputs(self.config)
        self.stages, self.figure = (table[self.config.segment.dimension] for table in (STAGES_OF, FIGURE_OF))
        self.input_facts: dict[str, dict] = {}
        self.warned: list[Warned] = []

    def read_inputs(self) -> None:
        """Digest every input file; an image is decoded only when its bytes have not been seen before."""
        for role, path in self.inputs.files.items():
            checkpoint()
            with recorded() as caught:
                facts, noted = self._facts(role, path)
            self.input_facts[role] = facts
            self.warned += [*caught, *noted]
        self.warned += [Warned("W702", f"{place}: {self.config.named[place].name} is not what it was when the run was "
                                       "made whose scenario this is; the result is of what it is now.")
                        for place in self._changed()]

    def _changed(self) -> list[str]:
        """Places of inputs that are not what an earlier run knew: neither their bytes nor what is decoded from them."""
        now = {self.config.places[role]: facts["digest"] for role, facts in self.input_facts.items()}
        return [place for place, known in self.config.changed.items() if known.content != now.get(place)]

    def run(self, until: str = "warp") -> dict[str, Done]:
        """All stages up to `until` of all steps, and what is carried along; by their labels."""
        for name, step in self._order(until):
            self.inputs.step = step
            self.started(name)
            self._finish(self._stage(self.stages[name], self._params(name, step), self._forced(name)))
            if name == "segment":  # where the organ is, is known
                self.warned += [Warned("W114", text) for text in frame_doubts(self.inputs, self.input_facts)]
        if until == ORDER[-1] and self.config.carry.companions:
            self.started(CARRY.name)
            self._finish(self._stage(CARRY, self.config.carry, self.force_from is not None))
        return self.inputs.done

    def draw(self) -> list[Done]:
        """The figure of each step, drawn or from the cache; the last one is the run's."""
        found = []
        for step in range(len(self.config.steps)):
            self.inputs.step = step
            found.append(self._stage(self.figure, self.config.figure, self.force_from == ORDER[0]))
            self.warned += found[-1].warnings
        return found

    def safe_part(self) -> float | None:
        """The largest part of what the blades do at which the whole run is trusted; None when no part is."""
        step = self.inputs.step
        try:
            safe = SAFE_OF[self.config.segment.dimension]
            return self._stage(safe, self.config.steps, self._forced("solve")).facts["safe_part"]
        finally:
            self.inputs.step = step

    def plan(self, until: str = "warp") -> list[tuple[str, str, str | None]]:
        """What a run would do: (stage, 'cached' or 'would run', key where it is known already)."""
        rows = []
        for name, step in self._order(until):
            self.inputs.step = step
            stage, told = self.stages[name], " ".join(filter(None, (name, self._step_name(name))))
            needed = [*map(self.inputs.label, stage.needs), *self._drawn_in(name)]
            if not all(label in self.inputs.done for label in needed):
                rows.append((told, "would run", None))
                continue
            key = self._key(stage, self._params(name, step))
            entry = None if self._forced(name) else self.cache.verified(key)
            rows.append((told, "cached" if entry else "would run", key))
            if entry:
                self.inputs.done[self.inputs.label(name)] = Done(name, "", "cached", 0.0, entry, {}, (), "")
        return rows

    def _order(self, until: str) -> list[tuple[str, int]]:
        """The stages in order, each with its step; a step is solved where a later one is drawn in its slice."""
        names = ORDER[:ORDER.index(until) + 1]
        rows = [(name, -1) for name in names if name not in STEPWISE]
        for k, _ in enumerate(self.config.steps):
            wanted = [name for name in names if name in STEPWISE]
            if wanted == ["constrain"] and any(k in drawn_after(step.constrain) for step in self.config.steps):
                wanted.append("solve")
            rows += [(name, k) for name in wanted]
        return rows

    def _params(self, name: str, step: int):
        return self.config.steps[step].constrain if name == "constrain" else getattr(self.config, name)

    def _step_name(self, name: str) -> str:
        return self.config.steps[self.inputs.step].name if name in (*STEPWISE, self.figure.name) else ""

    def _drawn_in(self, name: str) -> dict[str, int]:
        """Labels of the solutions in whose deformed slices something of this stage was drawn, and their steps."""
        if name != "constrain":
            return {}
        steps = drawn_after(self.config.steps[self.inputs.step].constrain)
        return {self.inputs.label("solve", k): k for k in sorted(steps)}

    def _finish(self, done: Done) -> None:
        self.inputs.done[self.inputs.label(done.name)] = done
        self.warned += done.warnings
        self.finished(done)

    def _forced(self, name: str) -> bool:
        return self.force_from is not None and ORDER.index(name) >= ORDER.index(self.force_from)

    def _key(self, stage: Stage, params) -> str:
        done = self.inputs.done
        read = {need: done[self.inputs.label(need)].entry.content(*VALUE) for need in stage.needs}
        read |= {f"after {k}": done[label].entry.content(*VALUE) for label, k in self._drawn_in(stage.name).items()}
        own = [role for role in self.input_facts if kind(role) in stage.files]
        read |= {role: self.input_facts[role]["digest"] for role in own}
        # What a stage warns of names its files; but for the image, of which it speaks by that word.
        read |= {f"name of {role}": self.inputs.files[role].name for role in own if role != "image"}
        return stage_key(stage.name, stage.layers, stage.libraries, params, read)

    def _stage(self, stage: Stage, params, force: bool) -> Done:
        def build(folder: Path) -> None:
            with self.computing(stage.name), recorded() as caught:
                checkpoint()
                value = stage.code.compute(params, self.inputs)
                checkpoint()
                facts = stage.code.facts(value, params, self.inputs)
            if value is not None and stage.kept:
                from xfemnav.pipeline.keeping.store import save

                save(folder, value)
                self.inputs.values[self.inputs.label(stage.name)] = value
            for role in (role for role in self.input_facts if kind(role) in stage.files):
                if self._raw(role) != self.input_facts[role]["sha256"]:
                    raise changed(self.inputs.files[role])
            (folder / "public").mkdir()
            with recorded() as later:
                stage.code.publish(value, params, self.inputs, folder / "public")
            write_facts(folder, facts, [*caught, *(item for item in later if item not in caught)])

        start = time.perf_counter()
        with recorded() as healing:
            entry, status = self.cache.obtain(self._key(stage, params), build, force=force)
        facts, caught = read_facts(entry)
        seconds, warned = time.perf_counter() - start, (*healing, *caught)
        return Done(stage.name, self._step_name(stage.name), status, seconds, entry, facts, warned, stage.line(facts))

    def _facts(self, role: str, path: Path) -> tuple[dict, tuple[Warned, ...]]:
        """Digest of an input file, and what reading it warned of."""
        if role == "mesh_file":
            return self._mesh_facts(path)
        if kind(role) in ("points", *FROM_BYTES):
            raw = self.inputs.digests[role] = self._raw(role)
            return {"digest": raw, "sha256": raw}, ()
        return self._image_facts(role, path)

    def _raw(self, role: str) -> str:
        """sha256 of the bytes of an input."""
        return bytes_digest(self.config.places[role], self.inputs.files[role], self.config.max_memory_gb)

    def _image_facts(self, role: str, path: Path) -> tuple[dict, tuple[Warned, ...]]:
        """Digest of the decoded voxels and affine, remembered by the file's name and the digest of its bytes."""
        def build(folder: Path) -> None:
            from xfemnav.imaging.reading import nifti_frames as frames

            with recorded() as caught:
                image = self.inputs.images[role] = self.inputs.decoded(role)
            if image.file_digest != raw:
                raise changed(path)
            shape = list(image.values.shape)
            found = {"digest": image.digest, "shape": shape, "dtype": image.dtype, "affine": image.affine.tolist()}
            write_facts(folder, found | frames.facts(image.frames, shape[:3]), caught)

        limit = self.config.max_memory_gb
        if not os.path.isdir(path) and (not os.path.isfile(path) or path.stat().st_size > limit * 1e9):
            self.inputs.decoded(role)  # refuses it, with the reason
        raw = self._raw(role)
        # What reading warns of names the file.
        key = stage_key("read", ("imaging",), IMAGING, self.inputs.reading(role), {"raw": raw, "name": path.name})
        facts, noted = read_facts(self.cache.obtain(key, build)[0])
        return facts | {"sha256": raw}, noted

    def _mesh_facts(self, path: Path) -> tuple[dict, tuple[Warned, ...]]:
        if not os.path.isfile(path):
            from xfemnav.pipeline.keeping.files import read_vtu

            read_vtu(path, "E209")  # refuses it, with the reason
        raw = file_digest(path)
        return {"digest": raw, "sha256": raw}, ()


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
    code = stage_key("report", ("pipeline",), ("jinja2", "pillow"), None, {})
    return digest({"page": run | {"stages": stages}, "code": code})
