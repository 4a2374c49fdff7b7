"""Options of the commands, made of the table of settings, and their help in groups."""

import os
from collections.abc import Iterable
from functools import cache

import click

from xfemnav.pipeline.asking.settings import CONTROL, GROUPS, STAGES, TABLE, Setting, kind
from xfemnav_cli.mistakes import FILE, REAL, Command


class Option(click.Option):
    """An option that the help lists under the heading `group`."""

    def __init__(self, *args, group: str = CONTROL, **kwargs):
        super().__init__(*args, **kwargs)
        self.group = group


class Grouped(Command):
    """A command whose help lists its options under their headings, and then `examples`, one command a line."""

    def __init__(self, *args, examples: tuple[str, ...] = (), **kwargs):
        super().__init__(*args, **kwargs)
        self.examples = examples

    def format_options(self, ctx, formatter):
        """Write the options, those without a group (`--help`) among the last."""
        rows = {group: [] for group in GROUPS}
        for option in self.get_params(ctx):
            if isinstance(option, click.Option) and (row := option.get_help_record(ctx)) is not None:
                rows[getattr(option, "group", CONTROL)].append(row)
        for group, listed in rows.items():
            if listed:
                with formatter.section(group):
                    formatter.write_dl(listed)

    def format_epilog(self, ctx, formatter):
        """Write the examples as they stand: a line that is cut up could not be copied."""
        if self.examples:
            with formatter.section("Examples"):
                for line in self.examples:
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")


def choice(words: Iterable[str]) -> click.Choice:
    """One of these words."""
    return click.Choice(tuple(words), case_sensitive=False)


@cache
def option(name: str) -> Option:
    """The option of a setting, the same in all commands that have it."""
    setting, taken = TABLE[name], kind(name)
    types = {int: int, float: REAL, os.PathLike: FILE, str: choice(setting.choices) if setting.choices else str}
    shape = {"is_flag": True} if taken is bool else {"type": types[taken], "multiple": setting.default == ()}
    return Option([f"--{name.replace('_', '-')}"], group=setting.group, metavar=setting.metavar or None, default=None,
                  help=told(setting), **shape)


def told(setting: Setting) -> str:
    """What a setting means, as a sentence, with its default."""
    more = "; repeat for more" if setting.default == () else ""
    sure = setting.default is not None and setting.default is not False and setting.default != ()
    default = f"{setting.default:g}" if isinstance(setting.default, float) else setting.default
    return f"{setting.meaning[0].upper()}{setting.meaning[1:]}{more}.{f'  [{default}]' if sure else ''}"


def stage_of(name: str) -> str:
    """The first stage that needs a setting; "" for every command."""
    return TABLE[name].stage or GROUPS[TABLE[name].group]


def options(stages: Iterable[str]) -> list[Option]:
    """The options of all settings that these stages need, and of those for every command."""
    return [option(name) for name in TABLE if stage_of(name) in ("", *stages)]


def until(stage: str) -> tuple[str, ...]:
    """The stages up to this one."""
    return STAGES[:STAGES.index(stage) + 1]
