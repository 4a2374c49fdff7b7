"""DICOM files of other kinds than the usual one: what the standard allows is read, as ITK reads it, and the rest is
called by its name."""

import struct
import subprocess
import sys

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.encaps import encapsulate, generate_fragments
from pydicom.uid import (
    CTImageStorage,
    DeflatedExplicitVRLittleEndian,
    EnhancedMRImageStorage,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLosslessSV1,
    RLELossless,
)

from tests.images import affine_of, image_of
from tests.test_dicom import code_of, compress_by_gdcm, set_one, write_series
from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.dicom import _check_fragments
from xfemnav.imaging.reading.gate import read_image

AFFINE = affine_of(np.diag([1.0, 1.0, 3.0]))
RNG = np.random.default_rng(3)
TWELVE = RNG.integers(0, 4096, (24, 20, 1))


def one(values, folder, dtype="u2", **options):
    """A series of one slice; gives its folder and its file."""
    write_series(image_of(values, AFFINE), folder, dtype=dtype, **options)
    return folder, folder / "000.dcm"


def by_itk(path) -> np.ndarray:
    """Values (columns, rows, 1) of a DICOM file as SimpleITK reads it."""
    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    return sitk.GetArrayFromImage(reader.Execute()).transpose(2, 1, 0)


def compressed(path, syntax):
    """Compress the file in place, its stated bits and photometric interpretation kept."""
    plane = pydicom.dcmread(path)
    if syntax == RLELossless:
        plane.compress(RLELossless)
    elif syntax in (JPEGLosslessSV1, JPEG2000Lossless):
        kind = "JPEG" if syntax == JPEGLosslessSV1 else "JPEG2000"
        compress_by_gdcm(plane, path, path.parent.parent / "packed.dcm", kind)
    plane.save_as(path)


# Inverted -------------------------------------------------------------------------------------------------------------

KINDS = {  # values, type, fields; whether ITK reads it right, which refuses or mangles the others
    "16 of 16 bits": (TWELVE * 16 + 5, "u2", {}, True),
    "12 of 16 bits": (TWELVE, "u2", {"BitsStored": 12, "HighBit": 11}, True),
    "8 of 8 bits": (TWELVE % 256, "u1", {}, True),
    "signed": (TWELVE - 2048, "i2", {}, True),
    "8 bits signed": (TWELVE % 256 - 128, "i1", {}, True),
    "12 of 16 bits, signed": (TWELVE - 2048, "i2", {"BitsStored": 12, "HighBit": 11}, False),
    "6 of 8 bits": (TWELVE % 64, "u1", {"BitsStored": 6, "HighBit": 5}, False),
    "slope": (TWELVE, "u2", {"BitsStored": 12, "HighBit": 11, "RescaleSlope": 2, "RescaleIntercept": -1000}, True),
    "slope of a half, signed": (TWELVE - 2048, "i2", {"RescaleSlope": 0.5, "RescaleIntercept": 10}, True),
    "slope of 0": (TWELVE, "u2", {"RescaleSlope": 0, "RescaleIntercept": 7}, True),
    "CT": (TWELVE, "u2", {"RescaleSlope": 1, "RescaleIntercept": -1024, "SOPClassUID": CTImageStorage}, True),
    "padding value": (TWELVE, "u2", {"PixelPaddingValue": 0, "PixelPaddingRangeLimit": 100}, True),
    "presentation": (TWELVE, "u2", {"PresentationLUTShape": "INVERSE"}, True),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("colours", ["MONOCHROME1", "MONOCHROME2"])
@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, RLELossless, JPEGLosslessSV1, JPEG2000Lossless])
def test_inverted_pixels_are_one_answer_and_that_of_itk(tmp_path, kind, colours, syntax):
    """MONOCHROME1: the largest value of the stored bits minus the stored one, before slope and intercept."""
    values, dtype, fields, itk_can = KINDS[kind]
    stored = fields.get("BitsStored", 8 * np.dtype(dtype).itemsize)
    folder, path = one(values, tmp_path / "s", dtype, PhotometricInterpretation=colours, **fields)
    if syntax != ExplicitVRLittleEndian:
        compressed(path, syntax)
    low, high = (-(1 << stored - 1), (1 << stored - 1) - 1) if dtype[0] == "i" else (0, (1 << stored) - 1)
    truth = low + high - values if colours == "MONOCHROME1" else values
    truth = truth * (fields.get("RescaleSlope", 1) or 1) + fields.get("RescaleIntercept", 0)
    found = read_image(folder).values
    np.testing.assert_array_equal(found, truth)
    precise = syntax != JPEG2000Lossless or stored % 8 == 0  # GDCM takes the bits of its own stream, 16
    if itk_can and (precise or colours == "MONOCHROME2"):
        np.testing.assert_array_equal(found, by_itk(path))


# What the standard allows ---------------------------------------------------------------------------------------------

