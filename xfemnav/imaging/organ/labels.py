"""A label map, on any grid: how much of each label the cells of a mesh hold."""

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.organ.masks import is_whole
from xfemnav.imaging.reading.gate import Image

SPLIT = 6  # each edge of a cell: the cell is 36 small triangles, each of the label at its middle
INNER = 4  # steps along an edge of a tetrahedron between the 35 places at which it is looked up


def label_shares(image: Image, frame: Grid, corners, labels) -> np.ndarray:
    """Share (m, k) of each cell, corners (m, 3, 2) plane mm or (m, 4, 3) in space, that has each of k labels; rows may
    miss 1.

    Each of the cell's 36 equal parts, of 35 places in a tetrahedron, has the label of the voxel that it is nearest to;
    0 outside the image.
    """
    refuse_fractions(image)
    _, n_corners, d = corners.shape
    weights = MIDDLES[n_corners]()
    points = np.einsum("pa,mai->mpi", weights, corners)
    to_voxels = np.linalg.inv(image.affine)
    voxels = np.rint(frame.to_world(points.reshape(-1, d)) @ to_voxels[:3, :3].T + to_voxels[:3, 3]).astype(int)
    inside = ((voxels >= 0) & (voxels < image.values.shape)).all(axis=1)
    found = np.zeros(len(voxels))
    found[inside] = image.values[tuple(voxels[inside].T)]
    return (np.rint(found).reshape(len(corners), -1, 1) == np.asarray(labels)).mean(axis=1)


def refuse_fractions(image: Image) -> None:
    """Raise E131 when an image's values are not whole numbers, so that it is no label map."""
    if not is_whole(image.values):
        raise XfemnavError("E131", f"{image.name} is no label map: its values are not whole numbers. Give labels, not "
                                   "probabilities.")


def _middles():
    """Barycentric coordinates (p, 3) of the middles of the SPLIT**2 equal parts of a triangle."""
    i, j = np.mgrid[0:SPLIT, 0:SPLIT]
    upright, inverted = i + j < SPLIT, i + j < SPLIT - 1
    first = np.concatenate([i[upright] + 1 / 3, i[inverted] + 2 / 3]) / SPLIT
    second = np.concatenate([j[upright] + 1 / 3, j[inverted] + 2 / 3]) / SPLIT
    return np.stack([1 - first - second, first, second], axis=1)


def _inner():
    """Barycentric coordinates (p, 4) of places spread evenly inside a tetrahedron."""
    steps = np.stack(np.meshgrid(*[np.arange(INNER + 1)] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    return (steps[steps.sum(axis=1) == INNER] + 1 / 4) / (INNER + 1)


#: Where a cell is looked up, by the number of its corners.
MIDDLES = {3: _middles, 4: _inner}
