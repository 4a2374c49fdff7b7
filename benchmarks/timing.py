"""How the benchmarks measure and keep what they measured.

Seconds are those that the process had a processor for, on one thread: on a shared machine a clock on the wall measures
the neighbours. What is compared is run in turns in one process, and the medians are given.
"""

import ctypes
import json
import os
import platform
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from time import process_time

from xfemnav.pipeline.keeping.kernels import settle_kernel_cache

settle_kernel_cache()  # or numba would take kernels of other code for ours
RESULTS = Path("benchmarks/results")
LIBRARIES = ("numpy", "scipy", "numba", "SimpleITK", "nibabel", "matplotlib", "shapely", "gmsh", "scikit-fem",
             "scikit-sparse", "distmeshpy")
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before the libraries start their threads
    if os.environ.setdefault(name, "1") != "1":
        sys.exit(f"{name} must be 1: one thread is measured")


def interleaved(runs: dict[str, Callable], repeats: int = 5) -> dict[str, float]:
    """Median seconds of each of `runs`, taken in turns after one run of each that is not counted."""
    for run in runs.values():
        run()
    seconds = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = process_time()
            run()
            seconds[name].append(process_time() - start)
    return {name: median(times) for name, times in seconds.items()}


def peak_mb(run: Callable) -> float:
    """MB by which a call makes the process grow at most, by the system's account: measured in a copy of the process."""
    receiver, sender = os.pipe()
    child = os.fork()
    if child:
        os.close(sender)
        with os.fdopen(receiver) as told:
            found = told.read()
        os.waitpid(child, 0)
        return float(found)
    try:
        ctypes.CDLL(None).malloc_trim(0)  # what is free already would be used again, and not be seen
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = _status("VmRSS")
        result = run()
        os.write(sender, f"{(_status('VmHWM') - before) / 1024}".encode())
        del result
    finally:
        os._exit(0)


def _status(name) -> int:
    """A line of /proc/self/status, kB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1])


def exponent(sizes, seconds) -> float:
    """p of the power law seconds ~ size^p that fits best."""
    import numpy as np  # not before the number of threads is set

    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def processor() -> str:
    """The processor's own name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.machine()


def machine() -> str:
    """Kind of machine, and versions of what is measured."""
    found = []
    for name in LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} absent")
    return (f"Measured on {os.cpu_count()} cores of {processor()}, {platform.system()}, Python "
            f"{platform.python_version()}; {', '.join(found)}.")


def table(head: tuple[str, ...], rows) -> str:
    """A Markdown table; numbers with three digits."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(_shown, line)) + " |" for line in lines) + "\n"


def _shown(value) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def mark(name: str, limit: float, measured: float) -> dict:
    """A mark: what is wanted to be at most `limit`, and what was measured."""
    return {"name": name, "limit": float(limit), "measured": float(measured)}


def keep(name: str, text: str, marks: list[dict]) -> None:
    """Print the text, and keep it with its marks and the machine for docs/measured/performance.md."""
    print(text)
    RESULTS.mkdir(exist_ok=True)
    kept = {"machine": machine(), "text": text, "marks": marks}
    (RESULTS / f"{name}.json").write_text(json.dumps(kept, indent=1) + "\n")
