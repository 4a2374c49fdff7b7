"""Files of fibre tracts: TrackVis (.trk, .trk.gz) and MRtrix (.tck), checked where their readers trust.

A file is opened once, as a regular file, gunzipped to the end of its checksum where it is gzip, and decoded from
memory. TrackVis keeps points in millimetres of its voxels: without vox_to_ras nothing says where those lie, and without
voxel_order not in which directions they count. Such tracts are read as nibabel reads them, with W115, and written back
as silent as they came.
"""

import gzip
import io
import re
import struct
from pathlib import Path

import numpy as np
from nibabel.streamlines import TckFile, Tractogram, TrkFile
from nibabel.streamlines.tractogram_file import DataError, HeaderError, TractogramFile

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.points.point_set import FARTHEST
from xfemnav.imaging.reading.content import GZIP_MAGIC, file_bytes, silenced, unpacked
from xfemnav.imaging.reading.formats import VOXEL_MM

PROPERTY, PROPERTIES = "motion", 10  # what a .trk calls our flags, and how many values a streamline it can hold
KINDS = ((TrkFile, b"TRACK"), (TckFile, b"mrtrix tracks"))
UNPLACED = "unplaced"  # key of a file's header: which of FIELDS it came without
#: Fields of a .trk header: where they stand, and what is there when nothing is said.
FIELDS = {"vox_to_ras": (440, bytes(64)), "voxel_order": (948, bytes(4))}
TCK_HEADER = 1 << 20  # bytes
VOXELS_AGREE = 0.01  # of a voxel: headers are rounded
COUNT = re.compile(rb"^count:[^\n]*\n", re.MULTILINE)
FAULTS = (DataError, HeaderError, struct.error, OSError, ValueError, LookupError, TypeError, AttributeError,
          MemoryError, ArithmeticError)


def read_streamlines(path, *, max_memory_gb: float = 4.0) -> TractogramFile:
    """The tractogram in a .trk, .trk.gz or .tck file, told by its content; points in RAS mm.

    Raises E100 (cannot be opened), E101 (gzip is damaged), E102 (too large), E106 (no file), E701 (no tractogram);
    warns W107 (name), W115 (no frame).
    """
    limit = int(max_memory_gb * 1e9)
    return decoded_streamlines(file_bytes(path, limit), Path(path).name, limit)


def decoded_streamlines(packed: bytes, name: str, limit: int = 4_000_000_000) -> TractogramFile:
    """The tractogram in the bytes of a file called `name`; see `read_streamlines`."""
    content = unpacked(packed, name, limit)
    kind = next((kind for kind, magic in KINDS if content.startswith(magic)), None)
    if kind is None:
        raise XfemnavError("E701", f"{name} is no tractogram that xfemnav reads; give .trk, .trk.gz or .tck.")
    if packed.startswith(GZIP_MAGIC) != name.lower().endswith(".gz"):
        warn("W107", f"{name} is {'not ' if packed is content else ''}gzip, whatever its name says; read by its "
                     "content.")
    unplaced = _unplaced(content) if kind is TrkFile else ()
    try:
        with np.errstate(all="ignore"), silenced():    # infinite points are told below
            file = kind.load(io.BytesIO(content))
            claimed = _claimed(kind, content)
            if kind is TrkFile:
                _check_voxels(file.header)
    except FAULTS as error:
        raise XfemnavError("E701", f"{name} is a damaged {'.trk' if kind is TrkFile else '.tck'} file ({error}). "
                                   "Write it again.") from None
    found = len(file.streamlines)
    if found == 0 or not claimed & {0, found}:
        raise XfemnavError("E701", f"{name} holds {found} streamlines, {', '.join(map(str, sorted(claimed)))} by its "
                                   "header. Write it again.")
    points = file.streamlines.get_data()
    if not np.isfinite(points).all():
        raise XfemnavError("E701", f"{name} has points that are NaN or infinite. Write it again.")
    if (far := abs(points).max(initial=0)) > FARTHEST:
        raise XfemnavError("E701", f"{name} has a coordinate of {far:.3g} mm; beyond {FARTHEST:.0e} mm there is no "
                                   "patient. Check its units, and its vox_to_ras.")
    if unplaced:
        file.header[UNPLACED] = unplaced
        warn("W115", f"{name} has no {' and no '.join(unplaced)}: {_taken(unplaced, file)}. Write it with a reference "
                     "image, and look where the tracts lie.")
    elif kind is TrkFile:
        _compare_voxels(file.header, name)
    return file


def _unplaced(content: bytes) -> tuple[str, ...]:
    """The fields of FIELDS that a .trk header leaves open: of version 1, or with 0 at its end, a matrix is none."""
    version = {int.from_bytes(content[992:996], order) for order in ("little", "big")}
    fields = []
    if version & {1} or not any(content[500:504]):
        fields.append("vox_to_ras")
    if not content[948:952].strip(b"\0 "):
        fields.append("voxel_order")
    return tuple(fields)


def _taken(unplaced: tuple[str, ...], file: TractogramFile) -> str:
    """What is taken in place of the fields that are missing, and where the tracts lie then."""
    taken = {"vox_to_ras": "voxel numbers are taken as RAS mm",
             "voxel_order": "its axes are taken as LPS, TrackVis's own"}
    low, high = (ends(file.streamlines.get_data(), axis=0) for ends in (np.min, np.max))
    place = "({:.0f}, {:.0f}, {:.0f}) to ({:.0f}, {:.0f}, {:.0f})".format(*low, *high)
    return f"{' and '.join(taken[field] for field in unplaced)}, so that the tracts lie from {place} mm"


