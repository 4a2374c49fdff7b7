"""The input gate: damaged, lying and hostile files get a coded error, never wrong voxels, a hang or much memory."""

import gzip
import os
import signal
import tracemalloc
from dataclasses import replace

import nibabel
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from xfemnav.errors import FAULTS, XfemnavError, XfemnavWarning
from xfemnav.imaging.frames.slices import take_slice, to_nifti
from xfemnav.imaging.reading.gate import content_digest, read_components, read_image

AFFINE = np.array([[0.9, 0, 0, -40], [0, 1.1, 0, -50], [0, 0, 2.0, 7], [0, 0, 0, 1]])


def volume(shape=(5, 4, 3), dtype=np.int16):
    return np.random.default_rng(0).integers(0, 100, shape).astype(dtype)


def nifti(values=None, affine=AFFINE, kind=nibabel.Nifti1Image, **fields) -> bytes:
    """Bytes of a NIfTI file whose header says `fields`, whatever is in it."""
    values = volume() if values is None else values
    data = bytearray(kind(values, affine, dtype=values.dtype).to_bytes())
    header = kind.header_class(bytes(data[: kind.header_class.sizeof_hdr]), check=False)
    for name, value in fields.items():
        header[name] = value
    data[: len(header.binaryblock)] = header.binaryblock
    return bytes(data)


def written(folder, content: bytes, name="image.nii"):
    path = folder / name
    path.write_bytes(content)
    return path


def code_of(path, **options) -> str:
    with pytest.raises(XfemnavError) as failure:
        read_image(path, **options)
    assert "\n" not in str(failure.value)
    return failure.value.code


@pytest.fixture
def alarm():
    """A read that hangs fails the test after 5 s."""
    signal.alarm(5)
    yield
    signal.alarm(0)


# What is read ---------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"])
@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
def test_voxels_and_affine_are_those_of_the_file(tmp_path, dtype, kind):
    image = read_image(written(tmp_path, gzip.compress(nifti(volume(dtype=dtype), kind=kind)), "image.nii.gz"))
    np.testing.assert_array_equal(image.values, volume())
    np.testing.assert_allclose(image.affine, AFFINE, atol=1e-6)  # NIfTI holds the affine in float32
    assert image.values.dtype == np.float64 and not image.values.flags.writeable and image.dtype == np.dtype(dtype).name


def test_digest_is_of_the_content_and_not_of_the_file(tmp_path):
    plain = nifti()
    same = {"a.nii": plain, "b.nii.gz": gzip.compress(plain, 1), "c.nii.gz": gzip.compress(plain, 9, mtime=5),
            "d.nii": nifti(kind=nibabel.Nifti2Image), "e.nii": nifti(volume(dtype=np.float32)),
            "f.nii": nibabel.Nifti1Image(volume(), AFFINE, nibabel.Nifti1Header(endianness=">")).to_bytes()}
    images = [read_image(written(tmp_path, content, name)) for name, content in same.items()]
    # NIfTI-2 holds the affine in float64, so its digits differ from the float32 ones.
    assert len({image.digest for name, image in zip(same, images) if name != "d.nii"}) == 1
    assert len({image.file_digest for image in images}) == len(same)
    assert images[0].file_digest == content_digest(tmp_path / "a.nii")
    coded = replace(images[0], frame_code=4)  # the outputs carry the code
    assert coded.digest != images[0].digest
    changed = volume()
    changed[1, 2, 1] += 1
    moved = AFFINE + np.eye(4)[:, [3, 0, 1, 2]] * 0.5
    for other in (nifti(changed), nifti(affine=moved), nifti(volume().reshape(4, 5, 3))):
        assert read_image(written(tmp_path, other, "other.nii")).digest != images[0].digest


def test_scaling_is_applied(tmp_path):
    image = read_image(written(tmp_path, nifti(scl_slope=0.5, scl_inter=-3)))
    np.testing.assert_array_equal(image.values, 0.5 * volume() - 3)
    np.testing.assert_array_equal(read_image(written(tmp_path, nifti(scl_slope=0, scl_inter=9))).values, volume())


@pytest.mark.parametrize("fields", [{"scl_slope": np.nan}, {"scl_slope": np.inf}, {"scl_inter": np.nan}])
def test_scaling_by_nan_is_ignored_with_a_warning(tmp_path, fields):
    with pytest.warns(XfemnavWarning, match="W104"):
        image = read_image(written(tmp_path, nifti(**fields)))
    np.testing.assert_array_equal(image.values, volume())


