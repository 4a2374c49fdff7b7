"""NRRD, MetaImage and MGH: the volume is where the file says, in any storage order, and damage is never voxels.

Files are written by other programs (SimpleITK, nibabel), so both sides cannot share one mistake about a frame.
"""

import gzip
import tracemalloc
import warnings
import zlib

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.images import ORDERS, affine_of, image_of, oblique_volume, stored, values_at
from xfemnav.errors import FAULTS, XfemnavError, XfemnavWarning
from xfemnav.imaging.reading.gate import content_digest, read_components, read_image

FLIP = np.diag([-1.0, -1, 1, 1])
ITK = ["v.nrrd", "z.nrrd", "v.nhdr", "z.nhdr", "v.mha", "z.mha", "v.mhd", "z.mhd"]  # z: compressed
FORMATS = [*ITK, "v.mgh", "v.mgz", "v.nii.gz"]


def write(image, path, dtype=np.float64):
    """`image` as the format that the name tells, by another program."""
    values = image.values.astype(dtype)
    if path.suffix in (".mgh", ".mgz"):
        nibabel.save(nibabel.MGHImage(values.astype(np.float32), image.affine), path)
    elif path.suffix == ".gz":
        nibabel.save(nibabel.Nifti1Image(values, image.affine), path)
    else:
        sitk.WriteImage(itk_image(values, image.affine), str(path), path.name.startswith("z"))
    return path


def itk_image(values, affine):
    lps, sizes = FLIP @ affine, np.linalg.norm(affine[:3, :3], axis=0)
    out = sitk.GetImageFromArray(np.ascontiguousarray(values.transpose(2, 1, 0)))
    out.SetSpacing(sizes.tolist())
    out.SetDirection((lps[:3, :3] / sizes).ravel().tolist())
    out.SetOrigin(lps[:3, 3].tolist())
    return out


def code_of(path, read=read_image, **options) -> str:
    with pytest.raises(XfemnavError) as failure:
        read(path, **options)
    assert "\n" not in str(failure.value)
    return failure.value.code


def put(folder, content: bytes, name):
    path = folder / name
    path.write_bytes(content)
    return path


def nrrd(values=None, fields=None, drop=(), data=None) -> bytes:
    """A NRRD whose header says `fields`, whatever its data are."""
    values = counts() if values is None else values
    header = {"type": {"i2": "short", "u1": "uchar", "f4": "float", "f8": "double"}[values.dtype.str[1:]],
              "dimension": values.ndim, "sizes": " ".join(map(str, values.shape)), "encoding": "raw",
              "endian": "big" if values.dtype.str[0] == ">" else "little", "space": "left-posterior-superior",
              "space directions": "(0.9,0,0) (0,1.1,0) (0,0,2)", "space origin": "(40,50,7)"} | (fields or {})
    lines = [f"{key}: {value}\n" for key, value in header.items() if key not in drop]
    return ("NRRD0005\n# comment\n" + "".join(lines) + "key:=value: with (marks)\n\n").encode() + (
        values.tobytes("F") if data is None else data)


def mha(values=None, fields=None, drop=(), data=None) -> bytes:
    values = counts() if values is None else values
    header = {"ObjectType": "Image", "NDims": 3, "BinaryData": "True",
              "BinaryDataByteOrderMSB": str(values.dtype.str[0] == ">"), "CompressedData": "False",
              "TransformMatrix": "1 0 0 0 1 0 0 0 1", "Offset": "40 50 7", "ElementSpacing": "0.9 1.1 2",
              "DimSize": " ".join(map(str, values.shape)),
              "ElementType": {"i2": "MET_SHORT", "u1": "MET_UCHAR", "f4": "MET_FLOAT", "f8": "MET_DOUBLE"}[
                  values.dtype.str[1:]]} | (fields or {})
    header["ElementDataFile"] = header.pop("ElementDataFile", "LOCAL")
    return "".join(f"{key} = {value}\n" for key, value in header.items() if key not in drop).encode() + (
        values.tobytes("F") if data is None else data)


