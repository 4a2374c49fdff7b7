"""Parts of a mesh that level sets cut: every crossed cell is divided function by function, and its parts are told apart
by the sides of the functions that divided them.

Two parts of one cell touch where just one function divides them, on the section of its zero, cut back to the sides of
both by all other functions. Two parts of neighbours touch on the face between, cut back likewise. As a function has one
value at a node, neighbours see the same section of their face, and no node hangs.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from xfemnav.geometry.mesh import Mesh, volumes
from xfemnav.geometry.parts import Faces, Fronts, Lips, Parts, shared
from xfemnav.geometry.solid.levels import Level, crossed, snapped
from xfemnav.geometry.solid.staircase import divide, room, section

ROUNDING = 1e-10  # of a function's largest value in the cell: as much is 0, else parts would be as thin as rounding
SEEN = 1e-8  # of a face: contacts that are smaller are none


class Contacts(NamedTuple):
    """Where parts touch each other and the outside: `pairs` (t, 2), -1 for the outside; `cut` (t,) that lies between,
    -1 for none; facets (g, d, d + 1) in barycentric coordinates of `cell` (t,), and of which contact each is (g,)."""

    pairs: np.ndarray
    cut: np.ndarray
    cell: np.ndarray
    facets: np.ndarray
    of: np.ndarray


def split(mesh: Mesh, cuts: tuple[Level, ...]) -> Parts:
    """Split the cells of a mesh of any dimension by level sets; nothing is dropped for being small."""
    values, phi, bounds = _functions(mesh, cuts)
    active = np.array([crossed(mesh, values[f], values[row[row >= 0]]) for f, row in zip(phi, bounds)], bool)
    active = active.reshape(len(cuts), len(mesh.cells))
    start, sides, lips, simplices, owner = _divided(mesh.cells, values, active, phi, bounds)
    number, cell = _numbered(start)
    corners, part = _corners(mesh, simplices, number[owner], cell)
    removed = np.zeros(len(cell), bool)
    removed[number] = _taken_out(mesh, cuts, values[phi], cell[number], lips)
    plain = ~active.any(axis=0)
    pairs, cut, where, facets, of = _touching(mesh.cells, mesh.neighbours, plain, values, phi, start, sides, lips)
    met = Contacts(np.where(pairs < 0, -1, number[pairs]), cut, where, facets, of)
    met = _with_plain(mesh, plain, met)
    return Parts(corners, part, cell, removed, **_told(mesh, cuts, met, _middles(corners, part), cell, removed))


def _functions(mesh, cuts):
    """All functions, snapped (f, n), and which are each cut's: phi (k,), bounds (k, b), -1 beyond its own."""
    values = np.concatenate([np.empty((0, len(mesh.points))), *(np.vstack([cut.phi, cut.bounds]) for cut in cuts)])
    count = np.array([1 + len(cut.bounds) for cut in cuts], int)
    phi = np.cumsum(count) - count
    place = np.arange(1, count.max(initial=1))
    return snapped(mesh, values), phi, np.where(place < count[:, None], phi[:, None] + place, -1)


def _numbered(start):
    """Number of each part as they were found (p,), a cell's first by the cell, and the cell of each number (p,)."""
    m = len(start) - 1
    found = np.repeat(np.arange(m), np.diff(start))
    further = np.ones(len(found), bool)
    further[start[:-1]] = False
    number = np.empty(len(found), int)
    number[~further], number[further] = np.arange(m), m + np.arange(further.sum())
    return number, np.concatenate([np.arange(m), found[further]])


def _corners(mesh, simplices, part, cell):
    """Corners (s, d + 1, d) mm of the simplices of all parts, positively oriented, and the part of each (s,)."""
    corners = np.einsum("sva,sai->svi", simplices, mesh.corners[cell[part]])
    size = volumes(corners)
    corners[size < 0, -2:] = corners[size < 0, :-3:-1]
    whole = np.ones(len(mesh.cells), bool)
    whole[cell[part]] = False
    solid = size != 0
    return np.concatenate([mesh.corners[whole], corners[solid]]), np.concatenate([np.flatnonzero(whole), part[solid]])


def _taken_out(mesh, cuts, phi, cell, lips):
    """Whether each part (p,), as they were found, is in what is taken out."""
    gone = np.zeros(len(cell), bool)
    for k, cut in enumerate(cuts):
        if cut.takes_out:
            within = (phi[k][mesh.cells] < 0).any(axis=1)
            gone |= np.where(lips[:, k] == 0, within[cell], lips[:, k] < 0)
    return gone


