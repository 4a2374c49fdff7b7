"""What cuts do to a mesh: parts of cells, the contacts between them, and the lips.

The mesh never contains the cut. Each crossed cell is split by binary space partition: a convex part is split by the
supporting line of a segment, and only the segment's own interval on that line is a cut. Two parts are *joined* where
their facets overlap in an interval that is not cut, so vertices that hang on a neighbour's facet do not matter.
The loop of a resection is a cut too; the parts inside it are removed, and what bounds them is a wall, not a lip.
"""

from dataclasses import dataclass
from functools import cached_property
from math import hypot

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.bisection import REACH, UNCUT
from xfemnav.geometry.cut import Cut
from xfemnav.geometry.mesh import Mesh, frozen_array, orient
from xfemnav.geometry.partition import HERE, Segments, split_cells, touched_cells, triangulate
from xfemnav.geometry.removal import parts_inside, walls
from xfemnav.geometry.resection import Resection
from xfemnav.geometry.snapping import SEVER, find_tips, mesh_net, snap, snap_region


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
    outline = shapely.multilinestrings(shapely.linestrings(mesh.points[mesh.boundary_edges]))
    region, loops = _snapped_region(net, outline, resections)
    paths = snap(net, [cut.path for cut in cuts], loops, outline)
    segments = Segments([*paths, *loops])
    ends = [tip for tip in find_tips(mesh, net, paths, loops) if not shapely.contains_xy(region, *tip[1][tip[2]])]
    polygons = split_cells(mesh, segments, [path[end] for _, path, end in ends])
    return _assemble(mesh, paths, segments, ends, polygons, [_travel(cuts[k].path, end) for k, _, end in ends],
                     region, resections)


def _snapped_region(net, outline, resections):
    """All that is taken out, as one snapped region, and the lines that cut it free inside the organ."""
    if not resections:
        return shapely.MultiPolygon(), ()
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


def _assemble(mesh, paths, segments, ends, polygons, travel, region, resections):
    n_cells = len(mesh.cells)
    part_cell = list(range(n_cells))
    part_of = {}
    for c, cell in polygons.items():
        part_of[c] = [c, *range(len(part_cell), len(part_cell) + len(cell) - 1)]
        part_cell.extend([c] * (len(cell) - 1))
    whole = np.ones(n_cells, dtype=bool)
    whole[list(polygons)] = False
    corners, part = [mesh.corners[whole]], [np.flatnonzero(whole)]
    tip_points = [path[end] for _, path, end in ends]
    touch = []
    split = [(p, c, [edge[:2] for edge in polygon])
             for c, cell in polygons.items() for p, polygon in zip(part_of[c], cell)]
    if split:
        owner, cell, outlines = zip(*split)
        triangles = triangulate([np.array(xy) for xy in outlines], tip_points, mesh.sizes[list(cell)])
        corners += triangles
        part.append(np.repeat(owner, [len(own) for own in triangles]))
    for t, tip in enumerate(tip_points):
        for c in touched_cells(mesh, tip, np.array([1.0, 0.0]), 0.0):
            for p, polygon in zip(part_of.get(c, [c]), polygons.get(c, [mesh.corners[c]])):
                xy = np.array([edge[:2] for edge in polygon])
                if (np.hypot(*(xy - tip).T) < HERE * mesh.sizes[c]).any():
                    touch.append((t, p))
    corners, part = np.concatenate(corners), np.concatenate(part)
    removed = parts_inside(region, corners, part, len(part_cell))
    joins, join_ends = _joins(mesh, polygons, part_of)
    joined = removed[joins[:, 0]] == removed[joins[:, 1]]
    faces = _lips(mesh, segments, polygons, part_of)
    gone = removed[np.array([row[3] for row in faces], dtype=int).reshape(-1, 2)]
    lips = [row for row, k in zip(faces, gone.any(axis=1).tolist()) if not k and row[0] < len(paths)]
    # A resection's line that merged with another leaves contacts between what stays and what goes: walls as well.
    bare = [row for row, k in zip(faces, (gone[:, 0] != gone[:, 1]).tolist()) if k]
    wall_ends = np.concatenate([np.array([row[2] for row in bare]).reshape(-1, 2, 2), join_ends[~joined]])
    wall_parts = np.concatenate([np.array([row[3] for row in bare], dtype=int).reshape(-1, 2), joins[~joined, :2]])
    rim_part, rim_ends = _rim(mesh, polygons, part_of)
    on_rim = ~removed[rim_part]
    return Subcells(
        corners=corners,
        part=part,
        part_cell=part_cell,
        joins=joins[joined],
        join_middle=join_ends[joined].mean(axis=1),
        lip_cut=[row[0] for row in lips],
        lip_arc=np.array([row[1] for row in lips]).reshape(-1, 2),
        lip_ends=np.array([row[2] for row in lips]).reshape(-1, 2, 2),
        lip_parts=np.array([row[3] for row in lips], dtype=int).reshape(-1, 2),
        lip_on_edge=np.array([row[4] for row in lips], dtype=bool).reshape(-1, 2),
        rim_part=rim_part[on_rim],
        rim_ends=rim_ends[on_rim],
        tip_cut=[k for k, _, _ in ends],
        tip_end=[end for _, _, end in ends],
        tips=np.array(tip_points).reshape(-1, 2),
        tip_travel=np.array(travel).reshape(-1, 2),
        tip_touch=np.array(touch, dtype=int).reshape(-1, 2),
        removed=removed,
        **walls(wall_ends, wall_parts, removed, resections),
        paths=tuple(paths),
    )