def _check_voxels(header) -> None:
    """Raise ValueError where positions in a .trk keep no meaning: voxels of no size, or a matrix that is flat."""
    linear = np.asarray(header["voxel_to_rasmm"], float)[:3, :3]
    sizes = np.concatenate([np.linalg.norm(linear, axis=0), np.asarray(header["voxel_sizes"], float)])
    if not ((sizes > VOXEL_MM[0]) & (sizes < VOXEL_MM[1])).all() or abs(np.linalg.det(linear / sizes[:3])) < 1e-6:
        raise ValueError("its voxels have no size, or its vox_to_ras is flat")


def _compare_voxels(header, name: str) -> None:
    """W115 where the matrix of a .trk has other voxels than its header: its points are stored in these."""
    by_matrix = np.linalg.norm(np.asarray(header["voxel_to_rasmm"], float)[:3, :3], axis=0)
    by_header = np.asarray(header["voxel_sizes"], float)
    if (abs(np.sort(by_matrix) - np.sort(by_header)) > VOXELS_AGREE * by_header.max()).any():
        told = (" x ".join(f"{size:.3g}" for size in sizes) for sizes in (by_matrix, by_header))
        warn("W115", "the vox_to_ras of {} has voxels of {} mm, and its voxel_size says {} mm: its tracts are too "
                     "large or too small. Write it with a reference image, and look where they lie.".format(
                         name, *told))


def _claimed(kind, content: bytes) -> set[int]:
    """How many streamlines the header says that there are, 0 for nothing said.

    MRtrix's own programs append a second `count` where they edit a file, and read the last one: either may be right.
    """
    if kind is TrkFile:
        return {int(TrkFile.load(io.BytesIO(content), lazy_load=True).header["nb_streamlines"])}
    head = content[: content.find(b"\nEND", 0, TCK_HEADER)]
    return {int(line.partition(b":")[2]) for line in COUNT.findall(head + b"\n")} or {0}


def tract_bytes(file: TractogramFile, ending: str) -> bytes:
    """The bytes of a tractogram as a file of that `ending`; equal tractograms are equal bytes."""
    stream = io.BytesIO()
    with np.errstate(all="ignore"), silenced():
        (TckFile(file.tractogram) if isinstance(file, TckFile) else file).save(stream)
    content = bytearray(stream.getvalue())
    if isinstance(file, TckFile):
        content = _tck_header(file.header, len(file.streamlines)) + content[content.index(b"\nEND\n") + 5 :]
    for field in file.header.get(UNPLACED, ()):
        start, nothing = FIELDS[field]
        content[start : start + len(nothing)] = nothing
    return gzip.compress(content, compresslevel=1, mtime=0) if ending.endswith(".gz") else bytes(content)


def _tck_header(header, n: int) -> bytearray:
    """The header of a .tck of `n` streamlines with what another one said: nibabel writes no value with a colon, and
    none of several lines, as MRtrix's history of commands is."""
    told = [f"{key}: {line}" for key, value in header.items() if isinstance(value, str) and not key.startswith("_")
            and key not in ("count", "datatype", "file", "endianness") for line in value.split("\n")]
    head = "\n".join(["mrtrix tracks", f"count: {n:010}", "datatype: Float32LE", *told, "file: . "]).encode()
    length = len(head) + len("\nEND\n")
    offset = next(length + digits for digits in range(1, 20) if len(str(length + digits)) == digits)
    return bytearray(head + f"{offset}\nEND\n".encode())


def file_like(file: TractogramFile, points, count, places, source, code) -> TractogramFile:
    """A file of the format of `file`, with its header and data.

    Its streamlines are `points` (n, 3) RAS mm, `count` (m,) of them each, parts of the streamlines `source` (m,) of
    `file`, with the flags `code` (m,). Point by point they lie at `places`: behind its points k (n,), before the ones
    that follow (n,), a part t (n,) of the way on. Raises E701 when a .trk has no room for the flags.
    """
    ends, old = np.cumsum(count)[:-1], file.tractogram
    per_point = {name: np.split(_between(values.get_data(), *places), ends)
                 for name, values in old.data_per_point.items()}
    per_streamline = {name: values[source] for name, values in old.data_per_streamline.items() if name != PROPERTY}
    if isinstance(file, TrkFile):
        if sum(values.shape[1] for values in per_streamline.values()) >= PROPERTIES:
            raise XfemnavError("E701", f"the .trk has {PROPERTIES} values a streamline, all that it can hold, and none "
                                       f"is left for {PROPERTY!r}. Write it again with fewer.")
        per_streamline[PROPERTY] = code[:, None].astype(np.float32)
    if not len(count):
        return type(file)(Tractogram(affine_to_rasmm=np.eye(4)), header=file.header)
    pieces = np.split(points.astype(np.float32), ends)
    return type(file)(Tractogram(pieces, per_streamline, per_point, affine_to_rasmm=np.eye(4)), header=file.header)


def _between(values, k, following, t) -> np.ndarray:
    """Rows k of `values`, and a part t of the way on to the rows that are `following`; all (n,)."""
    new, on = values[k], t > 0    # a point's own value needs no other, which may be NaN
    new[on] += t[on, None] * (values[following[on]] - new[on])
    return new
