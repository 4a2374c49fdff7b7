"""DICOM that was refused or read wrongly, and a full disk under a transform."""

import numpy as np
import pydicom
from pydicom.encaps import encapsulate, generate_fragments
from pydicom.uid import DeflatedExplicitVRLittleEndian, JPEGLosslessSV1, RLELossless
from rows import Row

from tests.images import image_of
from tests.motions import GRID, slice_in
from tests.test_dicom import write_series
from tests.test_dicom_bounds import BOMBS, deflated
from tests.test_dicom_kinds import AFFINE, TWELVE, by_itk, compressed, enhanced, one
from tests.test_transform import room_for
from xfemnav.errors import XfemnavError
from xfemnav.imaging.carrying.transform import write_transform
from xfemnav.imaging.carrying.vectors import write_nrrd
from xfemnav.imaging.reading.gate import read_image
from xfemnav.pipeline.keeping.disk import writing

VOLUME = image_of(TWELVE[:, :, :1] + np.arange(4), AFFINE)


def refusal(read, *arguments, **options) -> tuple[str, str]:
    """Message and code of the error that must come."""
    try:
        read(*arguments, **options)
    except XfemnavError as error:
        assert "damaged" not in error.message
        return error.message, error.code
    raise AssertionError("it was not refused")


def black_is_largest(folder):
    found = []
    for syntax in (None, RLELossless, JPEGLosslessSV1):
        series, path = one(TWELVE, folder / f"s{syntax}", PhotometricInterpretation="MONOCHROME1", BitsStored=12,
                           HighBit=11)
        if syntax:
            compressed(path, syntax)
        found.append(read_image(series).values)
        np.testing.assert_array_equal(found[-1], 4095 - TWELVE)
        np.testing.assert_array_equal(found[-1], by_itk(path))
    return "4095 - stored, native = RLE = JPEG = ITK", ""


def black_is_largest_and_signed(folder):
    """ITK refuses it."""
    series, path = one(TWELVE - 2048, folder / "s", "i2", PhotometricInterpretation="MONOCHROME1", BitsStored=12,
                       HighBit=11)
    native = read_image(series).values
    compressed(path, RLELossless)
    np.testing.assert_array_equal(native, 2047 - TWELVE)
    np.testing.assert_array_equal(read_image(series).values, native)
    return "-1 - stored, native = RLE", ""


def inflated(folder):
    series = write_series(VOLUME, folder / "s", DeflatedExplicitVRLittleEndian)
    np.testing.assert_array_equal(read_image(series).values, VOLUME.values)
    return "read, as the same files that are not deflated", ""


def bombed(folder):
    series, path = one(TWELVE, folder / "s", syntax=DeflatedExplicitVRLittleEndian)
    deflated(path, BOMBS["a private element"])
    text, code = refusal(read_image, series, max_memory_gb=0.02)
    assert code == "E102"
    return text[:60], code


def padded(folder):
    series, path = one(TWELVE, folder / "s")
    plane = pydicom.dcmread(path)
    plane.PixelData += bytes(128)
    plane.save_as(path)
    np.testing.assert_array_equal(read_image(series).values, TWELVE)
    return "read, the padding left out", ""


def padded_stream(folder):
    series, path = one(TWELVE, folder / "s")
    compressed(path, JPEGLosslessSV1)
    plane = pydicom.dcmread(path)
    stream = b"".join([*generate_fragments(plane.PixelData)][1:]).rstrip(b"\0")
    plane.PixelData = encapsulate([stream + b"\xff" * (1 + len(stream) % 2)])
    plane.save_as(path)
    np.testing.assert_array_equal(read_image(series).values, TWELVE)
    return "read", ""


def nameless(folder):
    series = write_series(VOLUME, folder / "s", change=lambda k, plane: delattr(plane, "SeriesInstanceUID"))
    np.testing.assert_array_equal(read_image(series).values, VOLUME.values)
    return f"read, {VOLUME.values.shape[2]} slices", ""


def mosaic(folder):
    text, code = refusal(read_image, write_series(VOLUME, folder / "s", ImageType=["ORIGINAL", "PRIMARY", "MOSAIC"]))
    assert "mosaic" in text and "dcm2niix" in text and code == "E106"
    return text[:60], code


def multiframe(folder):
    text, code = refusal(read_image, write_series(VOLUME, folder / "s", change=enhanced))
    assert "multi-frame DICOM file (Enhanced MR Image Storage" in text and "dcm2niix" in text and code == "E106"
    return text[:70], code


def full_disk(folder):
    slice, field, codes = slice_in(), np.ones((*GRID.shape, 2)), []
    for write in (write_transform, lambda *stated: write_nrrd(*stated, "modeling")):
        write(folder / "whole", slice, field)
        whole = (folder / "whole").stat().st_size
        for size in np.linspace(0, whole - 1, 29).astype(int).tolist():
            try:
                with room_for(size), writing(folder, "the transform"):
                    write(folder / "t", slice, field)
            except XfemnavError as error:
                codes.append(error.code)
    assert codes == ["E502"] * 58  # a limit on files is no full disk, which is E501
    return "refused with a code at 29 of 29 sizes, .h5 and .nrrd", "E502"


ROWS = [
    Row("A11", "MONOCHROME1, 12 of 16 bits", "1740 native, 63795 compressed", black_is_largest),
    Row("A11", "MONOCHROME1, signed, 12 of 16 bits", "not inverted; compressed: damaged", black_is_largest_and_signed),
    Row("B", "deflated DICOM", "damaged", inflated),
    Row("B", "deflated DICOM of 60 MB in 60 kB", "damaged", bombed),
    Row("B", "DICOM pixels with 128 bytes of padding", "E102", padded),
    Row("B", "JPEG stream that ends FF D9 FF", "damaged", padded_stream),
    Row("B", "DICOM without SeriesInstanceUID", "damaged", nameless),
    Row("B", "Siemens mosaic", "one slice of tiles", mosaic),
    Row("B", "enhanced multi-frame DICOM", "lacks series or positions", multiframe),
    Row("E2", "full disk under transform.h5 and field.nrrd", "exit 70, SIGSEGV, a cut-off .nrrd", full_disk),
]
