"""Resected tissue moves nowhere and holds nothing; what is cut free is refused, removed, or held at its mean."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array

from tests.meshes import BRAIN, cut_in, jittered, outline, posed
from tests.test_resection import box, circle
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.geometry.plane.resection import place_resection
from xfemnav.imaging.carrying.warp import covered, enclosed, pull_back, update
from xfemnav.mechanics.conditions import bodies as pieces
from xfemnav.mechanics.conditions.constraints import vector_rows
from xfemnav.mechanics.conditions.lips import Retraction, lip_quadrature
from xfemnav.mechanics.rules import Arc, Gravity, Skull
from xfemnav.mechanics.solving.solution import solve

MESH = jittered(12.0, 10.0, 1.0, 0.25, seed=25)
SKULL = Skull("fixed", 2.0, 1.0)
OPEN = tuple(Retraction(0, side, normal_mm=0.2, blade=(0.0, 0.5)) for side in (1, -1))


def taken(*rings, name="tumour"):
    return (place_resection(rings, outline(MESH), name),)


CORNER = cut_in(MESH, (-1, 3.1), (4.1, -1), name="approach")  # frees the corner, where the skull is open
RING = taken(circle(6, 5, 3), circle(6, 5, 1.5))  # frees the disc inside


@pytest.mark.parametrize("rings", [(circle(6, 5, 2),), (circle(0, 0, 3),), (box(4, -1, 7, 11),)])
def test_at_rest_the_cavity_is_the_region_taken_out(rings):
    """Nothing moves: the image's cavity has the region's area, also at the surface; pixels of .02 mm."""
    solution = solve(posed(MESH, (), BRAIN, SKULL, resections=taken(*rings)))
    assert np.abs(solution.U).max() == 0
    grid = np.array([-0.99, -0.99]), np.array([0.02, 0.02]), (700, 600)
    back = pull_back(solution.rest, solution.moved, *grid)
    organ, now = covered(MESH.corners, *grid), enclosed(solution.outline, *grid)
    image = update(np.ones(grid[2]), organ, back, now=now)
    # A pixel is in by its centre: the error is a part of the boundary's pixels.
    (placed,) = taken(*rings)
    assert abs(image.cavity.sum() * 4e-4 - placed.area_mm2) < 0.02 * placed.region.length / 4
    assert not image.vacated.any()


def test_the_outline_goes_on_across_a_notch():
    cut = cut_in(MESH, (-1, 5), (6, 5))
    solution = solve(posed(MESH, (cut,), BRAIN, SKULL, resections=taken(circle(0, 0, 3))))
    x, y = solution.outline.T
    assert_allclose(((x * np.roll(y, -1) - y * np.roll(x, -1)) / 2).sum(), MESH.volumes.sum(), rtol=1e-12)


def test_a_cut_through_a_resection_opens_what_is_left_of_it():
    """A blade that reaches over the cavity holds both ends of the cut that are left, as prescribed."""
    cut, hole = cut_in(MESH, (-1, 5), (10, 5.2)), taken(circle(5, 5, 1.2))
    blade = (0.1, 0.7)
    held = tuple(Retraction(0, side, normal_mm=0.2, blade=blade) for side in (1, -1))
    problem = posed(MESH, (cut,), BRAIN, SKULL, held, resections=hole)
    assert_allclose(problem.spans, np.tile(np.array(blade) * cut.length, (2, 1)), rtol=1e-3)
    solution = solve(problem)
    for side, span in zip((1, -1), problem.spans):
        q = lip_quadrature(problem.space, 0, side, span)
        assert q.weights.sum() < (span[1] - span[0]) - 2.3  # the hole is 2.4 mm wide
        u = np.einsum("qi,qi->q", problem.space.basis_in(q.points, q.parts) @ solution.U, q.normals)
        # The hats add up to one, so the mean over the lip is exact.
        assert_allclose(q.weights @ u / q.weights.sum(), 0.2 * side, rtol=1e-9)
    assert not problem.removed[solution.part].any()


def test_a_force_is_spread_over_the_lip_that_is_left():
    """The reaction of all conditions balances the whole force, though a part of the blade's lip is gone."""
    cut, hole = cut_in(MESH, (-1, 5), (10, 5.2)), taken(circle(5, 5, 1.2))
    force = Retraction(0, 1, force_mN_per_mm=(0.3, 1.0), blade=(0.1, 0.7))
    problem = posed(MESH, (cut,), BRAIN, SKULL, (force,), resections=hole)
    assert_allclose(problem.load.reshape(-1, 2)[problem.enrichment.kind < 2].sum(axis=0), (0.3, 1.0), rtol=1e-12)


