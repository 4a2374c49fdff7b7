"""Quadrature on triangles: polynomials exactly, products of branch functions to their stated error."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import orient
from xfemnav.mechanics.space.branch import branch_gradients
from xfemnav.mechanics.space.quadrature import collapsed_rule, tip_rule

UNIT = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
TIP = np.zeros((1, 2))
# A piece spans at most 60 degrees and its radius at most a factor 4 there: 10 Gauss points resolve 1 / cos to 1e-10.
STATED = 1e-9


def monomial(i, j):
    """Integral of x^i y^j over the unit triangle: i! j! / (i + j + 2)!."""
    factorial = np.cumprod([1.0, *range(1, 40)])
    return factorial[i] * factorial[j] / factorial[i + j + 2]


@pytest.mark.parametrize("n", [3, 4, 6])
def test_the_collapsed_rule_is_exact_to_its_degree(n):
    x, w = collapsed_rule(UNIT, n)
    for i in range(2 * n - 1):
        for j in range(2 * n - 1 - i):
            # Sums of n^2 positive terms: rounding only.
            assert_allclose((w * x[..., 0] ** i * x[..., 1] ** j).sum(), monomial(i, j), rtol=1e-13)


def inverse_radius(triangle):
    """Integral of 1/r over a triangle, about its first corner: height times the integral of 1/cos over the angle."""
    a, b, c = triangle
    along = (c - b) / np.linalg.norm(c - b)
    height = along[0] * (b - a)[1] - along[1] * (b - a)[0]
    t0, t1 = (np.arctan((x - a) @ along / abs(height)) for x in (b, c))
    return abs(height) * (np.arctanh(np.sin(t1)) - np.arctanh(np.sin(t0)))


SHAPES = {
    "equilateral": [[0, 0], [1, 0], [0.5, 0.75**0.5]],
    "right": [[0, 0], [1, 0], [0, 1]],
    "wide": [[0, 0], [1, 0], [-0.9, 0.3]],
    "sliver at the tip": [[0, 0], [1, 0], [1, 1e-6]],
    "flat beside the tip": [[0, 0], [1, 1e-3], [-1, 1e-3]],
    "turned": [[0, 0], [-0.3, -1], [0.8, -0.7]],
    "short side": [[0, 0], [1e-3, 0], [0.5, 1]],
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_inverse_radius_at_a_tip(name):
    """1/r is the square of the strains of Eq. (3): the hardest integrand of the stiffness."""
    triangle = np.array([SHAPES[name]], float)
    x, w, _ = tip_rule(triangle, TIP)
    found = (w / np.linalg.norm(x, axis=1)).sum()
    assert_allclose(found, inverse_radius(triangle[0]), rtol=STATED)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("power", [-0.5, 0.5, 1.0, 2.0])
def test_powers_of_the_radius_at_a_tip(name, power):
    """Integral of r^p: the radial part is 1 / (p + 2); the far edge by panels graded to its point nearest the tip."""
    triangle = np.array([SHAPES[name]], float)
    x, w, _ = tip_rule(triangle, TIP)
    _, b, c = triangle[0]
    nearest = np.clip(-(b @ (c - b)) / ((c - b) @ (c - b)), 0, 1)
    step = 0.5 ** np.arange(40)
    ends = np.unique(np.clip([0, 1, nearest, *(nearest + step), *(nearest - step)], 0, 1))
    s, ws = np.polynomial.legendre.leggauss(20)
    low, length = ends[:-1, None], np.diff(ends)[:, None]
    edge = b + (low + length * (s + 1) / 2)[..., None] * (c - b)
    along = (length * ws / 2 * np.linalg.norm(edge, axis=-1) ** power).sum()
    wanted = abs(b[0] * c[1] - b[1] * c[0]) * along / (power + 2)
    assert_allclose((w * np.linalg.norm(x, axis=1) ** power).sum(), wanted, rtol=STATED)


def strain_products(x):
    """All products of derivatives of F_1..F_4 with each other, (q, 64): what the stiffness integrates."""
    r, theta = np.hypot(*x.T), np.arctan2(x[:, 1], x[:, 0])
    g = branch_gradients(r, theta).reshape(-1, 8)
    return (g[:, :, None] * g[:, None, :]).reshape(-1, 64)


triangles = st.tuples(*[st.floats(-1, 1).map(lambda x: round(x, 2)) for _ in range(6)]).map(
    lambda t: np.array(t).reshape(3, 2)
)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(triangle=triangles, where=st.sampled_from(["corner", "near", "far"]), ahead=st.floats(0, 6.28))
def test_the_rule_agrees_with_its_finer_self_on_any_triangle(triangle, where, ahead):
    area = orient(*triangle)
    if abs(area) < 1e-2:
        return
    triangle = triangle if area > 0 else triangle[::-1]
    edge = (triangle[1] - triangle[0]) / np.linalg.norm(triangle[1] - triangle[0])
    outward = np.array([edge[1], -edge[0]])
    shift = {"corner": 0.0, "near": 1e-3, "far": 1.0}[where]
    # The tip at the origin, the triangle at a corner, just beyond an edge, or away from it; the cut runs away from it.
    triangle = triangle - triangle[0] - shift * outward - (0.3 if shift else 0) * (triangle[1] - triangle[0])
    axis = triangle.mean(axis=0) / np.linalg.norm(triangle.mean(axis=0))
    triangle = triangle @ np.array([[axis[0], -axis[1]], [axis[1], axis[0]]])
    (x, w, owner), (xf, wf, _) = tip_rule(triangle[None], TIP), tip_rule(triangle[None], TIP, fine=True)
    assert_allclose(w.sum(), abs(area) / 2, rtol=1e-12)
    assert (owner == 0).all() and (w > 0).all()
    usual, fine = w @ strain_products(x), wf @ strain_products(xf)
    assert_allclose(usual, fine, atol=1e-6 * np.abs(fine).max())  # the accuracy that the stiffness is to have


def test_weights_add_up_triangle_by_triangle():
    rng = np.random.default_rng(1)
    corners = rng.uniform(-1, 1, (200, 3, 2))
    area = orient(*corners.swapaxes(0, 1))
    corners[area < 0] = corners[area < 0][:, ::-1]
    corners = corners[np.abs(area) > 1e-2]
    away = corners - corners.mean(axis=1, keepdims=True) + (5.0, 0.0)
    at_corner = corners - corners[:, [1]]
    mixed = np.concatenate([away, at_corner])
    _, w, owner = tip_rule(mixed, TIP)
    assert_allclose(np.bincount(owner, w), orient(*mixed.swapaxes(0, 1)) / 2, rtol=1e-12)


def test_two_tips_in_one_triangle():
    """Tips at two corners: the integrand has both singularities; compared with the sum over two halves."""
    triangle = np.array([[[0.0, 0.0], [1.0, 0.0], [0.4, 0.8]]])
    tips = np.array([[0.0, 0.0], [1.0, 0.0]])
    x, w, _ = tip_rule(triangle, tips)
    inverse = w @ (1 / np.linalg.norm(x[:, None] - tips, axis=2))
    # Each half has one singularity at its corner and the other a side's length away, where 10 points give 1e-6.
    assert_allclose(inverse, [inverse_radius(triangle[0]), inverse_radius(triangle[0][[1, 2, 0]])], rtol=2e-6)


def test_the_polar_rule_alone():
    """Radius = s^2 makes r^(-1/2) a polynomial: one triangle, and where the far edge is x = 1 it is exact in x."""
    x, w, _ = tip_rule(np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]]), TIP)
    assert len(w) == 60  # at 45 degrees the triangle is not divided: 6 radii, 10 far coordinates
    assert_allclose(w.sum(), 0.5, rtol=1e-14)
    assert_allclose(w @ x[:, 0] ** -0.5, 2 / 3, rtol=1e-13)


@pytest.mark.parametrize("width", [1e-3, 1e-5, 1e-7])
def test_a_needle_beside_a_tip_costs_no_more_for_being_thin(width):
    """The area is right to rounding, and the points grow with the logarithm of the width, not with its inverse."""
    needle = np.array([[[-1.0, width], [1.0, width], [0.0, 2 * width]]])
    points, weights, _ = tip_rule(needle, np.zeros((1, 2)))
    assert weights.sum() == pytest.approx(width, rel=1e-9)
    assert len(points) < 60_000


@pytest.mark.parametrize("tip", [(0.3, 0.0), (0.3, 0.2)])
def test_a_tip_that_is_no_corner_is_refused(tip):
    """On an edge or inside, where no division of the triangle makes it one."""
    with pytest.raises(XfemnavError, match="E407"):
        tip_rule(UNIT, np.array([tip]))