def _joins(mesh, polygons, part_of):
    """Contacts (j, 4): part, part, and the two nodes let through ((-1, -1) inside a cell: all).

    And their ends (j, 2, 2) mm, the first part on their left.
    """
    cell, local = np.nonzero(mesh.neighbours > np.arange(len(mesh.cells))[:, None])
    other = mesh.neighbours[cell, local]
    i, k = mesh.cells[cell, (local + 1) % 3], mesh.cells[cell, (local + 2) % 3]
    touched = np.zeros(len(mesh.cells), dtype=bool)
    touched[list(polygons)] = True
    plain = ~(touched[cell] | touched[other])
    joins, ends = [], []
    facets = _facets_on_edges(polygons, part_of)
    cut = np.flatnonzero(~plain)
    beyond = np.argmax(mesh.neighbours[other[cut]] == cell[cut, None], axis=1)
    table = np.stack([cell[cut], local[cut], other[cut], beyond, i[cut], k[cut]], axis=1).tolist()
    for (c, e, d, f, a, b), ((x0, y0), (x1, y1)), h in zip(
        table, mesh.points[np.stack([i, k], axis=1)[cut]].tolist(), mesh.sizes[cell[cut]].tolist()
    ):
        length = hypot(x1 - x0, y1 - y0)
        dx, dy = (x1 - x0) / length, (y1 - y0) / length
        sides = []
        for n, edge in ((c, e), (d, f)):
            sides.append([(0.0, length, n)] if n not in polygons else [
                (*sorted(((x - x0) * dx + (y - y0) * dy, (u - x0) * dx + (v - y0) * dy)), p)
                for x, y, u, v, p in facets.get((n, edge), ())
            ])
        for p, q, low, high in _overlaps(*sides, SEVER * h):
            joins.append((p, q, a, b))
            ends.append([(x0 + t * dx, y0 + t * dy) for t in (low, high)])
    for c, cell_polygons in polygons.items():
        lines = {}
        for p, polygon in zip(part_of[c], cell_polygons):
            for n, (x, y, tag, by) in enumerate(polygon):
                if tag >= 0 and by == UNCUT:
                    x1, y1 = polygon[(n + 1) % len(polygon)][:2]
                    lines.setdefault(tag, []).append((p, x, y, x1, y1))
        for on_line in lines.values():
            _, x, y, x1, y1 = on_line[0]
            length = hypot(x1 - x, y1 - y)
            dx, dy = (x1 - x) / length, (y1 - y) / length
            sides = ([], [])
            for p, xa, ya, xb, yb in on_line:
                ta, tb = (xa - x) * dx + (ya - y) * dy, (xb - x) * dx + (yb - y) * dy
                sides[int(tb < ta)].append((min(ta, tb), max(ta, tb), p))
            for p, q, low, high in _overlaps(*sides, SEVER * mesh.sizes[c]):
                joins.append((p, q, -1, -1))
                ends.append([(x + t * dx, y + t * dy) for t in (low, high)])
    whole = np.stack([cell, other, i, k], axis=1)[plain]
    return (
        np.concatenate([whole, np.array(joins, dtype=int).reshape(-1, 4)]),
        np.concatenate([mesh.points[whole[:, 2:]], np.array(ends).reshape(-1, 2, 2)]),
    )


