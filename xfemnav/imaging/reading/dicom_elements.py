"""The data elements of a DICOM file, up to its pixels, by pydicom.

pydicom walks within the bytes that are there, and where a file was cut off it stops without a word: a walk that did not
come to the pixels says so. It is given a file that is read forwards and so often at most, because it keeps an object of
each element of a nested sequence, and would inflate a deflated file whole, however long.
"""

import io
from typing import NamedTuple

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import Forwards, Zlib, silenced
from xfemnav.imaging.reading.formats import impossible

META = 132  # where the elements start, behind DICM
UNDEFINED = 0xFFFFFFFF
PIXELS, OTHER_PIXELS = 0x7FE00010, {0x7FE00008: "floating-point", 0x7FE00009: "double-precision"}
FRAMES = 0x5200  # group of what each frame of an enhanced file says for itself

IMPLICIT, EXPLICIT, BIG = "1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2"
DEFLATED = "1.2.840.10008.1.2.1.99"
IMAGES = "1.2.840.10008.5.1.4.1.1."  # classes of stored objects; those below have no pixels, or no image of the patient
NO_IMAGES = ("4.2.", "9.", "10.", "11.", "66.", "67.", "68.", "78.", "79.", "80.", "88.", "90.", "91.", "104.", "129.",
             "131.", "200.", "201.", *(f"481.{n}." for n in range(3, 23)))

INTEGERS = {"BitsAllocated", "BitsStored", "Columns", "HighBit", "PixelRepresentation", "Rows", "SamplesPerPixel"}
TEXTS = {"ImageOrientationPatient", "ImagePositionPatient", "ImageType", "NumberOfFrames", "PhotometricInterpretation",
         "PixelSpacing", "RescaleIntercept", "RescaleSlope", "SOPClassUID", "SOPInstanceUID", "SeriesDescription",
         "SeriesInstanceUID", "SeriesNumber", "SliceThickness", "SpacingBetweenSlices", "StudyInstanceUID"}


class Elements(NamedTuple):
    """What stands before the pixels of a file: texts and integers by their keyword, and the transfer "syntax".

    `tag` of the element that ended the walk (0: the end of the file), whose value of `length` bytes starts at `place`
    of the `stream`.
    """

    fields: dict
    stream: Forwards
    tag: int
    place: int
    length: int


def walked(data: bytes, room: int, name: str) -> Elements | None:
    """The elements of a file up to its pixels; None where it is no image. Raises E101, E102, E105."""
    with silenced():  # what pydicom doubts is checked here, or means nothing to an image
        try:
            return _elements(data, room, name)
        except Exception as error:  # pydicom raises what it likes, and OSError for whatever reading a sequence raised
            cause = error.__context__ if isinstance(error, OSError) and error.__context__ else error
            if isinstance(cause, XfemnavError | MemoryError) or not isinstance(cause, Exception):
                raise cause from None
            if isinstance(cause, RecursionError):
                raise impossible(name, "sequences, too many in one another") from None
            raise XfemnavError("E101", f"{name} is damaged: its data elements cannot be read ({str(error)[:120]}). "
                                       "Copy it again.") from None


def _elements(data: bytes, room: int, name: str) -> Elements | None:
    from pydicom.datadict import tag_for_keyword
    from pydicom.filereader import read_dataset

    stream = Forwards(io.BytesIO(data), len(data), name)
    stream.seek(META)
    meta = read_dataset(stream, False, True, stop_when=lambda tag, vr, length: tag.group != 2)
    fields = {"syntax": _value(meta, 0x00020010, name) or IMPLICIT, "SOPClassUID": _value(meta, 0x00020002, name)}
    if not _is_image(fields["SOPClassUID"]):
        return None
    if fields["syntax"] == DEFLATED:
        stream = Forwards(Zlib(data[stream.tell() :], raw=True), room, name)
    end = [0, 0, 0]

    def at_pixels(tag, vr, length):
        if at_end := tag in (PIXELS, *OTHER_PIXELS) or tag.group == FRAMES:
            end[:] = int(tag), stream.tell(), length
        return at_end

    wanted = {tag_for_keyword(keyword): keyword for keyword in INTEGERS | TEXTS}
    found = read_dataset(stream, fields["syntax"] == IMPLICIT, fields["syntax"] != BIG, stop_when=at_pixels,
                         specific_tags=list(wanted))
    values = {keyword: _value(found, tag, name, keyword in INTEGERS) for tag, keyword in wanted.items()}
    fields |= {keyword: value for keyword, value in values.items() if value != ""}
    return Elements(fields, stream, *end) if _is_image(fields["SOPClassUID"]) else None


def _is_image(kind: str) -> bool:
    """Whether a class of stored objects, "" where the file names none, has images."""
    return not kind or (kind.startswith(IMAGES) and not f"{kind[len(IMAGES) :]}.".startswith(NO_IMAGES))


def _value(found, tag: int, name: str, integer: bool = False) -> str | int:
    """The value of an element as it is stored, "" where it is absent or empty. Raises E105."""
    element = found.get_item(tag) if tag in found else None
    value = (element.value or b"") if element else b""
    if not isinstance(value, bytes) or (integer and len(value) not in (0, 2)):
        raise impossible(name, f"element ({tag >> 16:04X},{tag & 0xFFFF:04X})")
    if integer and value:
        return int.from_bytes(value, "little" if element.is_little_endian else "big")
    return value[:1024].decode("ascii", "replace").strip(" \0")
