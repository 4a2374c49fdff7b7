"""What the image formats share: the header that each of them gives, its voxels, and which affines are usable.

A format is a module with
    recognises(head): whether `head`, the first bytes of a file, starts one of its files;
    read_header(head, name): the checked `Header`;
    read_frame(head, name): the affine (4, 4) voxel -> RAS mm and its code (0: the file states no position, for the
        reason `NO_POSITION`; else NIfTI's);
where something may follow the voxels, check_tail(tail, name);
and, where a header may state two frames, read_frames(head), which gives both of them or None; its read_frame takes the
    one that is `wanted`.
"""

import math
from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError

VOXEL_MM, ORIGIN_MM = (1e-3, 1e3), 1e6  # beyond these no position in a body keeps its meaning in float64
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
RAS, LPS = np.eye(3), LPS_TO_RAS[:3, :3]  # the axes of the two worlds as columns in RAS
RAS.flags.writeable = LPS.flags.writeable = False


class Vectors(NamedTuple):
    """How a file gives the vectors and tensors that it may hold.

    `stated` (3, 3): the axes of its components as columns in world RAS, v_RAS = `stated` v_file; None when the file
    says nothing of them. `world` (3, 3): those of the format's own world. `layout`: what it states of a tensor's
    components: "lower" or "upper" triangle, "masked" (a mask, then the upper triangle), "matrix" (all nine), "".
    """

    stated: np.ndarray | None = None
    world: np.ndarray = RAS
    layout: str = ""


NOT_SAID = Vectors()


class Header(NamedTuple):
    """What a header says of its voxels.

    `shape` (ni, nj, nk, ...) and stored `dtype`; value = `slope` * stored + `inter`; NIfTI's code `intent` of what
    the values are (0: not said). The voxels start at byte `offset` of the file, or of `data_file` beside it; from
    there they are packed by "gzip", "zlib" or not ("") . The file counts its axes fastest first; `last_axis` is where
    the last one of `shape` stands there. `vector`: that axis counts components of one value, not volumes.
    `tail`: bytes that may follow the voxels. `vectors`: whose axes components are in.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    offset: int
    slope: float = 1.0
    inter: float = 0.0
    intent: int = 0
    packing: str = ""
    data_file: str = ""
    last_axis: int = -1
    vector: bool = False
    tail: int = 0
    vectors: Vectors = NOT_SAID

    @property
    def n_bytes(self) -> int:
        """Length of the unpacked voxels, bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def voxels(header: Header, data) -> np.ndarray:
    """Stored voxels, `header.shape`, unscaled, as a read-only view of the bytes `data` that start with them."""
    lengths = list(header.shape)
    lengths.insert(header.last_axis % len(lengths), lengths.pop())
    flat = np.frombuffer(data, header.dtype, math.prod(lengths))
    return np.moveaxis(flat.reshape(lengths, order="F"), header.last_axis, -1)


@np.errstate(all="ignore")  # what overflows is refused by its result
def is_usable(affine: np.ndarray) -> bool:
    """Whether `affine` (4, 4) gives every voxel a position in mm and back."""
    sizes = np.linalg.norm(affine[:3, :3], axis=0)
    return bool(np.isfinite(affine).all() and (sizes > VOXEL_MM[0]).all() and (sizes < VOXEL_MM[1]).all()
                and (abs(affine[:3, 3]) < ORIGIN_MM).all() and abs(np.linalg.det(affine[:3, :3] / sizes)) > 1e-6)


def check_affine(affine: np.ndarray, name: str) -> None:
    """Raise E110 unless the `affine` (4, 4) of `name` is usable."""
    if not is_usable(affine):
        rows = "; ".join(" ".join(f"{x:.4g}" for x in row) for row in affine[:3])
        raise XfemnavError("E110", f"affine of {name} cannot be used: rows {rows} give voxels no size or no position "
                                   "in mm. Fix its header, or give the pixel sizes: ⟦spacing=0.9,0.9⟧.")


def impossible(name: str, what: str) -> XfemnavError:
    """E105: a field of the header of `name` that cannot be."""
    return XfemnavError("E105", f"impossible {what} in the header of {name}. Convert it again from its source.")


def not_read(name: str, what: str) -> XfemnavError:
    """E106: the format allows it, xfemnav does not read it."""
    return XfemnavError("E106", f"{name} {what}, which xfemnav does not read; write it again as NIfTI (.nii.gz).")


def numbers(text: str, name: str, field: str, convert=float) -> list:
    """The numbers of a header's line. Raises E105."""
    try:
        return [convert(word) for word in text.split()]
    except (ValueError, OverflowError):
        raise impossible(name, f"{field} {text[:60]!r}") from None


def lengths(text: str, name: str, field: str) -> tuple[int, ...]:
    """1 to 7 lengths of axes, each at least 1. Raises E105."""
    found = numbers(text, name, field, int)
    if not 1 <= len(found) <= 7 or not all(1 <= n < 2**31 for n in found):
        raise impossible(name, f"{field} {text[:60]!r}")
    return tuple(found)


def data_file(text: str, name: str) -> str:
    """Name of the one file beside `name` that holds its voxels. Raises E105, E106."""
    if text.upper().startswith("LIST") or "%" in text:
        raise not_read(name, f"spreads its voxels over several files ({text[:60]!r})")
    if not text or "/" in text or "\\" in text or text in (".", "..") or not text.isprintable():
        raise XfemnavError("E105", f"{name} names the data file {text[:60]!r}; it must lie in the same folder. Put it "
                                   "there and give its bare name.")
    return text


def completed(columns: np.ndarray) -> np.ndarray:
    """Three voxel axes (3, 3), as columns in mm, from the one, two or three (3, n) that a file gives: axes of length 1
    that it left out are perpendicular and 1 mm long."""
    n = columns.shape[1]
    if n == 1:
        other = np.eye(3)[np.argmin(abs(columns[:, 0]))]
        columns = np.column_stack([columns[:, 0], _unit(np.cross(columns[:, 0], other))])
    if n < 3:
        columns = np.column_stack([columns, _unit(np.cross(columns[:, 0], columns[:, 1]))])
    return columns


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 0 else vector
