"""A folder of DICOM files: one series is one volume in its place; whatever is no whole, even stack is refused."""

import shutil
import struct

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.uid import (
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLosslessSV1,
    MRImageStorage,
    RLELossless,
    generate_uid,
)

from tests.images import ORDERS, image_of, oblique_volume, stored, values_at
from xfemnav.errors import FAULTS, XfemnavError, XfemnavWarning
from xfemnav.imaging.reading.dicom import _check_fragments
from xfemnav.imaging.reading.gate import content_digest, read_components, read_image

FLIP = np.diag([-1.0, -1, 1, 1])
SERIES = generate_uid()


def write_series(image, folder, syntax=ExplicitVRLittleEndian, dtype="i2", name="{:03d}.dcm", slope=1, inter=0,
                 change=None, **fields):
    """`image` as a DICOM series, slices in the file's k order; `change(k, dataset)` edits each data set."""
    folder.mkdir(exist_ok=True)
    lps, sizes = FLIP @ image.affine, np.linalg.norm(image.affine[:3, :3], axis=0)
    for k in range(image.values.shape[2]):
        plane = pydicom.Dataset()
        plane.file_meta = pydicom.dataset.FileMetaDataset()
        plane.file_meta.TransferSyntaxUID = syntax
        plane.file_meta.MediaStorageSOPClassUID = plane.SOPClassUID = MRImageStorage
        plane.file_meta.MediaStorageSOPInstanceUID = plane.SOPInstanceUID = generate_uid()
        plane.SeriesInstanceUID, plane.SeriesDescription, plane.Modality = SERIES, "t1 mprage", "MR"
        item = pydicom.Dataset()
        item.ReferencedSOPClassUID = MRImageStorage
        plane.ReferencedStudySequence = pydicom.Sequence([item])
        plane["ReferencedStudySequence"].is_undefined_length = True
        plane.ImagePositionPatient = list(lps[:3] @ [0, 0, k, 1])
        plane.ImageOrientationPatient = list((lps[:3, :2] / sizes[:2]).T.ravel())
        plane.PixelSpacing, plane.SliceThickness = [sizes[1], sizes[0]], sizes[2]
        plane.Columns, plane.Rows = image.values.shape[:2]
        plane.SamplesPerPixel, plane.PhotometricInterpretation = 1, "MONOCHROME2"
        bits = 8 * np.dtype(dtype).itemsize
        plane.BitsAllocated = plane.BitsStored = bits
        plane.HighBit, plane.PixelRepresentation = bits - 1, int(dtype[0] == "i")
        if (slope, inter) != (1, 0):
            plane.RescaleSlope, plane.RescaleIntercept = slope, inter
        order = ">" if syntax == ExplicitVRBigEndian else "<"
        plane.PixelData = image.values[:, :, k].T.astype(order + dtype).tobytes()
        plane["PixelData"].VR = "OW"
        for field, value in fields.items():
            setattr(plane, field, value)
        if change:
            change(k, plane)
        plane.save_as(folder / name.format(k), enforce_file_format=True)
    return folder


@pytest.fixture
def volume():
    return oblique_volume()[0]


def code_of(folder, read=read_image, **options) -> str:
    with pytest.raises(XfemnavError) as failure:
        read(folder, **options)
    assert "\n" not in str(failure.value)
    return failure.value.code


def itk_volume(folder):
    """The folder as SimpleITK reads it: values (ni, nj, nk) and affine (4, 4) RAS."""
    image = sitk.ReadImage(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder)))
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return sitk.GetArrayFromImage(image).transpose(2, 1, 0), FLIP @ affine


# What is read ---------------------------------------------------------------------------------------------------------

