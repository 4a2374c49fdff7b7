"""Surfaces in VTK's XML format, PolyData (.vtp).

Arrays of points are kept as they are, those of cells without the cells that are left out. Normals are left out, since
they would be those of the old surface. Triangle strips become triangles.
"""

import numpy as np

from xfemnav.imaging.points.surface_form import Form, damaged, starts, unreadable
from xfemnav.imaging.points.vtk_cells import Cells
from xfemnav.imaging.points.vtk_xml import FAULTS, Document, Unknown

TAGS = {"Verts": "VERTICES", "Lines": "LINES", "Polys": "POLYGONS", "Strips": "TRIANGLE_STRIPS"}


def decoded(content: bytes, name: str, limit: int) -> Form:
    """The surface in the bytes of a .vtp file."""
    try:
        document = Document(content, "PolyData", name, limit)
        piece = document.piece()
        n = int(piece.get("NumberOfPoints"))
        (array,) = piece.findall("Points/DataArray")
        points = document.array(array, n).reshape(n, 3).astype(float)
        cells = Cells.of({kind: _connectivity(document, piece, tag) for tag, kind in TAGS.items()})
        about = {item: document.array(item, cells.n_rows) for item in piece.findall("CellData/DataArray")}
        remarks = _remarks(document)
    except Unknown as error:
        raise unreadable(name, str(error)) from None
    except FAULTS as error:
        raise damaged(name, error) from None

    def rewritten(new, kept) -> bytes:
        fresh = Document(content, "PolyData", name, limit)
        own = fresh.piece()
        if own.find("Polys") is None and own.find("Strips") is not None:
            own.find("Strips").tag = "Polys"
        fresh.replace(own.find("Points/DataArray"), new)
        for tag, kind in TAGS.items():
            corners, count = cells.of_kind(kind, kept)
            _replace(fresh, own, tag, corners, starts(count)[1:])
        values = dict(zip(own.findall("CellData/DataArray"), about.values()))
        for item, rows in values.items():
            fresh.replace(item, rows[cells.row[kept]])
        _drop(own, changed=len(cells.row) != cells.n_rows or not kept.all())
        return fresh.written()

    return Form(points, cells.corners, cells.count, rewritten, remarks)


def _connectivity(document: Document, piece, tag: str) -> tuple[np.ndarray, np.ndarray]:
    """Corners (k,) and their number (m,) of the cells of one kind."""
    n = int(piece.get(f"NumberOf{tag}") or 0)
    arrays = {item.get("Name"): item for item in piece.findall(f"{tag}/DataArray")}
    if n == 0:
        return np.zeros(0, int), np.zeros(0, int)
    offsets = document.array(arrays["offsets"], n).astype(int)
    count = np.diff(np.concatenate([[0], offsets]))
    if (count < 0).any():
        raise ValueError("cells end before they begin")
    return document.array(arrays["connectivity"], int(offsets[-1])).astype(int), count


def _replace(document: Document, piece, tag: str, corners, offsets) -> None:
    arrays = {item.get("Name"): item for item in piece.findall(f"{tag}/DataArray")}
    piece.set(f"NumberOf{tag}", str(len(offsets)))
    if arrays:
        document.replace(arrays["connectivity"], corners)
        document.replace(arrays["offsets"], offsets)


def _drop(piece, changed: bool) -> None:
    """Take out normals, and texts of cells where the cells are others now."""
    for place in ("PointData", "CellData"):
        for data in piece.findall(place):
            normals = data.attrib.pop("Normals", None)
            for item in list(data):
                if item.get("Name") in (normals, "Normals") or (
                        item.tag == "Array" and place == "CellData" and changed):
                    data.remove(item)


def _remarks(document: Document) -> bytes:
    """The frame that 3D Slicer states as the field SPACE."""
    fields = [item for item in document.root.iter("Array") if item.get("Name") == "SPACE"]
    return b"\n".join(b"SPACE=" + document.words(item).partition(b"\0")[0] for item in fields)