@pytest.mark.parametrize("unit, mm", [(0, 1), (1, 1000), (2, 1), (3, 0.001), (10, 1)])
def test_positions_are_in_mm_whatever_unit_the_header_uses(tmp_path, unit, mm):
    affine = AFFINE / mm
    affine[3, 3] = 1
    np.testing.assert_allclose(read_image(written(tmp_path, nifti(affine=affine, xyzt_units=unit))).affine, AFFINE,
                               rtol=1e-6)


def test_two_axes_and_trailing_axes_of_length_one_are_a_volume(tmp_path):
    assert read_image(written(tmp_path, nifti(volume((5, 4))))).values.shape == (5, 4, 1)
    assert read_image(written(tmp_path, nifti(volume((5, 4, 3, 1, 1))))).values.shape == (5, 4, 3)


def test_several_volumes_need_a_choice(tmp_path):
    path = written(tmp_path, nifti(volume((5, 4, 3, 6))))
    assert code_of(path) == "E121"
    assert code_of(path, volume=6) == code_of(path, volume=-1) == "E121"
    np.testing.assert_array_equal(read_image(path, volume=4).values, volume((5, 4, 3, 6))[..., 4])


# Several values a voxel -----------------------------------------------------------------------------------------------

@pytest.mark.parametrize("shape, n", [((5, 4, 3), 1), ((5, 4, 3, 7), 7), ((5, 4, 3, 1, 3), 3), ((5, 4, 3, 1, 6), 6)])
@pytest.mark.parametrize("intent", [0, 1005, 1006, 1007])
def test_components_are_all_values_of_a_voxel(tmp_path, shape, n, intent):
    path = written(tmp_path, gzip.compress(nifti(volume(shape), intent_code=intent, scl_slope=0.5)), "image.nii.gz")
    components = read_components(path)
    np.testing.assert_array_equal(components.values, 0.5 * volume(shape).reshape(5, 4, 3, n))
    np.testing.assert_allclose(components.affine, AFFINE, atol=1e-6)  # float32
    assert (components.intent, components.dtype, components.name) == (intent, "int16", "image.nii.gz")
    assert components.file_digest == content_digest(path) and not components.values.flags.writeable
    for k in range(n):
        np.testing.assert_array_equal(components.values[..., k], read_image(path, volume=k).values)


def test_digest_of_components_is_of_the_content(tmp_path):
    series = volume((5, 4, 3, 1, 3))
    plain = read_components(written(tmp_path, nifti(series)))
    assert plain.digest == read_components(written(tmp_path, gzip.compress(nifti(series)), "z.nii.gz")).digest
    others = nifti(series, intent_code=1007), nifti(series[..., ::-1]), nifti(series, affine=AFFINE * 1.001)
    for content in others:
        assert read_components(written(tmp_path, content)).digest != plain.digest


def test_components_pass_the_same_gate(tmp_path):
    series = volume((5, 4, 3, 6), np.float32)
    series[1, 2, 0, 4] = np.nan
    path = written(tmp_path, nifti(series))
    with pytest.raises(XfemnavError, match=r"E103 .* 1 NaN or infinite voxels, the first at index \(1, 2, 0, 4\)"):
        read_components(path)
    assert read_components(path, nan=-7).values[1, 2, 0, 4] == -7
    faults = {"E101": nifti(series)[:-1], "E105": nifti(series, datatype=77), "E110": nifti(series, srow_x=0),
              "E122": nifti(volume(dtype=np.complex64))}
    for code, content in faults.items():
        with pytest.raises(XfemnavError, match=code):
            read_components(written(tmp_path, content))
    large = written(tmp_path, nifti(volume((50, 50, 50, 4))))  # 1 MB stored, and 1 MB or 4 MB in float64
    assert read_image(large, volume=0, max_memory_gb=2.5e-3).values.size == 50**3
    with pytest.raises(XfemnavError, match="E102"):
        read_components(large, max_memory_gb=2.5e-3)


# Bad content ----------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_voxels_are_counted_and_located(tmp_path, bad):
    values = volume(dtype=np.float32)
    values[1, 2, 0] = values[3, 0, 2] = bad
    path = written(tmp_path, nifti(values))
    with pytest.raises(XfemnavError, match=r"E103 .* 2 NaN or infinite voxels, the first at index \(1, 2, 0\)"):
        read_image(path)
    image = read_image(path, nan=-7)
    assert (image.values == -7).sum() == 2 and image.values[1, 2, 0] == -7


