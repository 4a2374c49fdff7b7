"""What is said of a command line that cannot be read: the mistake, and the line that was meant.

The parser knows which word it did not expect; why it is there (a text of two words without quotes, an option in the
place of a value, a unit behind a number) is read from the words before it.
"""

import difflib
import re
from pathlib import Path

import click

NUMERIC = re.compile(r"[-+]?[\d.][\d.,;eE+-]*")
PAIRED = ("--cut", "--resect")  # points; other options of several numbers take one vector
UNITS = ("mm", "cm", "m", "kpa", "pa")


class Number(click.ParamType):
    """A number, without a unit."""

    name = "float"

    def convert(self, value, param, ctx):
        """The number; else a mistake that says how it is written."""
        try:
            return float(value)
        except (TypeError, ValueError):
            found = re.fullmatch(r"\s*([-+]?\d*)([.,]?)(\d*)\s*[A-Za-z²]*\s*", str(value))
            whole, point, part = found.groups() if found else ("", "", "")
            mend = f", as {whole}{point and '.'}{part}" if whole or part else ""
            self.fail(f"{str(value)!r} is no number. Give one without a unit, with a decimal point{mend}.", param, ctx)


REAL = Number()


class Place(click.Path):
    """A path; no text is no path, though to pathlib it is the current folder."""

    def __init__(self):
        super().__init__(path_type=Path, readable=False)

    def convert(self, value, param, ctx):
        """The path; else a mistake."""
        if value == "":
            self.fail("an empty text is no path; the current folder is '.'.", param, ctx)
        return super().convert(value, param, ctx)


FILE = Place()


class Command(click.Command):
    """A command that explains the words which it cannot read."""

    def parse_args(self, ctx, args):
        """Read the words as click does; a UsageError of it that has a likely cause is told with that."""
        given = list(args)
        if told := _option_for_value(self, given):
            raise click.UsageError(told, ctx)
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if told := _unquoted(self, given):
                raise click.UsageError(told, ctx) from None
            near = _nearest(self, error.option_name)
            raise click.NoSuchOption(error.option_name, possibilities=near, ctx=ctx) from None
        except click.BadParameter:
            raise
        except click.UsageError:
            if told := _unquoted(self, given):
                raise click.UsageError(told, ctx) from None
            raise


def _with_value(command: click.Command) -> dict[str, click.Option]:
    """Options that take a value, by each of their names."""
    return {name: option for option in command.params if isinstance(option, click.Option)
            and not (option.is_flag or option.count) for name in option.opts}


def _nearest(command: click.Command, word: str) -> list[str]:
    """The options that a wrong one may stand for: those that begin with it, or else the one that is most like it."""
    names = [name for option in command.params for name in option.opts if name.startswith("--")]
    begin = [name for name in names if name.startswith(word)]
    return begin or difflib.get_close_matches(word, names, 1, 0.5)


def _option_for_value(command: click.Command, words: list[str]) -> str | None:
    """Told of an option whose value was left out, so that the next option stands in its place."""
    options = _with_value(command)
    known = {name for option in command.params for name in option.opts if name.startswith("--")}
    for word, following in zip(words, [*words[1:], ""]):
        if word in options and following in known:
            wanted = options[word].metavar or "a value"
            more = (" It is for 4-D images; xfemnav works on one slice of a 3-D one: leave it out, and give --slice K "
                    "or --slice-mm S." if word == "--volume" else "")
            return f"{word} wants {wanted}, and the next word is the option {following}.{more}"
    return None


def _unquoted(command: click.Command, words: list[str]) -> str | None:
    """Told of a value that is several words, because it was not quoted."""
    options = _with_value(command)
    for k, word in enumerate(words[:-1]):
        if word not in options:
            continue
        rest = []
        for following in words[k + 2:]:
            if not (NUMERIC.fullmatch(following) or following.lower() in UNITS):
                break
            rest.append(following)
        if not rest or not NUMERIC.fullmatch(words[k + 1]):
            continue
        if rest[0].lower() in UNITS:
            return f"{word} takes a number without a unit: {word} {words[k + 1]}"
        value = [words[k + 1], *rest]
        return f"{word} takes one word, and '{' '.join(value)}' is {len(value)}: quote it, {_quoted(word, value)}"
    return None


def _quoted(option: str, words: list[str]) -> str:
    """The option with its words as one value."""
    if option not in PAIRED:
        return f'{option} "{",".join(word.strip(",;") for word in words)}"'
    if all("," in word.strip(",;") for word in words):
        return f'{option} "{" ".join(word.strip(",;") for word in words)}"'
    numbers = ",".join(words).replace(";", ",").replace(",,", ",").strip(",").split(",")
    return f'{option} "{" ".join(map(",".join, zip(numbers[::2], numbers[1::2])))}"'
