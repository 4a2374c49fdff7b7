"""The input gate: a path -> a checked `Image` (or `Components`), or one coded error.

A file is opened once, as a regular file, and its bytes are read once: gunzipped to the end of the trailer (nibabel
never reads the CRC), never further than the header allows, then decoded. The format is told by the content, not by
the name. A damaged file gives an error, never voxels. NIfTI, NRRD, MetaImage and FreeSurfer's MGH are files (a header
may name one data file beside it); a DICOM series is a folder. Whatever frame a format uses, positions come out as RAS.
"""

import gzip
import hashlib
import io
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging.reading import content, dicom, formats, metaimage, mgh, nifti, nrrd, series
from xfemnav.imaging.reading.nifti_frames import Frames
from xfemnav.limits import PADDING

FORMATS = (nifti, nrrd, metaimage, mgh)  # what a format gives: `formats`
LARGEST = float(np.finfo(np.float32).max)  # results are float32: what is larger would be infinite there
HEAD = 1 << 18  # bytes that tell the format and hold its header, however many keys a NRRD has


@dataclass(frozen=True, eq=False)
class Image:
    """One scalar volume: `values` (ni, nj, nk) in storage order, `affine` (4, 4) voxel -> RAS mm.

    `frame_code` is the header's sform or qform code (0: the file states no position), `dtype` the stored type's
    name, `file_digest` the `content_digest` of what lies on the disk, `name` its name for messages. `frames` are both
    frames of a NIfTI header, of which `affine` is one; None of other files, and where the header is not asked. `intent`
    is NIfTI's code of what the values are (0: not said).
    """

    values: np.ndarray
    affine: np.ndarray
    dtype: str
    frame_code: int
    file_digest: str
    name: str
    frames: Frames | None = None
    intent: int = 0

    def __post_init__(self):
        object.__setattr__(self, "values", frozen_array(self.values, float, (None, None, None), "values"))
        object.__setattr__(self, "affine", frozen_array(self.affine, float, (4, 4), "affine"))

    @cached_property
    def digest(self) -> str:
        """sha256 over decoded voxels, affine and its code, and the header's frames, which outputs carry on: one
        content, one digest, under any name or compression."""
        return _values_digest((*self.values.shape, self.frame_code), self)


@dataclass(frozen=True, eq=False)
class Components:
    """Several values a voxel: `values` (ni, nj, nk, nc) in storage order, `affine` (4, 4) voxel -> RAS mm.

    Components are as stored, in the file's own frame and order; axes after the third run together, the fourth
    fastest. `intent` is NIfTI's code of what they are (1005 symmetric matrix, 1006 displacement, 1007 vector;
    0: not said), `vectors` what the file states of their axes. `dtype`, `file_digest`, `name` and `frames` as of an
    `Image`.
    """

    values: np.ndarray
    affine: np.ndarray
    intent: int
    dtype: str
    file_digest: str
    name: str
    frames: Frames | None = None
    vectors: formats.Vectors = formats.NOT_SAID

    def __post_init__(self):
        object.__setattr__(self, "values", frozen_array(self.values, float, (None, None, None, None), "values"))
        object.__setattr__(self, "affine", frozen_array(self.affine, float, (4, 4), "affine"))

    @cached_property
    def digest(self) -> str:
        """sha256 over decoded values, affine, intent, axes, and the header's frames: one content, one digest, under any
        name or compression."""
        axes = [None if axes is None else axes.tolist() for axes in self.vectors[:2]]
        return _values_digest((*self.values.shape, self.intent, *axes, self.vectors.layout), self)


def _values_digest(facts: tuple, image: Image | Components) -> str:
    digest = hashlib.sha256(repr((*facts, image.frames and image.frames.listed)).encode())
    digest.update(image.affine.astype("<f8"))
    digest.update(image.values.astype("<f8", copy=False))
    return digest.hexdigest()


