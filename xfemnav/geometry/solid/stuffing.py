"""An organ filled with tetrahedra: isosurface stuffing of a graded lattice by a signed distance.

Lattice nodes near the surface are moved onto it, the tetrahedra that it still crosses are cut back to it by stencils,
and bad stars are smoothed (Labelle & Shewchuk 2007). A node is not moved onto the surface where two parts of the organ,
or of the outside, would then touch in it: the boundary is a manifold.
"""

import numpy as np
from numba import njit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import Mesh, area_vectors, volumes
from xfemnav.geometry.solid.field import Field, level
from xfemnav.geometry.solid.lattice import leaves, octree, tetrahedra
from xfemnav.geometry.solid.staircase import COUNT, STEPS
from xfemnav.geometry.solid.stars import shift, smooth, stars

ALONG, ASLANT = 0.25, 0.41  # of a lattice edge along an axis, and of others: nearer to an end, this takes its place
TINY = 1e-6  # mm: as near to the surface a node is on it
FLAT = 0.25  # of the squared slope of a distance, which is 1: where it is less a ridge is near
CRUMB = 50  # cells: a piece of fewer is no tissue


def stuff(field: Field, size, fine_mm: float, coarse_mm: float) -> Mesh:
    """Mesh of where a field is positive, with lattice cells of sides that are at most `size(points (n, 3)) -> (n,)` mm
    (world RAS): powers of two times `fine_mm`, up to `coarse_mm`.

    The same field gives the same mesh to the last bit, and where it lies in the world does not matter. All pieces are
    there that are larger than a few cells. Raises XfemnavError E207 when none is, or sizes are not positive.
    """
    if not 0 < fine_mm <= coarse_mm:
        raise XfemnavError("E207", f"elements of {fine_mm:g} to {coarse_mm:g} mm are none; give sizes above 0")
    own, turn = field.upright()
    tree = octree(own, lambda x: size(field.origin + x @ turn), fine_mm, coarse_mm)
    nodes, cells = tetrahedra(tree, leaves(tree, own))
    points, lattice = _pieces(*_stuffed(own, tree.corner + nodes * (fine_mm / 2), nodes, cells))
    if not len(points):
        raise XfemnavError("E207", f"the organ is nowhere as wide as its elements of {fine_mm:g} to {coarse_mm:g} mm; "
                                   "give a smaller ⟦element_size_mm⟧")
    points = field.origin + _smoothed(own, points, lattice) @ turn
    return Mesh(points, lattice.cells if np.linalg.det(turn) > 0 else lattice.cells[:, [0, 1, 3, 2]])


def _stuffed(field, points, nodes, cells):
    """Points (n, 3) mm, and tetrahedra (m, 4) that fill the organ, of a lattice whose `nodes` (n, 3) are at points; and
    where the points are in the lattice as it was, with its edges cut in the middle."""
    phi = field(points)
    phi[np.abs(phi) < TINY] = TINY
    cells = cells[(phi[cells] > 0).any(axis=1)]
    ends, rest = _crossed(cells, phi), points.copy()
    share = _shares(field.samples, points, phi, ends)
    near = np.where((nodes[ends[:, 0]] != nodes[ends[:, 1]]).sum(axis=1) == 1, ALONG, ASLANT)
    order = np.lexsort((ends[:, 1], ends[:, 0], np.minimum(share, 1 - share)))
    onto = _snap(order, ends, share, near, phi, cells, *stars(cells, len(points)))
    snapped = np.flatnonzero(onto >= 0)
    cut = points[ends[:, 0]] + share[:, None] * (points[ends[:, 1]] - points[ends[:, 0]])
    points[snapped] = cut[onto[snapped]]
    left = (phi[ends] != 0).all(axis=1)
    ends, share = ends[left], np.clip(share, near, 1 - near)[left]  # where an end was not to be moved, it keeps clear
    cut = points[ends[:, 0]] + share[:, None] * (points[ends[:, 1]] - points[ends[:, 0]])
    names = ends @ [len(points), 1]
    found = np.empty((6 * len(cells), 4), np.int64)
    cells = found[: _fill(cells, phi, names, cut, found)].copy()
    return np.concatenate([points, cut]), cells, np.concatenate([rest, rest[ends].mean(axis=1)])


