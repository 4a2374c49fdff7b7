"""One DICOM file -> what it says of its slice, and the slice's pixels.

The data elements are walked here, each held against the bytes that are there, because readers return zeros for the
part of a slice that a truncated file lacks. Native pixels are taken from the bytes; compressed ones (JPEG, JPEG-LS,
JPEG 2000, RLE) are decoded by GDCM, once their fragments are known to be complete.
Source: DICOM PS3.5 (encoding), PS3.3 C.7.6 (image plane and pixel), https://www.dicomstandard.org/current.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.formats import impossible, not_read

MARK = slice(128, 132)  # where a DICOM file says DICM
DEPTH = 16  # of sequences in sequences
UNDEFINED = 0xFFFFFFFF
PIXELS, ITEM, ITEM_END, SEQUENCE_END = (0x7FE0, 0x10), (0xFFFE, 0xE000), (0xFFFE, 0xE00D), (0xFFFE, 0xE0DD)
LONG = {b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"}  # 4-byte length

IMPLICIT, EXPLICIT, BIG = "1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2"
JPEG = {f"1.2.840.10008.1.2.4.{n}" for n in (50, 51, 57, 70, 80, 81, 90, 91)}  # each ends with the mark FF D9
RLE = "1.2.840.10008.1.2.5"
IMAGES = "1.2.840.10008.5.1.4.1.1."  # classes of stored objects; those below have no pixels
NO_IMAGES = tuple(IMAGES + n for n in ("9.", "11.", "66", "88.", "104.", "481.3", "481.4", "481.5", "481.8"))

WANTED = {(2, 0x2): "kind", (2, 0x10): "syntax", (8, 0x16): "kind", (8, 0x18): "instance", (8, 0x103E): "title",
          (0x18, 0x50): "thickness", (0x18, 0x88): "gap", (0x20, 0xE): "series", (0x20, 0x32): "position",
          (0x20, 0x37): "turn", (0x28, 0x2): "samples", (0x28, 0x4): "colours", (0x28, 0x8): "frames",
          (0x28, 0x10): "rows", (0x28, 0x11): "columns", (0x28, 0x30): "spacing", (0x28, 0x100): "bits",
          (0x28, 0x101): "stored_bits", (0x28, 0x102): "high_bit", (0x28, 0x103): "signed", (0x28, 0x1052): "inter",
          (0x28, 0x1053): "slope"}
INTEGERS = {"samples", "rows", "columns", "bits", "stored_bits", "high_bit", "signed"}  # two bytes each


class Plane(NamedTuple):
    """One slice as its file tells it, pixels not yet decoded.

    `shape` (columns, rows); `position` (3,) LPS mm of the first pixel; `turn` (2, 3) unit vectors LPS along a row and
    down a column; `spacing` (2,) mm between columns and between rows; `thickness` mm. None: not said.
    """

    path: Path
    series: str
    title: str
    instance: str
    shape: tuple[int, int]
    position: np.ndarray | None
    turn: np.ndarray | None
    spacing: np.ndarray | None
    thickness: float
    fields: dict
    data: bytes

    @property
    def scale(self) -> tuple[float, float]:
        """Slope and intercept of value = slope * stored + intercept."""
        return (_floats(self.fields, "slope", 1, self.path.name) or [1.0])[0], (
            _floats(self.fields, "inter", 1, self.path.name) or [0.0])[0]


def recognises(head: bytes) -> bool:
    """Whether `head`, the first bytes of a file, starts a DICOM file."""
    return head[MARK] == b"DICM"


def read_plane(path: Path, data: bytes) -> Plane | None:
    """What the DICOM file `path` of bytes `data` says of its slice; None when it is no image (DICOMDIR, a report).

    Raises E101 (cut off), E105 (impossible), E106 (compression, or several frames), E122 (colour).
    """
    name = path.name
    fields = _elements(data, name)
    kind = fields.get("kind", IMAGES)
    if not kind.startswith(IMAGES) or kind.startswith(NO_IMAGES):
        return None
    missing = [field for field in (*INTEGERS - {"samples", "high_bit"}, "pixels", "series") if field not in fields]
    if missing:
        raise XfemnavError("E101", f"{name} is damaged: it ends before, or lacks, {', '.join(sorted(missing))}. Copy "
                                   "it again.")
    if fields.get("samples", 1) != 1 or fields.get("colours", "MONOCHROME2") not in ("MONOCHROME1", "MONOCHROME2"):
        raise XfemnavError("E122", f"{name} is a colour image ({fields.get('colours')}); give one scalar a pixel.")
    if fields.get("frames", "1") not in ("1", ""):
        raise not_read(name, f"is a DICOM file of several frames ({fields['frames'][:20]})")
    _check_pixels(fields, name)
    position, turn, spacing = (_floats(fields, field, n, name) for field, n in (
        ("position", 3), ("turn", 6), ("spacing", 2)))
    thickness = _floats(fields, "gap", 1, name) or _floats(fields, "thickness", 1, name) or [1.0]
    return Plane(path, fields["series"], fields.get("title", ""), fields.get("instance", ""),
                 (fields["columns"], fields["rows"]), None if position is None else np.array(position),
                 None if turn is None else np.array(turn).reshape(2, 3),
                 None if spacing is None else np.array(spacing[::-1]), abs(thickness[0]), fields, data)


def pixels(plane: Plane) -> np.ndarray:
    """Values (columns, rows) of a slice, slope and intercept applied. Raises E101."""
    fields, (columns, rows) = plane.fields, plane.shape
    if fields["syntax"] not in (IMPLICIT, EXPLICIT, BIG):
        return _decompressed(plane)
    start, _ = fields["pixels"]
    bits, stored, order = fields["bits"], fields["stored_bits"], ">" if fields["syntax"] == BIG else "<"
    raw = np.frombuffer(plane.data, f"{order}u{bits // 8}", columns * rows, start).astype(np.int64)
    raw = raw >> (fields.get("high_bit", stored - 1) + 1 - stored) & ((1 << stored) - 1)  # other bits: overlays
    if fields["signed"]:
        raw -= (raw >> (stored - 1)) << stored
    slope, inter = plane.scale
    return (raw * slope + inter).reshape(rows, columns).T


def _decompressed(plane: Plane) -> np.ndarray:
    """GDCM's reading of the file, which applies slope and intercept."""
    import SimpleITK as sitk  # few files need it, and it takes as long to load as a slice to warp

    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(plane.path))
    try:
        image = sitk.GetArrayFromImage(reader.Execute())
        same = plane.path.read_bytes() == plane.data
    except (RuntimeError, OSError) as error:
        raise XfemnavError("E101", f"{plane.path.name} is damaged: its pixels cannot be decompressed "
                                   f"({str(error).splitlines()[-1][:120]}). Copy it again.") from None
    if not same or image.size != plane.shape[0] * plane.shape[1]:
        raise XfemnavError("E101", f"{plane.path.name} decompresses to {image.size} pixels, not {plane.shape[0]} x "
                                   f"{plane.shape[1]}, or changed while it was read. Copy it again.")
    return image.reshape(plane.shape[::-1]).T.astype(float)


