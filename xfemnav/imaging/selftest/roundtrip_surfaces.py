"""The known scene as surfaces, through every format: written by other programs' libraries, and ours read by them.

meshio and nibabel know .stl, .obj, .ply and .gii. Nobody here knows PolyData: .vtk and .vtp are written out by hand.
"""

import re
from pathlib import Path

import meshio
import nibabel
import numpy as np

from xfemnav.imaging.carrying.surfaces import move_surface
from xfemnav.imaging.points.surface_files import read_surface
from xfemnav.imaging.reading.content import silenced
from xfemnav.imaging.selftest.known import FROM_CUT, HALF, OBLIQUE, Mismatch, agree
from xfemnav.imaging.selftest.scenes import scene_motion, scene_slice

LPS = np.array([-1.0, -1.0, 1.0])
CENTRE = np.array([3.0, -4.0, 5.0])  # mm, of the volume that a FreeSurfer surface counts from
TOLERANCE = 1e-4  # mm: float32 and texts of 100 mm


def check_surfaces(folder: Path) -> None:
    """Faces on both sides of the cut, and one across it, which is left out."""
    # Points well within the halves, and faces between neighbours of one row or column.
    x = np.array([FROM_CUT - HALF, -FROM_CUT, FROM_CUT, HALF - FROM_CUT])
    plane = np.array([(a, b) for b in (-8.0, 3.0) for a in x])
    faces = np.array([[0, 1, 4], [1, 5, 4], [2, 3, 6], [3, 7, 6], [1, 2, 5]])
    off = 2.0 * OBLIQUE.turn[:, 2]
    frame = scene_slice(OBLIQUE)
    motion = scene_motion(OBLIQUE, frame)
    rest, now = OBLIQUE.world(plane) + off, OBLIQUE.world(OBLIQUE.now(plane)) + off
    for name, (write, read, space) in FILES.items():
        write(folder / name, rest, faces)
        surface = read_surface(folder / name, space=space)
        agree(f"the points of {name}", _sorted(surface.points), _sorted(rest), TOLERANCE)
        moved = move_surface(surface, frame, motion, motion.rest)
        if moved.left_out != {"on a cut": 1, "resected": 0, "at the outline": 0}:
            raise Mismatch(f"of {name} faces are left out: {moved.left_out}")
        (folder / f"out-{name}").write_bytes(moved.content)
        points, left = read(folder / f"out-{name}")
        agree(f"the moved corners of {name}", _sorted(points[left].reshape(-1, 3)),
              _sorted(now[faces[:4]].reshape(-1, 3)), TOLERANCE)


def _sorted(points) -> np.ndarray:
    """Rows in an order of their own: formats may number points anew."""
    points = np.asarray(points, float)
    return points[np.lexsort(np.rint(points / (10 * TOLERANCE)).T)]


def _meshio(kind: str, signs, **options):
    """How meshio writes a kind of file, in which points have these signs against RAS, and reads it."""
    def write(path, points, faces):
        with silenced():
            meshio.Mesh(points * signs, [("triangle", faces.astype("i4"))]).write(path, file_format=kind, **options)

    def read(path):
        with silenced():
            found = getattr(meshio, kind).read(path)
        return found.points * signs, found.get_cells_type("triangle")

    return write, read


def _write_gii(path, points, faces) -> None:
    """As FreeSurfer: points count from the centre of its volume, which the metadata tell."""
    about = {f"VolGeomC_{axis}": str(x) for axis, x in zip("RAS", CENTRE)}
    arrays = [nibabel.gifti.GiftiDataArray((points - CENTRE).astype("f4"), "NIFTI_INTENT_POINTSET", meta=about),
              nibabel.gifti.GiftiDataArray(faces.astype("i4"), "NIFTI_INTENT_TRIANGLE")]
    arrays[0].coordsys.dataspace = 0
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), path)


def _read_gii(path):
    image = nibabel.load(path)
    return image.agg_data("pointset") + CENTRE, image.agg_data("triangle")


def _write_vtk(path, points, faces) -> None:
    rows = "\n".join(" ".join(f"{x:.7f}" for x in point) for point in points * LPS)
    cells = "\n".join(" ".join(map(str, [3, *face])) for face in faces)
    path.write_text(f"# vtk DataFile Version 4.2\n3D Slicer output. SPACE=LPS\nASCII\nDATASET POLYDATA\n"
                    f"POINTS {len(points)} double\n{rows}\nPOLYGONS {len(faces)} {4 * len(faces)}\n{cells}\n")


def _read_vtk(path):
    text = path.read_text()
    points, cells = (_numbers(found) for found in re.search(
        r"POINTS \d+ double\n(.*)POLYGONS \d+ \d+\n(.*)", text, re.DOTALL).groups())
    return points.reshape(-1, 3) * LPS, cells.reshape(-1, 4)[:, 1:].astype(int)


VTP = """<?xml version="1.0"?>
<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64"><PolyData>
<FieldData><Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">76 80 83 0</Array></FieldData>
<Piece NumberOfPoints="{}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" NumberOfPolys="{}">
<Points><DataArray type="Float64" Name="Points" NumberOfComponents="3" format="ascii">{}</DataArray></Points>
<Polys><DataArray type="Int64" Name="connectivity" format="ascii">{}</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">{}</DataArray></Polys></Piece></PolyData></VTKFile>
"""


def _write_vtp(path, points, faces) -> None:
    texts = (" ".join(map(str, np.ravel(values).tolist())) for values in (
        np.round(points * LPS, 7), faces, 3 * np.arange(1, len(faces) + 1)))
    path.write_text(VTP.format(len(points), len(faces), *texts))


def _read_vtp(path):
    points, corners = (re.search(rf'Name="{name}"[^>]*>([^<]*)<', path.read_text())[1] for name in (
        "Points", "connectivity"))
    return _numbers(points).reshape(-1, 3) * LPS, _numbers(corners).reshape(-1, 3).astype(int)


def _numbers(text: str) -> np.ndarray:
    return np.array(text.split(), float)


#: Name of a file: how it is written and read by others, and the frame that its reader is told.
FILES = {
    "binary.stl": (*_meshio("stl", 1.0, binary=True), "ras"),
    "lps.stl": (*_meshio("stl", LPS, binary=False), "lps"),
    "lps.obj": (*_meshio("obj", LPS), "lps"),
    "binary.ply": (*_meshio("ply", 1.0, binary=True), "ras"),
    "lps.ply": (*_meshio("ply", LPS, binary=False), "lps"),
    "freesurfer.gii": (_write_gii, _read_gii, "lps"),  # it says its own
    "slicer.vtk": (_write_vtk, _read_vtk, "ras"),
    "slicer.vtp": (_write_vtp, _read_vtp, "ras"),
}
