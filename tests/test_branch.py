"""The crack-tip functions: Eq. (3), their derivatives, the branch of the angle."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from xfemnav.mechanics.space.branch import branch_functions, branch_gradients, polar

RNG = np.random.default_rng(4)
R = 10 ** RNG.uniform(-3, 2, 300)
THETA = RNG.uniform(-np.pi, np.pi, 300)
LOCAL = np.stack([R * np.cos(THETA), R * np.sin(THETA)], axis=1)


def at(points):
    return np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])


def test_they_are_those_of_the_paper():
    """Eq. (3), written out with other symbols: sqrt(r) {sin t/2, cos t/2, sin t/2 sin t, cos t/2 sin t}."""
    wanted = [
        np.sqrt(R) * np.sin(THETA / 2),
        np.sqrt(R) * np.cos(THETA / 2),
        np.sqrt(R) * np.sin(THETA / 2) * np.sin(THETA),
        np.sqrt(R) * np.cos(THETA / 2) * np.sin(THETA),
    ]
    assert_allclose(branch_functions(R, THETA), np.transpose(wanted), rtol=1e-15)


def test_only_the_first_jumps_across_the_cut():
    r = np.array([0.0, 0.3, 7.0])
    jump = branch_functions(r, np.full(3, np.pi)) - branch_functions(r, np.full(3, -np.pi))
    assert_allclose(jump[:, 0], 2 * np.sqrt(r))
    # sin(pi) is 1.2e-16 in floating point.
    assert_allclose(jump[:, 1:], 0, atol=1e-15)


def test_analytic_derivatives_equal_finite_differences():
    step = 1e-4 * R[:, None]
    stay = np.abs(THETA) < np.pi - 1e-3  # central differences must not straddle the cut
    numeric = np.stack(
        [
            (branch_functions(*at(LOCAL + step * e)) - branch_functions(*at(LOCAL - step * e))) / (2 * step)
            for e in np.eye(2)
        ],
        axis=-1,
    )
    scale = np.sqrt(R)[:, None, None]  # gradients grow as r^-1/2
    # Central differences with a step of 1e-4 r: error about (1e-4)^2 times the third derivative's factor (< 10).
    assert_allclose((branch_gradients(R, THETA) * scale)[stay], (numeric * scale)[stay], atol=1e-7)


def test_derivatives_hold_on_the_lips_themselves():
    """theta = +-pi is on the cut: the one-sided limit is the value just inside the lip."""
    for side in (1, -1):
        on, near = (branch_gradients(np.ones(1), np.array([side * t])) for t in (np.pi, np.pi - 1e-9))
        assert_allclose(on, near, atol=1e-8)  # the angle differs by 1e-9


def test_the_span_holds_williams_field():
    """The mode-I and mode-II displacements near a tip (Williams 1957) are combinations of F_1..F_4."""
    kappa, theta = 1.2, np.linspace(-np.pi, np.pi, 101)
    s, c = np.sin(theta / 2), np.cos(theta / 2)
    F = branch_functions(np.ones_like(theta), theta)
    for u in (
        c * (kappa - 1 + 2 * s**2), s * (kappa + 1 - 2 * c**2), s * (kappa + 1 + 2 * c**2), c * (kappa - 1 - 2 * s**2)
    ):
        coefficients, *_ = np.linalg.lstsq(F, u, rcond=None)
        assert_allclose(F @ coefficients, u, atol=1e-14)


@pytest.mark.parametrize("winding", [-1, 0, 1])
def test_the_angle_is_the_one_nearest_to_its_part(winding):
    travel = np.tile([np.cos(0.7), np.sin(0.7)], (300, 1))
    tip = np.array([[3.0, -2.0]])
    Q = np.array([travel[0], [-travel[0, 1], travel[0, 0]]])
    reference = THETA + 2 * np.pi * winding + RNG.uniform(-3, 3, 300)
    r, theta = polar(LOCAL @ Q + tip, tip, travel, reference)
    # The coordinates (size 100) are rounded when the tip is added: 1e-14 mm, against the smallest r of 1e-3.
    assert_allclose(r, R, rtol=1e-10)
    assert (np.abs(theta - reference) <= np.pi + 1e-12).all()
    assert_allclose(np.exp(1j * theta), np.exp(1j * THETA), atol=1e-10)


def test_a_point_on_a_lip_belongs_to_the_lip_of_its_part():
    behind = np.array([[-2.0, 0.0], [-2.0, 1e-17], [-2.0, -1e-17]])
    for side in (1, -1):
        _, theta = polar(behind, np.zeros((1, 2)), np.tile([1.0, 0.0], (3, 1)), np.full(3, side * 2.0))
        assert_allclose(theta, side * np.pi)