def read_image(path, *, volume=None, nan=None, max_memory_gb=4.0, spacing=None, nifti_frame="auto") -> Image:
    """Read the image at `path`.

    `volume`: which one of a 4-D file. `nan`: the value to put where voxels are NaN or infinite.
    `spacing` (2 or 3 numbers, mm): use these pixel sizes instead of the header's frame, voxel 0 at the origin.
    `nifti_frame`: which of a NIfTI header's two frames is taken, "sform" or "qform", where it states both; "auto" is
    the sform.
    Raises E100 (cannot be opened), E101 (damaged), E102 (too large), E103 (NaN), E105 (header), E106 (no image),
    E110 (affine), E121 (4-D), E122 (colour, complex, vectors), and for a folder E123 (several series) and E124 (its
    slices make no volume); warns W104 (scaling), W107 (name), W112 (no position), W113 (files skipped in a folder),
    W136 (zeros after the voxels).
    """
    stored = _stored(path, int(max_memory_gb * 1e9), nifti_frame, spacing)
    if stored.header.vector:
        raise XfemnavError("E122", f"{stored.name} holds {stored.header.shape[3]} components a voxel; give one scalar "
                                   "intensity a voxel.")
    values = _scaled(_one_volume(stored.voxels, volume, stored.name), stored)
    return Image(_finite(values, nan, stored.name), stored.affine, stored.header.dtype.name, stored.frame_code,
                 stored.file_digest, stored.name, stored.frames, stored.header.intent)


def read_components(path, *, nan=None, max_memory_gb=4.0, nifti_frame="auto") -> Components:
    """Read all values a voxel of the image at `path`: vectors, tensors, or the volumes of a series.

    `nan`: the value to put where one is NaN or infinite. Raises and warns as `read_image`, but never E121.
    """
    stored = _stored(path, int(max_memory_gb * 1e9), nifti_frame, all_volumes=True)
    values = _scaled(_volumes(stored.voxels), stored)
    return Components(_finite(values, nan, stored.name), stored.affine, stored.header.intent,
                      stored.header.dtype.name, stored.file_digest, stored.name, stored.frames, stored.header.vectors)


class _Stored(NamedTuple):
    """What a file holds, checked: its `header`, `voxels` (ni, nj, nk, ...) unscaled, `affine` (4, 4) and its code, and
    both `frames` of a header that may have two."""

    header: formats.Header
    voxels: np.ndarray
    affine: np.ndarray
    frame_code: int
    file_digest: str
    name: str
    frames: Frames | None


class _Source(NamedTuple):
    """What lies at a path, its header checked, its voxels not yet touched: `frame()` gives the affine and its code,
    `voxels()` what is stored; `no_position` says why the code may be 0."""

    header: formats.Header
    frame: Callable
    voxels: Callable
    no_position: str
    file_digest: str
    frames: Frames | None = None


def _stored(path, limit: int, nifti_frame: str, spacing=None, all_volumes=False) -> _Stored:
    """The image at `path`, decoded; all its volumes, or one of them, must fit into `limit` bytes in float64."""
    name = Path(path).name or str(path)
    source = _folder(Path(path), limit, name) if os.path.isdir(path) else _file(Path(path), limit, name, nifti_frame)
    affine, code = source.frame() if spacing is None else (_plain_affine(spacing, name), 0)
    if code == 0 and spacing is None:
        warn("W112", f"{name} states no position: {source.no_position}. Do not trust positions in mm; use "
                     "⟦space=voxel⟧.")
    _check_size(source.header, limit, name, all_volumes)
    frames = source.frames if spacing is None else None
    return _Stored(source.header, source.voxels(), affine, code, source.file_digest, name, frames)


