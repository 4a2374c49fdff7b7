"""What cuts do to a mesh: parts of cells, the contacts between them, and the lips.

The mesh never contains the cut. Each crossed cell is split by binary space partition: a convex part is split by the
supporting line of a segment, and only the segment's own interval on that line is a cut. Two parts are *joined* where
their facets overlap in an interval that is not cut, so vertices that hang on a neighbour's facet do not matter.
The loop of a resection is a cut too; the parts inside it are removed, and what bounds them is a wall, not a lip.
"""

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.parts import Faces, Fronts, Lips, Parts, shared
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.dissection import dissect
from xfemnav.geometry.plane.partition import segments_of
from xfemnav.geometry.plane.removal import parts_inside, walls
from xfemnav.geometry.plane.resection import Resection
from xfemnav.geometry.plane.snapping import find_tips, mesh_net, snap, snap_region


def embed(mesh: Mesh, cuts: tuple[Cut, ...], resections: tuple[Resection, ...] = ()) -> Parts:
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
    outline = shapely.multilinestrings(shapely.linestrings(mesh.points[mesh.boundary_facets]))
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
    cell = np.concatenate([np.arange(len(mesh.cells)), split[1:][split[1:] == split[:-1]]])
    removed = parts_inside(region, corners, part, len(cell))
    join_ends, rim_part, rim_ends = join_ends.reshape(-1, 2, 2), rim_part[:, 0], rim_ends.reshape(-1, 2, 2)
    line, lip_parts = between[:, 0], between[:, 1:3]
    lip_ends = segments.rows[line, None, :2] + spans[:, :, None] * segments.rows[line, None, 2:4]
    joined = removed[joins[:, 0]] == removed[joins[:, 1]]
    gone = removed[lip_parts]
    lips = ~gone.any(axis=1) & (segments.cut[line] < len(paths))
    # A resection's line that merged with another leaves contacts between what stays and what goes: walls as well.
    bare = gone[:, 0] != gone[:, 1]
    wall_ends = np.concatenate([lip_ends[bare], join_ends[~joined]])
    wall_parts = np.concatenate([lip_parts[bare], joins[~joined]])
    on_rim = ~removed[rim_part]
    arcs = segments.start[line[lips], None] + spans[lips]
    return Parts(
        corners=corners,
        part=part,
        cell=cell,
        removed=removed,
        joins=joins[joined],
        through=shared(*mesh.cells[cell[joins[joined]]].swapaxes(0, 1)),
        middles=(join_ends[joined, 0] + join_ends[joined, 1]) / 2,
        lips=Lips(lip_ends[lips], arcs[..., None], lip_parts[lips], segments.cut[line[lips]], between[lips, 3:]),
        rim=Faces(rim_ends[on_rim], rim_part[on_rim], np.full(on_rim.sum(), -1)),
        walls=walls(wall_ends, wall_parts, removed, resections),
        fronts=Fronts([k for k, _, _ in ends], [end for _, _, end in ends], tips, np.array(travel).reshape(-1, 2)),
        touch=touch,
        paths=tuple(paths),
    )

