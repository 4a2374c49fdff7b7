"""Points of the organ's outline at which it can be held, pressed or measured."""

from dataclasses import dataclass

import numpy as np

from xfemnav.mechanics.quadrature import gauss
from xfemnav.mechanics.space import Space


@dataclass(frozen=True, eq=False)
class Rim:
    """Points of the outline: points (k, 2) mm, parts (k,) that they are taken in, and the facet (k,) of each.

    Of that facet: middles (k, 2) mm, outward normals (k, 2), lengths (k,) mm.
    """

    points: np.ndarray
    parts: np.ndarray
    facet: np.ndarray
    middles: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray


def rim_points(space: Space) -> Rim:
    """Where the outline can be held: both ends of all facets (b of them first, then b), inner points of those with
    branch functions."""
    branched = np.flatnonzero(np.isin(space.parts.rim.parts, space.branch_parts))
    every = np.arange(len(space.parts.rim.parts))
    fraction = np.repeat([0.0, 1.0, 1 / 3, 2 / 3], [len(every), len(every), len(branched), len(branched)])
    return _rim(space, np.concatenate([every, every, branched, branched]), fraction)


def rim_quadrature(space: Space, facets, pieces: int = 8, n: int = 4) -> tuple[Rim, np.ndarray]:
    """n Gauss points in each of equal pieces of the facets (f,), and their weights (q,) mm."""
    t, w = gauss(n)
    t, w = ((np.arange(pieces)[:, None] + (t + 1) / 2) / pieces).ravel(), np.tile(w / 2 / pieces, pieces)
    rim = _rim(space, np.repeat(facets, len(t)), np.tile(t, len(facets)))
    return rim, rim.lengths * np.tile(w, len(facets))


def _rim(space, facet, fraction):
    a, b = space.parts.rim.facets[facet].swapaxes(0, 1)
    length = np.linalg.norm(b - a, axis=1)
    d = (b - a) / length[:, None]
    outward = np.stack([d[:, 1], -d[:, 0]], axis=1)  # tissue is on the left
    points = a + fraction[:, None] * (b - a)
    return Rim(points, space.parts.rim.parts[facet], facet, (a + b) / 2, outward, length)
