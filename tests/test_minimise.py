"""The constrained minimum: laws of Signorini's conditions on small random problems, beside a general optimiser."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.sparse import csc_array, csr_array, eye_array

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.conditions.constraints import Contacts, Means
from xfemnav.mechanics.solving.minimise import minimise


def contacts(G, gap):
    g = len(gap)
    return Contacts(csr_array(G), gap, np.zeros(g), np.zeros((g, 2)), np.zeros((g, 3)))


def problem(seed, n=8, g=5):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, n))
    G, gap = csr_array(rng.normal(size=(g, n))), rng.normal(size=g) + 1
    return csc_array(X @ X.T + np.eye(n)), rng.normal(size=n), G, gap


def solved(K, load, G, gap):
    """The minimum, held against all laws: open gaps, pushing forces, one of the two zero, equilibrium."""
    n = K.shape[0]
    found = minimise(K, load, np.zeros(n), eye_array(n, format="csc"), contacts(G, gap))
    opening = G @ found.U + gap
    assert opening.min() >= -1e-9
    assert found.force.min() >= 0
    assert np.abs(opening[found.force > 0]).max(initial=0.0) <= 1e-9
    size = max(1.0, np.abs(load).max(), np.abs(found.force).max())
    assert_allclose(K @ found.U, load + G.T @ found.force, atol=1e-9 * size)
    return found


@pytest.mark.parametrize("seed", range(20))
def test_gaps_stay_open_forces_push_and_one_of_the_two_is_zero(seed):
    solved(*problem(seed))


@pytest.mark.parametrize("seed", range(5))
def test_hundreds_of_conditions_many_of_them_redundant(seed):
    """A membrane over an obstacle, every condition given two to four times, some of them sums of others."""
    rng = np.random.default_rng(seed)
    n = 120
    K = csc_array(2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1) + 1e-4 * np.eye(n))
    once = np.vstack([np.eye(n), (np.eye(n) + np.eye(n, k=1))[:-1]])
    height = 0.3 + 0.2 * np.sin(np.arange(n) / 7.0)
    gap = np.concatenate([height, height[:-1] + height[1:]])  # the sums follow from the nodes' own conditions
    again = rng.integers(0, len(once), 400)
    found = solved(K, -np.full(n, 0.05), csr_array(np.vstack([once, once[again]])), np.concatenate([gap, gap[again]]))
    assert (found.force > 0).sum() > 10


def test_gaps_that_close_to_nothing_do_no_harm():
    """Degenerate: the free minimum touches every condition exactly, so that all forces are zero."""
    K, load, G, _ = problem(4, 30, 60)
    gap = -(G @ np.linalg.solve(K.toarray(), load))
    assert np.abs(solved(K, load, G, gap).force).max() <= 1e-8
    solved(K, 2 * load, G, gap)  # and nearly as many that change sign


def test_what_hangs_on_a_weak_spring_alone_is_stopped_where_it_touches():
    """A load that would carry the body 1e5 mm away closes the gap to rounding of a millimetre, not of 1e5."""
    K = csc_array(np.array([[1.0, -1.0], [-1.0, 1.0 + 1e-5]]))
    found = solved(K, np.array([0.0, 1.0]), csr_array([[-1.0, 0.0]]), np.array([0.5]))
    assert_allclose(found.force, 1.0, rtol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_gaps_are_judged_beside_the_motion(seed):
    """Rounding grows with the displacements: the same problem in micrometres is solved to the same digits."""
    K, load, G, gap = problem(seed, 30, 20)
    once = solved(K, load, G, gap)
    n = K.shape[0]
    large = minimise(K, 1e9 * load, np.zeros(n), eye_array(n, format="csc"), contacts(G, 1e9 * gap))
    assert (once.force > 0).any()
    assert_allclose(large.U / 1e9, once.U, atol=1e-9)


def test_what_hangs_on_springs_moves_on_as_they_give_way():
    """A body pressed onto a floor by one load and drawn along it by another, on a spring of 1e-5: its sway is minus the
    derivative by the logarithm of the spring's stiffness."""
    def along(k):
        K = csc_array(np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) + k * np.diag([1.0, 0.0, 1.0]))
        load, G = np.array([0.0, -1.0, 3e-5]), csr_array([[1.0, 0.0, 0.2]])
        hung = csc_array(np.diag([k, 0.0, k]))
        return minimise(K, load, np.zeros(3), eye_array(3, format="csc"), contacts(G, [0.5]), hung=hung)

    k = 1e-5
    found, more, less = along(k), along(1.001 * k), along(k / 1.001)
    assert found.force > 0
    assert_allclose(found.sway, (less.U - more.U) / np.log(1.001**2), rtol=1e-4, atol=1e-4)
    assert abs(found.sway[2]) > 1


