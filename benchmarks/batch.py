"""Throughput of a batch of 100 slices with two runs at a time, over that of one at a time.

    python -m benchmarks.batch

512 x 512 slices of about 4.5k nodes with a mask, each with noise and a cut of its own, figure and report included;
nothing is in the cache. Five blocks of 20 slices, each block one at a time and two at a time in turn. Seconds of the
clock on the wall: only a machine without other work tells something.
"""

from benchmarks.timing import keep, mark, table  # isort: skip (sets the number of threads)

import shutil
import subprocess
import tempfile
from pathlib import Path
from time import perf_counter

import nibabel
import numpy as np

from benchmarks.runs import COMMAND, INSTALLED, write_slice

BLOCKS, SLICES = 5, 20
LIMIT = 1 / 1.6


def write_block(folder: Path, block: int) -> None:
    """20 slices, a scenario beside each."""
    folder.mkdir()
    with tempfile.TemporaryDirectory() as name:
        image, mask = (nibabel.load(path) for path in write_slice(Path(name)))
        values, inside = image.get_fdata(), np.asarray(mask.dataobj)
    for k in range(SLICES):
        rng = np.random.default_rng(SLICES * block + k)
        noisy = (values + rng.normal(0, 3, values.shape)).astype(np.float32)
        nibabel.save(nibabel.Nifti1Image(noisy, image.affine), folder / f"slice{k:02}.nii.gz")
        nibabel.save(nibabel.Nifti1Image(inside, image.affine), folder / f"slice{k:02}_mask.nii.gz")
        x, y = 95 + rng.uniform(-10, 10), 110 + rng.uniform(-10, 10)
        (folder / f"slice{k:02}.toml").write_text(
            f'xfemnav = 1\nmask = "slice{k:02}_mask.nii.gz"\n\n[[cut]]\npoints = [[95, 190], [{x:.1f}, {y:.1f}]]\n'
            + "".join(f'\n[[retract]]\ncut = "cut"\nside = "{side}"\nnormal_mm = 3.0\n' for side in ("left", "right"))
        )


def seconds(source: Path, jobs: int) -> float:
    """A batch of the slices of `source` on an empty cache."""
    with tempfile.TemporaryDirectory() as name:
        start = perf_counter()
        subprocess.run([COMMAND, "batch", source, Path(name) / "out", "-j", str(jobs)], check=True,
                       env=INSTALLED | {"XFEMNAV_CACHE": f"{name}/cache"}, stdout=subprocess.DEVNULL)
        return perf_counter() - start


def main() -> None:
    """Print both throughputs."""
    took = {1: [], 2: []}
    for block in range(BLOCKS):
        with tempfile.TemporaryDirectory() as name:
            source = Path(name) / "slices"
            write_block(source, block)
            if not block:  # kernels are compiled
                few = Path(name) / "few"
                few.mkdir()
                for path in source.glob("slice00*"):
                    shutil.copy(path, few)
                seconds(few, 1)
            for jobs, found in took.items():
                found.append(seconds(source, jobs))
    rows = [(f"-j {jobs}", sum(found), 60 * BLOCKS * SLICES / sum(found), sum(took[1]) / sum(found))
            for jobs, found in took.items()]
    keep("batch", table(("batch", "seconds for 100 slices", "slices a minute", "over -j 1"), rows),
         [mark("batch: seconds of -j 2 over those of -j 1", LIMIT, sum(took[2]) / sum(took[1]))])


if __name__ == "__main__":
    main()
