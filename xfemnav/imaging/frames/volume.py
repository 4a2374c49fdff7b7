"""Volumes: a whole image in space, where it lies and in its own storage order; nothing of it is copied or turned.

Its points are world RAS mm (n, 3) themselves: whatever way the file counts its voxels, mechanics and all that is
carried along see the same places.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging.frames.grid import SAME_PIXEL, at, by
from xfemnav.imaging.reading.gate import Image
from xfemnav.imaging.reading.lean import nibabel
from xfemnav.imaging.reading.nifti_frames import OTHER, PERPENDICULAR, Frames, plain_header

BESIDE = 1.5  # voxels: a surface of voxels that touch the image's border lies nearer to it, any other one farther


@dataclass(frozen=True, eq=False)
class Volume:
    """An image in space: `values` (n1, n2, n3) in storage order, `affine` (4, 4) voxel -> RAS mm.

    `values` are the image's own array, which is read-only. `frame_code` and `frames` as of an `Image`.
    """

    values: np.ndarray
    affine: np.ndarray
    frame_code: int
    frames: Frames | None = None
    name = "the volume"  # what messages call it
    thickness = 0.0  # mm: every point lies in the volume, none off it
    axes = np.eye(3)  # of its points: the world's

    def __post_init__(self):
        object.__setattr__(self, "affine", frozen_array(self.affine, float, (4, 4), "affine"))

    @property
    def origin(self) -> np.ndarray:
        """Centre (3,) of the first voxel, mm."""
        return self.affine[:3, 3]

    @property
    def steps(self) -> np.ndarray:
        """Steps (3, 3) mm from voxel to voxel along each array axis, as columns."""
        return self.affine[:3, :3]

    @cached_property
    def spacing(self) -> np.ndarray:
        """Lengths (3,) mm of the steps along each array axis."""
        return np.linalg.norm(self.steps, axis=0)

    def to_pixels(self, points) -> np.ndarray:
        """Voxel coordinates (n, 3) of points (n, 3)."""
        return (np.asarray(points, float) - self.origin) @ np.linalg.inv(self.steps).T

    def padded(self, before, after) -> "Volume":
        """The grid, without values, with so many voxels (3,) more along each array axis, on either side."""
        affine = self.affine.copy()
        affine[:3, 3] -= self.steps @ before
        return _grid(affine, np.array(self.values.shape) + before + after, self.frame_code)

    @property
    def placed(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (3, 3) and shift (3,) that take points to the world: they are there."""
        return np.eye(3), np.zeros(3)

    @property
    def corners(self) -> np.ndarray:
        """Centres (8, 3) of the voxels at the image's corners, mm."""
        return self.voxels_to_world(list(product(*((0, n - 1) for n in self.values.shape))))

    @property
    def lattice(self) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
        """Where the voxels are: origin, steps, and how many along each array axis."""
        return self.origin, self.steps, self.values.shape

    def to_world(self, points) -> np.ndarray:
        """World RAS mm (n, 3) of points (n, 3): themselves."""
        return np.asarray(points, float)

    def from_world(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) of world points (n, 3) RAS mm, themselves, and how far (n,) mm they are off: 0."""
        points = np.asarray(points, float)
        return points, np.zeros(points.shape[:-1])

    def voxels_to_world(self, voxels) -> np.ndarray:
        """World RAS mm (n, 3) of voxel indices (n, 3), as the file counts them."""
        return np.asarray(voxels, float) @ self.steps.T + self.origin

    def pixel_centres(self) -> np.ndarray:
        """World RAS mm (n1, n2, n3, 3) of the voxel centres: 24 bytes a voxel."""
        return self.voxels_to_world(np.moveaxis(np.indices(self.values.shape), 0, -1))

    def to_storage(self, values) -> np.ndarray:
        """`values` (n1, n2, n3, ...) on the voxels in the file's order: as they are."""
        return np.asarray(values)

    def border(self, mask) -> tuple | None:
        """Where the image ends inside the organ of a `mask` (n1, n2, n3): the corners (low, high) of its box in voxels,
        how near (voxels) to its sides the organ ends there, and the rows (3, 4) that take points to voxels; None when
        the mask does not touch the box."""
        if not any(np.take(mask, end, axis=axis).any() for axis in range(3) for end in (0, -1)):
            return None
        rows = tuple(map(tuple, np.linalg.inv(self.affine)[:3].tolist()))
        return (-0.5,) * 3, tuple(n - 0.5 for n in self.values.shape), BESIDE, rows

    def header(self) -> nibabel.Nifti1Header:
        """A NIfTI header with the frames of the input, or twice the one that it has."""
        if self.frames is not None:
            return self.frames.header(0, 0)
        return plain_header(self.affine, self.frame_code)


def _grid(affine, shape, frame_code: int) -> Volume:
    """A grid all of whose values are 0, and take no room."""
    return Volume(np.broadcast_to(0.0, tuple(map(int, shape))), affine, frame_code)


