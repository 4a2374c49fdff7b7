"""What a row of the table of real data is: the rows stand in `rows_*.py`, the table in test_real_table.py."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple


class Row(NamedTuple):
    """One kind of real file or operation that was once got wrong: its place, what is given, what came before.

    `now(folder)` makes the input in an empty folder, runs it, asserts that what comes is right, and returns it in a few
    words with its numbers, and the code that the user gets ("" for none).
    """

    row: str
    given: str
    before: str
    now: Callable[[Path], tuple[str, str]]
