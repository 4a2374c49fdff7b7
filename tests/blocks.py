"""Blocks of cubes cut into simplices along their diagonals, in the plane and in space, and cuts placed in them."""

import functools
from itertools import permutations

import numpy as np

from xfemnav.geometry.mesh import Mesh, volumes
from xfemnav.geometry.solid.levels import Level


@functools.cache
def block(d: int, n: int) -> Mesh:
    """[0, n]^d of n^d unit cubes, each in d! simplices about its diagonal (Kuhn 1960)."""
    node = np.arange((n + 1) ** d).reshape((n + 1,) * d)
    low = np.stack(np.meshgrid(*[np.arange(n)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    points = np.stack(np.meshgrid(*[np.arange(n + 1.0)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    cells = np.concatenate([node[tuple((low[:, None] + _stairs(order)).transpose(2, 0, 1))]
                            for order in permutations(range(d))])
    turned = volumes(points[cells]) < 0
    cells[turned, -2:] = cells[turned, :-3:-1]
    return Mesh(points, cells)


def _stairs(order):
    """From corner to corner of the unit cube, one axis after the other (d + 1, d)."""
    return np.concatenate([np.zeros((1, len(order)), int), np.eye(len(order), dtype=int)[list(order)].cumsum(axis=0)])


def located(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cell (k,) of a block that holds each of `points` (k, d), and its shares (k, d + 1) of the cell's corners on
    the way up. It knows no geometry but how the block was made: one goes up the axes by falling fractions."""
    d, n = mesh.dim, round(mesh.points.max())
    low = np.clip(np.floor(points).astype(int), 0, n - 1)
    falling = np.argsort(low - points, axis=1, kind="stable")
    height = np.take_along_axis(points - low, falling, 1)
    orders = np.array(list(permutations(range(d))))
    order = (falling[:, None] == orders).all(axis=2).argmax(axis=1)
    return order * n**d + np.ravel_multi_index(low.T, (n,) * d), -np.diff(height, axis=1, prepend=1.0, append=0.0)


def interpolated(mesh: Mesh, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Nodal values (f, n) of a block's functions at points (k, d) inside it: (f, k)."""
    cell, share = located(mesh, points)
    up = np.argsort(mesh.points[mesh.cells].sum(axis=2), axis=1)  # the corners on the way
    nodes = np.take_along_axis(mesh.cells, up, 1)[cell]
    return np.einsum("fka,ka->fk", values[:, nodes], share)


OFFSETS = (0.0, 1e-15, 1e-9, 1e-5, 2e-3)  # of a plane from a lattice plane, as well as any


def plane(mesh: Mesh, rng) -> np.ndarray:
    """Signed distance (n,) from a random plane, one that runs along the lattice in a third of the cases."""
    d, n = mesh.dim, mesh.points.max()
    if rng.random() < 0.33:
        normal = np.array(rng.choice([-1, 0, 1], d), float)
        normal[rng.integers(d)] = 1.0
        through = rng.integers(1, n, d) + rng.choice(OFFSETS)
    else:
        normal, through = rng.normal(size=d), n * rng.uniform(0.25, 0.75, d)
    return (mesh.points - through) @ (normal / np.linalg.norm(normal))


def through_cut(mesh, rng):
    return (Level(plane(mesh, rng)),)


def internal_end(mesh, rng):
    return (Level(plane(mesh, rng), [plane(mesh, rng)]),)


def patch(mesh, rng):
    return (Level(plane(mesh, rng), [plane(mesh, rng), plane(mesh, rng)]),)


def crossing(mesh, rng):
    return Level(plane(mesh, rng)), Level(plane(mesh, rng))


def branch(mesh, rng):
    stem = plane(mesh, rng)
    return Level(stem), Level(plane(mesh, rng), [stem])


def branch_of_a_patch(mesh, rng):
    stem, end = plane(mesh, rng), plane(mesh, rng)
    return Level(stem, [end]), Level(plane(mesh, rng), [-stem, end])


def kink(mesh, rng):
    return (Level(np.maximum(plane(mesh, rng), plane(mesh, rng))),)


def ball(mesh, rng):
    n = mesh.points.max()
    middle = rng.integers(1, n, mesh.dim) if rng.random() < 0.3 else n * rng.uniform(0.2, 0.8, mesh.dim)
    return (Level(np.linalg.norm(mesh.points - middle, axis=1) - n * rng.uniform(0.1, 0.4), takes_out=True),)


def ball_at_a_cut(mesh, rng):
    return *through_cut(mesh, rng), *ball(mesh, rng)


def three(mesh, rng):
    return Level(plane(mesh, rng)), Level(plane(mesh, rng)), Level(plane(mesh, rng), [plane(mesh, rng)])


KINDS = (through_cut, internal_end, patch, crossing, branch, branch_of_a_patch, kink, ball, ball_at_a_cut, three)
