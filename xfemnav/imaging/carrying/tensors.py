"""Vectors, axes and symmetric tensors in moving tissue: how they turn.

A vector turns with the rotation of the tissue; a diffusion tensor follows its principal direction, and neither
changes its size (preservation of principal direction: Alexander, Pierpaoli, Basser, Gee, IEEE Trans. Med. Imaging 20,
1131-1139, 2001).
"""

import numpy as np


def matrices(components, order) -> np.ndarray:
    """Symmetric matrices (..., 3, 3) of six components (..., 6), whose places (row, column) `order` lists."""
    components = np.asarray(components, float)
    D = np.empty((*components.shape[:-1], 3, 3))
    for c, (i, j) in enumerate(order):
        D[..., i, j] = D[..., j, i] = components[..., c]
    return D


def components(D, order) -> np.ndarray:
    """Six components (..., 6) of symmetric matrices (..., 3, 3), whose places (row, column) `order` lists."""
    return np.stack([D[..., i, j] for i, j in order], axis=-1)


def dyads(vectors, order) -> np.ndarray:
    """Components (..., 6) of e e^T, e the unit vectors along `vectors` (..., 3): the same for e and -e; 0 for 0."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    e = np.divide(vectors, lengths, out=np.zeros(np.shape(vectors)), where=lengths > 0)
    return np.stack([e[..., i] * e[..., j] for i, j in order], axis=-1)


def principal(D) -> np.ndarray:
    """Unit eigenvectors (n, 3) of the largest eigenvalues of symmetric matrices (n, 3, 3); of arbitrary sign."""
    return np.linalg.eigh(D)[1][..., 2]


def rotations(F) -> np.ndarray:
    """Rotation R (n, d, d) of the polar decomposition F = R U of deformation gradients (n, d, d)."""
    F = np.asarray(F, float)
    return {2: _turns, 3: _polar}[F.shape[2]](F)


def _turns(F) -> np.ndarray:
    angle = np.arctan2(F[:, 1, 0] - F[:, 0, 1], F[:, 0, 0] + F[:, 1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)


def _polar(F) -> np.ndarray:
    V, _, W = np.linalg.svd(F)
    V[:, :, 2] *= np.sign(np.linalg.det(V) * np.linalg.det(W))[:, None]  # of tissue inside out, too, no mirroring
    return V @ W


def in_space(F, axes) -> np.ndarray:
    """Gradients (n, d, d) on a grid's axes as gradients (n, 3, 3) in world RAS; `axes` (3, 3) in its rows, of which
    those beyond d stay."""
    whole = np.tile(np.eye(3), (len(F), 1, 1))
    whole[:, :F.shape[2], :F.shape[2]] = F
    return axes.T @ whole @ axes


def reoriented(D, F) -> np.ndarray:
    """Symmetric tensors D (n, 3, 3) in tissue deformed by F (n, 3, 3): eigenvalues kept, principal directions carried.

    The first eigenvector goes along F e1; the second into the plane of F e1 and F e2; the third follows.
    """
    eigenvalues, E = np.linalg.eigh(D)  # ascending
    carried = F @ E
    first = _unit(carried[:, :, 2])
    second = carried[:, :, 1] - np.einsum("ni,ni->n", carried[:, :, 1], first)[:, None] * first
    second = _unit(second)
    N = np.stack([np.cross(first, second), second, first], axis=2)
    return (N * eigenvalues[:, None, :]) @ N.swapaxes(1, 2)


def _unit(vectors) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]
