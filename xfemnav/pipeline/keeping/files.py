"""Public files: meshes as VTU, written through meshio, and images as NIfTI.

meshio is unmaintained: it only writes, here and where the doctor looks at surfaces. What users give is read by
`xfemnav.imaging`.
"""

import base64
import gzip
from pathlib import Path

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import Mesh, orient

LEVEL = 1  # of zlib: noisy images are 2 % larger than at 6, in 3/4 of its time
LARGEST = 2_000_000_000  # bytes of a mesh, as a file and unpacked
CELLS = {3: "triangle", 4: "tetra"}  # meshio's words, by the number of corners
SIMPLICES = {3: "triangles", 4: "tetrahedra"}
SAME_MM = 1e-6  # corners of neighbouring triangles closer than this, at rest and moved, are one vertex


def write_nifti(path: Path, image) -> None:
    """Write `nifti_bytes` to `path`. Raises OSError."""
    path.write_bytes(nifti_bytes(image))


def nifti_bytes(image) -> bytes:
    """A nibabel image as .nii.gz without the time of day, so that equal images are equal files."""
    return gzip.compress(image.to_bytes(), compresslevel=LEVEL, mtime=0)


def write_vtu(path: Path, points, cells, point_data: dict | None = None, cell_data: dict | None = None) -> None:
    """Write triangles or tetrahedra: `points` (n, 3) world RAS mm, `cells` (m, 3 or 4), data by name with one row a
    point or cell."""
    import meshio

    from xfemnav.imaging.reading.content import silenced

    cell_data = {name: [values] for name, values in (cell_data or {}).items()}
    with silenced():
        mesh = meshio.Mesh(points, [(CELLS[cells.shape[1]], cells)], point_data or {}, cell_data)
        mesh.write(path, file_format="vtu")


def write_vtp(path: Path, corners, cell_data: dict | None = None) -> None:
    """Write triangles (f, 3, 3) mm, world RAS, as polygons whose file says so; corners that coincide are one point."""
    points, triangles = np.unique(np.rint(np.reshape(corners, (-1, 3)) / SAME_MM), axis=0, return_inverse=True)
    n = len(triangles) // 3

    def array(values, kind: str, name: str, attributes: str = "") -> str:
        values = np.ascontiguousarray(values)
        packed = base64.b64encode(np.uint32(values.nbytes).tobytes() + values.tobytes()).decode()
        return f'<DataArray type="{kind}" Name="{name}"{attributes} format="binary">{packed}</DataArray>'

    text = (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian" '
        f'header_type="UInt32">\n<PolyData>\n<FieldData><DataArray type="String" Name="SPACE" NumberOfTuples="1" '
        f'format="ascii">{" ".join(str(code) for code in (*b"RAS", 0))}</DataArray></FieldData>\n'
        f'<Piece NumberOfPoints="{len(points)}" NumberOfPolys="{n}">\n<CellData>'
        + "".join(array(np.asarray(values, "<f8"), "Float64", name) for name, values in (cell_data or {}).items())
        + "</CellData>\n<Points>" + array((points * SAME_MM).astype("<f8"), "Float64", "Points",
                                          ' NumberOfComponents="3"')
        + "</Points>\n<Polys>" + array(triangles.ravel().astype("<i8"), "Int64", "connectivity")
        + array(3 * np.arange(1, n + 1, dtype="<i8"), "Int64", "offsets")
        + "</Polys>\n</Piece>\n</PolyData>\n</VTKFile>\n")
    path.write_text(text)


def read_vtu(path: Path, code: str, wanted: tuple[str, ...] = (), corners: int = 3):
    """The triangles of a VTU file, or its tetrahedra, of 4 `corners`, and the point data `wanted`, all of them numbers
    and within reach: a Grid.

    Raises E100, E102, E106, and the error `code` when it is none.
    """
    from xfemnav.imaging.points.point_set import FARTHEST
    from xfemnav.imaging.points.vtk_grid import grid
    from xfemnav.imaging.reading.content import file_bytes

    content = file_bytes(path, LARGEST)
    if b"<VTKFile" not in content[:2000]:
        raise XfemnavError(code, f"{path.name} is no VTU file. Write it as VTU, for instance with meshio or ParaView.")
    try:
        found = grid(content, path.name, wanted, LARGEST, corners)
    except XfemnavError as error:
        raise XfemnavError(code if error.code == "E701" else error.code, error.text) from None
    if len(found.cells) == 0:
        what = SIMPLICES[corners]
        raise XfemnavError(code, f"{path.name} holds no {what}. Write a VTU of {what} in mm (RAS).")
    for what, values in (("points", found.points), *found.point_data.items()):
        if not (abs(values.astype(float)) <= FARTHEST).all():
            raise XfemnavError(code, f"{path.name} has {what} that are NaN, or over {FARTHEST:g} mm. Write it again, "
                                     "in mm.")
    return found


