"""What cannot stay beside a resection goes with it, and nothing else does."""

import warnings

import numpy as np
import pytest
import shapely

from tests.meshes import grid, outline
from xfemnav.errors import XfemnavWarning
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.resection import place_resection
from xfemnav.geometry.plane.shreds import Elements, without_shreds

MESH = grid(24, 24.0)  # elements of 1 mm, a square of 24 mm
LEAST = np.pi  # mm2: a disc of 2 mm


def circle(x, y, radius, n=60):
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def box(x0, y0, x1, y1):
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def ring_with_gap(gap):
    """A ring from 3 to 6 mm about the middle, open over `gap` mm on its right."""
    ring = shapely.Point(12, 12).buffer(6).difference(shapely.Point(12, 12).buffer(3))
    (part,) = shapely.get_parts(ring.difference(shapely.box(12, 12 - gap / 2, 20, 12 + gap / 2)))
    return np.asarray(part.exterior.coords)[:-1]


def taken(*drawn, mesh=MESH, elements=None, **more):
    """Area that goes with resections, each a tuple of rings, beyond their own, mm2; and what is warned of."""
    placed = tuple(place_resection(rings, outline(mesh), f"r{k}") for k, rings in enumerate(drawn))
    before = shapely.union_all([item.region for item in placed])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", XfemnavWarning)
        found = without_shreds(placed, outline(mesh), elements or Elements.of(mesh), **{"least_mm2": LEAST} | more)
    after = shapely.union_all([item.region for item in found])
    assert len(found) == len(placed) and shapely.difference(before, after).area < 1e-6
    codes = [item.message.code for item in caught]
    assert codes in ([], ["W210"])
    return shapely.difference(after, before), codes, found


AROUND = (box(5, 5, 19, 7), box(5, 17, 19, 19), box(17, 5, 19, 19))
GOES = {  # rings of each resection, the area that goes
    "enclosed": ([(circle(12, 12, 6), circle(12, 12, 4))], np.pi * 16),
    "held on by half an element": ([(ring_with_gap(0.5),)], np.pi * 9 + 3 * 0.5),
    "a shell at the surface": ([(box(6, 2, 18, 23.5),)], 12 * 0.5),
    "a shell between two resections": ([(box(4, 8, 11, 16),), (box(11.6, 8, 20, 16),)], 8 * 0.6),
    "enclosed between two": ([(box(5, 5, 12, 19),), AROUND], 5 * 10),
    "a crumb at the surface": ([(np.array([(2.4, -1), (4, -1), (-1, 4), (-1, 2.4)]),)], 1.4**2 / 2),
    "a corner wider than an element and under the size": (
        [(np.array([(1.5, -1), (3, -1), (3, 3), (-1, 3), (-1, 1.5), (1.5, 1.5)]),)], 1.5**2),
    "a finger": ([(box(6, 6, 18, 11.7), box(6, 12.3, 18, 18), box(6, 11.7, 8, 12.3))], 10 * 0.6),
}


@pytest.mark.parametrize("name", sorted(GOES))
def test_what_cannot_stay_goes_and_is_told(name):
    drawn, area = GOES[name]
    gone, codes, _ = taken(*drawn)
    assert codes == ["W210"]
    assert gone.area == pytest.approx(area, rel=0.08)


STAYS = {
    "a bridge between two halves": [(box(10, -1, 14, 11.7), box(10, 12.3, 14, 25))],
    "two bridges": [(box(10, -1, 14, 8), box(10, 8.6, 14, 16), box(10, 16.6, 14, 25))],
    "held on by more than an element": [(ring_with_gap(1.6),)],
    "a shell wider than an element": [(box(6, 2, 18, 22.5),)],
    "a corner of the organ": [(np.array([(8, -1), (9.5, -1), (-1, 9.5), (-1, 8)]),)],
    "more than the resection itself": [(box(2, 23.2, 22, 23.5),)],
    "round": [(circle(12, 12, 6),)],
    "sharp": [(np.array([(4, 4), (20, 12), (4, 20), (10, 12)]),)],
}


@pytest.mark.parametrize("name", sorted(STAYS))
def test_real_tissue_stays_without_a_word(name):
    gone, codes, _ = taken(*STAYS[name])
    assert codes == [] and gone.area < 1e-9


def test_holes_under_the_size_are_filled_without_a_word_unless_they_are_many():
    holes = [circle(x, y, 0.7) for x in (8, 12, 16) for y in (8, 12, 16)]
    gone, codes, _ = taken((circle(12, 12, 8), *holes[:4]))
    assert codes == [] and gone.area == pytest.approx(4 * np.pi * 0.49, rel=0.01)
    gone, codes, _ = taken((circle(12, 12, 8), *holes))
    assert codes == ["W210"] and gone.area == pytest.approx(9 * np.pi * 0.49, rel=0.01)


def test_what_is_to_be_held_stays_enclosed():
    gone, codes, _ = taken((circle(12, 12, 6), circle(12, 12, 4)), hold=True)
    assert codes == [] and gone.is_empty


def test_a_blade_keeps_the_tissue_that_it_would_lose():
    shell = (box(6, 2, 18, 23.5),)
    assert taken(shell, held=[shapely.LineString([(12, 24), (12, 20)])])[0].is_empty
    beyond = shapely.LineString([(2, 20), (12, 23.8)])  # more of it lies beside the shell
    assert taken(shell, held=[beyond])[0].area == pytest.approx(6, rel=0.05)


def test_each_part_goes_with_the_resection_that_it_lies_along():
    _, _, found = taken((circle(6, 12, 4), circle(6, 12, 2)), (circle(18, 12, 4),))
    assert found[0].area_mm2 == pytest.approx(np.pi * 16, rel=0.01)
    assert found[1].area_mm2 == pytest.approx(np.pi * 16, rel=0.01)


def test_a_coarse_mesh_takes_no_more_than_what_is_thin():
    coarse = grid(6, 60.0)
    gone, codes, _ = taken((box(10, 10, 50, 54),), mesh=coarse)
    assert codes == [] and gone.is_empty
    assert taken((box(10, 10, 50, 57),), mesh=coarse)[0].area == pytest.approx(40 * 3, rel=0.08)


def test_what_is_thin_without_the_resection_stays():
    x, y = MESH.corners.mean(axis=1).T
    bump = (y < 18) | ((y < 20) & (x > 11) & (x < 12)) | ((y > 20) & (x > 9) & (x < 14))  # on a neck of 1 mm
    gone, codes, _ = taken((box(2, 2, 12, 12), box(12.9, 21.4, 15, 22.6)), mesh=Mesh(MESH.points, MESH.cells[bump]))
    assert codes == [] and gone.area < 1e-9
    fin = (y < 18) | ((x > 10) & (x < 11))  # 1 mm wide
    gone, codes, _ = taken((box(11, 14, 16, 19),), mesh=Mesh(MESH.points, MESH.cells[fin]))
    assert codes == [] and gone.area < 1e-9


def test_elements_are_those_of_the_place():
    """Shells of 2 mm at the surface, beside elements of 1 mm on the left and of 3 mm on the right."""
    places = MESH.corners.mean(axis=1)
    graded = Elements(places, np.where(places[:, 0] < 12, 1.0, 3.0))
    gone, _, _ = taken((box(2, 10, 9, 22), box(14, 10, 20, 22)), elements=graded)
    assert gone.bounds[0] > 12 and gone.area == pytest.approx(6 * 2, rel=0.1)