@pytest.mark.parametrize("blade", [(0.3, 0.5), (0.0, 0.9)])
def test_a_blade_without_tissue_is_refused(blade):
    cut = cut_in(MESH, (-1, 5), (10, 5.2))
    hole = taken(box(2, 4, 6, 6)) if blade[0] else taken(box(-1, 4, 11, 6))
    with pytest.raises(XfemnavError, match="E402"):
        posed(MESH, (cut,), BRAIN, SKULL, (Retraction(0, 1, normal_mm=0.2, blade=blade),), resections=hole)


def test_a_freed_piece_is_refused_by_name():
    with pytest.raises(XfemnavError, match=r"E306 resection 'tumour' frees .* \(\d+\.\d, \d+\.\d\) mm"):
        posed(MESH, (), BRAIN, SKULL, resections=RING)
    with pytest.raises(XfemnavError, match="E306 cut 'approach' frees"):
        posed(MESH, (CORNER,), BRAIN, Skull("fixed", 9.0, 1.0))


def test_a_freed_piece_is_removed_when_asked():
    with pytest.warns(XfemnavWarning, match="W312"):
        problem = posed(MESH, (), BRAIN, SKULL, resections=RING, loose="remove")
    whole = posed(MESH, (), BRAIN, SKULL, resections=taken(circle(6, 5, 3)))
    assert [piece.fate for piece in problem.pieces] == ["fixed", "removed"]
    assert_allclose(problem.pieces[1].area_mm2, shapely_area(1.5), rtol=1e-3)
    assert_allclose(solve(problem).rest_areas.sum(), solve(whole).rest_areas.sum(), rtol=1e-4)


def shapely_area(radius, n=40):
    return n / 2 * radius**2 * np.sin(2 * np.pi / n)


def rigid_part(solution, own, about):
    """Mean displacement (2,) mm and mean rotation of triangles (t,) bool, and their displacements (k, 3, 2) mm."""
    u, x = solution.moved[own] - solution.rest[own], solution.rest[own] - about
    # The mean of a product of linear functions on a triangle: its corners' and its middle's, weighted 1 : 9.
    f = np.concatenate([u, u.mean(axis=1, keepdims=True)], axis=1)
    y = np.concatenate([x, x.mean(axis=1, keepdims=True)], axis=1)
    w = solution.rest_areas[own, None] / 12 * np.array([1, 1, 1, 9])
    turn = (w * (y[..., 0] * f[..., 1] - y[..., 1] * f[..., 0])).sum() / (w * (y**2).sum(axis=2)).sum()
    return (w[..., None] * f).sum(axis=(0, 1)) / w.sum(), turn, u