@pytest.mark.parametrize("rows, columns", [(24, 20), (23, 21)])
@pytest.mark.parametrize("padding", [b"\0", b"\0" * 3, b"\0" * 128, b"\xff" * 700, b" " * 512, bytes(range(30))])
def test_padding_behind_the_pixels(tmp_path, padding, rows, columns):
    """PS3.5 8.1.1. As the pixels of a slice with too few rows in its header: E102, in test_dicom."""
    values = TWELVE[:columns, :rows] if columns <= 20 else RNG.integers(0, 255, (columns, rows, 1))
    folder, path = one(values, tmp_path / "s")
    plane = pydicom.dcmread(path)
    plane.PixelData += padding + b"\0" * (len(padding) % 2)
    plane.save_as(path)
    np.testing.assert_array_equal(read_image(folder).values, values)
    np.testing.assert_array_equal(by_itk(path), values)
    content = path.read_bytes()
    path.write_bytes(content[:-2])
    assert code_of(folder) == "E101"


@pytest.mark.parametrize("excess", [bytes(range(200)), bytes(24 * 20 * 2 + 1026)])
def test_what_is_no_padding(tmp_path, excess):
    folder, path = one(TWELVE, tmp_path / "s")
    plane = pydicom.dcmread(path)
    plane.PixelData += excess
    plane.save_as(path)
    assert code_of(folder) == "E102"


@pytest.mark.parametrize("colours", ["MONOCHROME1", "MONOCHROME2"])
def test_a_deflated_series_is_the_same_volume(tmp_path, colours):
    values = RNG.integers(-300, 300, (24, 20, 4))
    plain, deflated = (write_series(image_of(values, AFFINE), tmp_path / syntax, syntax,
                                    PhotometricInterpretation=colours)
                       for syntax in (ExplicitVRLittleEndian, DeflatedExplicitVRLittleEndian))
    assert read_image(plain).digest == read_image(deflated).digest
    path = deflated / "002.dcm"
    content = path.read_bytes()
    path.write_bytes(content + bytes(30))  # zeros pad the stream
    assert read_image(plain).digest == read_image(deflated).digest
    whole = len(content) - (content[-1] == 0)  # the last one pads it to even length
    for length in (*range(400, whole, 64), whole - 1):
        path.write_bytes(content[:length])
        assert code_of(deflated) == "E101"


@pytest.mark.parametrize("end", [b"\xff\xd9", b"\xff\xd9\xff", b"\xff\xd9\xff\xff", b"\xff\xd9\0", b"\xff\xd9\0\0\0",
                                 b"\xff|\xd9\0", b"\xff\xd9|\0\0"])
def test_what_may_follow_the_end_of_a_jpeg_stream(end):
    """| is the border of two fragments."""
    stream = b"\xff\xd8" + bytes(20) + end
    parts = [b"", *stream.split(b"|")]
    data = b"".join(b"\xfe\xff\x00\xe0" + struct.pack("<I", len(part)) + part for part in parts)
    assert _check_fragments(data + b"\xfe\xff\xdd\xe0" + bytes(4), 0, JPEGLosslessSV1, "x") == stream.replace(b"|", b"")


@pytest.mark.parametrize("syntax", [JPEGLosslessSV1, JPEG2000Lossless])
@pytest.mark.parametrize("padding", [b"\xff", b"\0\0", b"\xff\xff\xff"])
def test_a_padded_stream_is_decoded(tmp_path, padding, syntax):
    folder, path = one(TWELVE, tmp_path / "s")
    compressed(path, syntax)
    plane = pydicom.dcmread(path)
    stream = b"".join([*generate_fragments(plane.PixelData)][1:]).rstrip(b"\0")
    plane.PixelData = encapsulate([stream + padding])
    plane.save_as(path)
    np.testing.assert_array_equal(read_image(folder).values, TWELVE)


def test_a_series_without_its_identifier(tmp_path):
    volume = image_of(RNG.integers(0, 900, (9, 8, 5)), AFFINE)
    folder = write_series(volume, tmp_path / "s", change=lambda k, plane: delattr(plane, "SeriesInstanceUID"))
    np.testing.assert_array_equal(read_image(folder).values, volume.values)
    write_series(volume, folder, name="b{}.dcm", SeriesDescription="flair",
                 change=lambda k, plane: delattr(plane, "SeriesInstanceUID"))
    with pytest.raises(XfemnavError, match=r"E123 .*t1 mprage: 5 files; flair: 5 files"):
        read_image(folder)
    write_series(volume, folder, name="b{}.dcm", SeriesNumber=7,
                 change=lambda k, plane: delattr(plane, "SeriesInstanceUID"))
    assert code_of(folder) == "E123"


OPTIONAL = ("SOPInstanceUID", "SeriesDescription", "SeriesInstanceUID", "Modality", "SliceThickness",
            "SamplesPerPixel", "HighBit", "PhotometricInterpretation", "ReferencedStudySequence", "SOPClassUID")


