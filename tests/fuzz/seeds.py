"""Good inputs of every target of the fuzzer, written out by hand or by another library, and small."""

import gzip
import io
import json
import tempfile
from functools import cache
from pathlib import Path

import meshio
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

import xfemnav
from tests.fuzz import surface_seeds
from tests.small import write

AFFINE = np.array([[-0.9, 0.1, 0, 40], [0.1, 0.9, 0, -50], [0, 0, 2.0, 7], [0, 0, 0, 1]])
CUT = ('{"@schema": "x-v1.0.3.json#", "markups": [{"type": "Line", "name": "F", "coordinateSystem": "LPS", '
       '"coordinateUnits": "mm", "controlPoints": [{"label": "a", "position": [60, -10, 7], "positionStatus": '
       '"defined"}, {"position": [1.5e1, -5, 7.0]}, {"position": [5, 9, 7]}]}]}')
#: Names of files that a target takes: the first byte of an input says which of them it is.
KINDS = {
    "surface": ("a.stl", "a.vtk", "a.vtp", "a.gii", "a.obj", "a.ply"),
    "tracts": ("a.trk", "a.tck", "a.trk.gz"),
    "table": ("a.csv", "a.tsv", "a.fcsv", "a.tag", "sub-1_coordsystem.json", "surface.csv"),
}


def nifti() -> list[bytes]:
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


def dicom() -> list[bytes]:
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


def markups() -> list[bytes]:
    table = b"x,y,z,label\n60,-10,7,a\n15,-5,7,b\n"
    fcsv = b"# CoordinateSystem = LPS\n# columns = id,x,y,z,label\n1,60,-10,7,a\n2,15,-5,7,b\n"
    tag = b'MNI Tag Point File\nVolumes = 1;\nPoints =\n 1 2 3 "a"\n 4 5 6 "b";\n'
    others = [CUT.replace("Line", kind).encode() for kind in ("Curve", "ClosedCurve", "Fiducial")]
    return [CUT.encode(), *others, CUT.replace("LPS", "RAS").encode(), table, fcsv, tag]


def scenario() -> list[bytes]:
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


def surface() -> list[bytes]:
    found = [(f"a.{name.rpartition('.')[2]}", content) for name, content in surface_seeds.SEEDS.items()]
    return [_named("surface", name, content) for name, content in found]


def tracts() -> list[bytes]:
    lines = [np.arange(9, dtype=np.float32).reshape(3, 3), np.ones((2, 3), np.float32)]
    found = {}
    for kind in (nibabel.streamlines.TrkFile, nibabel.streamlines.TckFile):
        tractogram = nibabel.streamlines.Tractogram(lines, affine_to_rasmm=np.eye(4))
        kind(tractogram).save(stream := io.BytesIO())
        found["a.trk" if kind is nibabel.streamlines.TrkFile else "a.tck"] = stream.getvalue()
    found["a.trk.gz"] = gzip.compress(found["a.trk"], mtime=0)
    return [_named("tracts", name, content) for name, content in found.items()]


def table() -> list[bytes]:
    found = [
        ("a.csv", "x,y,z,label\n60,-10,7,a\n15,-5,7,b\n"),
        ("a.csv", "l;p;s;defined;label\n60;-10;7;1;a\n0;0;0;0;b\n"),
        ("a.tsv", "name\tx\ty\tz\tsize\nA1\t60\t10\t7\t5\nA2\tn/a\tn/a\tn/a\t5\n"),
        ("a.fcsv", "# CoordinateSystem = LPS\n# columns = id,x,y,z,label\n1,60,-10,7,a\n2,15,-5,7,b\n"),
        ("a.tag", 'MNI Tag Point File\nVolumes = 2;\nPoints =\n 1 2 3 4 5 6 "a"\n 4 5 6 7 8 9 1 2 3 "b";\n'),
        ("sub-1_coordsystem.json", '{"iEEGCoordinateSystem": "ACPC", "iEEGCoordinateUnits": "cm"}'),
        ("surface.csv", "x,y,ux,uy,side\n-45,0,0,0,1\n45,0,1,0,-1\n"),
    ]
    return [_named("table", name, text.encode()) for name, text in found]


def vtu() -> list[bytes]:
    """Two triangles with displacements in every form that meshio writes, and one triangle by hand."""
    mesh = meshio.Mesh([[0, 0, 10], [4, 0, 10], [0, 4, 10], [4, 4.5, 10]], [("triangle", [[0, 1, 2], [1, 3, 2]])],
                       {"displacement": np.arange(12).reshape(4, 3) / 8}, {"part": [[1, 2]]})
    found = [b"""<VTKFile type="UnstructuredGrid"><UnstructuredGrid>
<Piece NumberOfPoints="3" NumberOfCells="1"><Points>
<DataArray type="Float64" NumberOfComponents="3">0 0 10 1 0 10 0 1 10</DataArray></Points><Cells>
<DataArray type="Int64" Name="connectivity">0 1 2</DataArray><DataArray type="Int64" Name="offsets">3</DataArray>
<DataArray type="UInt8" Name="types">5</DataArray></Cells></Piece></UnstructuredGrid></VTKFile>"""]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.vtu"
        for options in ({"binary": False}, {"compression": None}, {"compression": "zlib"}, {"compression": "lzma"}):
            meshio.vtu.write(path, mesh, **options)
            found.append(path.read_bytes())
    return found


def record() -> list[bytes]:
    """run.json of a finished run in two steps, as it is and as one that is not trusted."""
    whole = json.loads((Path(finished().name) / "out" / "run.json").read_text())
    shown = {key: whole[key] for key in sorted(whole.keys() - {"stages", "checks", "matrix", "mesh", "model"})}
    doubted = shown | {"status": "untrusted", "error": {"code": "E401", "text": "it folds"}}
    return [json.dumps(item, separators=(",", ":")).encode() for item in (shown, doubted)]


OPERATION = """xfemnav = 1
image = "head.nii.gz"
[mesh]
element_size_mm = 10
corridor_element_mm = 6
[[cut]]
name = "a"
points = [[-60, 10], [-15, 5]]
[[retract]]
name = "b"
cut = "a"
side = "left"
normal_mm = 3
[[step]]
name = "one"
acts = ["a"]
[[step]]
name = "two"
acts = ["b"]
"""


@cache
def finished() -> tempfile.TemporaryDirectory:
    """A folder with head.nii.gz, case.toml, and out, the run of them in two steps, with its cache."""
    kept = tempfile.TemporaryDirectory(prefix="xfemnav-finished-")
    folder = Path(kept.name)
    write(folder / "head.nii.gz")
    (folder / "case.toml").write_text(OPERATION)
    xfemnav.run(scenario=folder / "case.toml", output=folder / "out", cache=folder / "cache", report=False)
    return kept


def _named(target: str, name: str, content: bytes) -> bytes:
    return bytes([KINDS[target].index(name)]) + content


SEEDS = {"nifti": nifti, "dicom": dicom, "markups": markups, "scenario": scenario, "surface": surface,
         "tracts": tracts, "table": table, "vtu": vtu, "record": record}