def _floats(fields: dict, field: str, n: int, name: str) -> list[float] | None:
    """The `n` numbers of a decimal string, None when it is absent or empty. Raises E105."""
    text = fields.get(field, "")
    if not text:
        return None
    try:
        found = [float(word) for word in text.split("\\")]
    except ValueError:
        found = []
    if len(found) != n or not np.isfinite(found).all():
        raise impossible(name, f"{field} {text[:60]!r}")
    return found


def _check_pixels(fields: dict, name: str) -> None:
    """The pixels must be as many bytes as rows, columns and bits say. Raises E101, E102, E105, E106."""
    bits, stored = fields["bits"], fields["stored_bits"]
    high = fields.get("high_bit", stored - 1)
    if bits not in (8, 16, 32) or not 1 <= stored <= bits or not stored - 1 <= high < bits or fields["signed"] > 1 or (
            not fields["rows"] * fields["columns"]):
        raise impossible(name, f"pixels of {bits} bits ({stored} stored, highest {high}), {fields['columns']} x "
                               f"{fields['rows']} of them")
    length, wanted = fields["pixels"][1], fields["rows"] * fields["columns"] * bits // 8
    if fields["syntax"] in JPEG | {RLE}:
        if length:
            raise impossible(name, "pixels: compressed ones lie in fragments")
        return
    if fields["syntax"] not in (IMPLICIT, EXPLICIT, BIG):
        raise not_read(name, f"has the transfer syntax {fields['syntax'][:64]}")
    if length < wanted:
        raise XfemnavError("E101", f"{name} is damaged: {length} of {wanted} bytes of pixels. Copy it again.")
    if length > wanted + wanted % 2:
        raise XfemnavError("E102", f"{name} holds {length} bytes of pixels, its rows, columns and bits make {wanted}; "
                                   "get it again from its source.")


