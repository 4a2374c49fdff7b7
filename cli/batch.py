"""`xfemnav batch IN OUT -j N`: every slice of a folder that has a scenario beside it, each in a process of its own."""

import json
import subprocess
import sys
import threading
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, CancelledError, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import click

from xfemnav.errors import EXIT_OK, EXIT_SOME_FAILED, EXIT_UNTRUSTED
from xfemnav.interruption import checkpoint, forget
from xfemnav_cli.telling import printable, say

PATIENCE_S = 0.2  # how long a signal may wait
IMAGE_SUFFIXES = (".nii.gz", ".nii", ".mgz", ".mgh", ".nrrd", ".nhdr", ".mha", ".mhd")


@dataclass(frozen=True)
class Item:
    """One slice: its scenario `<stem>.toml`, its image `<stem>.nii.gz` (or another format), and its output folder."""

    image: Path
    scenario: Path
    folder: Path


@dataclass(frozen=True)
class Outcome:
    """What became of an item: exit status of its run, its stages {name: ran | cached | healed}, its last words."""

    item: Item
    exit_code: int
    stages: dict[str, str]
    message: str

    @property
    def result(self) -> str:
        return {EXIT_OK: "updated", EXIT_UNTRUSTED: "untrusted"}.get(self.exit_code, "failed")

    def row(self) -> str:
        """One line of the summary: slice, result, how many stages ran and were cached, why it failed."""
        cached = sum(status == "cached" for status in self.stages.values())
        done = f"{len(self.stages) - cached} ran, {cached} cached" if self.stages else ""
        return printable(f"{self.item.scenario.stem:<24} {self.result:<10} {done:<18} {self.message}".rstrip())


def find_items(source: Path, target: Path) -> list[Item]:
    """Every scenario of `source`, in the order of their names; where the image is missing, its run will say so."""
    items = []
    for scenario in sorted(source.glob("*.toml")):
        candidates = [scenario.with_name(scenario.stem + suffix) for suffix in IMAGE_SUFFIXES]
        image = next(filter(Path.is_file, candidates), candidates[0])
        items.append(Item(image, scenario, target / scenario.stem))
    return items


class Running:
    """The processes of the slices under way, which end together."""

    def __init__(self):
        self._lock, self._ended, self._started = threading.Lock(), False, []

    def start(self, program: list) -> subprocess.Popen:
        """Start one. Raises CancelledError when all are to end."""
        with self._lock:
            if self._ended:
                raise CancelledError
            process = subprocess.Popen(program, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                       stderr=subprocess.PIPE)
            self._started.append(process)
            return process

    def end(self) -> None:
        """End all, and start none any more."""
        with self._lock:
            self._ended = True
            for process in self._started:
                process.terminate()


def run_item(item: Item, running: Running) -> Outcome:
    """Run one slice to its end. A crash, a signal or a full memory ends this process and no other."""
    # Absolute paths: a name such as -x.nii must not look like an option. One thread a run: -j shares out the cores.
    paths = [item.image.absolute(), "--scenario", item.scenario.absolute(), "-o", item.folder.absolute()]
    program = [sys.executable, "-c", "from xfemnav_cli.main import main; main()", "run", "-q", "--threads", "1"]
    process = running.start([*program, *paths])
    words = process.communicate()[1].decode(errors="replace").strip().splitlines()
    succeeded = process.returncode in (EXIT_OK, EXIT_UNTRUSTED)
    record = json.loads((item.folder / "run.json").read_text(encoding="utf-8")) if succeeded else {"stages": []}
    stages = {stage["name"]: stage["status"] for stage in record["stages"]}
    message = "" if process.returncode == EXIT_OK else words[-1] if words else f"ended with status {process.returncode}"
    return Outcome(item, process.returncode, stages, message)


def run_items(items: list[Item], jobs: int) -> list[Outcome]:
    """Run all items, `jobs` at a time, with a line for each as it ends; their outcomes in the order of `items`."""
    running = Running()
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(run_item, item, running) for item in items]
        pending = set(waiting)
        try:
            while pending:
                done, pending = wait(pending, PATIENCE_S, FIRST_COMPLETED)
                checkpoint()
                before = len(items) - len(pending) - len(done)
                for number, ended in enumerate(done, before + 1):
                    say(f"[{number}/{len(items)}] {ended.result().row()}")
        except BaseException:
            # Ctrl-C and kill end the running slices too; their finished stages are in the cache.
            forget()
            pool.shutdown(wait=False, cancel_futures=True)
            running.end()
            raise
    return [done.result() for done in waiting]


@click.command()
@click.argument("source", metavar="IN", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("target", metavar="OUT", type=click.Path(file_okay=False, path_type=Path))
@click.option("-j", "--jobs", type=click.IntRange(1), default=1, help="Slices at a time.")
def batch(source: Path, target: Path, jobs: int):
    """Run every slice of IN that has a <stem>.toml beside it into OUT/<stem>.

    A <stem>.toml without its <stem>.nii.gz or .nii has failed.

    One failing slice never stops the others. Run again, finished work comes from the cache. Exit status 1 if any slice
    failed or is not trustworthy.
    """
    items = find_items(source, target)
    if not items:
        raise click.UsageError(f"{printable(str(source))} holds no <stem>.toml of a <stem>.nii.gz or .nii.")
    outcomes = run_items(items, jobs)
    say("")
    say("slice                    result     stages             message")
    for outcome in outcomes:
        say(outcome.row())
    counts = Counter(outcome.result for outcome in outcomes)
    say(", ".join(f"{counts[result]} {result}" for result in ("updated", "untrusted", "failed")))
    return EXIT_OK if counts["updated"] == len(items) else EXIT_SOME_FAILED
