"""The motion for other programs: as an ITK transform from the new image to the old one, which has no word for a gap.

A displacement field has a value at every pixel, also in an opened cut, where nothing rested. Two ways to fill it:
bridged from lip to lip, which any viewer shows without a jump but which draws stretched lips across the gap; or the
lips' own values one pixel on and beyond them a displacement out of the image, so that resampling gives background
there.
"""

from pathlib import Path

import numpy as np
import SimpleITK as sitk
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import splu

from xfemnav.imaging.hdf5 import without_times
from xfemnav.imaging.slices import Slice
from xfemnav.imaging.warp import PullBack

NOWHERE = 1e4    # mm, farther than any image reaches
LPS = np.array([-1.0, -1.0, 1.0])


def bridged(motion: PullBack, empty) -> np.ndarray:
    """The field (n1, n2, 2) mm of `motion` with a harmonic bridge over the pixels `empty` (n1, n2) bool.

    Between two near lips that is linear from one to the other. Around it the tissue's field and, outside, 0 are kept.
    """
    field = motion.field.copy()
    places = np.argwhere(empty)
    if not len(places):
        return field
    number = np.full(empty.shape, -1)
    number[empty] = np.arange(len(places))
    diagonal, right, links = np.zeros(len(places)), np.zeros((len(places), 2)), []
    for step in np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]):
        weight = (step**2 / motion.spacing**2).sum()
        k = np.flatnonzero(((places + step >= 0) & (places + step < empty.shape)).all(axis=1))
        there = tuple((places[k] + step).T)
        known = number[there] < 0
        diagonal[k] += weight
        right[k] += weight * np.where(known[:, None], field[there], 0)
        links.append(np.column_stack([k, number[there], np.full(len(k), -weight)])[~known])
    rows, columns, values = np.concatenate(links).T
    laplacian = sparse.csc_array((values, (rows.astype(int), columns.astype(int))), (len(places),) * 2)
    field[empty] = splu(laplacian + sparse.diags_array(diagonal, format="csc")).solve(right)
    return field


def extended(motion: PullBack, empty) -> np.ndarray:
    """The field (n1, n2, 2) mm of `motion`; pixels `empty` (n1, n2) bool go with tissue next to them, or NOWHERE."""
    field = motion.field.copy()
    steps, nearest = distance_transform_edt(~motion.tissue, return_indices=True)
    rim = empty & (steps < 1.5)    # neighbours, also across a corner
    field[empty] = NOWHERE
    field[rim] = motion.field[tuple(nearest[:, rim])]
    return field


def itk_transform(slice: Slice, field) -> sitk.CompositeTransform:
    """Transform of world points (LPS mm, as ITK counts) from the new image to the old one, by `field` (n1, n2, 2) mm.

    It holds in the slice; outside of its pixels ITK leaves points where they are. A composite, because there are
    readers that skip the first transform of a file and expect its parts behind it.
    """
    vectors = np.asarray(field) @ slice.axes[:2] * LPS
    image = sitk.GetImageFromArray(np.ascontiguousarray(vectors.swapaxes(0, 1)[None], float), isVector=True)
    e1, e2, _ = slice.axes * LPS
    image.SetOrigin((slice.to_world(slice.origin[None])[0] * LPS).tolist())
    image.SetSpacing([*slice.spacing.tolist(), slice.thickness])
    image.SetDirection(np.column_stack([e1, e2, np.cross(e1, e2)]).ravel().tolist())
    return sitk.CompositeTransform([sitk.DisplacementFieldTransform(image)])


def write_transform(path, slice: Slice, field) -> None:
    """Write `itk_transform` as ITK's .h5 file; the same field gives the same bytes."""
    sitk.WriteTransform(itk_transform(slice, field), str(path))
    Path(path).write_bytes(without_times(Path(path).read_bytes()))
