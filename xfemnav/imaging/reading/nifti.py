"""NIfTI-1 and NIfTI-2 (.nii) bytes -> stored voxels and where they lie.

The header is checked field by field before any voxel is touched, because readers trust it: dimensions of
32767 x 32767 x 32767 in a 17 kB file are a MemoryError in most of them, a zero affine is a silent spacing of 1.
Field meanings: NIfTI-1.1 and NIfTI-2 header files, https://nifti.nimh.nih.gov.
"""

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.formats import LPS, RAS, VOXEL_MM, Header, Vectors, check_affine, is_usable
from xfemnav.imaging.reading.lean import nibabel
from xfemnav.imaging.reading.nifti_frames import OTHER, Frames, chosen

SCALAR_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
COLOUR_TYPES = {128: "RGB", 2304: "RGBA"}
COMPLEX_TYPES = {32: "complex64", 1792: "complex128", 2048: "complex256"}
MM_PER_UNIT = {1: 1e3, 3: 1e-3}  # metre, micron; 0 (unknown) and 2 are mm
NO_POSITION = "its qform and sform codes are 0"
SYMMETRIC, DISPLACEMENT, VECTOR = 1005, 1006, 1007  # intents, of which ITK's are LPS: the first and the last
VECTORS = {SYMMETRIC: Vectors(None, LPS, "lower"), DISPLACEMENT: Vectors(RAS), VECTOR: Vectors(LPS, LPS)}

_KINDS = {348: (nibabel.Nifti1Header, b"n+1\0"), 540: (nibabel.Nifti2Header, b"n+2\0")}


def _kind(head: bytes):
    """(header class, byte order, length) of the header that `head` starts with, or None."""
    for order, name in (("<", "little"), (">", "big")):
        length = int.from_bytes(head[:4], name)
        if length in _KINDS and len(head) >= length:
            header_class, magic = _KINDS[length]
            start = 344 if length == 348 else 4
            if head[start : start + 4] == magic:
                return header_class, order, length
    return None


def recognises(head: bytes) -> bool:
    """Whether `head`, the first bytes of a file, starts a single-file NIfTI."""
    return _kind(head) is not None


def _raw(head: bytes):
    header_class, order, length = _kind(head)
    return header_class(head[:length], endianness=order, check=False)


def read_header(head: bytes, name: str) -> Header:
    """Checked header of the file `name` whose first bytes are `head`.

    Raises E105 for an impossible field, E122 for colour and complex voxels.
    """
    raw = _raw(head)
    slope, inter = float(raw["scl_slope"]), float(raw["scl_inter"])
    intent = int(raw["intent_code"])
    return Header(_shape(raw, name), _dtype(raw, name), _offset(raw, name), slope, inter, intent,
                  vectors=VECTORS.get(intent, Vectors()))


@np.errstate(all="ignore")  # what overflows is refused by its result
def read_frame(head: bytes, name: str, wanted: str = "auto") -> tuple[np.ndarray, int]:
    """Affine (4, 4) voxel -> RAS mm, and its code (0: the file states no position).

    Of two frames the one that is `wanted`, "sform" or "qform", with "auto" the sform, as in nibabel; where its code is
    0 the other one, and without both the pixel sizes alone. Raises E110 when unusable.
    """
    raw = _raw(head)
    codes = _codes(raw)
    which = chosen(*codes, wanted) if any(codes) else "base"
    try:
        affine = _affine(raw, which)
    except (ValueError, nibabel.spatialimages.HeaderDataError) as error:
        raise XfemnavError("E110", f"affine of {name} cannot be used: {error}. Fix its qform, or give the pixel "
                                   "sizes: ⟦spacing=0.9,0.9⟧.") from None
    check_affine(affine, name)
    code = codes[which == "qform"]
    return affine, code if code in nibabel.nifti1.xform_codes.value_set() else 1  # 1: some scanner's frame


@np.errstate(all="ignore")  # what overflows is no frame that can be used
def read_frames(head: bytes) -> Frames | None:
    """Both frames of a header; None where their codes are 0."""
    raw = _raw(head)
    codes = _codes(raw)
    if not any(codes):
        return None
    frames = [_usable(raw, which) if code else None for which, code in zip(OTHER, codes)]
    sizes = abs(raw["pixdim"][1:4].astype(float)) * _unit(raw)
    stated = (sizes > VOXEL_MM[0]) & (sizes < VOXEL_MM[1])
    known = next((frame for frame in frames if frame is not None), np.eye(4))
    return Frames(*frames, codes, np.where(stated, sizes, np.linalg.norm(known[:3, :3], axis=0)))


def _codes(raw) -> tuple[int, int]:
    return int(raw["sform_code"]), int(raw["qform_code"])


def _unit(raw) -> float:
    """Millimetres of the header's unit."""
    return MM_PER_UNIT.get(int(raw["xyzt_units"]) & 7, 1)


def _affine(raw, which: str) -> np.ndarray:
    """The frame "sform", "qform" or "base" (pixel sizes alone) of a header, (4, 4) voxel -> RAS mm, unchecked."""
    if raw["pixdim"][0] not in (-1, 1):
        raw["pixdim"][0] = 1  # the standard's reading of a missing qfac
    read = {"sform": raw.get_sform, "qform": raw.get_qform, "base": raw.get_base_affine}[which]
    affine = read().astype(float)
    affine[:3] *= _unit(raw)
    return affine


def _usable(raw, which: str) -> np.ndarray | None:
    """A frame of the header; None where it cannot be used."""
    try:
        affine = _affine(raw, which)
    except (ValueError, nibabel.spatialimages.HeaderDataError):
        return None
    return affine if is_usable(affine) else None


def _shape(raw, name: str) -> tuple[int, ...]:
    n_axes, *lengths = (int(n) for n in raw["dim"])
    if not 1 <= n_axes <= 7 or min(lengths[:n_axes]) < 1:
        raise XfemnavError("E105", f"impossible dimensions {[n_axes, *lengths]} in the header of {name}; "
                                   "dim[0] is 1 to 7 and every length at least 1. Convert it again from its source.")
    return tuple(lengths[:n_axes] + [1] * (3 - n_axes))


def _dtype(raw, name: str) -> np.dtype:
    code, bits = int(raw["datatype"]), int(raw["bitpix"])
    for kinds, what in ((COLOUR_TYPES, "a colour image"), (COMPLEX_TYPES, "a complex image")):
        if code in kinds:
            raise XfemnavError("E122", f"{name} is {what} ({kinds[code]}); give one scalar intensity a voxel.")
    if code not in SCALAR_TYPES or np.dtype(SCALAR_TYPES[code]).itemsize * 8 != bits:
        raise XfemnavError("E105", f"data type {code} with {bits} bits in the header of {name} is no scalar type of "
                                   "NIfTI. Convert it again from its source.")
    return np.dtype(SCALAR_TYPES[code]).newbyteorder(raw.endianness)


def _offset(raw, name: str) -> int:
    least, offset = raw.single_vox_offset, float(raw["vox_offset"])
    if offset == 0:
        return least
    if not (least <= offset < 2**40 and offset == int(offset)):
        raise XfemnavError("E105", f"voxels of {name} are said to start at byte {offset:g}, before byte {least} or "
                                   "past any file's end. Convert it again from its source.")
    return int(offset)
