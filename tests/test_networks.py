"""Networks of cuts on a retraction disc: how one is drawn does not matter, and it moves as the reference's does."""

import functools

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from benchmarks.probes import basis_at
from data_synthetic import domains
from tests.meshes import BRAIN, HARD_SKULL, outline, posed
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.grading import data_ends
from xfemnav.geometry.plane.resection import place_resection
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.mechanics.rules import Retraction
from xfemnav.mechanics.solving.solution import solve

STEM = ((0, 77), (0, 30))  # drawn from outside; its lips are held on the first half of what lies inside
BRANCH, FAR = ((0, 44), (15, 30)), ((-12, 52), (-22, 30))
CROSSING, TEE = ((-13, 35), (12, 46)), ((-12, 28.2), (16, 32.4))
CENTRE = (0, 35 + 13 * 11 / 25)  # where CROSSING meets the held cut
CAVITY = domains.ellipse(9, 6, 72, centre=(0, 28))
BOTH = tuple(Retraction(0, s, displacement_mm=(s * 3.5, -s * 1.0), blade=(0, 0.5)) for s in (1, -1))


@functools.cache
def graded(*paths, fineness=2.0):
    """A mesh of the disc, of 2,000 nodes, graded to the ends of cuts and data; the cuts are not in it."""
    disc = domains.disc()
    spots = data_ends(disc, placed(disc, paths), ((0, 0.0, 0.5),), HARD_SKULL.craniotomy_mm)
    focus = tuple((point, size * fineness**2, growth * fineness) for point, size, growth in spots)
    return distmesh(disc, SizeField(2.6 * fineness, focus=focus, growth=0.11 * fineness))


def placed(boundary, paths):
    """The held cut, from the outline, and further cuts inside."""
    return tuple(place_cut(path, boundary, f"cut {k}", internal=k > 0) for k, path in enumerate(paths))


def moved(mesh, paths, points, removed=()):
    """Displacement (k, 2) mm of points when the first cut's lips are held apart; all else is free."""
    resections = tuple(place_resection([loop], outline(mesh)) for loop in removed)
    cuts = placed(outline(mesh), paths)
    problem = posed(mesh, cuts, BRAIN, HARD_SKULL, BOTH, lips="free", resections=resections)
    return basis_at(problem.space, points) @ solve(problem).U


def around(*paths):
    """Points (k, 2) mm of the disc more than 1 mm from all paths."""
    points = np.random.default_rng(2).uniform(-66, 66, (400, 2))
    away = shapely.MultiLineString(paths).distance(shapely.points(points)) > 1
    return points[away & (np.hypot(*points.T) < 66)]


POINTS = around(STEM, BRANCH, FAR, CROSSING, TEE)
DRAWINGS = {
    "a free cut from its other end": ((STEM, CROSSING), (STEM, CROSSING[::-1])),
    "a crossing in two halves": ((STEM, CROSSING), (STEM, (CROSSING[0], CENTRE), (CENTRE, CROSSING[1]))),
    "a crossing in halves from the middle": ((STEM, CROSSING), (STEM, (CENTRE, CROSSING[1]), (CENTRE, CROSSING[0]))),
    "free cuts in another order": ((STEM, BRANCH, FAR), (STEM, FAR, BRANCH)),
    "a T in two halves": ((STEM, TEE), (STEM, (TEE[0], STEM[1]), (STEM[1], TEE[1]))),
    "a branch with a point on it": ((STEM, BRANCH), (STEM, (BRANCH[0], (7.5, 37), BRANCH[1]))),
}


@pytest.mark.parametrize("name", DRAWINGS)
def test_a_network_moves_as_it_lies_not_as_it_is_drawn(name):
    one, other = DRAWINGS[name]
    mesh = graded(*one)
    # A vertex that one drawing has and the other has not may be snapped: 1e-3 h, in strains of up to .1.
    assert_allclose(moved(mesh, one, POINTS), moved(mesh, other, POINTS), rtol=0, atol=1e-4)


