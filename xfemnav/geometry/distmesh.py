"""Triangle mesh of the inside of an outline, after Persson & Strang, "A simple mesh generator in MATLAB", SIAM Review
46 (2004).

Theirs: bars that press the nodes apart, a boundary that stays on the outline, a size function, a measured quality.
Changed, because their loop does not reach its stopping tolerance on a contour of an image: the outline's nodes are
placed once, by arc length; the others start on a lattice that follows the size function; the triangulation is grown
once and afterwards only flipped; every loop is bounded; and the quality is a gate at the end, not a hope.
"""

from collections.abc import Callable

import numpy as np
import shapely

from xfemnav.errors import XfemnavError
from xfemnav.geometry.delaunay import Triangulation, holes, insert, mark_inside, square
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.outline_nodes import outline_nodes
from xfemnav.geometry.relaxation import lift_worst, optimal_delaunay, truss
from xfemnav.geometry.sizing import cones, is_inside

MOST_NODES, FEWEST_NODES = 400_000, 12
TURN = np.radians(15)  # the lattice's rows are 15 degrees or more from both axes, along which many cuts run
NEAR, DEEP = 0.72, 0.5  # room that a lattice node keeps, in h, to other nodes and to the outline
HOLE = 0.8  # a cell whose circumscribed radius exceeds this, in h, can take one more node (equilateral: .58)
STRAY = 0.2  # an outline edge that leaves the outline by more than this, in its length, is refined
SMALLEST = 1 / 16  # a feature of the outline that would need elements smaller than this part of the wanted is refused
GROWTH = 0.3  # mm per mm about places where the outline is finer than the elements


def distmesh(outline, size: float | Callable, *, min_quality: float = 0.5) -> Mesh:
    """Mesh of the inside of `outline` (n, 2) mm, counter-clockwise and simple, the last point not repeated.

    `size` is the wanted edge length in mm, a number or a function (n, 2) -> (n,) such as a `SizeField`. Corners of
    the outline that turn by more than 40 degrees are nodes. Nodes of the outline come first, in its order. Parts of
    the outline thinner than the elements get smaller ones, so that the mesh has the outline's topology. Same input,
    same bytes. Raises XfemnavError E207 when the size gives too many or too few nodes, E208 when the outline crosses
    itself, has a detail too fine for the size, or a triangle has quality below `min_quality`.
    """
    outline = _checked(outline)
    wanted = size if callable(size) else (lambda points: np.full(len(points), float(size)))
    expected = expected_nodes(outline, wanted)
    if not FEWEST_NODES <= expected <= MOST_NODES:
        raise XfemnavError(
            "E207",
            f"the mesh would have about {expected:.3g} nodes, outside {FEWEST_NODES} to {MOST_NODES}; "
            f"use a {'smaller' if expected < FEWEST_NODES else 'larger'} element size",
        )
    T, n_outline, size_at = _outline_triangulation(outline, wanted, expected)
    if callable(size) or size_at is not wanted:
        _fill_by_fronts(T, size_at)
    else:
        _fill_by_lattice(T, float(size))
    _fill_holes(T, size_at)
    return _gate(_relaxed(T, n_outline, size_at), min_quality)


