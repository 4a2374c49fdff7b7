"""The page of the architecture: its files, types and floors are those of the code, its trip has eight steps."""

import ast
import re
from pathlib import Path

from xfemnav.pipeline.layers import LAYERS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/reference/architecture.md").read_text()
WORDS = ("Mesh", "Chart", "Parts", "Space", "Conditions", "Solution", "Motion", "Grid")
FILE = r"`((?:xfemnav|cli|tests)/[\w/.]+)`"


def section(title: str) -> str:
    """The text below a heading."""
    return PAGE.split(f"## {title}\n")[1].split("\n## ")[0]


def test_every_file_on_the_page_is_there():
    """And in the answers for contributors."""
    files = re.findall(FILE, PAGE) + re.findall(FILE, (ROOT / "CONTRIBUTING.md").read_text())
    assert len(files) > 80
    assert [name for name in files if not (ROOT / name).is_file()] == []


def test_eight_words_are_eight_types_each_in_its_file():
    """Which opens with what it is."""
    rows = re.findall(rf"^\| \*\*(\w+)\*\* \| .* \| `(\w+)` \| {FILE} \|$", section("Eight words"), re.MULTILINE)
    assert tuple(word for word, _, _ in rows) == WORDS
    assert len({file for _, _, file in rows}) == len(WORDS)
    for word, name, file in rows:
        tree = ast.parse((ROOT / file).read_text())
        assert ast.get_docstring(tree), file
        assert name in [node.name for node in tree.body if isinstance(node, ast.ClassDef)], word


def test_the_drawing_is_the_table_of_layers():
    """All floors from the top down: each stands above what it may import, neighbours import not each other."""
    drawing = re.search(r"^```text\n(.*?)^```", section("The floors"), re.MULTILINE | re.DOTALL)[1]
    floors = [[word for word in line.split() if word in LAYERS] for line in drawing.splitlines()
              if line[2:3].strip()]
    height = {name: -k for k, floor in enumerate(floors) for name in floor}
    assert height.keys() == LAYERS.keys()
    for name, below in LAYERS.items():
        assert all(height[other] < height[name] for other in below), name
    for floor in floors[:-1]:  # each floor is needed by one above, and needs one below
        assert all(any(height[other] == height[name] - 1 for other in LAYERS[name]) for name in floor)


def test_the_trip_has_eight_steps_with_files_of_every_floor():
    steps = re.findall(r"^\d\. \*\*.*?(?=^\d\. |^\n|\Z)", section("The trip of a cut"), re.MULTILINE | re.DOTALL)
    assert [step[0] for step in steps] == list("12345678")
    files = [re.findall(FILE, step) for step in steps]
    assert all(files)
    assert {part for found in files for name in found for part in name.split("/")} >= LAYERS.keys()
