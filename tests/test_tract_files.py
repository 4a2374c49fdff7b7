"""Files of tracts: read whole or refused, written in the format that they came in."""

import gzip
import os
import warnings

import numpy as np
import pytest
from nibabel.streamlines import TckFile, Tractogram, TrkFile
from numpy.testing import assert_allclose, assert_array_equal

from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.endings import TRACTS, ending_of
from xfemnav.imaging.points.tract_files import decoded_streamlines, file_like, read_streamlines, tract_bytes

LINES = [np.random.default_rng(n).normal(scale=40, size=(n, 3)).astype(np.float32) for n in (5, 1, 9)]
# 2 mm voxels stored to the left, with an oblique frame
HEADER = {"voxel_to_rasmm": np.array([[-1.92, 0.56, 0, 90], [0.56, 1.92, 0, -100], [0, 0, 2, -60], [0, 0, 0, 1.0]]),
          "voxel_sizes": (2.0, 2.0, 2.0), "dimensions": (90, 100, 70), "voxel_order": "LAS"}
FORMATS = {".trk": lambda t: TrkFile(t, header=HEADER), ".tck": TckFile}


def written(folder, ending, **data):
    path = folder / f"tracts{ending}"
    FORMATS[ending](Tractogram(LINES, affine_to_rasmm=np.eye(4), **data)).save(path)
    return path


def parts(file):
    """The arguments of `file_like` for all of a file's streamlines as they are."""
    points, count = file.streamlines.get_data(), np.array([len(x) for x in file.streamlines])
    k = np.arange(len(points))
    return points, count, (k, k, np.zeros(len(k))), np.arange(len(count)), np.array([1, 0, 3])


@pytest.mark.parametrize("ending", FORMATS)
def test_a_file_goes_out_as_it_came(ending, tmp_path):
    file = read_streamlines(written(tmp_path, ending))
    file_like(file, *parts(file)).save(tmp_path / f"new{ending}")
    again = read_streamlines(tmp_path / f"new{ending}")
    assert type(again) is type(file)
    for new, line in zip(again.streamlines, LINES):
        assert_allclose(new, line, atol=1e-4)    # float32 in voxels of a frame 100 mm off, twice over
    assert_allclose(again.affine, file.affine)
    if ending == ".trk":
        assert_array_equal(again.header["dimensions"], HEADER["dimensions"])
        assert_array_equal(again.tractogram.data_per_streamline["motion"].ravel(), [1, 0, 3])


@pytest.mark.parametrize("ending", FORMATS)
def test_no_streamline_left_is_a_file_too(ending, tmp_path):
    file = read_streamlines(written(tmp_path, ending))
    none = np.zeros(0, int)
    empty = file_like(file, np.zeros((0, 3)), none, (none, none, np.zeros(0)), none, none)
    empty.save(tmp_path / f"empty{ending}")
    assert len(type(file).load(tmp_path / f"empty{ending}").streamlines) == 0


@pytest.mark.parametrize("ending", FORMATS)
def test_a_file_that_ends_early_is_refused_wherever_it_ends(ending, tmp_path):
    whole = written(tmp_path, ending).read_bytes()
    cut = tmp_path / f"cut{ending}"
    for n in {3, 100, *range(len(whole) - 190, len(whole)), 1000, 1003} & set(range(len(whole))):
        cut.write_bytes(whole[:n])
        with pytest.raises(XfemnavError, match="E701"):
            read_streamlines(cut)


def test_files_that_are_none(tmp_path):
    with pytest.raises(XfemnavError, match="E100"):
        read_streamlines(tmp_path / "missing.trk")
    with pytest.raises(XfemnavError, match="E106"):
        read_streamlines(tmp_path)
    os.mkfifo(tmp_path / "pipe.trk")
    with pytest.raises(XfemnavError, match="E106"):    # and nobody waits for it
        read_streamlines(tmp_path / "pipe.trk")
    (tmp_path / "new.trx").write_bytes(b"PK\x03\x04 a zip archive")
    with pytest.raises(XfemnavError, match=r"E701.*\.trk, \.trk\.gz or \.tck"):
        read_streamlines(tmp_path / "new.trx")
    (tmp_path / "text.tck").write_text("x,y,z\n1,2,3\n" * 100)
    with pytest.raises(XfemnavError, match="E701"):
        read_streamlines(tmp_path / "text.tck")
    lines = [*LINES, np.full((2, 3), np.inf, np.float32)]
    with np.errstate(invalid="ignore"):
        TrkFile(Tractogram(lines, affine_to_rasmm=np.eye(4))).save(tmp_path / "infinite.trk")
    with pytest.raises(XfemnavError, match=r"E701.*NaN"):
        read_streamlines(tmp_path / "infinite.trk")


