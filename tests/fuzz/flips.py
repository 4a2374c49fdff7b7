"""Random bits and bytes of sound files, changed: python -m tests.fuzz.flips [FORMAT [COUNT]] [--write]

Each changed file is read as a run reads it, in a process of its own that may die. Counted are: codes; files that mean
the same as before; what was noticed and made anew; what means something else (which only bytes may that no checksum
covers); and what must not be: crashes, readers that take over 10 s, uncaught exceptions, warnings of libraries, more
than twice the memory, and other meanings in spite of a checksum. Exit status 1 where there is any of the latter.

Without a FORMAT all are tried, 10,000 times, and kernels also in 100 fresh processes, which run them ("fresh"). --write
keeps the counts in benchmarks/results/flips.json, from which `python -m tests.fuzz.page` writes
docs/measured/damage.md.
"""

import json
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from contextlib import suppress
from pathlib import Path

from tests.fuzz.intact import FORMATS, Anew, Format
from tests.fuzz.seeds import finished
from xfemnav.errors import XfemnavError, XfemnavWarning

COUNT, SECONDS = 10_000, 10
SPARE = 2 << 30  # bytes of addresses beyond those of the intact file: what takes them is counted, and not the end
HEADER = 500  # bytes in which every other change of a longer file falls
TIMES, SLACK_KB = 2, 8192  # of the memory of the intact file; the allocator's own steps are no finding
FRESH = "kernels, fresh"
BAD = ("crash", "hang", "uncaught", "memory", "covered")
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results" / "flips.json"


def tried(form: Format, count: int, seed: int = 0) -> dict:
    """`count` changes of the files of a format: how many came to what, the codes, examples of what must not be."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as place:
        (folder := Path(place) / "files").mkdir()
        path = form.make(folder)
        total, done = Tally(), 0
        while done < count:
            done += _in_a_process(form, path, folder, range(done, count), seed, total)
    return total.found()


class Tally:
    """What has come of changes so far."""

    def __init__(self):
        self.came, self.codes, self.examples = Counter(), Counter(), []
        self.seconds, self.memory, self.intact_memory = 0.0, 0, 0

    def add(self, number: int, what: str, detail: str, seconds: float, memory_kb: int) -> None:
        """Count one change; `detail` is its code, or what must not be."""
        self.came[what] += 1
        self.seconds, self.memory = max(self.seconds, seconds), max(self.memory, memory_kb)
        if what == "code":
            self.codes[detail] += 1
        if what in BAD:
            self.examples.append(f"{number}: {what}: {detail}")

    def found(self) -> dict:
        """All of it, for JSON."""
        return {"came": dict(sorted(self.came.items())), "codes": dict(sorted(self.codes.items())),
                "slowest_s": round(self.seconds, 3), "memory_MB": round(self.memory / 1e3, 1),
                "intact_MB": round(self.intact_memory / 1e3, 1), "examples": self.examples[:5]}


def _in_a_process(form: Format, path: Path, folder: Path, numbers: range, seed: int, total: Tally) -> int:
    """Try changes in a process until it ends or dies; how many have been tried, that of which it died too."""
    contents = {file: file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}
    here, there = multiprocessing.Pipe(duplex=False)
    arguments = form, path, contents, numbers, seed, there
    process = multiprocessing.get_context("fork").Process(target=_work, args=arguments)
    process.start()
    there.close()
    n, ended = 0, False
    try:
        total.intact_memory = max(total.intact_memory, here.recv())
        while True:
            total.add(*here.recv())
            n += 1
    except EOFError:
        process.join()
        ended = n == len(numbers)
    if not ended:
        what = "hang" if process.exitcode == -signal.SIGALRM else "crash"
        total.add(numbers[n], what, f"exit code {process.exitcode}", 0.0, 0)
        for file, content in contents.items():
            file.write_bytes(content)
    return n if ended else n + 1


def _work(form: Format, path: Path, contents: dict[Path, bytes], numbers: range, seed: int, there) -> None:
    """Read the intact file and then each changed one, and send what came of it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    for _ in range(2):  # all that is imported, is
        sound, memory, _ = _read(form, path)
    allowed = 1024 * _status("VmSize") + SPARE
    resource.setrlimit(resource.RLIMIT_AS, (allowed, allowed))
    there.send(memory)
    for number in numbers:
        rng = random.Random(f"{seed} {number}")
        file = rng.choice([file for file, content in contents.items() if content])
        place, changed = change(contents[file], rng)
        file.write_bytes(changed)
        signal.alarm(SECONDS)
        (what, detail), kb, seconds = _read(form, path)
        signal.alarm(0)
        file.write_bytes(contents[file])
        if what == "value":
            what = "same" if (what, detail) == sound else "other"
        if what == "other" and any(place in covered for covered in form.covered(contents[file])):
            what, detail = "covered", f"byte {place} of {file.name}"
        if kb > TIMES * memory + SLACK_KB:
            what, detail = "memory", f"{kb / 1e3:.1f} MB, {memory / 1e3:.1f} MB for the intact file"
        there.send((number, what, detail if what != "other" else "", seconds, kb))


