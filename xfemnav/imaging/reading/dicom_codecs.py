"""Compressed pixels of a DICOM file -> what is stored: RLE here, the JPEG family by GDCM.

Streams are checked before they are decoded: decoders allocate what a stream claims, and fill up what it lacks.
Source: DICOM PS3.5 annexes A.4 and G; ITU-T T.81 B.2, T.87 C.2 (JPEG, JPEG-LS frame headers), T.800 A.5.1 (SIZ).
"""

import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import silenced

JPEG = {f"1.2.840.10008.1.2.4.{n}" for n in (50, 51, 57, 70, 80, 81, 90, 91)}  # each ends with the mark FF D9
RLE = "1.2.840.10008.1.2.5"
COMPRESSED = {RLE, *JPEG}

SOC_SIZ = b"\xff\x4f\xff\x51"  # how a JPEG 2000 codestream starts
FRAME_HEADERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC} | {0xF7}


def decompressed(stream: bytes, fields: dict, name: str) -> np.ndarray:
    """Stored values (rows * columns) of a compressed `stream`, int64, signs not yet told. Raises E101, E502."""
    try:
        raw = _run_lengths(stream, fields) if fields["syntax"] == RLE else _by_gdcm(stream, fields)
    except (ValueError, RuntimeError, struct.error, IndexError) as error:
        raise XfemnavError("E101", f"{name} is damaged: its pixels cannot be decompressed "
                                   f"({str(error).splitlines()[-1][:120]}). Copy it again.") from None
    except OSError as error:
        raise XfemnavError("E502", f"cannot write the pixels of {name} to a temporary file for GDCM: "
                                   f"{error.strerror}. Set TMPDIR to a folder that can be written.") from None
    return raw


def _run_lengths(stream: bytes, fields: dict) -> np.ndarray:
    """The segments of an RLE stream: the first byte of each pixel, the most significant one, then the next."""
    n_pixels, depth = fields["Rows"] * fields["Columns"], fields["BitsAllocated"] // 8
    count, *starts = struct.unpack_from("<16I", stream)
    if count != depth:
        raise ValueError(f"{count} segments for pixels of {depth} bytes")
    raw = np.zeros(n_pixels, np.int64)
    for start, end in zip(starts[:depth], [*starts[1:depth], len(stream)]):
        raw = raw << 8 | np.frombuffer(_unpacked(stream[start:end], n_pixels), np.uint8)
    return raw


def _unpacked(segment: bytes, n_bytes: int) -> bytes:
    """The first `n_bytes` that PackBits packs: a count n < 128 is followed by n + 1 bytes, n > 128 by a byte that is
    repeated 257 - n times."""
    found, place = bytearray(), 0
    while len(found) < n_bytes and place < len(segment) - 1:
        count = segment[place]
        if count < 128:
            found += segment[place + 1 : place + 2 + count]
            place += 2 + count
        else:
            found += segment[place + 1 : place + 2] * (257 - count) if count > 128 else b""
            place += 2 if count > 128 else 1
    if len(found) < n_bytes:
        raise ValueError(f"{len(found)} of {n_bytes} bytes in a run-length segment")
    return bytes(found[:n_bytes])


def _by_gdcm(stream: bytes, fields: dict) -> np.ndarray:
    """A JPEG, JPEG-LS or JPEG 2000 stream, from a file of it alone: what else a file says, GDCM would apply as well."""
    import SimpleITK as sitk  # few files need it, and it takes as long to load as a slice to warp

    shape = rows, columns = fields["Rows"], fields["Columns"]
    *stated, bits = _stated(stream)
    if tuple(stated) != shape or bits > fields["BitsAllocated"]:
        raise ValueError(f"{stated[1]} x {stated[0]} pixels of {bits} bits in the stream, {columns} x {rows} of "
                         f"{fields['BitsAllocated']} in the header")
    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    with tempfile.TemporaryDirectory(prefix="xfemnav-") as scratch:
        reader.SetFileName(str(_alone(Path(scratch) / "pixels.dcm", stream, bits, fields)))
        with (Path(scratch) / "said").open("w+b") as said, _stderr_into(said):
            raw = sitk.GetArrayFromImage(reader.Execute()).astype(np.int64).ravel()
        if doubt := (Path(scratch) / "said").read_text("ascii", "replace"):
            raise ValueError(" ".join(doubt.split()))
    if len(raw) != rows * columns:
        raise ValueError(f"{len(raw)} pixels")
    return raw


@contextmanager
def _stderr_into(file) -> Iterator[None]:
    """What libraries print on stderr goes into `file`: of a stream that ends early libjpeg says nothing otherwise."""
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # it is closed
        kept = None
    os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        if kept is None:
            os.close(2)
        else:
            os.dup2(kept, 2)
            os.close(kept)


def _alone(path: Path, stream: bytes, bits: int, fields: dict) -> Path:
    """A DICOM file at `path` that says of the pixels in `stream`, of so many `bits`, how they are stored, and no more.

    GDCM refuses a header of fewer bits than the stream has, though the others may be unused.
    """
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.encaps import encapsulate
    from pydicom.uid import SecondaryCaptureImageStorage, generate_uid

    plane = Dataset()
    plane.file_meta = FileMetaDataset()
    plane.file_meta.TransferSyntaxUID = fields["syntax"]
    plane.file_meta.MediaStorageSOPClassUID = plane.SOPClassUID = SecondaryCaptureImageStorage
    plane.file_meta.MediaStorageSOPInstanceUID = plane.SOPInstanceUID = generate_uid()
    plane.SamplesPerPixel, plane.PhotometricInterpretation = 1, "MONOCHROME2"
    for keyword in ("Rows", "Columns", "BitsAllocated", "PixelRepresentation"):
        setattr(plane, keyword, fields[keyword])
    plane.BitsStored, plane.HighBit = bits, bits - 1
    plane.add_new(0x7FE00010, "OB", encapsulate([stream]))
    plane["PixelData"].is_undefined_length = True
    with silenced():
        plane.save_as(path, enforce_file_format=True)
    return path


def _stated(stream: bytes) -> tuple[int, int, int]:
    """Rows, columns and bits that a JPEG, JPEG-LS or JPEG 2000 stream claims. Raises ValueError, struct.error."""
    start = stream.find(SOC_SIZ, 0, 512)
    if start >= 0:
        right, low, left, top = struct.unpack_from(">4I", stream, start + 8)
        return low - top, right - left, (stream[start + 42] & 0x7F) + 1
    place = stream.find(b"\xff\xd8") + 2
    while place >= 2 and stream[place] == 0xFF:
        if stream[place + 1] in FRAME_HEADERS:
            bits, rows, columns = struct.unpack_from(">B2H", stream, place + 4)
            return rows, columns, bits
        place += 1 if stream[place + 1] == 0xFF else 2 + struct.unpack_from(">H", stream, place + 2)[0]
    raise ValueError("no frame header")
