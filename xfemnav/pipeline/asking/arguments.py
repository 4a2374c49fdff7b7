"""What a program hands over, as values that the rest relies on: plain numbers, words, lists and paths.

Python takes anything for an argument; what is no number or path of a user's is refused here, by name.
"""

import math
import os
from collections.abc import Sequence
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.asking.settings import LARGEST


def plain(value):
    """A value as lists, numbers, words and Paths: no array, no tuple. What is none of these stays, to be refused."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
        return Path(value) if isinstance(value, str) else value
    listed = isinstance(value, Sequence) and not isinstance(value, str | bytes)
    return [plain(item) for item in value] if listed else value


def path_of(value, name: str) -> Path:
    """The path that an argument is. Raises E780 for what is none."""
    value = plain(value)
    if not isinstance(value, str | Path) or not str(value) or "\0" in str(value):
        raise XfemnavError("E780", f"⟦!{name}⟧: wants the path of a file or folder, got {shown(value)}.")
    return Path(value)


def real(value) -> float | None:
    """A number of the size that settings may have; None for what is none: a bool, a text, NaN, 1e300."""
    known = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if known and -LARGEST <= value <= LARGEST else None


def shown(value) -> str:
    """A value as a message has it, cut short."""
    try:
        text = value if isinstance(value, str) else repr(value)
    except ValueError:  # a number of thousands of digits
        text = f"a number of {math.floor(value.bit_length() * math.log10(2)) + 1} digits"
    return repr(text[:60]) if isinstance(value, str) else text[:60]