def mgh(values=None, tail=b"", **fields) -> bytes:
    raw = bytearray(nibabel.MGHImage((counts() if values is None else values), AFFINE).to_bytes())
    layout = nibabel.freesurfer.mghformat.header_dtype
    header = np.frombuffer(bytes(raw[: layout.itemsize]), layout).copy()
    for name, value in fields.items():
        header[name] = value
    return header.tobytes() + bytes(raw[layout.itemsize :]) + tail


AFFINE = np.array([[-0.9, 0, 0, -40], [0, -1.1, 0, -50], [0, 0, 2.0, 7], [0, 0, 0, 1]])  # what nrrd() and mha() say
MADE = {"v.nrrd": nrrd, "v.mha": mha}


def counts(dtype="<i2", shape=(5, 4, 3)):
    return np.random.default_rng(0).integers(-99, 100, shape).astype(dtype)


# What is read ---------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", FORMATS)
def test_every_storage_order_gives_the_same_values_at_the_same_points(tmp_path, name):
    volume, points = oblique_volume()
    truth = values_at(volume, points)
    assert np.isfinite(truth).all() and np.ptp(truth) > 100 and truth.min() < 0
    for order, flips in ORDERS:
        image = read_image(write(stored(volume, order, flips), tmp_path / name))
        # mgh and NIfTI-1 hold positions in float32; a voxel value changes by 20 in a mm
        np.testing.assert_allclose(values_at(image, points), truth, atol=1e-6 if name in ITK else 5e-3)
        same = stored(volume, order, flips)
        np.testing.assert_allclose(image.affine, same.affine, atol=1e-6 if name in ITK else 1e-4)
        np.testing.assert_array_equal(image.values, same.values)
        assert image.frame_code > 0 and image.file_digest == content_digest(tmp_path / name)


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"])
@pytest.mark.parametrize("name", ["v.nrrd", "z.nrrd", "v.mha", "z.mhd"])
def test_every_type_of_voxel(tmp_path, name, dtype):
    values = counts("i8") if dtype[0] != "u" else abs(counts("i8"))
    image = read_image(write(image_of(values, AFFINE), tmp_path / name, dtype))
    np.testing.assert_array_equal(image.values, values)
    assert image.dtype == np.dtype(dtype).name


@pytest.mark.parametrize("dtype", ["u1", ">i2", ">i4", ">f4"])
def test_every_type_of_mgh(tmp_path, dtype):
    values = abs(counts(dtype))
    np.testing.assert_array_equal(read_image(put(tmp_path, mgh(values), "v.mgh")).values, values)


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("dtype", ["i2", "f4", "f8"])
def test_both_byte_orders(tmp_path, name, order, dtype):
    values = counts(order + dtype)
    image = read_image(put(tmp_path, MADE[name](values), name))
    np.testing.assert_array_equal(image.values, values)
    np.testing.assert_array_equal(image.affine, AFFINE)


def test_the_header_states_a_scale(tmp_path):
    fields = {"ElementToIntensityFunctionSlope": 0.5, "ElementToIntensityFunctionOffset": -3}
    np.testing.assert_array_equal(read_image(put(tmp_path, mha(fields=fields), "v.mha")).values, 0.5 * counts() - 3)


@pytest.mark.parametrize("name, content", [("v.nrrd.gz", gzip.compress(nrrd())), ("v.mha.gz", gzip.compress(mha()))])
def test_a_whole_file_may_be_gzip(tmp_path, name, content):
    np.testing.assert_array_equal(read_image(put(tmp_path, content, name)).values, counts())


def test_a_name_tells_nothing(tmp_path):
    for make in (nrrd, mha, mgh):
        np.testing.assert_array_equal(read_image(put(tmp_path, make(counts(">f4")), "image.nii")).values, counts())
    with pytest.warns(XfemnavWarning, match="W107"):
        read_image(put(tmp_path, gzip.compress(mgh(counts(">f4"))), "image.mgh"))


# Frames ---------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("space, signs", [
    ("left-posterior-superior", (-1, -1, 1)), ("LPS", (-1, -1, 1)), ("right-anterior-superior", (1, 1, 1)),
    ("RAS", (1, 1, 1)), ("left-anterior-superior", (-1, 1, 1)), ("LAS", (-1, 1, 1))])
