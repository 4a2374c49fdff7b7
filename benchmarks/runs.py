"""Whole runs of the command: cold (a new cache, compiled kernels there) and cached, with and without a report; memory.

    python -m benchmarks.runs

A 512 x 512 slice of the MNI152 brain's outline at .36 mm, about 4.5k nodes, a cut of 80 mm opened by 6 mm. Seconds of
the child process on a processor, and on the wall's clock; medians of 5. Python keeps the bytecode of our modules, as
an installation does, also where PYTHONDONTWRITEBYTECODE is set.
"""

from benchmarks.timing import keep, mark, table  # isort: skip (sets the number of threads)

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import process_time

import nibabel
import numpy as np

from benchmarks.mesh import brain_outline
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.imaging.carrying.warp import covered, enclosed, pull_back, update
from xfemnav.imaging.organ.outline import outline_of
from xfemnav.mechanics.conditions.problem import pose
from xfemnav.mechanics.rules import Retraction, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

REPEATS, SIDE, PIXEL_MM = 5, 512, 0.36
INSTALLED = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
COMMAND = str(Path(sys.executable).with_name("xfemnav"))
# A small process starts the command: a child's peak memory counts from its parent's.
START = """
import json, os, subprocess, sys, time
start = time.perf_counter()
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
_, status, used = os.wait4(child.pid, 0)
child.returncode = os.waitstatus_to_exitcode(status)
print(json.dumps([child.returncode, used.ru_utime + used.ru_stime, time.perf_counter() - start, used.ru_maxrss / 1000]))
"""


def write_slice(folder: Path) -> tuple[Path, Path]:
    """A slice and its mask as NIfTI."""
    outline = brain_outline()
    outline = 18 + (outline - outline.min(axis=0)) / np.ptp(outline, axis=0).max() * 0.88 * SIDE * PIXEL_MM
    mask = enclosed(outline, np.zeros(2), np.full(2, PIXEL_MM), (SIDE, SIDE))
    waves = 100 + 5 * np.sin(np.indices(mask.shape)[0] / 9)
    noise = np.random.default_rng(0).normal(0, 3, mask.shape)
    affine, found = np.diag([PIXEL_MM, PIXEL_MM, 1, 1]), []
    for name, values in (("slice_T1w", (mask * waves + noise).astype(np.float32)), ("mask", mask.astype(np.uint8))):
        found.append(folder / f"{name}.nii.gz")
        nibabel.save(nibabel.Nifti1Image(values[..., None], affine), found[-1])
    return tuple(found)


def warm(image: Path, mask: Path) -> float:
    """Median seconds from a mask to a warped slice in one process, all that a run reports of the solution included."""
    values, organ = (np.asarray(nibabel.load(path).dataobj)[..., 0] for path in (image, mask))
    origin, spacing, found = np.zeros(2), np.full(2, PIXEL_MM), []
    path = np.array([[95.0, 190.0], [95.0, 110.0]])
    for _ in range(REPEATS + 1):  # the first one loads kernels
        start = process_time()
        mesh = distmesh(outline_of(organ > 0, origin, spacing), SizeField(3.0, 1.0, 12.0, (path,)))
        cut = place_cut(path, mesh.outline)
        blades = tuple(Retraction(0, side, normal_mm=3.0, blade=(0.0, 0.8)) for side in (1, -1))
        solution = solve(pose(mesh, (cut,), Material(), Skull(), blades))
        grid = origin, spacing, values.shape
        update(values, covered(mesh.corners, *grid), pull_back(solution.rest, solution.moved, *grid))
        found.append(process_time() - start)
    return median(found[1:])


def once(*words: str) -> list[float]:
    """Processor's seconds, wall's seconds and peak MB of one run of a command."""
    told = subprocess.run([sys.executable, "-S", "-c", START, *words], capture_output=True, text=True, check=True,
                          env=INSTALLED)
    code, *found = json.loads(told.stdout)
    if code:
        sys.exit(f"{' '.join(words)} ended with {code}")
    return found


def main() -> None:
    """Print one row for each kind of run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        image, mask = write_slice(folder)
        cache, out = folder / "cache", folder / "out"
        run = ("run", str(image), "--cut", "95,190 95,110", "--opening-mm", "6", "-o", str(out), "-w", str(cache))
        kinds = {
            "a mask given, no report, cold": ((*run, "--mask", str(mask), "--no-report"), True, 1.5),
            "a mask given, no report, all cached": ((*run, "--mask", str(mask), "--no-report"), False, 0.5),
            "segmentation, figure and report, cold": (run, True, 4.0),
            "with the report, all cached": (run, False, 0.5),
            "run --help": (("run", "--help"), False, 0.1),
        }
        rows, marks = [], []
        for kind, (words, cold, limit) in kinds.items():
            once(COMMAND, *words)  # compiles kernels, fills the cache
            found = []
            for _ in range(REPEATS):
                if cold:
                    shutil.rmtree(cache)
                found.append(once(COMMAND, *words))
            processor, wall, memory = (median(column) for column in zip(*found))
            rows.append((kind, processor, wall, memory))
            marks.append(mark(f"run: {kind}, s", limit, processor))
        seconds = warm(image, mask)
        rows.append(("a mask to the warped slice in one process, warm", seconds, "", ""))
        marks.append(mark("run: from a mask to the warped slice in one process, warm, s", 0.12, seconds))
    bare = median(once(sys.executable, "-c", "pass")[0] for _ in range(REPEATS))
    text = table(("run", "seconds", "wall's seconds", "peak MB"), rows)
    keep("runs", f"{text}\nPython itself starts in {bare:.3f} s.\n", marks)


if __name__ == "__main__":
    main()
