"""Closed-form displacement fields of cracked plates and handbook stress intensity factors.

Lengths mm, stresses kPa, K kPa mm^.5. Signs: K_I > 0 opens, K_II > 0 moves the left lip along the travel.
"""

import numpy as np

from benchmarks.verification import plane
from xfemnav.mechanics.tissue.elasticity import Material


def williams(points, material: Material, K_I: float, K_II: float, above) -> np.ndarray:
    """Leading displacement (n, 2) about a tip at the origin, crack on the negative x axis (Williams 1957).

    above (n,) bool: which lip a point on the crack belongs to.
    """
    x, y = np.asarray(points, float).T
    r, t = np.hypot(x, y), np.arctan2(y, x)
    t = np.where((x < 0) & (np.abs(y) < 1e-12), np.where(above, np.pi, -np.pi), t)
    kappa = material.kappa
    s, c, cos = np.sin(t / 2), np.cos(t / 2), np.cos(t)
    u = np.stack(
        [
            K_I * c * (kappa - cos) + K_II * s * (kappa + 2 + cos),
            K_I * s * (kappa - cos) - K_II * c * (kappa - 2 + cos),
        ],
        axis=1,
    )
    return np.sqrt(r / (2 * np.pi))[:, None] * u / (2 * material.shear_modulus)


def williams_strain(points, material: Material, K_I: float, K_II: float) -> np.ndarray:
    """Strains xx, yy, 2 xy (n, 3) of `williams` at points off the crack, from the field's stresses."""
    x, y = np.asarray(points, float).T
    r, t = np.hypot(x, y), np.arctan2(y, x)
    s, c, s3, c3 = np.sin(t / 2), np.cos(t / 2), np.sin(3 * t / 2), np.cos(3 * t / 2)
    xx = K_I * c * (1 - s * s3) - K_II * s * (2 + c * c3)
    yy = K_I * c * (1 + s * s3) + K_II * s * c * c3
    xy = K_I * c * s * c3 + K_II * c * (1 - s * s3)
    stress = np.stack([xx, yy, xy], axis=1) / np.sqrt(2 * np.pi * r)[:, None]
    return stress @ np.linalg.inv(plane.stiffness(material))


def inclined_crack(points, material: Material, half_length: float, beta: float, tension: float) -> np.ndarray:
    """Displacement (n, 2) of an infinite plate under `tension` along y, with a crack through the origin (Westergaard).

    beta rad: angle of the crack to the x axis. The field is the uniform one plus those of Westergaard's functions
    Z = s (z / sqrt(z^2 - a^2) - 1), in the crack's own axes.
    """
    a, mu, kappa = half_length, material.shear_modulus, material.kappa
    Q = np.array([[np.cos(beta), np.sin(beta)], [-np.sin(beta), np.cos(beta)]])
    p = np.asarray(points, float) @ Q.T
    stress = Q @ np.diag([0.0, tension]) @ Q.T
    strain = np.linalg.solve(plane.stiffness(material), [stress[0, 0], stress[1, 1], stress[0, 1]])
    uniform = p @ np.array([[strain[0], strain[2] / 2], [strain[2] / 2, strain[1]]])
    z = p[:, 0] + 1j * p[:, 1]
    root = np.sqrt(z - a) * np.sqrt(z + a)
    Z, integral = z / root - 1, root - z
    opening = np.stack(
        [(kappa - 1) / 2 * integral.real - p[:, 1] * Z.imag, (kappa + 1) / 2 * integral.imag - p[:, 1] * Z.real], axis=1
    )
    sliding = np.stack(
        [(kappa + 1) / 2 * integral.imag + p[:, 1] * Z.real, (1 - kappa) / 2 * integral.real - p[:, 1] * Z.imag], axis=1
    )
    u = uniform + (stress[1, 1] * opening + stress[0, 1] * sliding) / (2 * mu)
    return u @ Q


def inclined_crack_factors(half_length: float, beta: float, tension: float) -> tuple[float, float]:
    """(K_I, K_II) of `inclined_crack` at the tip at angle beta."""
    k = tension * np.sqrt(np.pi * half_length)
    return k * np.cos(beta) ** 2, k * np.sin(beta) * np.cos(beta)


def arc_crack_factors(radius: float, half_angle: float, tension: float) -> tuple[float, float]:
    """(K_I, |K_II|) of a circular arc crack in an infinite plate, tension along the arc's axis of symmetry.

    Cotterell & Rice, Int. J. Fract. 16 (1980); half_angle rad is half the angle of the arc.
    """
    k = tension / 2 * np.sqrt(np.pi * radius * np.sin(half_angle))
    s, c = np.sin(half_angle / 2), np.cos(half_angle / 2)
    common = (1 - s**2 * c**2) / (1 + s**2)
    return k * (common * c + np.cos(3 * half_angle / 2)), k * (common * s + np.sin(3 * half_angle / 2))
