"""The first steps of every problem, whole or live: cuts placed in a mesh, and the functions that they make."""

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.chart import Chart
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.resection import Resection
from xfemnav.geometry.plane.snapping import SNAP
from xfemnav.geometry.plane.subcells import embed
from xfemnav.mechanics.rules import Basis
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.space import Space


def place(mesh: Mesh, cuts: tuple[Cut, ...], resections: tuple[Resection, ...] = ()) -> Parts:
    """What cuts and resections do to a mesh.

    Raises XfemnavError E305 for a cut within 1e-3 h of the outline, or of another cut: it is snapped onto that, and
    cuts nothing. What lies in a resection, or along its wall, has been cut and taken out.
    """
    parts = embed(mesh, cuts, resections)
    gone = shapely.union_all([r.region.buffer(4 * SNAP * mesh.sizes.max()) for r in resections])
    for k, cut in enumerate(cuts):
        line = shapely.LineString(cut.path)
        left = line.difference(gone).length if resections else line.length
        lost = left - np.diff(parts.lips.arc[parts.lips.cut == k], axis=1).sum()
        if lost > 0.1 * min(cut.length, mesh.sizes.min()):
            raise XfemnavError(
                "E305",
                f"cut '{cut.name}' runs along the outline, or along another cut, for {lost:.2g} of its "
                f"{cut.length:.2g} mm, where it cuts nothing; keep it inside, or leave that part out.",
            )
    return parts


def functions_on(mesh: Mesh, parts: Parts, basis: Basis) -> Space:
    """The functions on the parts of a mesh."""
    return Space(mesh, parts, enrich(mesh, parts, basis))


def open_mouths(parts: Parts, cuts: tuple[Chart, ...]) -> np.ndarray:
    """The mouths (m, d) mm about which the skull is open."""
    mouths = [path[0] for path, cut in zip(parts.paths, cuts) if cut.mouth and cut.craniotomy]
    return np.array(mouths).reshape(-1, parts.corners.shape[2])