def test_colour_and_complex_images_are_refused(tmp_path):
    rgb = np.zeros((5, 4, 3), [("R", "u1"), ("G", "u1"), ("B", "u1")])
    assert code_of(written(tmp_path, nifti(rgb))) == "E122"
    assert code_of(written(tmp_path, nifti(volume(dtype=np.complex64)))) == "E122"
    assert code_of(written(tmp_path, nifti(datatype=2304, bitpix=32))) == "E122"


@pytest.mark.parametrize("fields", [
    {"srow_x": 0, "srow_y": 0, "srow_z": 0}, {"srow_x": 0}, {"srow_y": [np.nan, 1, 0, 0]},
    {"srow_z": [0, 0, 1, np.inf]}, {"srow_x": 1e30}, {"srow_x": [1, 0, 0, 1e20]},
    {"srow_y": [1, 0, 0, 0], "srow_x": [1, 0, 0, 0]},
    {"sform_code": 0, "qform_code": 1, "quatern_b": 2.0},
    {"sform_code": 0, "qform_code": 1, "pixdim": [1, 0, 1, 1, 1, 1, 1, 1]},
    {"sform_code": 0, "qform_code": 1, "pixdim": [1, -1, 1, 1, 1, 1, 1, 1]},
    {"sform_code": 0, "qform_code": 1, "pixdim": [1, np.nan, 1, 1, 1, 1, 1, 1]}])
def test_unusable_affine(tmp_path, fields):
    path = written(tmp_path, nifti(**fields))
    assert code_of(path) == "E110"
    image = read_image(path, spacing=(0.9, 1.1))  # the way out that the message names
    np.testing.assert_array_equal(image.affine, np.diag([0.9, 1.1, 1, 1]))
    assert code_of(path, spacing=(0, 1)) == "E110"


def test_no_stated_position_warns(tmp_path):
    with pytest.warns(XfemnavWarning, match="W112"):
        image = read_image(written(tmp_path, nifti(sform_code=0, qform_code=0)))
    np.testing.assert_allclose(np.linalg.norm(image.affine[:3, :3], axis=0), [0.9, 1.1, 2], rtol=1e-6)


def test_unknown_frame_codes_count_as_a_position(tmp_path):
    assert read_image(written(tmp_path, nifti(sform_code=128))).frame_code == 1
    assert read_image(written(tmp_path, nifti(sform_code=4))).frame_code == 4


@pytest.mark.parametrize("fields", [
    {"dim": [0, 5, 4, 3, 1, 1, 1, 1]}, {"dim": [8, 5, 4, 3, 1, 1, 1, 1]}, {"dim": [9, 5, 4, 3, 1, 1, 1, 1]},
    {"dim": [3, -5, 4, 3, 1, 1, 1, 1]}, {"dim": [3, 5, 0, 3, 1, 1, 1, 1]}, {"dim": [-3, 5, 4, 3, 1, 1, 1, 1]},
    {"datatype": 0}, {"datatype": 1}, {"datatype": 77}, {"bitpix": 8}, {"datatype": 1536, "bitpix": 128},
    {"vox_offset": -1}, {"vox_offset": 20}, {"vox_offset": np.nan}, {"vox_offset": 352.5}, {"vox_offset": np.inf}])
def test_impossible_header_fields(tmp_path, fields):
    assert code_of(written(tmp_path, nifti(**fields))) == "E105"


@pytest.mark.parametrize("content", [b"", b"\0", b"hello\n" * 100, gzip.compress(b"hello", mtime=0),
                                     b"\x89PNG\r\n" + bytes(999),
                                     nifti()[:300], nifti(magic=b"ni1"), nifti(sizeof_hdr=7)])
def test_not_an_image(tmp_path, content):
    name = "image.nii.gz" if content[:1] == b"\x1f" else "image.nii"
    assert code_of(written(tmp_path, content, name)) == "E106"


# Damaged files --------------------------------------------------------------------------------------------------------

