"""Fields of vectors as NIfTI, in the one form that ITK, ANTs and 3D Slicer read alike."""

import nibabel
import numpy as np

from xfemnav.imaging.slices import Slice, to_nifti


def vector_nifti(slice: Slice, vectors) -> nibabel.Nifti1Image:
    """`vectors` (n1, n2, 3) mm, world RAS, as an image of shape (i, j, k, 1, 3) on the input's grid, one slice.

    Intent 1007 (VECTOR) is read as LPS, so x and y are stored with the other sign; 1006 would mean RAS, but ITK's
    readers and writers do not agree on it.
    """
    parts = [to_nifti(slice, sign * np.asarray(vectors)[..., i]) for i, sign in enumerate((-1, -1, 1))]
    data = np.stack([np.asarray(part.dataobj) for part in parts], axis=-1)[:, :, :, None, :]
    image = nibabel.Nifti1Image(data, parts[0].affine, parts[0].header)
    image.header.set_intent("vector")
    return image