def _file(path: Path, limit: int, name: str, nifti_frame: str) -> _Source:
    packed = content.file_bytes(path, limit)
    zipped = packed.startswith(content.GZIP_MAGIC)
    if zipped != name.lower().endswith((".gz", ".mgz")):
        warn("W107", f"{name} is {'' if zipped else 'not '}gzip, whatever its name says; read by its content.")
    head, stream = content.opened(packed, name, HEAD)
    form = _format_of(head, name)
    header = form.read_header(head, name)
    beside = content.file_bytes(path.parent / header.data_file, limit) if header.data_file else b""

    def voxels() -> np.ndarray:
        if header.data_file:
            data = _voxel_bytes(header, b"", io.BytesIO(beside), limit, header.data_file)
        else:
            data = _voxel_bytes(header, head, stream, limit, name)
        if header.tail:
            form.check_tail(bytes(data[header.n_bytes :]), name)
        return formats.voxels(header, data)

    parts = {name: packed} | ({header.data_file: beside} if header.data_file else {})
    digest = content.parts_digest(parts)
    if hasattr(form, "read_frames"):
        frame = partial(form.read_frame, head, name, nifti_frame)
        return _Source(header, frame, voxels, form.NO_POSITION, digest, form.read_frames(head))
    return _Source(header, partial(form.read_frame, head, name), voxels, form.NO_POSITION, digest)


def _folder(path: Path, limit: int, name: str) -> _Source:
    """The one DICOM series in a folder. Files that are no DICOM are not kept, but count in the digest."""
    hashes, files, n_bytes = {}, {}, 0
    for file, data in content.each_file(path, limit):
        hashes[file] = hashlib.sha256(data).digest()
        files[file] = data if dicom.recognises(data) else b""
        n_bytes += len(files[file])
        if n_bytes > limit:
            raise XfemnavError("E102", f"the files of {name} hold more than the limit of {content.size(limit)}; raise "
                                       "it with ⟦max_memory⟧ if the folder is right.")
    found = series.read_series(path, files, limit)
    return _Source(found.header, found.frame, found.voxels, series.NO_POSITION, content.listed_digest(hashes))


def content_digest(path, *, max_memory_gb=4.0) -> str:
    """sha256 of what lies at `path`, without decoding its voxels; equals the `file_digest` of the image read there.

    Of a file, its bytes; where its header names a data file beside it, or of a folder, names and bytes of all files.
    Raises E100, E102, E106, and what the header of an image raises.
    """
    limit, path = int(max_memory_gb * 1e9), Path(path)
    if os.path.isdir(path):
        files = content.each_file(path, limit)
        return content.listed_digest({file: hashlib.sha256(data).digest() for file, data in files})
    packed = content.file_bytes(path, limit)
    head, _ = content.opened(packed, path.name, HEAD)
    form = next((form for form in FORMATS if form.recognises(head)), None)
    beside = form.read_header(head, path.name).data_file if form else ""
    parts = {beside: content.file_bytes(path.parent / beside, limit)} if beside else {}
    return content.parts_digest({path.name: packed} | parts)


