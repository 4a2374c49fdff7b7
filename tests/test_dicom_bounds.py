"""What a DICOM file claims is held against what is there before anything is allocated, inflated or decoded."""

import shlex
import struct
import subprocess
import sys
import tracemalloc
import zlib

import numpy as np
import pydicom
import pytest
from pydicom.encaps import encapsulate, generate_fragments
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLosslessSV1,
    RLELossless,
)

from tests.images import image_of
from tests.test_dicom import code_of, write_series
from tests.test_dicom_kinds import AFFINE, RNG, TWELVE, compressed, one
from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.content import Forwards
from xfemnav.imaging.reading.gate import read_image

# Deflated -------------------------------------------------------------------------------------------------------------

def deflated(path, content: bytes, level=9):
    """Replace the deflated data set of the file by that of `content`."""
    whole = path.read_bytes()
    start = 132 + 12 + struct.unpack("<I", whole[140:144])[0]
    packer = zlib.compressobj(level, zlib.DEFLATED, -15)
    path.write_bytes(whole[:start] + packer.compress(content) + packer.flush())
    return path


def element(group, number, vr, value: bytes) -> bytes:
    head = struct.pack("<HH2s", group, number, vr)
    return head + (struct.pack("<HI", 0, len(value)) if vr in (b"OB", b"OW", b"UN", b"UT") else
                   struct.pack("<H", len(value))) + value


def shape(rows, columns) -> bytes:
    numbers = (0x10, rows), (0x11, columns), (0x100, 16), (0x101, 16), (0x102, 15), (0x103, 0)
    return b"".join(element(0x28, number, b"US", struct.pack("<H", value)) for number, value in numbers)


