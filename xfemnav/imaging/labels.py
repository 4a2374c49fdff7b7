"""A label map, on any grid: how much of each label the cells of a mesh hold, and the outlines of one label."""

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.resection import even_odd
from xfemnav.imaging.outline import rings_of_mask
from xfemnav.imaging.reading import Image
from xfemnav.imaging.slices import Slice, values_on

LOST = 0.05  # part of a region that may be lost without a warning
SPLIT = 6  # each edge of a cell: the cell is 36 small triangles, each of the label at its middle


def label_shares(image: Image, frame: Slice, corners, labels) -> np.ndarray:
    """Share (m, k) of the area of each cell, corners (m, 3, 2) plane mm, that has each of k labels; rows may miss 1.

    Each of the cell's 36 equal parts has the label of the voxel that its middle is nearest to; 0 outside the image.
    """
    refuse_fractions(image)
    weights = _middles()
    points = np.einsum("pa,mai->mpi", weights, corners)
    to_voxels = np.linalg.inv(image.affine)
    voxels = np.rint(frame.to_world(points.reshape(-1, 2)) @ to_voxels[:3, :3].T + to_voxels[:3, 3]).astype(int)
    inside = ((voxels >= 0) & (voxels < image.values.shape)).all(axis=1)
    found = np.zeros(len(voxels))
    found[inside] = image.values[tuple(voxels[inside].T)]
    return (found.reshape(len(corners), -1, 1) == np.asarray(labels)).mean(axis=1)


def refuse_fractions(image: Image) -> None:
    """Raise E131 when an image's values are not whole numbers, so that it is no label map."""
    if (image.values != np.rint(image.values)).any():
        raise XfemnavError("E131", f"{image.name} is no label map: its values are not whole numbers. Give labels, not "
                                   "probabilities.")


def _middles():
    """Barycentric coordinates (p, 3) of the middles of the SPLIT**2 equal parts of a triangle."""
    i, j = np.mgrid[0:SPLIT, 0:SPLIT]
    upright, inverted = i + j < SPLIT, i + j < SPLIT - 1
    first = np.concatenate([i[upright] + 1 / 3, i[inverted] + 2 / 3]) / SPLIT
    second = np.concatenate([j[upright] + 1 / 3, j[inverted] + 2 / 3]) / SPLIT
    return np.stack([1 - first - second, first, second], axis=1)


def region_rings(image: Image, frame: Slice, label: int | None = None) -> tuple[np.ndarray, ...]:
    """Closed outlines (k, 2) plane mm of one label, or of all that is not 0, in the slice `frame`.

    They are smooth: each loses pi pixels. Warns W208 of what else is lost, parts that are not two pixels wide.
    """
    values = values_on(image, frame, resample="nearest")
    mask = values != 0 if label is None else values == label
    if label is not None:
        refuse_fractions(image)
        if not mask.any():
            held = ", ".join(f"{value:.0f}" for value in np.unique(values)[:20] if value) or "none"
            raise XfemnavError("E311", f"label {label} of {image.name} is nowhere on this slice, which holds the "
                                       f"labels {held}. Check its number, and that the map covers the slice.")
    elif len(np.unique(values[mask])) > 1:
        warn("W209", f"{image.name} is no mask of two values: all that is not 0 is taken out, {mask.sum()} pixels.")
    rings = rings_of_mask(mask, frame.origin, frame.spacing)
    pixel, wanted = float(frame.spacing.prod()), float(mask.sum() * frame.spacing.prod())
    lost = wanted - even_odd(rings).area - np.pi * pixel * len(rings)
    if lost > LOST * wanted:
        warn("W208", f"{lost:.3g} of {wanted:.4g} mm2 of {image.name} that are taken out are nowhere two pixels wide, "
                     "and stay.")
    return rings
