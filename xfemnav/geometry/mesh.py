"""Mesh of simplices, triangles in the plane and tetrahedra in space: points, cells, and what follows from them."""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import factorial, sqrt

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
    """Simplices: `points` (n, d) mm, `cells` (m, d + 1) indices, positively oriented."""

    points: np.ndarray
    cells: np.ndarray

    def __post_init__(self):
        d = np.shape(self.points)[-1]
        object.__setattr__(self, "points", frozen_array(self.points, float, (None, d), "points"))
        object.__setattr__(self, "cells", frozen_array(self.cells, np.int64, (None, d + 1), "cells"))
        if len(self.cells) and (self.cells.min() < 0 or self.cells.max() >= len(self.points)):
            raise ValueError("cells name points that do not exist")
        if (self.volumes <= 0).any():
            raise ValueError(f"cell {int(np.argmin(self.volumes))} is flat or turned over (volume "
                             f"{self.volumes.min():.3g} mm{d})")

    @property
    def dim(self) -> int:
        """Dimension d."""
        return self.points.shape[1]

    @cached_property
    def corners(self) -> np.ndarray:
        """Corner positions (m, d + 1, d) mm."""
        return self.points[self.cells]

    @cached_property
    def volumes(self) -> np.ndarray:
        """Cell volumes (m,) mm^d: areas in the plane."""
        return volumes(self.corners)

    @cached_property
    def gradients(self) -> np.ndarray:
        """Gradients (m, d + 1, d) 1/mm of the nodal shape functions on each cell (Eq. 1)."""
        return gradients(self.corners)

    @cached_property
    def quality(self) -> np.ndarray:
        """Quality q = d r_in / r_out of each cell (m,): 1 regular, 0 flat (Persson & Strang 2004)."""
        squares = ((self.corners[:, 1:] - self.corners[:, :1]) ** 2).sum(axis=2)
        outer = np.linalg.norm(np.einsum("ma,mai->mi", squares, self.gradients[:, 1:]), axis=1) / 2
        return self.dim / (outer * np.linalg.norm(self.gradients, axis=2).sum(axis=1))

    @cached_property
    def edges(self) -> np.ndarray:
        """Unique edges (e, 2), smaller node first."""
        one, other = self.cells[:, list(combinations(range(self.dim + 1), 2))].reshape(-1, 2).T
        key = np.unique(np.minimum(one, other) * len(self.points) + np.maximum(one, other))
        return np.stack(np.divmod(key, len(self.points)), axis=1)

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Cell across the facet opposite each local node (m, d + 1); -1 on the boundary."""
        facets = np.sort(self.cells[:, _opposite(self.dim)].reshape(-1, self.dim), axis=1)
        key = facets[:, 0]
        for column in facets.T[1:]:
            key = key * len(self.points) + column
        order = np.argsort(key, kind="stable")
        same = np.flatnonzero(np.diff(key[order]) == 0)
        across = np.full(len(key), -1)
        one, other = order[same], order[same + 1]
        across[one], across[other] = other // (self.dim + 1), one // (self.dim + 1)
        return across.reshape(self.cells.shape)

    @cached_property
    def valences(self) -> np.ndarray:
        """Number (n,) of cells about each node."""
        return np.bincount(self.cells.ravel(), minlength=len(self.points))

    @cached_property
    def reaches(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle (m, d) mm of each cell, and a distance (m, 1) mm well beyond its corners."""
        middle = self.corners.mean(axis=1)
        return middle, 1.5 * np.linalg.norm(self.corners - middle[:, None], axis=2).max(axis=1)[:, None]

    @cached_property
    def boundary_facets(self) -> np.ndarray:
        """Facets (b, d) of the boundary, by nodes: edges with tissue on their left, triangles that turn left as seen
        from outside."""
        cell, local = np.nonzero(self.neighbours < 0)
        return self.cells[cell[:, None], _opposite(self.dim)[local]]

    @cached_property
    def boundary_loops(self) -> list[np.ndarray]:
        """In the plane: node indices of each closed boundary loop, tissue on the left, the longest loop first.

        Raises ValueError when two loops share a node (a pinched mesh).
        """
        follow = dict(self.boundary_facets.tolist())
        if len(follow) < len(self.boundary_facets):
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

    @property
    def outline(self) -> np.ndarray:
        """In the plane: the outline (k, 2) mm, the longest of `boundary_loops`."""
        return self.points[self.boundary_loops[0]]

    @cached_property
    def sizes(self) -> np.ndarray:
        """Edge length (m,) mm of the regular simplex with each cell's volume: the local element size h."""
        d = self.dim
        return (self.volumes * factorial(d) * sqrt(2**d / (d + 1))) ** (1 / d)


def volumes(corners: np.ndarray) -> np.ndarray:
    """Signed volumes (...) mm^d of simplices with `corners` (..., d + 1, d)."""
    return determinants(corners[..., 1:, :] - corners[..., :1, :]) / factorial(corners.shape[-1])


def determinants(rows: np.ndarray) -> np.ndarray:
    """Determinants (...) of `rows` (..., d, d)."""
    if rows.shape[-1] == 2:
        return rows[..., 0, 0] * rows[..., 1, 1] - rows[..., 0, 1] * rows[..., 1, 0]
    return np.einsum("...i,...i->...", rows[..., 0, :], np.cross(rows[..., 1, :], rows[..., 2, :]))


def area_vectors(facets: np.ndarray) -> np.ndarray:
    """Outward normals (b, d) of facets (b, d, d), see `Mesh.boundary_facets`, as long as they are large, mm^(d-1)."""
    edges = facets[:, 1:] - facets[:, :1]
    if facets.shape[-1] == 2:
        return np.stack([edges[:, 0, 1], -edges[:, 0, 0]], axis=1)
    return np.cross(edges[:, 0], edges[:, 1]) / 2


def gradients(corners: np.ndarray) -> np.ndarray:
    """Gradients (s, d + 1, d) 1/mm of the nodal shape functions on simplices with `corners` (s, d + 1, d) mm: across
    the facet opposite each node, inwards."""
    s, _, d = corners.shape
    if d == 2:
        across = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
        inward = np.stack([-across[..., 1], across[..., 0]], axis=-1)
    else:
        inward = -area_vectors(corners[:, _opposite(d)].reshape(-1, d, d)).reshape(s, d + 1, d)
    return inward / (d * volumes(corners))[:, None, None]


def _opposite(d: int) -> np.ndarray:
    """Local nodes (d + 1, d) of the facet opposite each local node, turned outwards (see `Mesh.boundary_facets`)."""
    facets = np.array([[k for k in range(d + 1) if k != i] for i in range(d + 1)])
    facets[1::2, -2:] = facets[1::2, :-3:-1]
    return facets
