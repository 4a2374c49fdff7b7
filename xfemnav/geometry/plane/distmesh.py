"""Triangle mesh of the inside of an outline, after Persson & Strang (SIAM Review 46, 2004).

Theirs: bars that press the nodes apart, a boundary that stays on the outline, a size function, a measured quality.
Changed, because their loop does not reach its stopping tolerance on a contour of an image: the outline's nodes are
spaced by arc length at once; the others start on a lattice that grows wave by wave after the size function; the
triangulation is grown with them and afterwards only flipped; every loop is bounded; and the quality is a gate at the
end, not a hope.
"""

from collections.abc import Callable

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.delaunay import Triangulation, holes, insert, mark_inside, square
from xfemnav.geometry.plane.rail import Rail, outline_nodes, rail_nodes, strays
from xfemnav.geometry.plane.relaxation import lift_worst, mean_quality, truss
from xfemnav.geometry.plane.sizing import cones, sample_inside
from xfemnav.interruption import checkpoint

MOST_NODES, FEWEST_NODES = 400_000, 12
TURN = np.radians(15)  # rows of the lattice of nodes are 15 degrees or more from both axes, along which many cuts run
NEAR, DEEP = 0.72, 0.5  # room that a lattice node keeps, in h, to other nodes and to the outline
HOLE = 0.8  # a cell whose circumscribed radius exceeds this, in h, can take one more node (equilateral: .58)
STRAY = 0.2  # an outline edge that leaves the outline by more than this, in its length, is too coarse
SMALLEST = 1 / 16  # a detail that would need elements smaller than this part of the wanted ones is refused
GROWTH = 0.25  # mm per mm about details that are finer than the elements
CLOSE = 0.985  # below this mean quality the outline's shape governs the mesh, and more cells are worth a search
WAVES = 30  # most times that waves start anew
CYCLES, STALL = 6, 2e-3  # most cycles of relaxation; it ends when the mean quality rises by less
# An organ of few elements gets finer ones until they are good in the mean, or this much finer.
MEAN_QUALITY, FINER, COARSEST = 0.95, 0.75, 0.4
ROUNDS = 12  # times that the mesh is begun anew with smaller elements at newly found details


def distmesh(outline, size: float | Callable, *, min_quality: float = 0.5) -> Mesh:
    """Mesh of the inside of `outline` (n, 2) mm, a simple loop, the last point not repeated.

    `size` is the wanted edge length in mm, a number or a function (n, 2) -> (n,) such as a `SizeField`. Corners of
    the outline that turn by more than 40 degrees are nodes. Nodes of the outline come first, in its order,
    counter-clockwise. Parts of the outline thinner than the elements get smaller ones, so that the mesh has the
    outline's topology: one piece, no holes. Same input, same bytes.
    Raises XfemnavError E207 when the size gives too many or too few nodes; E208 when the outline crosses itself, has a
    detail too fine for the size, or leaves a triangle of quality below `min_quality`.
    """
    outline = _checked(outline)
    wanted = size if callable(size) else (lambda points: np.full(len(points), float(size)))
    spots, finer = np.empty((0, 3)), 1.0
    for _ in range(ROUNDS):
        checkpoint()
        size_at = _lowered(wanted, finer, spots)
        T, rail, details = _outline_triangulation(outline, size_at)
        if len(details) == 0:
            _fill_by_fronts(T, size_at)
            mesh = _relaxed(T, rail, size_at)
            if not shapely.Polygon(mesh.points[: len(rail.places)]).is_valid:  # nodes slid past a bay's other shore
                mesh = _relaxed(T, rail._replace(free=np.zeros(len(rail.free), bool)), size_at)
            details = _flat(mesh, min_quality, size_at)
            if len(details) == 0 and (mesh.quality.mean() >= MEAN_QUALITY or finer <= COARSEST):
                return mesh
            if len(details) == 0:
                finer *= FINER
                continue
        if (details[:, 2] < SMALLEST * wanted(details[:, :2])).any():
            break
        spots = np.concatenate([spots, details])
    x, y, h = details[np.argmin(details[:, 2])]
    raise XfemnavError(
        "E208",
        f"no mesh of quality {min_quality:g}: near ({x:.1f}, {y:.1f}) mm the outline has a detail too fine for "
        f"elements of {wanted(np.array([[x, y]]))[0]:.2g} mm; use {h:.2g} mm there, or smooth the mask",
    )


def _checked(outline) -> np.ndarray:
    """The outline as a counter-clockwise simple loop (n, 2); raises E208 when it crosses itself or has no inside."""
    outline = np.array(outline, dtype=float)
    polygon = shapely.Polygon(outline) if len(outline) > 2 and np.isfinite(outline).all() else shapely.Polygon()
    if polygon.is_empty or not polygon.is_valid:
        raise XfemnavError(
            "E208",
            f"the outline is no simple loop: {shapely.is_valid_reason(polygon)}; smooth the mask or draw it again",
        )
    return outline if polygon.exterior.is_ccw else outline[::-1].copy()


