"""What a fuzzer may feed: bytes as a file, read as a run reads it. Only coded errors and right values may come out."""

import gzip
import json
import os
import shutil
import tempfile
import warnings
from functools import cache
from pathlib import Path

import numpy as np

from tests.fuzz import surface_seeds
from tests.fuzz.seeds import CUT, KINDS, SEEDS, finished
from xfemnav.errors import FAULTS, XfemnavError, XfemnavWarning
from xfemnav.imaging.frames.slices import PLANES, take_slice, to_nifti
from xfemnav.imaging.points.point_files import read_control_points, read_points, write_points
from xfemnav.imaging.points.point_set import FARTHEST
from xfemnav.imaging.points.surface_files import decoded_surface
from xfemnav.imaging.points.tract_files import decoded_streamlines, tract_bytes
from xfemnav.imaging.reading.gate import content_digest, read_image
from xfemnav.pipeline.asking.config import configure, read_displacements, scenario_problems
from xfemnav.pipeline.asking.scenario import Scenario
from xfemnav.pipeline.keeping.files import read_mesh, read_soup
from xfemnav.pipeline.running.apply import apply
from xfemnav.pipeline.running.result import Result
from xfemnav.pipeline.running.runfile import OutputFolder
from xfemnav_cli.telling import printable

READ = 8192  # bytes of an input at most; a message names every problem of a scenario, and so grows with it
WORDS = ("curveType", "spline", "linear", "Curve", "ClosedCurve", "Fiducial", "Line", "RAS", "LPS", "um", "mm", "UCUM",
         "undefined", "preview", "defined", "true", "null", "NaN", "Infinity", "-0", "1e999", "\\ud800")


def refused_or(read, *arguments, **options):
    """What `read` gives, None where it is refused with a code in one line; anything else that it raises is a bug."""
    try:
        return read(*arguments, **options)
    except XfemnavError as error:
        told = printable(str(error))
        assert error.code in FAULTS and told.isprintable() and len(told) < 10 * READ + 5000, told[:500]
        return None


def fed(name: str, data: bytes) -> bool:
    """Whether the target of that name takes `data`."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what numpy warns of would reach the user's terminal
        warnings.simplefilter("ignore", XfemnavWarning)
        return TARGETS[name](data)


def nifti(data: bytes) -> bool:
    """Whether `data` are read as an image: bit 0 of its first byte packs the rest, bit 1 replaces NaN."""
    choice, content = data[:1] or b"\0", data[1:]
    packed = gzip.compress(content, 1, mtime=0) if choice[0] & 1 else content
    path = _written("image.nii.gz" if choice[0] & 1 else "image.nii", packed)
    image = refused_or(read_image, path, nan=0.0 if choice[0] & 2 else None)
    if image is None:
        return False
    assert np.isfinite(image.values).all() and abs(np.linalg.det(image.affine)) > 0
    assert image.file_digest == content_digest(path)
    for plane in PLANES:
        found = refused_or(take_slice, image, plane=plane, index=0)
        if found is not None:
            np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-9)
            to_nifti(found, found.values)
    return True


def dicom(data: bytes) -> bool:
    """Whether `data` are read as the one slice of a series."""
    path = _written("series/0.dcm", data)
    image = refused_or(read_image, path.parent, nan=0.0, max_memory_gb=0.1)
    if image is None:
        return False
    assert np.isfinite(image.values).all() and abs(np.linalg.det(image.affine)) > 0
    assert image.file_digest == content_digest(path.parent)
    return True


def markups(data: bytes) -> bool:
    """Whether `data` are read as markups or another point file, drawn and as stored."""
    path = _written("cut.mrk.json", data)
    stored, drawn = refused_or(read_control_points, path), refused_or(read_points, path)
    for points in filter(None, (stored, drawn)):
        assert np.isfinite(points.points).all() and len(points.labels) == len(points.points) > 0
    assert stored is None or abs(stored.points).max() <= FARTHEST
    assert drawn is None or stored is not None
    return drawn is not None


def surface(data: bytes) -> bool:
    """Whether `data` are read as a surface; what is read comes back as it was."""
    name, content = _chosen("surface", data)
    found = refused_or(decoded_surface, content, name)
    if found is None:
        return False
    assert abs(found.points).max() <= FARTHEST + 1e3 and len(found.corners) == found.count.sum()
    again = decoded_surface(found.written(found.points, np.ones(len(found.count), bool)), name)
    np.testing.assert_allclose(again.points, found.points, rtol=1e-4, atol=1e-4)
    assert np.array_equal(again.count, found.count)
    return True


def tracts(data: bytes) -> bool:
    """Whether `data` are read as a tractogram, which comes back with as many streamlines."""
    name, content = _chosen("tracts", data)
    file = refused_or(decoded_streamlines, content, name)
    if file is None:
        return False
    again = decoded_streamlines(tract_bytes(file, name[1:]), name)
    assert len(again.streamlines) == len(file.streamlines)
    return True


def table(data: bytes) -> bool:
    """Whether `data` are read as a table of points or of displacements, or as what says where a table counts."""
    name, content = _chosen("table", data)
    if name == "surface.csv":
        rows = refused_or(read_displacements, _written("tables/surface.csv", content))
        assert rows is None or np.isfinite(rows).all()
        return rows is not None
    (FOLDER / "tables" / "sub-1_coordsystem.json").unlink(missing_ok=True)
    path = _written(f"tables/{name}", content)
    if name.endswith(".json"):
        path = _written("tables/sub-1_electrodes.tsv", b"name\tx\ty\tz\nA1\t6\t1\t7\n")
    points = refused_or(read_points, path)
    if points is None:
        return False
    assert np.isfinite(points.points).all() and len(points.labels) == len(points.points) > 0
    write_points(path, points)
    np.testing.assert_allclose(read_points(path).points, points.points, rtol=1e-9, atol=1e-5)
    return True


def vtu(data: bytes) -> bool:
    """Whether `data` are read as the solution of a run or as a user's mesh, in the slice of the run."""
    path, frame = _written("mine.vtu", data), _result().frame
    mesh, soup = refused_or(read_mesh, path, frame), refused_or(read_soup, path, frame)
    assert mesh is None or (np.isfinite(mesh.points).all() and (mesh.volumes > 0).all())
    assert soup is None or soup[0].shape == soup[1].shape
    return mesh is not None or soup is not None