def fresh(count: int, seed: int = 0) -> dict:
    """`count` changes of compiled kernels, each before a process that runs them: it must find what it found before."""
    command = ("from xfemnav.pipeline.running.result import Result\n"
               f"found = Result.load({str(Path(finished().name) / 'out')!r})\n"
               "print(found.to_current([[-30.0, 8], [10, 20]], 'left').tobytes().hex(), found.update.cavity.sum())")
    total = Tally()
    with tempfile.TemporaryDirectory() as place:
        def run():
            return subprocess.run([sys.executable, "-c", command], env=os.environ | {"NUMBA_CACHE_DIR": place},
                                  capture_output=True, text=True)

        sound = [run().stdout for _ in range(2)][1]
        for number in range(count):
            rng, start = random.Random(f"{seed} {number}"), time.perf_counter()
            found = [path for path in sorted(Path(place).rglob("*")) if path.is_file() and path.stat().st_size]
            file = rng.choice(found)
            file.write_bytes(change(file.read_bytes(), rng)[1])
            done = run()
            what = "same" if (done.returncode, done.stdout, done.stderr) == (0, sound, "") else "crash"
            told = f"{file.name}: {done.returncode} {done.stderr[-200:]}"
            total.add(number, what, told, time.perf_counter() - start, 0)
    return total.found()


def change(content: bytes, rng: random.Random) -> tuple[int, bytes]:
    """A bit or a byte of `content` changed: where, and what comes of it."""
    place = rng.randrange(min(len(content), HEADER) if rng.random() < 0.5 else len(content))
    other = 1 << rng.randrange(8) if rng.random() < 0.5 else rng.randrange(1, 256)
    return place, content[:place] + bytes([content[place] ^ other]) + content[place + 1:]


def _read(form: Format, path: Path) -> tuple[tuple[str, object], int, float]:
    """What comes of a file: ("value", bytes), ("code", code), ("anew", ""), ("uncaught", which); kB of memory that
    reading took, and seconds."""
    before, start = memory_now(), time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # what a library warns of would reach the user's terminal
            warnings.simplefilter("ignore", XfemnavWarning)
            came = "value", form.read(path)
    except XfemnavError as error:
        came = "code", error.code
    except Anew:
        came = "anew", ""
    except Exception as error:
        came = "uncaught", f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.perf_counter() - start
    return came, max(most_memory() - before, 0), seconds


def memory_now() -> int:
    """The memory of this process, kB; `most_memory` is counted from here on."""
    with suppress(OSError):  # where /proc is read-only, what was taken before hides what is taken now
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def most_memory() -> int:
    """The most memory of this process since `memory_now`, kB."""
    return _status("VmHWM")


def _status(field: str) -> int:
    text = Path("/proc/self/status").read_text()
    return int(text[text.index(field) + len(field) + 1:].split()[0])


def main(arguments: list[str]) -> int:
    """Try formats, print a line of each, and keep the counts."""
    wanted = [word for word in arguments if word != "--write"]
    names, count = wanted[:1] or [*FORMATS, FRESH], int(wanted[1]) if len(wanted) > 1 else COUNT
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    bad = 0
    for name in names:
        found = kept[name] = fresh(count // 100) if name == FRESH else tried(FORMATS[name], count)
        bad += sum(found["came"].get(what, 0) for what in BAD)
        print(f"{name:20} {found['came']} slowest {found['slowest_s']} s, {found['memory_MB']} MB "
              f"({found['intact_MB']})", *found["examples"], sep="\n    ", flush=True)
        if "--write" in arguments:
            RESULTS.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
