"""docs/measured/damage.md from the kept counts: python -m tests.fuzz.page"""

import json
from pathlib import Path

from tests.fuzz.flips import BAD, COUNT, FRESH, HEADER, RESULTS, SECONDS, SLACK_KB, TIMES
from tests.fuzz.intact import FORMATS, none, whole

ROOT = Path(__file__).parents[2]
PAGE, FUZZED = ROOT / "docs/measured/damage.md", ROOT / "benchmarks" / "results" / "fuzz.json"
TEXT = """# Damaged files

Written by `python -m tests.fuzz.page` from what the commands below have counted.

## A bit or a byte changed

    make flips                            # every format, {count:,} times each: an hour or two
    make flips FORMAT="nii.gz" FLIPS=500  # one of them

One bit or one byte of a sound file is changed at a random place (every other time in the first {header} bytes, where
headers are), and the file is read as a run reads it. *Refused*: an error with a code. *As before*: the same voxels and
affine, points, faces, settings, or motion of landmarks. *Made anew*: noticed, and computed again as it was. *Something
else*: read as another file, which it is. Where a checksum covers the byte (`*`: the whole file; `+`: its packed part)
nothing else may come; none did. No reader crashed, took over {seconds} s, raised anything without a code, let a
library warn, or took more than {times} times the memory of the sound file (and {slack:.0f} MB, the allocator's steps).

{table}

*kernels* are compiled code, held against digests before it is loaded; *kernels, fresh*: a kernel is changed, and then a
process runs them. *transform h5* is written for other programs: xfemnav reads none.

What no reader can see is in [formats.md](../reference/formats.md#what-no-reader-can-see).

## Fuzzing

    make fuzz FUZZ=record SECONDS=600     # nifti, dicom, markups, scenario, surface, tracts, table, vtu, record

Coverage-guided (atheris): inputs grow towards what has not been run yet, from sound seeds. A run ends at the first
uncaught exception or warning of a library, an input that takes over 10 s, or a memory of 1 GB. *record* is a
`run.json` that landmarks, a surface and an image are carried by; *table* are .csv, .tsv, .fcsv, .tag, BIDS's coordinate
systems and measured displacements; *vtu* are meshes and solutions.

{fuzzed}

What was found on the way is mended, and stands in the tests: of surfaces in `tests/test_surface_files.py`, of the
others in `tests/test_fuzz.py`.
"""


def table(rows: list[list[str]]) -> str:
    """A table in Markdown; its first row is the head."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (rows[0], ["--"] * len(rows[0]), *rows[1:]))


def page() -> str:
    """The page's text."""
    kept, fuzzed = json.loads(RESULTS.read_text()), json.loads(FUZZED.read_text())
    head = ["format", "changes", "refused", "as before", "made anew", "something else", "slowest, s", "codes"]
    rows = [head, *(_row(name, kept[name]) for name in (*FORMATS, FRESH) if name in kept)]
    runs_of = "seconds", "inputs", "memory_MB"
    runs = [["target", "seconds", "inputs", "memory, MB"],
            *([name, *(f"{found[key]:,}" for key in runs_of)] for name, found in fuzzed.items())]
    return TEXT.format(count=COUNT, header=HEADER, seconds=SECONDS, times=TIMES, slack=SLACK_KB / 1024,
                       table=table(rows), fuzzed=table(runs))


def _row(name: str, found: dict) -> list[str]:
    came = found["came"]
    if wrong := [what for what in BAD if what in came]:
        raise SystemExit(f"{name}: {', '.join(wrong)}: {found['examples']}; nothing of that may be")
    codes = sorted(found["codes"], key=found["codes"].get, reverse=True)[:4]
    counts = sum(came.values()), *(came.get(what, 0) for what in ("code", "same", "anew", "other"))
    return [name + _mark(name), *(f"{n:,}" for n in counts), f"{found['slowest_s']:.2f}", " ".join(codes)]


def _mark(name: str) -> str:
    return {whole: " *", none: ""}.get(FORMATS[name].covered, " +") if name in FORMATS else ""


if __name__ == "__main__":
    PAGE.write_text(page())