def test_every_truncation_of_a_gzip_file_is_refused(tmp_path):
    packed = gzip.compress(nifti(volume((20, 20, 3))), mtime=0)
    for length in range(0, len(packed), 7):
        assert code_of(written(tmp_path, packed[:length], "image.nii.gz")) in {"E101", "E106"} if length > 1 else True
    for length in range(len(packed) - 8, len(packed)):  # only the trailer is short
        assert code_of(written(tmp_path, packed[:length], "image.nii.gz")) == "E101"


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_no_flipped_byte_of_a_gzip_file_gives_wrong_voxels(tmp_path):
    packed = gzip.compress(nifti(volume((8, 8, 3))), mtime=0)
    truth = read_image(written(tmp_path, packed, "image.nii.gz")).digest
    silent = 0
    for place in range(len(packed)):
        broken = bytearray(packed)
        broken[place] ^= 1 << place % 8
        try:
            image = read_image(written(tmp_path, bytes(broken), "image.nii.gz"))
        except XfemnavError as error:
            assert error.code in {"E101", "E102", "E105", "E106", "E110"}
        else:
            assert image.digest == truth
            silent += 1
    assert silent < 12  # flags, time and system of gzip's own header, and unused bits where the stream ends


def test_a_large_gzip_file_is_read_to_its_trailer(tmp_path):
    content = nifti(volume((100, 100, 100)))  # 2 MB: no reader holds it in one buffer
    packed = gzip.compress(content, 1)
    assert read_image(written(tmp_path, packed, "image.nii.gz")).values.size == 10**6
    for place in (-8, -5, -4, -1):  # CRC and length
        broken = bytearray(packed)
        broken[place] ^= 1
        assert code_of(written(tmp_path, bytes(broken), "image.nii.gz")) == "E101"
    assert code_of(written(tmp_path, packed[:-1], "image.nii.gz")) == "E101"
    assert code_of(written(tmp_path, gzip.compress(content + b"\1", 1), "image.nii.gz")) == "E102"


def test_truncated_raw_file(tmp_path):
    content = nifti()
    for length in range(352, len(content)):
        assert code_of(written(tmp_path, content[:length])) == "E101"


def test_a_file_longer_than_its_header_says_has_wrong_dimensions(tmp_path):
    content = nifti(dim=[3, 5, 4, 2, 1, 1, 1, 1])
    assert code_of(written(tmp_path, content)) == "E102"
    assert code_of(written(tmp_path, gzip.compress(content), "image.nii.gz")) == "E102"


@pytest.mark.parametrize("n", [1, 512, 300_000, 1 << 20])
def test_zeros_after_the_voxels_are_padding(tmp_path, n):
    """As nibabel and SimpleITK read them; up to a limit, and to the checksum behind them."""
    packed = gzip.compress(nifti() + bytes(n), mtime=0)
    for content, name in ((nifti() + bytes(n), "image.nii"), (packed, "image.nii.gz")):
        path = written(tmp_path, content, name)
        with pytest.warns(XfemnavWarning, match=f"W136 {n} bytes"):
            image = read_image(path)
        np.testing.assert_array_equal(image.values, volume())
        np.testing.assert_array_equal(image.values, nibabel.load(path).get_fdata())
        assert image.digest == read_image(written(tmp_path, nifti())).digest
    broken = packed[:-5] + bytes([packed[-5] ^ 1]) + packed[-4:]
    assert code_of(written(tmp_path, broken, "image.nii.gz")) == "E101"


@pytest.mark.parametrize("rest, words", [
    (bytes((1 << 20) + 1), "too many for padding"), (b"junk", "4 bytes"), (bytes(511) + b"\1", "512 bytes"),
    (bytes(9) + b"\1" * (1 << 21), "more than")], ids=["zeros", "junk", "late", "long"])
def test_what_is_no_padding_is_told_as_what_is_known_of_it(tmp_path, rest, words):
    for content, name in ((nifti() + rest, "image.nii"), (gzip.compress(nifti() + rest), "image.nii.gz")):
        with pytest.raises(XfemnavError, match="E102") as failure:
            read_image(written(tmp_path, content, name))
        assert words in str(failure.value) and "damaged" not in str(failure.value)


def test_a_bomb_of_zeros_is_read_no_further_than_padding(tmp_path):
    path = written(tmp_path, gzip.compress(nifti() + bytes(300_000_000), 9), "image.nii.gz")
    tracemalloc.start()
    assert code_of(path) == "E102"
    assert tracemalloc.get_traced_memory()[1] < 2e7
    tracemalloc.stop()