def _middles(corners, part):
    """Middle (p, d) mm of each part."""
    size = volumes(corners)
    moment = corners.mean(axis=1) * size[:, None]
    return np.stack([np.bincount(part, x) for x in moment.T], axis=1) / np.bincount(part, size)[:, None]


def _with_plain(mesh, plain, met):
    """The contacts, and those of cells that no cut passes, which touch on whole faces."""
    over, rows = mesh.neighbours, np.arange(len(plain))[:, None]
    cell, face = np.nonzero(plain[:, None] & ((over < 0) | (over > rows) & plain[over]))
    corners = np.eye(mesh.dim + 1)[[[k for k in range(mesh.dim + 1) if k != f] for f in range(mesh.dim + 1)]]
    return Contacts(np.concatenate([met.pairs, np.stack([cell, over[cell, face]], axis=1)]),
                    np.concatenate([met.cut, np.full(len(cell), -1)]), np.concatenate([met.cell, cell]),
                    np.concatenate([met.facets, corners[face]]),
                    np.concatenate([met.of, len(met.cut) + np.arange(len(cell))]))


def _told(mesh, cuts, met, middle, cell, removed):
    """Joins, lips, rim and walls (see `Parts`) out of the contacts."""
    inner, gone = met.pairs[:, 1] >= 0, removed[met.pairs]
    uneven = inner & (gone[:, 0] != gone[:, 1])
    left = np.where(gone[:, 0] & inner, met.pairs[:, 1], met.pairs[:, 0])
    points = np.einsum("gva,gai->gvi", met.facets, mesh.corners[met.cell[met.of]])
    turned = np.flatnonzero(_turned(points, middle[left[met.of]]))
    points[turned, -2:], met.facets[turned, -2:] = points[turned, :-3:-1], met.facets[turned, :-3:-1]
    joined = np.flatnonzero(inner & (met.cut < 0) & ~uneven)
    first = np.searchsorted(met.of, joined)
    pairs = met.pairs[joined]

    def faces(chosen, source):
        facet = chosen[met.of]
        return Faces(points[facet], left[met.of[facet]], source[met.of[facet]])

    return {"joins": pairs, "through": shared(*mesh.cells[cell[pairs]].swapaxes(0, 1)),
            "middles": points[first].mean(axis=1),
            "lips": _lips(mesh, cuts, met, points, (inner & (met.cut >= 0) & ~gone.any(axis=1))[met.of]),
            "rim": faces(~inner & ~gone[:, 0], np.full(len(met.cut), -1)), "walls": faces(uneven, met.cut),
            "fronts": Fronts([], [], np.empty((0, mesh.dim)), np.empty((0, mesh.dim))), "touch": np.empty((0, 2))}


def _lips(mesh, cuts, met, points, chosen):
    """The facets (g,) that are `chosen`, as lips."""
    contact, shares = met.of[chosen], met.facets[chosen]
    k, nodes = met.cut[contact], mesh.cells[met.cell[contact]]
    columns = max((cut.at.shape[1] for cut in cuts if cut.at is not None), default=mesh.dim - 1)
    at = np.zeros((len(cuts), len(mesh.points), columns))
    for cut, own in zip(cuts, at):
        own[:] = 0 if cut.at is None else cut.at
    return Lips(points[chosen], np.einsum("gva,gak->gvk", shares, at[k[:, None], nodes]), met.pairs[contact], k,
                (shares == 0).any(axis=2))


def _turned(facets, inside):
    """Which facets (g, d, d) mm are not turned as the border of what holds the points `inside` (g, d) mm."""
    return volumes(np.concatenate([inside[:, None], facets], axis=1)) < 0