def _crossed(cells, phi):
    """Edges (e, 2) between nodes inside and outside, the smaller number first, sorted."""
    astride = cells[(phi[cells] < 0).any(axis=1)]
    pairs = np.concatenate([astride[:, [a, b]] for a in range(4) for b in range(a)])
    pairs = np.sort(pairs[(phi[pairs] > 0).sum(axis=1) == 1], axis=1)
    return np.stack(np.divmod(np.unique(pairs @ [len(phi), 1]), len(phi)), axis=1)


@njit(cache=True)
def _shares(field, points, phi, ends):
    """How far (e,) from the first of its ends an edge crosses the surface, as a share of its length."""
    found = np.empty(len(ends))
    for e in range(len(ends)):
        a, b = points[ends[e, 0]], points[ends[e, 1]]
        low, high, at_low, at_high = 0.0, 1.0, phi[ends[e, 0]], phi[ends[e, 1]]
        for _ in range(8):  # regula falsi, never nearer to an end than a tenth of what is left
            t = low + (high - low) * min(max(at_low / (at_low - at_high), 0.1), 0.9)
            value = level(field, a + t * (b - a))
            if (value > 0) == (at_low > 0):
                low, at_low = t, value
            else:
                high, at_high = t, value
        found[e] = low + (high - low) * at_low / (at_low - at_high)
    return found


@njit(cache=True)
def _snap(order, ends, share, near, phi, cells, start, star):
    """Set phi (n,) to 0 at nodes that are to be moved onto the surface, those nearest to it first, and return on which
    crossed edge each (n,) is to lie, -1 for none."""
    onto = np.full(len(phi), -1)
    refused = np.zeros(len(phi), np.bool_)
    for e in order:
        v = ends[e, 0] if share[e] <= 0.5 else ends[e, 1]
        if min(share[e], 1 - share[e]) >= near[e] or refused[v] or phi[ends[e, 0]] * phi[ends[e, 1]] == 0:
            continue
        value = phi[v]
        phi[v] = 0.0
        around = star[start[v]:start[v + 1]]
        good = _manifold(v, around, cells, phi)
        for c in around:
            for w in cells[c]:
                if good and w != v and phi[w] == 0:
                    good = _manifold(w, star[start[w]:start[w + 1]], cells, phi)
        if good:
            onto[v] = e
        else:
            phi[v], refused[v] = value, True
    return onto