def test_spaces_of_nrrd(tmp_path, space, signs):
    image = read_image(put(tmp_path, nrrd(fields={"space": space}), "v.nrrd"))
    given = np.array([[0.9, 0, 0, 40], [0, 1.1, 0, 50], [0, 0, 2, 7], [0, 0, 0, 1]])
    np.testing.assert_array_equal(image.affine, np.diag([*signs, 1]) @ given)
    assert image.frame_code == 1


@pytest.mark.parametrize("content, name", [
    (nrrd(fields={"space": "scanner-xyz"}), "v.nrrd"), (nrrd(fields={"space dimension": 3}, drop=["space"]), "v.nrrd"),
    (nrrd(fields={"spacings": "0.9 1.1 2"}, drop=["space", "space directions", "space origin"]), "v.nrrd"),
    (mha(drop=["Offset", "TransformMatrix"]), "v.mha"), (mgh(counts(">f4"), goodRASFlag=0), "v.mgh")])
def test_no_stated_position_warns(tmp_path, content, name):
    with pytest.warns(XfemnavWarning, match="W112"):
        image = read_image(put(tmp_path, content, name))
    sizes = [1, 1, 1] if name == "v.mgh" else [0.9, 1.1, 2]  # FreeSurfer's own default
    np.testing.assert_allclose(np.linalg.norm(image.affine[:3, :3], axis=0), sizes)
    assert image.frame_code == 0


def test_units_of_nrrd(tmp_path):
    fields = {"space units": '"um" "um" "um"', "space directions": "(900,0,0) (0,1100,0) (0,0,2000)",
              "space origin": "(40000,50000,7000)"}
    np.testing.assert_allclose(read_image(put(tmp_path, nrrd(fields=fields), "v.nrrd")).affine, AFFINE, rtol=1e-12)
    assert code_of(put(tmp_path, nrrd(fields={"space units": '"s" "s" "s"'}), "v.nrrd")) == "E110"


