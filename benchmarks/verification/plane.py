"""Strains and stresses of the plane as columns xx, yy, xy, written by themselves: not as the product has them."""

import numpy as np


def stiffness(material) -> np.ndarray:
    """D (3, 3) kPa: stress (xx, yy, xy) from strain (xx, yy, 2 xy), from Young's modulus and Poisson's ratio."""
    E, nu = material.young_kpa, material.poisson
    if material.stress_state == "stress":
        return E / (1 - nu**2) * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
    return E / ((1 + nu) * (1 - 2 * nu)) * np.array([[1 - nu, nu, 0], [nu, 1 - nu, 0], [0, 0, (1 - 2 * nu) / 2]])


def strains(space, U, points, parts) -> np.ndarray:
    """Strain (q, 3) xx, yy, 2 xy of the coefficients U at points (q, 2) mm in parts (q,)."""
    by_x, by_y = (derivative @ np.reshape(U, (-1, 2)) for derivative in space.gradient_in(points, parts))
    return np.stack([by_x[:, 0], by_y[:, 1], by_x[:, 1] + by_y[:, 0]], axis=1)
