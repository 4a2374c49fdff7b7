"""Values of a volume at places of a plane or of space: trilinear, nearest, or the interpolating cubic B-spline.

The kernels know the dimension of the places as the length of a tuple, `axes`, which is a constant when compiled.
"""

import numpy as np
from numba import njit

from xfemnav.imaging.carrying.lattice import SAME

SPLINE_REACH = 16  # voxels beyond which a voxel no longer tells in a cubic spline: it falls by .27 a voxel, to 1e-9


def sample_volume(values, matrix, shift, places, interp: str, reach: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """`values` (ni, nj, nk, nc) at `places` (n, d) mm, and which of them have a voxel.

    A place is at voxel `matrix` (3, d) place + `shift` (3,). Outermost voxels go on for `reach`, by default half their
    size; along an axis of one voxel there is no end, for a single slice is taken in its plane. Returns (n, nc), 0 where
    there is none, and (n,) bool.
    """
    places, shape = np.ascontiguousarray(places, float), np.array(values.shape[:3])
    reach = np.where(shape == 1, np.inf, reach)
    out, seen = np.zeros((len(places), values.shape[3])), np.ones(len(places), np.bool_)
    where = shape - 1.0, matrix, shift, reach, places, tuple(range(places.shape[1]))
    if interp == "linear":
        _linear(out, seen, values, *where)
    elif interp == "nearest":
        _nearest(out, seen, values, *where)
    elif interp == "cubic":
        _cubic(out, seen, *_spline(values, matrix, shift, places), *where)
    else:
        raise ValueError(f"interp is {interp!r}, wanted linear, cubic or nearest")
    return out, seen


def _spline(values, matrix, shift, places):
    """Coefficients (mi, mj, mk, nc) of the interpolating cubic B-spline of `values` about the places, and the voxel
    (3,) of the first one. Beyond the outermost voxels the values go on unchanged; an axis of length 1 stays.
    """
    at, last = places @ matrix.T + shift, np.array(values.shape[:3]) - 1
    low = np.clip(np.floor(at.min(axis=0, initial=0)).astype(int) - SPLINE_REACH, 0, last)
    high = np.clip(np.ceil(at.max(axis=0, initial=0)).astype(int) + SPLINE_REACH, 0, last) + 1
    from scipy.ndimage import spline_filter1d

    long = [axis for axis in range(3) if last[axis] > 0]
    pad = [(SPLINE_REACH if axis in long else 0,) * 2 for axis in range(3)]
    near = np.pad(values[tuple(slice(*ends) for ends in zip(low, high))], [*pad, (0, 0)], mode="edge")
    for axis in long:
        near = spline_filter1d(near, 3, axis, mode="mirror")
    return near, low - [before for before, _ in pad]


@njit(cache=True)
def _within(x, end, reach):
    """Voxel coordinate `x` within 0..`end`; NaN beyond the `reach` of the outermost voxels."""
    if not (-reach - SAME <= x <= end + reach + SAME):
        return np.nan
    return 0.0 if x < 0 else (end if x > end else x)


@njit(cache=True)
def _along(a, place, matrix, shift, ends, reach, axes):
    """Voxel coordinate of a `place` (d,) mm along array axis `a`; NaN where there is no voxel."""
    x = matrix[a, 0] * place[0]
    for i in range(1, len(axes)):
        x += matrix[a, i] * place[i]
    return _within(x + shift[a], ends[a], reach[a])


@njit(cache=True)
def _voxel(place, matrix, shift, ends, reach, axes):
    """Voxel coordinates of a `place` (d,) mm; NaN in each one along which there is no voxel."""
    x = _along(0, place, matrix, shift, ends, reach, axes)
    y = _along(1, place, matrix, shift, ends, reach, axes)
    z = _along(2, place, matrix, shift, ends, reach, axes)
    return x, y, z


@njit(cache=True)
def _nearest(out, seen, values, ends, matrix, shift, reach, places, axes):
    """As `_linear`, with the value of the nearest voxel."""
    for p in range(len(places)):
        x, y, z = _voxel(places[p], matrix, shift, ends, reach, axes)
        if x + y + z != x + y + z:
            seen[p] = False
            continue
        i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
        for c in range(out.shape[1]):
            out[p, c] = values[i, j, k, c]


@njit(cache=True)
def _linear(out, seen, values, ends, matrix, shift, reach, places, axes):
    """Write trilinear `values` (ni, nj, nk, nc) at `places` (n, d) mm to `out` (n, nc).

    A place is at voxel `matrix` (3, d) place + `shift` (3,). The last voxels are `ends` (3,), and the outermost ones go
    on for `reach` (3,). Places that are not `seen` (n,) have no voxel and stay.
    """
    # Unsigned: an index that cannot be negative costs no look whether it counts from the end.
    nc = np.uint64(values.shape[3])
    flat, one = values.ravel(), np.uint64(values.shape[2]) * nc
    two, none = np.uint64(values.shape[1]) * one, np.uint64(0)
    for p in range(len(places)):
        x, y, z = _voxel(places[p], matrix, shift, ends, reach, axes)
        if x + y + z != x + y + z:
            seen[p] = False
            continue
        i, j, k = np.uint64(x + SAME), np.uint64(y + SAME), np.uint64(z + SAME)
        r, s, t = x - i, y - j, z - k
        at = i * two + j * one + k * nc
        # places on a plane of voxels take nothing from the next one, which may not be there
        ri, sj = two if r > SAME else none, one if s > SAME else none
        for c in range(nc):
            a, b = at + c, at + c + ri
            low = flat[a] + s * (flat[a + sj] - flat[a])
            high = flat[b] + s * (flat[b + sj] - flat[b])
            out[p, c] = low + r * (high - low)
        if t > SAME:
            for c in range(nc):
                a, b = at + nc + c, at + nc + c + ri
                low = flat[a] + s * (flat[a + sj] - flat[a])
                high = flat[b] + s * (flat[b + sj] - flat[b])
                out[p, c] += t * (low + r * (high - low) - out[p, c])


@njit(cache=True)
def _cubic(out, seen, spline, first, ends, matrix, shift, reach, places, axes):
    """As `_linear`, with the cubic B-spline of coefficients `spline` (mi, mj, mk, nc) from voxel `first` (3,) on."""
    taps = [4 if end > 0 else 1 for end in ends]
    weight, start, at = np.ones((3, 4)), np.zeros(3, np.int64), np.zeros(3)
    for p in range(len(places)):
        at[0], at[1], at[2] = _voxel(places[p], matrix, shift, ends, reach, axes)
        if at.sum() != at.sum():
            seen[p] = False
            continue
        for k in range(3):
            if taps[k] == 4:    # else one slice: its values are the coefficients
                i = int(at[k])
                t, start[k] = at[k] - i, i - 1 - first[k]
                weight[k, 0], weight[k, 3] = (1 - t) ** 3 / 6, t**3 / 6
                weight[k, 1], weight[k, 2] = 2 / 3 - t * t * (1 - t / 2), 2 / 3 - (1 - t) ** 2 * (1 + t) / 2
        for c in range(out.shape[1]):
            total = 0.0
            for a in range(taps[0]):
                for b in range(taps[1]):
                    row = 0.0
                    for d in range(taps[2]):
                        row += weight[2, d] * spline[start[0] + a, start[1] + b, start[2] + d, c]
                    total += weight[0, a] * weight[1, b] * row
            out[p, c] = total
