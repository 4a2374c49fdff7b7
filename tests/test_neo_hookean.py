"""The neo-Hookean law: derivatives of its energy, rotations cost nothing, Hooke's law for small strains."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize_scalar

from benchmarks.verification import plane
from tests.meshes import turn
from xfemnav.mechanics.tissue.elasticity import Material
from xfemnav.mechanics.tissue.neo_hookean import energy, stress, tangent

STATES = ["strain", "stress"]
RATIOS = [0.0, 0.3, 0.45, 0.499]


def gradients(n=40, seed=0):
    """Deformation gradients (n, 2, 2): stretches .4 to 2.5 in any directions, rotated."""
    rng = np.random.default_rng(seed)
    turns = np.array([turn(a) for a in rng.uniform(0, 2 * np.pi, 2 * n)]).reshape(2, n, 2, 2)
    return np.einsum("qij,qj,qjk->qik", turns[0], np.exp(rng.uniform(np.log(0.4), np.log(2.5), (n, 2))), turns[1])


def constants(nu, state, n=40):
    mu, lam = Material(3.0, nu, state).lame_in(np.zeros(n, int))
    return mu, lam, state == "stress"


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("nu", RATIOS)
def test_stress_and_tangent_are_derivatives(state, nu):
    F, law = gradients(), constants(nu, state)
    step = 1e-6
    for k, unit in enumerate(np.eye(4).reshape(4, 2, 2)):
        there, back = F + step * unit, F - step * unit
        slope = (energy(there, *law) - energy(back, *law)) / (2 * step)
        P = stress(F, *law).reshape(-1, 4)
        # Central differences: third derivatives, up to 1e3 times the stress, times 1e-12, and rounding over 1e-6.
        assert_allclose(slope, P[:, k], atol=1e-7 * np.abs(P).max())
        A = tangent(F, *law)
        change = (stress(there, *law) - stress(back, *law)).reshape(-1, 4) / (2 * step)
        assert_allclose(change, A[:, :, k], atol=1e-7 * np.abs(A).max())
        assert_allclose(A, A.swapaxes(1, 2), rtol=0, atol=1e-12 * np.abs(A).max())


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("nu", RATIOS)
def test_small_strains_are_hookes(state, nu):
    """At F = 1 there is no stress, and the tangent on strains is D: to rounding, times lambda / mu."""
    law, D = constants(nu, state, 1), plane.stiffness(Material(3.0, nu, state))
    still = np.eye(2)[None]
    assert abs(energy(still, *law)[0]) <= 1e-15 * D.max()
    assert np.abs(stress(still, *law)).max() <= 1e-15 * D.max()
    B = np.array([[1.0, 0, 0, 0], [0, 0, 0, 1], [0, 1, 1, 0]])  # the strain of a displacement gradient xx, xy, yx, yy
    assert_allclose(tangent(still, *law)[0], B.T @ D @ B, atol=1e-13 * D.max())


@pytest.mark.parametrize("state", STATES)
def test_a_rotation_costs_nothing(state):
    F, law = gradients(), constants(0.45, state)
    R = turn(1.1)
    assert_allclose(energy(R @ F, *law), energy(F, *law), rtol=1e-12)
    assert_allclose(energy(F @ R, *law), energy(F, *law), rtol=1e-12)  # isotropic
    assert_allclose(stress(R @ F, *law), R @ stress(F, *law), atol=1e-12 * np.abs(stress(F, *law)).max())


@pytest.mark.parametrize("nu", RATIOS)
def test_plane_stress_has_the_thickness_of_least_energy(nu):
    F, law = gradients(8), constants(nu, "stress", 8)
    mu, lam = law[0][0], law[1][0]

    def solid(v, I1, log_det):
        return mu / 2 * (I1 + np.exp(2 * v) - 3 - 2 * (log_det + v)) + lam / 2 * (log_det + v) ** 2

    for each, W in zip(F, energy(F, *law)):
        least = minimize_scalar(solid, args=((each**2).sum(), np.log(np.linalg.det(each))), bounds=(-4, 4))
        assert_allclose(W, least.fun, rtol=1e-8)  # the bounded search's own tolerance, squared
