"""The new image as the pull-back of the old one: every pixel asks which moved triangle it is in, and samples at rest.

The motion is affine on each triangle of the mechanics' result, so a pixel's resting place is exact: nothing is inverted
numerically and nothing is smeared across a cut. Coordinates are plane mm; pixel (i, j) has its centre at
origin + (i, j) * spacing, so that axis 0 runs along the plane's first coordinate.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from xfemnav.imaging.carrying.lattice import ON_EDGE, SAME
from xfemnav.imaging.carrying.solid import SolidPullBack, enclosed_in_space, pull_back_in_space


@dataclass(frozen=True, eq=False)
class PullBack:
    """Where the tissue in each pixel rested.

    `resting` (n1, n2, 2) mm, NaN where there is no tissue; `count` (n1, n2) triangles that cover the pixel, 2 or more
    where tissue overlaps; `folded` (n1, n2) triangles that cover it turned inside out, which `count` leaves out;
    `triangle` (n1, n2) the index of the one that `resting` is from, -1 for none; the `origin`, `spacing` (2,) mm;
    the triangles at `rest` and `moved`, both (t, 3, 2) mm.
    """

    resting: np.ndarray
    count: np.ndarray
    folded: np.ndarray
    triangle: np.ndarray
    origin: np.ndarray
    spacing: np.ndarray
    rest: np.ndarray
    moved: np.ndarray

    @cached_property
    def tissue(self) -> np.ndarray:
        """Pixels (n1, n2) with tissue in them."""
        return self.triangle >= 0

    @cached_property
    def overlap(self) -> np.ndarray:
        """Pixels (n1, n2) with more than one piece of tissue in them."""
        return self.count > 1

    @cached_property
    def F(self) -> np.ndarray:
        """The deformation gradient (t, 2, 2) of each triangle, d moved / d rest."""
        return _gradients(self.rest, self.moved)

    @cached_property
    def field(self) -> np.ndarray:
        """Resting place minus position, (n1, n2, 2) mm; 0 where there is no tissue."""
        field = self.resting - self._centres()
        field[~self.tissue] = 0
        return field

    @cached_property
    def places(self) -> np.ndarray:
        """Where to look for what is in each pixel now, (n1, n2, 2) mm: its resting place, or its own without tissue."""
        return np.where(self.tissue[..., None], self.resting, self._centres())

    @cached_property
    def box(self) -> np.ndarray:
        """Corners (4, 2) mm of the rectangle that holds all resting places of tissue; none (0, 2) without tissue."""
        at = self.resting[self.tissue]
        if not len(at):
            return at
        low, high = at.min(axis=0), at.max(axis=0)
        return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])

    def simplices_of(self, wanted, first: int = 0) -> np.ndarray:
        """The triangle (n,) that each of the `wanted` pixels is in, -1 for none; `wanted` as in `places_of`."""
        return self.triangle[first:first + len(wanted)][wanted]

    def places_of(self, wanted, first: int = 0) -> np.ndarray:
        """The `places` (n, 2) mm of the `wanted` pixels (m, n2) bool of the rows from `first` on."""
        return self.places[first:first + len(wanted)][wanted]

    def centres_of(self, pixels) -> np.ndarray:
        """Centres (n, 2) mm of `pixels` (n, 2)."""
        return self.origin + self.spacing * pixels

    def sample_into(self, out, values, interp: str) -> None:
        """Write an image's `values` (n1, n2) at the resting places of tissue to `out`, as `sample_into`."""
        sample_into(out, values, self.origin, self.spacing, self.resting, interp)

    def _centres(self):
        first, second = (o + h * np.arange(n) for o, h, n in zip(self.origin, self.spacing, self.triangle.shape))
        return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1)


@dataclass(frozen=True, eq=False)
class Update:
    """An updated image: `updated` (n1, n2), its `cavity`, `vacated` and `overlap` (n1, n2) bool, and what made it: the
    `pull_back`, and the `fill` of pixels without tissue.

    No tissue is left in cavity and vacated pixels: the cavity lies inside the organ as it is now, the vacated ones
    outside of it. In those of the overlap lies tissue of two places. `updated` is float32, or of the image's own type
    when its values were taken by nearest neighbour.
    """

    updated: np.ndarray
    cavity: np.ndarray
    vacated: np.ndarray
    overlap: np.ndarray
    fill: float
    pull_back: PullBack

    @property
    def field(self) -> np.ndarray:
        """Resting place minus position, (n1, n2, 2) mm; 0 where there is no tissue."""
        return self.pull_back.field


