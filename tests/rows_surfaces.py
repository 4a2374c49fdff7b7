"""Rows of tracts and surfaces; see `tests/rows.py`."""

import base64
import gzip
import io
import struct
import warnings
import zlib
from pathlib import Path

import nibabel as nib
import numpy as np
from nibabel.streamlines import TckFile, Tractogram, TrkFile
from small import CUT, brain, write

import xfemnav
from tests.fuzz.surface_seeds import SEEDS, stl, vtp
from tests.rows import Row
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.points.surface_files import read_surface
from xfemnav.imaging.points.tract_files import read_streamlines
from xfemnav.pipeline.running.apply import apply

LINE = np.array([[-30.0, -10, 10], [-30, 30, 10]])
HEADER = {"voxel_to_rasmm": np.diag([2.0, 2, 2, 1]), "dimensions": (90, 90, 90), "voxel_sizes": (2, 2, 2),
          "voxel_order": "RAS"}


def run(folder: Path, **flags):
    """A small run, and the warnings that came of it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = xfemnav.run(write(folder / "head.nii.gz"), cut=CUT, opening_mm=4.0, blade="0,0.6",
                             element_size_mm=8.0, corridor_element_mm=4.0, report=False, output=folder / "out",
                             cache=folder / "cache", **flags)
    return result, caught


def tract(folder: Path, *places) -> Path:
    """A .trk whose header has zeros at the `places` (start, length)."""
    path = folder / "tract.trk"
    TrkFile(Tractogram([LINE], affine_to_rasmm=np.eye(4)), HEADER).save(path)
    content = bytearray(path.read_bytes())
    for start, n in places:
        content[start:start + n] = bytes(n)
    path.write_bytes(content)
    return path


def refused(read, *arguments) -> XfemnavError:
    try:
        read(*arguments)
    except XfemnavError as error:
        return error
    raise AssertionError("it was not refused")


def a13_unplaced_tracts(folder: Path):
    path = tract(folder, (440, 64))
    result, caught = run(folder, streamlines=(str(path),))
    told = [item for item in result.record["warnings"] if item["code"] == "W115"]
    assert len(told) == 1 and "vox_to_ras" in told[0]["text"]
    assert all(issubclass(item.category, XfemnavWarning) for item in caught)
    strict = refused(lambda: run(folder, streamlines=(str(path),), strict=True))
    assert strict.code == "W115"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        later = apply(result, path, folder / "later")
    assert sorted(item.code for item in later.warnings) == ["W115", "W132"]  # where it was put it lies off the slice
    return "told in run.json, by apply and to --strict, once each", "W115"


def a13_voxel_order(folder: Path):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_streamlines(tract(folder, (948, 4)))
    assert [item.message.code for item in caught] == ["W115"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_streamlines(tract(folder))
    return "told; a whole header is not", "W115"


def b_trk_gz(folder: Path):
    path = tract(folder)
    packed = folder / "tract.trk.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    result, _ = run(folder, streamlines=(str(packed),))
    made = folder / "out" / result.record["outputs"]["streamlines"]
    moved = TrkFile.load(io.BytesIO(gzip.decompress(made.read_bytes()))).streamlines
    assert made.name.endswith(".trk.gz") and len(moved) == 2    # the cut parts it
    return f"{len(moved)} parts in {made.name}", ""


def b_two_counts(folder: Path):
    path = folder / "a.tck"
    TckFile(Tractogram([LINE, LINE + 1], affine_to_rasmm=np.eye(4))).save(path)
    head, data = path.read_bytes().split(b"END\n", 1)
    head = head.replace(b"count: 0000000002", b"count: 0000001000\ncount: 0000000002")
    head = head[: head.index(b"file:")] + b"file: . "
    path.write_bytes(head + f"{len(head) + 8:03}\nEND\n".encode() + data)
    assert len(read_streamlines(path).streamlines) == 2
    return "read: 2 streamlines", ""


def b_others(folder: Path):
    result, _ = run(folder)
    for name in ("a.trx", "a.pdf", "a.vtu"):
        (folder / name).write_bytes(b"PK\3\4 something")
        error = refused(apply, result, folder / name, folder / "new")
        named = (".mrk.json", ".trk.gz", ".stl", "NIfTI")
        assert error.code == "E106" and all(ending in error.message for ending in named)
    assert refused(read_streamlines, folder / "a.trx").code == "E701"
    return "the message lists what is carried, by ending", "E106"


def b_surfaces(folder: Path):
    name = {"a.stl": "binary/lps.stl", "b.vtk": "binary/lps.vtk", "c.vtp": "raw-zlib/lps.vtp", "d.gii": "mni.gii",
            "e.obj": "lps.obj", "f.ply": "binary/big.ply"}
    for file, seed in name.items():
        (folder / file).write_bytes(SEEDS[seed])
    result, _ = run(folder, surfaces=tuple(str(folder / file) for file in name))
    outputs = [file for role, file in result.record["outputs"].items() if role.startswith("surfaces")]
    assert len(outputs) == len(result.record["surfaces"]) == 6
    for file, made in zip(name, outputs):
        before, after = read_surface(folder / file), read_surface(folder / "out" / made)
        wanted = result.to_current(before.points)
        wanted = np.where(np.isfinite(wanted), wanted, before.points)
        order = [np.lexsort(np.rint(points * 1e3).T) for points in (wanted, after.points)]
        assert abs(wanted[order[0]] - after.points[order[1]]).max() < 1e-4 and after.frame == before.frame
    return "6 formats: points are within 1e-4 mm of their tissue, in their file's frame", ""


def b_frame(folder: Path):
    # A ball on the patient's left, in LPS, in a file that does not say so: as RAS it lies outside.
    unit = np.random.default_rng(1).normal(size=(20, 3, 3))
    facets = np.array([90.0, 0, 10]) + 8 * unit / np.linalg.norm(unit, axis=2, keepdims=True)
    content = stl()[:80] + struct.pack("<I", 20) + b"".join(
        bytes(12) + (facet * [-1, -1, 1]).astype("<f4").tobytes() + bytes(2) for facet in facets)
    (folder / "a.stl").write_bytes(content)
    affine = np.diag([2.0, 2, 2, 1])
    affine[:3, 3] = 37 - 10, -71, 10    # the brain about (90, 0)
    write(folder / "moved.nii.gz", brain(), affine)
    codes = []
    for space in ("ras", "lps"):
        cut = "30,10 75,5" if space == "ras" else "-30,-10 -75,-5"
        with warnings.catch_warnings(record=True):
            warnings.simplefilter("always")
            result = xfemnav.run(folder / "moved.nii.gz", cut=cut, opening_mm=4.0, element_size_mm=8.0, space=space,
                                 corridor_element_mm=4.0, report=False, output=folder / space, cache=folder / "cache",
                                 surfaces=(str(folder / "a.stl"),))
        codes.append([item["code"] for item in result.record["warnings"] if item["code"] == "W131"])
    assert codes == [["W131"], []]
    return "W131 as RAS, none with --space lps", "W131"


def b_vtu(folder: Path):
    from xfemnav.pipeline.keeping.files import read_vtu

    path = folder / "a.vtu"
    grid = vtp("binary").replace(b"PolyData", b"UnstructuredGrid")
    grid = grid.replace(b'NumberOfPolys="4"', b'NumberOfCells="4"')
    path.write_bytes(grid.replace(b"<VTKFile", b'<VTKFile compressor="vtkLZ4DataCompressor"'))
    lz4 = refused(read_vtu, path, "E209")
    (folder / "a.vtp").write_bytes(vtp("ascii"))
    poly = refused(read_vtu, folder / "a.vtp", "E209")
    assert "vtkLZ4DataCompressor" in lz4.message and "PolyData" in poly.message and ".vtu" in poly.message
    assert "damaged" not in lz4.message + poly.message and {lz4.code, poly.code} == {"E209"}
    return "the compressor, and the kind, and how to write it", "E209"


def b_bomb(folder: Path):
    from xfemnav.pipeline.keeping.files import read_vtu

    block, n = 3 << 20, 1000    # 3 GB
    packed = zlib.compress(bytes(block), 9)
    head = struct.pack(f"<{3 + n}I", n, block, 0, *[len(packed)] * n)
    content = (f'<VTKFile type="UnstructuredGrid" compressor="vtkZLibDataCompressor"><UnstructuredGrid><Piece '
               f'NumberOfPoints="{block * n // 24}" NumberOfCells="0"><Points><DataArray type="Float64" '
               'NumberOfComponents="3" format="binary">').encode()
    content += base64.b64encode(head) + base64.b64encode(packed * n)
    path = folder / "bomb.vtu"
    path.write_bytes(content + b"</DataArray></Points><Cells/></Piece></UnstructuredGrid></VTKFile>")
    assert refused(read_vtu, path, "E209").code == "E102"
    return f"{path.stat().st_size / 1e6:.1f} MB that unpack to {block * n / 1e9:.1f} GB: refused, unread", "E102"


def b_gifti(folder: Path):
    centre = np.array([5.0, -18.0, 20.0])
    points = np.array([[-30.0, 10, 8], [-20, 12, 10], [-25, 20, 14]])
    about = {f"VolGeomC_{axis}": str(x) for axis, x in zip("RAS", centre)}
    array = nib.gifti.GiftiDataArray((points - centre).astype("f4"), "NIFTI_INTENT_POINTSET", meta=about)
    array.coordsys.dataspace = 0
    faces = nib.gifti.GiftiDataArray(np.array([[0, 1, 2]], "i4"), "NIFTI_INTENT_TRIANGLE")
    nib.save(nib.gifti.GiftiImage(darrays=[array, faces]), folder / "lh.pial.gii")
    found = read_surface(folder / "lh.pial.gii")
    off = abs(found.points - points).max()
    assert off < 1e-5 and "tkregister" in found.frame
    return f"{found.frame}; {off:.0e} mm off", ""


ROWS = [
    Row("A13", ".trk without vox_to_ras", "only a library's own warning; --strict passes", a13_unplaced_tracts),
    Row("A13", ".trk without voxel_order", "only a library's own warning", a13_voxel_order),
    Row("B", ".trk.gz given to run", "'no image'", b_trk_gz),
    Row("B", "two count lines in a .tck", "'damaged'", b_two_counts),
    Row("B", ".trx, .pdf, .vtu given to apply", "'no image'", b_others),
    Row("B", "surfaces of six formats", "'no image', or the interpreter ends", b_surfaces),
    Row("B", "an STL in LPS that does not say so", "not read", b_frame),
    Row("B", "a FreeSurfer surface in GIfTI", "not read", b_gifti),
    Row("B", "LZ4 VTU, .vtp as --mesh", "'damaged' with a KeyError", b_vtu),
    Row("E8", "a small VTU that unpacks to 3 GB", "3 GB of memory", b_bomb),
]