@pytest.mark.parametrize("n", [1.0, 0.25])
def test_a_freed_piece_is_held_at_its_mean(n):
    """The means take gravity's resultant up where it acts: the piece neither moves nor turns, nor does it deform."""
    mesh = jittered(12.0, 10.0, n, 0.25, seed=25)
    ring = (place_resection([circle(6, 5, 4), circle(6, 5, 2.5)], outline(mesh)),)
    with pytest.warns(XfemnavWarning, match="W313"):
        problem = posed(mesh, (), BRAIN, SKULL, resections=ring, loose="hold", gravity=Gravity((0.6, -0.8)))
    assert [piece.fate for piece in problem.pieces] == ["fixed", "held"]
    solution = solve(problem)
    own = np.linalg.norm(solution.rest.mean(axis=1) - (6, 5), axis=1) < 3
    mean, turn, u = rigid_part(solution, own, (6, 5))
    assert solution.residual < 1e-8 and solution.max_displacement_mm > 1e-3
    assert max(np.abs(mean).max(), abs(turn), np.abs(u).max()) < 1e-12


BOTTOM = Skull("free", 0.0, 0.0, arcs=(Arc((0.0, 0.0), (12.0, 0.0), "fixed"),))


def pushed(n, model="linear"):
    """A rectangle cut right through, its larger, lower part fixed; its lip is pushed into the upper one, which is held
    at its mean."""
    mesh = jittered(12.0, 10.0, n, 0.25, seed=25)
    cut = cut_in(mesh, (-1, 6.03), (13, 6.03))
    blade = Retraction(0, -1, displacement_mm=(0.05, 0.3), blade=(0.3, 0.6))
    with pytest.warns(XfemnavWarning, match="W313"):
        problem = posed(mesh, (cut,), BRAIN, BOTTOM, (blade,), loose="hold", gravity=Gravity((0.6, -0.8)), model=model)
    return problem, solve(problem)


def upper(solution):
    own = solution.rest.mean(axis=1)[:, 1] > 6.03
    return rigid_part(solution, own, (6, 8))


def test_what_a_held_piece_does_under_a_push_is_that_of_the_tissue_not_of_the_mesh():
    (_, coarse), (problem, fine) = pushed(0.25), pushed(0.125)
    sizes = []
    for solution in (coarse, fine):
        mean, turn, u = upper(solution)
        assert solution.residual < 1e-8 and solution.contact and solution.min_gap_mm > -1e-9
        assert max(np.abs(mean).max(), abs(turn)) < 1e-9
        sizes.append(np.ptp(u.reshape(-1, 2), axis=0))
    assert (np.unique(problem.enrichment.dof[problem.enrichment.body == 1]).size) > 3000
    assert_allclose(*sizes, rtol=0.1)  # the pressure peaks at the blade's ends, where meshes differ


def test_only_what_nothing_holds_is_held_at_its_mean():
    """A piece that slides along the skull above: one mean. Neither means nor contacts, which are zero, do any work: the
    blade does it all (Clapeyron)."""
    mesh = jittered(12.0, 10.0, 0.5, 0.25, seed=25)
    cut = cut_in(mesh, (-1, 6.03), (13, 6.63))
    skull = Skull("free", 0.0, 0.0, arcs=(*BOTTOM.arcs, Arc((12.0, 10.0), (0.0, 10.0), "sliding")))
    blade = Retraction(0, -1, displacement_mm=(0.05, 0.3), blade=(0.3, 0.6))
    with pytest.warns(XfemnavWarning, match="W313"):
        problem = posed(mesh, (cut,), BRAIN, skull, (blade,), loose="hold")
    assert problem.means.C.shape[0] == 1
    solution = solve(problem)
    U = solution.U.ravel()
    assert np.abs(problem.means.C @ U).max() < 1e-12 and solution.contact
    work = np.dot(solution.retractor[0].force_mN_per_mm, (0.05, 0.3))
    assert_allclose(work, 2 * solution.energy + U @ (problem.springs @ U), rtol=1e-8)


