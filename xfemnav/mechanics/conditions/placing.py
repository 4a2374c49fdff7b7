"""The first steps of every problem, whole or live: cuts placed in a mesh, and the functions that they make."""

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.chart import Chart
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.plane.resection import Resection
from xfemnav.geometry.plane.snapping import SNAP
from xfemnav.geometry.plane.subcells import embed
from xfemnav.geometry.solid.split import split
from xfemnav.mechanics.rules import Basis
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.space import Space


def place(mesh: Mesh, cuts: tuple[Chart, ...], resections: tuple[Resection, ...] = ()) -> Parts:
    """What cuts and resections do to a mesh: in the plane their paths are followed exactly, in space their level sets.

    Raises XfemnavError E305 for a cut within 1e-3 h of the outline, or of another cut: it is snapped onto that, and
    cuts nothing. What lies in a resection, or along its wall, has been cut and taken out.
    """
    return MAKERS[mesh.dim](mesh, cuts, resections)


def _along_paths(mesh, cuts, resections):
    parts = embed(mesh, cuts, resections)
    gone = shapely.union_all([r.region.buffer(4 * SNAP * mesh.sizes.max()) for r in resections])
    for k, cut in enumerate(cuts):
        line = shapely.LineString(cut.path)
        left = line.difference(gone).length if resections else line.length
        lost = left - np.diff(parts.lips.arc[parts.lips.cut == k], axis=1).sum()
        _refuse_lost(cut, lost, cut.length, 0.1 * min(cut.length, mesh.sizes.min()), "mm")
    return parts


def _by_levels(mesh, cuts, resections):
    parts = split(mesh, tuple(cut.level(mesh) for cut in cuts))
    for k, cut in enumerate(cuts):
        if not (parts.lips.cut == k).any():
            _refuse_lost(cut, cut.area_mm2, cut.area_mm2, 0.0, "mm2")
    return parts


def _refuse_lost(cut, lost, whole, limit, unit):
    if lost > limit:
        raise XfemnavError(
            "E305",
            f"cut '{cut.name}' runs along the outline, or along another cut, for {lost:.2g} of its {whole:.2g} {unit}, "
            "where it cuts nothing; keep it inside, or leave that part out.",
        )


#: The makers of parts by the dimension of the mesh: the border above which it is not asked for.
MAKERS = {2: _along_paths, 3: _by_levels}


def functions_on(mesh: Mesh, parts: Parts, basis: Basis) -> Space:
    """The functions on the parts of a mesh."""
    return Space(mesh, parts, enrich(mesh, parts, basis))


def open_mouths(parts: Parts, cuts: tuple[Chart, ...]) -> np.ndarray:
    """Places (m, d) mm in the mouths about which the skull is open: a path's first point, as it was snapped, and all of
    a sheet's line."""
    lines = [path[:1] for path in parts.paths] or [cut.mouth_line for cut in cuts]
    mouths = [line for line, cut in zip(lines, cuts) if cut.mouth and cut.craniotomy]
    return np.concatenate([np.empty((0, parts.corners.shape[2])), *mouths])
