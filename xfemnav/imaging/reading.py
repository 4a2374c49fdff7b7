"""The input gate: a path -> a checked `Image` (or `Components`), or one coded error.

A file is opened once, as a regular file, and its bytes are read once: gunzipped to the end of the trailer (nibabel
never reads the CRC), never further than the header allows, then decoded. The format is told by the content, not by
the name. A damaged file gives an error, never voxels.
"""

import gzip
import hashlib
import io
import math
import os
import stat
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging import nifti

# A format is a module with recognises(head), read_header(head, name), read_frame(head, name), voxels(header, data).
FORMATS = (nifti,)
HEAD = 4096  # bytes that tell the format and hold its header
CHUNK = 1 << 22
GZIP_MAGIC = b"\x1f\x8b"


@dataclass(frozen=True, eq=False)
class Image:
    """One scalar volume: `values` (ni, nj, nk) in storage order, `affine` (4, 4) voxel -> RAS mm.

    `frame_code` is the header's sform or qform code (0: the file states no position), `dtype` the stored type's
    name, `file_digest` the sha256 of the file as it lies on the disk, `name` its name for messages.
    """

    values: np.ndarray
    affine: np.ndarray
    dtype: str
    frame_code: int
    file_digest: str
    name: str

    def __post_init__(self):
        object.__setattr__(self, "values", frozen_array(self.values, float, (None, None, None), "values"))
        object.__setattr__(self, "affine", frozen_array(self.affine, float, (4, 4), "affine"))

    @cached_property
    def digest(self) -> str:
        """sha256 over decoded voxels, affine and its code: one content, one digest, under any name or compression."""
        return _content_digest((*self.values.shape, self.frame_code), self.affine, self.values)


@dataclass(frozen=True, eq=False)
class Components:
    """Several values a voxel: `values` (ni, nj, nk, nc) in storage order, `affine` (4, 4) voxel -> RAS mm.

    Components are as stored, in the file's own frame and order; axes after the third run together, the fourth
    fastest. `intent` is NIfTI's code of what they are (1005 symmetric matrix, 1006 displacement, 1007 vector;
    0: not said). `dtype`, `file_digest` and `name` as of an `Image`.
    """

    values: np.ndarray
    affine: np.ndarray
    intent: int
    dtype: str
    file_digest: str
    name: str

    def __post_init__(self):
        object.__setattr__(self, "values", frozen_array(self.values, float, (None, None, None, None), "values"))
        object.__setattr__(self, "affine", frozen_array(self.affine, float, (4, 4), "affine"))

    @cached_property
    def digest(self) -> str:
        """sha256 over decoded values, affine and intent: one content, one digest, under any name or compression."""
        return _content_digest((*self.values.shape, self.intent), self.affine, self.values)


def _content_digest(facts: tuple, affine: np.ndarray, values: np.ndarray) -> str:
    content = hashlib.sha256(repr(facts).encode())
    content.update(affine.astype("<f8"))
    content.update(values.astype("<f8", copy=False))
    return content.hexdigest()


def read_image(path, *, volume=None, nan=None, max_memory_gb=4.0, spacing=None) -> Image:
    """Read the image at `path`.

    `volume`: which one of a 4-D file. `nan`: the value to put where voxels are NaN or infinite.
    `spacing` (2 or 3 numbers, mm): use these pixel sizes instead of the header's frame, voxel 0 at the origin.
    Raises E100 (cannot be opened), E101 (damaged), E102 (too large), E103 (NaN), E105 (header), E106 (no image),
    E110 (affine), E121 (4-D), E122 (colour, complex); warns W104 (scaling), W107 (name), W112 (no position).
    """
    stored = _stored(path, int(max_memory_gb * 1e9), spacing)
    values = _scaled(_one_volume(stored.voxels, volume, stored.name), stored)
    return Image(_finite(values, nan, stored.name), stored.affine, stored.header.dtype.name, stored.frame_code,
                 stored.file_digest, stored.name)


