"""An image as NIfTI-1 bytes: what the pipeline writes."""

from dataclasses import dataclass

import numpy as np

from xfemnav.imaging.nifti import SCALAR_TYPES
from xfemnav.imaging.nifti_header import FIELDS, quaternion, rotation

TYPE_CODES = {np.dtype(name): code for code, name in SCALAR_TYPES.items()}
START, MILLIMETRES, VECTOR = 352, 2, 1007
SHEAR = 1e-3  # mm that a voxel's step may change when a quaternion states it


@dataclass(frozen=True, eq=False)
class NiftiImage:
    """`values` (ni, nj, nk, ...) of one of SCALAR_TYPES, `affine` (4, 4) voxel -> RAS mm, its code, and an intent."""

    values: np.ndarray
    affine: np.ndarray
    code: int
    intent: int = 0

    def to_bytes(self) -> bytes:
        """The file: header, no extension, voxels with the first axis fastest."""
        values = self.values.astype(self.values.dtype.newbyteorder("<"), copy=False)
        return self._header().tobytes() + bytes(START - 348) + values.tobytes(order="F")

    def as_nibabel(self):
        """The same image as one of nibabel's."""
        from nibabel import Nifti1Image

        return Nifti1Image.from_bytes(self.to_bytes())

    def _header(self):
        raw, shape = np.zeros((), FIELDS[348].newbyteorder("<")), self.values.shape
        raw["sizeof_hdr"], raw["magic"], raw["vox_offset"] = 348, b"n+1", START
        raw["dim"] = (len(shape), *shape, *[1] * (7 - len(shape)))
        raw["datatype"], raw["bitpix"] = TYPE_CODES[self.values.dtype], 8 * self.values.itemsize
        raw["scl_slope"] = 1
        raw["xyzt_units"], raw["intent_code"] = MILLIMETRES, self.intent
        raw["sform_code"], raw["qform_code"] = self.code, self.code
        raw["srow_x"], raw["srow_y"], raw["srow_z"] = self.affine[:3]
        self._state_qform(raw)
        return raw

    def _state_qform(self, raw) -> None:
        """The same frame by a quaternion. Its code is 0 where slices are tilted: it cannot hold the shear."""
        sizes = np.sqrt((self.affine[:3, :3] ** 2).sum(axis=0))
        directions = self.affine[:3, :3] / sizes
        handed = 1 if np.linalg.det(directions) > 0 else -1
        directions[:, 2] *= handed
        left, _, right = np.linalg.svd(directions)
        q = quaternion(left @ right)  # of the nearest rotation
        raw["pixdim"] = (handed, *sizes, 1, 1, 1, 1)
        raw["quatern_b"], raw["quatern_c"], raw["quatern_d"] = q[1:]
        raw["qoffset_x"], raw["qoffset_y"], raw["qoffset_z"] = self.affine[:3, 3]
        held = rotation(*q) * sizes * [1, 1, handed]
        if not np.allclose(held, self.affine[:3, :3], atol=SHEAR):
            raw["qform_code"] = 0
