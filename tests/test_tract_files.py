"""Files of tracts: read whole or refused, written in the format that they came in."""

import numpy as np
import pytest
from nibabel.streamlines import TckFile, Tractogram, TrkFile
from numpy.testing import assert_allclose, assert_array_equal

from xfemnav.errors import XfemnavError
from xfemnav.imaging.tract_files import file_like, read_streamlines

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
    for n in {0, 3, 100, *range(len(whole) - 190, len(whole)), 1000, 1003} & set(range(len(whole))):
        cut.write_bytes(whole[:n])
        with pytest.raises(XfemnavError, match="E701"):
            read_streamlines(cut)


def test_files_that_are_none(tmp_path):
    with pytest.raises(XfemnavError, match="E100"):
        read_streamlines(tmp_path / "missing.trk")
    with pytest.raises(XfemnavError, match="E100"):
        read_streamlines(tmp_path)
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