def read_components(path, *, nan=None, max_memory_gb=4.0) -> Components:
    """Read all values a voxel of the image at `path`: vectors, tensors, or the volumes of a series.

    `nan`: the value to put where one is NaN or infinite. Raises and warns as `read_image`, but never E121.
    """
    stored = _stored(path, int(max_memory_gb * 1e9), all_volumes=True)
    values = _scaled(_volumes(stored.voxels), stored)
    return Components(_finite(values, nan, stored.name), stored.affine, stored.header.intent,
                      stored.header.dtype.name, stored.file_digest, stored.name)


class _Stored(NamedTuple):
    """What a file holds, checked: its `header`, `voxels` (ni, nj, nk, ...) unscaled, `affine` (4, 4) and its code."""

    header: NamedTuple
    voxels: np.ndarray
    affine: np.ndarray
    frame_code: int
    file_digest: str
    name: str


def _stored(path, limit: int, spacing=None, all_volumes=False) -> _Stored:
    """The file at `path`, decoded; all its volumes, or one of them, must fit into `limit` bytes in float64."""
    name = Path(path).name
    packed = _file_bytes(path, limit)
    zipped = packed.startswith(GZIP_MAGIC)
    if zipped != name.lower().endswith(".gz"):
        warn("W107", f"{name} is {'' if zipped else 'not '}gzip, whatever its name says; read by its content.")
    stream = gzip.GzipFile(fileobj=io.BytesIO(packed)) if zipped else io.BytesIO(packed)
    head = _read(stream, HEAD, name)
    form = _format_of(head, name)
    header = form.read_header(head, name)
    affine, code = form.read_frame(head, name) if spacing is None else (_plain_affine(spacing, name), 0)
    if code == 0 and spacing is None:
        warn("W112", f"{name} states no position (its qform and sform codes are 0): pixel sizes alone give its frame. "
                     "Do not trust positions in mm; use --space voxel.")
    _check_size(header, limit, name, all_volumes)
    data = head + _read(stream, header.n_bytes + 1 - len(head), name)
    _check_length(len(data), header.n_bytes, name)
    return _Stored(header, form.voxels(header, data), affine, code, hashlib.sha256(packed).hexdigest(), name)


def file_digest(path, *, max_memory_gb=4.0) -> str:
    """sha256 of the bytes of the regular file at `path`, without decoding them. Raises E100, E102, E106."""
    return hashlib.sha256(_file_bytes(path, int(max_memory_gb * 1e9))).hexdigest()


def _file_bytes(path, limit: int) -> bytes:
    """Bytes of a regular file of at most `limit` bytes; a pipe or device is never waited for."""
    name = Path(path).name or str(path)
    try:
        # O_NONBLOCK: a pipe that nobody writes to opens at once, and is then refused as what it is.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise XfemnavError("E100", f"cannot open {path}: {reason}. Correct the path.") from None
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise XfemnavError("E106", f"{path} is a folder, pipe or device, not a file; give an image file (.nii.gz).")
        if status.st_size == 0:
            raise XfemnavError("E106", f"{name} is empty (0 bytes); copy it again.")
        if status.st_size > limit:
            raise XfemnavError("E102", f"{name} holds {_size(status.st_size)}, over the limit of {_size(limit)}; "
                                       "raise it with --max-memory if the file is right.")
        with os.fdopen(handle, "rb", closefd=False) as file:
            return file.read(status.st_size)
    except OSError as error:
        raise XfemnavError("E101", f"cannot read {name}: {error.strerror}. Copy it again.") from None
    finally:
        os.close(handle)


def _format_of(head: bytes, name: str):
    for form in FORMATS:
        if form.recognises(head):
            return form
    raise XfemnavError("E106", f"the content of {name} is no image that xfemnav knows; give NIfTI (.nii, .nii.gz).")


