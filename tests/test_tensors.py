"""Turning vectors and tensors: sizes stay, directions follow the tissue, components keep their order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from xfemnav.imaging.carrying.tensors import components, dyads, in_space, matrices, principal, reoriented, rotations
from xfemnav.imaging.reading.conventions import ORDERS

ROUNDING = 1e-12  # products and eigenvectors of 3 x 3 matrices of size 1: some tens of roundings


def rotation(rng) -> np.ndarray:
    """A random rotation (3, 3)."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q * np.linalg.det(Q)


def tensor(rng, eigenvalues=(3.0, 2.0, 1.0)) -> np.ndarray:
    E = rotation(rng)
    return E @ np.diag(eigenvalues) @ E.T


def gradient(rng) -> np.ndarray:
    """A random deformation gradient (3, 3) that does not turn inside out."""
    return rotation(rng) @ (np.eye(3) + 0.15 * (lambda X: X + X.T)(rng.uniform(-1, 1, (3, 3))))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), eigenvalues=st.tuples(*[st.floats(0, 4)] * 3))
def test_eigenvalues_are_kept(seed, eigenvalues):
    """Also where they are equal or zero."""
    rng = np.random.default_rng(seed)
    D = reoriented(tensor(rng, eigenvalues)[None], gradient(rng)[None])[0]
    assert_allclose(D, D.T, atol=ROUNDING)
    assert_allclose(np.linalg.eigvalsh(D), sorted(eigenvalues), atol=4 * ROUNDING)


@pytest.mark.parametrize("seed", range(5))
def test_a_rotation_rotates_a_tensor(seed):
    rng = np.random.default_rng(seed)
    R, D = rotation(rng), tensor(rng)
    assert_allclose(reoriented(D[None], R[None])[0], R @ D @ R.T, atol=ROUNDING)


@pytest.mark.parametrize("seed", range(5))
def test_the_principal_direction_follows_the_tissue(seed):
    """e1 goes along F e1, and the plane of e1 and e2 goes to the plane of F e1 and F e2."""
    rng = np.random.default_rng(seed)
    D, F = tensor(rng), gradient(rng)
    before, after = np.linalg.eigh(D)[1], np.linalg.eigh(reoriented(D[None], F[None])[0])[1]
    e1, e2 = F @ before[:, 2], F @ before[:, 1]
    assert abs(after[:, 2] @ e1) == pytest.approx(np.linalg.norm(e1), abs=ROUNDING)
    assert after[:, 0] @ e1 == pytest.approx(0, abs=ROUNDING)
    assert after[:, 0] @ e2 == pytest.approx(0, abs=ROUNDING)


@pytest.mark.parametrize("seed", range(5))
def test_the_rotation_is_the_polar_one(seed):
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(40, 2, 2))
    F = F[np.linalg.det(F) > 0.01]
    R = rotations(F)
    stretch = R.swapaxes(1, 2) @ F
    assert_allclose(np.linalg.det(R), 1, atol=ROUNDING)
    assert_allclose(stretch, stretch.swapaxes(1, 2), atol=ROUNDING)
    assert (np.linalg.eigvalsh(stretch) > 0).all()


def test_a_plane_gradient_in_space_leaves_the_normal():
    rng = np.random.default_rng(0)
    axes, F = rotation(rng) * [[1], [1], [-1]], rng.normal(size=(4, 2, 2))    # left-handed, as in coronal slices
    whole = in_space(F, axes)
    assert_allclose(whole @ axes[2], np.tile(axes[2], (4, 1)), atol=ROUNDING)
    assert_allclose(axes[:2] @ whole @ axes[:2].T, F, atol=ROUNDING)


def test_components_have_the_order_of_their_file():
    D = np.array([[1.0, 2, 3], [2, 4, 5], [3, 5, 6]])
    wanted = {"fsl": [1, 2, 3, 4, 5, 6], "mrtrix": [1, 4, 6, 2, 3, 5], "nifti": [1, 2, 4, 3, 5, 6]}
    for name, order in ORDERS.items():
        assert_array_equal(components(D, order), wanted[name])
        assert_array_equal(matrices(components(D, order), order), D)


def test_a_dyad_knows_no_sign_and_no_length():
    rng = np.random.default_rng(3)
    v = rng.normal(size=(5, 3))
    e = v / np.linalg.norm(v, axis=1)[:, None]
    assert_allclose(dyads(v, ORDERS["fsl"]), dyads(-2 * v, ORDERS["fsl"]), atol=ROUNDING)
    found = principal(matrices(dyads(v, ORDERS["fsl"]), ORDERS["fsl"]))
    assert_allclose(abs(np.einsum("ni,ni->n", found, e)), 1, atol=ROUNDING)
    assert_array_equal(dyads(np.zeros(3), ORDERS["fsl"]), np.zeros(6))
