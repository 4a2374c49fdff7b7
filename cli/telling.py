"""What the command says: one line a stage, one line an error, nothing that a terminal would obey."""

import json
import os
import sys
import threading

from xfemnav.naming import Names, flag

PATIENCE_S = 0.5  # stages that take longer show on a terminal that they work


#: How the command line calls settings.
FLAGS = Names(flag, flag, "See `xfemnav run --help`.", "See `xfemnav run --help`.")


def printable(text: str) -> str:
    """`text` on one line, with control characters and broken encodings as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


refused: list[str] = []  # why stdout could not be written


def put(text: str, *, on_stderr: bool = False) -> None:
    """Print text as it is, and a line's end, on stdout or stderr; where nothing can be written, go on without."""
    stream = sys.stderr if on_stderr else sys.stdout
    if stream is None:  # closed by whoever started us
        return
    try:
        print(text, file=stream, flush=True)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and not on_stderr:  # nobody wants what we make any more
            raise
        give_up(stream)
        if not on_stderr:
            refused.append(error.strerror)


def give_up(stream) -> None:
    """Let a stream that cannot be written lead nowhere, or the interpreter tries again when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def say(text: str) -> None:
    """Print one line on stdout."""
    put(printable(text))


def complain(text: str) -> None:
    """Print one line on stderr."""
    put(printable(text), on_stderr=True)


class Teller:
    """Tells how a run gets on: stage lines on stdout, or on stderr when stdout is for one JSON object."""

    def __init__(self, *, as_json: bool, quiet: bool, verbose: int):
        self.as_json, self.quiet, self.verbose = as_json, quiet, verbose
        self.timer = self.spinner = None
        self.compiles = False

    def say(self, text: str) -> None:
        """One line of human text."""
        if not self.quiet:
            put(printable(text), on_stderr=self.as_json)

    def started(self, stage: str) -> None:
        """A stage has begun: on a terminal, show after a moment that it works."""
        if sys.stderr is not None and sys.stderr.isatty() and not self.quiet:
            self.timer = threading.Timer(PATIENCE_S, self._spin, (stage,))
            self.timer.daemon = True
            self.timer.start()

    def _spin(self, stage: str) -> None:
        from rich.console import Console

        self.spinner = Console(stderr=True).status(f"{stage} ...")
        self.spinner.start()

    def stop(self) -> None:
        """Take the sign of work away."""
        if self.timer is not None:
            self.timer.cancel()
            self.timer.join()
            self.timer = None
        if self.spinner is not None:
            self.spinner.stop()
            self.spinner = None

    def finished(self, done) -> None:
        """A stage has ended: its name, how it came, seconds, key and key figure, then its warnings."""
        self.stop()
        key = done.entry.key if self.verbose else done.entry.key[:12]
        step = f"{done.step}: " if done.step else ""
        self.say(f"{done.name:<10} {done.status:<7} {done.seconds:7.2f} s  {key}  {step}{done.line}")

    def waiting(self) -> None:
        """Another run holds the output folder."""
        complain("waiting for another run to leave the output folder ...")

    def compiling(self) -> None:
        """A stage is computed for the first time by this code."""
        if not self.compiles and not self.quiet:
            complain("compiling the numerical kernels: half a minute or so in all ...")
        self.compiles = True

    def warnings(self, record: dict) -> None:
        """Every warning of a run, on stderr."""
        if not self.quiet:
            for item in record.get("warnings", ()):
                complain(f"{item['code']} {item['text']}")

    def failed(self, record: dict) -> None:
        """A run has failed: its warnings, which may say why."""
        self.stop()
        self.warnings(record)

    def json(self, value: dict) -> None:
        """The one object on stdout."""
        put(json.dumps(value, indent=2, sort_keys=True, allow_nan=False))