def test_a_slice_is_a_volume_of_one(tmp_path):
    plane = counts(shape=(5, 4))
    image = read_image(put(tmp_path, nrrd(plane, {"space directions": "(0.9,0,0) (0,0,1.1)"}), "v.nrrd"))
    np.testing.assert_array_equal(image.values[:, :, 0], plane)
    np.testing.assert_allclose(image.affine[:3, :3].T, [[-0.9, 0, 0], [0, 0, 1.1], [0, 1, 0]])
    fields = {"NDims": 2, "TransformMatrix": "1 0 0 1", "Offset": "40 50", "ElementSpacing": "0.9 1.1"}
    image = read_image(put(tmp_path, mha(plane, fields), "v.mha"))
    np.testing.assert_array_equal(image.values[:, :, 0], plane)
    np.testing.assert_allclose(image.affine, [[-0.9, 0, 0, -40], [0, -1.1, 0, -50], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("content", [
    nrrd(fields={"space directions": "(0,0,0) (0,1,0) (0,0,1)"}), nrrd(fields={"space origin": "(nan,0,0)"}),
    nrrd(fields={"space directions": "(1,0,0) (1,0,0) (0,0,1)"}),
    nrrd(fields={"space directions": "(1,0,0) (0,1,0) (0,0,inf)"}),
    nrrd(fields={"space directions": "(1e200,0,0) (0,1,0) (0,0,1)"}),
    mha(fields={"ElementSpacing": "0 1 1"}), mha(fields={"ElementSpacing": "nan 1 1"}),
    mha(fields={"TransformMatrix": "0 0 0 0 0 0 0 0 0"}), mha(fields={"Offset": "1e20 0 0"}),
    mgh(delta=[0, 1, 1]), mgh(delta=[np.nan, 1, 1]), mgh(Mdc=0), mgh(Pxyz_c=np.inf)])
def test_unusable_affine(tmp_path, content):
    path = put(tmp_path, content, "v.img")
    assert code_of(path) == "E110"
    np.testing.assert_array_equal(read_image(path, spacing=(0.9, 1.1)).affine, np.diag([0.9, 1.1, 1, 1]))


# Several values a voxel -----------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", ["v.nrrd", "v.mha", "z.nhdr", "z.mhd"])
@pytest.mark.parametrize("n", [2, 3, 6])
def test_vectors_are_components_and_no_image(tmp_path, name, n):
    vectors = np.random.default_rng(1).normal(size=(5, 4, 3, n)).astype(np.float32)
    out = sitk.GetImageFromArray(np.ascontiguousarray(vectors.transpose(2, 1, 0, 3)), isVector=True)
    sitk.WriteImage(out, str(tmp_path / name), name[0] == "z")
    np.testing.assert_array_equal(read_components(tmp_path / name).values, vectors)
    assert code_of(tmp_path / name) == "E122"


@pytest.mark.parametrize("axis", [0, 1, 2, 3])
@pytest.mark.parametrize("kind, code", [("vector", "E122"), ("3D-symmetric-matrix", "E122"), ("list", "E121"),
                                        ("time", "E121")])
def test_the_axis_of_components_stands_anywhere_in_nrrd(tmp_path, axis, kind, code):
    values = counts(shape=(5, 4, 3, 6))
    directions, kinds = ["(0.9,0,0)", "(0,1.1,0)", "(0,0,2)"], ["domain"] * 3
    directions.insert(axis, "none")
    kinds.insert(axis, kind)
    fields = {"space directions": " ".join(directions), "kinds": " ".join(kinds)}
    path = put(tmp_path, nrrd(np.moveaxis(values, 3, axis), fields), "v.nrrd")
    np.testing.assert_array_equal(read_components(path).values, values)
    assert code_of(path) == code
    if code == "E121":
        np.testing.assert_array_equal(read_image(path, volume=2).values, values[..., 2])
        assert code_of(path, volume=6) == "E121"


def test_series_of_volumes(tmp_path):
    values = counts(">f4", (5, 4, 3, 2))
    fields = {"NDims": 4, "TransformMatrix": " ".join(map(str, np.eye(4).ravel())), "Offset": "40 50 7 0",
              "ElementSpacing": "0.9 1.1 2 1"}
    for content, name in ((mgh(values), "v.mgh"), (mha(values, fields), "v.mha")):
        path = put(tmp_path, content, name)
        assert code_of(path) == "E121"
        np.testing.assert_array_equal(read_image(path, volume=1).values, values[..., 1])
        np.testing.assert_array_equal(read_components(path).values, values)


def test_colour_and_complex_are_refused(tmp_path):
    for kind, n in (("RGB-color", 3), ("RGBA-color", 4), ("complex", 2)):
        fields = {"space directions": "none (1,0,0) (0,1,0) (0,0,1)", "kinds": f"{kind} domain domain domain"}
        path = put(tmp_path, nrrd(counts(shape=(n, 5, 4, 3)), fields), "v.nrrd")
        assert code_of(path) == code_of(path, read_components) == "E122"
    assert code_of(put(tmp_path, mha(fields={"ElementType": "MET_SHORT_ARRAY"}), "v.mha")) == "E122"


# Bad content ----------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("make", [nrrd, mha, mgh])
def test_non_finite_voxels(tmp_path, make):
    values = counts(">f4")
    values[1, 2, 0] = np.nan
    path = put(tmp_path, make(values), "v.img")
    with pytest.raises(XfemnavError, match=r"E103 .* 1 NaN or infinite voxels, the first at index \(1, 2, 0\)"):
        read_image(path)
    assert read_image(path, nan=-7).values[1, 2, 0] == -7


@pytest.mark.parametrize("content, code", [
    (nrrd(fields={"sizes": "5 4 0"}), "E105"), (nrrd(fields={"sizes": "5 4 -3"}), "E105"),
    (nrrd(fields={"sizes": "5 4"}), "E105"), (nrrd(fields={"dimension": "x"}), "E105"), (nrrd(drop=["sizes"]), "E105"),
    (nrrd(fields={"type": "block"}), "E105"), (nrrd(drop=["endian"]), "E105"), (nrrd(fields={"Type": "float"}), "E105"),
    (nrrd(fields={"sizes": "9" * 5000 + " 4 3"}), "E105"), (nrrd(fields={"kinds": "domain"}), "E105"),
    (nrrd(fields={"space directions": "(1,0,0) (0,1,0)"}), "E105"),
    (nrrd(fields={"space directions": "none none none"}), "E105"),
    (nrrd(fields={"space directions": "(1,0,0) (0,one,0) (0,0,1)"}), "E105"),
    (nrrd(fields={"encoding": "ascii"}), "E106"), (nrrd(fields={"encoding": "bzip2"}), "E106"),
    (nrrd(fields={"line skip": "1"}), "E106"), (nrrd(fields={"byte skip": "-1"}), "E106"),
    (nrrd(fields={"data file": "/etc/passwd"}), "E105"), (nrrd(fields={"data file": "../v.raw"}), "E105"),
    (nrrd(fields={"data file": "LIST"}), "E106"), (nrrd(fields={"data file": "v%03d.raw 1 3 1"}), "E106"),
    (nrrd(fields={"data file": "no.raw"}), "E100"), (nrrd(fields={"sizes": "5 4 4"}), "E101"),
    (nrrd(fields={"sizes": "5 4 2"}), "E102"), (nrrd(fields={"sizes": "32767 32767 32767"}), "E102"),
    (mha(fields={"DimSize": "5 4 0"}), "E105"), (mha(fields={"DimSize": "5 4"}), "E105"),
    (mha(fields={"ElementType": "MET_STRING"}), "E105"), (mha(fields={"NDims": "3.5"}), "E105"),
    (mha(fields={"ElementNumberOfChannels": 0}), "E105"), (mha(fields={"ElementNumberOfChannels": 1.5}), "E105"),
    (mha(fields={"CompressedData": "perhaps"}), "E105"), (mha(fields={"ElementSpacing": "1 1"}), "E105"),
    (mha(fields={"Position": "0 0 0"}), "E105"), (mha(fields={"ElementNumberOfChannels": 2}), "E101"),
    (mha(fields={"BinaryData": "False"}), "E106"), (mha(fields={"HeaderSize": -1}), "E106"),
    (mha(fields={"ElementDataFile": "/etc/passwd"}), "E105"), (mha(fields={"ElementDataFile": "no.raw"}), "E100"),
    (mha(fields={"ElementDataFile": "LIST"}), "E106"), (mha(drop=["ElementDataFile"]), "E101"),
    (mha(fields={"DimSize": "5 4 4"}), "E101"), (mha(fields={"DimSize": "5 4 2"}), "E102"),
    (mha(fields={"DimSize": "32767 32767 32767"}), "E102"),
    (mgh(dims=[5, 4, 0, 1]), "E105"), (mgh(dims=[5, -4, 3, 1]), "E105"), (mgh(type=2), "E105"), (mgh(type=77), "E105"),
    (mgh(dims=[5, 4, 4, 1]), "E101"), (mgh(dims=[5, 4, 2, 1]), "E102"), (mgh(dims=[32767, 32767, 32767, 1]), "E102"),
    (mgh(version=2), "E106"), (mgh(goodRASFlag=7), "E106")])
def test_impossible_headers(tmp_path, content, code):
    path = put(tmp_path, content, "v.img")
    tracemalloc.start()
    found = code_of(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == code and peak < 2e6  # the file has 500 bytes


def test_a_data_file_is_read_from_the_same_folder_and_counts_in_the_digest(tmp_path):
    for make, key, name in ((nrrd, "data file", "v.nhdr"), (mha, "ElementDataFile", "v.mhd")):
        path = put(tmp_path, make(fields={key: "v.raw"}, data=b""), name)
        raw = put(tmp_path, counts().tobytes("F"), "v.raw")
        first = read_image(path)
        np.testing.assert_array_equal(first.values, counts())
        raw.write_bytes((counts() + 1).tobytes("F"))
        assert read_image(path).file_digest == content_digest(path) != first.file_digest
        raw.write_bytes(raw.read_bytes()[:-1])
        assert code_of(path) == "E101"
        raw.write_bytes(raw.read_bytes() + b"xx")
        assert code_of(path) == "E102"
        (tmp_path / "v.raw").unlink()
        assert code_of(path) == code_of(path, content_digest) == "E100"


def test_bytes_before_the_voxels_of_a_data_file(tmp_path):
    put(tmp_path, b"12345" + counts().tobytes("F"), "v.raw")
    for content in (nrrd(fields={"data file": "v.raw", "byte skip": 5}, data=b""),
                    mha(fields={"ElementDataFile": "v.raw", "HeaderSize": 5}, data=b"")):
        np.testing.assert_array_equal(read_image(put(tmp_path, content, "v.hdr")).values, counts())


def test_what_follows_the_voxels_of_an_mgh_must_be_tags(tmp_path):
    tag = (3).to_bytes(4, "big") + (5).to_bytes(8, "big") + b"hello"
    np.testing.assert_array_equal(read_image(put(tmp_path, mgh(counts(">f4"), tail=tag), "v.mgh")).values, counts())
    whole = mgh(counts(">f4"))
    np.testing.assert_array_equal(read_image(put(tmp_path, whole[:-20], "v.mgh")).values, counts())  # tail is optional
    for junk in (bytes(100), b"junk" * 9, b"x"):
        assert code_of(put(tmp_path, mgh(counts(">f4"), tail=junk), "v.mgh")) == "E102"


def padded(rest: bytes) -> dict[str, tuple]:
    """Files whose voxels are followed by `rest`: in the stream of the voxels or, where they are packed, behind it."""
    voxels = counts().tobytes("F")
    packed, size = zlib.compress(voxels), {"CompressedDataSize": len(zlib.compress(voxels))}
    gz, z, beside = {"encoding": "gzip"}, {"CompressedData": "True"}, {"data file": "v.raw"}
    return {"raw.nrrd": (nrrd() + rest,), "inside.nrrd": (nrrd(fields=gz, data=gzip.compress(voxels + rest)),),
            "behind.nrrd": (nrrd(fields=gz, data=gzip.compress(voxels) + rest),),
            "beside.nhdr": (nrrd(fields=beside, data=b""), voxels + rest), "raw.mha": (mha() + rest,),
            "inside.mha": (mha(fields=z | {"CompressedDataSize": len(zlib.compress(voxels + rest))},
                               data=zlib.compress(voxels + rest)),),
            "behind.mha": (mha(fields=z | size, data=packed + rest),),
            "beside.mhd": (mha(fields={"ElementDataFile": "v.raw"}, data=b""), voxels + rest)}


@pytest.mark.parametrize("name", padded(b""))
def test_zeros_after_the_voxels_are_padding_in_every_format(tmp_path, name):
    """As ITK reads them. Behind a packed stream, zeros are what its own readers skip; nothing is said of them."""
    for rest, code in ((bytes(512), "W136"), (bytes(99) + b"x", {"behind": "E101"}.get(name[:6], "E102"))):
        for file, content in zip((name, "v.raw"), padded(rest)[name]):
            path = put(tmp_path, content, file)
        path = tmp_path / name
        np.testing.assert_array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(path))).T, counts())
        if code.startswith("E"):
            assert code_of(path) == code
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            np.testing.assert_array_equal(read_image(path).values, counts())
        assert [item.message.code for item in caught] == ([] if name.startswith("behind") else [code])


