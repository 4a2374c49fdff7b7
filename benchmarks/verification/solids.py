"""Masks of organs in space to be meshed, and what is measured of a mesh: angles, defects of its boundary, fidelity."""

import numpy as np
from nilearn.datasets import load_mni152_brain_mask
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.solid.field import Field

OBLIQUE = np.linalg.qr(np.array([[0.94, 0.21, -0.1], [-0.3, 0.9, 0.2], [0.17, -0.25, 0.95]]))[0]
SAMPLED = 0.4  # mm between points by which surfaces are compared


def brain(spacing: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """MNI152 brain mask (n1, n2, n3) of 1 or 2 mm, and its affine (4, 4)."""
    image = load_mni152_brain_mask(resolution=spacing)
    return np.asarray(image.dataobj) > 0, image.affine


def shape(inside, reach=40.0, spacing=(1.0, 1.0, 1.0), turn=None) -> tuple[np.ndarray, np.ndarray]:
    """Mask of where `inside(x, y, z)` of mm about the middle, and its affine; `turn` (3, 3) lays its axes obliquely."""
    affine = np.eye(4)
    affine[:3, :3] = (np.eye(3) if turn is None else turn) * spacing
    n = np.ceil(2 * reach / np.array(spacing)).astype(int)
    affine[:3, 3] = -affine[:3, :3] @ ((n - 1) / 2)
    x = np.moveaxis(np.indices(n), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
    return inside(*np.moveaxis(x, -1, 0)), affine


def ball(radius, x=0.0, y=0.0, z=0.0):
    """A ball as a function of places."""
    return lambda a, b, c: (a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2 < radius**2


def rough(x, y, z):
    """Of the size of a cerebellum, with folia: ridges 2 mm high every 7 mm."""
    return (x / 48) ** 2 + (y / 30) ** 2 + (z / 26) ** 2 < (1 + 0.06 * np.sin(2 * np.pi * (z + 0.1 * y) / 7)) ** 2


def noisy(x, y, z):
    """A ball of 28 mm whose edge is off by up to some millimetres."""
    noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=x.shape), 1.5)
    return np.sqrt(x**2 + y**2 + z**2) < 28 + 2 * noise / noise.std()


def masks() -> dict:
    """Twenty masks with their affines, by name."""
    whole, affine = brain()
    coarse, affine_2 = brain(2)
    places = np.indices(whole.shape)
    left = places[0] < whole.shape[0] // 2
    lesions = np.zeros(whole.shape, bool)
    for radius, centre in ((12, (60, 120, 90)), (9, (140, 80, 100)), (15, (100, 170, 70))):
        lesions |= sum((p - c) ** 2 for p, c in zip(places, centre)) < radius**2
    child, thick = affine.copy(), affine.copy()
    child[:3, :3] *= 0.7
    thick[:, 2] *= 5
    rng = np.random.default_rng(1)
    return {
        "brain": (whole, affine), "left half of it": (whole & left, affine),
        "right half of it": (whole & ~left, affine), "brain less three lesions": (whole & ~lesions, affine),
        "child's size": (whole, child),
        "brain, 2 mm": (coarse, affine_2), "brain, 1 x 1 x 5 mm": (whole[:, :, 2::5], thick),
        "brain with holes": (whole & (ndimage.zoom(rng.random([n // 6 + 1 for n in whole.shape]), 6, order=0)[
            tuple(slice(n) for n in whole.shape)] > 0.02), affine),
        "brain that the image cuts": (whole[:, :, 40:130], affine),
        "cerebellum": shape(rough, 52), "cerebellum, oblique": shape(rough, 56, (1, 1, 1.5), OBLIQUE),
        "ball": shape(ball(30)), "ball, oblique 1 x 1 x 3 mm": shape(ball(30), 40, (1, 1, 3), OBLIQUE),
        "ellipsoid": shape(lambda x, y, z: (x / 35) ** 2 + (y / 25) ** 2 + (z / 15) ** 2 < 1),
        "torus": shape(lambda x, y, z: (np.hypot(x, y) - 24) ** 2 + z**2 < 10**2),
        "two balls that touch": shape(lambda *x: ball(15, -14.5)(*x) | ball(15, 14.5)(*x)),
        "strip of a shell": shape(lambda x, y, z: (abs(np.sqrt(x**2 + y**2 + z**2) - 30) < 3) & (abs(y) < 9) & (z > 0)),
        "ball with a noisy edge": shape(noisy), "tiny": shape(ball(5), 10),
        "box": shape(lambda x, y, z: (abs(x) < 20) & (abs(y) < 15) & (abs(z) < 10)),
    }


def about_place(field: Field):
    """Wanted sizes about a place of the organ that is fine, 1.25 mm, within 20 mm."""
    inside = np.argwhere(field.values > 0)
    place = field.origin + inside[np.argmax(inside @ (0.3, 0.5, 0.8))] @ field.axes
    return lambda points: 1.25 + 0.1 * np.maximum(np.linalg.norm(points - place, axis=1) - 20, 0)


def coarse_for(field: Field) -> float:
    """Largest elements, mm, of organs of the size of a brain and of smaller ones."""
    return 5.0 if (field.values > 0).sum() * abs(np.linalg.det(field.axes)) > 3e5 else 2.5


def dihedral(mesh: Mesh) -> np.ndarray:
    """The six angles (m, 6) between faces of each tetrahedron, degrees."""
    g = mesh.gradients / np.linalg.norm(mesh.gradients, axis=2)[:, :, None]
    a, b = np.triu_indices(4, 1)
    return np.degrees(np.arccos(np.clip(-np.einsum("mai,mai->ma", g[:, a], g[:, b]), -1, 1)))


def defects(mesh: Mesh) -> tuple[int, int]:
    """How many edges of the boundary are not in just two of its facets, and nodes not in one ring of them."""
    facets = mesh.boundary_facets
    corner = np.arange(facets.size).reshape(facets.shape)
    ends, own = (np.concatenate([x[:, [0, 1]], x[:, [1, 2]], x[:, [2, 0]]]) for x in (facets, corner))
    order = np.argsort(ends, axis=1)
    ends, own = np.take_along_axis(ends, order, 1), np.take_along_axis(own, order, 1)
    order = np.lexsort(ends.T)
    ends, own = ends[order], own[order]
    same = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    joins = np.stack([own[same], own[same + 1]], axis=-1).reshape(-1, 2)
    rings = connected_components(coo_array((np.ones(len(joins)), joins.T), (facets.size,) * 2), directed=False)[0]
    return int((np.unique(ends, axis=0, return_counts=True)[1] != 2).sum()), rings - len(np.unique(facets))


def surface_points(corners: np.ndarray) -> np.ndarray:
    """Points on triangles (b, 3, 3) mm, about SAMPLED apart."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    found, count = [], np.maximum(np.ceil(longest / SAMPLED), 1).astype(int)
    for n in np.unique(count):
        share = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        found.append((share @ corners[count == n]).reshape(-1, 3))
    return np.concatenate(found)


def zero_level(field: Field) -> np.ndarray:
    """Triangles (b, 3, 3) mm of a field's zero."""
    points, facets, *_ = marching_cubes(field.values.copy(), 0.0)
    return (field.origin + points @ field.axes)[facets]


def fidelity(field: Field, mesh: Mesh) -> dict[str, float]:
    """How the mesh differs from where the field is positive: `volume`, relative, by that within the zero level; `p99`
    and `far`, mm, the 99th percentile and most of the distances between the surfaces, from either."""
    level = zero_level(field)
    own, theirs = surface_points(mesh.points[mesh.boundary_facets]), surface_points(level)
    away = [cKDTree(b).query(a)[0] for a, b in ((own, theirs), (theirs, own))]
    volume = abs(np.linalg.det(level).sum()) / 6
    return {"volume": float(mesh.volumes.sum() / volume - 1), "p99": float(max(np.percentile(x, 99) for x in away)),
            "far": float(max(x.max() for x in away))}
