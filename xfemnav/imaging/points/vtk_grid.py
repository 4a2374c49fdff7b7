"""Triangles and tetrahedra in VTK's XML format, UnstructuredGrid (.vtu): the meshes that runs read and leave behind."""

from dataclasses import dataclass

import numpy as np

from xfemnav.imaging.points.surface_form import damaged, unreadable
from xfemnav.imaging.points.vtk_xml import FAULTS, Document, Unknown

TYPES = {3: 5, 4: 10}  # VTK's numbers of triangles and tetrahedra, by their corners


@dataclass(frozen=True, eq=False)
class Grid:
    """Points (n, 3) in the file's frame, the triangles (m, 3), or tetrahedra (m, 4), among its cells, and its point
    data (n, ...) by name."""

    points: np.ndarray
    cells: np.ndarray
    point_data: dict[str, np.ndarray]


def grid(content: bytes, name: str, wanted: tuple[str, ...] = (), limit: int = 4_000_000_000,
         corners: int = 3) -> Grid:
    """The triangles in the bytes of a .vtu file called `name`, or what has 4 `corners`, and those of the
    point data `wanted` that it has.

    Raises E701, and E102 for what unpacks to too much.
    """
    try:
        document = Document(content, "UnstructuredGrid", name, limit)
        piece = document.piece()
        n, m = (int(piece.get(f"NumberOf{what}")) for what in ("Points", "Cells"))
        (array,) = piece.findall("Points/DataArray")
        points = document.array(array, n).reshape(n, 3).astype(float)
        cells = {item.get("Name"): item for item in piece.findall("Cells/DataArray")}
        ends = document.array(cells["offsets"], m).astype(int)
        nodes = document.array(cells["connectivity"], int(ends[-1]) if m else 0).astype(int)
        chosen = document.array(cells["types"], m) == TYPES[corners]
        if (np.diff(ends, prepend=0)[chosen] != corners).any() or ((nodes < 0) | (nodes >= n)).any():
            raise ValueError(f"a cell has other than {corners} corners, or one that is no point")
        about = {item.get("Name"): item for item in piece.findall("PointData/DataArray")}
        found = {key: document.array(about[key], n) for key in wanted if key in about}
    except Unknown as error:
        raise unreadable(name, str(error)) from None
    except FAULTS as error:
        raise damaged(name, error) from None
    return Grid(points, nodes[ends[chosen][:, None] + np.arange(-corners, 0)], found)