def pull_back(rest, moved, origin, spacing, shape) -> PullBack | SolidPullBack:
    """Resting place of every pixel of a grid, from simplices at `rest` and `moved`, both (t, d + 1, d) mm.

    The grid has `shape` (d,), and `origin` (d,) mm; `spacing` is (2,) mm in the plane, in space the steps (3, 3) mm
    from voxel to voxel as columns: the `lattice` of a Slice or Volume. A centre on an edge or face that simplices share
    belongs to one of them, a centre on a lip to the tissue. Where tissue overlaps, the simplex that comes first gives
    the resting place; one turned inside out gives it only where there is no other.
    """
    if len(shape) == 3:
        return pull_back_in_space(rest, moved, origin, spacing, shape)
    origin, spacing = np.asarray(origin, float), np.asarray(spacing, float)
    rest, moved = np.ascontiguousarray(rest, float), np.ascontiguousarray(moved, float)
    return PullBack(*_rasterise(rest, moved, origin, spacing, *shape), origin, spacing, rest, moved)


@njit(cache=True)
def _gradients(rest, moved):
    """Deformation gradients (t, 2, 2) of triangles; of one that is flat at rest the identity."""
    F = np.empty((len(rest), 2, 2))
    for c in range(len(rest)):
        r = rest[c]
        gx, gy, hx, hy = r[1, 0] - r[0, 0], r[1, 1] - r[0, 1], r[2, 0] - r[0, 0], r[2, 1] - r[0, 1]
        twice = gx * hy - hx * gy
        for i in range(2):
            g, h = moved[c, 1, i] - moved[c, 0, i], moved[c, 2, i] - moved[c, 0, i]
            F[c, i, 0] = (g * hy - h * gy) / twice if twice != 0 else 1.0 - i
            F[c, i, 1] = (h * gx - g * hx) / twice if twice != 0 else float(i)
    return F


def covered(simplices, origin, spacing, shape) -> np.ndarray:
    """Pixels (n1, ...) bool with their centre in or on one of `simplices` (t, d + 1, d) mm; the grid as in `pull_back`.
    """
    return pull_back(simplices, simplices, origin, spacing, shape).tissue


def enclosed(outline, origin, spacing, shape) -> np.ndarray:
    """Pixels (n1, ...) bool whose centre is inside the closed `outline`; the grid as in `pull_back`.

    It is a loop (k, 2) mm, in space closed triangles (k, 3, 3) mm. Where it crosses itself, inside is what it goes
    around an odd number of times.
    """
    if len(shape) == 3:
        return enclosed_in_space(outline, origin, spacing, shape)
    return _fill((np.asarray(outline, float) - origin) / spacing, *shape)


def update(values, organ, pull_back: PullBack, interp: str = "linear", outside: str = "keep",
           fill: float = 0.0, now=None) -> Update:
    """The image `values` (n1, n2) on the pixels of its `pull_back` as it looks after the motion.

    `organ` (n1, n2) bool is the region of the organ at rest: rasterise the whole mesh with `covered`. The mask that the
    mesh was made from would not do, because pixels between its outline and the mesh's chords have no triangle and are
    no cavity; nor would the triangles that moved, because resected tissue has left one. A pixel of `organ` without
    tissue gets `fill`. It is cavity if it lies in the organ as it is `now` (n1, n2) bool (by default everywhere), and
    else vacated: there the outline has drawn back from the skull. Pixels with neither organ nor tissue are kept, or 0
    with `outside="zero"`.
    """
    values = np.asarray(values)
    dtype = values.dtype if interp == "nearest" else np.dtype(np.float32)
    updated = values.astype(dtype, order="C") if outside == "keep" else np.zeros(values.shape, dtype)
    empty = organ & ~pull_back.tissue
    np.copyto(updated, dtype.type(fill), where=empty)
    cavity, vacated = (empty, np.zeros_like(empty)) if now is None else (empty & now, empty & ~now)
    pull_back.sample_into(updated, values, interp)
    return Update(updated, cavity, vacated, pull_back.overlap, float(fill), pull_back)