def _lowered(wanted, finer, spots) -> Callable:
    """The size `wanted` times `finer`, lowered at the `spots` (k, 3) = x, y, size mm, and growing from there."""
    if len(spots) == 0:
        return wanted if finer == 1 else lambda points: finer * wanted(points)
    centres, sizes, slopes = spots[:, :2].copy(), spots[:, 2].copy(), np.full(len(spots), GROWTH)
    return lambda points: np.minimum(finer * wanted(points), cones(points, centres, sizes, slopes))


def expected_nodes(outline, size_at: Callable) -> float:
    """Estimate of the number of nodes: one for each 3^.5/2 h^2 of area, and half a node for each h of outline."""
    points, area = sample_inside(outline, 160)
    interior = area * np.sum(1 / size_at(points) ** 2) / (np.sqrt(3) / 2)
    length = np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1)
    return float(interior + np.sum(length / size_at(outline)) / 2)


def _outline_triangulation(outline, size_at) -> tuple[Triangulation, Rail, np.ndarray]:
    """Delaunay triangulation of nodes on the outline, their rail, and details (k, 3) = x, y, size that it misses.

    A detail is an outline edge that the triangulation does not hold, because another node is close, or that strays
    from the outline: it wants half the size. When there is none, the outline's edges bound the cells marked inside.
    Raises E207 when there will be too many or too few nodes.
    """
    expected = expected_nodes(outline, size_at)
    if not FEWEST_NODES <= expected <= MOST_NODES:
        raise XfemnavError(
            "E207",
            f"the mesh would have about {expected:.3g} nodes, outside {FEWEST_NODES} to {MOST_NODES}; "
            f"use a {'smaller' if expected < FEWEST_NODES else 'larger'} element size",
        )
    rail = outline_nodes(outline, size_at)
    nodes = rail_nodes(rail)
    T = square(outline.min(axis=0), outline.max(axis=0), MOST_NODES + len(nodes))
    placed = insert(T, nodes, np.zeros(len(nodes)), np.full(len(nodes), -1), 0.0, 0.0)
    there = mark_inside(T, 4, len(nodes)) if (placed >= 0).all() else placed >= 0
    T.sizes[4 : 4 + len(nodes)] = size_at(nodes)
    edges = np.roll(nodes, -1, axis=0) - nodes
    length = np.linalg.norm(edges, axis=1)
    missed = ~there | (strays(rail, nodes) > STRAY * length)
    return T, rail, np.column_stack([nodes + edges / 2, length / 2])[missed]


def _fill_by_fronts(T, size_at):
    """Nodes one edge length from their parent in six fixed directions, wave after wave, until no room is left.

    The first wave starts where the elements are smallest, others in the cells that are still too large. Where the size
    is uniform the waves draw a hexagonal lattice.
    """
    for most in (1, *[None] * WAVES):
        centres, parents = holes(T, HOLE)
        h = size_at(centres)
        seeds = np.argsort(h, kind="stable")[:most]
        nodes = insert(T, centres[seeds], h[seeds], parents[seeds], NEAR, DEEP)
        front = nodes[nodes >= 0]
        if most is None and len(front) == 0:
            return
        while len(front):
            front = _wave(T, front, size_at)


def _wave(T, front, size_at) -> np.ndarray:
    """New nodes about the nodes `front` (k,); their indices."""
    angles = TURN + np.pi / 3 * np.arange(6)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    parents, directions = np.repeat(front, 6), np.tile(directions, (len(front), 1))
    here, h = T.points[parents], T.sizes[parents]
    h = (h + size_at(here + h[:, None] * directions)) / 2
    points = here + h[:, None] * directions
    nodes = insert(T, points, size_at(points), parents, NEAR, DEEP)
    return nodes[nodes >= 0]


def _relaxed(T, rail, size_at) -> Mesh:
    """The inside cells, relaxed in cycles of truss steps; then the worst stars."""
    if T.count[0] == len(T.points):
        raise XfemnavError("E207", f"the mesh has over {MOST_NODES} nodes; use larger elements or a steeper growth")
    n_cells = T.count[1]
    kept = T.inside[:n_cells] == 1
    number = np.full(n_cells + 1, -1)
    number[:-1][kept] = np.arange(kept.sum())
    p = T.points[4 : T.count[0]].copy()
    cells, across = T.cells[:n_cells][kept] - 4, number[T.across[:n_cells][kept]]
    quality = 0.0
    for _ in range(CYCLES):
        h, before = size_at(p), quality
        truss(p, cells, across, h, rail, 15)
        quality = mean_quality(p, cells)
        if quality < before + STALL:
            break
    lift_worst(p, cells, across, size_at(p), rail, 0.9 if quality > CLOSE else 0.95, 4)
    return Mesh(p, cells)


def _flat(mesh, min_quality, size_at) -> np.ndarray:
    """Details (k, 3) = x, y, size mm of the cells below `min_quality`: half the size or half the edges."""
    flat = mesh.corners[mesh.quality < min_quality]
    longest = np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2).max(axis=1)
    centres = flat.mean(axis=1)
    return np.column_stack([centres, np.minimum(longest, size_at(centres)) / 2])
