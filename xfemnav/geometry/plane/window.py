"""The part of a mesh about a path, as a mesh of its own: what a cut there can change."""

from dataclasses import dataclass

import numpy as np

from xfemnav.geometry.locate import LIP
from xfemnav.geometry.mesh import Mesh

#: Cells within this part of their size of the path may be touched: a cut is snapped by thousandths of it.
SLACK = 0.05


@dataclass(frozen=True, eq=False)
class Window:
    """A `mesh` that has the cells (m,) and nodes (n,) of a larger one, in the same order.

    border (n,) bool: nodes of which the larger mesh has more cells.
    """

    mesh: Mesh
    cells: np.ndarray
    nodes: np.ndarray
    border: np.ndarray


def window(mesh: Mesh, path, radius: float = 0.0, also=()) -> Window:
    """The cells that the `path` (k, 2) mm touches, or that are within `radius` mm of its ends, with all that share a
    node with them; and the cells `also` named. A node whose support the path crosses is not on the border."""
    near = np.zeros(len(mesh.points), dtype=bool)
    near[mesh.cells[near_cells(mesh, path, radius)]] = True
    chosen = near[mesh.cells[:, 0]] | near[mesh.cells[:, 1]] | near[mesh.cells[:, 2]]
    chosen[np.asarray(also, int)] = True
    cells = np.flatnonzero(chosen)
    count = np.bincount(mesh.cells[cells].ravel(), minlength=len(mesh.points))
    nodes = np.flatnonzero(count)
    number = np.empty(len(count), dtype=int)
    number[nodes] = np.arange(len(nodes))
    border = count[nodes] < mesh.valences[nodes]
    return Window(Mesh(mesh.points[nodes], number[mesh.cells[cells]]), cells, nodes, border)


def near_cells(mesh: Mesh, path, radius: float = 0.0) -> np.ndarray:
    """Cells (k,) within a twentieth of their size, or LIP, of the path (n, 2) mm, or within `radius` mm of an end."""
    path = np.asarray(path, float)
    middle, reach = mesh.reaches
    low, high = path.min(axis=0), path.max(axis=0)
    boxed, reach = True, reach[:, 0]
    for x, least, most in zip(middle.T, low, high):
        boxed &= (x >= least - reach) & (x <= most + reach)
    boxed = np.flatnonzero(boxed)
    middle, reach = middle[boxed], reach[boxed]
    near = np.zeros(len(boxed), dtype=bool)
    for a, b in zip(path[:-1], path[1:]):
        length = np.hypot(*(b - a))
        dx, dy = (b - a) / length
        x, y = (middle - a).T
        chosen = np.flatnonzero(np.abs(y * dx - x * dy) <= reach)
        x, y = (mesh.corners[boxed[chosen]] - a).T
        along, off = x * dx + y * dy, y * dx - x * dy
        slack = np.maximum(SLACK * mesh.sizes[boxed[chosen]], LIP)
        near[chosen] |= (
            (along.max(axis=0) >= -slack) & (along.min(axis=0) <= length + slack)
            & (off.max(axis=0) >= -slack) & (off.min(axis=0) <= slack)
        )
    if radius > 0:
        gap = np.linalg.norm(mesh.corners[:, :, None] - path[[0, -1]], axis=3).min(axis=(1, 2))
        return np.union1d(boxed[near], np.flatnonzero(gap <= radius))
    return boxed[near]
