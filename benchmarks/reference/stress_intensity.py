"""Stress intensity factors by the interaction integral with a smooth weight.

Yau, Wang & Corten, J. Appl. Mech. 47 (1980); Moran & Shih, Eng. Fract. Mech. 27 (1987).
"""

import numpy as np
from skfem import Basis, Functional

from benchmarks.reference.elasticity import Model


def williams(x, tip, travel, tissue, K_I, K_II) -> tuple[np.ndarray, np.ndarray]:
    """Displacement (2, ...) and its gradient (2, 2, ...) u_i,j of the singular field at points x (2, ...).

    The tip's frame has its first axis along the crack's travel (2,); the lips are traction-free.
    """
    mu = tissue.lame[1]
    nu = tissue.poisson
    kappa = 3 - 4 * nu if tissue.stress_state == "strain" else (3 - nu) / (1 + nu)
    Q = np.array([[travel[0], travel[1]], [-travel[1], travel[0]]])
    y = np.einsum("ij,j...->i...", Q, x - np.reshape(tip, (2, *[1] * (x.ndim - 1))))
    r, t = np.hypot(*y), np.arctan2(y[1], y[0])
    s, c = np.sin(t / 2), np.cos(t / 2)
    # u = sqrt(r / 2 pi) / (2 mu) g(t)
    g = np.stack(
        [
            K_I * c * (kappa - np.cos(t)) + K_II * s * (kappa + 2 + np.cos(t)),
            K_I * s * (kappa - np.cos(t)) - K_II * c * (kappa - 2 + np.cos(t)),
        ]
    )
    dg = np.stack(
        [
            K_I * (-s / 2 * (kappa - np.cos(t)) + c * np.sin(t))
            + K_II * (c / 2 * (kappa + 2 + np.cos(t)) - s * np.sin(t)),
            K_I * (c / 2 * (kappa - np.cos(t)) + s * np.sin(t))
            - K_II * (-s / 2 * (kappa - 2 + np.cos(t)) - c * np.sin(t)),
        ]
    )
    a = 1 / (2 * mu * np.sqrt(2 * np.pi))
    u = a * np.sqrt(r) * g
    by_r, by_t = a * g / (2 * np.sqrt(r)), a * dg / np.sqrt(r)
    grad = np.stack([np.cos(t) * by_r - np.sin(t) * by_t, np.sin(t) * by_r + np.cos(t) * by_t], axis=1)
    return np.einsum("ai,a...->i...", Q, u), np.einsum("ai,bj,ab...->ij...", Q, Q, grad)


def stress_intensity(model: Model, u, tip, travel, inner: float, outer: float) -> tuple[float, float]:
    """(K_I, K_II) at `tip`: the crack is straight, free of traction and alone within `outer` mm of it.

    The weight q falls from 1 to 0 between the radii `inner` and `outer` as a quintic with two vanishing derivatives.
    """
    tip, travel = np.asarray(tip, float), np.asarray(travel, float)
    travel = travel / np.linalg.norm(travel)
    tissue = model.tissue
    lam, mu = tissue.lame
    radius = np.linalg.norm(model.mesh.p.T - tip, axis=1)[model.mesh.t]
    ring = np.flatnonzero((radius.min(axis=0) < outer) & (radius.max(axis=0) > inner))
    basis = Basis(model.mesh, model.element, elements=ring, intorder=10)

    def stress(grad):
        e = (grad + grad.swapaxes(0, 1)) / 2
        return lam * (e[0, 0] + e[1, 1]) * np.eye(2)[:, :, None, None] + 2 * mu * e

    @Functional
    def interaction(w):
        grad = np.asarray(w["u"].grad)
        x = np.asarray(w.x)
        _, aux = williams(x, tip, travel, tissue, *w["mode"])
        sigma, sigma_aux = stress(grad), stress(aux)
        d = x - tip[:, None, None]
        r = np.hypot(*d)
        s = np.clip((r - inner) / (outer - inner), 0, 1)
        dq = -30 * s**2 * (1 - s) ** 2 / (outer - inner) * d / r
        flux = np.einsum("ij...,ik...,k->j...", sigma, aux, travel)
        flux += np.einsum("ij...,ik...,k->j...", sigma_aux, grad, travel)
        work = np.einsum("ij...,ij...->...", sigma, aux)
        return np.einsum("j...,j...->...", flux, dq) - work * np.einsum("j...,j->...", dq, travel)

    E = tissue.young / (1 - tissue.poisson**2) if tissue.stress_state == "strain" else tissue.young
    field = basis.interpolate(u)
    return tuple(float(interaction.assemble(basis, u=field, mode=mode)) * E / 2 for mode in ((1.0, 0.0), (0.0, 1.0)))
