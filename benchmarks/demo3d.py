"""The demo of a volume, from an empty cache and again: its seconds and its memory.

    python -m benchmarks.demo3d [folder of the run]

Kernels that were never used on this machine are compiled in the first run, which says so.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COMMAND = (sys.executable, "-m", "xfemnav", "demo", "--dim", "3")
PEAK = 1e3 if sys.platform == "darwin" else 1.0  # of ru_maxrss, in kB


def timed(output: Path, cache: Path, *more: str) -> tuple[float, float]:
    """Seconds of a run of the demo and the largest memory, GB, of any run so far."""
    start = time.perf_counter()
    subprocess.run([*COMMAND, "-o", str(output), "-w", str(cache), *more], check=True)
    seconds = time.perf_counter() - start
    return seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / PEAK / 1e6


def main() -> None:
    """Print a line for each of the two runs."""
    output = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/demo3d")
    with tempfile.TemporaryDirectory() as folder:
        cold, memory = timed(output, Path(folder))
        cached, _ = timed(output, Path(folder), "-q")
    print(f"cold {cold:.1f} s, {memory:.2f} GB at most; all stages cached {cached:.1f} s; {os.cpu_count()} cores, of "
          f"which {os.getloadavg()[0]:.1f} were busy")


if __name__ == "__main__":
    main()
