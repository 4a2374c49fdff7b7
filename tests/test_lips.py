"""Conditions and forces on lips: the blade's span, quadrature along it, crossings, mortar rows and Eqs. (5) and (6)."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from tests.eq_4 import paper_coefficients
from tests.meshes import cut_in, grid, jittered, space_of
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.geometry.plane.cut import Cut
from xfemnav.mechanics.conditions.lips import (
    Retraction,
    crossings,
    held_span,
    lip_load,
    lip_quadrature,
    mortar_rows,
    pointwise_rows,
)
from xfemnav.mechanics.space.enrichment import BRANCH

MESH = jittered(20.0, 16.0, 1.0, 0.25, seed=0)
CUT = cut_in(MESH, (-1, 7.13), (12.37, 8.71))
SPACE = space_of(MESH, CUT)
KINKED = cut_in(MESH, (-1, 7.13), (6.2, 8.3), (11.1, 5.2))
EXACT = 1e-11  # sums of some hundred rounded terms of size 10


def test_a_retraction_says_exactly_one_thing():
    with pytest.raises(ValueError, match="exactly one"):
        Retraction(0, 1)
    with pytest.raises(ValueError, match="exactly one"):
        Retraction(0, 1, displacement_mm=(1, 0), force_mN_per_mm=(1, 0))
    with pytest.raises(ValueError, match="side"):
        Retraction(0, 2, normal_mm=1.0)


@pytest.mark.parametrize("blade", [(-0.1, 0.5), (0.5, 0.5), (0.7, 0.3), (0.2, 1.2), (np.nan, 0.5)])
def test_a_blade_off_the_cut_is_refused(blade):
    with pytest.raises(XfemnavError, match="E402"):
        Retraction(0, 1, normal_mm=1.0, blade=blade)


def test_what_is_prescribed():
    normals = np.array([[0.0, 1.0], [0.6, 0.8]])
    assert_allclose(Retraction(0, 1, displacement_mm=(3, -1)).displacement(normals), [[3, -1], [3, -1]])
    assert_allclose(Retraction(0, 1, normal_mm=2.0).displacement(normals), 2 * normals)
    assert_allclose(Retraction(0, -1, normal_mm=2.0).displacement(normals), -2 * normals)  # away from the other lip
    assert not Retraction(0, -1, force_mN_per_mm=(1, 0)).holds


@pytest.mark.parametrize("cut", [CUT, KINKED])
@pytest.mark.parametrize("side", [1, -1])
def test_lip_quadrature_measures_the_held_length(cut, side):
    space = space_of(MESH, cut)
    for span in ((0.0, cut.length), (1.234, 7.7), (3.0, 3.01)):
        q = lip_quadrature(space, 0, side, span, breaks=(2.0, 5.5))
        length = span[1] - span[0]
        assert_allclose(q.weights.sum(), length, rtol=EXACT)
        assert_allclose((q.weights * q.arc**3).sum(), (span[1] ** 4 - span[0] ** 4) / 4, rtol=EXACT)
        assert_allclose(np.linalg.norm(q.normals, axis=1), 1)
        line = shapely.LineString(cut.path)
        assert_allclose(shapely.line_locate_point(line, shapely.points(q.points)), q.arc, atol=1e-6)
        # Parts lie on the side asked for: a step of .01 mm along side * normal from the lip is still in the part or
        # beyond it, never on the other lip's side.
        for x, p, n in zip(q.points, q.parts, q.normals):
            triangles = space.parts.corners[space.parts.part == p]
            assert ((triangles.reshape(-1, 2) - x) @ (side * n)).max() > 0


def test_the_blade_stays_two_cells_short_of_the_tip():
    with pytest.warns(XfemnavWarning, match="W404"):
        span = held_span(SPACE, (CUT,), Retraction(0, 1, normal_mm=1.0, blade=(0.0, 0.95)))
    tip_cell = SPACE.parts.cell[SPACE.parts.touch[0, 1]]
    assert_allclose(span, (0, CUT.length - 2 * MESH.sizes[tip_cell]), atol=1e-9)


@pytest.mark.filterwarnings("error")
def test_a_blade_that_is_short_enough_is_taken_as_it_is():
    assert_allclose(held_span(SPACE, (CUT,), Retraction(0, 1, normal_mm=1.0, blade=(0.25, 0.5))),
                    (0.25 * CUT.length, 0.5 * CUT.length))


def test_an_internal_cut_keeps_its_distance_at_both_ends():
    cut = Cut([(4.2, 7.1), (14.3, 8.2)], mouth=False)
    with pytest.warns(XfemnavWarning, match="W404"):
        start, stop = held_span(space_of(MESH, cut), (cut,), Retraction(0, 1, normal_mm=1.0, blade=(0.0, 1.0)))
    assert start > 1 and stop < cut.length - 1


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_nothing_left_to_hold_is_refused():
    short = cut_in(MESH, (-1, 7.13), (1.5, 7.3))
    with pytest.raises(XfemnavError, match=r"E402.*nothing of cut"):
        held_span(space_of(MESH, short), (short,), Retraction(0, 1, normal_mm=1.0))


@pytest.mark.parametrize("side", [1, -1])
def test_mortar_rows_are_means_over_hats_that_add_up_to_one(side):
    """Sum of all rows: the mean over the whole span, for the basis and for the data."""
    span = (0.0, 8.0)
    rows = mortar_rows(SPACE, Retraction(0, side, displacement_mm=(1.5, -0.5)), span, 3)
    assert_allclose(rows.d.reshape(-1, 2).sum(axis=0), 8.0 * np.array([1.5, -0.5]), rtol=EXACT)
    U = np.random.default_rng(0).normal(size=(SPACE.enrichment.n_rows, 2))
    q = lip_quadrature(SPACE, 0, side, span, n=12)
    mean = q.weights @ (SPACE.basis_in(q.points, q.parts) @ U)
    assert_allclose((rows.C @ U.ravel()).reshape(-1, 2).sum(axis=0), mean, atol=1e-9)
    assert (rows.group == 3).all()
    # Hats of spacing 2 h: about one for every two cells, and one more.
    assert 8.0 / 2.6 < len(rows.d) / 2 < 8.0 / 1.4 + 1


def test_a_field_that_is_as_prescribed_meets_the_mortar_rows():
    rows = mortar_rows(SPACE, Retraction(0, 1, displacement_mm=(1.5, -0.5)), (0.0, 8.0), 0)
    U = np.where((SPACE.enrichment.kind < BRANCH)[:, None], (1.5, -0.5), 0.0)
    assert_allclose(rows.C @ U.ravel(), rows.d, atol=EXACT)


def brute_force_crossings(mesh, path):
    """Where the path meets the mesh's edges, each place once, sorted along the path."""
    line = shapely.LineString(path)
    met = [shapely.intersection(line, e) for e in shapely.linestrings(mesh.points[mesh.edges])]
    points = np.concatenate([shapely.get_coordinates(m) for m in met if not m.is_empty])
    arc = shapely.line_locate_point(line, shapely.points(points))
    order = np.argsort(arc)
    keep = np.concatenate([[True], np.diff(arc[order]) > 1e-7])
    return points[order][keep], arc[order][keep]


