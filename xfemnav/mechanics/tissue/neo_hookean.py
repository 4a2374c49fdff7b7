"""The compressible neo-Hookean solid in the plane: energy, stress and tangent from the deformation gradient F.

W = mu/2 (I1 - 3 - 2 ln J) + lam/2 (ln J)^2 with I1 = F:F + F33^2 and J = F33 det F. In plane strain F33 = 1; in plane
stress F33 is what leaves no stress across the plane, mu (F33^2 - 1) + lam ln J = 0. Either way the stress is
P = mu F - g F^-T with g a function of ln det F alone: mu - lam ln det F in plane strain, mu F33^2 in plane stress.
To first order this is linear elasticity with the same constants. (Bonet & Wood 2008, Sect. 6.4.)
"""

import numpy as np

#: Newton steps for F33: its equation is convex, and these settle it to rounding for det F in .05 to 20 and any nu.
STEPS = 12


def energy(F, mu, lam, plane_stress: bool) -> np.ndarray:
    """W (q,) kPa of deformation gradients F (q, 2, 2) with det F > 0; Lame's constants (q,) kPa."""
    log_det = np.log(np.linalg.det(F))
    v = _thickening(log_det, mu, lam, plane_stress)
    log_J = log_det + v / 2
    return mu / 2 * ((F**2).sum(axis=(1, 2)) - 2 + np.expm1(v) - 2 * log_J) + lam / 2 * log_J**2


def stress(F, mu, lam, plane_stress: bool) -> np.ndarray:
    """First Piola-Kirchhoff stress P = dW/dF (q, 2, 2) kPa: force per area at rest."""
    g, _ = _pressure(np.log(np.linalg.det(F)), mu, lam, plane_stress)
    return mu[:, None, None] * F - g[:, None, None] * np.linalg.inv(F).swapaxes(1, 2)


def tangent(F, mu, lam, plane_stress: bool) -> np.ndarray:
    """A = dP/dF (q, 4, 4) kPa, symmetric; rows and columns xx, xy, yx, yy of F."""
    g, slope = _pressure(np.log(np.linalg.det(F)), mu, lam, plane_stress)
    inverse = np.linalg.inv(F)
    # d(F^-T) = - F^-T dF^T F^-T and d(ln det F) = F^-T : dF
    A = np.einsum("q,qli,qjk->qijkl", g, inverse, inverse) - np.einsum("q,qji,qlk->qijkl", slope, inverse, inverse)
    return A.reshape(-1, 4, 4) + mu[:, None, None] * np.eye(4)


def _thickening(log_det, mu, lam, plane_stress):
    """v (q,) = ln F33^2."""
    v = np.zeros_like(log_det)
    if plane_stress:
        for _ in range(STEPS):
            v = v - (mu * np.expm1(v) + lam * (log_det + v / 2)) / (mu * np.exp(v) + lam / 2)
    return v


def _pressure(log_det, mu, lam, plane_stress):
    """g and its slope dg / d(ln det F), both (q,) kPa."""
    if not plane_stress:
        return mu - lam * log_det, -lam
    g = mu * np.exp(_thickening(log_det, mu, lam, plane_stress))
    return g, -2 * lam * g / (2 * g + lam)
