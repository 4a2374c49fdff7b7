"""Scanlines through tetrahedra: which of them each voxel of a lattice lies in, and what closed surfaces enclose.

Coordinates are voxels: the voxel (i, j, k) has its centre there. The rules are those of triangles in the plane.
"""

import numpy as np
from numba import njit

from xfemnav.geometry.nearest import cross, dot, minus, triple
from xfemnav.imaging.carrying.lattice import ON_EDGE

ALONG = 1e-10  # slope of a face, per voxel, up to which a scanline runs along it: over a line, far less than ON_EDGE
STILL = 1e-10  # mm that rounding moves what does not move
MOST = 255  # tetrahedra in one voxel that are counted


@njit(cache=True)
def _six_volumes(x):
    """Six times the signed volume of the tetrahedron `x` (4, 3)."""
    a = triple(x[0])
    return dot(cross(minus(triple(x[1]), a), minus(triple(x[2]), a)), minus(triple(x[3]), a))


@njit(cache=True)
def faces_of(x, planes):
    """Write the faces of the tetrahedron `x` (4, 3) to `planes` (4, 4): height over the face opposite corner f is
    planes[f, :3] . p + planes[f, 3]. Returns six times its signed volume, and its least height; 0 where it is flat."""
    a, b, c, d = triple(x[0]), triple(x[1]), triple(x[2]), triple(x[3])
    six, largest = _six_volumes(x), 0.0
    for f, (top, u, v, w) in enumerate(((a, b, c, d), (b, a, c, d), (c, a, b, d), (d, a, b, c))):
        normal = cross(minus(v, u), minus(w, u))
        area = dot(normal, normal) ** 0.5
        if area == 0:
            return 0.0, 0.0
        largest = max(largest, area)
        inward = 1 / area if dot(normal, minus(top, u)) > 0 else -1 / area
        planes[f, 0], planes[f, 1], planes[f, 2] = normal[0] * inward, normal[1] * inward, normal[2] * inward
        planes[f, 3] = -dot(normal, u) * inward
    return six, abs(six) / largest


@njit(cache=True)
def mapped(points, by):
    """Points (t, 4, 3) by an affine map (3, 4). BLAS takes longer to share so little out among threads."""
    found = np.empty(points.shape)
    for c in range(len(points)):
        for k in range(4):
            for i in range(3):
                found[c, k, i] = by[i, 0] * points[c, k, 0] + by[i, 1] * points[c, k, 1] \
                    + by[i, 2] * points[c, k, 2] + by[i, 3]
    return found


@njit(cache=True)
def affine_maps(here, there, own):
    """Maps (t, 3, 4) from places in tetrahedra `here` (t, 4, 3) to places in those `there` (t, 4, 3).

    Of a flat tetrahedron, and of one that is where its place is its `own`, (3, 4), it is that map, to the last bit.
    """
    maps, planes, still = np.empty((len(here), 3, 4)), np.empty((4, 4)), mapped(here, own)
    for c in range(len(here)):
        if faces_of(here[c], planes)[1] == 0 or np.abs(still[c] - there[c]).max() < STILL:
            maps[c] = own
            continue
        maps[c] = 0
        for i in range(3):
            maps[c, i, 3] = there[c, 0, i]
        for f in range(1, 4):
            top = planes[f, 0] * here[c, f, 0] + planes[f, 1] * here[c, f, 1] + planes[f, 2] * here[c, f, 2] \
                + planes[f, 3]
            for i in range(3):
                for k in range(4):
                    maps[c, i, k] += (there[c, f, i] - there[c, 0, i]) * planes[f, k] / top
    return maps


@njit(cache=True)
def _bounds(x, n1, n2, n3):
    """The first and last voxel of the lattice, (2, 3), that `x` (4, 3) may hold."""
    ends = np.empty((2, 3), np.int64)
    for i, n in enumerate((n1, n2, n3)):
        low, high = min(min(x[0, i], x[1, i]), min(x[2, i], x[3, i])), max(max(x[0, i], x[1, i]), max(x[2, i], x[3, i]))
        ends[0, i] = max(int(np.ceil(low - ON_EDGE)), 0)
        ends[1, i] = min(int(np.floor(high + ON_EDGE)), n - 1)
    return ends


