"""NIfTI headers with two frames, and where other programs' libraries put their voxels."""

import nibabel as nib
import numpy as np
import SimpleITK as sitk
from small import RAS, brain

from tests.motions import turned

TURNED = np.eye(4)
TURNED[:3, :3] = turned(8.0)
TURNED[:3, 3] = 5, -3, 2


def two_frames(path, values=None, sform=RAS, qform=TURNED @ RAS, codes=(2, 1), kind=nib.Nifti1Image, **fields):
    """Write a NIfTI of `values` (ni, nj, nk) with these frames and codes of sform and qform, and whatever `fields`."""
    values = brain()[:, :, None] if values is None else values
    header = kind.header_class()
    header.set_data_dtype(values.dtype)
    header.set_data_shape(values.shape)
    header.set_qform(qform, codes[1])
    header.set_sform(sform, codes[0])
    header["vox_offset"], header["magic"] = header.single_vox_offset, header.single_magic
    for name, value in fields.items():
        header[name] = value
    content = header.binaryblock
    path.write_bytes(content + bytes(header.single_vox_offset - len(content)) + values.tobytes(order="F"))
    return path


def itk_affine(path) -> np.ndarray:
    """Affine (4, 4) voxel -> RAS mm of the file as SimpleITK reads it."""
    image = sitk.ReadImage(str(path))
    affine, n = np.eye(4), image.GetDimension()
    affine[:n, :n] = np.reshape(image.GetDirection(), (n, n)) * image.GetSpacing()
    affine[:n, 3] = image.GetOrigin()
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