@njit(cache=True)
def _divided(cells, values, active, phi, bounds):
    """Parts of all cells: where each cell's begin (m + 1,); on which side of which function they were divided off
    (p, f), and of which cut they are on the left, +1, or on the right, -1 (p, k); and of the cells that are `active`
    (k, m) in any cut the simplices (s, d + 1, d + 1), in barycentric coordinates, and the part (s,) of each."""
    m, v = cells.shape
    start = np.zeros(m + 1, np.int64)
    sides, lips = np.zeros((m, len(values)), np.int8), np.zeros((m, len(phi)), np.int8)
    simplices, owner, total = np.empty((m, v, v)), np.empty(m, np.int64), 0
    nodal = np.empty(v)
    for c in range(m):
        first = start[c]
        sides, lips = room(sides, first), room(lips, first)
        sides[first], lips[first] = 0, 0
        work, own, n_parts = np.empty((0, v, v)), np.empty(0, np.int64), 1
        for k in range(len(phi)):
            if not active[k, c]:
                continue
            if len(work) == 0:
                work, own = np.eye(v).reshape(1, v, v), np.zeros(1, np.int64)
            beyond = np.zeros(16, np.bool_)  # parts past a bound, where this cut ends
            for b in range(bounds.shape[1] + 1):
                is_bound = b < bounds.shape[1]
                f = bounds[k, b] if is_bound else phi[k]
                if f < 0:
                    continue
                zero = _nodal(values, f, cells[c], -1, nodal)
                work, own, has, n = _divided_all(work, own, beyond, nodal, zero)
                for p in range(n_parts):
                    if beyond[p]:
                        continue
                    if has[0, p] and has[1, p]:
                        low = first + n_parts
                        sides, lips, beyond = room(sides, low), room(lips, low), room(beyond, n_parts)
                        sides[low], lips[low], beyond[n_parts] = sides[first + p], lips[first + p], False
                        sides[first + p, f], sides[low, f] = 1, -1
                        for s in range(n, len(own)):
                            if own[s] == p:
                                own[s] = n_parts
                        n_parts += 1
                        if not is_bound:
                            lips[first + p, k], lips[low, k] = 1, -1
                    elif not is_bound:
                        lips[first + p, k] = -1 if has[1, p] else 1
                    beyond[p] = is_bound and (has[0, p] or not has[1, p])
        for s in range(len(work)):
            simplices, owner = room(simplices, total), room(owner, total)
            simplices[total], owner[total] = work[s], first + own[s]
            total += 1
        start[c + 1] = first + n_parts
    return start, sides[: start[m]], lips[: start[m]], simplices[:total], owner[:total]


@njit(cache=True)
def _nodal(values, f, nodes, face, nodal):
    """The values of a function at the nodes of a cell, or of a face alone, into `nodal`; and how much of them is 0."""
    largest = 0.0
    for i in range(len(nodes)):
        nodal[i] = 0.0 if i == face else values[f, nodes[i]]
        largest = max(largest, abs(nodal[i]))
    return ROUNDING * largest


@njit(cache=True)
def _at(simplex, nodal, own):
    """A function's values at the corners of a simplex into `own`; and the largest of them."""
    largest = 0.0
    for i in range(len(simplex)):
        own[i] = 0.0
        for j in range(len(nodal)):
            own[i] += simplex[i, j] * nodal[j]
        largest = max(largest, abs(own[i]))
    return largest


@njit(cache=True)
def _divided_all(work, own, beyond, nodal, zero):
    """The simplices of a cell divided by one more function, but for those `beyond`: all above it, then all below; their
    parts as before, which parts have any above and any below (2, p), and how many are above."""
    v = len(nodal)
    above, below = np.empty((2 * len(work), v, v)), np.empty((2 * len(work), v, v))
    part_above, part_below = np.empty(2 * len(work), np.int64), np.empty(2 * len(work), np.int64)
    has, at, n, k = np.zeros((2, len(beyond)), np.bool_), np.empty(v), 0, 0
    for s in range(len(work)):
        was, old, p = n, k, own[s]
        if beyond[p]:
            above = room(above, n)
            above[n] = work[s]
            n += 1
        else:
            flat = _at(work[s], nodal, at) <= zero  # of no volume: it says nothing of its part
            above, n, below, k = divide(work[s], at, zero, above, n, below, k)
            has[0, p] |= n > was and not flat
            has[1, p] |= k > old
        for t in range(was, n):
            part_above = room(part_above, t)
            part_above[t] = p
        for t in range(old, k):
            part_below = room(part_below, t)
            part_below[t] = p
    work, own = np.empty((n + k, v, v)), np.empty(n + k, np.int64)
    work[:n], own[:n] = above[:n], part_above[:n]
    work[n:], own[n:] = below[:k], part_below[:k]
    return work, own, has, n


