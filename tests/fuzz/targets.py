"""What a fuzzer may feed: bytes as a file, read as a run reads it. Only coded errors and right values may come out."""

import gzip
import io
import json
import os
import tempfile
import warnings
from pathlib import Path

import nibabel
import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    MRImageStorage,
    RLELossless,
)

from tests.fuzz import surface_seeds
from xfemnav.errors import FAULTS, XfemnavError, XfemnavWarning
from xfemnav.imaging.point_files import read_control_points, read_points
from xfemnav.imaging.points import FARTHEST
from xfemnav.imaging.reading import content_digest, read_image
from xfemnav.imaging.slices import PLANES, take_slice, to_nifti
from xfemnav.imaging.surface_files import decoded_surface
from xfemnav.imaging.tract_files import decoded_streamlines, tract_bytes
from xfemnav.imaging.vtk_grid import grid
from xfemnav.pipeline.config import configure, scenario_problems
from xfemnav.pipeline.scenario import Scenario
from xfemnav_cli.telling import printable

READ = 8192  # bytes of an input at most; a message names every problem of a scenario, and so grows with it
AFFINE = np.array([[-0.9, 0.1, 0, 40], [0.1, 0.9, 0, -50], [0, 0, 2.0, 7], [0, 0, 0, 1]])
CUT = ('{"@schema": "x-v1.0.3.json#", "markups": [{"type": "Line", "name": "F", "coordinateSystem": "LPS", '
       '"coordinateUnits": "mm", "controlPoints": [{"label": "a", "position": [60, -10, 7], "positionStatus": '
       '"defined"}, {"position": [1.5e1, -5, 7.0]}, {"position": [5, 9, 7]}]}]}')
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
    """Whether `data` are read as a surface, or a mesh or tractogram; their first byte says of which kind, and what is
    read comes back as it was."""
    name, content = KINDS[data[0] % len(KINDS)] if data else KINDS[0], data[1:]
    if name.endswith(".vtu"):
        return refused_or(grid, content, name, ("displacement",)) is not None
    if name.endswith((".trk", ".tck", ".gz")):
        file = refused_or(decoded_streamlines, content, name)
        if file is None:
            return False
        again = decoded_streamlines(tract_bytes(file, name[1:]), name)
        assert len(again.streamlines) == len(file.streamlines)
        return True
    found = refused_or(decoded_surface, content, name)
    if found is None:
        return False
    assert abs(found.points).max() <= FARTHEST + 1e3 and len(found.corners) == found.count.sum()
    again = decoded_surface(found.written(found.points, np.ones(len(found.count), bool)), name)
    np.testing.assert_allclose(again.points, found.points, rtol=1e-4, atol=1e-4)
    assert np.array_equal(again.count, found.count)
    return True


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
    return sorted({*WORDS, *_keys(json.loads(CUT))}) if name == "markups" else []


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


def _nifti_seeds() -> list[bytes]:
    values = np.arange(24, dtype=np.int16).reshape(4, 3, 2)
    found = []
    for kind in (nibabel.Nifti1Image, nibabel.Nifti2Image):
        for dtype in (np.uint8, np.int16, np.float32):
            image = kind(values.astype(dtype), AFFINE)
            image.set_qform(AFFINE, code=1)
            image.header.set_xyzt_units("mm")
            found += [bytes([choice]) + image.to_bytes() for choice in (0, 1, 2)]
        found.append(b"\0" + kind(np.stack([values, values], -1), AFFINE).to_bytes())
    return found


def _dicom_seeds() -> list[bytes]:
    return [_dicom(syntax, dtype) for syntax in (ImplicitVRLittleEndian, ExplicitVRLittleEndian, ExplicitVRBigEndian,
                                                 DeflatedExplicitVRLittleEndian, RLELossless) for dtype in ("u1", "i2")]


def _dicom(syntax, dtype: str) -> bytes:
    """One slice of 6 x 4 pixels, with a nested sequence, MONOCHROME1, slope and intercept."""
    plane, item, file = Dataset(), Dataset(), io.BytesIO()
    plane.file_meta = FileMetaDataset()
    plane.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian if syntax == RLELossless else syntax
    plane.SOPClassUID, plane.SOPInstanceUID, plane.SeriesInstanceUID = MRImageStorage, "1.2.3", "1.2.4"
    item.ReferencedSOPClassUID = MRImageStorage
    plane.ReferencedStudySequence = [item]
    plane["ReferencedStudySequence"].is_undefined_length = True
    plane.ImagePositionPatient, plane.ImageOrientationPatient = [1, 2, 3], [1, 0, 0, 0, 1, 0]
    plane.PixelSpacing, plane.SliceThickness, plane.RescaleSlope, plane.RescaleIntercept = [1, 2], 3, "0.5", "-7"
    plane.Rows, plane.Columns, plane.SamplesPerPixel, plane.PhotometricInterpretation = 4, 6, 1, "MONOCHROME1"
    plane.BitsAllocated = plane.BitsStored = 8 * np.dtype(dtype).itemsize
    plane.HighBit, plane.PixelRepresentation = plane.BitsStored - 1, int(dtype == "i2")
    plane.PixelData = np.arange(24).astype((">" if syntax == ExplicitVRBigEndian else "<") + dtype).tobytes()
    plane["PixelData"].VR = "OW"
    if syntax == RLELossless:
        plane.compress(RLELossless)
    plane.save_as(file, enforce_file_format=True)
    return file.getvalue()


