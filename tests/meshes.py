"""Meshes and problems that several test files share: jittered rectangles, regular grids, meshed outlines."""

import functools
from dataclasses import fields, replace

import numpy as np
from scipy.spatial import Delaunay

from data_synthetic import domains
from xfemnav.geometry.mesh import Mesh, orient
from xfemnav.geometry.plane.cut import Cut, place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.subcells import embed
from xfemnav.mechanics.conditions.problem import Problem, pose
from xfemnav.mechanics.rules import Basis, LipRules, Loads, Measured, Rules, Skull
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material

BRAIN = Material()
HARD_SKULL = Skull("fixed", craniotomy_mm=15.0, ramp_mm=0.0)
FREE = Skull("free")


@functools.cache
def jittered(width=20.0, height=16.0, h=1.0, jitter=0.25, seed=0) -> Mesh:
    """Rectangle with its lower left corner at the origin: a grid of spacing `h`, inner nodes shaken, Delaunay."""
    rng = np.random.default_rng(seed)
    nx, ny = round(width / h), round(height / h)
    x, y = np.meshgrid(np.linspace(0, width, nx + 1), np.linspace(0, height, ny + 1), indexing="ij")
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    inner = (points > 0).all(axis=1) & (points < (width, height)).all(axis=1)
    points[inner] += jitter * h * rng.uniform(-1, 1, (inner.sum(), 2))
    cells = Delaunay(points).simplices
    area = orient(*points[cells].swapaxes(0, 1))
    cells[area < 0] = cells[area < 0][:, ::-1]
    return Mesh(points, cells[np.abs(area) > 1e-9 * h * h])


@functools.cache
def grid(n=8, size=8.0) -> Mesh:
    """Square [0, size]^2 of n x n boxes, each cut by the diagonal from its lower left to its upper right corner."""
    x, y = np.meshgrid(np.linspace(0, size, n + 1), np.linspace(0, size, n + 1), indexing="ij")
    node = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (k.ravel() for k in (node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]))
    return Mesh(np.stack([x.ravel(), y.ravel()], axis=1), np.vstack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


@functools.cache
def disc(radius=70.0, h=7.0) -> Mesh:
    """A disc by the house's own mesh generator."""
    return distmesh(domains.disc(radius), h)


def outline(mesh) -> np.ndarray:
    """The mesh's boundary loop (n, 2) mm."""
    return mesh.outline


def cut_in(mesh, *path, **kind) -> Cut:
    """The cut along a path, clipped to the mesh."""
    return place_cut(path, outline(mesh), **kind)


def space_of(mesh, *cuts, tip_enrichment="topological") -> Space:
    """The finite element space of a mesh with cuts."""
    split = embed(mesh, cuts)
    return Space(mesh, split, enrich(mesh, split, Basis(tip_enrichment)))


def posed(mesh, cuts, material, skull, retractions=(), *, resections=(), **said) -> Problem:
    """`pose` with the fields of its values by their names; measured motion of the outline as rows and their weight."""
    rows, weight = said.pop("boundary_displacement", None), said.pop("boundary_weight", None)
    if rows is not None:
        skull = replace(skull, measured=Measured(rows, weight))

    def of(kind):
        return kind(**{field.name: said.pop(field.name) for field in fields(kind) if field.name in said})

    basis, lips, loads = of(Basis), of(LipRules), of(Loads)
    return pose(mesh, cuts, material, skull, retractions, resections, loads, Rules(basis, lips, **said))


def measured_outline(mesh, cut, u) -> np.ndarray:
    """Rows x, y, ux, uy, side of a field u(points, side) at all ends of outline facets of the cut mesh.

    `side` is that of the facet: +1 left and -1 right of the walk along a straight or slightly bent cut.
    """
    split = embed(mesh, (cut,))
    a, b = split.rim.facets.swapaxes(0, 1)
    path = split.paths[0]
    travel = path[-1] - path[0]
    side = np.sign(orient(path[0], path[0] + travel, (a + b) / 2))
    points, side = np.concatenate([a, b]), np.tile(side, 2)
    return np.column_stack([points, u(points, side), side])


def turn(angle) -> np.ndarray:
    """Rotation matrix (2, 2), counter-clockwise, rad."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def mapped(mesh, Q, shift=(0.0, 0.0)) -> Mesh:
    """The mesh under x -> Q x + shift; a mirrored mesh has its cells turned over again."""
    cells = mesh.cells if np.linalg.det(Q) > 0 else mesh.cells[:, ::-1]
    return Mesh(mesh.points @ np.asarray(Q).T + shift, cells)