def record(data: bytes) -> bool:
    """Whether `data` are the record of a run that can be applied to points, a surface and an image."""
    folder = _copied()
    (folder / "out" / "run.json").write_bytes(data)
    earlier = OutputFolder(folder / "out", folder / "head.nii.gz").earlier
    assert not any("/" in name or name in ("..", "run.json") for name in earlier)
    found = False
    for step in (None, "one"):
        result = refused_or(Result.load, folder / "out", step)
        for file in () if result is None else (*LATER, folder / "head.nii.gz"):
            found |= refused_or(apply, result, file, FOLDER / "applied", force=True) is not None
    return found


def scenario(data: bytes) -> bool:
    """Whether `data` are a scenario that can run, in a folder with an image, a cut and a table of displacements."""
    path = _written("case.toml", data)
    found = refused_or(configure, scenario=path)
    told = scenario_problems(path)
    assert all(isinstance(line, str) for line in told)
    assert found is None or all(os.path.realpath(file).startswith(os.path.realpath(FOLDER)) for file in
                                found.files.values()), "a scenario named a file outside its folder"
    return found is not None


def seeds(name: str) -> list[bytes]:
    """Good inputs of a target to begin with."""
    return SEEDS[name]()


def words(name: str) -> list[str]:
    """Words that the inputs of a target are made of."""
    if name == "scenario":
        return sorted(set(_keys(Scenario.model_json_schema())))
    if name == "record":
        return sorted(set(_keys(json.loads(seeds(name)[1]))))
    return sorted({*WORDS, *_keys(json.loads(CUT))}) if name == "markups" else []


def _chosen(target: str, data: bytes) -> tuple[str, bytes]:
    """The name of a file that the first byte chooses, and its content."""
    names = KINDS[target]
    return names[data[0] % len(names) if data else 0], data[1:]


@cache
def _result() -> Result:
    return Result.load(Path(finished().name) / "out")


def _written(name: str, content: bytes) -> Path:
    path = FOLDER / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    return path


def _keys(value) -> list[str]:
    """Every key and short text in a JSON value."""
    if isinstance(value, dict):
        return [*value, *(key for inner in value.values() for key in _keys(inner))]
    if isinstance(value, list):
        return [key for inner in value for key in _keys(inner)]
    return [value] if isinstance(value, str) and len(value) < 20 and value else []


@cache
def _copied() -> Path:
    """The finished run once more, for a record of another's."""
    return Path(shutil.copytree(finished().name, FOLDER / "copied", ignore=shutil.ignore_patterns("cache")))


TARGETS = {"nifti": nifti, "dicom": dicom, "markups": markups, "scenario": scenario, "surface": surface,
           "tracts": tracts, "table": table, "vtu": vtu, "record": record}

_KEPT = tempfile.TemporaryDirectory(prefix="xfemnav-fuzz-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
FOLDER = Path(_KEPT.name)
_written("head.nii.gz", seeds("nifti")[0][1:])
_written("cut.mrk.json", CUT.encode())
_written("surface.csv", b"x,y,ux,uy\n-45,0,0,0\n45,0,0,0\n")
#: What a finished run is applied to.
LATER = (_written("points.csv", b"x,y,z,label\n30,-8,10,a\n15,-5,10,b\n"),
         _written("skin.stl", surface_seeds.SEEDS["ascii.stl"]))
