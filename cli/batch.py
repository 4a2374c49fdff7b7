"""`xfemnav batch IN OUT -j N`: the slices of a folder or a manifest, each in a process of its own, and their table."""

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, CancelledError, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import click

from xfemnav.errors import EXIT_OK, EXIT_SOME_FAILED, EXIT_UNTRUSTED
from xfemnav.interruption import checkpoint, forget
from xfemnav_cli.mistakes import FILE
from xfemnav_cli.slices import Item, find_items, read_manifest
from xfemnav_cli.telling import printable, say

PATIENCE_S = 0.2  # how long a signal may wait
CODE = re.compile(r"[EW]\d{3}\b")


@dataclass(frozen=True)
class Outcome:
    """What became of an item: exit status of its run, what that has recorded, its last words, how long it took."""

    item: Item
    exit_code: int
    record: dict
    message: str
    seconds: float

    @property
    def result(self) -> str:
        """One word: updated, untrusted or failed."""
        return {EXIT_OK: "updated", EXIT_UNTRUSTED: "untrusted"}.get(self.exit_code, "failed")

    def row(self) -> str:
        """One line of the summary: slice, result, how many stages ran and were cached, why it failed."""
        stages = {stage["name"]: stage["status"] for stage in self.record.get("stages", ())}
        cached = sum(status == "cached" for status in stages.values())
        done = f"{len(stages) - cached} ran, {cached} cached" if stages else ""
        return printable(f"{self.item.name:<24} {self.result:<10} {done:<18} {self.message}".rstrip())

    def table_row(self, target: Path) -> dict:
        """Its row of the table in `target`, paths from there."""
        from xfemnav.pipeline.asking.scenario_file import seen_from
        from xfemnav.pipeline.running.batch_table import row

        item, said = self.item, CODE.match(self.message)
        image = item.image or self._recorded_image()
        return row(item.name, seen_from(target, image) if image else "", seen_from(target, item.folder), self.exit_code,
                   self.seconds, self.record, said[0] if said else "")

    def _recorded_image(self) -> Path | None:
        known = self.record.get("inputs", {}).get("image")
        return Path(known["absolute"]) if known else None


class Running:
    """The processes of the slices under way, which end together."""

    def __init__(self):
        self._lock, self._ended, self._started = threading.Lock(), False, []

    def start(self, program: list, home: Path) -> subprocess.Popen:
        """Start one in the folder `home`. Raises CancelledError when all are to end."""
        with self._lock:
            if self._ended:
                raise CancelledError
            process = subprocess.Popen(program, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                       stderr=subprocess.PIPE, cwd=home)
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
    from xfemnav.pipeline.running.job import default_cache

    # One thread a run: -j shares out the cores.
    program = [sys.executable, "-c", "from xfemnav_cli.main import main; main()", "run", "-q", "--threads", "1"]
    places = ["-o", item.folder.absolute(), "-w", default_cache().absolute()]
    begun = time.monotonic()
    process = running.start([*program, *item.words, *places], item.home)
    words = process.communicate()[1].decode(errors="replace").strip().splitlines()
    seconds, code = time.monotonic() - begun, process.returncode
    message = "" if code == EXIT_OK else words[-1] if words else f"ended with status {code}"
    return Outcome(item, code, _record(item.folder, code), message, seconds)


def _record(folder: Path, exit_code: int) -> dict:
    """What a run of this exit status has recorded; nothing where what is there is of an earlier run."""
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if record.get("exit_code") == exit_code else {}


def run_items(items: list[Item], jobs: int, table) -> list[Outcome]:
    """Run all items, `jobs` at a time, with a line and a row of the `table` for each as it ends; their outcomes in the
    order of `items`."""
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
                    table.put(ended.result().item.name, ended.result().table_row(table.path.parent))
                    say(f"[{number}/{len(items)}] {ended.result().row()}")
        except BaseException:
            # Ctrl-C and kill end the running slices too; their finished stages are in the cache.
            forget()
            pool.shutdown(wait=False, cancel_futures=True)
            running.end()
            raise
    return [done.result() for done in waiting]


@click.command()
@click.argument("source", metavar="IN|MANIFEST", type=FILE)
@click.argument("target", metavar="OUT", type=FILE)
@click.option("-j", "--jobs", type=click.IntRange(1), default=1, help="Slices at a time.")
def batch(source: Path, target: Path, jobs: int):
    """Run every slice of IN that has a <stem>.toml beside it into OUT/<stem>, or the rows of a MANIFEST.

    Several slices of one volume: <stem>.<label>.toml, or scenarios that name the image. A MANIFEST is a .tsv or .csv
    with a row a slice: columns image, scenario, name, and any setting of `xfemnav run` (slice_mm, cut, opening_mm),
    as on a command line in the manifest's folder; n/a is not given.

    OUT/batch.tsv has a row for each: status, code of the error, warnings, checks, forces, seconds. One failing slice
    never stops the others. Run again, finished work comes from the cache. Exit status 1 if any slice failed or is not
    trustworthy.
    """
    from xfemnav.pipeline.running.batch_table import Table

    items = find_items(source, target) if os.path.isdir(source) else read_manifest(source, target)
    if not items:
        raise click.UsageError(f"{printable(str(source))} holds no <stem>.toml of a <stem>.nii.gz or .nii.")
    table = Table(target, [item.name for item in items])
    outcomes = run_items(items, jobs, table)
    say("")
    say("slice                    result     stages             message")
    for outcome in outcomes:
        say(outcome.row())
    counts = Counter(outcome.result for outcome in outcomes)
    say(", ".join(f"{counts[result]} {result}" for result in ("updated", "untrusted", "failed")))
    say(f"table      {table.path}")
    return EXIT_OK if counts["updated"] == len(items) else EXIT_SOME_FAILED