def _voxel_bytes(header, head: bytes, stream, limit: int, name: str) -> memoryview:
    """Bytes of the voxels, and of what may follow them, from a file's first bytes `head` and the `stream` after it."""
    start = header.offset
    if header.packing:
        most = min(limit, start + header.n_bytes + header.n_bytes // 100 + content.CHUNK)
        packed = head + content.read(stream, max(most + 1 - len(head), 0), name)
        if len(packed) > most:
            raise XfemnavError("E102", f"{name} packs {header.n_bytes} bytes of voxels into more than {most}, so its "
                                       "header or its content is wrong. Convert it again from its source.")
        unpacked = io.BytesIO(packed[start:])
        stream = gzip.GzipFile(fileobj=unpacked) if header.packing == "gzip" else content.Zlib(packed[start:])
        head, start = b"", 0
    wanted = start + header.n_bytes
    data = head + content.read(stream, wanted + header.tail + 1 - len(head), name)
    if len(data) < wanted:
        raise XfemnavError("E101", f"{name} is damaged: it ends after {len(data)} of {wanted} bytes. Copy it again.")
    if len(data) > wanted + header.tail:
        rest = data[wanted:]
        _check_padding(rest + content.read(stream, PADDING.value + 1 - len(rest), name), wanted, name)
    return memoryview(data)[start:]


def _format_of(head: bytes, name: str):
    for form in FORMATS:
        if form.recognises(head):
            return form
    if dicom.recognises(head):
        raise XfemnavError("E106", f"{name} is one DICOM file; give the folder that holds its series, and no other.")
    raise XfemnavError("E106", f"the content of {name} is no image that xfemnav knows; give NIfTI (.nii, .nii.gz), "
                               "NRRD, MetaImage, MGH, or the folder of a DICOM series.")


def _check_size(header, limit: int, name: str, all_volumes: bool) -> None:
    """E102 when the voxels that the header claims would pass the memory limit."""
    shape = "x".join(map(str, header.shape))
    # As stored, and what is returned in float64.
    needed = header.n_bytes + 8 * math.prod(header.shape if all_volumes else header.shape[:3])
    if needed > limit:
        raise XfemnavError("E102", f"header of {name} claims {shape} voxels, {content.size(needed)} in memory; the "
                                   f"limit is {content.size(limit)} and nothing was read. Raise ⟦max_memory⟧ if the "
                                   "header is right.")


def _check_padding(rest: bytes, wanted: int, name: str) -> None:
    """What follows the `wanted` bytes of a file: zeros up to `PADDING` warn W136, all else is E102.

    Other readers skip whatever is there. But of an image with wrong dimensions it is voxels, and those before it are
    out of place.
    """
    more = f"more than {content.size(PADDING.value)}" if len(rest) > PADDING.value else f"{len(rest)} bytes"
    goes_on = f"{name} goes on after the {wanted} bytes that its header describes, with {more}"
    if rest.strip(b"\0"):
        raise XfemnavError("E102", f"{goes_on} that are not all zeros: its dimensions are wrong, or another program "
                                   "has appended something. Convert it again from its source, or save it again in a "
                                   "program that shows it rightly.")
    if len(rest) > PADDING.value:
        raise XfemnavError("E102", f"{goes_on} of zeros, too many for padding: its dimensions are wrong, or it is not "
                                   "meant to be read. Convert it again from its source.")
    warn("W136", f"{more} of zeros follow the voxels of {name}, and are not looked at. If it looks sheared in the "
                 "figure, its dimensions are wrong.")


def _volumes(voxels: np.ndarray) -> np.ndarray:
    """`voxels` with one axis (ni, nj, nk, n) after the third."""
    return voxels.reshape(*voxels.shape[:3], -1, order="F")


def _one_volume(voxels: np.ndarray, volume, name: str) -> np.ndarray:
    """The three-axis volume number `volume` of `voxels`; further axes of length 1 do not count."""
    volumes = _volumes(voxels)
    n_volumes = volumes.shape[3]
    if volume is None and n_volumes > 1:
        raise XfemnavError("E121", f"{name} is 4-D and holds {n_volumes} volumes; say which one: ⟦volume=0⟧ to "
                                   f"{n_volumes - 1}.")
    if volume and n_volumes == 1:
        raise XfemnavError("E121", f"{name} has one volume, so there is no volume {volume}; leave out ⟦volume⟧, which "
                                   "is for 4-D images. A slice of a 3-D one is chosen by ⟦slice=K⟧ or ⟦slice_mm=S⟧.")
    if volume is not None and not 0 <= volume < n_volumes:
        raise XfemnavError("E121", f"{name} has no volume {volume}; it holds 0 to {n_volumes - 1}.")
    return volumes[..., volume or 0]


@np.errstate(over="ignore", invalid="ignore")  # what overflows is refused by its result
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
    """`values` with NaN and what is infinite in float32 replaced by `nan`; E103 where there is some without `nan`."""
    bad = ~((values >= -LARGEST) & (values <= LARGEST))
    if not bad.any():
        return values
    if nan is None:
        first = tuple(int(i) for i in np.unravel_index(np.argmax(bad), bad.shape))
        raise XfemnavError("E103", f"{name} has {int(bad.sum())} NaN or infinite voxels, the first at index {first} "
                                   f"(over {LARGEST:.1e} counts as infinite). Give the value to put there: ⟦nan=0⟧.")
    return np.where(bad, float(nan), values)


def _plain_affine(spacing, name: str) -> np.ndarray:
    """Affine (4, 4) of pixel sizes alone: array axes along R, A, S, voxel 0 at the origin."""
    affine = np.diag([*spacing, *[1.0] * (4 - len(spacing))])
    formats.check_affine(affine, name)
    return affine
