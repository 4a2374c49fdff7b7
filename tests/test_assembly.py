"""The stiffness kernel: the sum of its parts, symmetric to the last bit, in the order that sparse solvers want."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from xfemnav.mechanics.tissue.assembly import assemble

RNG = np.random.default_rng(3)


def dense_sum(n_rows, rows, gradients, lam, mu, tip_rows, blocks):
    """The definition: the weak form's integral on each part, added where its functions are."""
    K = np.zeros((n_rows, 2, n_rows, 2))
    for functions, g, l, m in zip(rows, gradients, lam, mu):
        for a, ga in zip(functions, g):
            for b, gb in zip(functions, g):
                K[a, :, b] += l * np.outer(ga, gb) + m * np.outer(gb, ga) + m * (ga @ gb) * np.eye(2)
    for functions, block in zip(tip_rows, blocks):
        own = np.flatnonzero(functions >= 0)
        for a in own:
            for b in own:
                K[functions[a], :, functions[b]] += block[2 * a : 2 * a + 2, 2 * b : 2 * b + 2]
    return K.reshape(2 * n_rows, 2 * n_rows)


def parts(n_rows=23, n_plain=40, n_tip=5, f=11):
    rows = np.array([RNG.permutation(n_rows)[:3] for _ in range(n_plain)], int).reshape(-1, 3)
    tip_rows = np.array([RNG.permutation(n_rows)[:f] for _ in range(n_tip)], int).reshape(-1, f)
    tip_rows[1::2, f - 4 :] = -1
    blocks = RNG.normal(size=(n_tip, 2 * f, 2 * f))
    lam, mu = RNG.uniform(1, 2, (2, n_plain))
    return n_rows, rows, RNG.normal(size=(n_plain, 3, 2)), lam, mu, tip_rows, blocks + blocks.swapaxes(1, 2)


@pytest.mark.parametrize("counts", [(40, 5), (40, 0), (0, 5), (1, 1)])
def test_the_matrix_is_the_sum_of_its_parts(counts):
    given = parts(n_plain=counts[0], n_tip=counts[1])
    # sums of up to 40 terms of size 10: rounding of 1e-16 each
    assert_allclose(assemble(*given).toarray(), dense_sum(*given), atol=1e-12)


def test_it_is_symmetric_to_the_last_bit_and_sorted_once():
    K = assemble(*parts())
    assert_array_equal(K.toarray(), K.toarray().T)
    for column in range(K.shape[1]):
        assert (np.diff(K.indices[K.indptr[column] : K.indptr[column + 1]]) > 0).all()


def test_a_function_that_lives_nowhere_has_an_empty_column():
    given = list(parts())
    given[0] += 1
    K = assemble(*given)
    assert K.shape == (48, 48) and K.indptr[-1] == K.indptr[-3]
