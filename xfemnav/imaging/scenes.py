"""The known scene as this program and ITK have it: its slice, triangles, motion and images."""

import numpy as np
import SimpleITK as sitk

from xfemnav.geometry.affine_map import PiecewiseAffineMap
from xfemnav.imaging.known import CUT, Scene
from xfemnav.imaging.reading import Image
from xfemnav.imaging.slices import Slice, take_slice


def scene_triangles(scene: Scene, frame: Slice):
    """The triangles of the scene at rest and now in plane coordinates of a slice, both (4, 3, 2) mm."""
    return (frame.from_world(scene.world(corners))[0] for corners in (scene.rest, scene.moved))


def scene_slice(scene: Scene) -> Slice:
    """The scene's slice, without a file."""
    values, affine = scene.volume()
    return take_slice(Image(values, affine, "float64", 2, "", "scene"), plane="axial", position_mm=scene.position_mm)


def scene_motion(scene: Scene, frame: Slice, rest, moved) -> PiecewiseAffineMap:
    """The motion of the triangles, two-valued on the scene's cut."""
    return PiecewiseAffineMap(rest, moved, (frame.from_world(scene.world(CUT))[0],))


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
