"""What the command says: one line a stage, one line an error, nothing that a terminal would obey."""

import json
import sys
import threading

PATIENCE_S = 0.5  # stages that take longer show on a terminal that they work


def printable(text: str) -> str:
    """`text` on one line, with control characters and broken encodings as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


def complain(text: str) -> None:
    """Print one line on stderr."""
    print(printable(text), file=sys.stderr, flush=True)


class Teller:
    """Tells how a run gets on: stage lines on stdout, or on stderr when stdout is for one JSON object."""

    def __init__(self, *, as_json: bool, quiet: bool, verbose: int):
        self.as_json, self.quiet, self.verbose = as_json, quiet, verbose
        self.timer = self.spinner = None
        self.compiles = False

    def say(self, text: str) -> None:
        """One line of human text."""
        if not self.quiet:
            print(printable(text), file=sys.stderr if self.as_json else sys.stdout, flush=True)

    def started(self, stage: str) -> None:
        """A stage has begun: on a terminal, show after a moment that it works."""
        if sys.stderr.isatty() and not self.quiet:
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

    def json(self, value: dict) -> None:
        """The one object on stdout."""
        print(json.dumps(value, indent=2, sort_keys=True, allow_nan=False), flush=True)
