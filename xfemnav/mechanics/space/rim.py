"""Points of the organ's outline at which it can be held, pressed or measured."""

from dataclasses import dataclass

import numpy as np

from xfemnav.geometry.mesh import area_vectors
from xfemnav.mechanics.space.quadrature import gauss_in_simplex
from xfemnav.mechanics.space.space import Space


@dataclass(frozen=True, eq=False)
class Rim:
    """Points of the outline: points (k, d) mm, parts (k,) that they are taken in, and the facet (k,) of each.

    Of that facet: middles (k, d) mm, outward normals (k, d), sizes (k,) mm^(d-1), in the plane lengths.
    """

    points: np.ndarray
    parts: np.ndarray
    facet: np.ndarray
    middles: np.ndarray
    normals: np.ndarray
    sizes: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Lengths (k,) mm of the facets: in space those of squares as large."""
        return self.sizes ** (1 / (self.points.shape[1] - 1))


def rim_points(space: Space) -> Rim:
    """Where the outline can be held: the corners of all facets (the first of each, then the next of each), and inner
    points of those with branch functions."""
    branched = np.flatnonzero(np.isin(space.parts.rim.parts, space.branch_parts))
    every, corners = np.arange(len(space.parts.rim.parts)), np.eye(space.mesh.dim)
    inner = (1 + corners) / (1 + len(corners))
    facet = np.concatenate([np.tile(every, len(corners)), np.tile(branched, len(inner))])
    return _rim(space, facet, np.concatenate([np.repeat(corners, len(every), axis=0),
                                              np.repeat(inner, len(branched), axis=0)]))


def rim_quadrature(space: Space, facets, pieces: int = 8, n: int = 4) -> tuple[Rim, np.ndarray]:
    """Gauss points of equal pieces of the facets (f,), divided along their first edge, and their weights (q,)
    mm^(d-1)."""
    d = space.mesh.dim
    shares, weights = gauss_in_simplex(d - 1, n)
    step, parts = np.arange(pieces + 1) / pieces, np.tile(np.eye(d), (pieces, 1, 1))
    parts[:, 0, 0], parts[:, 0, 1], parts[:, 1, 0], parts[:, 1, 1] = 1 - step[:-1], step[:-1], 1 - step[1:], step[1:]
    shares, weights = (shares @ parts).reshape(-1, d), np.tile(weights / pieces, pieces)
    rim = _rim(space, np.repeat(facets, len(weights)), np.tile(shares, (len(facets), 1)))
    return rim, rim.sizes * np.tile(weights, len(facets))


def _rim(space, facet, shares):
    """Points of facets (k,) by their shares (k, d) of the corners."""
    rim = space.parts.rim
    outward = area_vectors(rim.facets)[facet]
    sizes = np.linalg.norm(outward, axis=1)
    points = np.einsum("ka,kai->ki", shares, rim.facets[facet])
    return Rim(points, rim.parts[facet], facet, rim.facets[facet].mean(axis=1), outward / sizes[:, None], sizes)
