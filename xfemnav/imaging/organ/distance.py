"""A mask of voxels -> the signed distance from its surface, without stairs.

The exact distance of a staircase still has stairs: it is smoothed by a Gaussian of a voxel, as the outline of a slice
is (curvature flow: a surface of radius R moves inwards by sigma^2 / R). Thick slices are interpolated by shape first:
each has its signed distance in the plane, and between them it is linear (Raya & Udupa 1990).

Distances by lower envelopes of parabolas, an axis after the other (Felzenszwalb & Huttenlocher 2012): scipy's are the
same, with ten times the memory.
"""

import numpy as np
from numba import njit
from scipy.ndimage import find_objects, gaussian_filter1d

from xfemnav.errors import XfemnavError
from xfemnav.geometry.solid.field import Field
from xfemnav.imaging.reading.lean import nibabel

SIGMA = 1.0  # voxels
MARGIN_MM, MARGIN = 8.0, 5  # background about the organ, mm and at least so many voxels
FARTHEST = 1e12  # mm^2: of what nothing is there to be near to
THICK = 2.0  # times the thinnest spacing: thicker slices are interpolated by shape
# Axes that are as near to one axis of the world as to another are told apart by this turn (rad), in whatever order they
# are stored.
TURN = np.array([[1.0, -3e-6, 2e-6], [3e-6, 1.0, -1e-6], [-2e-6, 1e-6, 1.0]])


def signed_distance(mask: np.ndarray, affine: np.ndarray) -> Field:
    """Signed distance mm from the surface of the organ in `mask` (n1, n2, n3), positive inside, where `affine` (4, 4)
    takes voxel indices to world RAS mm.

    The grid is that of the mask, thick slices divided, in the order nearest to R, A, S, with the organ and a margin
    alone. An organ that the image's border cuts ends half a voxel beyond its last one. Raises E201 for an empty mask.
    """
    mask, affine = np.asarray(mask, bool), np.asarray(affine, float)
    if not mask.any():
        raise XfemnavError("E201", "the mask is empty. Give another ⟦mask=FILE⟧.")
    box = find_objects(mask.view(np.uint8))[0]
    organ, start = mask[box], np.array([part.start for part in box])
    organ, origin, axes = _nearest_to_world(organ, affine[:3, :3] @ start + affine[:3, 3], affine[:3, :3].T)
    spacing = np.linalg.norm(axes, axis=1)
    for axis in np.argsort(-spacing):
        parts = round(spacing[axis] / spacing.min())
        if spacing[axis] > THICK * spacing.min():
            organ = _between_slices(organ, spacing, axis, parts)
            origin, axes[axis] = origin - axes[axis], axes[axis] / parts
            spacing[axis] /= parts
    margin = np.maximum(np.ceil(MARGIN_MM / spacing), MARGIN).astype(int)
    values = _signed(np.pad(organ, [(n, n) for n in margin]), spacing)
    for axis in range(3):
        gaussian_filter1d(values, SIGMA, axis, output=values)
    return Field(values, origin - margin @ axes, axes)


def _nearest_to_world(organ, origin, axes):
    """The organ with its array axes in the order and direction nearest to R, A, S, and its origin and axes."""
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes.T, origin
    turned = np.eye(4)
    turned[:3, :3] = TURN @ axes.T
    order = nibabel.orientations.io_orientation(turned)
    affine = affine @ nibabel.orientations.inv_ornt_aff(order, organ.shape)
    return nibabel.orientations.apply_orientation(organ, order), affine[:3, 3], affine[:3, :3].T.copy()


def _between_slices(organ, spacing, axis, parts):
    """The organ with `parts` slices for one along an axis, from an empty one before the first to one after the last.

    Distances are bounded by the spacing of the slices: so the organ, or a part of it that ends, is rounded off within
    half a slice, and one that the image's border cuts ends flat.
    """
    slices = np.moveaxis(organ, axis, 0)
    thick, plane = spacing[axis], np.delete(spacing, axis)
    found = np.zeros(((len(slices) + 1) * parts + 1, *slices.shape[1:]), bool)
    last = np.full(slices.shape[1:], -thick)
    for k in range(len(slices) + 1):
        own = np.full_like(last, -thick)
        if k < len(slices):
            own = np.clip(_signed(slices[k][None], np.array([thick, *plane]))[0], -thick, thick)
        for part in range(parts):
            found[k * parts + part] = last + (own - last) * (part / parts) > 0
        last = own
    return np.moveaxis(found, 0, axis)


def _signed(organ, spacing):
    """Distance (n1, n2, n3) float32 mm of voxels' centres from the border between those in the organ and those not.

    That border lies half a voxel before the nearest centre on the other side.
    """
    inside, outside = _nearest(~organ, spacing), _nearest(organ, spacing)
    inside -= outside
    half = np.float32(spacing.min() / 2)
    inside -= np.where(organ, half, -half)
    return inside


def _nearest(there, spacing):
    """Distance (n1, n2, n3) float32 mm of each voxel's centre from the nearest that is `there`."""
    squares = np.where(there, np.float32(0), np.float32(FARTHEST))
    for axis in range(3):
        _lower_envelope(np.moveaxis(squares, axis, 2), spacing[axis] ** 2)
    return np.sqrt(squares, out=squares)


@njit(cache=True)
def _lower_envelope(f, width):
    """Along the last axis, in place: the least f(q) + width (p - q)^2 of all q, at each p."""
    n = f.shape[2]
    of, begins, own = np.empty(n, np.int64), np.empty(n), np.empty(n)  # parabolas of the envelope, and from where on
    for i in range(f.shape[0]):
        for j in range(f.shape[1]):
            k = -1
            for q in range(n):
                own[q] = f[i, j, q]
                if own[q] >= FARTHEST:
                    continue
                meets = -np.inf
                while k >= 0:
                    meets = ((own[q] - own[of[k]]) / width + q * q - of[k] * of[k]) / (2 * (q - of[k]))
                    if meets > begins[k]:
                        break
                    k, meets = k - 1, -np.inf
                k += 1
                of[k], begins[k] = q, meets
            last, k = k, 0
            for p in range(n if last >= 0 else 0):
                while k < last and begins[k + 1] < p:
                    k += 1
                f[i, j, p] = own[of[k]] + width * (p - of[k]) ** 2