def test_every_storage_order_gives_the_same_values_at_the_same_points(tmp_path):
    volume, points = oblique_volume()
    truth = values_at(volume, points)
    for order, flips in ORDERS:
        folder = write_series(stored(volume, order, flips), tmp_path / "series")
        image = read_image(folder)
        # decimal strings of 16 characters hold 1e-12; GDCM says the same
        np.testing.assert_allclose(values_at(image, points), truth, atol=1e-6)
        values, affine = itk_volume(folder)
        np.testing.assert_allclose(image.affine, affine, atol=1e-4)  # ITK rounds the direction of the normal
        np.testing.assert_array_equal(image.values, values)
        assert image.frame_code == 1 and image.name == "series"
        shutil.rmtree(folder)


@pytest.mark.parametrize("syntax", [ImplicitVRLittleEndian, ExplicitVRLittleEndian, ExplicitVRBigEndian])
@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "i4"])
def test_native_syntaxes_and_types(tmp_path, volume, syntax, dtype):
    values = abs(volume.values) % 200 if dtype[0] == "u" else volume.values
    folder = write_series(image_of(values, volume.affine), tmp_path / "s", syntax, dtype)
    np.testing.assert_array_equal(in_file_order(folder, volume), values)


def test_slope_and_intercept_are_those_of_each_slice(tmp_path, volume):
    def steeper(k, plane):
        plane.RescaleSlope = 0.5 + k

    folder = write_series(volume, tmp_path / "s", slope=0.5, inter=-30, change=steeper)
    np.testing.assert_allclose(in_file_order(folder, volume), volume.values * (0.5 + np.arange(5)) - 30, atol=1e-9)


def in_file_order(folder, volume):
    """Values as the series was written, whichever way its normal points."""
    image = read_image(folder)
    return image.values if image.affine[:3, 2] @ volume.affine[:3, 2] > 0 else image.values[:, :, ::-1]


def test_only_the_stored_bits_count(tmp_path, volume):
    def overlaid(k, plane):
        stored_bits = volume.values[:, :, k].T.astype("<i2").view("<u2") & 0xFFF
        plane.BitsStored, plane.HighBit = 12, 11
        plane.PixelData = (stored_bits | 0xA000).astype("<u2").tobytes()

    np.testing.assert_array_equal(in_file_order(write_series(volume, tmp_path / "s", change=overlaid), volume),
                                  volume.values)


@pytest.mark.parametrize("syntax", [RLELossless, JPEG2000Lossless, JPEGLosslessSV1])
def test_compressed_syntaxes_are_those_that_gdcm_writes(tmp_path, volume, syntax):
    """RLE is written by pydicom; JPEG by GDCM's own encoder through SimpleITK, slice by slice."""
    values = np.random.default_rng(5).integers(0, 900, (40, 36, 2))
    plain = write_series(image_of(values, volume.affine), tmp_path / "plain", dtype="u2", slope=2, inter=-5)
    packed = tmp_path / "packed"
    packed.mkdir()
    for path in sorted(plain.iterdir()):
        plane = pydicom.dcmread(path)
        if syntax == RLELossless:
            plane.compress(RLELossless)
        else:
            compress_by_gdcm(plane, path, tmp_path / "one.dcm", "JPEG2000" if syntax == JPEG2000Lossless else "JPEG")
        plane.save_as(packed / path.name)
        assert pydicom.dcmread(packed / path.name).file_meta.TransferSyntaxUID == syntax
    np.testing.assert_allclose(read_image(packed).values, read_image(plain).values, atol=1e-9)
    content = (packed / "001.dcm").read_bytes()
    for length in (*range(64, len(content), 64), len(content) - 1):
        (packed / "001.dcm").write_bytes(content[:length])
        assert code_of(packed) in {"E101", "E105"}


def compress_by_gdcm(plane, path, target, kind):
    """Put the pixels of `plane` as GDCM compresses them."""
    writer = sitk.ImageFileWriter()
    writer.SetFileName(str(target))
    writer.UseCompressionOn()
    writer.SetCompressor(kind)
    image = sitk.GetImageFromArray(plane.pixel_array[None])
    writer.Execute(image)
    other = pydicom.dcmread(target)
    plane.PixelData, plane.file_meta.TransferSyntaxUID = other.PixelData, other.file_meta.TransferSyntaxUID
    plane["PixelData"].VR, plane["PixelData"].is_undefined_length = "OB", True


