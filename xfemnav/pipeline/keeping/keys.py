"""Content keys: what a stage's result depends on, as one sha256.

A key covers the stage's parameters, the content of its inputs, the code that its layer can reach, and the versions
of the numeric libraries. Paths, times and thread counts are not in it.
"""

import hashlib
import json
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from xfemnav.pipeline.layers import reach

PACKAGE = Path(__file__).parents[2]
DATA = (".html", ".json")  # files of the package that its code renders or reads
# Every stage runs through these, whatever its layer.
COMMON_CODE = ("errors.py", "interruption.py", "limits.py", "pipeline/stages/stage.py", "pipeline/keeping/store.py",
               "pipeline/keeping/files.py")


def plain(value):
    """`value` as JSON types: dataclasses become objects, tuples become lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def canonical(value) -> bytes:
    """The one JSON text of `value`: sorted names, no spaces, no NaN. Equal values give equal bytes."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest(value) -> str:
    """sha256 of the canonical JSON of `value`."""
    return hashlib.sha256(canonical(value)).hexdigest()


def file_digest(path: Path) -> str:
    """sha256 of a file's bytes."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@cache
def code_digest(layers: tuple[str, ...], root: Path = PACKAGE) -> str:
    """sha256 over every module and data file that `layers` can reach (table `LAYERS`), and of `COMMON_CODE`."""
    sources = {root / name for name in COMMON_CODE}
    for below in set().union(*map(reach, layers)):
        sources.update(path for path in (root / below).rglob("*") if path.suffix in (".py", *DATA))
    return source_digest(*sources, root=root)


@cache
def own_digest(stage: str, root: Path = PACKAGE) -> str:
    """sha256 of the stage's own modules, of slices and of volumes; of nothing where it has none."""
    return source_digest(*root.glob(f"pipeline/stages/*_{stage}.py"), root=root)


def source_digest(*sources: Path, root: Path = PACKAGE) -> str:
    """sha256 over names and content of source files below `root`."""
    stated = {source: source.stat() for source in sources}
    return digest({source.relative_to(root).as_posix(): _read_once(source, now.st_mtime_ns, now.st_size)
                   for source, now in stated.items()})


@cache
def _read_once(source: Path, changed_ns: int, size: int) -> str:
    """`file_digest` of a source: most of them are reached by several layers."""
    return file_digest(source)


def library_versions(names: tuple[str, ...]) -> dict[str, str | None]:
    """Installed versions of `names`, None of one that is not there. Read from metadata: nothing is imported."""
    return {name: _installed(name) for name in names}


@cache
def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def stage_key(stage: str, layers: tuple[str, ...], libraries: tuple[str, ...], params, inputs: dict[str, str]) -> str:
    """Key of one stage: `params` is its frozen dataclass, `inputs` maps each input to the digest of its content."""
    return digest({
        "stage": stage,
        "params": params,
        "inputs": inputs,
        "code": code_digest(layers),
        "own code": own_digest(stage),
        "libraries": library_versions(libraries),
    })
