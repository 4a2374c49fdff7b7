"""Triangle mesh: points, cells, and what follows from them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np


def frozen_array(values, dtype, shape, name) -> np.ndarray:
    """Copy of `values` that is read-only; `shape` holds lengths, or None where any length will do.

    Raises ValueError when the shape does not fit.
    """
    array = np.array(values, dtype=dtype, order="C", copy=True)
    if array.ndim != len(shape) or any(want is not None and want != got for want, got in zip(shape, array.shape)):
        raise ValueError(f"{name} has shape {array.shape}, wanted {shape}")
    array.setflags(write=False)
    return array


def orient(a, b, c) -> np.ndarray:
    """Twice the signed area of the triangles a, b, c (..., 2), positive when they turn left."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in plane coordinates: `points` (n, 2) mm, `cells` (m, 3) indices, positively oriented."""

    points: np.ndarray
    cells: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "points", frozen_array(self.points, float, (None, 2), "points"))
        object.__setattr__(self, "cells", frozen_array(self.cells, np.int64, (None, 3), "cells"))
        if len(self.cells) and (self.cells.min() < 0 or self.cells.max() >= len(self.points)):
            raise ValueError("cells name points that do not exist")
        if (self.areas <= 0).any():
            raise ValueError(
                f"cell {int(np.argmin(self.areas))} is flat or turned over (area {self.areas.min():.3g} mm2)"
            )

    @cached_property
    def corners(self) -> np.ndarray:
        """Corner positions (m, 3, 2) mm."""
        return self.points[self.cells]

    @cached_property
    def areas(self) -> np.ndarray:
        """Cell areas (m,) mm^2."""
        a, b, c = self.points[self.cells].swapaxes(0, 1)
        return orient(a, b, c) / 2

    @cached_property
    def gradients(self) -> np.ndarray:
        """Gradients (m, 3, 2) 1/mm of the three nodal shape functions on each cell (Eq. 1)."""
        x = self.corners
        opposite = x[:, [2, 0, 1]] - x[:, [1, 2, 0]]
        return np.stack([-opposite[..., 1], opposite[..., 0]], axis=-1) / (2 * self.areas)[:, None, None]

    @cached_property
    def quality(self) -> np.ndarray:
        """Quality q = 2 r_in / r_out of each cell (m,): 1 equilateral, 0 flat (Persson & Strang 2004)."""
        x = self.corners
        a, b, c = (np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in ((1, 2), (2, 0), (0, 1)))
        return (b + c - a) * (c + a - b) * (a + b - c) / (a * b * c)

    @cached_property
    def edges(self) -> np.ndarray:
        """Unique edges (e, 2), smaller node first."""
        one, other = self.cells.ravel(), self.cells[:, [1, 2, 0]].ravel()
        key = np.unique(np.minimum(one, other) * len(self.points) + np.maximum(one, other))
        return np.stack(np.divmod(key, len(self.points)), axis=1)

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Cell across the edge opposite each local node (m, 3); -1 on the boundary."""
        one, other = self.cells[:, [1, 2, 0]].ravel(), self.cells[:, [2, 0, 1]].ravel()
        key = np.minimum(one, other) * len(self.points) + np.maximum(one, other)
        order = np.argsort(key, kind="stable")
        same = np.flatnonzero(np.diff(key[order]) == 0)
        across = np.full(len(key), -1)
        across[order[same]], across[order[same + 1]] = order[same + 1] // 3, order[same] // 3
        return across.reshape(-1, 3)

    @cached_property
    def valences(self) -> np.ndarray:
        """Number (n,) of cells about each node."""
        return np.bincount(self.cells.ravel(), minlength=len(self.points))

    @cached_property
    def reaches(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle (m, 2) mm of each cell, and a distance (m, 1) mm well beyond its corners."""
        middle = self.corners.mean(axis=1)
        return middle, 1.5 * np.linalg.norm(self.corners - middle[:, None], axis=2).max(axis=1)[:, None]

    @cached_property
    def boundary_edges(self) -> np.ndarray:
        """Edges (b, 2) of the boundary, tissue on their left."""
        cell, local = np.nonzero(self.neighbours < 0)
        return np.stack([self.cells[cell, (local + 1) % 3], self.cells[cell, (local + 2) % 3]], axis=1)

    @cached_property
    def boundary_loops(self) -> list[np.ndarray]:
        """Node indices of each closed boundary loop, tissue on the left, the longest loop first.

        Raises ValueError when two loops share a node (a pinched mesh).
        """
        follow = dict(self.boundary_edges.tolist())
        if len(follow) < len(self.boundary_edges):
            raise ValueError("the mesh is pinched: two boundary loops share a node")
        loops = []
        while follow:
            start, node = follow.popitem()
            loop = [start]
            while node != start:
                loop.append(node)
                node = follow.pop(node)
            loops.append(np.array(loop))
        return sorted(loops, key=len, reverse=True)

    @cached_property
    def sizes(self) -> np.ndarray:
        """Edge length (m,) mm of the equilateral triangle with each cell's area: the local element size h."""
        return np.sqrt(self.areas * 4 / np.sqrt(3))
