"""The header of NIfTI files as bytes: its fields, and the frames that it can state.

nibabel knows all this too, but takes longer to load than a slice to read. Fields and quaternions: NIfTI-1.1 and NIfTI-2
header files, https://nifti.nimh.nih.gov; rotation to quaternion: I. Y. Bar-Itzhack, J. Guid. Control Dyn. 23 (2000).
"""

import numpy as np

# name and type, in the order of the file
_NIFTI_1 = """sizeof_hdr i4, data_type S10, db_name S18, extents i4, session_error i2, regular S1, dim_info u1, dim 8i2,
    intent_p1 f4, intent_p2 f4, intent_p3 f4, intent_code i2, datatype i2, bitpix i2, slice_start i2, pixdim 8f4,
    vox_offset f4, scl_slope f4, scl_inter f4, slice_end i2, slice_code u1, xyzt_units u1, cal_max f4, cal_min f4,
    slice_duration f4, toffset f4, glmax i4, glmin i4, descrip S80, aux_file S24, qform_code i2, sform_code i2,
    quatern_b f4, quatern_c f4, quatern_d f4, qoffset_x f4, qoffset_y f4, qoffset_z f4, srow_x 4f4, srow_y 4f4,
    srow_z 4f4, intent_name S16, magic S4"""
_NIFTI_2 = """sizeof_hdr i4, magic S4, eol_check 4i1, datatype i2, bitpix i2, dim 8i8, intent_p1 f8, intent_p2 f8,
    intent_p3 f8, pixdim 8f8, vox_offset i8, scl_slope f8, scl_inter f8, cal_max f8, cal_min f8, slice_duration f8,
    toffset f8, slice_start i8, slice_end i8, descrip S80, aux_file S24, qform_code i4, sform_code i4, quatern_b f8,
    quatern_c f8, quatern_d f8, qoffset_x f8, qoffset_y f8, qoffset_z f8, srow_x 4f8, srow_y 4f8, srow_z 4f8,
    slice_code i4, xyzt_units i4, intent_code i4, intent_name S16, dim_info u1, unused_str S15"""
FIELDS = {length: np.dtype([tuple(field.split()) for field in text.split(",")])
          for length, text in ((348, _NIFTI_1), (540, _NIFTI_2))}
"""Length of the header -> its fields."""


def unpacked(head: bytes, length: int, order: str):
    """The fields of the header of `length` bytes that `head` starts with, its numbers in byte `order` < or >."""
    return np.frombuffer(bytearray(head[:length]), FIELDS[length].newbyteorder(order))[0]


def best_affine(raw) -> np.ndarray:
    """Affine (4, 4) that the header `raw` states: its sform, else its qform, else its pixel sizes about the centre.

    Raises ValueError for a qform that is none.
    """
    affine = np.eye(4)
    if raw["sform_code"] != 0:
        affine[:3] = raw["srow_x"], raw["srow_y"], raw["srow_z"]
    elif raw["qform_code"] != 0:
        affine[:3, :3] = _qform(raw)
        affine[:3, 3] = raw["qoffset_x"], raw["qoffset_y"], raw["qoffset_z"]
    else:
        n = min(int(raw["dim"][0]), 3)
        sizes, shape = np.ones(3), np.ones(3)
        sizes[:n], shape[:n] = raw["pixdim"][1:n + 1], raw["dim"][1:n + 1]
        sizes[0] *= -1  # without a position, the first axis runs to the left
        affine[:3, :3], affine[:3, 3] = np.diag(sizes), -(shape - 1) / 2 * sizes
    return affine


def _qform(raw) -> np.ndarray:
    """The linear part (3, 3) of a qform. Raises ValueError where its numbers make no rotation of pixels."""
    sizes = raw["pixdim"][1:4].copy()
    if (sizes < 0).any():
        raise ValueError("pixdims[1,2,3] should be positive")
    if raw["pixdim"][0] not in (-1, 1):
        raise ValueError("qfac (pixdim[0]) should be 1 or -1")
    sizes[2] *= raw["pixdim"][0]
    # The first part of a unit quaternion is what is left of 1: a difference that cancels.
    bcd = np.array([raw["quatern_b"], raw["quatern_c"], raw["quatern_d"]], np.longdouble)
    square = 1 - bcd @ bcd
    if abs(square) < 3 * np.finfo(raw["quatern_b"].dtype).eps:
        square = 0
    if square < 0:
        raise ValueError(f"w2 should be positive, but is {square:e}")
    return rotation(np.sqrt(np.longdouble(square)), *bcd) @ np.diag(sizes)


def rotation(a, b, c, d) -> np.ndarray:
    """Rotation matrix (3, 3) of the quaternion a + bi + cj + dk, which need not have length 1."""
    twice = 2 / (a * a + b * b + c * c + d * d)
    x, y, z = b * twice, c * twice, d * twice
    ax, ay, az, bx, by, bz, cy, cz, dz = a * x, a * y, a * z, b * x, b * y, b * z, c * y, c * z, d * z
    return np.array([[1 - (cy + dz), by - az, bz + ay], [by + az, 1 - (bx + dz), cz - ax],
                     [bz - ay, cz + ax, 1 - (bx + cy)]])


def quaternion(R) -> np.ndarray:
    """Quaternion (4,) of length 1 of the rotation matrix `R` (3, 3), its first part not negative.

    It is the eigenvector of the largest eigenvalue of a symmetric matrix (lower half), and so the nearest for a matrix
    that is no rotation quite.
    """
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = R
    K = np.array([[xx - yy - zz, 0, 0, 0], [yx + xy, yy - xx - zz, 0, 0], [zx + xz, zy + yz, zz - xx - yy, 0],
                  [yz - zy, zx - xz, xy - yx, xx + yy + zz]]) / 3
    values, vectors = np.linalg.eigh(K)
    q = vectors[[3, 0, 1, 2], values.argmax()]
    return -q if q[0] < 0 else q
