"""A fault at every call that changes a file, of commands that write.

    LD_PRELOAD=SHIM python tests/faults/everywhere.py SHIM HOW FOLDER [EVERY]

prints how many calls there are and what became of them; HOW is one of FAULTS, or "all"; with EVERY = 5 only
every fifth call fails.

One process imports everything and computes every stage once. For each fault it forks: the child runs the command from
its first line to its exit, with real files; what stages compute, and the pixels of the figure, are remembered, so that
what takes its time is writing. The state before each command is copied into its place, the same command is run again
without the fault, and what stands then must be, byte for byte, what an undisturbed run leaves.
"""

import atexit
import ctypes
import errno
import gc
import os
import signal
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from faults.battery import HALF, KILL, WRITES, Battery, Bench, Ended, Fault
from faults.commands import COMMANDS, NEW, remember

from xfemnav.interruption import ENDING
from xfemnav_cli.main import main as xfemnav

#: name: (how a call fails, whether all later ones do too)
FAULTS = {"ENOSPC": (errno.ENOSPC, 0), "EIO": (errno.EIO, 0), "EACCES": (errno.EACCES, 0), "half": (HALF, 0),
          "kill": (KILL, 0), "ENOSPC on": (errno.ENOSPC, 1), "EIO on": (errno.EIO, 1)}


class Forks(Bench):
    """Commands run in forks of this process, where the shim makes their calls fail."""

    def __init__(self, shim: str, root: Path):
        super().__init__(root)
        self.shim, self.said = ctypes.CDLL(shim), self.root / "said"
        self.said.mkdir()
        os.environ |= self.environment

    def run(self, arguments, fault=None, log=None):
        """See Bench."""
        calls = self.said / "calls"
        child = os.fork()
        if child == 0:
            self._in_child(arguments, fault or Fault(0, 0), calls if log is not None else None)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if log is not None:
            log += [line.split(" ", 1)[1] for line in calls.read_text().splitlines()]
        return Ended(status, *((self.said / name).read_text() for name in ("stdout", "stderr")))

    def _in_child(self, arguments, fault: Fault, calls: Path | None):
        code = 99
        try:
            for number, name in ((1, "stdout"), (2, "stderr")):
                os.dup2(written(self.said / name), number)
            self.shim.shim_arm(os.fsencode(self.case), ctypes.c_long(fault.at), fault.how, fault.lasting,
                               written(calls) if calls else -1)
            code = exit_of(arguments)
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


def written(path: Path) -> int:
    """A new file, opened."""
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)


def exit_of(arguments) -> int:
    """The exit of a command that is run in this process."""
    try:
        xfemnav(list(arguments))
    except SystemExit as end:
        return end.code or 0


def warm(bench: Bench) -> None:
    """Compute everything that the commands ask for once, in this process."""
    bench.place("")
    for command in (NEW, *COMMANDS):
        assert exit_of(command.arguments) == 0, command
    for signum in ENDING:
        signal.signal(signum, signal.SIG_DFL)  # the commands have left theirs
    gc.freeze()  # or each fork would copy what its collector looks through


def main(shim: str, how: str, folder: str, every: str = "1") -> None:
    """Every call of every command fails once, in a run of its own."""
    remember()
    bench = Forks(shim, Path(folder))
    warm(bench)
    battery, total = Battery(bench), 0
    for command in COMMANDS:
        true = battery.undisturbed(command)
        for name in FAULTS if how == "all" else [how]:
            start = time.perf_counter()
            numbers = [n for n, call in enumerate(true.calls, 1) if name != "half" or call.split()[0] in WRITES]
            numbers = numbers[::int(every)]
            for n in numbers:
                battery.fault(true, Fault(n, *FAULTS[name]))
            total += len(numbers)
            seconds = time.perf_counter() - start
            print(f"{name:<9} {command.name:<31} {len(numbers):4d} calls {seconds:6.1f} s", flush=True)
    print(f"{total} faults: " + ", ".join(f"{name}: {count}" for name, count in battery.found.items()))
    print(*battery.failed, sep="\n", flush=True)
    sys.exit(bool(battery.failed))


if __name__ == "__main__":
    main(*sys.argv[1:])