def test_members_and_zero_padding_of_gzip_are_legal(tmp_path):
    content = nifti()
    packed = gzip.compress(content[:200]) + gzip.compress(content[200:]) + bytes(512)
    np.testing.assert_array_equal(read_image(written(tmp_path, packed, "image.nii.gz")).values, volume())
    assert code_of(written(tmp_path, packed + b"junk", "image.nii.gz")) == "E101"


@pytest.mark.parametrize("dims", [[3, 32767, 32767, 32767, 1, 1, 1, 1], [7] + [32767] * 7,
                                  [3, 900, 900, 900, 1, 1, 1, 1]])
@pytest.mark.parametrize("zipped", [False, True])
def test_lying_dimensions_allocate_nothing(tmp_path, dims, zipped):
    content = nifti(dim=dims)
    path = written(tmp_path, gzip.compress(content), "image.nii.gz") if zipped else written(tmp_path, content)
    tracemalloc.start()
    code = code_of(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert code == "E102" and peak < 2e6  # the file has 500 bytes; the rest is tracemalloc and messages


def test_lying_dimensions_within_the_limit_allocate_nothing(tmp_path):
    path = written(tmp_path, gzip.compress(nifti(dim=[3, 600, 600, 600, 1, 1, 1, 1])), "image.nii.gz")
    tracemalloc.start()
    code = code_of(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert code == "E101" and peak < 10e6  # one chunk of 4 MB, not the 430 MB claimed


def test_gzip_bomb_is_left_when_the_header_is_satisfied(tmp_path):
    path = written(tmp_path, gzip.compress(nifti() + bytes(150_000_000), 1), "image.nii.gz")
    tracemalloc.start()
    code = code_of(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert code == "E102" and peak < 3 * path.stat().st_size + 10e6


def test_the_memory_limit_is_the_users(tmp_path):
    path = written(tmp_path, nifti(volume((50, 50, 50))))
    assert code_of(path, max_memory_gb=1e-3) == "E102"  # 250 kB stored and 1 MB in float64
    assert read_image(path, max_memory_gb=2e-3).values.shape == (50, 50, 50)
    assert code_of(path, max_memory_gb=1e-5) == "E102"


@settings(max_examples=250, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 351), st.integers(0, 255)), min_size=1, max_size=6))
@example([(40, 3), (42, 0)])
@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_any_header_gives_an_image_or_a_code(tmp_path_factory, patches):
    content = bytearray(nifti())
    for place, value in patches:
        content[place] = value
    try:
        image = read_image(written(tmp_path_factory.getbasetemp(), bytes(content)))
        slice = take_slice(image, index=0)
        assert to_nifti(slice, slice.values).header.get_data_shape()
    except XfemnavError as error:
        assert error.code in FAULTS
    else:
        assert np.isfinite(image.values).all() and abs(np.linalg.det(image.affine)) > 0


# Paths ----------------------------------------------------------------------------------------------------------------

def test_missing_files(tmp_path):
    path = written(tmp_path, nifti())
    for missing in (tmp_path / "no.nii", path / "inside.nii", tmp_path / ("x" * 300), "nul\0.nii"):
        assert code_of(missing) == "E100"


def test_only_regular_files_are_read(tmp_path, alarm):
    os.mkfifo(tmp_path / "pipe.nii")
    for path in (tmp_path / "pipe.nii", tmp_path, "/dev/zero", "/dev/null"):
        assert code_of(path) == "E106"


def test_links_and_odd_names_are_read(tmp_path):
    path = written(tmp_path, nifti(), "- Größe\n.nii")
    (tmp_path / "link.nii").symlink_to(path)
    assert read_image(path).digest == read_image(tmp_path / "link.nii").digest


@pytest.mark.parametrize("name, content", [("image.nii", gzip.compress(nifti(), mtime=0)), ("image.nii.gz", nifti()),
                                           ("image", gzip.compress(nifti(), mtime=0))])
def test_the_content_tells_the_format_and_a_wrong_name_warns(tmp_path, name, content):
    with pytest.warns(XfemnavWarning, match="W107"):
        np.testing.assert_array_equal(read_image(written(tmp_path, content, name)).values, volume())


def test_the_neighbour_with_a_similar_name_is_not_read(tmp_path):
    written(tmp_path, nifti(volume() + 1), "image.nii")
    path = written(tmp_path, gzip.compress(nifti()), "image.nii.gz")
    np.testing.assert_array_equal(read_image(path).values, volume())