def expected_nodes(outline, wanted: Callable) -> float:
    """Estimate of the number of nodes: one for each 3^.5/2 h^2 of area, and half a node for each h of outline."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    n = 160
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2)
    centres = low + (grid + 0.5) / n * (high - low)
    h = wanted(centres[is_inside(centres, outline)])
    length = np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1)
    interior = shapely.Polygon(outline).area * np.mean(1 / h**2) / (np.sqrt(3) / 2) if len(h) else 0.0
    return float(interior + np.sum(length / wanted(outline)) / 2)


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


def _outline_triangulation(outline, wanted, expected) -> tuple[Triangulation, int, Callable]:
    """Delaunay triangulation of nodes on the outline that holds all its edges; their number; the size that achieves
    this.

    An edge that another node hides, or that strays from the outline, marks a detail finer than the elements: the size
    is lowered there, with `GROWTH` around, and the outline is divided again. Raises E208 when a detail is too fine.
    """
    spots, sizes = np.empty((0, 2)), np.empty(0)
    size_at = wanted
    for _ in range(12):
        nodes, stray = outline_nodes(outline, size_at)
        T = square(outline.min(axis=0), outline.max(axis=0), int(1.5 * expected) + 4 * len(nodes) + 1000)
        unlimited = np.zeros(len(nodes))
        placed = insert(T, nodes, unlimited, np.full(len(nodes), -1), 0.0, 0.0)
        there = mark_inside(T, 4, len(nodes)) if (placed >= 0).all() else placed >= 0
        edges = np.roll(nodes, -1, axis=0) - nodes
        length = np.linalg.norm(edges, axis=1)
        bad = ~there | (stray > STRAY * length)
        if not bad.any():
            T.sizes[4 : 4 + len(nodes)] = size_at(nodes)
            return T, len(nodes), size_at
        middle = (nodes + edges / 2)[bad]
        finer = length[bad] / 2
        too_fine = finer < SMALLEST * wanted(middle)
        if too_fine.any():
            break
        spots, sizes = np.concatenate([spots, middle]), np.concatenate([sizes, finer])
        size_at = _lowered(wanted, spots, sizes)
    x, y = middle[np.argmin(finer)]
    raise XfemnavError(
        "E208",
        f"the outline has a detail too fine for the elements near ({x:.1f}, {y:.1f}) mm; smooth the mask there, "
        f"or use elements of {finer.min() * 4:.2g} mm",
    )


def _lowered(wanted, spots, sizes) -> Callable:
    """The size `wanted`, limited to `sizes` (k,) mm at `spots` (k, 2) and growing from there."""
    slopes = np.full(len(sizes), GROWTH)
    return lambda points: np.minimum(wanted(points), cones(points, spots, sizes, slopes))


def _fill_by_lattice(T, h):
    """Nodes of a hexagonal lattice of edge `h` mm inside the outline, in rows that run to and fro."""
    points = T.points[4 : T.count[0]]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    n = int(np.linalg.norm(np.ptp(points, axis=0)) / 2 / (h * np.sqrt(3) / 2)) + 2
    row, column = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij")
    column = np.where(row % 2 == 0, column, -column)
    x, y = (column + 0.5 * (row % 2)) * h, row * h * np.sqrt(3) / 2
    along, up = np.array([np.cos(TURN), np.sin(TURN)]), np.array([-np.sin(TURN), np.cos(TURN)])
    lattice = centre + x.reshape(-1, 1) * along + y.reshape(-1, 1) * up
    insert(T, lattice, np.full(len(lattice), h), np.full(len(lattice), -1), NEAR, DEEP)


def _fill_by_fronts(T, size_at):
    """Nodes one edge length from their parent in six fixed directions, wave after wave, until no room is left.

    Where the size is uniform the waves draw the hexagonal lattice; they start where the elements are smallest.
    """
    centres, parents = holes(T, HOLE)
    while len(centres):
        h = size_at(centres)
        seed = np.argsort(h, kind="stable")[:1]
        nodes = insert(T, centres[seed], h[seed], parents[seed], NEAR, DEEP)
        front = nodes[nodes >= 0]
        if len(front) == 0:
            return
        while len(front):
            front = _wave(T, front, size_at)
        return


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


def _fill_holes(T, size_at):
    """Nodes in the circumcentres of cells that are too large, and waves from there."""
    for _ in range(30):
        centres, parents = holes(T, HOLE)
        if len(centres) == 0:
            return
        nodes = insert(T, centres, size_at(centres), parents, NEAR, DEEP)
        front = nodes[nodes >= 0]
        if len(front) == 0:
            return
        while len(front):
            front = _wave(T, front, size_at)


def _relaxed(T, n_outline, size_at) -> Mesh:
    """The inside cells, relaxed: truss, optimal Delaunay, worst stars."""
    if T.count[0] == len(T.points):
        raise XfemnavError("E207", f"the mesh has more than {len(T.points)} nodes; use a larger element size")
    n_cells = T.count[1]
    kept = T.inside[:n_cells] == 1
    number = np.full(n_cells + 1, -1)
    number[:-1][kept] = np.arange(kept.sum())
    p = T.points[4 : T.count[0]].copy()
    cells, across = T.cells[:n_cells][kept] - 4, number[T.across[:n_cells][kept]]
    for _ in range(4):
        truss(p, cells, across, size_at(p), n_outline, 15)
    h = size_at(p)
    optimal_delaunay(p, cells, across, h, n_outline, 6)
    lift_worst(p, cells, across, h, n_outline, 0.8, 8)
    return Mesh(p, cells)


def _gate(mesh, min_quality) -> Mesh:
    """The mesh, if all its triangles have `min_quality` and it is one piece without holes; else E208."""
    worst = int(np.argmin(mesh.quality))
    if mesh.quality[worst] < min_quality:
        x, y = mesh.corners[worst].mean(axis=0)
        raise XfemnavError(
            "E208", f"triangle quality {mesh.quality[worst]:.2f} at ({x:.1f}, {y:.1f}) mm is below {min_quality:g}; "
            f"use elements under {mesh.sizes[worst] / 2:.2g} mm there, or smooth the mask"
        )
    return mesh