@njit(cache=True)
def _touching(cells, neighbours, plain, values, phi, start, sides, lips):
    """Contacts (see `Contacts`) of the parts of cells that are not plain, by parts as they were found."""
    m, v = cells.shape
    pairs, cut, where, n = np.empty((m, 2), np.int64), np.empty(m, np.int64), np.empty(m, np.int64), 0
    facets, of, n_facets = np.empty((m, v - 1, v)), np.empty(m, np.int64), 0
    whole, nodal, found = np.eye(v), np.empty(v), np.empty((8, v - 1, v))
    for c in range(m):
        for face in range(-1, v):
            other = c if face < 0 else neighbours[c, face]
            if 0 <= other < c or (plain[c] and (other < 0 or plain[other])):
                continue
            for p in range(start[c], start[c + 1]):
                first, last = (p + 1, start[c + 1]) if face < 0 else (-1, 0)
                if face >= 0 and other >= 0:
                    first, last = start[other], start[other + 1]
                for q in range(first, last):
                    k, f = _between(cells[c], face, values, phi, sides, lips, p, q)
                    if k < -1:
                        continue
                    if face < 0:
                        zero = _nodal(values, f, cells[c], -1, nodal)
                        found, count = section(whole, nodal, zero, found, 0)
                    else:
                        found, count = room(found, 0), 1
                        for i in range(v - 1):
                            found[0, i] = whole[i if i < face else i + 1]
                    full = _size(found, count)
                    found, count = _cut_back(found, count, cells[c], face, values, sides[p], f, nodal)
                    if q >= 0:
                        found, count = _cut_back(found, count, cells[c], face, values, sides[q], f, nodal)
                    if count == 0 or _size(found, count) <= SEEN * full:
                        continue
                    pairs, cut, where = room(pairs, n), room(cut, n), room(where, n)
                    left = k < 0 or lips[p, k] > 0
                    pairs[n, 0], pairs[n, 1], cut[n], where[n] = p if left else q, q if left else p, k, c
                    for g in range(count):
                        facets, of = room(facets, n_facets), room(of, n_facets)
                        facets[n_facets], of[n_facets] = found[g], n
                        n_facets += 1
                    n += 1
    return pairs[:n], cut[:n], where[:n], facets[:n_facets], of[:n_facets]


@njit(cache=True)
def _between(nodes, face, values, phi, sides, lips, p, q):
    """The cut between two parts that may touch, -1 for none and -2 where they can not; and in one cell the function
    that divides them."""
    f, dividing, apart = -1, 0, False
    if q < 0:
        return -1, f
    if face < 0:
        for g in range(len(values)):
            if sides[p, g] * sides[q, g] < 0:
                dividing, f = dividing + 1, g
        if dividing != 1:
            return -2, f
    for j in range(len(phi)):
        if lips[p, j] * lips[q, j] < 0:
            on = True  # the face lies on the cut
            for i in range(len(nodes)):
                on &= face < 0 or i == face or values[phi[j], nodes[i]] == 0
            if on:
                return j, f
            apart = True
    return -2 if apart else -1, f


@njit(cache=True)
def _cut_back(found, count, nodes, face, values, sides, divider, nodal):
    """What is left of facets on the `sides` (f,) of all functions but the divider."""
    own = np.empty(len(nodes) - 1)
    for f in range(len(values)):
        if sides[f] == 0 or f == divider:
            continue
        zero = _nodal(values, f, nodes, face, nodal)
        kept, n, lost = np.empty((2 * count, found.shape[1], found.shape[2])), 0, np.empty_like(found)
        for g in range(count):
            if _at(found[g], nodal, own) <= zero:  # nearly on it, where two functions are nearly one: on one side
                if (own.sum() >= 0) == (sides[f] > 0):
                    kept = room(kept, n)
                    kept[n] = found[g]
                    n += 1
            elif sides[f] > 0:
                kept, n, lost, _ = divide(found[g], own, zero, kept, n, lost, 0)
            else:
                lost, _, kept, n = divide(found[g], own, zero, lost, 0, kept, n)
        found, count = kept, n
    return found, count


@njit(cache=True)
def _size(facets, count):
    """Size of facets (g, d, d + 1) in barycentric coordinates: a face of the cell has the same whichever it is."""
    total = 0.0
    for g in range(count):
        aa = ab = bb = 0.0
        for j in range(facets.shape[2]):
            a = facets[g, 1, j] - facets[g, 0, j]
            b = facets[g, facets.shape[1] - 1, j] - facets[g, 0, j]
            aa, ab, bb = aa + a * a, ab + a * b, bb + b * b
        total += aa**0.5 if facets.shape[1] == 2 else max(aa * bb - ab * ab, 0.0) ** 0.5
    return total
