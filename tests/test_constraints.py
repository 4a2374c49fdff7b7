"""Conditions C U = d and their exact elimination: satisfied, complete, indifferent to redundancy, deaf to nonsense."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.conditions.constraints import (
    SKULL,
    Constraints,
    eliminate,
    multipliers,
    normal_rows,
    stack,
    vector_rows,
)

# Orthogonal factors of blocks of at most 30 rows with entries of size 1: a few dozen roundings.
EXACT = 1e-12


def random_conditions(rng, n_dof=40, n_rows=15):
    """Consistent conditions: sparse rows, single ones among them, some repeated or combined."""
    C = np.where(rng.random((n_rows, n_dof)) < 0.08, rng.normal(size=(n_rows, n_dof)), 0.0)
    single = rng.random(n_rows) < 0.3
    C[single] = np.eye(n_dof)[rng.integers(0, n_dof, single.sum())] * rng.uniform(0.1, 9, (single.sum(), 1))
    C = np.vstack([C, C[:3] * 5.0, C[3] + C[4], 0.5 * C[5] - C[6]])
    solution = rng.normal(size=n_dof)
    C = C[np.abs(C).sum(axis=1) > 0]
    return Constraints(csr_array(C), C @ solution, np.full(len(C), SKULL)), solution


@settings(derandomize=True, max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_all_solutions_and_only_they(seed):
    constraints, solution = random_conditions(np.random.default_rng(seed))
    U0, T = eliminate(constraints)
    C = constraints.C.toarray()
    scale = np.abs(C).sum(axis=1)
    assert_allclose((C @ U0 - constraints.d) / scale, 0, atol=EXACT * np.abs(U0).max() + EXACT)
    assert np.abs((C @ T.toarray()) / scale[:, None]).max(initial=0) <= EXACT
    # Complete: as many free unknowns as the rank leaves, orthonormal, and the known solution among them.
    assert T.shape[1] == C.shape[1] - np.linalg.matrix_rank(C, tol=1e-9)
    assert_allclose((T.T @ T).toarray(), np.eye(T.shape[1]), atol=EXACT)
    assert_allclose(U0 + T @ (T.T @ (solution - U0)), solution, atol=1e-9)  # blocks may have condition 1e3


def test_conditions_that_contradict_each_other_are_refused():
    C = csr_array(np.array([[1.0, 1, 0], [2, 2, 0], [0, 0, 1]]))
    with pytest.raises(XfemnavError, match=r"E403.*0\.\d+ mm"):
        eliminate(Constraints(C, [1.0, 2.5, 0], [0, 0, 0]))
    eliminate(Constraints(C, [1.0, 2.0, 0], [0, 0, 0]))


def test_one_unknown_held_at_two_values_is_refused():
    C = csr_array(np.array([[1.0, 0], [1.0, 0]]))
    with pytest.raises(XfemnavError, match="E403"):
        eliminate(Constraints(C, [1.0, 1.1], [0, SKULL]))


@pytest.mark.parametrize("rounding", [0.0, 1e-17, 1e-13])
def test_an_impossible_condition_on_fixed_unknowns_is_refused(rounding):
    """A row that acts only on unknowns fixed by others, but for rounding, is a condition on data: met, or refused."""
    C = csr_array(np.array([[1.0, 0, 0], [0, 1.0, 0], [1.0, 1.0, rounding]]))
    eliminate(Constraints(C, [1.0, 2.0, 3.0], [0, 0, 0]))
    with pytest.raises(XfemnavError, match="E403"):
        eliminate(Constraints(C, [1.0, 2.0, 4.0], [0, 0, 0]))


def test_nothing_to_eliminate():
    U0, T = eliminate(stack([], 6))
    assert not U0.any()
    assert_allclose(T.toarray(), np.eye(6))


def test_vector_rows_hold_both_components():
    B = csr_array(np.array([[0.25, 0.75, 0.0], [0.0, 0.0, 1.0]]))
    rows = vector_rows(B, [[1.0, 2.0], [3.0, 4.0]], group=7)
    U = np.arange(6.0).reshape(3, 2)
    assert_allclose(rows.C @ U.ravel(), (B @ U).ravel())
    assert_allclose(rows.d, [1, 2, 3, 4])
    assert_allclose(rows.group, 7)


def test_normal_rows_hold_the_normal_component():
    B = csr_array(np.array([[0.25, 0.75, 0.0], [0.0, 0.0, 1.0]]))
    normals = np.array([[0.6, 0.8], [0.0, -1.0]])
    rows = normal_rows(B, normals, [0.5, 0.0], SKULL)
    U = np.arange(6.0).reshape(3, 2)
    assert_allclose(rows.C @ U.ravel(), np.einsum("ki,ki->k", B @ U, normals))


def test_stacking_keeps_order_and_groups():
    one, two = (vector_rows(csr_array(np.eye(3)[[k]]), [[k, k]], k) for k in (0, 1))
    both = stack([one, two], 6)
    assert_allclose(both.C.toarray(), np.vstack([one.C.toarray(), two.C.toarray()]))
    assert_allclose(both.group, [0, 0, 1, 1])
    assert_allclose(both.d, [0, 0, 1, 1])


def test_multipliers_are_the_forces_of_the_lips():
    rng = np.random.default_rng(3)
    C = rng.normal(size=(6, 9))
    force = rng.normal(size=6)
    constraints = Constraints(csr_array(C), np.zeros(6), [0, 0, 1, 1, SKULL, SKULL])
    found = multipliers(constraints, C.T @ force)
    assert_allclose(found[:4], force[:4], atol=1e-10)  # least squares of a well-conditioned 9 x 6


def test_multipliers_of_repeated_conditions_share_the_force():
    C = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    constraints = Constraints(csr_array(C), np.zeros(2), [0, 0])
    assert_allclose(multipliers(constraints, np.array([3.0, 3.0, 0.0])).sum(), 3.0, atol=EXACT)


def test_conditions_are_checked_for_shape_and_read_only():
    with pytest.raises(ValueError):
        Constraints(csr_array(np.eye(3)), [1.0, 2.0], [0, 0, 0])
    fixed = Constraints(csr_array(np.eye(2)), [1.0, 2.0], [0, 0])
    with pytest.raises(ValueError):
        fixed.d[0] = 5
