"""The help of the command: every option under one heading, and examples that run."""

import re
import shlex

import click
import pytest
from click.testing import CliRunner
from small import xfemnav

from xfemnav.pipeline.asking.settings import GROUPS, TABLE
from xfemnav_cli.options import stage_of
from xfemnav_cli.run import EXAMPLES, run, stage_commands

COARSE = ("--element-size-mm", "8", "--corridor-element-mm", "4")


def shown(command, width) -> dict[str, list[str]]:
    """The options (their last name) that the help of a command lists under each heading."""
    text = CliRunner().invoke(command, ["--help"], terminal_width=width, max_content_width=width).output
    assert max(map(len, text.partition("Examples:")[0].splitlines())) <= width
    found, heading = {}, ""
    for line in text.splitlines():
        if match := re.fullmatch(r"(\w[\w ]*):", line):
            heading = match[1]
        elif match := re.match(r"  (?:-\w, )?--([\w-]+)", line):
            found.setdefault(heading, []).append(match[1])
    return found


@pytest.mark.parametrize("width", [80, 100, 140])
@pytest.mark.parametrize("command", [run, *stage_commands], ids=lambda command: command.name)
def test_every_option_stands_under_one_heading(command, width):
    found = shown(command, width)
    assert list(found) == [group for group in GROUPS if group in found]
    listed = [name for names in found.values() for name in names]
    options = [param.opts[-1].strip("-") for param in command.params if isinstance(param, click.Option)]
    assert sorted(listed) == sorted([*options, "help"])
    for group, names in found.items():
        for name in names:
            setting = TABLE.get(name.replace("-", "_"))
            assert setting is None or setting.group == group


def test_run_has_every_setting_and_each_stage_what_it_needs():
    assert set(TABLE) <= {param.name for param in run.params}
    for command in stage_commands:
        own = {param.name for param in command.params} & set(TABLE)
        assert own == {name for name in TABLE if stage_of(name) in ("", *own_stages(command.name))}


def own_stages(stage) -> list[str]:
    """A stage and those before it."""
    names = [command.name for command in stage_commands]
    return names[: names.index(stage) + 1]


def test_the_examples_run(tmp_path, monkeypatch, capfd):
    """On a mesh that is coarse enough for a test, and each of them moves something."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XFEMNAV_CACHE", str(tmp_path / "cache"))
    for line in EXAMPLES:
        coarse = (*COARSE, "--no-report") if " run " in line else ()
        code, _, err = xfemnav(capfd, *shlex.split(line)[1:], *coarse)
        assert code == 0 and "W409" not in err, (line, err)
