"""The stiffness matrix, row by row: each basis function gathers the parts that it lives on.

No list of entries is made and sorted: the functions that share a part with one are counted, ordered, and their 2 x 2
blocks added up where they stay. K is symmetric to the last bit, as both of its halves add the same numbers in one
order, so its compressed rows are its compressed columns.
"""

import numpy as np
from numba import njit
from scipy.sparse import csc_array


def assemble(n_rows: int, rows, gradients, lam, mu, tip_rows, tip_blocks) -> csc_array:
    """K (2 n_rows, 2 n_rows) kPa from plain parts and from parts with branch functions.

    rows (k, 3): the basis functions of each plain part, gradients (k, 3, 2) 1/mm on it; lam, mu (k,) kPa mm^2: Lame's
    constants of the plane times its area. tip_rows (b, f): the functions of the parts that have their stiffness in
    tip_blocks (b, 2 f, 2 f) kPa, degree of freedom 2 a + i, each block symmetric; -1 beyond a part's own.
    """
    data, indices, indptr = _compressed(n_rows, rows, gradients, lam, mu, tip_rows, tip_blocks)
    K = csc_array((data, indices, indptr), (2 * n_rows,) * 2)
    K.has_canonical_format = True
    return K


@njit(cache=True)
def _compressed(n_rows, rows, gradients, lam, mu, tip_rows, tip_blocks):
    """Data, row indices and column starts of K."""
    first, uses = _uses(n_rows, rows, tip_rows)
    start = _widths(n_rows, first, uses, rows, tip_rows)
    total = 4 * start[-1]
    indptr, indices, data = np.empty(2 * n_rows + 1, np.int32), np.empty(total, np.int32), np.zeros(total)
    _gather(first, uses, start, rows, gradients, lam, mu, tip_rows, tip_blocks, indptr, indices, data)
    return data, indices, indptr


@njit(cache=True)
def _uses(n_rows, rows, tip_rows):
    """Places where each function is used, `uses[first[r] : first[r + 1]]`: 3 part + local in `rows`, and then the
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
def _widths(n_rows, first, uses, rows, tip_rows):
    """Running sum (n_rows + 1,) of the number of functions that share a part with each one."""
    start, seen = np.zeros(n_rows + 1, np.int64), np.full(n_rows, -1)
    for r in range(n_rows):
        width = 0
        for k in range(first[r], first[r + 1]):
            plain = uses[k] < rows.size
            e = uses[k] // 3 if plain else (uses[k] - rows.size) // tip_rows.shape[1]
            for b in range(3 if plain else tip_rows.shape[1]):
                s = rows[e, b] if plain else tip_rows[e, b]
                if s >= 0 and seen[s] != r:
                    seen[s] = r
                    width += 1
        start[r + 1] = start[r] + width
    return start


@njit(cache=True)
def _gather(first, uses, start, rows, gradients, lam, mu, tip_rows, tip_blocks, indptr, indices, data):
    """Fill the compressed columns 2 r and 2 r + 1 of every function r."""
    seen, place = np.full(len(first) - 1, -1), np.empty(len(first) - 1, np.int64)
    sharing = np.empty(len(first) - 1, np.int64)
    indptr[0] = 0
    for r in range(len(first) - 1):
        width = 0
        for k in range(first[r], first[r + 1]):
            plain = uses[k] < rows.size
            e = uses[k] // 3 if plain else (uses[k] - rows.size) // tip_rows.shape[1]
            for b in range(3 if plain else tip_rows.shape[1]):
                s = rows[e, b] if plain else tip_rows[e, b]
                if s >= 0 and seen[s] != r:
                    seen[s] = r
                    at = width
                    while at > 0 and sharing[at - 1] > s:
                        sharing[at] = sharing[at - 1]
                        at -= 1
                    sharing[at] = s
                    width += 1
        one, two = 4 * start[r], 4 * start[r] + 2 * width
        indptr[2 * r + 1], indptr[2 * r + 2] = two, two + 2 * width
        for k in range(width):
            place[sharing[k]] = 2 * k
            for j in range(2):
                indices[one + 2 * k + j] = indices[two + 2 * k + j] = 2 * sharing[k] + j
        for k in range(first[r], first[r + 1]):
            if uses[k] < rows.size:
                e, a = uses[k] // 3, uses[k] % 3
                x, y, l, m = gradients[e, a, 0], gradients[e, a, 1], lam[e], mu[e]
                for b in range(3):
                    # K_(a i)(b j) = area (lam g_ai g_bj + mu g_aj g_bi + mu g_a.g_b where i = j)
                    u, v, at = gradients[e, b, 0], gradients[e, b, 1], place[rows[e, b]]
                    xu, yv = x * u, y * v
                    both = m * (xu + yv)
                    data[one + at] += l * xu + (m * xu + both)
                    data[one + at + 1] += l * (x * v) + m * (y * u)
                    data[two + at] += l * (y * u) + m * (x * v)
                    data[two + at + 1] += l * yv + (m * yv + both)
            else:
                f = tip_rows.shape[1]
                e, a = (uses[k] - rows.size) // f, (uses[k] - rows.size) % f
                for b in range(f):
                    if tip_rows[e, b] >= 0:
                        at = place[tip_rows[e, b]]
                        for j in range(2):
                            data[one + at + j] += tip_blocks[e, 2 * a, 2 * b + j]
                            data[two + at + j] += tip_blocks[e, 2 * a + 1, 2 * b + j]
