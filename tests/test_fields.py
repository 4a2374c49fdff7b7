"""Closed-form fields: their gradients are their gradients, they are in equilibrium, and cracks carry no traction."""

from math import pi

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_synthetic.fields import CentreCrack, Linear, Sum, Williams, kolosov, resting, rigid

STATES = ["strain", "stress"]
TIP, AHEAD = (1.0, -2.0), (-0.8, -0.6)


def williams(K_I=1.3, K_II=-0.7, **kwargs):
    return Williams(TIP, AHEAD, K_I, K_II, nu=0.3, mu=2.5, **kwargs)


def crack(**kwargs):
    return CentreCrack((0.8, 0.6), far_stress=(0.3, 1.0, -0.4), a=2.0, centre=TIP, nu=0.3, mu=2.5, **kwargs)


FIELDS = [pytest.param(make(stress_state=state), id=f"{make.__name__}-{state}") for make in (williams, crack)
          for state in STATES]
FIELDS += [pytest.param(Sum(williams(), rigid(0.3, (1, 2), (3, 4))), id="sum")]


def around(n=300, seed=0) -> np.ndarray:
    """Points (n, 2) about the tip, none nearer than .1 to it or to the crack's other end, none on the crack's line."""
    p = np.random.default_rng(seed).uniform(-4, 4, (n, 2))
    p = p[(np.abs(np.linalg.norm(p, axis=1) - 2) > 0.1) & (np.linalg.norm(p, axis=1) > 0.1) & (np.abs(p[:, 1]) > 1e-2)]
    return TIP + p @ np.array([AHEAD, (0.6, -0.8)])


def central(f, points, h=1e-5) -> np.ndarray:
    """Central differences of f(points (n, 2)) -> (n, ...), the derivative's axis last."""
    return np.stack([(f(points + h * e) - f(points - h * e)) / (2 * h) for e in np.eye(2)], axis=-1)


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("side", [0, 1, -1])
def test_the_gradient_is_the_derivative(field, side):
    points = around()
    # truncation h^2 / 6 |u'''| ~ 1e-11 x 1e2 near the ends, rounding 1e-16 / h = 1e-11
    assert_allclose(field.gradient(points, side), central(lambda p: field.displacement(p, side), points), atol=1e-7)


@pytest.mark.parametrize("field", FIELDS[:4])
def test_stress_is_in_equilibrium(field):
    xx, yy, xy = np.moveaxis(central(field.stress, around()), 1, 0)
    assert_allclose(xx[:, 0] + xy[:, 1], 0, atol=1e-5)
    assert_allclose(xy[:, 0] + yy[:, 1], 0, atol=1e-5)


@pytest.mark.parametrize("field", FIELDS[:4])
def test_stress_obeys_hookes_law(field):
    """sigma = 2 mu eps + lambda tr(eps), with lambda = mu (3 - kappa) / (kappa - 1) in both stress states."""
    G = field.gradient(around())
    lame = field.mu * (3 - field.kappa) / (field.kappa - 1)
    stress = field.mu * (G + G.swapaxes(1, 2)) + lame * np.einsum("nii->n", G)[:, None, None] * np.eye(2)
    assert_allclose(field.stress(around()), stress[:, [0, 1, 0], [0, 1, 1]], atol=1e-12)


@pytest.mark.parametrize("field", FIELDS[:4])
@pytest.mark.parametrize("side", [1, -1])
def test_faces_are_free_of_traction(field, side):
    s = np.linspace(0.05, 1.9, 30)
    faces = np.array(TIP) - s[:, None] * AHEAD if isinstance(field, Williams) else TIP + (s - 1)[:, None] * AHEAD
    xx, yy, xy = field.stress(faces, side).T
    n = np.array([0.6, -0.8])
    assert_allclose(np.stack([xx * n[0] + xy * n[1], xy * n[0] + yy * n[1]]), 0, atol=1e-12)