def _facets_on_edges(polygons, part_of):
    """Uncut facets (x, y, x', y', part) on each edge (cell, opposite local node) of the cells in parts."""
    facets = {}
    for c, cell in polygons.items():
        for p, polygon in zip(part_of[c], cell):
            for n, (x, y, tag, by) in enumerate(polygon):
                if tag < 0 and by == UNCUT:
                    u, v = polygon[(n + 1) % len(polygon)][:2]
                    facets.setdefault((c, -1 - tag), []).append((x, y, u, v, p))
    return facets


def _overlaps(one, two, least):
    """Pairs of parts whose intervals overlap by more than `least`, and that overlap."""
    found = {}
    for a0, a1, p in one:
        for b0, b1, q in two:
            low, high = max(a0, b0), min(a1, b1)
            if high - low > least:
                found.setdefault((p, q), (low, high))
    return [(*pair, *overlap) for pair, overlap in sorted(found.items())]


def _lips(mesh, segments, polygons, part_of):
    """Pieces of the cuts between the parts on their two sides, in travel order."""
    sides = {}
    for c, cell in polygons.items():
        for p, polygon in zip(part_of[c], cell):
            for n, (x, y, tag, by) in enumerate(polygon):
                if by == UNCUT:
                    continue
                ax, ay, dx, dy, _ = segments.rows[by]
                x1, y1 = polygon[(n + 1) % len(polygon)][:2]
                ta, tb = (x - ax) * dx + (y - ay) * dy, (x1 - ax) * dx + (y1 - ay) * dy
                # Parts have their facets counter-clockwise: those on the left run with the travel.
                sides.setdefault(by, ([], []))[int(ta > tb)].append((min(ta, tb), max(ta, tb), p, c, tag))
    lips = []
    for s, (left, right) in sorted(sides.items()):
        ax, ay, dx, dy, _ = segments.rows[s]
        left.sort()
        right.sort()
        j = 0
        for a0, a1, p, c, tag in left:
            while j and right[j - 1][1] > a0:
                j -= 1
            while j < len(right) and right[j][0] < a1:
                b0, b1, q, other, _ = right[j]
                low, high = max(a0, b0), min(a1, b1)
                if high - low > REACH * mesh.sizes[c]:
                    ends = [(ax + t * dx, ay + t * dy) for t in (low, high)]
                    on_edge = [tag < 0 or _on_an_edge(mesh, (c, other), x) for x in ends]
                    arcs = (segments.start[s] + low, segments.start[s] + high)
                    lips.append((segments.cut[s], arcs, ends, (p, q), on_edge))
                j += 1
    return lips


def _on_an_edge(mesh, cells, x):
    for c in cells:
        (ax, ay), (bx, by), (cx, cy) = mesh.corners[c].tolist()
        u, v = x
        depth = min((ex - sx) * (v - sy) - (ey - sy) * (u - sx) for sx, sy, ex, ey in
                    ((ax, ay, bx, by), (bx, by, cx, cy), (cx, cy, ax, ay)))
        if depth < SEVER * mesh.sizes[c] ** 2:
            return True
    return False


def _rim(mesh, polygons, part_of):
    """Facets of the organ's outline and the parts behind them, tissue on the left."""
    cell, local = np.nonzero(mesh.neighbours < 0)
    split = np.zeros(len(mesh.cells), dtype=bool)
    split[list(polygons)] = True
    # Each facet as one or more rows, in the order of the boundary.
    order, parts = [np.flatnonzero(~split[cell])], [cell[~split[cell]]]
    ends = [mesh.corners[cell[:, None], (local[:, None] + [1, 2]) % 3][~split[cell]]]
    for row in np.flatnonzero(split[cell]).tolist():
        c, k = int(cell[row]), int(local[row])
        for p, polygon in zip(part_of[c], polygons[c]):
            for n, (x, y, tag, _) in enumerate(polygon):
                if tag == -1 - k:
                    order.append([row])
                    parts.append([p])
                    ends.append(np.array([[(x, y), polygon[(n + 1) % len(polygon)][:2]]]))
    order = np.argsort(np.concatenate(order), kind="stable")
    return np.concatenate(parts).astype(int)[order], np.concatenate(ends).reshape(-1, 2, 2)[order]
