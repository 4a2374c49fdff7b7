"""A small head for tests of the whole chain, and the command line run in this process."""

import sys

import nibabel as nib
import numpy as np

from xfemnav_cli.main import main

CUT = "-60,10 -15,5"  # from outside the brain to its inside, through the patient's left
QUICK = ("--element-size-mm", "8", "--corridor-element-mm", "4", "--no-report")
OPEN = ("--opening-mm", "4")
RAS = np.diag([2.0, 2.0, 2.0, 1.0])
RAS[:3, 3] = -63, -71, 10


def brain(shape=(64, 72)):
    """A stripped brain: an ellipse with a bright core and a texture, background 0, on 2 mm pixels."""
    x, y = (np.indices(shape) * 2.0 + np.array([-63, -71])[:, None, None])
    inside = (x / 45) ** 2 + (y / 55) ** 2 < 1
    core = ((x - 8) / 20) ** 2 + (y / 25) ** 2 < 1
    return np.where(inside, 500 + 200 * core + 40 * np.sin(x / 3) * np.cos(y / 4), 0).astype(np.float32)


def write(path, values=None, affine=RAS):
    """Write a NIfTI slice at `path` and return it; the brain unless other `values` are given."""
    values = brain() if values is None else np.asarray(values)
    nib.save(nib.Nifti1Image(values[:, :, None] if values.ndim == 2 else values, affine), path)
    return path


def xfemnav(capfd, *arguments):
    """Run the command in this process: (exit code, stdout, stderr)."""
    capfd.readouterr()
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        sys.stdout.flush()
        return (end.code or 0, *capfd.readouterr())
    raise AssertionError("the command did not end with an exit code")