def upright(volume: Volume, spacing_mm: float | None = None) -> Volume:
    """The grid of `volume`, without values, as programs built on ITK can have it: with perpendicular axes, and voxels
    of `spacing_mm` where that is given. It holds all that the volume holds.
    """
    directions = volume.steps / volume.spacing
    U, _, W = np.linalg.svd(directions)
    turned, square = U @ W, abs(directions.T @ directions - np.eye(3)).max() < PERPENDICULAR
    if square and spacing_mm is None:
        return _grid(volume.affine, volume.values.shape, volume.frame_code)
    spacing = volume.spacing if spacing_mm is None else np.full(3, float(spacing_mm))
    along = volume.corners @ turned
    low, high = along.min(axis=0), along.max(axis=0)
    shape = np.ceil((high - low) / spacing - SAME_PIXEL).astype(int) + 1
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = turned * spacing, turned @ low
    return _grid(affine, shape, volume.frame_code)


def take_volume(image: Image) -> Volume:
    """The whole of `image`. Raises E105 when it is one slice."""
    if 1 in image.values.shape:
        raise XfemnavError("E105", f"{image.name} is one slice of {' x '.join(map(str, image.values.shape))} voxels, "
                                   "not a volume.")
    return Volume(image.values, image.affine, image.frame_code, image.frames)


def world_points(volume: Volume, points, space: str = "ras") -> np.ndarray:
    """World RAS mm (n, 3) of a user's `points` (n, 3), read in `space` ras, lps or voxel. Raises E780 for others."""
    try:
        points = frozen_array(points, float, (None, 3), "points")
    except ValueError as error:
        raise XfemnavError("E780", f"points in a volume are rows of 3 numbers: {error}.") from None
    if not np.isfinite(points).all():
        raise XfemnavError("E780", "points in a volume are finite numbers; some are not.")
    return volume.voxels_to_world(points) if space == "voxel" else points * ([-1, -1, 1] if space == "lps" else 1)


def values_in(image: Image, like: Volume, *, resample: str | None = None) -> np.ndarray:
    """Values (n1, n2, n3) of `image`, in any storage order, at the voxels of `like`.

    Raises E204 when its grid is another one and `resample` is not "nearest" or "linear" (zero outside the image).
    """
    if (values := _reordered(image, image.affine, like, like.affine)) is not None:
        return values
    if resample is None:
        raise XfemnavError("E204", f"grids differ: {_words(image.values.shape, image.affine, image.name)}; "
                                   f"{_words(like.values.shape, like.affine, 'the volume')}. "
                                   f"{_by_other_frames(image, like)}Resample it, or give ⟦resample_mask=True⟧.")
    from scipy.ndimage import map_coordinates

    matrix, values = np.linalg.inv(image.affine) @ like.affine, np.zeros(like.values.shape)
    for k, plane in enumerate(values):    # plane by plane: places take 24 bytes a voxel
        here = np.array(np.meshgrid(k, *map(np.arange, plane.shape), indexing="ij"))[:, 0]
        voxels = np.einsum("ij,j...->i...", matrix[:3, :3], here) + matrix[:3, 3, None, None]
        nearest = np.rint(voxels)
        inside = ((nearest >= 0) & (nearest < np.array(image.values.shape)[:, None, None])).all(axis=0)
        order = 1 if resample == "linear" else 0
        plane[inside] = map_coordinates(image.values, voxels[:, inside], order=order, mode="nearest")
    return values


def _reordered(image: Image, affine, like: Volume, own) -> np.ndarray | None:
    """Values (n1, n2, n3) of an `image` by its `affine` on the grid of `like` by its `own`; None of another grid."""
    matrix, shape = np.linalg.inv(affine) @ own, np.array(image.values.shape)
    turn = np.rint(matrix[:3, :3])
    order = abs(turn).argmax(axis=0)  # the image's axis along each axis of `like`
    if (abs(turn) != np.eye(3)[:, order]).any() or (shape[order] != like.values.shape).any():
        return None
    ends = np.array(list(product(*((0, n - 1) for n in like.values.shape))))
    first = np.where(turn.sum(axis=1) < 0, shape - 1, 0)
    if abs(ends @ (matrix[:3, :3] - turn).T + matrix[:3, 3] - first).max() > SAME_PIXEL:
        return None
    return image.values.transpose(order)[tuple(slice(None, None, int(sign)) for sign in turn.sum(axis=0))]


def _by_other_frames(image: Image, like: Volume) -> str:
    """A hint where the grids are one when a frame of the headers is taken that was not: "" for none."""
    for wanted in OTHER:
        affine, own = (item.affine if item.frames is None else item.frames.affine(wanted) for item in (image, like))
        if affine is not None and own is not None and _reordered(image, affine, like, own) is not None:
            return f"By the {wanted} of their headers they are one grid: ⟦nifti_frame={wanted}⟧. "
    return ""


def _words(shape, affine, name: str) -> str:
    size = np.linalg.norm(affine[:3, :3], axis=0)
    return f"{name} has {by(shape)} voxels of {by(size)} mm, the first at ({at(affine[:3, 3])})"