# Data elements --------------------------------------------------------------------------------------------------------

def _elements(data: bytes, name: str) -> dict:
    """The `WANTED` fields of a file, and "pixels": start and length in bytes (0: in fragments, which are complete)."""
    fields, place, order, explicit, in_meta = {"syntax": IMPLICIT}, 132, "<", True, True
    while place < len(data):
        if in_meta and data[place : place + 2] != b"\2\0":  # from here on in the syntax that group 2 named
            in_meta, explicit = False, fields["syntax"] != IMPLICIT
            order = ">" if fields["syntax"] == BIG else "<"
        tag, length, place = _tag(data, place, order, explicit, name)
        if tag == PIXELS:
            if length == UNDEFINED:
                _check_fragments(data, place, fields["syntax"], name)
            elif place + length > len(data):
                raise _cut(name, len(data))
            return fields | {"pixels": (place, 0 if length == UNDEFINED else length)}
        if length == UNDEFINED:
            place = _after_sequence(data, place, order, explicit, name)
            continue
        _keep(fields, tag, data[place : place + length], order, name)
        place += length
    if place > len(data):
        raise _cut(name, len(data))
    return fields


def _cut(name: str, length: int) -> XfemnavError:
    return XfemnavError("E101", f"{name} is damaged: it ends after {length} bytes, within a data element. Copy it "
                                "again.")


def _tag(data: bytes, place: int, order: str, explicit: bool, name: str) -> tuple[tuple[int, int], int, int]:
    """Tag and length of the data element at `place`, and where its value starts. Raises E101."""
    try:
        tag = struct.unpack_from(order + "HH", data, place)
        if not explicit or tag[0] == 0xFFFE:
            return tag, struct.unpack_from(order + "I", data, place + 4)[0], place + 8
        if data[place + 4 : place + 6] in LONG:
            return tag, struct.unpack_from(order + "I", data, place + 8)[0], place + 12
        return tag, struct.unpack_from(order + "H", data, place + 6)[0], place + 8
    except struct.error:
        raise _cut(name, len(data)) from None


def _keep(fields: dict, tag: tuple[int, int], value: bytes, order: str, name: str) -> None:
    field = WANTED.get(tag)
    if field in INTEGERS:
        if len(value) != 2:
            raise impossible(name, f"{field} of {len(value)} bytes")
        fields[field] = struct.unpack(order + "H", value)[0]
    elif field:
        fields[field] = value[:1024].decode("ascii", "replace").strip(" \0")


def _after_sequence(data: bytes, place: int, order: str, explicit: bool, name: str, depth: int = 0) -> int:
    """Where a sequence or item of undefined length that starts at `place` has ended. Raises E101, E105."""
    if depth > DEPTH:
        raise impossible(name, f"sequences, more than {DEPTH} in one another")
    explicit = explicit and data[place - 8 : place - 6] != b"UN"  # what nobody knew when it was written is implicit
    while place < len(data):
        tag, length, place = _tag(data, place, order, explicit, name)
        if tag in (ITEM_END, SEQUENCE_END):
            return place
        if length == UNDEFINED:
            place = _after_sequence(data, place, order, explicit, name, depth + 1)
        else:
            place += length
    raise _cut(name, len(data))


def _check_fragments(data: bytes, place: int, syntax: str, name: str) -> None:
    """Compressed pixels are items up to a sequence's end, and a JPEG stream has its own end mark. Raises E101."""
    last = b""
    while True:
        tag, length, place = _tag(data, place, "<", True, name)
        if tag == SEQUENCE_END:
            break
        if tag != ITEM or place + length > len(data):
            raise _cut(name, len(data))
        last, place = data[place : place + length], place + length
    if syntax in JPEG and not last.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise XfemnavError("E101", f"{name} is damaged: its compressed pixels lack their end mark. Copy it again.")
