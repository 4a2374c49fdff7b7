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
from xfemnav.imaging.reading.gate import Image
from xfemnav.imaging.reading.lean import nibabel
from xfemnav.imaging.reading.nifti_frames import Frames, plain_header

SAME_VOXEL = 0.05  # voxels apart up to which two grids are one: files round their affines


@dataclass(frozen=True, eq=False)
class Volume:
    """An image in space: `values` (n1, n2, n3) in storage order, `affine` (4, 4) voxel -> RAS mm.

    `values` are the image's own array, which is read-only. `frame_code` and `frames` as of an `Image`.
    """

    values: np.ndarray
    affine: np.ndarray
    frame_code: int
    frames: Frames | None = None
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

    def header(self) -> nibabel.Nifti1Header:
        """A NIfTI header with the frames of the input, or twice the one that it has."""
        if self.frames is not None:
            return self.frames.header(0, 0)
        return plain_header(self.affine, self.frame_code)


def take_volume(image: Image) -> Volume:
    """The whole of `image`. Raises E105 when it is one slice."""
    if 1 in image.values.shape:
        raise XfemnavError("E105", f"{image.name} is one slice of {' x '.join(map(str, image.values.shape))} voxels, "
                                   "not a volume.")
    return Volume(image.values, image.affine, image.frame_code, image.frames)


def reordered(image: Image, like: Volume) -> np.ndarray | None:
    """Values (n1, n2, n3) of an `image` on the grid of `like`, whatever its storage order; None of another grid."""
    matrix, shape = np.linalg.inv(image.affine) @ like.affine, np.array(image.values.shape)
    turn = np.rint(matrix[:3, :3])
    order = abs(turn).argmax(axis=0)  # the image's axis along each axis of `like`
    if (abs(turn) != np.eye(3)[:, order]).any() or (shape[order] != like.values.shape).any():
        return None
    ends = np.array(list(product(*((0, n - 1) for n in like.values.shape))))
    first = np.where(turn.sum(axis=1) < 0, shape - 1, 0)
    if abs(ends @ (matrix[:3, :3] - turn).T + matrix[:3, 3] - first).max() > SAME_VOXEL:
        return None
    return image.values.transpose(order)[tuple(slice(None, None, int(sign)) for sign in turn.sum(axis=0))]
