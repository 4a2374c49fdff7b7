"""Faults of commands one after the other: the command, what it leaves, and the same command again."""

import os
import shutil
import signal
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from faults.claims import REFUSED, check_cache, check_left, check_said, differ, entries, files_in, public, state
from faults.commands import Command, write_inputs

HALF, KILL = -1, -2  # other ways to fail are an errno
WRITES = ("write", "pwrite", "pwrite64", "sendfile", "sendfile64", "copy_file_range")


@dataclass(frozen=True)
class Fault:
    """The call number `at` fails: with an errno, after half of what is to be written, or with the death of the
    process; `lasting`: all later calls too."""

    at: int
    how: int
    lasting: int = 0


@dataclass(frozen=True)
class Ended:
    """How a child ended: its exit status, or minus its signal, and what it said."""

    code: int
    stdout: str
    stderr: str


class Bench:
    """A folder in which commands run; how, and how calls are made to fail, the kinds of benches know."""

    def __init__(self, root: Path):
        self.root = root.absolute()
        self.case = self.root / "case"
        self.kept: dict[str, Path] = {}
        inputs = self.root / "inputs"
        (inputs / "tmp").mkdir(parents=True)
        write_inputs(inputs)
        self.kept[""] = inputs

    @property
    def environment(self) -> dict[str, str]:
        """Where commands write beside their output."""
        return {"XFEMNAV_CACHE": "cache", "TMPDIR": str(self.case / "tmp")}

    def run(self, arguments, fault: Fault | None = None, log: list[str] | None = None) -> Ended:
        """Run a command; `log` is given its calls, as "name path"."""
        raise NotImplementedError

    def place(self, name: str) -> None:
        """Put a state that was kept into the place where commands run."""
        os.chdir(self.root)
        shutil.rmtree(self.case, ignore_errors=True)
        shutil.copytree(self.kept[name], self.case)
        os.chdir(self.case)

    def keep(self, name: str) -> None:
        """Keep the state of now under a name."""
        self.kept[name] = self.root / f"kept-{len(self.kept)}"
        shutil.copytree(self.case, self.kept[name])


@dataclass(frozen=True)
class Undisturbed:
    """A command without a fault: where it begins, its exit, its calls ("name path"), and the files and
    entries of the cache before and after."""

    command: Command
    code: int
    calls: tuple[str, ...]
    old: dict[str, bytes]
    new: dict[str, bytes]
    entries: tuple[dict[str, bytes], dict[str, bytes]]


class Battery:
    """Faults of commands, and what became of them: `found` counts exits and reruns, `failed` tells what was wrong."""

    def __init__(self, bench: Bench):
        self.bench, self.found, self.failed = bench, Counter(), []
        self.fine: set[str] = set()  # states from which the same command was seen to succeed

    def undisturbed(self, command: Command) -> Undisturbed:
        """Run a command without a fault, from the state in which it begins, which is kept under its name."""
        bench, start = self.bench, " ".join(f"after {each.name}" for each in command.after)
        if start not in bench.kept:
            bench.place("")
            for each in command.after:
                before = bench.run(each.arguments)
                assert before.code == each.code, before
            bench.keep(start)
        bench.place(start)
        command.spoil(bench.case)
        bench.keep(command.name)
        old, before, calls = self._public(command), entries(bench.case / "cache"), []
        ended = bench.run(command.arguments, log=calls)
        assert ended.code == command.code, ended
        made = before, entries(bench.case / "cache")
        return Undisturbed(command, ended.code, tuple(calls), old, self._public(command), made)

    def fault(self, true: Undisturbed, fault: Fault) -> None:
        """One fault, and the same command again; what is wrong is noted."""
        try:
            self._fault(true, fault)
        except AssertionError as error:
            self.failed.append(f"{true.command.name}: {fault}, {true.calls[fault.at - 1]}: {error}")

    def _fault(self, true: Undisturbed, fault: Fault) -> None:
        bench, command = self.bench, true.command
        bench.place(command.name)
        ended = bench.run(command.arguments, fault)
        code = None if fault.how == KILL and ended.code == -signal.SIGKILL else ended.code
        self.found["killed" if code is None else f"exit {code}"] += 1
        if code is not None:
            check_said(code, ended.stdout, ended.stderr, {true.code, 0, *REFUSED, *command.also})
        check_left(bench.case / command.out, true.old, true.new, code, recorded=command.recorded)
        check_cache(bench.case / "cache", *true.entries)
        left = state(files_in(bench.case))
        if left not in self.fine:
            self._again(true)
            self.fine.add(left)

    def _again(self, true: Undisturbed) -> None:
        """The command without the fault: its exit, and the same bytes; nothing half is left."""
        bench, command = self.bench, true.command
        again = bench.run(command.arguments)
        assert again.code in (true.code, 0), again
        wrong = differ(self._public(command), true.new)
        assert not wrong, f"the same command leaves other bytes: {wrong}"
        assert not list((bench.case / command.out).glob(".*")), "files half written are left"
        self.found["reruns"] += 1

    def _public(self, command: Command) -> dict[str, bytes]:
        return public(files_in(self.bench.case / command.out))