def test_a_single_slice_has_its_thickness(tmp_path, volume):
    one = image_of(volume.values[:, :, :1], volume.affine)
    image = read_image(write_series(one, tmp_path / "s"))
    np.testing.assert_allclose(abs(image.affine), abs(one.affine), atol=1e-9)
    np.testing.assert_allclose(read_image(tmp_path / "s", spacing=(1, 2, 3)).affine, np.diag([1, 2, 3, 1]))
    spaced = read_image(write_series(one, tmp_path / "gap", SpacingBetweenSlices=7.5))  # with what lies between
    np.testing.assert_allclose(np.linalg.norm(spaced.affine[:3, 2]), 7.5)


def test_the_order_of_names_does_not_count(tmp_path, volume):
    image = read_image(write_series(volume, tmp_path / "s"))
    for k, name in enumerate(["z", "b", "q", "a", "m"]):
        (tmp_path / "s" / f"{k:03d}.dcm").rename(tmp_path / "s" / name)
    again = read_image(tmp_path / "s")
    assert again.digest == image.digest and again.file_digest != image.file_digest


def test_digest_of_the_folder(tmp_path, volume):
    folder = write_series(volume, tmp_path / "s")
    assert read_image(folder).file_digest == content_digest(folder) == read_components(folder).file_digest
    first = content_digest(folder)
    data = bytearray((folder / "002.dcm").read_bytes())
    data[-1] ^= 1
    (folder / "002.dcm").write_bytes(data)
    assert content_digest(folder) != first
    np.testing.assert_array_equal(read_components(folder).values[..., 0], read_image(folder).values)


# What is refused ------------------------------------------------------------------------------------------------------

def test_folders_without_images(tmp_path, volume):
    assert code_of(tmp_path) == "E106"
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "README").write_text("hello")
    write_series(volume, tmp_path / "inner")
    assert code_of(tmp_path) == "E106"
    assert code_of(tmp_path / "inner" / "000.dcm") == "E106"  # one file of a series


def test_several_series_are_listed(tmp_path, volume):
    write_series(volume, tmp_path / "s")
    write_series(volume, tmp_path / "s", name="b{:03d}.dcm", SeriesInstanceUID=generate_uid(),
                 SeriesDescription="flair")
    with pytest.raises(XfemnavError, match=r"E123 .*t1 mprage: 5 files; flair: 5 files"):
        read_image(tmp_path / "s")


@pytest.mark.parametrize("k", [1, 2, 3])
def test_a_missing_slice(tmp_path, volume, k):
    (write_series(volume, tmp_path / "s") / f"{k:03d}.dcm").unlink()
    with pytest.raises(XfemnavError, match=r"E124 .* gap of 5 mm after slice \d of 4"):
        read_image(tmp_path / "s")


def test_doubled_slices(tmp_path, volume):
    folder = write_series(volume, tmp_path / "s")
    shutil.copy(folder / "001.dcm", folder / "copy.dcm")
    assert code_of(folder) == "E124"
    plane = pydicom.dcmread(folder / "copy.dcm")
    plane.SOPInstanceUID = generate_uid()  # another image at the same place
    plane.save_as(folder / "copy.dcm")
    assert code_of(folder) == "E124"


def test_a_series_twice_over(tmp_path, volume):
    folder = write_series(volume, tmp_path / "s")
    for path in list(folder.iterdir()):
        shutil.copy(path, folder / f"copy{path.name}")
    with pytest.raises(XfemnavError, match=r"E124 .* holds one slice twice \(000.dcm, copy000.dcm\)"):
        read_image(folder)


