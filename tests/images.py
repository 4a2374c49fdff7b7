"""Images that several tests share."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np
from nilearn.datasets import load_mni152_brain_mask, load_mni152_template
from scipy import ndimage
from scipy.spatial.transform import Rotation

from data_synthetic.phantom import GRIDS, Phantom
from xfemnav.imaging.frames.slices import Slice, take_slice
from xfemnav.imaging.organ.masks import one_piece
from xfemnav.imaging.reading.gate import Image

ORDERS = list(product(permutations(range(3)), product((False, True), repeat=3)))  # 48 storage orders


def image_of(values, affine, name="image.nii.gz", code=2) -> Image:
    return Image(values, affine, "float64", code, "", name)


def affine_of(linear, origin=(-30.0, 20.0, 5.0)) -> np.ndarray:
    return np.vstack([np.column_stack([linear, origin]), [0, 0, 0, 1]])


def stored(image: Image, order, flips) -> Image:
    """The same physical image with its array axes in another order and direction."""
    values, affine = image.values.transpose(order), image.affine[:, [*order, 3]].copy()
    for axis in np.flatnonzero(flips):
        affine[:, 3] += affine[:, axis] * (values.shape[axis] - 1)
        affine[:, axis] *= -1
        values = np.flip(values, axis)
    return image_of(values, affine)


def brain() -> tuple[Image, Image]:
    """A real average brain without skull (MNI152, T1, 1 mm), and its mask."""
    return tuple(image_of(np.asarray(load(resolution=1).dataobj, float), load(resolution=1).affine)
                 for load in (load_mni152_template, load_mni152_brain_mask))


def slice_of(values, spacing=(1.0, 1.0), origin=(0.0, 0.0)) -> Slice:
    """Axial slice of `values` (n1, n2) at z = 0."""
    return take_slice(image_of(np.asarray(values, float)[:, :, None], affine_of(np.diag([*spacing, 1]), (*origin, 0))))


def phantom_head(seed=1, grid="A", **scene) -> tuple[Slice, np.ndarray]:
    """Noisy phantom with skull and scalp, and its brain mask."""
    phantom = Phantom(grid=GRIDS[grid], **scene)
    return slice_of(phantom.image(seed), phantom.grid.spacing, phantom.grid.origin), phantom.mask


def head_of(slice: Slice, rng: np.random.Generator, bridges: int = 3) -> tuple[Slice, np.ndarray]:
    """A brain slice put into a head: 2 mm of fluid, a dark skull, bright scalp, strands through the skull, an uneven
    coil and noise. Returns the slice and its brain mask."""
    mask = one_piece(slice.values > 0)
    out = ndimage.distance_transform_edt(~mask)
    skull, scalp = rng.uniform(4, 8), rng.uniform(4, 8)
    inside = 700 * slice.values / np.percentile(slice.values[mask], 98)
    values = np.select([out == 0, out <= 2, out <= 2 + skull, out <= 2 + skull + scalp], [inside, 150, 60, 850], 0)
    away = np.moveaxis(np.indices(mask.shape), 0, -1) - ndimage.center_of_mass(mask)
    for angle in rng.uniform(-np.pi, np.pi, bridges):
        along, across = away @ [np.cos(angle), np.sin(angle)], away @ [-np.sin(angle), np.cos(angle)]
        values[(abs(across) < rng.uniform(0.5, 2)) & (along > 0) & (out > 0) & (out <= 2 + skull)] = 450
    coil = 1 + 0.2 * np.cos(away[..., 0] / 80 + rng.uniform(0, 6)) * np.cos(away[..., 1] / 90 + rng.uniform(0, 6))
    clean = ndimage.gaussian_filter(values.astype(float), 0.6) * coil
    noise = rng.normal(0, 20, (2, *mask.shape))
    return replace(slice, values=np.hypot(clean + noise[0], noise[1])), mask


def oblique_volume() -> tuple[Image, np.ndarray]:
    """A small volume with uneven voxels, turned against all axes of the world, of whole numbers with negative ones;
    and points (n, 3) RAS mm inside it."""
    rng = np.random.default_rng(7)
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    affine = affine_of(turn * [0.8, 1.3, 2.5], (-31.7, 24.9, 11.3))
    values = rng.integers(-300, 300, (7, 6, 5)).astype(float)
    inside = rng.uniform(0, 1, (40, 3)) * (np.array(values.shape) - 1)
    return image_of(values, affine), inside @ affine[:3, :3].T + affine[:3, 3]


def values_at(image: Image, points) -> np.ndarray:
    """Linear interpolation (n,) of an image at points (n, 3) RAS mm; NaN outside."""
    voxels = np.linalg.solve(image.affine[:3, :3], (points - image.affine[:3, 3]).T)
    return ndimage.map_coordinates(image.values, voxels, order=1, cval=np.nan)