@njit(cache=True)
def rasterise(rest, moved, hand, n1, n2, n3):
    """Of tetrahedra at `rest` (t, 4, 3) mm and `moved` (t, 4, 3) voxels: the one that is in each voxel (n1, n2, n3), -1
    for none, how many cover it upright, and how many turned inside out; `hand` is -1 where voxels are left-handed.

    Along each line of voxels a tetrahedron covers what its four faces leave of it: strictly inside by ON_EDGE it is
    counted; within ON_EDGE of a face it only claims a voxel that nobody else has. Where tissue overlaps the first one
    has it; one turned inside out only where there is no other.
    """
    simplex = np.full((n1, n2, n3), -1, np.int32)
    count, folded = np.zeros((n1, n2, n3), np.uint8), np.zeros((n1, n2, n3), np.uint8)
    planes = np.empty((4, 4))
    for c in range(len(moved)):
        (i0, j0, k0), (i1, j1, k1) = _bounds(moved[c], n1, n2, n3)
        if i0 > i1 or j0 > j1 or k0 > k1:
            continue
        six, least = faces_of(moved[c], planes)
        if least <= ON_EDGE:
            continue    # too flat to hold a voxel that its neighbours do not claim
        upright = six * _six_volumes(rest[c]) * hand > 0
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                begin, end, inner_begin, inner_end = float(k0), float(k1), -1.0, float(n3)
                for f in range(4):
                    height, slope = planes[f, 0] * i + planes[f, 1] * j + planes[f, 3], planes[f, 2]
                    if slope > ALONG:
                        begin = max(begin, (-ON_EDGE - height) / slope)
                        inner_begin = max(inner_begin, (ON_EDGE - height) / slope)
                    elif slope < -ALONG:
                        end = min(end, (-ON_EDGE - height) / slope)
                        inner_end = min(inner_end, (ON_EDGE - height) / slope)
                    elif height <= ON_EDGE:
                        inner_end = -1.0
                        end = end if height >= -ON_EDGE else -1.0
                for k in range(int(np.ceil(begin)), int(np.floor(end)) + 1):
                    inside = inner_begin < k < inner_end
                    if simplex[i, j, k] < 0 or (inside and upright and count[i, j, k] == 0):
                        simplex[i, j, k] = c
                    if inside and upright:
                        count[i, j, k] += count[i, j, k] < MOST
                    elif inside:
                        folded[i, j, k] += folded[i, j, k] < MOST
    for i in range(n1):
        for j in range(n2):
            for k in range(n3):
                if simplex[i, j, k] >= 0 and count[i, j, k] == 0 and folded[i, j, k] == 0:
                    count[i, j, k] = 1    # on a face
    return simplex, count, folded


@njit(cache=True)
def places(simplex, wanted, maps, own, start):
    """Places (n, 3) of the `wanted` voxels (m1, m2, m3) bool, by the map of the `simplex` (m1, m2, m3) in each, or by
    their `own` (3, 4) where that is -1; the first one is voxel `start` (3,)."""
    found, n = np.empty((wanted.sum(), 3)), 0
    for i in range(wanted.shape[0]):
        for j in range(wanted.shape[1]):
            for k in range(wanted.shape[2]):
                if wanted[i, j, k]:
                    m = maps[simplex[i, j, k]] if simplex[i, j, k] >= 0 else own
                    x, y, z = i + start[0], j + start[1], k + start[2]
                    for a in range(3):
                        found[n, a] = m[a, 0] * x + m[a, 1] * y + m[a, 2] * z + m[a, 3]
                    n += 1
    return found


@njit(cache=True)
def fill(surface, n1, n2, n3):
    """Voxels (n1, n2, n3) bool that the triangles `surface` (k, 3, 3) voxels enclose an odd number of times.

    Each triangle is cut by the planes of voxels, and each piece turns over the voxels of a line beyond its crossing.
    Triangles that share an edge cut it at the same place, so that no line slips through between them.
    """
    inside, ends = np.zeros((n1, n2, n3 + 1), np.bool_), np.empty((2, 2))
    for c in range(len(surface)):
        x = surface[c]
        low, high = min(x[0, 0], x[1, 0], x[2, 0]), max(x[0, 0], x[1, 0], x[2, 0])
        for i in range(max(int(np.ceil(low)), 0), min(int(np.ceil(high)), n1)):
            found = 0
            for e in range(3):
                a, b = (x[e - 1], x[e]) if x[e - 1, 0] < x[e, 0] else (x[e], x[e - 1])
                if int(np.ceil(a[0])) <= i < int(np.ceil(b[0])):
                    t = (i - a[0]) / (b[0] - a[0])
                    ends[found, 0], ends[found, 1] = a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])
                    found += 1
            p, q = (ends[0], ends[1]) if ends[0, 0] < ends[1, 0] else (ends[1], ends[0])
            for j in range(max(int(np.ceil(p[0])), 0), min(int(np.ceil(q[0])), n2)):
                at = p[1] + (j - p[0]) / (q[0] - p[0]) * (q[1] - p[1])
                k = int(min(max(np.ceil(at), 0), n3))
                inside[i, j, k] = not inside[i, j, k]
    for i in range(n1):
        for j in range(n2):
            for k in range(1, n3):
                inside[i, j, k] ^= inside[i, j, k - 1]
    return inside[:, :, :n3]