@pytest.mark.parametrize("cut", [CUT, KINKED])
def test_crossings_are_those_of_the_plane_without_the_tip_cell_s(cut):
    """Sect. 5: every intersection of the crack with the mesh; those of the element with the tip are left free."""
    space = space_of(MESH, cut)
    points, arc = brute_force_crossings(MESH, space.parts.paths[0])
    all_points, all_arc, _ = crossings(space, 0, 1, hold_tip=True)
    assert_allclose(all_arc, arc, atol=1e-9)
    assert_allclose(all_points, points, atol=1e-9)
    tip_cell = shapely.Polygon(MESH.corners[space.parts.cell[space.parts.touch[0, 1]]])
    free = [tip_cell.distance(shapely.Point(x)) < 1e-9 for x in points]
    assert sum(free) == 1
    for side in (1, -1):
        assert_allclose(crossings(space, 0, side)[1], arc[~np.array(free)], atol=1e-9)


def test_crossings_along_edges_are_the_nodes():
    mesh = grid(10, 10.0)
    space = space_of(mesh, Cut([(0.0, 4.0), (5.0, 4.0)]))
    assert_allclose(crossings(space, 0, 1, hold_tip=True)[1], np.arange(5.0), atol=1e-12)


@pytest.mark.parametrize("side, sign", [(1, 1.0), (-1, -1.0)])
def test_pointwise_rows_are_eqs_5_and_6(side, sign):
    """At a crossing between H nodes 1 and 2: phi_1 u_1 +- phi_1 a_1 + phi_2 u_2 +- phi_2 a_2 = the displacement."""
    given = (3.5, -1.0)
    rows = pointwise_rows(SPACE, Retraction(0, side, displacement_mm=given, blade=None), (0, np.inf), 0, False)
    points, _, _ = crossings(SPACE, 0, side)
    U = np.random.default_rng(5).normal(size=(SPACE.enrichment.n_rows, 2))
    paper = paper_coefficients(SPACE, U)
    found = (rows.C @ U.ravel()).reshape(-1, 2)
    assert len(found) == len(points)
    assert_allclose(rows.d.reshape(-1, 2), np.tile(given, (len(points), 1)))
    edges = shapely.linestrings(MESH.points[MESH.edges])
    plain = np.setdiff1d(np.arange(len(MESH.points)), SPACE.enrichment.tip_nodes)
    checked = 0
    for x, row in zip(points, found):
        one, two = MESH.edges[np.argmin(shapely.distance(edges, shapely.Point(x)))]
        if not np.isin([one, two], plain).all():
            continue  # next to the tip's cell the branch functions come in
        phi_2 = np.linalg.norm(x - MESH.points[one]) / np.linalg.norm(MESH.points[two] - MESH.points[one])
        u, a = paper["u"], paper["a"]
        eq = (1 - phi_2) * (u[one] + sign * a[one]) + phi_2 * (u[two] + sign * a[two])
        assert_allclose(row, eq, atol=1e-10)
        checked += 1
    assert checked > 15


def test_a_force_is_spread_evenly():
    """The nodal forces add up to the force, and their moment is that of a line load over the blade."""
    force, span = np.array([2.0, 5.0]), (2.0, 7.0)
    load = lip_load(SPACE, Retraction(0, 1, force_mN_per_mm=tuple(force)), span).reshape(-1, 2)
    own = SPACE.enrichment.kind < BRANCH
    assert_allclose(load[own].sum(axis=0), force, rtol=EXACT)
    x = MESH.points[SPACE.enrichment.node[own]]
    middle = CUT.at(4.5 / CUT.length)
    moment = (x[:, 0] * load[own, 1] - x[:, 1] * load[own, 0]).sum()
    assert_allclose(moment, middle[0] * force[1] - middle[1] * force[0], rtol=EXACT)
    # Nothing acts on the other lip's pieces.
    other = np.unique(SPACE.enrichment.dof[SPACE.parts.lips.parts[:, 1]])
    left = np.unique(SPACE.enrichment.dof[SPACE.parts.lips.parts[:, 0]])
    assert_allclose(load[np.setdiff1d(other, left)], 0)
