"""A signed distance on a grid: what is read between its values, wherever the grid lies and however it is stored."""

from itertools import permutations, product

import numpy as np
import pytest
from numpy.testing import assert_allclose

from xfemnav.geometry.solid.field import Field

ROUNDING = 2e-6  # mm: values of 20 mm in single precision
AXES = np.linalg.qr(np.array([[0.9, 0.3, -0.1], [-0.2, 1, 0.3], [0.2, -0.2, 0.9]]))[0] * [[1.0], [1.5], [0.8]]


def tilted(shape=(9, 8, 7)) -> Field:
    """A linear function on an oblique grid: x + 2 y - z - 5."""
    origin = np.array([1.0, -2.0, 3.0])
    points = origin + np.moveaxis(np.indices(shape), 0, -1) @ AXES
    return Field(points @ (1, 2, -1) - 5, origin, AXES)


def test_linear_functions_are_exact_with_their_gradient():
    field = tilted()
    index = np.random.default_rng(0).uniform(1, 5, (50, 3))
    points = field.origin + index @ field.axes
    assert_allclose(field(points), points @ (1, 2, -1) - 5, atol=ROUNDING)
    assert_allclose(field.gradient(points), np.tile((1, 2, -1), (50, 1)), atol=1e-5)


def test_beyond_the_grid_the_border_goes_on():
    field = tilted()
    index = np.array([[-3.0, 2, 2], [4, 90, 2], [8, 7, 6], [20, -1, 9]])
    at = np.clip(index, 0, (8, 7, 6)).astype(int)
    assert_allclose(field(field.origin + index @ field.axes), field.values[tuple(at.T)], atol=ROUNDING)


def test_gradient_is_the_derivative_where_the_field_bends():
    x = np.moveaxis(np.indices((12, 12, 12)), 0, -1) - 5.5
    field = Field(4 - np.linalg.norm(x, axis=-1), -5.5 * np.ones(3), np.eye(3))
    points = np.random.default_rng(1).normal(size=(40, 3))
    points *= 4 / np.linalg.norm(points, axis=1)[:, None]
    # A difference over a step of 1 mm at a radius of 4 mm: to the order of (1/4)^2.
    assert_allclose(field.gradient(points), -points / 4, atol=0.06)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_storage_order_does_not_matter(order):
    """Nor do mirrored axes."""
    field, points = tilted(), np.random.default_rng(2).uniform(-4, 10, (200, 3))
    for flips in product((False, True), repeat=3):
        axes = np.flatnonzero(flips)
        last = np.where(flips, np.array(field.values.shape) - 1, 0)
        signs = np.where(flips, -1, 1)[:, None]
        other = Field(np.flip(field.values, axes).transpose(order), field.origin + last @ field.axes,
                      (signs * field.axes)[list(order)])
        assert_allclose(other(points), field(points), atol=1e-6, rtol=0)
        assert_allclose(other.gradient(points), field.gradient(points), atol=1e-6)


def test_upright_is_the_same_field_turned():
    field = tilted()
    own, turn = field.upright()
    assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
    assert_allclose(own.axes, np.diag(field.spacing), atol=1e-12)
    points = np.random.default_rng(3).uniform(0, 5, (20, 3))
    assert_allclose(own(points), field(field.origin + points @ turn), atol=ROUNDING)


def test_a_field_of_one_layer_is_none():
    with pytest.raises(ValueError, match="two along each axis"):
        Field(np.zeros((4, 1, 4)), np.zeros(3), np.eye(3))