def test_a_full_trk_has_no_room_for_flags(tmp_path):
    data = {f"value{k}": np.zeros((3, 1), np.float32) for k in range(10)}
    file = read_streamlines(written(tmp_path, ".trk", data_per_streamline=data))
    with pytest.raises(XfemnavError, match=r"E701.*fewer"):
        file_like(file, *parts(file))


def test_gzip_is_read_and_written_to_its_checksum(tmp_path):
    whole = written(tmp_path, ".trk").read_bytes()
    packed = gzip.compress(whole)
    file = decoded_streamlines(packed, "a.trk.gz")
    made = tract_bytes(file, ending_of("A.TRK.GZ", TRACTS))
    assert made[:2] == b"\x1f\x8b" and made == tract_bytes(file, ".trk.gz")    # and no time of day in it
    for new, line in zip(decoded_streamlines(made, "b.trk.gz").streamlines, LINES):
        assert_allclose(new, line, atol=1e-4)
    with pytest.raises(XfemnavError, match="E101"):
        decoded_streamlines(packed[:-1], "a.trk.gz")
    with pytest.raises(XfemnavError, match="E101"):
        decoded_streamlines(packed[:-6] + b"\0" + packed[-5:], "a.trk.gz")
    with pytest.raises(XfemnavError, match="E102"):    # 30 kB of zeros without end
        decoded_streamlines(gzip.compress(whole + bytes(30_000_000)), "bomb.trk.gz")
    with pytest.warns(match="W107"):
        decoded_streamlines(whole, "a.trk.gz")


@pytest.mark.parametrize("counts, right", [(("0000001000", "3"), True), (("3", "0000001000"), True), (("3", "3"), True),
                                           (("4", "5"), False), (("4",), False), ((), True), (("0",), True)])
def test_of_two_counts_one_has_to_be_right(tmp_path, counts, right):
    """MRtrix's programs append a second line where they edit a file."""
    whole = written(tmp_path, ".tck").read_bytes()
    data = whole[whole.index(b"END\n") + 4:]
    head = "".join(["mrtrix tracks\n", *(f"count: {n}\n" for n in counts), "datatype: Float32LE\n"])
    content = f"{head}file: . {len(head) + 17}\nEND\n".encode().ljust(len(head) + 17) + data
    if right:
        assert len(decoded_streamlines(content, "a.tck").streamlines) == 3
    else:
        with pytest.raises(XfemnavError, match="E701"):
            decoded_streamlines(content, "a.tck")


def test_a_history_of_commands_is_kept(tmp_path):
    """Several lines of one key, and colons in them: nibabel reads both and writes neither."""
    whole = written(tmp_path, ".tck").read_bytes()
    head = (b"mrtrix tracks\ncount: 3\ndatatype: Float32LE\ncommand_history: tckgen a:b\n"
            b"command_history: tckedit c:d\nroi: seed /x:y.nii\n")
    content = head + f"file: . {len(head) + 17}\nEND\n".encode().ljust(17) + whole[whole.index(b"END\n") + 4:]
    made = tract_bytes(decoded_streamlines(content, "a.tck"), ".tck")
    assert made.count(b"command_history: ") == 2 and b"tckedit c:d\nroi: seed /x:y.nii\n" in made
    for new, line in zip(decoded_streamlines(made, "b.tck").streamlines, LINES):
        assert_allclose(new, line)


def without(whole, *places):
    content = bytearray(whole)
    for start, n in places:
        content[start:start + n] = bytes(n)
    return bytes(content)


@pytest.mark.parametrize("places, told", [
    ([(440, 64)], r"W115.*no vox_to_ras:"), ([(948, 4)], r"W115.*no voxel_order:"),
    ([(440, 64), (948, 4)], r"W115.*no vox_to_ras and no voxel_order:"),
])
def test_tracts_without_a_frame_are_told_and_stay_so(tmp_path, places, told):
    content = without(written(tmp_path, ".trk").read_bytes(), *places)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        file = decoded_streamlines(content, "a.trk")
        made = tract_bytes(file, ".trk")
    assert [item.category.__name__ for item in caught] == ["XfemnavWarning"]    # no library's
    with pytest.warns(match=told):
        again = decoded_streamlines(made, "b.trk")
    assert_allclose(again.streamlines.get_data(), file.streamlines.get_data(), atol=1e-4)
    for start, n in places:
        assert made[start:start + n] == bytes(n)


def test_voxels_of_two_sizes_are_told(tmp_path):
    content = bytearray(written(tmp_path, ".trk").read_bytes())
    content[12:24] = np.full(3, 1.0, "<f4").tobytes()
    with pytest.warns(match=r"W115.*2 x 2 x 2 mm.*1 x 1 x 1 mm"):
        decoded_streamlines(bytes(content), "a.trk")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_streamlines(tmp_path / "tracts.trk")    # a frame is no doubt
