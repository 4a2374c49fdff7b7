"""What a stage of the method is: what it computes, the figures it reports, the public files it leaves, and its key.

A stage is a pure function of its frozen parameters and of earlier values; it can tell neither a cached input from a
fresh one nor a test from a patient. Leaf modules are imported inside the functions, so that a run that finds
everything in the cache imports none of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType


@dataclass(frozen=True)
class Stage:
    """One stage, and what its key must know: the layers and libraries that it reaches, and what it reads.

    `needs` are earlier stages; `files` are roles of input files, without the part after a colon. The module `code` has
    `compute(params, inputs)`, which gives the value and keeps in it what the others need, `facts(value, params,
    inputs)`, its numbers for run.json, and `publish(value, params, inputs, folder)`, which writes files named by role;
    `line(facts)` says the key figure in a word. The value of a stage that is not `kept` is for its own files alone.
    """

    name: str
    layers: tuple[str, ...]
    libraries: tuple[str, ...]
    needs: tuple[str, ...]
    files: tuple[str, ...]
    code: ModuleType
    line: Callable[[dict], str]
    kept: bool = True