def test_williams_opens_and_slides_by_its_intensities():
    """Jump across the cut at r: (kappa + 1) / mu sqrt(r / 2 pi) (K_II, K_I), left minus right, along and across."""
    field, r = williams(), np.array([0.01, 1.0, 9.0])
    behind = np.array(TIP) - r[:, None] * AHEAD
    jump = field.displacement(behind, 1) - field.displacement(behind, -1)
    size = (field.kappa + 1) / field.mu * np.sqrt(r / (2 * pi))
    assert_allclose(jump @ AHEAD, size * field.K_II, rtol=1e-12)
    assert_allclose(jump @ np.array([0.6, -0.8]), size * field.K_I, rtol=1e-12)


def test_williams_has_the_published_values():
    """PHANTOM: K_I / mu = 1.080907 mm^.5, nu = .45, local (X, Y) -> (uX, uY), printed to four digits."""
    field = Williams((0, 0), (1, 0), K_I=1.080907, nu=0.45)
    points = [(10, 7), (-20, 15), (30, -25), (5, -40)]
    values = [(0.2736, 0.0862), (0.6818, 2.0455), (0.5470, -0.1980), (1.1042, -0.9748)]
    assert_allclose(field.displacement(points), values, atol=6e-5)


def test_a_value_on_the_cut_is_the_limit_from_its_side():
    for field, on in ((williams(), -1.0), (crack(), 0.7)):
        point = TIP + on * np.array([AHEAD])
        left = np.array([0.6, -0.8]) * (1 if isinstance(field, Williams) else -1)
        for side in (1, -1):
            near = field.displacement(point + side * 1e-9 * left)
            assert_allclose(field.displacement(point, side), near, atol=1e-8)
            across = field.displacement(point - side * 1e-9 * left, side)    # a lip met with rounding error
            assert_allclose(across, near, atol=1e-8)


@pytest.mark.parametrize("beta", np.radians([0, 15, 45, 75]))
def test_centre_crack_in_tension(beta):
    """K_I = sigma sqrt(pi a) cos^2 beta, K_II = sigma sqrt(pi a) sin beta cos beta; far away the stress is uniform."""
    field = CentreCrack((np.cos(beta), np.sin(beta)))
    assert_allclose(field.K, np.sqrt(pi) * np.cos(beta) * np.array([np.cos(beta), np.sin(beta)]), atol=1e-15)
    assert_allclose(field.stress([[3e4, 1e4], [0, -2e4]]), [[0, 1, 0]] * 2, atol=1e-8)


def test_centre_crack_looks_like_williams_at_its_tip():
    """The jump near the tip is Williams' but for r / 4a: the next term of the root."""
    whole = crack()
    tip = np.array(TIP) + 2.0 * np.array(whole.direction)
    K_I, K_II = whole.K
    local = Williams(tuple(tip), whole.direction, K_I, K_II, nu=0.3, mu=2.5)
    behind = tip - 1e-4 * np.array([whole.direction])
    jumps = [f.displacement(behind, 1) - f.displacement(behind, -1) for f in (whole, local)]
    assert_allclose(*jumps, rtol=2e-5)


def test_rigid_motion_keeps_lengths():
    field, points = rigid(np.radians(5), (1, 2), (10, -4)), around()
    moved = points + field.displacement(points)
    assert_allclose(np.linalg.norm(moved - [11, -2], axis=1), np.linalg.norm(points - [10, -4], axis=1), rtol=1e-13)
    G = field.gradient(points)
    assert_allclose(np.linalg.det(np.eye(2) + G), 1, rtol=1e-14)


@pytest.mark.parametrize("side", [1, -1])
def test_resting_inverts_each_branch(side):
    field = Williams((0, 0), (1, 0), K_I=0.5, K_II=0.2)
    x = np.random.default_rng(0).uniform(-5, 5, (500, 2)) + np.array([0, 5.05 * side])
    assert_allclose(resting(field, x + field.displacement(x), side), x, atol=1e-9)


def test_resting_is_exact_for_linear_motion():
    field = Linear([[0.01, 0.002], [0, -0.004]], (1, 2))
    points = around()
    assert_allclose(resting(field, points + field.displacement(points)), points, atol=1e-12)


def test_kolosov():
    assert kolosov(0.45) == pytest.approx(1.2)
    assert kolosov(0.25, "stress") == pytest.approx(2.2)