def test_several_images_at_each_position(tmp_path, volume):
    write_series(volume, tmp_path / "s")
    write_series(volume, tmp_path / "s", name="b{:03d}.dcm")
    with pytest.raises(XfemnavError, match=r"E121 .* 2 images at each of 5 positions"):
        read_image(tmp_path / "s")


def moved(along, sideways):
    def change(k, plane):
        if k == 2:
            turn = np.reshape(plane.ImageOrientationPatient, (2, 3)).astype(float)
            shift = along * np.cross(*turn) + sideways * turn[0]
            plane.ImagePositionPatient = list(np.array(plane.ImagePositionPatient, float) + shift)
    return change


def test_uneven_slices(tmp_path, volume):
    """Slices are 2.5 mm apart; up to 2 % of it is rounding."""
    for along, sideways in ((0.2, 0), (0, 0.2), (-1, 0)):
        assert code_of(write_series(volume, tmp_path / "s", change=moved(along, sideways))) == "E124"
    read_image(write_series(volume, tmp_path / "s", change=moved(0.01, 0.01)))


def set_one(**fields):
    def change(k, plane):
        if k == 2:
            for field, value in fields.items():
                if value is None:
                    delattr(plane, field)
                else:
                    setattr(plane, field, value)
    return change


@pytest.mark.parametrize("fields, code", [
    ({"Rows": 7, "Columns": 6}, "E124"), ({"ImageOrientationPatient": [1, 0, 0, 0, 1, 0]}, "E124"),
    ({"ImagePositionPatient": None}, "E124"), ({"ImageOrientationPatient": None}, "E124"),
    ({"PixelSpacing": [2, 2]}, "E110"), ({"PixelSpacing": None}, "E110"), ({"PixelSpacing": [0, 0]}, "E110"),
    ({"Rows": 60}, "E101"), ({"Rows": 3}, "E102"), ({"Rows": 0}, "E105"), ({"PixelData": None}, "E101"),
    ({"BitsAllocated": 12}, "E105"), ({"BitsStored": 17}, "E105"), ({"BitsStored": 0}, "E105"),
    ({"PixelRepresentation": 2}, "E105"), ({"NumberOfFrames": 2}, "E106"), ({"SamplesPerPixel": 3}, "E122"),
    ({"PhotometricInterpretation": "RGB"}, "E122"), ({"PhotometricInterpretation": "PALETTE COLOR"}, "E122")])
def test_slices_that_do_not_fit(tmp_path, volume, fields, code):
    assert code_of(write_series(volume, tmp_path / "s", change=set_one(**fields))) == code


@pytest.mark.parametrize("turn", [[0, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0], [1, 0, 0, 0, 2, 0]])
def test_unusable_orientation(tmp_path, volume, turn):
    one = image_of(volume.values[:, :, :1], volume.affine)
    assert code_of(write_series(one, tmp_path / "s", ImageOrientationPatient=turn)) == "E110"


def test_non_finite_scale(tmp_path, volume):
    def text(k, plane):
        plane.add_new(0x00281053, "LO", "nan")

    assert code_of(write_series(volume, tmp_path / "s", change=text)) == "E105"


def test_no_stated_position_warns(tmp_path, volume):
    one = image_of(volume.values[:, :, :1], volume.affine)
    folder = write_series(one, tmp_path / "s", change=lambda k, plane: delattr(plane, "ImagePositionPatient"))
    with pytest.warns(XfemnavWarning, match="W112"):
        assert read_image(folder).frame_code == 0


def test_foreign_files_are_skipped_with_a_warning_or_refused(tmp_path, volume):
    folder = write_series(volume, tmp_path / "s")
    (folder / "notes.txt").write_text("hello")
    (folder / ".hidden").write_text("hello")
    (folder / "inner").mkdir()
    with pytest.warns(XfemnavWarning, match=r"W113 1 files .*notes\.txt"):
        assert read_image(folder).values.shape == volume.values.shape
    for name in ("000005.dcm", "IM0005", "1.2.840.5"):  # could be the slice of an end
        for text in ("hello", ""):
            (folder / name).write_text(text)
            assert code_of(folder) == "E101"
        (folder / name).unlink()