def _markups_seeds() -> list[bytes]:
    table = b"x,y,z,label\n60,-10,7,a\n15,-5,7,b\n"
    fcsv = b"# CoordinateSystem = LPS\n# columns = id,x,y,z,label\n1,60,-10,7,a\n2,15,-5,7,b\n"
    tag = b'MNI Tag Point File\nVolumes = 1;\nPoints =\n 1 2 3 "a"\n 4 5 6 "b";\n'
    others = [CUT.replace("Line", kind).encode() for kind in ("Curve", "ClosedCurve", "Fiducial")]
    return [CUT.encode(), *others, CUT.replace("LPS", "RAS").encode(), table, fcsv, tag]


def _scenario_seeds() -> list[bytes]:
    head = 'xfemnav = 1\nimage = "head.nii.gz"\n'
    cut = '[[cut]]\nname = "a"\npoints = [[-60, 10], [-15, 5]]\n'
    whole = (head + 'space = "lps"\nnan = 0\n[slice]\nplane = "axial"\nindex = 0\n' + cut +
             '[[cut]]\nname = "b"\nmarkups = "cut.mrk.json"\ncraniotomy = false\n'
             '[[retract]]\nname = "r"\ncut = "a"\nside = "left"\ndisplacement_mm = [3.5, 1.0]\nblade = [0.0, 0.8]\n'
             '[[resect]]\nname = "t"\noutline = [[0, 0], [9, 0], [0, 9]]\n'
             '[[companion]]\nimage = "head.nii.gz"\nkind = "label"\n'
             '[tissue]\nlabels = "head.nii.gz"\n[tissue.by_label.7]\nyoung_kpa = 9.0\n'
             '[boundary]\nskull = "contact"\ndisplacement = "surface.csv"\n'
             '[[boundary.arc]]\nstart = [0, 50]\nend = [-50, 0]\nskull = "free"\n'
             '[load]\ngravity = [0.0, -1.0]\n[[load.pressure]]\nname = "p"\non = "t"\nkpa = 0.5\n'
             '[mesh]\nelement_size_mm = 8\n[solve]\nmodel = "neo-hookean"\n[warp]\ninterp = "cubic"\n'
             '[[step]]\nname = "one"\nacts = ["a"]\n[[step]]\nname = "two"\nacts = ["r", "t"]\nframe = "current"\n')
    return [text.encode() for text in (head + cut, whole, head + '[[cut]]\nmarkups = "cut.mrk.json"\nsmooth = true\n',
                                       head + '[boundary]\ndisplacement = "surface.csv"\n')]


def _surface_seeds() -> list[bytes]:
    lines = [np.arange(9, dtype=np.float32).reshape(3, 3), np.ones((2, 3), np.float32)]
    tracts = nibabel.streamlines.Tractogram(lines, affine_to_rasmm=np.eye(4))
    found = [(f".{name.rpartition('.')[2]}", content) for name, content in surface_seeds.SEEDS.items()]
    found.append((".vtu", b"""<VTKFile type="UnstructuredGrid"><UnstructuredGrid>
<Piece NumberOfPoints="3" NumberOfCells="1"><Points>
<DataArray type="Float64" NumberOfComponents="3">0 0 0 1 0 0 0 1 0</DataArray></Points><Cells>
<DataArray type="Int64" Name="connectivity">0 1 2</DataArray><DataArray type="Int64" Name="offsets">3</DataArray>
<DataArray type="UInt8" Name="types">5</DataArray></Cells></Piece></UnstructuredGrid></VTKFile>"""))
    for kind, ending in ((nibabel.streamlines.TrkFile, ".trk"), (nibabel.streamlines.TckFile, ".tck")):
        kind(tracts).save(stream := io.BytesIO())
        found.append((ending, stream.getvalue()))
    found.append((".trk.gz", gzip.compress(found[-2][1], mtime=0)))
    return [bytes([KINDS.index(f"a{ending}")]) + content for ending, content in found]


#: Names of files that the target of surfaces takes.
KINDS = [f"a{ending}" for ending in (".stl", ".vtk", ".vtp", ".gii", ".obj", ".ply", ".vtu", ".trk", ".tck", ".trk.gz")]
TARGETS = {"nifti": nifti, "dicom": dicom, "markups": markups, "scenario": scenario, "surface": surface}
SEEDS = {"nifti": _nifti_seeds, "dicom": _dicom_seeds, "markups": _markups_seeds, "scenario": _scenario_seeds,
         "surface": _surface_seeds}

_KEPT = tempfile.TemporaryDirectory(prefix="xfemnav-fuzz-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
FOLDER = Path(_KEPT.name)
_written("head.nii.gz", _nifti_seeds()[0][1:])
_written("cut.mrk.json", CUT.encode())
_written("surface.csv", b"x,y,ux,uy\n-45,0,0,0\n45,0,0,0\n")
