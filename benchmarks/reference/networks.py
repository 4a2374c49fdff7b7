"""Problem p's disc with more than the one cut: branches, crossings, T-cuts and resections, on conforming meshes.

The cut of problem p is held as there, on its first half; every other lip and the rim of a resection is free, without
contact. The outline is fixed beyond 15 mm from the mouth of the held cut, and free nearer; other mouths free nothing.
"""

from dataclasses import dataclass

import numpy as np
import shapely

from benchmarks.reference.cases import BRAIN, LIFT, MOUTH, TIP, Retracted, disc, switches
from benchmarks.reference.elasticity import Model, Tissue
from benchmarks.reference.mesh import Grading, conforming_mesh

#: Fraction of the held cut that is held, from its mouth, and where that ends, mm.
HELD = 0.5
END = np.array(MOUTH) + HELD * (np.array(TIP) - MOUTH)
STEM = (MOUTH, TIP)
#: Edge length at the blunt corners of a resection's rim, mm.
RIM_MM = 0.1


@dataclass(frozen=True)
class Network:
    """Cuts ((x, y), ...) mm, the held one first, and the resected region, a loop ((x, y), ...) mm, if there is one.

    A cut that begins on the outline has its mouth there.
    """

    title: str
    cuts: tuple
    removed: tuple = ()

    @property
    def lines(self) -> shapely.MultiLineString:
        """All cuts."""
        return shapely.MultiLineString(self.cuts)

    @property
    def tissue(self) -> shapely.Polygon:
        """The disc without what is resected."""
        organ = shapely.Polygon(disc())
        return organ.difference(shapely.Polygon(self.removed)) if self.removed else organ


def ellipse(centre, semi_axes, turn_deg: float = 0.0, n: int = 72) -> tuple:
    """Corners ((x, y), ...) mm of a polygon on an ellipse."""
    t, turn = 2 * np.pi * np.arange(n) / n, np.deg2rad(turn_deg)
    x, y = semi_axes[0] * np.cos(t), semi_axes[1] * np.sin(t)
    points = np.stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], axis=1) + centre
    return tuple(map(tuple, points.tolist()))


def _on_outline(angle_deg):
    """The point (x, y) mm of the 360-gon in a direction seen from its centre."""
    far = 2 * np.linalg.norm(MOUTH) * np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    return shapely.LineString([(0, 0), far]).intersection(shapely.LinearRing(disc())).coords[0]


NETWORKS = {
    "branch, internal": Network(
        "branch below the held part, and an internal cut", (STEM, ((0, 44), (15, 30)), ((-12, 52), (-22, 30)))
    ),
    "branch, edge": Network(
        "branch below the held part, and a cut from another mouth", (STEM, ((0, 44), (15, 30)),
                                                                     (_on_outline(150.3), (-40, 38), (-18, 24)))
    ),
    "crossing": Network("two cuts that cross below the held part", (STEM, ((-13, 35), (12, 46)))),
    "tip on a cut": Network("T: the held cut's tip lies on the second cut", (STEM, ((-12, 28.2), (16, 32.4)))),
    "from beside the tip": Network("T: the second cut starts 1.5 mm above the tip", (STEM, ((0, 31.5), (14, 25)))),
    "from the tip": Network("the second cut starts at the tip", (STEM, ((0, 30), (14, 24)))),
}

RESECTIONS = {
    "at the end": Network("resection at the end of the held cut", (STEM,), ellipse((0, 28), (9, 6))),
    "inside": Network("resection that no cut reaches", (STEM,), ellipse((20, 30), (9, 6), 30)),
    "at the surface": Network("resection that reaches the surface", (STEM,), ellipse(_on_outline(150), (14, 9), 150)),
}


def retraction(network: Network, refinement: float = 1.0, tissue: Tissue = BRAIN) -> Retracted:
    """The displacement of the disc with a network of cuts, and its strain energy."""
    organ, switch = network.tissue, switches()
    cuts = [np.array(line.coords) for line in shapely.get_parts(shapely.line_merge(network.lines & organ))]
    focus = _singular(network, organ, switch) + tuple((x, y, RIM_MM / refinement**2) for x, y in network.removed)
    grading = Grading(4 / refinement, 1e-3 / refinement**2, 0.14 / refinement, focus)
    holes = [np.array(hole.coords[:-1]) for hole in organ.interiors]
    mesh = conforming_mesh(np.array(organ.exterior.coords[:-1]), cuts, grading, [*switch, END], holes)
    model = Model(mesh, tissue)
    skull, reach = shapely.LinearRing(disc()), np.linalg.norm(switch[0] - MOUTH)

    def is_fixed(x, _):
        return (skull.distance(shapely.points(x)) < 1e-9) & (np.linalg.norm(x - MOUTH, axis=1) > reach)

    model.prescribe(model.facets(is_fixed), np.zeros(2))
    for side in (1, -1):
        model.prescribe(model.facets(lambda x, inward, side=side: _is_held(x, inward, side)), side * LIFT)
    u = model.solve()
    return Retracted(model.field(u), model.energy(u), model.basis.N)


def _is_held(x, inward, side):
    """Facets of the held cut from its mouth to END, on its left (+1) or right (-1)."""
    on = (np.abs(x[:, 0]) < 1e-9) & (x[:, 1] < MOUTH[1] - 1e-9) & (x[:, 1] > END[1])
    return on & (np.sign(inward[:, 0]) == side)


def _singular(network, organ, switch):
    """Points ((x, y), ...) to refine at: ends of data, of cuts; bends and meetings; corners of a resection's mouth."""
    lines = shapely.get_parts(network.lines)
    points = [*switch, END, *(point for line in lines for point in line.coords)]
    for k, line in enumerate(lines):
        points += shapely.get_coordinates(shapely.intersection(line, lines[:k])).tolist()
    if network.removed:
        rim = shapely.LinearRing(network.removed)
        points += shapely.get_coordinates(shapely.intersection(rim, [shapely.LinearRing(disc()), *lines])).tolist()
    keep = shapely.distance(organ, shapely.points(np.array(points))) < 1e-6
    return tuple(dict.fromkeys(tuple(np.round(p, 9).tolist()) for p in np.array(points)[keep]))
