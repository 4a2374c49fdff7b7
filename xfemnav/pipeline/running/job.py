"""One run, from a checked configuration to run.json."""

import math
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from xfemnav import __version__
from xfemnav.errors import EXIT_DATA, EXIT_UNTRUSTED, FAULTS, XfemnavError
from xfemnav.interruption import Interrupted, checkpoint
from xfemnav.naming import ARGUMENTS, Names, kept
from xfemnav.pipeline.asking import whereabouts
from xfemnav.pipeline.asking.config import Config
from xfemnav.pipeline.asking.scenario_file import placed, scenario_text
from xfemnav.pipeline.asking.whereabouts import bytes_digest
from xfemnav.pipeline.keeping.cache import Cache
from xfemnav.pipeline.keeping.disk import scratch
from xfemnav.pipeline.keeping.kernels import compiling, settle_kernel_cache
from xfemnav.pipeline.keeping.names import SCHEMA, stem
from xfemnav.pipeline.running.runfile import OutputFolder, output_folder
from xfemnav.pipeline.stages import stage_carry
from xfemnav.pipeline.stages.chain import Chain, page_key
from xfemnav.pipeline.stages.inputs import STEPWISE, Done, Warned, recorded
from xfemnav.pipeline.stages.stage_safe import told
from xfemnav.pipeline.telling.verdicts import doubts, reasons, stillness, towards, verdicts


@dataclass(frozen=True)
class Options:
    """What a run does beside its configuration: where it writes, how far it goes, what it computes again, and how
    what it tells calls settings."""

    output: Path
    cache: Path
    until: str = "warp"
    force_from: str | None = None
    report: bool = True
    argv: tuple[str, ...] = ()
    names: Names = ARGUMENTS


@dataclass(frozen=True)
class Listener:
    """Who is told how a run gets on."""

    started: Callable[[str], None] = lambda stage: None
    finished: Callable[[Done], None] = lambda done: None
    waiting: Callable[[], None] = lambda: None
    compiling: Callable[[], None] = lambda: None
    failed: Callable[[dict], None] = lambda record: None


def default_output(image: Path) -> Path:
    """./<stem>_xfemnav."""
    return Path(f"{stem(image)}_xfemnav")


def default_cache() -> Path:
    """$XFEMNAV_CACHE, else ~/.cache/xfemnav."""
    return Path(os.environ.get("XFEMNAV_CACHE") or "~/.cache/xfemnav").expanduser()


@contextmanager
def opened_cache(root: Path) -> Iterator[tuple[Cache, tuple[Warned, ...]]]:
    """The cache at `root`; when that, or an entry of it, cannot be written, a temporary one, with warning W602."""
    with ExitStack() as stack:
        def spare() -> Cache:
            return Cache(stack.enter_context(scratch()))

        warned = ()
        try:
            cache = Cache(root, spare)
        except XfemnavError as error:
            if error.code != "E502":
                raise
            warned = (Warned("W602", f"the cache folder {root} cannot be written; nothing is kept for the next run."),)
            cache = spare()
        stack.enter_context(cache.in_use())
        yield cache, warned


def run(config: Config, options: Options, listener: Listener = Listener()) -> dict:
    """Run the stages, publish their files, and return the record that was written as run.json.

    A failure (XfemnavError, Interrupted, or a bug) is recorded in run.json, unless the result of an earlier run is
    there still whole, and raised again.
    """
    output = options.output.absolute()
    with (output_folder(output, config.image, listener.waiting) as folder,
          opened_cache(options.cache) as (cache, warned)):
        folder.refuse_overwriting([*config.files.values(), *config.also_read], _roles(config))
        passing = settle_kernel_cache()
        computing = partial(compiling, tell=listener.compiling)
        chain = Chain(config, cache, options.force_from, listener.started, listener.finished, computing)
        chain.warned += warned
        if passing:
            chain.warned.append(Warned("W602", passing))
        record = {"schema": SCHEMA, "dimension": config.segment.dimension, "version": __version__,
                  "argv": list(options.argv), "parameters": placed(config.parameters, config.named, output)}
        try:
            return _run(chain, options, folder, record)
        except BaseException as error:
            record = _reported(chain, output, record, options.names) | failure(error, options.names)
            folder.write_failure(record)
            listener.failed(record)
            raise


def plan(config: Config, options: Options) -> list[tuple[str, str, str | None]]:
    """What `run` would do, stage by stage; nothing is written but the digests of inputs in the cache."""
    with opened_cache(options.cache) as (cache, _):
        chain = Chain(config, cache, options.force_from)
        chain.read_inputs()
        return chain.plan(options.until)


