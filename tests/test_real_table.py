"""Real files and real operations that were once got wrong, row by row: what is given, what came, what comes now.

`pytest -s tests/test_real_table.py` prints the table. Each row is run: nothing in its last two columns is written down.
"""

import importlib
from pathlib import Path

import pytest

MODULES = sorted(path.stem for path in Path(__file__).parent.glob("rows_*.py"))
ROWS = [row for module in MODULES for row in importlib.import_module(module).ROWS]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.row}-{row.given[:40]}".replace(" ", "_"))
def test_row_of_the_table(row, tmp_path):
    text, code = row.now(tmp_path)
    print(f"\n{row.row:<4} | {row.given} | before: {row.before} | now: {text} | {code or '-'}", end="")