def test_dicom_files_without_pixels_are_skipped(tmp_path, volume):
    folder = write_series(volume, tmp_path / "s")
    report = pydicom.dcmread(folder / "000.dcm")
    del report.PixelData
    report.SOPClassUID = report.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.88.11"
    report.save_as(folder / "report.dcm")
    with pytest.warns(XfemnavWarning, match=r"W113 .*report\.dcm"):
        assert read_image(folder).values.shape == volume.values.shape


def test_memory_limit(tmp_path, volume):
    assert code_of(write_series(volume, tmp_path / "s"), max_memory_gb=1e-6) == "E102"
    assert code_of(tmp_path / "s", max_memory_gb=2e-6) == "E102"  # one file of 1.2 kB fits, five do not


@pytest.mark.parametrize("end, code", [(b"\xff\xd9", None), (b"\xff\xd9\0", None), (b"", "E101")])
def test_a_jpeg_stream_has_its_end_mark(end, code):
    """Fragments that say the right lengths around a stream that was cut off."""
    stream = b"\xff\xd8" + bytes(20) + end
    items = b"".join(b"\xfe\xff\x00\xe0" + struct.pack("<I", len(part)) + part for part in (b"", stream))
    data = items + b"\xfe\xff\xdd\xe0" + bytes(4)
    if code is None:
        _check_fragments(data, 0, JPEGLosslessSV1, "x.dcm")
    else:
        with pytest.raises(XfemnavError, match=code):
            _check_fragments(data, 0, JPEGLosslessSV1, "x.dcm")


def test_unknown_sequences_are_implicit_inside(tmp_path, volume):
    """PS3.5 6.2.2: a sequence whose VR nobody knew, of undefined length, in an explicit file."""
    folder = write_series(volume, tmp_path / "s")
    whole = read_image(folder).digest
    inner = struct.pack("<HHI", 0x0009, 0x1001, 4) + b"\x0a\0\0\0"  # implicit: tag, length, value
    item = struct.pack("<HHI", 0xFFFE, 0xE000, 0xFFFFFFFF) + inner + struct.pack("<HHI", 0xFFFE, 0xE00D, 0)
    unknown = struct.pack("<HH2sHI", 0x0009, 0x1010, b"UN", 0, 0xFFFFFFFF) + item
    unknown += struct.pack("<HHI", 0xFFFE, 0xE0DD, 0)
    for path in folder.iterdir():
        content = path.read_bytes()
        place = content.index(struct.pack("<HH", 0x0018, 0x0050) + b"DS")
        path.write_bytes(content[:place] + unknown + content[place:])
    assert read_image(folder).digest == whole


# Damaged files --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("syntax", [ImplicitVRLittleEndian, ExplicitVRLittleEndian, ExplicitVRBigEndian])
@pytest.mark.parametrize("name", ["{:03d}.dcm", "IM{:04d}"])
def test_every_truncation_of_a_slice_is_refused(tmp_path, volume, syntax, name):
    folder = write_series(volume, tmp_path / "s", syntax, name=name)
    for k in (0, 2):
        path = folder / name.format(k)
        content = path.read_bytes()
        for length in [*range(64, len(content), 64), len(content) - 1]:
            path.write_bytes(content[:length])
            assert code_of(folder) in {"E101", "E105"}
        path.write_bytes(content)


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_any_flipped_byte_gives_an_image_or_a_code(tmp_path, volume):
    folder = write_series(volume, tmp_path / "s")
    content = (folder / "002.dcm").read_bytes()
    for place in range(128, len(content), 3):
        broken = bytearray(content)
        broken[place] ^= 1 << place % 8
        (folder / "002.dcm").write_bytes(broken)
        try:
            image = read_image(folder)
        except XfemnavError as error:
            assert error.code in FAULTS
        else:
            assert np.isfinite(image.values).all()