BOMBS = {  # 60 MB each
    "pixels": shape(5000, 6000) + element(0x7FE0, 0x10, b"OW", bytes(60_000_000)),
    "padding": shape(50, 60) + element(0x7FE0, 0x10, b"OW", bytes(60_000_000)),
    "a private element": element(0x9, 0x1001, b"UN", bytes(60_000_000)) + shape(2, 2) + element(
        0x7FE0, 0x10, b"OW", bytes(8)),
    "a text": element(0x8, 0x103E, b"UT", b"x" * 60_000_000),
    "what follows the pixels": shape(2, 2) + element(0x7FE0, 0x10, b"OW", bytes(8)) + element(
        0xFFFC, 0xFFFC, b"OB", bytes(60_000_000)),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_deflate_bomb_is_refused_within_the_memory_limit(tmp_path, bomb):
    folder, path = one(TWELVE, tmp_path / "s", syntax=DeflatedExplicitVRLittleEndian)
    deflated(path, BOMBS[bomb])
    assert path.stat().st_size < 100_000
    read_image(one(TWELVE, tmp_path / "other")[0])  # pydicom is loaded
    tracemalloc.start()
    try:
        assert code_of(folder, max_memory_gb=0.02) == "E102"
        assert tracemalloc.get_traced_memory()[1] < 0.03e9
    finally:
        tracemalloc.stop()


def test_what_lies_before_the_pixels_is_not_kept(tmp_path):
    """60 MB of a private element, within the limit: a sound file of much that nobody reads."""
    folder, path = one(TWELVE, tmp_path / "s", syntax=DeflatedExplicitVRLittleEndian)
    deflated(path, BOMBS["a private element"])
    with pytest.raises(XfemnavError, match="E110"):  # it says nothing of its places
        read_image(folder)
    tracemalloc.start()
    try:
        assert not read_image(folder, spacing=(1, 1, 1)).values.any()
        assert tracemalloc.get_traced_memory()[1] < 0.02e9
    finally:
        tracemalloc.stop()


def test_bombs_in_several_files_share_the_limit(tmp_path):
    folder = write_series(image_of(RNG.integers(0, 9, (24, 20, 5)), AFFINE), tmp_path / "s",
                          DeflatedExplicitVRLittleEndian)
    for path in folder.iterdir():
        deflated(path, shape(250, 1000) + element(0x7FE0, 0x10, b"OW", bytes(500_000)))
    assert code_of(folder, max_memory_gb=0.0055) == "E102"


# Elements -------------------------------------------------------------------------------------------------------------

def put(path, items: bytes):
    """Put a sequence of undefined length and these items into a file."""
    content = path.read_bytes()
    place = content.index(struct.pack("<HH", 0x0028, 0x0002) + b"US")
    sequence = struct.pack("<HH2sHI", 0x0021, 0x1010, b"SQ", 0, 0xFFFFFFFF) + items + struct.pack(
        "<HHI", 0xFFFE, 0xE0DD, 0)
    path.write_bytes(content[:place] + sequence + content[place:])
    return path.parent


def test_objects_without_pixels_are_skipped_however_many_parts_they_have(tmp_path):
    folder, path = one(TWELVE, tmp_path / "s")
    contours = pydicom.dcmread(path)
    del contours.PixelData
    contours.SOPClassUID = contours.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.481.3"
    contours.save_as(folder / "contours.dcm")
    items = struct.pack("<HHI", 0xFFFE, 0xE000, 0) * (Forwards.READS + 1)
    put(folder / "contours.dcm", items)
    with pytest.warns(match=r"W113 .*contours\.dcm"):
        assert read_image(folder).values.shape == TWELVE.shape


def test_millions_of_empty_items_are_not_kept(tmp_path):
    folder, path = one(TWELVE, tmp_path / "s")
    put(path, struct.pack("<HHI", 0xFFFE, 0xE000, 0) * 50)
    assert read_image(folder).values.shape == TWELVE.shape
    put(path, struct.pack("<HHI", 0xFFFE, 0xE000, 0) * 2_000_000)
    assert code_of(folder) == "E105"


@pytest.mark.parametrize("depth, code", [(12, None), (5000, "E105")])
def test_sequences_in_sequences(tmp_path, depth, code):
    start = struct.pack("<HHI", 0xFFFE, 0xE000, 0xFFFFFFFF) + struct.pack(
        "<HH2sHI", 0x0021, 0x1010, b"SQ", 0, 0xFFFFFFFF)
    end = struct.pack("<HHI", 0xFFFE, 0xE0DD, 0) + struct.pack("<HHI", 0xFFFE, 0xE00D, 0)
    folder = put(one(TWELVE, tmp_path / "s")[1], start * depth + end * depth)
    if code is None:
        np.testing.assert_array_equal(read_image(folder).values, TWELVE)
    else:
        assert code_of(folder) == code


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("field, value, codes", [
    ("ImagePositionPatient", ["-1e308", "1e308", "1e308"], ("E110", "E121")),
    ("ImageOrientationPatient", ["1e300"] * 6, ("E110", "E110")),
    ("ImageOrientationPatient", ["1e300", "-1e300", "0", "1e300", "1e300", "0"], ("E110", "E110")),
    ("PixelSpacing", ["1e300", "1e300"], ("E110", "E110")), ("PixelSpacing", ["0", "0"], ("E110", "E110")),
    ("SliceThickness", "1e308", ("E110", None)), ("RescaleSlope", "1e308", ("E103", "E103")),
    ("RescaleIntercept", "-1e308", ("E103", "E103"))])
def test_numbers_beyond_all_measure(tmp_path, field, value, codes):
    """Of one slice and of several: refused by what comes of them, without a word of numpy's."""
    for n_slices, code in zip((1, 3), codes):
        volume = image_of(RNG.integers(1, 900, (9, 8, n_slices)), AFFINE)
        folder = write_series(volume, tmp_path / str(n_slices), change=lambda k, plane: plane.add_new(
            pydicom.datadict.tag_for_keyword(field), "LO", value))
        if code is None:
            read_image(folder)
        else:
            assert code_of(folder) == code


@pytest.mark.parametrize("syntax", [RLELossless, JPEGLosslessSV1, JPEG2000Lossless])
def test_a_stream_that_is_cut_off_inside_whole_fragments(tmp_path, syntax, capfd):
    """With its end mark, where it has one: decoders fill up what is missing, and print it at most."""
    folder, path = one(TWELVE, tmp_path / "s")
    compressed(path, syntax)
    plane = pydicom.dcmread(path)
    stream = b"".join([*generate_fragments(plane.PixelData)][1:]).rstrip(b"\0")
    for length in (2, 10, 40, 63, 64, 70, 150, len(stream) // 2, len(stream) - 10):
        plane.PixelData = encapsulate([stream[:length] + (b"" if syntax == RLELossless else b"\xff\xd9")])
        plane.save_as(path)
        assert code_of(folder) == "E101"
    assert capfd.readouterr() == ("", "")


def test_closed_stderr_stays_closed(tmp_path):
    folder, path = one(TWELVE, tmp_path / "s")
    compressed(path, JPEGLosslessSV1)
    code = f"import xfemnav.imaging.reading.gate as reading; print(reading.read_image({str(folder)!r}).values.sum())"
    done = subprocess.run(f"exec 2>&-; {sys.executable} -c {shlex.quote(code)}", shell=True, capture_output=True,
                          text=True, check=True)
    assert float(done.stdout) == TWELVE.sum()


@pytest.mark.parametrize("syntax, where", [(JPEGLosslessSV1, b"\xff\xc3\0\x0b\x10"), (JPEG2000Lossless, b"\xff\x51")])
def test_a_stream_that_claims_another_size_than_the_header_is_not_decoded(tmp_path, syntax, where):
    """60000 x 60000: a decoder would make room for them."""
    folder, path = one(TWELVE, tmp_path / "s")
    compressed(path, syntax)
    content = path.read_bytes()
    place = content.index(where) + (5 if syntax == JPEGLosslessSV1 else 6)
    size = struct.pack(">2H" if syntax == JPEGLosslessSV1 else ">2I", 60000, 60000)
    path.write_bytes(content[:place] + size + content[place + len(size) :])
    with pytest.raises(XfemnavError, match=r"E101 .*60000 x 60000 pixels of 16 bits in the stream, 24 x 20"):
        read_image(folder)


def test_runs_without_end_are_cut_at_the_pixels_of_the_header(tmp_path):
    folder, path = one(TWELVE, tmp_path / "s")
    compressed(path, RLELossless)
    plane = pydicom.dcmread(path)
    segment = b"\x81\x07" * 500_000  # 64 MB each
    plane.PixelData = encapsulate([struct.pack("<16I", 2, 64, 64 + len(segment), *[0] * 13) + 2 * segment])
    plane.save_as(path)
    tracemalloc.start()
    try:
        assert (read_image(folder).values == 0x0707).all()
        assert tracemalloc.get_traced_memory()[1] < 0.02e9
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, RLELossless])
def test_pixels_that_lie_in_the_wrong_form(tmp_path, syntax):
    """Native ones in fragments, compressed ones without."""
    folder, path = one(TWELVE, tmp_path / "s")
    compressed(path, RLELossless)
    plane = pydicom.dcmread(path)
    if syntax == RLELossless:
        plane["PixelData"].is_undefined_length = False
    content = path.read_bytes()
    if syntax == ExplicitVRLittleEndian:
        content = content.replace(RLELossless.encode() + b"\0", b"1.2.840.10008.1.2.1\0"[:20].ljust(20, b"\0"))
    else:
        place = content.index(struct.pack("<HH2sHI", 0x7FE0, 0x10, b"OB", 0, 0xFFFFFFFF))
        content = content[:place + 8] + struct.pack("<I", len(content) - place - 12) + content[place + 12:]
    path.write_bytes(content)
    assert code_of(folder) == "E105"
