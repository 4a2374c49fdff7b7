"""The phantom's opening as a solver without error would return it, on slices of any plane, tilt and storage order."""

import nibabel as nib
import numpy as np
import SimpleITK as sitk

from data_synthetic.phantom import Grid, Phantom, perfect_solution
from tests.images import image_of, stored
from xfemnav.imaging.frames.slices import PLANES, Slice, take_slice, to_nifti

GRID = Grid((100, 130), (2.0, 1.6), "LAS")
PHANTOM = Phantom(grid=GRID)
REST, MOVED = perfect_solution(PHANTOM, 360, 30)
OFFSET, THICKNESS = 12.5, 3.0    # mm
AS_IS = (0, 1, 2), (False, False, False)
LAS = (0, 1, 2), (True, False, False)
MIXED = (2, 0, 1), (True, False, True)
SCENES = [("axial", 0, AS_IS), ("axial", 20, LAS), ("coronal", 0, LAS), ("coronal", 15, MIXED), ("sagittal", 25, MIXED)]


def slice_in(plane="axial", degrees=0.0, storage=AS_IS, grid=GRID) -> Slice:
    """The phantom's slice lying in `plane`, turned by `degrees` about (1, 1, 1), in a storage order (axes, flips)."""
    axes = np.eye(3)[list(PLANES[plane])] @ turned(degrees).T    # rows e1, e2, normal
    affine = np.eye(4)
    affine[:3, :3] = axes.T * (*grid.spacing, THICKNESS)
    affine[:3, 3] = [*grid.origin, OFFSET] @ axes
    return take_slice(stored(image_of(np.zeros((*grid.shape, 1)), affine), *storage))


def turned(degrees) -> np.ndarray:
    """Rotation (3, 3) about (1, 1, 1), by Rodrigues' formula."""
    K = np.cross(np.eye(3), np.ones(3) / np.sqrt(3))
    t = np.radians(degrees)
    return np.eye(3) + np.sin(t) * K + (1 - np.cos(t)) * K @ K


def itk_image(slice: Slice, values, folder) -> sitk.Image:
    """`values` (n1, n2) on the slice's pixels as ITK reads them from a file of nibabel's."""
    nib.save(to_nifti(slice, values, np.float64), folder / "values.nii")
    return sitk.ReadImage(str(folder / "values.nii"), sitk.sitkFloat64)


def from_itk(slice: Slice, image: sitk.Image) -> np.ndarray:
    """Values (n1, n2) of an ITK image in the slice's storage order."""
    values = sitk.GetArrayFromImage(image).transpose(2, 1, 0).transpose(slice.array_axes)[:, :, 0]
    return np.flip(values, [k for k in (0, 1) if slice.flipped[k]])


def finer(slice: Slice, n: int, margin: int) -> tuple[np.ndarray, np.ndarray, sitk.Image]:
    """Origin and spacing (2,) mm of a grid `n` times as fine, `margin` pixels inside the slice's border, and that grid
    for ITK along e1 and e2."""
    spacing, origin = slice.spacing / n, slice.origin + margin * slice.spacing
    shape = (np.array(slice.values.shape) - 1 - 2 * margin) * n + 1
    e1, e2 = slice.axes[:2] * (-1, -1, 1)
    grid = sitk.Image([*shape.tolist(), 1], sitk.sitkFloat64)
    grid.SetOrigin((slice.to_world(origin[None])[0] * (-1, -1, 1)).tolist())
    grid.SetSpacing([*spacing.tolist(), 1.0])
    grid.SetDirection(np.column_stack([e1, e2, np.cross(e1, e2)]).ravel().tolist())
    return origin, spacing, grid


def landing(slice: Slice, transform, folder, grid=None) -> np.ndarray:
    """Where `transform` makes ITK look for each pixel, plane mm (n1, n2, 2): the image of each coordinate, resampled.

    At the slice's pixels, or at those of an ITK `grid` along e1 and e2. NaN where ITK looks outside the image.
    """
    found = []
    for k in (0, 1):
        image = itk_image(slice, slice.pixel_centres()[..., k], folder)
        out = sitk.Resample(image, image if grid is None else grid, transform, sitk.sitkLinear, np.nan)
        found.append(from_itk(slice, out) if grid is None else sitk.GetArrayFromImage(out)[0].T)
    return np.stack(found, axis=-1)