def test_the_minimum_is_the_one_of_a_general_optimiser():
    K, load, G, gap = problem(3)
    found = solved(K, load, G, gap)
    other = minimize(lambda u: u @ (K @ u) / 2 - load @ u, np.zeros(8), jac=lambda u: K @ u - load, method="SLSQP",
                     constraints={"type": "ineq", "fun": lambda u: G @ u + gap}, options={"ftol": 1e-14})
    assert_allclose(found.U, other.x, atol=1e-6)  # SLSQP's own accuracy


def test_repeated_conditions_do_no_harm():
    K, load, G, gap = problem(5)
    twice = solved(K, load, csr_array(np.vstack([G.toarray()] * 2)), np.tile(gap, 2))
    assert_allclose(twice.U, solved(K, load, G, gap).U, atol=1e-8)


def test_a_condition_between_held_unknowns_is_left_out_or_refused():
    """Two unknowns are held; a condition on them alone is met, whatever the third does, or contradicted: E405."""
    K, load = csc_array(np.eye(3)), np.array([0.0, 0.0, -5.0])
    T = csc_array([[0.0], [0.0], [1.0]])
    G = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    held = np.array([2.0, 1.0, 0.0])
    found = minimise(K, load, held, T, contacts(G, np.array([0.0, 0.25])))
    assert_allclose(found.U, [2, 1, -0.25])
    assert_allclose(found.force, [0, 4.75])
    with pytest.raises(XfemnavError, match=r"E405.*0\.5 mm"):
        minimise(K, load, held, T, contacts(G, np.array([-1.5, 0.25])))


def test_an_energy_without_a_minimum_is_refused():
    with pytest.raises(XfemnavError, match="E407"):
        minimise(csc_array(np.diag([1.0, -1.0])), np.ones(2), np.zeros(2), eye_array(2, format="csc"))


@pytest.mark.parametrize("seed", range(5))
def test_a_mean_holds_what_moves_freely(seed):
    """A chain of springs whose ends are free, over obstacles: the mean takes up the resultant of load and contact, and
    the answer is that of the whole saddle-point problem; U0 need not have the mean 0."""
    rng = np.random.default_rng(seed)
    n = 30
    D = np.diff(np.eye(n), axis=0)
    K, load, U0 = csc_array(D.T @ D), rng.normal(size=n), rng.normal(size=n)
    C, G, gap = rng.uniform(0.5, 1.5, (1, n)), csr_array(rng.normal(size=(6, n))), np.full(6, 0.1)
    means = Means(csr_array(C), [int(rng.integers(n))])
    found = minimise(K, load, U0, eye_array(n, format="csc"), contacts(G, gap), means)
    assert np.abs(C @ found.U).max() < 1e-12 and found.residual < 1e-12
    assert (found.force > 0).any() and (G @ found.U + gap).min() > -1e-9
    assert_allclose((G @ found.U + gap)[found.force > 0], 0, atol=1e-9)
    assert_allclose(K @ found.U, load + G.T @ found.force + C.T @ found.mean_force, atol=1e-10 * np.abs(found.U).max())
