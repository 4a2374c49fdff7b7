"""Scenario files: TOML that is read within bounds, and the settings of a run as such a file, which is read back as the
same settings wherever it is read.

TOML is written here and not by a library: tables, arrays of tables, numbers, words and lists are all that a scenario
has, and the standard library reads TOML but does not write it.
"""

import copy
import json
import os
import re
import tomllib
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import decoded, file_bytes
from xfemnav.naming import flag
from xfemnav.pipeline.asking.flags import BACKSLASH, MASKS, path_places, printed
from xfemnav.pipeline.keeping.names import PAGES

NAME = "".join(PAGES["scenario"])
AGAIN = f"xfemnav run {flag('scenario', NAME)} {flag('output', 'OTHER')}"
HEAD = f"# The settings of this run, defaults filled in. The same again: {AGAIN}\n"
UNSAYABLE = "# TOML holds UTF-8 alone, and the name of this file is none, so give it again: {place} = {name}\n"
LIMIT_BYTES, LIMIT_DEPTH = 1_000_000, 32
SCENARIO = {"no file": ("E780", "{name} is a folder, pipe or device, no scenario. Correct the path."),
            "empty": ("E780", "{name} is empty (0 bytes); a scenario begins with xfemnav = 1."),
            "large": ("E780", "{name} holds {size}; at most {limit} are read. Is it a scenario?"),
            "unread": ("E780", "{name} cannot be read: {reason}. Copy it again.")}
# Dotted keys deeper than that; the parser's time grows with the square of their length.
LONG_KEY = re.compile(r"""(?<![\w.-])(?:(?:"[^"\n]*"|'[^'\n]*'|[\w-]+)[ \t]*\.[ \t]*){32}""")
ESCAPE = re.compile(r"hex value|[Ee]scape")  # in the parser's words


def read_toml(path: Path) -> dict:
    """The raw scenario in a TOML file. Raises E100 (missing) and E780 (no file, too large, too deep, no TOML)."""
    too_deep = XfemnavError("E780", f"{path.name} is nested deeper than {LIMIT_DEPTH} levels.")
    try:
        text = re.sub(r"\r\n?", "\n", decoded(file_bytes(path, LIMIT_BYTES, SCENARIO)))
    except ValueError as error:
        if path.name.lower().endswith(MASKS):
            raise XfemnavError("E780", f"{path.name} is an image, no scenario (a TOML file); an image is for `xfemnav "
                                       "run`.") from None
        raise XfemnavError("E780", f"{path.name} {error}.") from None
    try:
        if LONG_KEY.search(text):
            raise too_deep
        raw = tomllib.loads(text)
    except ValueError as error:  # of numbers with thousands of digits too
        mend = f" {BACKSLASH}" if ESCAPE.search(str(error)) else _quotes(text, str(error))
        raise XfemnavError("E780", f"{path.name} is no TOML: {error}.{mend}") from None
    except RecursionError:
        raise too_deep from None
    if _depth(raw) > LIMIT_DEPTH:
        raise too_deep
    return raw


def _quotes(text: str, why: str) -> str:
    """What to say of a text without quotes in the line that the parser names."""
    line = re.search(r"at line (\d+)", why)
    row = text.split("\n")[int(line[1]) - 1] if line else ""
    bare = re.fullmatch(r"\s*([\w.-]+)\s*=\s*([^\W\d][^\"'\[{#]*|[./~][^\"'\[{#]*)", row)
    return f' A text, as a path is, stands in quotes: {bare[1]} = "{bare[2].strip()}".' if bare else ""


def _depth(value) -> int:
    """Levels of nesting of tables and arrays, without recursion."""
    depth, level = 0, [value]
    while level:
        depth += 1
        level = [inner for item in level if isinstance(item, dict | list)
                 for inner in (item.values() if isinstance(item, dict) else item)]
    return depth


def whole(path: Path) -> str:
    """The path of a file from the root. Links to folders are followed, since '..' is where a link leads; the file keeps
    its own name, of which outputs are called."""
    return os.path.join(os.path.realpath(path.parent), path.name)


def seen_from(folder: Path, path: Path) -> str:
    """The path of a file from a folder, with /; its whole path where none leads there (another drive)."""
    try:
        found = os.path.relpath(whole(path), os.path.realpath(folder))
    except ValueError:
        found = whole(path)
    return found.replace(os.sep, "/")


def placed(settings: dict, files: dict[str, Path], folder: Path) -> dict:
    """The settings of a scenario that stands in `folder`: its `files` (by place) relative to that, and free to lie
    outside where one does."""
    found = copy.deepcopy(settings)
    for place, path in files.items():
        put(found, place, printed(seen_from(folder, path)))
    outside = any(name.startswith("../") or os.path.isabs(name) for name in path_places(found).values())
    return found | {"allow_outside": found["allow_outside"] or outside}


def put(raw: dict, place: str, value) -> None:
    """Set what stands at a place such as 'cut.0.markups'."""
    *way, last = (int(part) if part.isdecimal() else part for part in place.split("."))
    for part in way:
        raw = raw[part]
    raw[last] = value


def scenario_text(settings: dict, files: dict[str, Path], folder: Path) -> str:
    """The scenario as it stands in `folder`."""
    names = {place: seen_from(folder, path) for place, path in files.items()}
    words = [UNSAYABLE.format(place=place, name=name) for place, name in ((p, printed(n)) for p, n in names.items())
             if name != names[place]]
    return "".join([HEAD, *words, "\n", toml({"xfemnav": 1} | placed(settings, files, folder))])


def toml(table: dict, name: str = "", heading: str = "[{}]") -> str:
    """TOML of a table: its plain keys, then its tables and arrays of tables; keys that are None are left out."""
    given = {key: value for key, value in table.items() if value is not None}
    inner = {key: value for key, value in given.items() if _holds_tables(value)}
    lines = [f"{key} = {_plain(value)}\n" for key, value in given.items() if key not in inner]
    text = "".join(([f"\n{heading.format(name)}\n"] if name and (lines or heading == "[[{}]]") else []) + lines)
    for key, value in inner.items():
        within = f"{name}.{key}" if name else key
        text += "".join([toml(value, within)] if isinstance(value, dict) else
                        [toml(item, within, "[[{}]]") for item in value])
    return text


def _holds_tables(value) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def _plain(value) -> str:
    """A number, word or list of them."""
    if isinstance(value, list):
        return f"[{', '.join(map(_plain, value))}]"
    # JSON's numbers and words are TOML's, but for one character that TOML wants escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
