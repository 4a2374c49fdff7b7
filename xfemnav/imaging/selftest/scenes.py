"""The known scene as this program and ITK have it: its slice, triangles, motion and images."""

import numpy as np
import SimpleITK as sitk

from xfemnav.geometry.motion import Motion
from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.frames.slices import Slice, take_slice
from xfemnav.imaging.reading.gate import Image
from xfemnav.imaging.selftest.known import CUT, Scene


def scene_slice(scene: Scene) -> Slice:
    """The scene's slice, without a file."""
    values, affine = scene.volume()
    return take_slice(Image(values, affine, "float64", 2, "", "scene"), plane="axial", position_mm=scene.position_mm)


def scene_motion(scene: Scene, frame: Grid) -> Motion:
    """The motion of the scene's triangles in plane coordinates of a slice, two-valued on its cut."""
    rest, moved, cut = (frame.from_world(scene.world(points))[0] for points in (scene.rest, scene.moved, CUT))
    return Motion(rest, moved, (cut,))


def itk_image(values, affine) -> sitk.Image:
    """`values` (ni, nj, nk), or (ni, nj, nk, nc) for vectors, on the grid of `affine` (4, 4) RAS, as an image of ITK,
    whose world is LPS."""
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    sizes = np.linalg.norm(lps[:3, :3], axis=0)
    stored = np.ascontiguousarray(np.moveaxis(values, (0, 1, 2), (2, 1, 0))).astype(np.float32)
    image = sitk.GetImageFromArray(stored, isVector=stored.ndim == 4)
    image.SetOrigin(lps[:3, 3].tolist())
    image.SetSpacing(sizes.tolist())
    image.SetDirection((lps[:3, :3] / sizes).ravel().tolist())
    return image