def _run(chain: Chain, options: Options, folder: OutputFolder, record: dict) -> dict:
    chain.read_inputs()
    done = chain.run(options.until)
    faults = _judged(chain)
    if chain.config.strict and chain.warned:
        first = chain.warned[0]
        raise XfemnavError(first.code, f"{first.text} (⟦strict=True⟧ makes warnings errors)")
    wanted = options.report and options.until == "warp"
    drawn = chain.draw() if wanted else []
    record = _reported(chain, folder.path, record, options.names) | {"status": "complete", "exit_code": 0}
    if faults:
        record |= _untrusted(chain, faults, options.names)
    files = {}
    for label, item in done.items():
        _collect(files, chain.config, label, item)
    if wanted:
        for k, item in enumerate(drawn):
            _collect(files, chain.config, chain.inputs.label("warp", k).replace("warp", "figure"), item)
        record["outputs"] = folder.names([*files, "report", "scenario"], files)
        figures = {role: path for role, (path, _) in files.items() if role.partition(":")[0] == "figure"}
        files["report"] = _page(chain, record, figures)
        record["warnings"] = _warnings(chain, options.names)
    checkpoint()
    texts = {"scenario": scenario_text(chain.config.settings, chain.config.named, folder.path)}
    record["outputs"] = folder.publish(files, texts, record, _sidecars(chain))
    record["digests"] = {role: sha256 for role, (_, sha256) in files.items()}
    folder.write_record(record)
    return record


def _judged(chain: Chain) -> list[str]:
    """Why the run is not to be trusted; what else its numbers give rise to is added to the chain's warnings."""
    found = _solved(chain)
    for name, facts, judged in found:
        chain.warned += [Warned(*doubt) for doubt in doubts(name, judged, facts["checks"], facts["model"]["name"])]
    if len(found) == len(chain.config.steps):
        chain.warned += [Warned(*doubt) for doubt in towards(chain.config.parameters["retract"])]
        taken = any(facts["resections"] for _, facts, _ in found)
        chain.warned += [Warned(*doubt) for doubt in stillness([facts["checks"] for _, facts, _ in found], taken)]
    return [reason for name, _, judged in found for reason in reasons(name, judged)]


def _solved(chain: Chain) -> list[tuple[str, dict, dict]]:
    """Each step that has come so far: its name, all that its own stages reported, and the verdicts on that."""
    found = []
    for k, step in enumerate(chain.config.steps):
        facts: dict = {}
        for stage in STEPWISE:
            if done := chain.inputs.done.get(chain.inputs.label(stage, k)):
                _gather(facts, done.facts)
        if "checks" in facts:
            pixel = _grid_size(chain.inputs.done["segment"].facts)
            found.append((step.name, facts, verdicts(facts, pixel)))
    return found


def _grid_size(facts: dict) -> float:
    """Size of a pixel, mm^2, or of a voxel, mm^3."""
    return math.prod((facts.get("slice") or facts["volume"])["spacing"])


def _untrusted(chain: Chain, faults: list[str], names: Names) -> dict:
    """Status and error of a run that is not to be trusted, with the part of it that would be."""
    blades = chain.config.parameters["retract"]
    safe = told(chain.safe_part(), chain.config.parameters) if blades else "No blade acts, so none can do less."
    text = f"{'; '.join(faults)}. {safe} The results are written, and marked untrusted (exit 3)."
    return {"status": "untrusted", "exit_code": EXIT_UNTRUSTED, "error": kept("E401", text, names)}


#: Files of the steps before the last that are published.
OF_A_STEP = ("updated", "cavity", "solution", "figure")


def _sidecars(chain: Chain) -> dict[str, dict]:
    """What stages say of their images, for the sidecars, by role."""
    config = chain.config
    return {_role(config, label, done, name): words for label, done in chain.inputs.done.items()
            for name, words in done.facts.get("sidecars", {}).items()}


def _role(config: Config, label: str, item: Done, name: str) -> str:
    """The role of a public file `name` of a stage that is kept as `label`."""
    _, _, step = label.partition(":")
    if item.name == "carry":
        number, _, what = name.removeprefix("carry-").partition("-")
        return config.carry.companions[int(number)].role + (f"-{what}" if what else "")
    return f"{name}:{config.steps[int(step)].name}" if step else name


def _collect(files: dict[str, tuple[Path, str]], config: Config, label: str, item: Done) -> None:
    """Add the public files of a stage, with their sha256, to `files` by role."""
    _, _, step = label.partition(":")
    for name, path in item.public().items():
        if not step or name in OF_A_STEP:
            files[_role(config, label, item, name)] = path, item.entry.files[f"public/{path.name}"]


