"""The slices of a batch: scenarios of a folder, or the rows of a manifest."""

import csv
import io
import os
import re
from dataclasses import dataclass
from pathlib import Path

import click

from xfemnav.errors import XfemnavError
from xfemnav_cli.telling import printable

IMAGE_SUFFIXES = (".nii.gz", ".nii", ".mgz", ".mgh", ".nrrd", ".nhdr", ".mha", ".mhd")
MISSING = ("", "n/a")
TRUTH = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


@dataclass(frozen=True)
class Item:
    """One slice: what it is called, its image (None: its scenario names it), the arguments of its run, the folder from
    which paths in them lead, and its output folder."""

    name: str
    image: Path | None
    words: tuple[str, ...]
    home: Path
    folder: Path


def find_items(source: Path, target: Path) -> list[Item]:
    """Every scenario of `source`, in the order of their names; where the image is missing, its run will say so.

    The image of <stem>.toml is <stem>.nii.gz (or another format); of <stem>.<label>.toml that of <stem> too, so that
    several slices share a volume; else the one that the scenario names.
    """
    items = []
    for scenario in sorted(source.glob("*.toml")):
        image = _image_of(scenario)
        words = ["--scenario", os.path.abspath(scenario)]
        if image is not None:
            # Absolute: a name such as -x.nii must not look like an option.
            words.insert(0, os.path.abspath(image))
        items.append(Item(scenario.stem, image, tuple(words), Path.cwd(), target / scenario.stem))
    return items


def _image_of(scenario: Path) -> Path | None:
    """The image beside a scenario, None where only the scenario names one."""
    parts = scenario.stem.split(".")
    for n in range(len(parts), 0, -1):
        for suffix in IMAGE_SUFFIXES:
            if os.path.isfile(image := scenario.with_name(".".join(parts[:n]) + suffix)):
                return image
    return None if _names_an_image(scenario) else scenario.with_name(scenario.stem + IMAGE_SUFFIXES[0])


def _names_an_image(scenario: Path) -> bool:
    from xfemnav.pipeline.asking.scenario_file import read_toml

    try:
        return "image" in read_toml(scenario)
    except XfemnavError:
        return True  # its run says what is wrong with it


def read_manifest(path: Path, target: Path) -> list[Item]:
    """The rows of a table, .tsv or .csv: columns are `image`, `scenario`, `name`, and any setting of `xfemnav run`.

    Cells are as on the command line, given in the manifest's folder: from there paths lead, and they may lead anywhere.
    n/a, or nothing, is not given. A column that comes twice is given twice. Raises click.UsageError.
    """
    from xfemnav.imaging.reading.content import decoded, file_bytes
    from xfemnav.pipeline.asking.scenario_file import LIMIT_BYTES

    try:
        text = decoded(file_bytes(path, LIMIT_BYTES))
    except ValueError as error:
        raise _unusable(path, str(error)) from None
    table = csv.reader(io.StringIO(text, newline=""), delimiter="\t" if path.suffix.lower() == ".tsv" else ",")
    try:
        header, *rows = [[cell.strip() for cell in row] for row in table if any(map(str.strip, row))]
    except (ValueError, csv.Error):
        header, rows = [], []
    if not rows:
        raise _unusable(path, "holds no rows under a header")
    columns = [name.lstrip("-").replace("-", "_").lower() for name in header]
    _check_columns(path, columns)
    items = []
    for number, row in enumerate(rows, 2):
        if len(row) != len(columns):
            raise _unusable(path, f"line {number} has {len(row)} cells, and the header {len(columns)}")
        given = [(column, cell) for column, cell in zip(columns, row) if cell.lower() not in MISSING]
        items.append(_item(path, number, given, target))
    names = [item.name for item in items]
    for name in names:
        if names.count(name) > 1:
            raise _unusable(path, f"has several rows called '{name}'; give them a column 'name'")
    return items


def _item(path: Path, number: int, given: list[tuple[str, str]], target: Path) -> Item:
    from xfemnav.pipeline.keeping.names import stem
    from xfemnav.pipeline.running.batch_table import NAME as TABLE_NAME

    own, words, home = {}, [], Path(os.path.abspath(path)).parent
    for column, cell in given:
        if column in ("name", "image", "scenario"):
            own[column] = cell
        else:
            words += _option(path, number, column, cell)
    image = home / own["image"] if "image" in own else None
    if "scenario" in own:
        words = ["--scenario", str(home / own["scenario"]), *words]
    if image is not None:
        words.insert(0, str(image))
    name = own.get("name") or (Path(own["scenario"]).stem if "scenario" in own else stem(image) if image else "")
    if not name or name.startswith(".") or "/" in name or "\\" in name or name.lower() == TABLE_NAME:
        raise _unusable(path, f"line {number} has the name '{name}', which is no name of a folder of a slice")
    return Item(name, image, tuple(words), home, target / name)


def _option(path: Path, number: int, column: str, cell: str) -> list[str]:
    """A cell as the command line gives it."""
    flag = f"--{column.replace('_', '-')}"
    if not _options()[column].is_flag:
        return [f"{flag}={cell}"]
    if cell.lower() not in TRUTH:
        raise _unusable(path, f"line {number}: {column} is '{cell}', wanted true or false")
    return [flag] if TRUTH[cell.lower()] else []


def _options() -> dict[str, click.Option]:
    """The settings that a manifest may have: those of a scenario."""
    from xfemnav.pipeline.asking.settings import TABLE
    from xfemnav_cli.run import run

    return {option.name: option for option in run.params if option.name in TABLE}


def _check_columns(path: Path, columns: list[str]) -> None:
    known = {"name", "image", "scenario", *_options()}
    strange = [column for column in columns if column not in known]
    if len(columns) == 1 and re.search(r"[,;\t]", columns[0]):
        raise _unusable(path, "is one column: a .tsv has tabs between its cells, any other name commas")
    if strange:
        raise _unusable(path, f"has the column '{strange[0]}', which is no setting of xfemnav run, nor 'image', "
                              "'scenario' or 'name'")
    if not {"image", "scenario"} & set(columns):
        raise _unusable(path, "has no column 'image' or 'scenario'")


def _unusable(path: Path, why: str) -> click.UsageError:
    return click.UsageError(printable(f"the manifest {path} {why}."))
