"""One DICOM file -> what it says of its slice, and the slice's pixels.

Pixels are taken when all of them are there: readers return zeros for the part of a slice that a truncated file lacks.
Only what is known to be cut off is called damaged; what is not read is called by its name.
Source: DICOM PS3.5 (encoding), PS3.3 C.7.6 (image plane and pixel), https://www.dicomstandard.org/current.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import size
from xfemnav.imaging.reading.dicom_codecs import COMPRESSED, JPEG, decompressed
from xfemnav.imaging.reading.dicom_elements import (
    BIG,
    DEFLATED,
    EXPLICIT,
    FRAMES,
    IMPLICIT,
    OTHER_PIXELS,
    PIXELS,
    UNDEFINED,
    Elements,
    walked,
)
from xfemnav.imaging.reading.formats import impossible, not_read

MARK = slice(128, 132)  # where a DICOM file says DICM
ITEM, SEQUENCE_END = (0xFFFE, 0xE000), (0xFFFE, 0xE0DD)
NEEDED = ("BitsAllocated", "BitsStored", "Columns", "PixelRepresentation", "Rows")  # of all images, by PS3.3 C.7.6.3


class Plane(NamedTuple):
    """One slice as its file tells it, pixels not yet decoded.

    `series`: what tells its series from others; `shape` (columns, rows); `position` (3,) LPS mm of the first pixel;
    `turn` (2, 3) unit vectors LPS along a row and down a column; `spacing` (2,) mm between columns and between rows;
    `thickness` mm. None: not said. `data`: the pixels' bytes, native or compressed.
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
        """Slope and intercept of value = slope * stored + intercept. A slope of 0 says nothing, as to ITK."""
        slope, inter = (_floats(self.fields, f"Rescale{what}", 1, self.path.name) for what in ("Slope", "Intercept"))
        return (slope or [1.0])[0] or 1.0, (inter or [0.0])[0]


def recognises(head: bytes) -> bool:
    """Whether `head`, the first bytes of a file, starts a DICOM file."""
    return head[MARK] == b"DICM"


def read_plane(path: Path, data: bytes, room: int) -> Plane | None:
    """What the DICOM file `path` of bytes `data` says of its slice; None when it is no image (DICOMDIR, a report).

    Of a deflated file at most `room` bytes are unpacked. Raises E101 (cut off), E102 (too large), E105 (impossible),
    E106 (compression, or several frames), E122 (colour).
    """
    name = path.name
    elements = walked(data, room, name)
    if elements is None:
        return None
    fields = elements.fields
    _check_kind(elements, name)
    _check_pixels(elements, room, name)
    position, turn, spacing = (_floats(fields, field, n, name) for field, n in (
        ("ImagePositionPatient", 3), ("ImageOrientationPatient", 6), ("PixelSpacing", 2)))
    thickness = (_floats(fields, "SpacingBetweenSlices", 1, name) or _floats(fields, "SliceThickness", 1, name)
                 or [1.0])
    # A file that lacks its series' identifier is grouped by what else tells one series from another.
    series = fields.get("SeriesInstanceUID") or "\n".join(fields.get(field, "") for field in (
        "StudyInstanceUID", "SeriesNumber", "SeriesDescription"))
    return Plane(path, series, fields.get("SeriesDescription", ""), fields.get("SOPInstanceUID", ""),
                 (fields["Columns"], fields["Rows"]), None if position is None else np.array(position),
                 None if turn is None else np.array(turn).reshape(2, 3),
                 None if spacing is None else np.array(spacing[::-1]), abs(thickness[0]), fields,
                 _pixel_bytes(elements, data, name))


@np.errstate(all="ignore")  # what overflows is infinite, and told as such
def pixels(plane: Plane) -> np.ndarray:
    """Values (columns, rows) of a slice, slope and intercept applied. Raises E101.

    Where the largest value is black (MONOCHROME1) they are inverted, as ITK does: bright is bright in every image.
    """
    fields, (columns, rows) = plane.fields, plane.shape
    bits, stored, syntax = fields["BitsAllocated"], fields["BitsStored"], fields["syntax"]
    if syntax in COMPRESSED:
        raw = decompressed(plane.data, fields, plane.path.name)
    else:
        raw = np.frombuffer(plane.data, f"{'>' if syntax == BIG else '<'}u{bits // 8}", columns * rows).astype(np.int64)
    largest = (1 << stored) - 1
    raw = raw >> (fields.get("HighBit", stored - 1) + 1 - stored) & largest  # other bits: overlays
    if fields.get("PhotometricInterpretation") == "MONOCHROME1":
        raw = largest - raw
    if fields["PixelRepresentation"]:
        raw -= (raw >> (stored - 1)) << stored
    slope, inter = plane.scale
    return (raw * slope + inter).reshape(rows, columns).T


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


# What is refused ------------------------------------------------------------------------------------------------------

