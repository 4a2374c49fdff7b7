"""Fields of vectors as images that ITK, ANTs, nitransforms and 3D Slicer read alike.

Readers disagree on fields of one slice: ITK takes such a NIfTI for two-dimensional and refuses it, nitransforms drops
the axis of any, and points on one face of the slice are outside. So the slice is repeated below and above the plane,
SPREAD thicknesses apart: points half a slice off the plane are inside even for readers that stop at the outer slices'
centres, and those of the next slice are outside even for ITK, which goes on for half a step. Fields of volumes are as
they are; their axes must be perpendicular (`frames.volume.upright`), or ITK refuses them.
"""

import gzip
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.frames.slices import Slice, to_nifti
from xfemnav.imaging.frames.volume import Volume
from xfemnav.imaging.reading.lean import nibabel

SPREAD = 0.6                             # between 1/2 and 2/3
LPS = np.array([-1.0, -1.0, 1.0])
KINDS = "resampling", "modeling"         # 3D Slicer's words for fields of new points and of old ones


def vector_image(frame: Slice | Volume, field) -> sitk.Image:
    """`field` (n1, ..., d) mm, on the grid's axes, as an ITK image of vectors: LPS mm, float64; of a slice e1, e2 and
    three slices."""
    if isinstance(frame, Slice):
        return _of_slice(frame, field)
    image = sitk.GetImageFromArray(np.asarray(field, float).transpose(2, 1, 0, 3) * LPS, isVector=True)
    image.SetOrigin((frame.origin * LPS).tolist())
    image.SetSpacing(frame.spacing.tolist())
    image.SetDirection((LPS[:, None] * frame.steps / frame.spacing).ravel().tolist())
    return image


def _of_slice(slice: Slice, field) -> sitk.Image:
    vectors = np.asarray(field, float).swapaxes(0, 1) @ slice.axes[:2]
    vectors *= LPS
    image = sitk.GetImageFromArray(np.broadcast_to(vectors, (3, *vectors.shape)), isVector=True)
    e1, e2 = slice.axes[:2] * LPS
    normal, step = np.cross(e1, e2), SPREAD * slice.thickness
    image.SetOrigin((slice.to_world(slice.origin[None])[0] * LPS - step * normal).tolist())
    image.SetSpacing([*slice.spacing.tolist(), step])
    image.SetDirection(np.column_stack([e1, e2, normal]).ravel().tolist())
    return image


def write_nrrd(path, frame: Slice | Volume, field, kind: str) -> None:
    """Write `nrrd_bytes` to `path`. Raises OSError."""
    Path(path).write_bytes(nrrd_bytes(frame, field, kind))


def nrrd_bytes(frame: Slice | Volume, field, kind: str) -> bytes:
    """`vector_image` as .nrrd, float32, of a `kind` of KINDS; the same field gives the same bytes.

    Made in memory: teem, which writes NRRD for ITK, says nothing of a disk that is full at a file's last bytes.
    """
    if kind not in KINDS:
        raise ValueError(f"kind is {kind!r}, wanted one of {KINDS}")
    image = vector_image(frame, field)
    vectors = sitk.GetArrayViewFromImage(image).astype("<f4")
    axes = np.reshape(image.GetDirection(), (3, 3)).T * np.array(image.GetSpacing())[:, None]
    origin, *columns = ("({},{},{})".format(*place) for place in (image.GetOrigin(), *axes.tolist()))
    header = f"""NRRD0004
type: float
dimension: 4
space: left-posterior-superior
sizes: 3 {" ".join(map(str, image.GetSize()))}
space directions: none {" ".join(columns)}
kinds: vector domain domain domain
endian: little
encoding: gzip
space origin: {origin}
displacement field type:={kind}

"""
    return header.encode() + gzip.compress(vectors.tobytes(), compresslevel=1, mtime=0)


def field_nifti(frame: Slice | Volume, field) -> nibabel.Nifti1Image:
    """`field` (n1, ..., d) mm, on the grid's axes, as NIfTI of intent 1007 and shape (i, j, k, 1, 3), float32.

    Pixels and storage order are the input's, of a slice three of it; vectors are LPS mm. The normal of the slice is
    perpendicular to it also where the input's slices are stacked askew, which ITK would refuse.
    """
    if isinstance(frame, Slice):
        data, affine = _thrice(frame, field)
    else:
        data, affine = (field * LPS)[:, :, :, None].astype(np.float32), frame.affine
    image = nibabel.Nifti1Image(data, affine)
    image.set_sform(affine, frame.frame_code or 1)
    image.set_qform(affine, frame.frame_code or 1)
    image.header.set_xyzt_units("mm")
    image.header.set_intent("vector")
    return image


def _thrice(slice: Slice, field):
    """The vectors (i, j, k, 1, 3) of a slice's field, LPS mm, in three slices, and where they lie (4, 4)."""
    vectors = slice.to_storage(np.asarray(field, float) @ slice.axes[:2] * LPS)
    data = np.repeat(vectors, 3, axis=slice.array_axes[2])[:, :, :, None].astype(np.float32)
    signs = [-1.0 if flipped else 1.0 for flipped in slice.flipped]
    signs.append(np.copysign(1.0, slice.affine[:3, slice.array_axes[2]] @ slice.axes[2]))
    columns = slice.axes.T * (*slice.spacing, SPREAD * slice.thickness) * signs
    first = slice.origin + slice.flipped * (np.array(slice.values.shape) - 1) * slice.spacing
    affine = np.eye(4)
    affine[:3, list(slice.array_axes)] = columns
    affine[:3, 3] = slice.to_world(first[None])[0] - columns[:, 2]
    return data, affine


def vector_nifti(frame: Grid, vectors) -> nibabel.Nifti1Image:
    """`vectors` (n1, ..., 3) mm, world RAS, as an image of shape (i, j, k, 1, 3) on the input's grid.

    For nibabel and numpy. Intent 1007 (VECTOR) is read as LPS, so x and y are stored with the other sign; 1006 would
    mean RAS, but ITK's readers and writers do not agree on it.
    """
    parts = [to_nifti(frame, sign * np.asarray(vectors)[..., i]) for i, sign in enumerate(LPS)]
    data = np.stack([np.asarray(part.dataobj) for part in parts], axis=-1)[:, :, :, None, :]
    image = nibabel.Nifti1Image(data, parts[0].affine, parts[0].header)
    image.header.set_intent("vector")
    return image