def sample_into(out, values, origin, spacing, points, interp) -> None:
    """Write the image's `values` (n1, n2) at `points` (..., 2) mm to `out` (...), whose values at NaN points stay.

    `interp` is linear, cubic (the interpolating cubic B-spline, which may overshoot at edges) or nearest. Beyond its
    outermost pixel centres the image goes on unchanged. Raises ValueError for another `interp`.
    """
    origin, spacing = np.asarray(origin, float), np.asarray(spacing, float)
    flat, to = points.reshape(-1, 2), out.reshape(-1)
    if interp == "cubic":
        from scipy.ndimage import map_coordinates  # it takes longer to load than an image to warp

        known = np.isfinite(flat[:, 0])
        at = ((flat[known] - origin) / spacing).T
        to[known] = map_coordinates(np.asarray(values, float), at, order=3, mode="nearest")
    elif interp == "linear":
        _linear(to, np.ascontiguousarray(values, float), flat, origin, spacing)
    elif interp == "nearest":
        _nearest(to, np.ascontiguousarray(values), flat, origin, spacing)
    else:
        raise ValueError(f"interp is {interp!r}, wanted linear, cubic or nearest")


@njit(cache=True)
def _linear(out, values, points, origin, spacing):
    (n1, n2), (o1, o2), per_mm1, per_mm2 = values.shape, origin, 1 / spacing[0], 1 / spacing[1]
    flat = values.ravel()
    for k in range(len(points)):
        x, y = (points[k, 0] - o1) * per_mm1, (points[k, 1] - o2) * per_mm2
        if x != x:
            continue
        x = 0.0 if x < 0 else (n1 - 1.0 if x > n1 - 1 else x)
        y = 0.0 if y < 0 else (n2 - 1.0 if y > n2 - 1 else y)
        i, j = int(x + SAME), int(y + SAME)
        s, t = x - i, y - j
        s, t = (s if s > SAME else 0.0), (t if t > SAME else 0.0)
        at = i * n2 + j
        next_i, next_j = n2 if i < n1 - 1 else 0, 1 if j < n2 - 1 else 0
        low = flat[at] + t * (flat[at + next_j] - flat[at])
        high = flat[at + next_i] + t * (flat[at + next_i + next_j] - flat[at + next_i])
        out[k] = low + s * (high - low)


@njit(cache=True)
def _nearest(out, values, points, origin, spacing):
    (n1, n2), (o1, o2), per_mm1, per_mm2 = values.shape, origin, 1 / spacing[0], 1 / spacing[1]
    for k in range(len(points)):
        x, y = (points[k, 0] - o1) * per_mm1, (points[k, 1] - o2) * per_mm2
        if x == x:
            out[k] = values[int(min(max(x + 0.5, 0.0), n1 - 1.0)), int(min(max(y + 0.5, 0.0), n2 - 1.0))]


@njit(cache=True)
def _fill(loop, n1, n2):
    """Even-odd rule: each edge of `loop` (k, 2) pixels that crosses a row turns over the pixels beyond the crossing."""
    inside = np.zeros((n1, n2 + 1), np.bool_)
    for k in range(len(loop)):
        a, b = loop[k - 1], loop[k]
        low, high = (a, b) if a[0] < b[0] else (b, a)
        for i in range(max(int(np.ceil(low[0])), 0), min(int(np.ceil(high[0])), n1)):
            at = low[1] + (i - low[0]) / (high[0] - low[0]) * (high[1] - low[1])
            j = int(min(max(np.ceil(at), 0), n2))
            inside[i, j] = not inside[i, j]
    for i in range(n1):
        for j in range(1, n2):
            inside[i, j] ^= inside[i, j - 1]
    return inside[:, :n2]


@njit(cache=True)
def _crossings(m, counter_clockwise, edges):
    """Where the edges of the triangle `m` (3, 2) pixels cross row i: at edges[k, 0] + edges[k, 1] * i.

    Edges with the triangle at higher columns come first, and their number is returned. edges[k, 2] is the distance
    along the row in which the distance from the edge grows by ON_EDGE.
    """
    n_left, n_right = 0, 0
    for k in range(3):
        a, b = (m[k], m[(k + 1) % 3]) if counter_clockwise else (m[(k + 1) % 3], m[k])
        di, dj = b[0] - a[0], b[1] - a[1]
        length = (di * di + dj * dj) ** 0.5
        if abs(di) < 1e-12 * length:
            di = 1e-12 * length    # an edge along the row, turned by less than rounding
        if di > 0:
            row, n_left = n_left, n_left + 1
        else:
            row, n_right = 2 - n_right, n_right + 1
        edges[row, 1] = dj / di
        edges[row, 0] = a[1] - edges[row, 1] * a[0]
        edges[row, 2] = ON_EDGE * length / abs(di)
    return n_left


