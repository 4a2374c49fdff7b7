"""The independent reference in space, held against closed forms, and xfemnav against it."""

import numpy as np
import pytest

pytestmark = pytest.mark.slow


def test_linear_displacement_is_exact_on_tetrahedra():
    from skfem import MeshTet

    from benchmarks.reference.mesh import SplitMesh
    from benchmarks.reference.solid import SolidModel

    mesh = MeshTet().refined(2)
    model = SolidModel(SplitMesh(mesh.p.T, mesh.t.T))
    A = np.array([[0.01, 0.02, 0.0], [-0.03, 0.015, 0.01], [0.0, 0.02, -0.01]])
    model.prescribe(model.boundary, lambda x: x @ A.T)
    points = np.random.default_rng(0).uniform(0, 1, (50, 3))
    np.testing.assert_allclose(model.field(model.solve())(points), points @ A.T, atol=1e-9)


def test_front_nodes_stay_whole_and_mouth_nodes_are_doubled():
    from benchmarks.reference.solid import RADIUS, Case, mesh_of

    case = Case("flat")
    mesh = mesh_of(case, 6.0, 2.0, 0.5)
    place, count = np.unique(np.round(mesh.points, 6), axis=0, return_counts=True)
    on = np.abs(case.height(place)) < 1e-6
    on &= (place[:, 2] > case.front_mm - 1e-6) & (np.abs(place[:, 0]) < case.half_mm + 1e-6)
    border = on & ((place[:, 2] < case.front_mm + 1e-6) | (np.abs(place[:, 0]) > case.half_mm - 1e-6))
    mouth = on & ~border & (np.linalg.norm(place, axis=1) > RADIUS - 1e-6)
    assert (count[~on] == 1).all() and (count[border] == 1).all() and (count[on & ~border] == 2).all() and mouth.any()


@pytest.mark.parametrize("bend", [None, 20.0])
def test_an_opened_ball_moves_as_the_reference_says(bend):
    from benchmarks.reference.solid import Case
    from benchmarks.verification import opened_ball

    case = Case("ball", bend_mm=bend)
    field, _ = opened_ball.reference(case, 5.0, 1.6, 0.4)
    _, found = opened_ball.solved(case, 2.0)
    worst, rms = opened_ball.compare(case, found, field).beyond(3.0)
    assert worst < 0.25 and rms < 0.015
