"""Vectors and symmetric tensors in moving tissue: their axes in files, and how they turn.

A vector turns with the rotation of the tissue; a diffusion tensor follows its principal direction, and neither
changes its size (preservation of principal direction: Alexander, Pierpaoli, Basser, Gee, IEEE Trans. Med. Imaging 20,
1131-1139, 2001).
"""

import numpy as np

SYMMETRIC, DISPLACEMENT, VECTOR = 1005, 1006, 1007  # NIfTI's intents
LPS = np.diag([-1.0, -1.0, 1.0])
# Six components of a symmetric tensor by (row, column): NIfTI's own lower triangle (ITK, ANTs), and FSL's order.
LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def world_axes(affine, intent: int, axes: str = "world") -> np.ndarray:
    """The axes (3, 3) in which a file gives vectors, as columns in world RAS: v_RAS = world_axes v_file.

    "world": RAS itself, but LPS for the intents 1005 and 1007, which are ITK's. "image" (FSL): unit vectors along the
    array axes of `affine` (4, 4), the first one reversed where they are right-handed.
    """
    if axes == "world":
        return LPS if intent in (SYMMETRIC, VECTOR) else np.eye(3)
    if axes != "image":
        raise ValueError(f"axes is {axes!r}, wanted world or image")
    U, _, V = np.linalg.svd(affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0))  # the nearest perpendicular axes
    directions = U @ V
    return directions * ([-1, 1, 1] if np.linalg.det(directions) > 0 else [1, 1, 1])


def matrices(components, intent: int) -> np.ndarray:
    """Symmetric matrices (..., 3, 3) of six components (..., 6): xx, xy, yy, xz, yz, zz with the intent 1005 (ITK),
    xx, xy, xz, yy, yz, zz without (FSL)."""
    components = np.asarray(components, float)
    D = np.empty((*components.shape[:-1], 3, 3))
    for c, (i, j) in enumerate(_order(intent)):
        D[..., i, j] = D[..., j, i] = components[..., c]
    return D


def components(D, intent: int) -> np.ndarray:
    """Six components (..., 6) of symmetric matrices (..., 3, 3), in the order of `matrices`."""
    return np.stack([D[..., i, j] for i, j in _order(intent)], axis=-1)


def _order(intent: int):
    return LOWER if intent == SYMMETRIC else UPPER


def rotations(F) -> np.ndarray:
    """Rotation R (n, 2, 2) of the polar decomposition F = R U of deformation gradients (n, 2, 2)."""
    F = np.asarray(F, float)
    angle = np.arctan2(F[:, 1, 0] - F[:, 0, 1], F[:, 0, 0] + F[:, 1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)


def in_space(F, axes) -> np.ndarray:
    """Plane gradients (n, 2, 2) as gradients (n, 3, 3) in world RAS; `axes` (3, 3) rows e1, e2, normal, which stays."""
    whole = np.zeros((len(F), 3, 3))
    whole[:, :2, :2], whole[:, 2, 2] = F, 1
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
