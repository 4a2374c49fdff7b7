"""Small surfaces of every format, written out by hand or by another library: four faces of a pyramid."""

import base64
import lzma
import struct
import zlib

import nibabel
import numpy as np

POINTS = np.array([[10.0, 20, 5], [14, 20, 6], [14, 24, 7], [10, 24, 8.5], [12.25, 22, 15]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [3, 4, 2]])


def rows(values) -> str:
    return "\n".join(" ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in row) for row in values.tolist())


def vtk(points=POINTS, faces=FACES, title="made by hand", more="") -> bytes:
    cells = np.column_stack([np.full(len(faces), 3), faces])
    return (f"# vtk DataFile Version 3.0\n{title}\nASCII\nDATASET POLYDATA\n"
            f"POINTS {len(points)} float\n{rows(points)}\n"
            f"POLYGONS {len(faces)} {cells.size}\n{rows(cells)}\n{more}").encode()


MORE = """CELL_DATA 4
FIELD FieldData 1
id 1 4 int
1 2 3 4
METADATA
INFORMATION 0

POINT_DATA 5
SCALARS curvature float 1
LOOKUP_TABLE default
0 1 2 3 4
LOOKUP_TABLE mine 1
0 .5 1 1
NORMALS Normals float
0 0 1 0 0 1 0 0 1 0 0 1 0 0 1
"""
STRIPS = """# vtk DataFile Version 3.0
strips
ASCII
DATASET POLYDATA
POINTS 6 float
0 0 0 1 0 0 0 1 0 1 1 0 0 2 0 1 2 0
TRIANGLE_STRIPS 2 10
5 0 1 2 3 4
3 2 3 5
CELL_DATA 2
FIELD FieldData 1
strip 1 2 int
5 6
"""
STRIPS_XML = """<VTKFile type="PolyData" byte_order="LittleEndian"><PolyData>
<Piece NumberOfPoints="6" NumberOfStrips="2"><CellData>
<DataArray type="Int32" Name="strip" format="ascii">5 6</DataArray></CellData>
<Points><DataArray type="Float32" NumberOfComponents="3" format="ascii">
0 0 0 1 0 0 0 1 0 1 1 0 0 2 0 1 2 0</DataArray></Points>
<Strips><DataArray type="Int32" Name="connectivity" format="ascii">0 1 2 3 4 2 3 5</DataArray>
<DataArray type="Int32" Name="offsets" format="ascii">5 8</DataArray></Strips></Piece></PolyData></VTKFile>
"""


def vtk5() -> bytes:
    """Binary, of version 5, with the frame as a field."""
    head = b"# vtk DataFile Version 5.1\nx\nBINARY\nDATASET POLYDATA\nFIELD FieldData 1\nSPACE 1 1 string\n\xc3LPS\n"
    return b"".join([head, b"METADATA\nINFORMATION 0\n\n", b"POINTS 5 double\n", POINTS.astype(">f8").tobytes(),
                     b"\nMETADATA\nINFORMATION 0\n\nPOLYGONS 5 12\nOFFSETS vtktypeint64\n",
                     np.arange(0, 13, 3).astype(">i8").tobytes(),
                     b"\nCONNECTIVITY vtktypeint64\n", FACES.astype(">i8").tobytes(),
                     b"\nCELL_DATA 4\nCOLOR_SCALARS c 3\n", bytes(12), b"\n"])


def vtp(form, pack=None, points=POINTS, faces=FACES, wide=False, more=False, encoded=False) -> bytes:
    """PolyData with arrays ascii, binary or appended; `pack` (name, function); with lengths of 8 bytes where `wide`."""
    appended, letter = [], "Q" if wide else "I"

    def block(data: bytes) -> tuple[bytes, bytes]:
        if pack is None:
            return struct.pack(f"<{letter}", len(data)), data
        parts = [pack[1](data[at:at + 40]) for at in range(0, len(data), 40)]
        head = struct.pack(f"<{3 + len(parts)}{letter}", len(parts), 40, len(data) % 40, *map(len, parts))
        return head, b"".join(parts)

    def put(name, values, kind, width=1):
        values = np.asarray(values).astype({"Float64": "<f8", "Float32": "<f4", "Int64": "<i8"}[kind])
        about = f'type="{kind}" Name="{name}" NumberOfComponents="{width}" format="{form}"'
        if form == "ascii":
            return f"<DataArray {about}>{' '.join(map(str, values.ravel().tolist()))}</DataArray>"
        head, data = block(values.tobytes())
        text = base64.b64encode(head + data) if pack is None else base64.b64encode(head) + base64.b64encode(data)
        if form == "binary":
            return f"<DataArray {about}>{text.decode()}</DataArray>"
        at = sum(map(len, appended))
        appended.append(text if encoded else head + data)
        return f'<DataArray {about} offset="{at}"/>'

    data = ""
    if more:
        data = ('<PointData Normals="Normals">' + put("Normals", np.zeros((5, 3)), "Float32", 3)
                + put("curvature", np.arange(5), "Float32") + "</PointData><CellData>"
                + put("id", [1, 2, 3, 4], "Int64") + "</CellData>")
    body = (f"{data}<Points>{put('Points', points, 'Float64', 3)}</Points><Polys>{put('connectivity', faces, 'Int64')}"
            f"{put('offsets', 3 * np.arange(1, len(faces) + 1), 'Int64')}</Polys>")
    space = ('<FieldData><Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">76 80 83 0</Array>'
             "</FieldData>")
    head = ('<?xml version="1.0"?><VTKFile type="PolyData" byte_order="LittleEndian" '
            f'header_type="UInt{64 if wide else 32}"' + (f' compressor="{pack[0]}"' if pack else "")
            + f"><PolyData>{space if more else ''}"
            f'<Piece NumberOfPoints="{len(points)}" NumberOfPolys="{len(faces)}">{body}</Piece></PolyData>')
    if form != "appended":
        return (head + "</VTKFile>").encode()
    return (head + f'<AppendedData encoding="{"base64" if encoded else "raw"}">_').encode() + b"".join(appended) + (
        b"</AppendedData></VTKFile>")


def ply(points=POINTS, faces=FACES, order="", remark="") -> bytes:
    """Points with a normal and a colour, faces with a number; quality before the corners where it is binary."""
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    number = "property uchar number\n"
    head = (f"ply\nformat {form} 1.0\n{remark}element vertex {len(points)}\n"
            + "".join(f"property float {axis}\n" for axis in ("x", "y", "z", "nx", "ny", "nz")) + "property uchar red\n"
            + f"element face {len(faces)}\n" + (number if order else "")
            + "property list uchar int vertex_indices\n" + ("" if order else number) + "end_header\n").encode()
    if not order:
        lines = [f"{' '.join(map(str, point.tolist()))} 0 0 1 200" for point in points]
        lines += [f"3 {' '.join(map(str, face.tolist()))} {10 * k + 10}" for k, face in enumerate(faces)]
        return head + ("\n".join(lines) + "\n").encode()
    vertex = np.zeros(len(points), [("p", order + "f4", 6), ("c", "u1")])
    vertex["p"][:, :3], vertex["c"] = points, 200
    face = np.zeros(len(faces), [("q", "u1"), ("n", "u1"), ("c", order + "i4", 3)])
    face["n"], face["c"] = 3, faces
    return head + vertex.tobytes() + face.tobytes()


def obj() -> bytes:
    lines = ["# SPACE=LPS", "mtllib a.mtl", *("v {} {} {} .1 .2 .3".format(*point) for point in POINTS), "vt 0.5 0.5",
             "vn 0 0 1", "usemtl skin", "f 1/1/1 2/1/1 3/1/1", "f 1/1/1 3/1/1 4/1/1", "f 1//1 4//1 2//1", "f -2 -1 -3"]
    return "\n".join(lines).encode() + b"\n"


def stl(title=b"") -> bytes:
    facets = np.zeros(len(FACES), [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
    facets["c"], facets["a"] = POINTS[FACES], np.arange(len(FACES)) + 6
    return title.ljust(80, b"\0") + struct.pack("<I", len(facets)) + facets.tobytes()


def stl_text() -> bytes:
    corners = ["".join(f"  vertex {rows(corner[None])}\n" for corner in face) for face in POINTS[FACES]]
    facets = [f"facet normal 0 0 1\n outer loop\n{three} endloop\nendfacet\n" for three in corners]
    return f"solid one\n{facets[0]}{facets[1]}endsolid one\nsolid two\n{facets[2]}{facets[3]}endsolid two\n".encode()


def gii(space=0, target=0, matrix=None, about=(), triangles=1) -> bytes:
    arrays = [nibabel.gifti.GiftiDataArray(POINTS.astype("f4"), "NIFTI_INTENT_POINTSET", meta=dict(about))]
    system = arrays[0].coordsys
    system.dataspace, system.xformspace = space, target
    system.xform = np.eye(4) if matrix is None else matrix
    arrays += [nibabel.gifti.GiftiDataArray(FACES.astype("i4"), "NIFTI_INTENT_TRIANGLE") for _ in range(triangles)]
    return nibabel.gifti.GiftiImage(darrays=arrays).to_bytes()


ZLIB, LZMA = ("vtkZLibDataCompressor", zlib.compress), ("vtkLZMADataCompressor", lzma.compress)
LPS = b"3D Slicer output. SPACE=LPS"
#: By name; "lps" in it: the file says so.
SEEDS = {
    "ascii.stl": stl_text(), "binary/ras.stl": stl(b"solid but binary"), "binary/lps.stl": stl(LPS),
    "ascii/ras.vtk": vtk(), "ascii/full.vtk": vtk(more=MORE), "ascii/lps.vtk": vtk(title=LPS.decode()),
    "binary/lps.vtk": vtk5(),
    "ascii/lps.vtp": vtp("ascii", more=True), "binary/ras.vtp": vtp("binary"),
    "zlib/lps.vtp": vtp("binary", ZLIB, more=True),
    "lzma/lps.vtp": vtp("binary", LZMA, wide=True, more=True), "raw/lps.vtp": vtp("appended", more=True),
    "raw-zlib/lps.vtp": vtp("appended", ZLIB, wide=True, more=True),
    "base64/lps.vtp": vtp("appended", ZLIB, more=True, encoded=True),
    "mni.gii": gii(space=4), "lps.obj": obj(),
    "ascii/lps.ply": ply(remark="comment SPACE=LPS\n"), "binary/little.ply": ply(order="<"),
    "binary/big.ply": ply(order=">"),
}
