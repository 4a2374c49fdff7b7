"""Triangles in VTK's XML format, UnstructuredGrid (.vtu): the meshes that runs read and leave behind."""

from dataclasses import dataclass

import numpy as np

from xfemnav.imaging.points.surface_form import damaged, unreadable
from xfemnav.imaging.points.vtk_xml import FAULTS, Document, Unknown

TRIANGLE = 5  # VTK's number of the type


@dataclass(frozen=True, eq=False)
class Grid:
    """Points (n, 3) in the file's frame, the triangles (m, 3) among its cells, and its point data (n, ...) by name."""

    points: np.ndarray
    triangles: np.ndarray
    point_data: dict[str, np.ndarray]


def grid(content: bytes, name: str, wanted: tuple[str, ...] = (), limit: int = 4_000_000_000) -> Grid:
    """The triangles in the bytes of a .vtu file called `name`, and those of the point data `wanted` that it has.

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
        corners = document.array(cells["connectivity"], int(ends[-1]) if m else 0).astype(int)
        triangle = document.array(cells["types"], m) == TRIANGLE
        if (np.diff(ends, prepend=0)[triangle] != 3).any() or ((corners < 0) | (corners >= n)).any():
            raise ValueError("a triangle has other than three corners, or one that is no point")
        about = {item.get("Name"): item for item in piece.findall("PointData/DataArray")}
        found = {key: document.array(about[key], n) for key in wanted if key in about}
    except Unknown as error:
        raise unreadable(name, str(error)) from None
    except FAULTS as error:
        raise damaged(name, error) from None
    return Grid(points, corners[ends[triangle][:, None] + np.arange(-3, 0)], found)
