"""How messages call settings: by marks, which the edge that tells a message turns into words of its own.

Below the command line a message names a setting as ⟦interp=cubic⟧: its name, and a value where there is one to
give. The command line prints `--interp cubic`, Python `interp="cubic"`, and a run of a scenario the
key `warp.interp = "cubic"`. A setting that was given as an option itself is ⟦!left⟧, also beside a scenario,
and ⟦?⟧, ⟦!?⟧ say where all of them are listed. Marks are kept in the cache, so that a warning that one edge met is told
rightly by another.
"""

import re
from collections.abc import Callable
from typing import NamedTuple

MARK = re.compile(r"⟦(!?)(\w+|\?)(?:=([^⟦⟧]*))?⟧")
NUMBER_OR_PLACE = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[A-Z]+", re.ASCII)  # 3.5, or FROM
SHORT = {"output": "-o", "cache": "-w", "image": "IMAGE"}


class Names(NamedTuple):
    """How an edge calls a setting, by its name and value ("" for none), and one that was `given` as an option there;
    and where it lists them."""

    setting: Callable[[str, str], str]
    given: Callable[[str, str], str]
    listed: str
    given_listed: str


def said(text: str, names: "Names | None" = None) -> str:
    """A text, its settings called as `names` has them; as arguments of Python unless told otherwise."""
    names = names or ARGUMENTS

    def word(mark: re.Match) -> str:
        given, name, value = mark.groups()
        if name == "?":
            return names.given_listed if given else names.listed
        return (names.given if given else names.setting)(name, value or "")

    return MARK.sub(word, text)


def told(item: dict, names: Names | None = None) -> str:
    """The text of a warning or error of a record, whichever edge made that."""
    return said(item.get("marked", item["text"]), names)


def kept(code: str, text: str, names: Names | None = None) -> dict:
    """A warning or error for a record: code, text, and the marked text where that is another."""
    words = said(text, names)
    return {"code": code, "text": words} | ({"marked": text} if words != text else {})


def flag(name: str, value: str = "") -> str:
    """--interp cubic."""
    text = SHORT.get(name) or "--" + name.replace("_", "-")
    if value in ("", "True"):
        return text
    quoted = f'"{value}"' if " " in value else value
    return f"{text}={quoted}" if value.startswith("-") else f"{text} {quoted}"


def argument(name: str, value: str = "") -> str:
    """interp="cubic"."""
    return f"{name}={literal(value, '()')}" if value else name


def literal(value: str, brackets: str) -> str:
    """A value as Python or TOML has it: numbers and placeholders bare, several in brackets, words in quotes."""
    parts = value.split(",")
    if value == "True" or NUMBER_OR_PLACE.fullmatch(value):
        return value
    if all(map(NUMBER_OR_PLACE.fullmatch, parts)):
        return brackets[0] + ", ".join(parts) + brackets[1]
    return "|".join(f'"{word}"' for word in value.split("|"))


ARGUMENTS = Names(argument, argument, "See help(xfemnav.run).", "See help(xfemnav.run).")