def test_the_memory_limit_is_the_users(tmp_path):
    values = counts(shape=(50, 50, 50))  # 250 kB stored and 1 MB in float64
    for make in (nrrd, mha):
        path = put(tmp_path, make(values), "v.img")
        assert code_of(path, max_memory_gb=1e-3) == "E102"
        assert read_image(path, max_memory_gb=2e-3).values.size == 50**3


# Damaged files --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", [name for name in FORMATS if name[-3:] not in ("hdr", "mhd")])
def test_every_truncation_is_refused(tmp_path, name):
    content = write(oblique_volume()[0], tmp_path / name).read_bytes()
    end = len(content) - 20 * name.endswith(".mgh")  # the numbers of the scan are optional
    for length in [*range(64, end, 64), end - 1]:
        assert code_of(put(tmp_path, content[:length], name)) in {"E101", "E105", "E106"}
    assert code_of(put(tmp_path, content[: end - 1], name)) == "E101"


@pytest.mark.parametrize("name", ["z.nhdr", "z.mhd", "v.nhdr", "v.mhd"])
def test_every_truncation_of_a_data_file_is_refused(tmp_path, name):
    path = write(oblique_volume()[0], tmp_path / name)
    data = next(file for file in tmp_path.iterdir() if "raw" in file.name)
    content = data.read_bytes()
    for length in [*range(64, len(content), 64), len(content) - 1]:
        data.write_bytes(content[:length])
        assert code_of(path) == "E101"


