"""What cuts do to a mesh: parts of cells, the contacts between them, and the lips.

The mesh never contains the cut. Each crossed cell is split by binary space partition: a convex part is split by the
supporting line of a segment, and only the segment's own interval on that line is a cut. Two parts are *joined* where
their facets overlap in an interval that is not cut, so vertices that hang on a neighbour's facet do not matter.
The loop of a resection is a cut too; the parts inside it are removed, and what bounds them is a wall, not a lip.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.cut import Cut
from xfemnav.geometry.dissection import dissect
from xfemnav.geometry.mesh import Mesh, frozen_array, orient
from xfemnav.geometry.partition import segments_of
from xfemnav.geometry.removal import parts_inside, walls
from xfemnav.geometry.resection import Resection
from xfemnav.geometry.snapping import find_tips, mesh_net, snap, snap_region


@dataclass(frozen=True, eq=False)
class Subcells:
    """Parts of the mesh's cells and how they touch.

    Part c < n_cells belongs to cell c; cells in several parts have their further parts after those. Arrays:

    corners (s, 3, 2) mm: triangles, positively oriented; `part` (s,): the part that each belongs to.
    part_cell (p,): the cell of each part.
    joins (j, 4): parts p, q, and two local flags packed as cell nodes i, k that the contact lets through: for a contact
        across a mesh edge its two nodes, for a contact inside a cell (-1, -1), meaning all three. join_middle (j, 2)
        mm: the middle of the contact.
    lip_cut (l,), lip_ends (l, 2, 2) mm, lip_arc (l, 2) mm from the mouth, lip_parts (l, 2): pieces of the cut inside
        one cell (or along an edge), in travel order; the parts on the left (+1) and on the right (-1).
    lip_on_edge (l, 2): whether each end lies on a mesh edge or node.
    rim_part (b,), rim_ends (b, 2, 2) mm: facets of the organ's outline, tissue on the left.
    removed (p,): parts taken out by a resection. No lip, rim facet, tip or wall belongs to one.
    wall_part (w,), wall_ends (w, 2, 2) mm, wall_resection (w,): facets between what is left and what was taken out,
        tissue on the left, and the resection that took it; -1 where the beyond was a loose piece.
    tip_cut (t,), tip_end (t,) 0 or -1, tips (t, 2) mm, tip_travel (t, 2) unit direction in which the cut would go on.
    tip_touch (k, 2): pairs (tip, part) of the parts that a tip touches.
    paths: the snapped cuts, a tuple of (k, 2) mm.
    """

    corners: np.ndarray
    part: np.ndarray
    part_cell: np.ndarray
    joins: np.ndarray
    join_middle: np.ndarray
    lip_cut: np.ndarray
    lip_ends: np.ndarray
    lip_arc: np.ndarray
    lip_parts: np.ndarray
    lip_on_edge: np.ndarray
    rim_part: np.ndarray
    rim_ends: np.ndarray
    tip_cut: np.ndarray
    tip_end: np.ndarray
    tips: np.ndarray
    tip_travel: np.ndarray
    tip_touch: np.ndarray
    removed: np.ndarray
    wall_part: np.ndarray
    wall_ends: np.ndarray
    wall_resection: np.ndarray
    paths: tuple

    def __post_init__(self):
        n = None
        for name, kind, shape in (
            ("corners", float, (n, 3, 2)),
            ("part", np.int64, (n,)),
            ("part_cell", np.int64, (n,)),
            ("joins", np.int64, (n, 4)),
            ("join_middle", float, (n, 2)),
            ("lip_cut", np.int64, (n,)),
            ("lip_ends", float, (n, 2, 2)),
            ("lip_arc", float, (n, 2)),
            ("lip_parts", np.int64, (n, 2)),
            ("lip_on_edge", bool, (n, 2)),
            ("rim_part", np.int64, (n,)),
            ("rim_ends", float, (n, 2, 2)),
            ("tip_cut", np.int64, (n,)),
            ("tip_end", np.int64, (n,)),
            ("tips", float, (n, 2)),
            ("tip_travel", float, (n, 2)),
            ("tip_touch", np.int64, (n, 2)),
            ("removed", bool, (len(self.part_cell),)),
            ("wall_part", np.int64, (n,)),
            ("wall_ends", float, (n, 2, 2)),
            ("wall_resection", np.int64, (n,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), kind, shape, name))
        object.__setattr__(self, "paths", tuple(frozen_array(path, float, (n, 2), "path") for path in self.paths))

    @cached_property
    def areas(self) -> np.ndarray:
        """Triangle areas (s,) mm^2."""
        a, b, c = self.corners.swapaxes(0, 1)
        return orient(a, b, c) / 2

    @property
    def n_parts(self) -> int:
        """Number of parts."""
        return len(self.part_cell)


def embed(mesh: Mesh, cuts: tuple[Cut, ...], resections: tuple[Resection, ...] = ()) -> Subcells:
    """Split the cells of `mesh` by the cuts and by the walls of the resections; nothing is dropped for being small.

    The network is first snapped to the mesh at 1e-3 of the local element size. Any simple polylines will do.
    Raises XfemnavError E311 for a resection that is smaller than the snapping.
    """
    net = mesh_net(mesh)
    region, loops = _snapped_region(mesh, net, resections)
    paths = snap(mesh, net, [cut.path for cut in cuts], loops)
    segments = segments_of([*paths, *loops])
    ends = [tip for tip in find_tips(mesh, net, paths, loops) if not shapely.contains_xy(region, *tip[1][tip[2]])]
    tips = np.array([path[end] for _, path, end in ends]).reshape(-1, 2)
    travel = [_travel(cuts[k].path, end) for k, _, end in ends]
    return _assemble(mesh, paths, segments, ends, tips, travel, region, resections)


def _snapped_region(mesh, net, resections):
    """All that is taken out, as one snapped region, and the lines that cut it free inside the organ."""
    if not resections:
        return shapely.MultiPolygon(), ()
    outline = shapely.multilinestrings(shapely.linestrings(mesh.points[mesh.boundary_edges]))
    regions = [snap_region(net, resection.region, outline)[0] for resection in resections]
    for resection, region in zip(resections, regions):
        if region.is_empty:
            raise XfemnavError(
                "E311",
                f"resection '{resection.name}' ({resection.area_mm2:.2g} mm2) is smaller than the mesh can tell; use "
                "smaller elements, or leave it out.",
            )
    return snap_region(net, shapely.union_all(regions), outline)


def _travel(drawn, end):
    """Unit direction in which a cut as drawn (k, 2) would go on: where it was snapped, its last stretch may be tiny."""
    d = drawn[0] - drawn[1] if end == 0 else drawn[-1] - drawn[-2]
    return d / np.linalg.norm(d)


def _assemble(mesh, paths, segments, ends, tips, travel, region, resections):
    split, (owner, triangles), (joins, join_ends), (between, spans), (rim_part, rim_ends), touch = dissect(
        mesh.corners, mesh.cells, mesh.neighbours, mesh.sizes, segments, tips)
    whole = np.ones(len(mesh.cells), dtype=bool)
    whole[split] = False
    corners = np.concatenate([mesh.corners[whole], triangles.reshape(-1, 3, 2)])
    part = np.concatenate([np.flatnonzero(whole), owner[:, 0]])
    part_cell = np.concatenate([np.arange(len(mesh.cells)), split[1:][split[1:] == split[:-1]]])
    removed = parts_inside(region, corners, part, len(part_cell))
    join_ends, rim_part, rim_ends = join_ends.reshape(-1, 2, 2), rim_part[:, 0], rim_ends.reshape(-1, 2, 2)
    line, lip_parts = between[:, 0], between[:, 1:3]
    lip_ends = segments.rows[line, None, :2] + spans[:, :, None] * segments.rows[line, None, 2:4]
    joined = removed[joins[:, 0]] == removed[joins[:, 1]]
    gone = removed[lip_parts]
    lips = ~gone.any(axis=1) & (segments.cut[line] < len(paths))
    # A resection's line that merged with another leaves contacts between what stays and what goes: walls as well.
    bare = gone[:, 0] != gone[:, 1]
    wall_ends = np.concatenate([lip_ends[bare], join_ends[~joined]])
    wall_parts = np.concatenate([lip_parts[bare], joins[~joined, :2]])
    on_rim = ~removed[rim_part]
    return Subcells(
        corners=corners,
        part=part,
        part_cell=part_cell,
        joins=joins[joined],
        join_middle=join_ends[joined].mean(axis=1),
        lip_cut=segments.cut[line[lips]],
        lip_arc=segments.start[line[lips], None] + spans[lips],
        lip_ends=lip_ends[lips],
        lip_parts=lip_parts[lips],
        lip_on_edge=between[lips, 3:],
        rim_part=rim_part[on_rim],
        rim_ends=rim_ends[on_rim],
        tip_cut=[k for k, _, _ in ends],
        tip_end=[end for _, _, end in ends],
        tips=tips,
        tip_travel=np.array(travel).reshape(-1, 2),
        tip_touch=touch,
        removed=removed,
        **walls(wall_ends, wall_parts, removed, resections),
        paths=tuple(paths),
    )