# Displacement at PROBES of the conforming reference (`python -m benchmarks.networks`; the slow test below holds them to
# it), mm.
PROBES = np.array([(40, 30), (-40, 30), (12, 44), (-10, 60), (0, 15)], dtype=float)
KNOWN = {
    "branch, internal": ((STEM, BRANCH, FAR), (),
        [(0.3949, -0.6234), (-0.2244, -0.3902), (1.2138, -1.7547), (-2.2028, 0.0336), (-0.0436, -0.2018)]),
    "crossing": ((STEM, CROSSING), (),
        [(0.3209, -0.5866), (-0.2919, -0.5149), (0.9338, -1.0800), (-2.2276, -0.0424), (-0.0253, -0.3309)]),
    "tip on a cut": ((STEM, TEE), (),
        [(0.4087, -0.6221), (-0.2813, -0.5136), (1.2432, -1.7987), (-2.2271, -0.0303), (0.0159, -0.2726)]),
    "at the end": ((STEM,), (CAVITY,),
        [(0.4045, -0.6213), (-0.2768, -0.5046), (1.2424, -1.6605), (-2.2283, -0.0258), (-0.0121, -0.4132)]),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_a_coarse_mesh_moves_as_the_reference(name):
    """The mark of .03 mm holds on 8,000 nodes; the error falls as h, and these meshes have 2,000."""
    paths, removed, wanted = KNOWN[name]
    error = np.linalg.norm(moved(graded(*paths), paths, PROBES, removed) - wanted, axis=1)
    assert error.max() < 0.03 * np.sqrt(8 / 2)


def test_a_lost_cut_would_be_seen():
    """Without the further cuts the probes are off by much more than that."""
    for paths, removed, wanted in KNOWN.values():
        error = np.linalg.norm(moved(graded(*paths), (STEM,), PROBES) - wanted, axis=1)
        assert error.max() > 0.15, (paths, removed)


def test_more_cuts_make_the_tissue_softer():
    """The lips are held where they are; a further free cut only widens the space that energy is least in."""
    mesh, energies = graded(STEM, BRANCH, FAR), []
    for paths in ((STEM,), (STEM, BRANCH), (STEM, BRANCH, FAR)):
        cuts = placed(outline(mesh), paths)
        energies.append(solve(posed(mesh, cuts, BRAIN, HARD_SKULL, BOTH, lips="free", tip_enrichment="none")).energy)
    assert energies[0] > 1.001 * energies[1] > 1.001**2 * energies[2]


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOWN)
def test_the_known_displacements_are_the_reference_s(name):
    """To .001 mm: the reference's own change under refinement is under half of that."""
    from benchmarks.reference.networks import NETWORKS, RESECTIONS, retraction

    field = retraction((NETWORKS | RESECTIONS)[name], 0.7).field
    assert_allclose(field(PROBES), KNOWN[name][2], atol=1e-3)


CASES = ("branch, internal", "branch, edge", "crossing", "tip on a cut", "from beside the tip", "from the tip",
         "at the end", "inside", "at the surface")  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_marks_of_uniform_and_graded_meshes(name):
    """.17 mm on 8,800 uniform nodes, .03 mm on 8,000 graded ones, beyond two elements of any cut and rim."""
    from benchmarks.verification import networks, retraction

    assert set(networks.CASES) == set(CASES)
    graded_mesh = networks.graded(networks.CASES[name], 8_000)
    for mesh, limit in ((retraction.uniform(8_800), 0.17), (graded_mesh, 0.03)):
        errors = {value.name: value.error for value in networks.opened(name, mesh, "topological").values}
        assert errors["max beyond 2 h, mm"] <= limit


@pytest.mark.slow
def test_the_reference_leaves_a_resection_out():
    """The hole is there, with the polygon's area, and a cut that ends on it has two lips there."""
    from benchmarks.reference.mesh import Grading, conforming_mesh

    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    cut, hole = np.array([[0.0, 2.0], [1.5, 2.0]]), square / 4 + 1.5
    mesh = conforming_mesh(square, [cut], Grading(0.4, 0.1, 0.2, ((1.5, 2.0),)), holes=[hole])
    corners = mesh.points[mesh.cells]
    area = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 2
    assert area == pytest.approx(15.0, abs=1e-12)
    assert (np.linalg.norm(mesh.points - (1.5, 2.0), axis=1) < 1e-9).sum() == 2