@pytest.mark.parametrize("name", ["z.nrrd", "z.mha"])
def test_a_large_packed_file_is_read_to_its_checksum(tmp_path, name):
    noise = np.random.default_rng(3).normal(size=(100, 110, 120))  # 10 MB that do not shrink: several chunks
    path = write(image_of(noise, AFFINE), tmp_path / name)
    np.testing.assert_array_equal(read_image(path).values, noise)
    broken = bytearray(path.read_bytes())
    broken[-1] ^= 1
    assert code_of(put(tmp_path, bytes(broken), name)) == "E101"


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
@pytest.mark.parametrize("name", ["z.nrrd", "z.mha", "v.mgz"])
def test_no_flipped_byte_of_compressed_voxels_gives_wrong_ones(tmp_path, name):
    content = write(image_of(counts("f8"), AFFINE), tmp_path / name).read_bytes()
    start = {"z.nrrd": content.find(b"\n\n") + 2, "z.mha": content.find(b"LOCAL\n") + 6, "v.mgz": 0}[name]
    truth, silent = read_image(tmp_path / name).digest, 0
    for place in range(start, len(content)):
        broken = bytearray(content)
        broken[place] ^= 1 << place % 8
        try:
            image = read_image(put(tmp_path, bytes(broken), name))
        except XfemnavError as error:
            assert error.code in {"E101", "E102", "E105", "E106", "E110"}
        else:
            assert image.digest == truth
            silent += 1
    assert silent < 12  # flags, time and system of gzip's own header, and unused bits where the stream ends


