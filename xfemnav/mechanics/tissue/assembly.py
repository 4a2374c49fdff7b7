"""The stiffness matrix, row by row: each basis function gathers the parts that it lives on.

No list of entries is made and sorted: the functions that share a part with one are counted, ordered, and their d x d
blocks added up where they stay. K is symmetric to the last bit, as both of its halves add the same numbers in one
order, so its compressed rows are its compressed columns.

The kernels know the dimension as the length of a tuple, `axes`, which is a constant when they are compiled.
"""

import numpy as np
from numba import njit
from scipy.sparse import csc_array


def assemble(n_rows: int, rows, gradients, lam, mu, tip_rows, tip_blocks) -> csc_array:
    """K (d n_rows, d n_rows) kPa from plain parts and from parts with branch functions.

    rows (k, d + 1): the basis functions of each plain part, gradients (k, d + 1, d) 1/mm on it; lam, mu (k,) kPa mm^d:
    Lame's constants times its volume. tip_rows (b, f): the functions of the parts that have their stiffness in
    tip_blocks (b, d f, d f) kPa, degree of freedom d a + i, each block symmetric; -1 beyond a part's own.
    """
    axes = tuple(range(gradients.shape[2]))
    data, indices, indptr = _compressed(n_rows, rows, gradients, lam, mu, tip_rows, tip_blocks, axes)
    K = csc_array((data, indices, indptr), (len(axes) * n_rows,) * 2)
    K.has_canonical_format = True
    return K


@njit(cache=True)
def _compressed(n_rows, rows, gradients, lam, mu, tip_rows, tip_blocks, axes):
    """Data, row indices and column starts of K."""
    d = len(axes)
    first, uses = _uses(n_rows, rows, tip_rows)
    start = _widths(n_rows, first, uses, rows, tip_rows, axes)
    total = d * d * start[-1]
    indptr, indices, data = np.empty(d * n_rows + 1, np.int32), np.empty(total, np.int32), np.zeros(total)
    _gather(first, uses, start, rows, gradients, lam, mu, tip_rows, tip_blocks, axes, indptr, indices, data)
    return data, indices, indptr


@njit(cache=True)
def _uses(n_rows, rows, tip_rows):
    """Places where each function is used, `uses[first[r] : first[r + 1]]`: (d + 1) part + local in `rows`, and then the
    places in `tip_rows` after those."""
    first = np.zeros(n_rows + 1, np.int64)
    _count(rows, first)
    _count(tip_rows, first)
    first = np.cumsum(first)
    uses, filled = np.empty(first[-1], np.int64), first[:-1].copy()
    _list(rows, 0, uses, filled)
    _list(tip_rows, rows.size, uses, filled)
    return first, uses


@njit(cache=True)
def _count(table, first):
    for e in range(len(table)):
        for a in range(table.shape[1]):
            if table[e, a] >= 0:
                first[table[e, a] + 1] += 1


@njit(cache=True)
def _list(table, before, uses, filled):
    for e in range(len(table)):
        for a in range(table.shape[1]):
            r = table[e, a]
            if r >= 0:
                uses[filled[r]] = before + e * table.shape[1] + a
                filled[r] += 1


@njit(cache=True)
def _widths(n_rows, first, uses, rows, tip_rows, axes):
    """Running sum (n_rows + 1,) of the number of functions that share a part with each one."""
    corners, start, seen = len(axes) + 1, np.zeros(n_rows + 1, np.int64), np.full(n_rows, -1)
    for r in range(n_rows):
        width = 0
        for k in range(first[r], first[r + 1]):
            plain = uses[k] < rows.size
            e = uses[k] // corners if plain else (uses[k] - rows.size) // tip_rows.shape[1]
            for b in range(corners if plain else tip_rows.shape[1]):
                s = rows[e, b] if plain else tip_rows[e, b]
                if s >= 0 and seen[s] != r:
                    seen[s] = r
                    width += 1
        start[r + 1] = start[r] + width
    return start


@njit(cache=True)
def _gather(first, uses, start, rows, gradients, lam, mu, tip_rows, tip_blocks, axes, indptr, indices, data):
    """Fill the compressed columns d r + i of every function r."""
    seen, place = np.full(len(first) - 1, -1), np.empty(len(first) - 1, np.int64)
    sharing = np.empty(len(first) - 1, np.int64)
    d, corners = len(axes), len(axes) + 1
    indptr[0] = 0
    for r in range(len(first) - 1):
        width = 0
        for k in range(first[r], first[r + 1]):
            plain = uses[k] < rows.size
            e = uses[k] // corners if plain else (uses[k] - rows.size) // tip_rows.shape[1]
            for b in range(corners if plain else tip_rows.shape[1]):
                s = rows[e, b] if plain else tip_rows[e, b]
                if s >= 0 and seen[s] != r:
                    seen[s] = r
                    at = width
                    while at > 0 and sharing[at - 1] > s:
                        sharing[at] = sharing[at - 1]
                        at -= 1
                    sharing[at] = s
                    width += 1
        begin, length = d * d * start[r], d * width
        for i in range(d):
            indptr[d * r + i + 1] = begin + (i + 1) * length
        for k in range(width):
            s, at = sharing[k], begin + d * k
            place[s] = at
            for i in range(d):
                for j in range(d):
                    indices[at + i * length + j] = d * s + j
        for k in range(first[r], first[r + 1]):
            if uses[k] < rows.size:
                e, a = uses[k] // corners, uses[k] % corners
                l, m = lam[e], mu[e]
                for b in range(corners):
                    # K_(a i)(b j) = volume (lam g_ai g_bj + mu g_aj g_bi + mu g_a.g_b where i = j)
                    at, both = place[rows[e, b]], 0.0
                    for i in range(d):
                        both += gradients[e, a, i] * gradients[e, b, i]
                    for i in range(d):
                        x, u = gradients[e, a, i], gradients[e, b, i]
                        data[at + i * length + i] += l * (x * u) + (m * (x * u) + m * both)
                        for j in range(i):
                            y, v = gradients[e, a, j], gradients[e, b, j]
                            data[at + i * length + j] += l * (x * v) + m * (y * u)
                            data[at + j * length + i] += l * (y * u) + m * (x * v)
            else:
                f = tip_rows.shape[1]
                e, a = (uses[k] - rows.size) // f, (uses[k] - rows.size) % f
                for b in range(f):
                    if tip_rows[e, b] >= 0:
                        for i in range(d):
                            for j in range(d):
                                data[place[tip_rows[e, b]] + i * length + j] += tip_blocks[e, d * a + i, d * b + j]