def read_mesh(path: Path, slice, min_quality: float = 0.05) -> Mesh:
    """The user's mesh in the plane of `slice`: VTU triangles, world RAS mm. Raises E100 and E209."""
    found = read_vtu(path, "E209")
    used, cells = np.unique(found.cells, return_inverse=True)
    points, distance = slice.from_world(found.points[used])
    if abs(distance).max() > slice.thickness / 2 * (1 + 1e-6):
        raise XfemnavError("E209", f"{path.name} lies up to {abs(distance).max():.2f} mm off the slice, over half its "
                                   f"thickness ({slice.thickness / 2:.2f} mm). Its points are world RAS mm.")
    cells = cells.reshape(-1, 3)
    turned = orient(*points[cells].swapaxes(0, 1)) < 0
    cells[turned] = cells[turned][:, [0, 2, 1]]
    return _checked_mesh(path.name, points, cells, min_quality)


def _checked_mesh(name: str, points, cells, min_quality: float) -> Mesh:
    """A mesh of one piece, without holes, overlaps or flat triangles. Raises E209."""
    try:
        mesh = Mesh(points, cells)
        loops = mesh.boundary_loops
    except ValueError as error:
        raise XfemnavError("E209", f"{name}: {error}. Mend the mesh.") from None
    least = int(np.argmin(mesh.sizes))
    if mesh.sizes[least] < SAME_MM:
        raise XfemnavError("E209", f"{name}: triangle {least} is {mesh.sizes[least]:.2g} mm large. Mend the mesh.")
    worst = int(np.argmin(mesh.quality))
    if not mesh.quality[worst] >= min_quality:
        raise XfemnavError("E209", f"{name}: triangle {worst} has quality {mesh.quality[worst]:.3f}, "
                                   f"below {min_quality}. Mend the mesh.")
    edges = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    if np.unique(edges, axis=0, return_counts=True)[1].max() > 2:
        raise XfemnavError("E209", f"{name}: an edge belongs to more than two triangles. Mend the mesh.")
    if len(loops) != 1:
        raise XfemnavError("E209", f"{name}: the mesh has {len(loops)} boundary loops (holes or several pieces); "
                                   "one is wanted.")
    x, y = points[loops[0]].T
    enclosed = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    if not abs(enclosed - mesh.volumes.sum()) <= 1e-6 * mesh.volumes.sum():
        raise XfemnavError("E209", f"{name}: triangles overlap ({mesh.volumes.sum():.2f} mm2 of triangles inside an "
                                   f"outline of {enclosed:.2f} mm2). Mend the mesh.")
    return mesh


def write_soup(path: Path, slice, rest, moved, cell_data: dict) -> None:
    """Write the deformed simplices: points at rest, `displacement` (3) at the points, `cell_data` by simplex.

    rest, moved (t, d + 1, d) mm, in the plane of a slice or in space. Corners that are equal at rest and moved become
    one vertex: lips stay double.
    """
    _, corners, d = rest.shape
    both = np.concatenate([rest, moved], axis=2).reshape(-1, 2 * d)
    _, first, cells = np.unique(np.rint(both / SAME_MM), axis=0, return_index=True, return_inverse=True)
    at_rest, displaced = both[first, :d], both[first, d:] - both[first, :d]
    write_vtu(path, slice.to_world(at_rest), cells.reshape(-1, corners), {"displacement": displaced @ slice.axes[:d]},
              cell_data)


def read_soup(path: Path, frame) -> tuple[np.ndarray, np.ndarray]:
    """rest, moved (t, d + 1, d) mm, in the plane of a Slice `frame` or in space, of the file that `write_soup` wrote.
    Raises E100 and E701."""
    d = frame.values.ndim
    found = read_vtu(path, "E701", ("displacement",), d + 1)
    displacement = found.point_data.get("displacement", np.empty(0))
    if displacement.shape != found.points.shape:
        raise XfemnavError("E701", f"{path.name} has no point data 'displacement' of three components; it is no "
                                   "solution of xfemnav.")
    rest = frame.from_world(found.points)[0]
    moved = rest + displacement @ frame.axes[:d].T
    return rest[found.cells], moved[found.cells]