def test_bombs_are_left_when_the_header_is_satisfied(tmp_path):
    full = counts().tobytes("F") + bytes(150_000_000)
    for content, name in ((nrrd(fields={"encoding": "gzip"}, data=gzip.compress(full, 1)), "v.nrrd"),
                          (mha(fields={"CompressedData": "True"}, data=zlib.compress(full, 1)), "v.mha")):
        path = put(tmp_path, content, name)
        tracemalloc.start()
        assert code_of(path) == "E102"
        assert tracemalloc.get_traced_memory()[1] < 5 * len(content) + 12e6
        tracemalloc.stop()
    for make, fields, name in ((nrrd, {"encoding": "gzip"}, "v.nrrd.gz"),
                               (mha, {"CompressedData": "True"}, "v.mha.gz")):
        packed = gzip.compress(make(fields=fields, data=bytes(150_000_000)), 1)  # packed twice, the inner one no stream
        tracemalloc.start()
        with pytest.raises(XfemnavError, match=r"E102 .* packs"):
            read_image(put(tmp_path, packed, name))
        assert tracemalloc.get_traced_memory()[1] < 30e6
        tracemalloc.stop()
    longer = zlib.compress(counts().tobytes("F")) + b"x"
    assert code_of(put(tmp_path, mha(fields={"CompressedData": "True"}, data=longer), "v.mha")) == "E101"


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([nrrd, mha, mgh]), st.lists(st.tuples(st.integers(0, 330), st.integers(0, 255)), min_size=1,
                                                   max_size=5))
@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_any_header_gives_an_image_or_a_code(tmp_path_factory, make, patches):
    content = bytearray(make(counts(">f4")))
    for place, value in patches:
        content[place] = value
    try:
        image = read_image(put(tmp_path_factory.getbasetemp(), bytes(content), "v.img"), nan=0)
    except XfemnavError as error:
        assert error.code in FAULTS
    else:
        assert np.isfinite(image.values).all() and abs(np.linalg.det(image.affine)) > 0


def test_the_shared_volume_is_oblique_and_uneven():
    volume, _ = oblique_volume()
    axes = volume.affine[:3, :3] / np.linalg.norm(volume.affine[:3, :3], axis=0)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert (abs(axes) > 0.05).all() and len(set(volume.values.shape)) == 3
    np.testing.assert_array_equal(affine_of(volume.affine[:3, :3], volume.affine[:3, 3]), volume.affine)