def _roles(config: Config) -> dict[str, str]:
    """All roles of outputs that a run may write beside the fixed ones, and the ending of those that keep their own."""
    found = {f"{name}:{step.name}": "" for step in config.steps[:-1] for name in OF_A_STEP}
    for item in config.carry.companions:
        found[item.role] = stage_carry.ending(item.kind, config.files[item.role])
        if item.kind == "points":
            found[item.role.replace("points", "points-markups", 1)] = ""
    return found


def _inputs(chain: Chain, folder: Path) -> dict:
    """Where the inputs lie, as seen from the output folder and altogether, and the digests of those that were read."""
    config, known = chain.config, {}
    for role, facts in chain.input_facts.items():
        decoded = {"content": facts["digest"]} if "affine" in facts else {}
        known[config.places[role]] = {"sha256": facts["sha256"]} | decoded
    return whereabouts.told(config.named, folder, known, partial(bytes_digest, max_memory_gb=config.max_memory_gb))


def _reported(chain: Chain, folder: Path, record: dict, names: Names) -> dict:
    """`record` with what the stages that finished have reported."""
    image = chain.input_facts.get("image")
    found = {
        "inputs": _inputs(chain, folder),
        "input": image and {name: image[name] for name in ("sha256", "shape", "affine", "dtype")},
        "stages": [{"name": done.name} | ({"step": done.step} if done.step else {}) |
                   {"status": done.status, "key": done.entry.key, "seconds": round(done.seconds, 4)}
                   for done in chain.inputs.done.values()],
        "warnings": _warnings(chain, names),
        "outputs": {},
    }
    steps: dict[int, dict] = {}
    for label, done in chain.inputs.done.items():
        _, _, step = label.partition(":")
        _gather(steps.setdefault(int(step), {}) if step else found, done.facts)
    for facts in (found, *steps.values()):
        if "checks" in facts:
            facts["verdicts"] = verdicts(facts, _grid_size(found))
    if len(chain.config.steps) > 1:
        found["steps"] = [_step_record(step, steps.get(k, found)) for k, step in enumerate(chain.config.steps)]
    return {name: fact for name, fact in (record | found).items() if name != "places"}  # the verdicts hold them


def _warnings(chain: Chain, names: Names) -> list[dict]:
    """What was warned of so far, each once."""
    return [kept(item.code, item.text, names) for item in dict.fromkeys(chain.warned)]


def _gather(found: dict, facts: dict) -> None:
    """Add what a stage reported; tables of the same name are joined."""
    for name, fact in facts.items():
        if name != "sidecars":
            found[name] = found.get(name, {}) | fact if isinstance(fact, dict) else fact


#: What the record says of each step.
STEP_FACTS = ("cuts", "resections", "pieces", "retractor", "checks", "verdicts")


def _step_record(step, facts: dict) -> dict:
    """A step in the record: what began and ended with it, and what came of it."""
    known = {name: facts[name] for name in STEP_FACTS if name in facts}
    return {"name": step.name, "acts": list(step.acts), "ends": list(step.ends)} | known


def failure(error: BaseException, names: Names = ARGUMENTS) -> dict:
    """Status, exit code and error of a run that ended with `error`."""
    if isinstance(error, XfemnavError):
        exit_code = FAULTS[error.code].exit_code or EXIT_DATA
        return {"status": "failed", "exit_code": exit_code, "error": kept(error.code, error.text, names)}
    if isinstance(error, Interrupted | KeyboardInterrupt):
        return {"status": "interrupted", "exit_code": 128 + getattr(error, "signum", 2)}
    if isinstance(error, BrokenPipeError):  # whoever read our lines has gone away
        return {"status": "interrupted", "exit_code": 141}
    code = "E800" if isinstance(error, MemoryError) else "E900"
    text = f"{type(error).__name__}: {error}"
    return {"status": "failed", "exit_code": FAULTS[code].exit_code, "error": {"code": code, "text": text}}


def _page(chain: Chain, record: dict, figures: dict[str, Path]) -> tuple[Path, str]:
    """The report in the cache, and its sha256; what storing it gives rise to is added to the chain's warnings."""
    def build(folder: Path) -> None:
        from xfemnav.pipeline.telling.report import write_report

        write_report(record, folder, figures)

    with recorded() as caught:
        entry, _ = chain.cache.obtain(page_key(record), build)
    chain.warned += caught
    return entry.folder / "report.html", entry.files["report.html"]
