"""MetaImage (.mha, and .mhd with its data file beside it) header -> what its voxels are and where they lie.

Positions and vectors are LPS, as ITK writes and reads them. Binary voxels are read, plain or compressed (zlib).
Field meanings: MetaIO, https://itk.org/Wiki/MetaIO/Documentation.
"""

import re

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.formats import (
    LPS,
    LPS_TO_RAS,
    Header,
    Vectors,
    check_affine,
    completed,
    data_file,
    impossible,
    lengths,
    not_read,
    numbers,
)

NO_POSITION = "it has neither Offset nor TransformMatrix"

TYPES = {"MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
         "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4",
         "MET_DOUBLE": "f8"}
# Several names of one field: the first is the one used below.
SAME = {"position": "offset", "origin": "offset", "rotation": "transformmatrix", "orientation": "transformmatrix",
        "elementbyteordermsb": "binarydatabyteordermsb"}
_START = re.compile(rb"(ObjectType[ \t]*=[ \t]*Image|NDims[ \t]*=)")
_END = re.compile(rb"^ElementDataFile[ \t]*=[ \t]*([^\r\n]*)(\r?\n|\Z)", re.MULTILINE)


def recognises(head: bytes) -> bool:
    """Whether `head`, the first bytes of a file, starts a MetaImage."""
    return _START.match(head) is not None


def _fields(head: bytes, name: str) -> tuple[dict[str, str], int]:
    """The header's fields, names in small letters, and its length in bytes: ElementDataFile is the last."""
    end = _END.search(head)
    if not end:
        raise XfemnavError("E101", f"{name} is damaged: no ElementDataFile in its first {len(head)} bytes. Copy it "
                                   "again.")
    fields = {}
    for line in head[: end.end()].decode("utf-8", "replace").splitlines():
        field, equals, value = line.partition("=")
        field = SAME.get(field.strip().lower(), field.strip().lower())
        if equals and field in fields and field != "comment":
            raise impossible(name, f"second {field[:30]}")
        if equals:
            fields[field] = value.strip()
    return fields, end.end()


def read_header(head: bytes, name: str) -> Header:
    """Checked header of the file `name` whose first bytes are `head`.

    Raises E101 (cut off), E105 (impossible field), E106 (stored in a way that is not read).
    """
    fields, length = _fields(head, name)
    if not _truth(fields, "binarydata", "True", name):
        raise not_read(name, "holds its voxels as text")
    beside = fields["elementdatafile"]
    beside = "" if beside.upper() == "LOCAL" else data_file(beside, name)
    skip = _number(fields, "headersize", 0, name)
    packing = "zlib" if _truth(fields, "compresseddata", "False", name) else ""
    if skip and (packing or not beside or skip < 0):
        raise not_read(name, f"has HeaderSize {skip:g}")
    n_components = _number(fields, "elementnumberofchannels", 1, name)
    if not (1 <= n_components < 2**31 and n_components == int(n_components)):
        raise impossible(name, f"ElementNumberOfChannels {n_components:g}")
    shape = _sizes(fields, name)
    shape += (1,) * (3 - len(shape))
    several = n_components > 1
    if several and len(shape) > 3:
        raise not_read(name, "is a series of vectors")
    return Header((*shape, int(n_components)) if several else shape, _dtype(fields, name),
                  int(skip) if beside else length, packing=packing, data_file=beside,
                  slope=_number(fields, "elementtointensityfunctionslope", 1, name),
                  inter=_number(fields, "elementtointensityfunctionoffset", 0, name),
                  last_axis=0 if several else -1, vector=several, vectors=Vectors(LPS, LPS))


@np.errstate(all="ignore")  # what overflows is refused by its result
def read_frame(head: bytes, name: str) -> tuple[np.ndarray, int]:
    """Affine (4, 4) voxel -> RAS mm, and its code: 1, or 0 where the file states no position.

    Raises E110 when unusable.
    """
    fields, _ = _fields(head, name)
    n = len(_sizes(fields, name))
    spacing = fields.get("elementspacing", fields.get("elementsize", "1 " * n))
    sizes, origin = np.array(_n(spacing, n, name)), np.array(_n(fields.get("offset", "0 " * n), n, name))
    # The file lists the direction of its first axis, then that of the second, ...
    turn = np.array(_n(fields.get("transformmatrix", " ".join(map(str, np.eye(n).ravel()))), n * n, name)).reshape(n, n)
    axes, affine = min(n, 3), np.eye(4)
    columns = np.zeros((3, axes))
    columns[:axes] = (turn.T * sizes)[:axes, :axes]
    affine[:3, :3] = completed(columns)
    affine[:axes, 3] = origin[:axes]
    affine = LPS_TO_RAS @ affine
    check_affine(affine, name)
    return affine, int("offset" in fields or "transformmatrix" in fields)


def _sizes(fields, name: str) -> tuple[int, ...]:
    sizes = lengths(fields.get("dimsize", ""), name, "DimSize")
    if numbers(fields.get("ndims", ""), name, "NDims", int) != [len(sizes)]:
        raise impossible(name, f"NDims {fields.get('ndims', '')[:20]!r} of {len(sizes)} sizes")
    return sizes


def _dtype(fields, name: str) -> np.dtype:
    word = fields.get("elementtype", "")
    if word.endswith("_ARRAY"):
        raise XfemnavError("E122", f"{name} is an image of vectors ({word[:40]}); give one scalar intensity a voxel.")
    if word not in TYPES:
        raise impossible(name, f"ElementType {word[:40]!r}")
    return np.dtype(TYPES[word]).newbyteorder(">" if _truth(fields, "binarydatabyteordermsb", "False", name) else "<")


def _truth(fields, field: str, default: str, name: str) -> bool:
    word = fields.get(field, default).lower()
    if word not in ("true", "false", "1", "0"):
        raise impossible(name, f"{field} {word[:20]!r}")
    return word in ("true", "1")


def _n(text: str, n: int, name: str) -> list[float]:
    found = numbers(text, name, "line")
    if len(found) != n:
        raise impossible(name, f"line {text[:60]!r}: {n} numbers are wanted")
    return found


def _number(fields, field: str, default: float, name: str) -> float:
    return _n(fields[field], 1, name)[0] if field in fields else float(default)