@njit(cache=True)
def _manifold(v, around, cells, phi):
    """Whether the organ about a node on its surface is half a ball (or all of it, or nothing), and touches itself in
    none of its edges there: in the sphere of the opposite faces what is inside is one piece without holes."""
    nodes, kind, n = np.empty(4 * len(around), np.int64), np.empty(4 * len(around), np.int64), 0
    edges = faces = 0
    for c in around:
        inside = 0
        for w in cells[c]:
            inside += phi[w] > 0
        edges += inside * (inside - 1) // 2
        faces += inside == 3
        for w in cells[c]:
            if w != v and phi[w] >= 0:
                k = 0
                while k < n and nodes[k] != w:
                    k += 1
                if k == n:
                    nodes[n], kind[n] = w, 0
                    n += 1
                if phi[w] == 0:  # twice the arcs that are inside about the edge to w: ends less middles
                    kind[k] += inside - 2 * (inside == 2)
    count = 0
    for k in range(n):
        if phi[nodes[k]] > 0:
            count += 1
        elif kind[k] > 2:
            return False
    # Edges of the sphere are in two faces each.
    return count == 0 or (count - edges // 2 + faces >= 1 and _connected(around, cells, phi, nodes[:n], kind, count))


@njit(cache=True)
def _connected(around, cells, phi, nodes, reached, count):
    """Whether all `count` nodes inside are joined by edges of cells `around`; `reached` is room for marks."""
    first = -1
    for k in range(len(nodes)):
        reached[k] = 0
        if first < 0 and phi[nodes[k]] > 0:
            first = k
    reached[first], n, was = 1, 1, 0
    while n > was:
        was = n
        for c in around:
            joined = False
            for k in range(len(nodes)):
                joined |= reached[k] == 1 and (cells[c] == nodes[k]).any()
            for k in range(len(nodes)):
                if joined and reached[k] == 0 and phi[nodes[k]] > 0 and (cells[c] == nodes[k]).any():
                    reached[k] = 1
                    n += 1
    return n == count


@njit(cache=True)
def _fill(cells, phi, names, cut, found):
    """Put the tetrahedra of the inner parts of cells into `found` and return how many. Crossed edges are called by
    `names`, sorted; their points `cut` come after the nodes."""
    m, order = 0, np.empty((3, 4), np.int64)
    for c in range(len(cells)):
        a = b = z = 0
        for v in cells[c]:
            if phi[v] > 0:
                order[0, a] = v
                a += 1
            elif phi[v] < 0:
                order[1, b] = v
                b += 1
            else:
                order[2, z] = v
                z += 1
        if a == 0:
            continue
        if b == 0:
            found[m] = cells[c]
            m += 1
            continue
        _deepest_first(order[0, :a], phi)
        if a == 2 and b == 2:
            _shorter_diagonal(order, names, cut, len(phi))
        for path in range(COUNT[a, b + 1]):
            for k in range(z):
                found[m, k] = order[2, k]
            for k in range(a + b):
                i, j = STEPS[a, b + 1, path, k]
                found[m, z + k] = order[0, i]
                if j > 0:
                    found[m, z + k] = len(phi) + _crossing(names, order[0, i], order[1, j - 1], len(phi))
            m += 1
    return m


@njit(cache=True)
def _deepest_first(nodes, phi):
    """Sort nodes by their depth: neighbours, who do it too, then divide the quadrilaterals that they share alike."""
    for i in range(len(nodes)):
        for j in range(i + 1, len(nodes)):
            u, v = nodes[i], nodes[j]
            if phi[v] > phi[u] or (phi[v] == phi[u] and v > u):
                nodes[i], nodes[j] = v, u


@njit(cache=True)
def _crossing(names, a, b, n):
    return np.searchsorted(names, min(a, b) * n + max(a, b))


@njit(cache=True)
def _shorter_diagonal(order, names, cut, n):
    """Order the two nodes outside so that the quadrilateral of the surface is divided along its shorter diagonal."""
    p, q = order[0], order[1]
    one = cut[_crossing(names, p[0], q[0], n)] - cut[_crossing(names, p[1], q[1], n)]
    other = cut[_crossing(names, p[0], q[1], n)] - cut[_crossing(names, p[1], q[0], n)]
    if (other**2).sum() < (one**2).sum():
        q[0], q[1] = q[1], q[0]


def _pieces(points, cells, rest):
    """Points (n, 3) mm, without pieces of fewer than CRUMB cells and what no cell has, and the mesh of them in the
    lattice as it was: that orients the cells, and none is flat there or turned over by nodes that moved."""
    _, piece = connected_components(coo_array(
        (np.ones(3 * len(cells), np.int8), (cells[:, :3].ravel(), cells[:, 1:].ravel())), (len(points),) * 2), False)
    of = piece[cells[:, 0]]
    cells = cells[np.bincount(of)[of] >= CRUMB]
    used = np.zeros(len(points), bool)
    used[cells] = True
    points, rest, cells = points[used], rest[used], (np.cumsum(used) - 1)[cells]
    turned = volumes(rest[cells]) < 0
    cells[turned] = cells[turned][:, [0, 1, 3, 2]]
    return points, Mesh(rest, cells)


def _smoothed(field, points, mesh):
    """Points (n, 3) mm after star smoothing, which turns over what is turned over."""
    on_surface = np.zeros(len(points), bool)
    on_surface[mesh.boundary_facets] = True
    reach = np.bincount(mesh.cells.ravel(), np.repeat(mesh.sizes, 4), len(points)) / mesh.valences
    about = stars(mesh.cells, len(points))
    smooth(points, mesh.cells, *about, on_surface, reach, field.samples)
    shift(points, mesh.cells, *about, *_sag(field, points, mesh.boundary_facets))
    return points


def _sag(field, points, facets):
    """Nodes (k,) of the facets (b, 3), and the steps (k, 3) mm off the surface that lay the facets on it in the mean:
    chords lie within what is convex."""
    corners = points[facets]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    within = field(middles.reshape(-1, 3)).reshape(-1, 3).mean(axis=1)  # exact in the mean for a quadratic function
    area = np.linalg.norm(area_vectors(corners), axis=1)
    total = np.bincount(facets.ravel(), np.repeat(area, 3))
    nodes = np.flatnonzero(total)
    sag = np.bincount(facets.ravel(), np.repeat(area * within, 3))[nodes] / total[nodes]
    gradient = field.gradient(points[nodes])
    return nodes, -(sag / np.maximum((gradient**2).sum(axis=1), FLAT))[:, None] * gradient
