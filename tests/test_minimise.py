"""The constrained minimum: laws of Signorini's conditions on small random problems, beside a general optimiser."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.sparse import csc_array, csr_array, eye_array

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.minimise import Contacts, minimise


def problem(seed, n=8, g=5):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, n))
    return csc_array(X @ X.T + np.eye(n)), rng.normal(size=n), csr_array(rng.normal(size=(g, n))), rng.normal(size=g) + 1


@pytest.mark.parametrize("seed", range(20))
def test_gaps_stay_open_pressures_push_and_one_of_the_two_is_zero(seed):
    K, load, G, gap = problem(seed)
    found = minimise(K, load, np.zeros(8), eye_array(8, format="csc"), Contacts(G, gap))
    opening = G @ found.U + gap
    assert opening.min() >= -1e-9
    assert found.force.min() >= 0
    assert abs(found.force @ opening) <= 1e-8
    assert_allclose(K @ found.U, load + G.T @ found.force, atol=1e-9)  # equilibrium with the pressures


def test_the_minimum_is_the_one_of_a_general_optimiser():
    K, load, G, gap = problem(3)
    found = minimise(K, load, np.zeros(8), eye_array(8, format="csc"), Contacts(G, gap))
    other = minimize(lambda u: u @ (K @ u) / 2 - load @ u, np.zeros(8), jac=lambda u: K @ u - load, method="SLSQP",
                     constraints={"type": "ineq", "fun": lambda u: G @ u + gap}, options={"ftol": 1e-14})
    assert_allclose(found.U, other.x, atol=1e-6)  # SLSQP's own accuracy


def test_repeated_conditions_do_no_harm():
    K, load, G, gap = problem(5)
    once = minimise(K, load, np.zeros(8), eye_array(8, format="csc"), Contacts(G, gap))
    twice = Contacts(csr_array(np.vstack([G.toarray()] * 2)), np.tile(gap, 2))
    assert_allclose(minimise(K, load, np.zeros(8), eye_array(8, format="csc"), twice).U, once.U, atol=1e-8)


def test_an_energy_without_a_minimum_is_refused():
    with pytest.raises(XfemnavError, match="E407"):
        minimise(csc_array(np.diag([1.0, -1.0])), np.ones(2), np.zeros(2), eye_array(2, format="csc"))