def _check_kind(elements: Elements, name: str) -> None:
    """The file must be one plane of scalars in a syntax that is read. Raises E101, E105, E106, E122."""
    fields = elements.fields
    frames = fields.get("NumberOfFrames", "1") or "1"
    if elements.tag >> 16 == FRAMES or frames != "1":
        raise XfemnavError("E106", f"{name} is a multi-frame DICOM file ({_named(fields['SOPClassUID'])}, "
                                   f"{frames[:20]} frames), which xfemnav does not read; convert it to NIfTI with "
                                   "dcm2niix.")
    if "MOSAIC" in fields.get("ImageType", "").split("\\"):
        raise XfemnavError("E106", f"{name} is a mosaic: its slices lie side by side in one plane (as Siemens stores "
                                   "EPI), which xfemnav does not read; convert it to NIfTI with dcm2niix.")
    if elements.tag in OTHER_PIXELS:
        raise not_read(name, f"has {OTHER_PIXELS[elements.tag]} pixels")
    if elements.tag != PIXELS:
        raise XfemnavError("E101", f"{name} is damaged: it ends before its pixels. Copy it again.")
    missing = [field for field in NEEDED if field not in fields]
    if missing:
        raise XfemnavError("E105", f"{name} lacks {', '.join(missing)}, without which its pixels cannot be read; get "
                                   "it again from its source.")
    colours = fields.get("PhotometricInterpretation") or "MONOCHROME2"
    if fields.get("SamplesPerPixel", 1) != 1 or colours not in ("MONOCHROME1", "MONOCHROME2"):
        raise XfemnavError("E122", f"{name} is a colour image ({colours[:20]}); give one scalar a pixel.")
    if fields["syntax"] not in (IMPLICIT, EXPLICIT, BIG, DEFLATED, *COMPRESSED):
        raise not_read(name, f"has the transfer syntax {_named(fields['syntax'])}")


def _named(uid: str) -> str:
    """A UID of the standard with its name, others as they are."""
    from pydicom.config import IGNORE
    from pydicom.uid import UID

    name = UID(uid, IGNORE).name
    return uid[:64] if name == uid else f"{name} ({uid})"


def _check_pixels(elements: Elements, room: int, name: str) -> None:
    """The pixels must be as many bytes as rows, columns and bits say. Raises E101, E102, E105, E106.

    Padding behind them is allowed (PS3.5 8.1.1): less than a row or column, or one byte over and over
    (`_pixel_bytes`). Rows or columns that are too few in the header leave more than that.
    """
    fields, length = elements.fields, elements.length
    bits, stored, rows, columns = (fields[field] for field in ("BitsAllocated", "BitsStored", "Rows", "Columns"))
    high = fields.get("HighBit", stored - 1)
    if bits in (1, 24, 64):
        raise not_read(name, f"has pixels of {bits} bits")
    if bits not in (8, 16, 32) or not 1 <= stored <= bits or not stored - 1 <= high < bits or (
            fields["PixelRepresentation"] > 1 or not rows * columns):
        raise impossible(name, f"pixels of {bits} bits ({stored} stored, highest {high}), {columns} x {rows} of them")
    wanted = rows * columns * bits // 8
    if 16 * rows * columns > room:  # read and returned in float64
        raise XfemnavError("E102", f"header of {name} claims {columns} x {rows} pixels, more than fit into the "
                                   f"{size(room)} that the limit leaves. Raise ⟦max_memory⟧ if the header is right.")
    if (fields["syntax"] in COMPRESSED) != (length == UNDEFINED):
        raise impossible(name, "pixels: compressed ones lie in fragments, and no others")
    if length == UNDEFINED:
        return
    if length < wanted:
        raise XfemnavError("E101", f"{name} is damaged: {length} of {wanted} bytes of pixels. Copy it again.")
    if length > 2 * wanted + 1024:
        raise _too_many(length, wanted, name)


def _too_many(length: int, wanted: int, name: str) -> XfemnavError:
    return XfemnavError("E102", f"{name} holds {length} bytes of pixels, its rows, columns and bits make {wanted}; get "
                                "it again from its source.")


def _pixel_bytes(elements: Elements, data: bytes, name: str) -> bytes | memoryview:
    """The pixels, all of them: native ones without padding, or the compressed stream. Raises E101, E102."""
    fields, place, length = elements.fields, elements.place, elements.length
    if length == UNDEFINED:
        return _check_fragments(data, place, fields["syntax"], name)
    found = memoryview(data)[place : place + length]
    if fields["syntax"] == DEFLATED:
        elements.stream.seek(place)
        found = elements.stream.read(length)
        elements.stream.finish()
    if len(found) < length:
        raise XfemnavError("E101", f"{name} is damaged: it ends after {len(found)} of {length} bytes of pixels. Copy "
                                   "it again.")
    lines, depth = (fields["Rows"], fields["Columns"]), fields["BitsAllocated"] // 8
    wanted = lines[0] * lines[1] * depth
    padding = bytes(found[wanted:])
    if len(padding) >= max(min(lines) * depth, 2) and padding.strip(padding[:1]):
        raise _too_many(length, wanted, name)
    return found[:wanted]


def _check_fragments(data: bytes, place: int, syntax: str, name: str) -> bytes:
    """The compressed stream in the items that start at `place`, up to a sequence's end. Raises E101.

    A JPEG stream has an end mark of its own; behind it there may be padding.
    """
    parts, tag = [], None
    while tag != SEQUENCE_END:
        if place + 8 > len(data):
            raise XfemnavError("E101", f"{name} is damaged: it ends within its compressed pixels. Copy it again.")
        *tag, length = struct.unpack_from("<HHI", data, place)
        tag, part, place = tuple(tag), data[place + 8 : place + 8 + length], place + 8 + length
        if tag == ITEM and len(part) == length:
            parts.append(part)
        elif tag != SEQUENCE_END:
            raise XfemnavError("E101", f"{name} is damaged: a fragment of its compressed pixels is cut off. Copy it "
                                       "again.")
    stream = b"".join(parts[1:])  # the first is a table of offsets
    if syntax in JPEG and not stream.rstrip(b"\0\xff ").endswith(b"\xff\xd9"):
        raise XfemnavError("E101", f"{name} is damaged: its compressed pixels lack their end mark. Copy it again.")
    return stream
