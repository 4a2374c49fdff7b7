"""Rows of damage and attacks: folders that are pruned, kernels, bombs, records and scenarios changed by hand."""

import gzip
import json
import os
import subprocess
import sys
from pathlib import Path

import test_prune
from rows import Row

from tests.fuzz import flips
from tests.fuzz.intact import FORMATS
from tests.fuzz.targets import fed, finished, seeds
from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.gate import read_image
from xfemnav.pipeline.asking.config import scenario_problems
from xfemnav.pipeline.keeping.cache import Cache
from xfemnav.pipeline.running.result import Result


def refused(read, *arguments) -> str:
    """The code with which something is refused."""
    try:
        read(*arguments)
    except XfemnavError as error:
        return error.code
    raise AssertionError(f"{arguments} passed")


def pruned_study(folder: Path):
    for number, (kind, make) in enumerate(test_prune.OWN.items()):
        root = folder / str(number) / "own"
        root.mkdir(parents=True)
        make(root)
        before = test_prune.held(root)
        assert refused(lambda root: Cache(root).prune(0), root) == "E504", kind
        assert test_prune.held(root) == before, kind
    return f"{len(test_prune.OWN)} folders of users refused, nothing in them touched", "E504"


def pruned_links(folder: Path):
    for number, (kind, (attack, stays)) in enumerate(test_prune.INSIDE.items()):
        cache, (entry,) = test_prune.made(folder / str(number) / "cache", "one")
        precious = test_prune.precious_in(folder / str(number))
        attack(cache.root, precious)
        before = test_prune.held(precious)
        cache.prune(0)
        assert test_prune.held(precious) == before and entry.exists() == stays, kind
    return f"{len(test_prune.INSIDE)} things put into a cache, links of every kind: none led anywhere", ""


def kernels(folder: Path):
    found = flips.tried(FORMATS["kernels"], 30, 2)["came"]
    assert found.keys() <= {"anew", "same"}
    return f"30 flips: {found['anew']} noticed and compiled anew, {found.get('same', 0)} meant nothing", ""


def doubly_packed(folder: Path):
    """200 MB of zeros, packed twice, under a header that claims a thousand voxels."""
    head = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 10 10 10\nspace: LPS\nencoding: gzip\n\n"
    packed = gzip.compress(head + gzip.compress(bytes(200_000_000), 9), 9)
    (folder / "bomb.nrrd").write_bytes(packed)
    before = flips.memory_now()
    code = refused(read_image, folder / "bomb.nrrd")
    took = flips.most_memory() - before
    assert took < 60_000 and code == "E102"
    return f"{len(packed) / 1e3:.1f} kB that unpack to 200 MB: refused with {max(took, 0) / 1e3:.0f} MB", code


SHORT = 'xfemnav = 1\nimage = "head.nii.gz"\n[[cut]]\npoints = [[-60, 10], [-15, 5]]\n'
ODD = None, 5, "x", [], {}, -1e308, [[]]


def changed_records(folder: Path):
    """Every value of what a record says of its motion, replaced by what it cannot be, or left out."""
    whole, tried, taken = seeds("record")[0], 0, 0
    places = [(key,) for key in ("schema", "status", "outputs", "slice", "cuts", "steps", "parameters", "error")]
    places += [("outputs", "solution"), ("outputs", "mask"), ("cuts", 0), ("cuts", 0, "path"), ("steps", 0, "cuts"),
               ("steps", 0, "name"), ("parameters", "space"), ("slice", "plane")]
    for number, place in enumerate(places):
        for odd in (ODD[number % len(ODD)], ODD[(number + 3) % len(ODD)]):
            record = json.loads(whole)
            inner = record
            for key in place[:-1]:
                inner = inner[key]
            inner[place[-1]] = odd
            taken += fed("record", json.dumps(record).encode())
            tried += 1
    return f"{tried} changes by hand: {tried - taken} refused with a code, {taken} taken, no exception", "E701"


def odd_scenarios(folder: Path):
    (folder / "head.nii.gz").write_bytes(Path(finished().name, "head.nii.gz").read_bytes())
    told = []
    for odd in ("[[step]]\nacts = [{}]\n", "[load]\ngravity = [0, 1e308]\n", "[load]\ngravity = [nan, 0]\n"):
        (folder / "case.toml").write_text(SHORT + odd)
        told += scenario_problems(folder / "case.toml")[:1]
    assert len(told) == 3
    return "; ".join(line.split(":")[0] for line in told) + ": each told as a problem", "E780"


def piped_record(folder: Path):
    os.mkfifo(folder / "run.json")
    return f"refused at once: {refused(Result.load, folder)}", refused(Result.load, folder)


def escapes(folder: Path):
    """A key, a file and a folder with an escape sequence in their names, through the command."""
    (folder / "case.toml").write_text('xfemnav = 1\nimage = "a\\u001b[31m.nii"\n"\\u001b[2J" = 1\n')
    code = "from xfemnav_cli.main import main; main()"
    said = ""
    for words in (("check", folder / "case.toml"), ("cache", "ls", "-w", folder / "\x1b[31mcache")):
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
        said += done.stdout + done.stderr
    assert "\x1b" not in said and "cache" in said and "31m" in said
    return "`check` and `cache ls` print them escaped", ""


ROWS = [
    Row("E1", "`cache prune -w STUDY`, and folders that look like a cache", "every file in damaged/, locks/ went",
        pruned_study),
    Row("E1", "links, pipes, sockets and files of users in a cache", "symlinked locks and entries lost their targets",
        pruned_links),
    Row("E7", "a flipped bit in a compiled kernel", "exit 70 or SIGSEGV until deleted", kernels),
    Row("E8", "a doubly gzipped NRRD", "8.7 MB took 4 GB", doubly_packed),
    Row("E9", "run.json damaged by hand, given to apply", "16 of 78 exit 70", changed_records),
    Row("E9", "scenario acts = [{}], gravity = [0, 1e308]", "exit 70", odd_scenarios),
    Row("E9", "a FIFO as run.json", "hangs", piped_record),
    Row("E9", "terminal escapes in a scenario and a folder's name", "raw in check and cache ls", escapes),
]