def test_what_holds_a_piece_is_no_force_of_its_blade(monkeypatch):
    """A blade that is taken to be too short to keep the piece from turning leaves that to the mean: blade and weight do
    all the work."""
    monkeypatch.setattr(pieces, "FREE_MOTION", 0.1)
    mesh = jittered(12.0, 10.0, 0.5, 0.25, seed=25)
    cut = cut_in(mesh, (-1, 6.03), (13, 6.03))
    blade = Retraction(0, 1, displacement_mm=(0.05, 0.3), blade=(0.2, 0.3))
    with pytest.warns(XfemnavWarning, match="W313"):
        problem = posed(mesh, (cut,), BRAIN, BOTTOM, (blade,), loose="hold", gravity=Gravity((0.6, -0.8)))
    assert 0 < problem.means.C.shape[0] < 3
    solution = solve(problem)
    U = solution.U.ravel()
    assert not solution.contact and np.abs(problem.means.C @ U).max() < 1e-12
    work = np.dot(solution.retractor[0].force_mN_per_mm, (0.05, 0.3))
    assert_allclose(work, 2 * solution.energy + U @ (problem.springs @ U) - problem.load @ U, rtol=1e-8)


def test_neo_hookean_pieces_are_held_at_their_mean_too():
    _, solution = pushed(0.5, model="neo-hookean")
    mean, turn, u = upper(solution)
    assert solution.residual < 1e-8 and np.abs(u).max() > 1e-3
    assert max(np.abs(mean).max(), abs(turn)) < 1e-9


def test_a_mean_over_several_pieces_holds_none_of_them_alone():
    """One blade over a stretch of lip that crossings cut in pieces: what its few means leave free is found."""
    stem = cut_in(MESH, (1.0, 5.05), (11.0, 5.05), internal=True)
    comb = [cut_in(MESH, (x, 5.05), (x, 6.5), (x + 0.45, 6.5), (x + 0.45, 5.05), internal=True)
            for x in (3.03, 3.55, 4.07)]
    held = Retraction(0, 1, normal_mm=0.1, blade=(0.1, 0.9))
    with pytest.warns(XfemnavWarning, match="W31"):
        problem = posed(MESH, (stem, *comb), BRAIN, SKULL, (held,), loose="remove")
    solution = solve(problem)
    assert np.isfinite(solution.U).all() and solution.residual < 1e-8


def test_a_retractor_does_not_pull_on_a_removed_piece():
    pull = Retraction(0, -1, force_mN_per_mm=(0.0, -1.0))
    with pytest.raises(XfemnavError, match=r"E306 .* pulls"):
        posed(MESH, (CORNER,), BRAIN, Skull("fixed", 9.0, 1.0), (pull,), loose="remove")


def test_the_largest_piece_is_never_removed():
    held = Retraction(0, -1, normal_mm=1.0, blade=(0.0, 1.0))  # the corner, and nothing else
    with pytest.raises(XfemnavError, match=r"E306 .* the largest piece is not removed"):
        posed(MESH, (CORNER,), BRAIN, Skull("free"), (held,), loose="remove")


def test_unknown_ways_with_loose_pieces_are_refused():
    with pytest.raises(ValueError, match="magic"):
        posed(MESH, (), BRAIN, SKULL, loose="magic")


@pytest.mark.parametrize("lever, free", [(0.1, 0), (0.02, 0), (0.005, 1), (1e-4, 1)])
def test_a_lever_under_a_hundredth_of_the_organ_holds_nothing(lever, free):
    """Two points that are held so near to each other let it turn: what holds it by so little throws it about."""
    space = posed(MESH, (), BRAIN, SKULL).space
    size = np.sqrt(((MESH.points - MESH.points.mean(axis=0)) ** 2).sum(axis=1).mean())
    points = np.array([[0, 0], [lever * size, 0]]) + MESH.corners[0].mean(axis=0)
    held = vector_rows(space.basis_in(points, [0, 0]), np.zeros((2, 2)), 0)  # functions go on beyond their cell
    motions = pieces.free_motions(space, held, csr_array((space.enrichment.n_dof,) * 2), space.enrichment.body[0])
    assert motions.shape[1] == free
