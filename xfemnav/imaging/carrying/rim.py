"""Voxels of a mask just outside of the smooth surface that was meshed: they go with the tissue beside them."""

from dataclasses import replace

import numpy as np

from xfemnav.imaging.carrying.solid import SolidPullBack


def with_rim(pull_back: SolidPullBack, rim) -> SolidPullBack:
    """A pull-back in which voxels of the `rim` (n1, n2, n3) bool next to tissue, by a face, are in its tetrahedron."""
    low = np.maximum(pull_back.first - 1, 0)
    high = np.minimum(pull_back.first + pull_back.simplex.shape + 1, pull_back.shape)
    pad = [(a - b, d - c) for a, b, c, d in zip(pull_back.first, low, pull_back.first + pull_back.simplex.shape, high)]
    own = np.pad(pull_back.simplex, pad, constant_values=-1)
    wanted, simplex = rim[tuple(map(slice, low, high))], own.copy()
    for axis in range(3):
        for step in (1, -1):
            beside = np.roll(own, step, axis)
            ends = [slice(None)] * 3
            ends[axis] = 0 if step == 1 else -1
            beside[tuple(ends)] = -1
            np.copyto(simplex, beside, where=wanted & (simplex < 0))
    count = np.maximum(np.pad(pull_back.count, pad), (simplex >= 0) & (own < 0))
    return replace(pull_back, simplex=simplex, count=count.astype(np.uint8), folded=np.pad(pull_back.folded, pad),
                   first=low)
