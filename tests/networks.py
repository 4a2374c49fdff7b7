"""Random networks of cuts and resections on small random meshes, near-coincidences included, from one seed."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay

from tests.meshes import grid, jittered
from xfemnav.geometry.mesh import Mesh, orient

OFFSETS = 10.0 ** -np.arange(1, 13)


@dataclass(frozen=True)
class Network:
    """As drawn: cuts as (path (k, 2) mm, internal), resections as tuples of rings (k, 2) mm."""

    mesh: Mesh
    cuts: list
    resections: list


def random_mesh(rng) -> Mesh:
    """30 to 150 nodes of spacing about 1 mm: a shaken rectangle, a regular grid, or random points in a disc."""
    kind = rng.integers(3)
    if kind == 0:
        return jittered(float(rng.integers(5, 13)), float(rng.integers(4, 10)), 1.0, 0.3, int(rng.integers(20)))
    if kind == 1:
        n = int(rng.integers(5, 11))
        return grid(n, float(n))
    radius = rng.uniform(3.0, 6.0)
    n = int(2 * np.pi * radius)
    angle = 2 * np.pi * np.arange(n) / n
    points = [radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)]
    for x in radius * rng.uniform(-1, 1, (400, 2)):  # as many as keep their distance
        every = np.concatenate(points)
        if np.hypot(*x) < radius - 0.6 and np.hypot(*(every - x).T).min() > 0.75:
            points.append(x[None])
    points = np.concatenate(points)
    cells = Delaunay(points).simplices
    area = orient(*points[cells].swapaxes(0, 1))
    cells[area < 0] = cells[area < 0][:, ::-1]
    return Mesh(points, cells[np.abs(area) > 1e-9])


def random_network(seed: int) -> Network:
    """One mesh with up to three cuts and up to two resections."""
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng)
    cuts, lines = [], [mesh.points]
    for _ in range(rng.integers(0, 4)):
        path, internal = _cut(mesh, lines, rng)
        path = _moved(path, mesh, lines, rng)
        cuts.append((path, internal))
        lines.append(path)
    resections = []
    for _ in range(rng.choice(3, p=[0.4, 0.4, 0.2])):
        rings = tuple(_moved(ring, mesh, lines, rng) for ring in _rings(mesh, rng))
        resections.append(rings)
        lines.extend(rings)
    return Network(mesh, cuts, resections)


def _inside(mesh, rng):
    """Somewhere in the organ."""
    return rng.dirichlet(np.ones(3)) @ mesh.corners[rng.integers(len(mesh.cells))]


def _on_outline(mesh, rng):
    a, b = mesh.points[mesh.boundary_facets[rng.integers(len(mesh.boundary_facets))]]
    return a + rng.uniform() * (b - a)


def _cut(mesh, lines, rng):
    """From the outline, right through, inside, off another cut, or on from another's tip: two to six points."""
    middle = [_inside(mesh, rng) for _ in range(rng.choice(5, p=[0.5, 0.2, 0.15, 0.1, 0.05]))]
    kind = rng.integers(5) if len(lines) > 1 else rng.integers(3)
    if kind == 0:
        return np.array([_on_outline(mesh, rng), *middle, _inside(mesh, rng)]), False
    if kind == 1:
        return np.array([_on_outline(mesh, rng), *middle, _on_outline(mesh, rng)]), False
    if kind == 2:
        return np.array([_inside(mesh, rng), *middle, _inside(mesh, rng)]), True
    other = lines[rng.integers(1, len(lines))]
    if kind == 3:  # a branch
        k = rng.integers(len(other) - 1)
        start = other[k] + rng.uniform() * (other[k + 1] - other[k])
        return np.array([start, *middle, _inside(mesh, rng)]), True
    ahead = other[-1] - other[-2]  # faces the other's tip, nearly on its line
    start = other[-1] + rng.uniform(0.05, 1.0) * ahead / np.linalg.norm(ahead)
    return np.array([start, start + rng.uniform(0.5, 3) * ahead / np.linalg.norm(ahead)]), True


def _rings(mesh, rng):
    """A blob, a ring around tissue, two blobs, a hole with an island, or a box along the grid."""
    at, radius = _inside(mesh, rng), rng.choice([0.05, 0.4, 1.0, 2.0, 3.0])
    kind = rng.integers(6)
    if kind < 2:
        return [_blob(at, radius, rng)]
    if kind == 2:
        return [_blob(at, radius, rng), _blob(at, rng.uniform(0.2, 0.8) * radius, rng)]
    if kind == 3:
        return [_blob(at, radius, rng), _blob(_inside(mesh, rng), radius, rng)]
    if kind == 4:
        return [_blob(at, f * radius, rng) for f in (1.0, 0.6, 0.3)]
    low, high = np.sort(np.round(rng.uniform(mesh.points.min(axis=0), mesh.points.max(axis=0), (2, 2))), axis=0)
    return [np.array([low, (high[0], low[1]), high, (low[0], high[1])])]


def _blob(centre, radius, rng):
    n = rng.integers(3, 20)
    angle = np.sort(rng.uniform(0, 2 * np.pi, n)) if rng.uniform() < 0.3 else 2 * np.pi * np.arange(n) / n
    r = radius * (1 if rng.uniform() < 0.5 else rng.uniform(0.5, 1, n))
    return centre + np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def _moved(path, mesh, lines, rng):
    """Some vertices put on nodes, edges, or other lines, exactly or 1e-1 to 1e-12 mm beside them; some rounded."""
    path = path.copy()
    for k in range(len(path)):
        how = rng.integers(12)
        if how == 0:
            path[k] = mesh.points[np.argmin(np.hypot(*(mesh.points - path[k]).T))]
        elif how == 1:
            a, b = mesh.points[mesh.edges[np.argmin(np.hypot(*(mesh.points[mesh.edges].mean(axis=1) - path[k]).T))]]
            path[k] = a + rng.uniform() * (b - a)
        elif how == 2 and len(lines) > 1:
            other = lines[rng.integers(1, len(lines))]
            path[k] = other[rng.integers(len(other))]
        elif how == 3 and len(lines) > 1:
            other = lines[rng.integers(1, len(lines))]
            j = rng.integers(len(other) - 1)
            path[k] = other[j] + rng.uniform() * (other[j + 1] - other[j])
        elif how == 4:
            path[k] = np.round(path[k], rng.integers(0, 3))
        if how < 5 and rng.uniform() < 0.5:
            path[k] += rng.choice(OFFSETS) * rng.normal(size=2)
    return path