def _read(stream, n_bytes: int, name: str) -> bytes:
    """At most `n_bytes` of a stream, in chunks: memory follows what is there, not what a header claims.

    A gzip stream that comes to its end has its CRC and length checked. Raises E101.
    """
    parts, missing = [], n_bytes
    try:
        while missing > 0 and (part := stream.read(min(CHUNK, missing))):
            parts.append(part)
            missing -= len(part)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise XfemnavError("E101", f"{name} is damaged: {error} (after {n_bytes - missing} of {n_bytes} bytes). "
                                   f"Copy it again; check with: gzip -t {name}") from None
    return b"".join(parts)


def _size(n_bytes: int) -> str:
    """Human-readable size: 17.4 kB, 141 TB."""
    power = min(int(math.log10(max(n_bytes, 1)) / 3), 5)
    return f"{n_bytes / 1e3**power:.4g} {('bytes', 'kB', 'MB', 'GB', 'TB', 'PB')[power]}"


def _check_size(header, limit: int, name: str, all_volumes: bool) -> None:
    """E102 when the voxels that the header claims would pass the memory limit."""
    shape = "x".join(map(str, header.shape))
    # As stored, and what is returned in float64.
    needed = header.n_bytes + 8 * math.prod(header.shape if all_volumes else header.shape[:3])
    if needed > limit:
        raise XfemnavError("E102", f"header of {name} claims {shape} voxels, {_size(needed)} in memory; the limit is "
                                   f"{_size(limit)} and nothing was read. Raise --max-memory if the header is right.")


def _check_length(n_bytes: int, wanted: int, name: str) -> None:
    if n_bytes < wanted:
        raise XfemnavError("E101", f"{name} is damaged: it ends after {n_bytes} of {wanted} bytes. Copy it again.")
    if n_bytes > wanted:
        raise XfemnavError("E102", f"{name} holds more than the {wanted} bytes that its header describes, so its "
                                   "dimensions are wrong. Convert it again from its source.")


def _volumes(voxels: np.ndarray) -> np.ndarray:
    """`voxels` with one axis (ni, nj, nk, n) after the third."""
    return voxels.reshape(*voxels.shape[:3], -1, order="F")


def _one_volume(voxels: np.ndarray, volume, name: str) -> np.ndarray:
    """The three-axis volume number `volume` of `voxels`; further axes of length 1 do not count."""
    volumes = _volumes(voxels)
    n_volumes = volumes.shape[3]
    if volume is None and n_volumes > 1:
        raise XfemnavError("E121", f"{name} holds {n_volumes} volumes; say which one: --volume 0 to {n_volumes - 1}.")
    if volume is not None and not 0 <= volume < n_volumes:
        raise XfemnavError("E121", f"{name} has no volume {volume}; it holds 0 to {n_volumes - 1}.")
    return volumes[..., volume or 0]


def _scaled(voxels: np.ndarray, stored: _Stored) -> np.ndarray:
    """value = slope * voxel + inter in float64 (NIfTI: slope 0 means unscaled)."""
    header, name = stored.header, stored.name
    if not (math.isfinite(header.slope) and math.isfinite(header.inter)):
        warn("W104", f"scl_slope {header.slope} and scl_inter {header.inter} of {name} are ignored: voxels are taken "
                     "as they are stored.")
        return voxels
    if header.slope == 0 or (header.slope, header.inter) == (1, 0):
        return voxels
    return voxels * np.float64(header.slope) + header.inter


def _finite(values: np.ndarray, nan, name: str) -> np.ndarray:
    """`values` with NaN and infinities replaced by `nan`; E103 when there are some and `nan` is None."""
    bad = ~np.isfinite(values)
    if not bad.any():
        return values
    if nan is None:
        first = tuple(int(i) for i in np.unravel_index(np.argmax(bad), bad.shape))
        raise XfemnavError("E103", f"{name} has {int(bad.sum())} NaN or infinite voxels, the first at index {first}. "
                                   "Give the value to put there: --nan 0.")
    return np.where(bad, float(nan), values)


def _plain_affine(spacing, name: str) -> np.ndarray:
    """Affine (4, 4) of pixel sizes alone: array axes along R, A, S, voxel 0 at the origin."""
    affine = np.diag([*spacing, *[1.0] * (4 - len(spacing))])
    nifti.check_affine(affine, name)
    return affine
