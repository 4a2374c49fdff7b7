"""Triangles for the map: plain ones as they are, those with branch functions divided, graded towards the tip.

The displacement is affine on plain triangles and behaves as sqrt(r) at a tip: there uniform refinement converges as
n^-1/2 only, a fan whose rings halve the radius is right.
"""

import numpy as np

RINGS = 8
RAYS = 6
UNIFORM = 4


def graded_triangles(space) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (t, 3, 2) mm of the cut organ at rest and the part (t,) that each lies in; in space its tetrahedra."""
    split = space.parts
    if not len(space.branch_parts):
        return split.corners, split.part
    branched = np.isin(split.part, space.branch_parts)
    corners, part = split.corners[branched], split.part[branched]
    at_tip = np.zeros((len(corners), 3), dtype=bool)
    if len(split.fronts.at):
        gap = np.linalg.norm(corners[:, :, None] - split.fronts.at, axis=3).min(axis=2)
        at_tip = gap <= 1e-9 * np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)[:, None]
    fans = at_tip.sum(axis=1) == 1
    turn = (np.argmax(at_tip[fans], axis=1)[:, None] + np.arange(3)) % 3
    pieces = [(split.corners[~branched], split.part[~branched])]
    for weights, chosen, owner in (
        (_fan(), np.take_along_axis(corners[fans], turn[:, :, None], axis=1), part[fans]),
        (_uniform(), corners[~fans], part[~fans]),
    ):
        triangles = np.einsum("wka,tai->twki", weights, chosen).reshape(-1, 3, 2)
        pieces.append((triangles, np.repeat(owner, len(weights))))
    return np.concatenate([p[0] for p in pieces]), np.concatenate([p[1] for p in pieces])


def _fan():
    """Barycentric corners (w, 3, 3) of a fan about the first corner: rings of radius 2^-k, evenly spaced rays."""
    radius = np.concatenate([[0.0], 0.5 ** np.arange(RINGS - 1, -1, -1)])
    ray = np.arange(RAYS + 1) / RAYS

    def point(k, j):
        return np.array([1 - radius[k], radius[k] * (1 - ray[j]), radius[k] * ray[j]])

    triangles = []
    for j in range(RAYS):
        triangles.append([point(0, 0), point(1, j), point(1, j + 1)])
        for k in range(1, RINGS):
            triangles.append([point(k, j), point(k + 1, j), point(k + 1, j + 1)])
            triangles.append([point(k, j), point(k + 1, j + 1), point(k, j + 1)])
    return np.array(triangles)


def _uniform():
    """Barycentric corners (w, 3, 3) of a triangle's division into UNIFORM^2 equal ones."""
    n = UNIFORM

    def point(i, j):
        return np.array([n - i - j, i, j]) / n

    triangles = []
    for i in range(n):
        for j in range(n - i):
            triangles.append([point(i, j), point(i + 1, j), point(i, j + 1)])
            if i + j < n - 1:
                triangles.append([point(i + 1, j), point(i + 1, j + 1), point(i, j + 1)])
    return np.array(triangles)