@pytest.mark.parametrize("syntax", [ImplicitVRLittleEndian, ExplicitVRLittleEndian])
@pytest.mark.parametrize("how", ["absent", "empty"])
def test_attributes_that_an_image_does_not_need(tmp_path, how, syntax):
    def bare(k, plane):
        for field in OPTIONAL:
            if how == "absent" or field in ("SOPClassUID", "SOPInstanceUID"):
                delattr(plane, field)
            else:
                plane[field].value = None

    volume = image_of(RNG.integers(-9, 900, (9, 8, 5)), AFFINE)
    folder = write_series(volume, tmp_path / "s", syntax, change=bare)
    np.testing.assert_array_equal(read_image(folder).values, volume.values)


@pytest.mark.parametrize("field", ["Rows", "Columns", "BitsAllocated", "BitsStored", "PixelRepresentation"])
def test_attributes_that_it_needs_are_named(tmp_path, field):
    folder, _ = one(TWELVE, tmp_path / "s", change=lambda k, plane: delattr(plane, field))
    with pytest.raises(XfemnavError, match=f"E105 000.dcm lacks {field},") as failure:
        read_image(folder)
    assert "damaged" not in str(failure.value)


# What is not read, by its name ----------------------------------------------------------------------------------------

def enhanced(k, plane):
    plane.SOPClassUID = plane.file_meta.MediaStorageSOPClassUID = EnhancedMRImageStorage
    plane.NumberOfFrames = 1
    plane.PerFrameFunctionalGroupsSequence = [pydicom.Dataset()]


def float_pixels(k, plane):
    del plane.PixelData
    plane.FloatPixelData = bytes(plane.Rows * plane.Columns * 4)


@pytest.mark.parametrize("change, code, words", [
    (set_one(ImageType=["ORIGINAL", "PRIMARY", "M", "MOSAIC"]), "E106", "mosaic.*dcm2niix"),
    (set_one(NumberOfFrames=40), "E106", r"multi-frame DICOM file \(MR Image Storage .*40 frames\).*dcm2niix"),
    (enhanced, "E106", "multi-frame DICOM file .Enhanced MR Image Storage .*dcm2niix"),
    (float_pixels, "E106", "floating-point pixels"),
    (set_one(BitsAllocated=1, BitsStored=1, HighBit=0), "E106", "pixels of 1 bits")])
def test_kinds_that_are_not_read_are_called_by_their_name(tmp_path, change, code, words):
    with pytest.raises(XfemnavError, match=f"{code} 00..dcm .*{words}") as failure:
        read_image(write_series(image_of(RNG.integers(0, 9, (9, 8, 3)), AFFINE), tmp_path / "s", change=change))
    assert "damaged" not in str(failure.value)


@pytest.mark.parametrize("syntax, words", [
    ("1.2.840.10008.1.2.1.98", "Encapsulated Uncompressed"), ("1.2.3.4", "syntax 1.2.3.4,"),
    ("1.2.840.10008.1.2.4.201", r"High-Throughput JPEG 2000 .*\(1.2.840.10008.1.2.4.201\)")])
def test_a_transfer_syntax_that_is_not_read_is_named(tmp_path, syntax, words):
    folder, path = one(TWELVE, tmp_path / "s")
    plane = pydicom.dcmread(path)
    plane.file_meta.TransferSyntaxUID = syntax
    plane.PixelData = encapsulate([bytes(plane.PixelData)])
    plane["PixelData"].VR, plane["PixelData"].is_undefined_length = "OB", True
    plane.save_as(path, implicit_vr=False, little_endian=True)
    with pytest.raises(XfemnavError, match=f"E106 .*{words}"):
        read_image(folder)


# pydicom --------------------------------------------------------------------------------------------------------------

@pytest.mark.filterwarnings("error")
def test_what_pydicom_warns_of_reaches_nobody(tmp_path, capfd):
    """An explicit file that says that it is implicit, a time that is none, a word in a place of numbers."""
    folder, path = one(TWELVE, tmp_path / "s")
    content = path.read_bytes()
    old = ExplicitVRLittleEndian.encode() + b"\0"
    content = content.replace(old, ImplicitVRLittleEndian.encode().ljust(len(old), b"\0"))
    path.write_bytes(content.replace(b"1.2.840.10008.5.1.4.1.1.4\0", b"1.2.840.10008.5.1.4.1.1.7 "))
    np.testing.assert_array_equal(read_image(folder).values, TWELVE)
    assert capfd.readouterr() == ("", "")


def test_reading_nifti_loads_neither_pydicom_nor_h5py(tmp_path):
    """Nor does nibabel, which would if it could; what somebody else has loaded stays."""
    path = tmp_path / "x.nii.gz"
    nibabel.save(nibabel.Nifti1Image(np.ones((4, 4, 1)), np.eye(4)), path)
    read = ("import sys, xfemnav.imaging.reading.gate as reading, xfemnav.imaging.carrying.transform; "
            f"reading.read_image({str(path)!r}); print(*({{'pydicom', 'h5py'}} & set(sys.modules)))")
    for before, loaded in (("", ""), ("import pydicom; ", "pydicom")):
        done = subprocess.run([sys.executable, "-c", before + read], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == loaded