@njit(cache=True)
def _rasterise(rest, moved, origin, spacing, n1, n2):
    """`resting`, `count`, `folded`, `triangle` of PullBack, from `rest` and `moved` (t, 3, 2) mm.

    Row by row, each triangle covers what its three edges leave of the row: strictly inside by ON_EDGE it is counted;
    within ON_EDGE of an edge it only claims a pixel that nobody else has.
    """
    resting, triangle = np.full((n1, n2, 2), np.nan), np.full((n1, n2), -1, np.int32)
    count, folded = np.zeros((n1, n2), np.uint16), np.zeros((n1, n2), np.uint16)
    m, edges = np.empty((3, 2)), np.empty((3, 3))
    for c in range(len(rest)):
        r = rest[c]
        for k in range(3):    # the moved corners in pixels
            m[k, 0], m[k, 1] = (moved[c, k, 0] - origin[0]) / spacing[0], (moved[c, k, 1] - origin[1]) / spacing[1]
        ex, ey, fx, fy = m[1, 0] - m[0, 0], m[1, 1] - m[0, 1], m[2, 0] - m[0, 0], m[2, 1] - m[0, 1]
        gx, gy, hx, hy = r[1, 0] - r[0, 0], r[1, 1] - r[0, 1], r[2, 0] - r[0, 0], r[2, 1] - r[0, 1]
        twice = ex * fy - ey * fx
        longest = max(ex * ex + ey * ey, fx * fx + fy * fy, (fx - ex) ** 2 + (fy - ey) ** 2) ** 0.5
        if abs(twice) <= ON_EDGE * longest:
            continue    # too flat to hold a pixel that its neighbours do not claim
        upright = twice * (gx * hy - gy * hx) > 0
        # resting place = r0 + A (x - m0)
        A00, A01 = (gx * fy - hx * ey) / twice, (hx * ex - gx * fx) / twice
        A10, A11 = (gy * fy - hy * ey) / twice, (hy * ex - gy * fx) / twice
        left, right = min(m[0, 1], m[1, 1], m[2, 1]) - ON_EDGE, max(m[0, 1], m[1, 1], m[2, 1]) + ON_EDGE
        first = max(int(np.ceil(min(m[0, 0], m[1, 0], m[2, 0]) - ON_EDGE)), 0)
        last = min(int(np.floor(max(m[0, 0], m[1, 0], m[2, 0]) + ON_EDGE)), n1 - 1)
        if first > last:
            continue
        n_left = _crossings(m, twice > 0, edges)
        # one or two edges on either side; a single one is taken twice, which spares the rows a branch
        a0, a1, a2 = edges[0]
        b0, b1, b2 = edges[n_left - 1]
        c0, c1, c2 = edges[n_left]
        d0, d1, d2 = edges[2]
        for i in range(first, last + 1):
            begin, end, inner_begin, inner_end = max(left, 0.0), min(right, n2 - 1.0), -1.0, float(n2)
            at, other = a0 + a1 * i, b0 + b1 * i
            begin, inner_begin = max(begin, at - a2, other - b2), max(inner_begin, at + a2, other + b2)
            at, other = c0 + c1 * i, d0 + d1 * i
            end, inner_end = min(end, at + c2, other + d2), min(inner_end, at - c2, other - d2)
            start0 = r[0, 0] + A00 * (i - m[0, 0]) - A01 * m[0, 1]
            start1 = r[0, 1] + A10 * (i - m[0, 0]) - A11 * m[0, 1]
            for j in range(int(np.ceil(begin)), int(np.floor(end)) + 1):
                inside = inner_begin < j < inner_end
                if triangle[i, j] < 0 or (inside and upright and count[i, j] == 0):
                    triangle[i, j] = c
                    resting[i, j, 0] = start0 + A01 * j
                    resting[i, j, 1] = start1 + A11 * j
                if inside and upright:
                    count[i, j] += 1
                elif inside:
                    folded[i, j] += 1
    for i in range(n1):
        for j in range(n2):
            if triangle[i, j] >= 0 and count[i, j] == 0 and folded[i, j] == 0:
                count[i, j] = 1    # on an edge
    return resting, count, folded, triangle
