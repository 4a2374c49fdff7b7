"""Factors solve what they were made of, and refuse what has no minimum; both factorisations alike."""

import importlib.util
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csc_array

from tests.meshes import BRAIN, jittered, space_of
from xfemnav.mechanics.solving.factor import NotPositiveDefinite, by_cholmod, by_superlu, factor
from xfemnav.mechanics.tissue.elasticity import Tissue, stiffness

without = pytest.mark.skipif(importlib.util.find_spec("sksparse") is None, reason="the extra cholmod is not installed")
WAYS = [by_superlu, pytest.param(by_cholmod, marks=without), factor]


def held_sheet() -> csc_array:
    """Stiffness of a sheet that is held along its lower edge."""
    mesh = jittered(12.0, 10.0, 1.0, 0.25, seed=4)
    free = np.repeat(mesh.points[:, 1] > 1e-9, 2)
    return csc_array(stiffness(space_of(mesh), BRAIN)[free][:, free])


@pytest.mark.parametrize("way", WAYS)
def test_it_solves_for_one_load_and_for_many(way):
    A = held_sheet()
    found, x = way(A), np.random.default_rng(0).normal(size=(A.shape[0], 3))
    # the condition number of this sheet is about 1e4
    assert_allclose(found.solve(A @ x), x, atol=1e-10)
    assert_allclose(found.solve(A @ x[:, 0]), x[:, 0], atol=1e-10)


@pytest.mark.parametrize("way", WAYS)
def test_what_has_no_minimum_is_refused(way):
    A = held_sheet()
    with pytest.raises(NotPositiveDefinite):
        way(csc_array(A - 2 * A.diagonal().max() * csc_array(np.eye(A.shape[0]))))
    with pytest.raises(NotPositiveDefinite):
        way(csc_array((3, 3)))


@pytest.mark.parametrize("hold", [0, 1, 2])
@pytest.mark.parametrize("way", [*WAYS, partial(by_superlu, semidefinite=True)])
def test_what_can_move_rigidly_is_refused(way, hold):
    mesh = jittered(30.0, 20.0, 0.5, 0.25, seed=4)
    K = csc_array(stiffness(space_of(mesh), BRAIN))
    free = np.delete(np.arange(K.shape[0]), [0, 1][:hold])  # of three rigid motions
    with pytest.raises(NotPositiveDefinite):
        way(K[free][:, free])
    free = np.delete(np.arange(K.shape[0]), [0, 1, 2 * np.argmax(mesh.points[:, 1])])
    way(K[free][:, free])


@pytest.mark.parametrize("way", [*WAYS, partial(by_superlu, semidefinite=True)])
@pytest.mark.parametrize("ratio", [1e6, 1e10])
def test_a_stiff_body_in_soft_tissue_is_no_rigid_motion(way, ratio):
    """It hardly resists being moved, beside what it resists being deformed; but the tissue holds it."""
    mesh = jittered(30.0, 20.0, 0.5, 0.25, seed=4)
    middle = mesh.points[mesh.cells].mean(axis=1)
    young = np.where(np.hypot(*(middle - [15, 10]).T) < 6, 3.0 * ratio, 3.0)
    A = csc_array(stiffness(space_of(mesh), Tissue(young, np.full(len(young), 0.45))))
    free = np.repeat(mesh.points[:, 1] > 1e-9, 2)
    A = A[free][:, free]
    b = np.random.default_rng(1).normal(size=A.shape[0])
    x = way(A).solve(b)
    assert np.linalg.norm(A @ x - b) < 1e-14 * ratio * np.linalg.norm(b)
