"""The motion for other programs: fields on a grid, of the new image to the old one and back, and ITK's transform file.

Both directions come from the triangles: neither is the other one inverted. A field on a grid has one value a pixel, so
it is not the motion itself, which has two on a cut; that is what the mesh with doubled lips and `Result` are for.
"""

from pathlib import Path

import numpy as np
import SimpleITK as sitk

from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.gaps import bridged, extended
from xfemnav.imaging.carrying.hdf5 import transform_bytes
from xfemnav.imaging.carrying.solid import SolidPullBack
from xfemnav.imaging.carrying.vectors import vector_image
from xfemnav.imaging.carrying.warp import PullBack, covered, pull_back
from xfemnav.imaging.frames.grid import Grid

MARGIN = 2    # pixels of nothing around the tissue: a field that ends with 0 is the same to all, however they go on


def roomy(frame: Grid, points) -> Grid:
    """`frame` with so many pixels added that the `points` (..., d) mm keep MARGIN pixels from its border.

    Beyond a field's pixels ITK leaves points where they are, 3D Slicer goes on with the last value: neither may happen
    to tissue. No pixel is taken away, because there are readers that take places outside of a field for others in it.
    """
    n, points = np.array(frame.values.shape), np.asarray(points, float)
    pixels = frame.to_pixels(points.reshape(-1, points.shape[-1]))
    before = np.maximum(np.ceil(MARGIN - pixels.min(axis=0)), 0).astype(int)
    after = np.maximum(np.ceil(pixels.max(axis=0) + MARGIN - (n - 1)), 0).astype(int)
    return frame.padded(before, after)


def backward(frame: Grid, organ, tissue: Motion, gaps: str = "bridged",
             known: PullBack | SolidPullBack | None = None) -> np.ndarray:
    """Where the `tissue` in each pixel of `frame` rested minus where it is now, (n1, ..., d) mm.

    Pixels of the `organ`, simplices (m, d + 1, d) mm at rest, that hold no tissue now are `gaps`, "bridged" or
    "extended" (see `imaging.carrying.gaps`). What is neither organ nor tissue is 0. `known`: the pull-back on these
    pixels, if it is.
    """
    motion = known or pull_back(tissue.rest, tissue.moved, *frame.lattice)
    empty = covered(organ, *frame.lattice) & ~motion.tissue
    if gaps == "extended":
        return extended(motion, empty)
    if gaps == "bridged":
        return bridged(motion, empty, tissue)
    raise ValueError(f"gaps is {gaps!r}, wanted bridged or extended")


def forward(frame: Grid, tissue: Motion) -> np.ndarray:
    """Displacement (n1, ..., d) mm of the `tissue` that rested at each pixel centre of `frame`; 0 where none is left.

    Exact at the centres; whoever interpolates between two of them across a cut gets
    something between the motions of its lips.
    """
    return pull_back(tissue.moved, tissue.rest, *frame.lattice).field


def itk_transform(frame: Grid, field) -> sitk.CompositeTransform:
    """Transform of world points (LPS mm, as ITK counts) from the new image to the old one, by `field` (n1, ..., d) mm.

    It holds for points up to half a slice off the plane and in the frame's pixels; ITK leaves all others where they
    are. A composite, because there are readers that skip the first transform of a file and expect its parts behind it.
    """
    return sitk.CompositeTransform([sitk.DisplacementFieldTransform(vector_image(frame, field))])


def write_transform(path, frame: Grid, field) -> None:
    """Write `itk_bytes` to `path`. Raises OSError."""
    Path(path).write_bytes(itk_bytes(frame, field))


def itk_bytes(frame: Grid, field) -> bytes:
    """`itk_transform` as ITK's .h5 file; the same field gives the same bytes."""
    part = sitk.DisplacementFieldTransform(itk_transform(frame, field).GetNthTransform(0))
    vectors = sitk.GetArrayViewFromImage(part.GetDisplacementField())
    return transform_bytes([
        ("CompositeTransform_double_3_3", (), ()),
        ("DisplacementFieldTransform_double_3_3", part.GetFixedParameters(), vectors.ravel())])
