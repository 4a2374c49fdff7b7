"""All that a network of segments makes of a mesh's cells, in one compiled piece: parts, contacts, lips and rim."""

import numpy as np
from numba import njit

from xfemnav.geometry.plane.interfaces import Polygons, joins, lips, rim, touched
from xfemnav.geometry.plane.partition import split_cells
from xfemnav.geometry.plane.triangulate import fan


@njit(cache=True)
def dissect(corners, cells, neighbours, sizes, segments, tips):
    """Cells (m, 3) with corners (m, 3, 2) mm, split by the segments of `Segments`; tips (t, 2) mm are corners.

    The cell (p,) of each part of a split cell; tables of the triangles of those parts, their part (s, 1) and corners
    (s, 6) mm; what `joins`, `lips`, `rim` and `touched` of `facets` tell. The first part of a cell has the cell's
    number, further ones follow those of all cells.
    """
    polygons, cell = split_cells(corners, sizes, segments.rows, tips)
    begin, part, further = np.zeros(len(cells) + 1, np.int64), [], len(cells)
    for k in range(len(cell)):
        begin[cell[k] + 1] += 1
        if k > 0 and cell[k] == cell[k - 1]:
            part.append(further)
            further += 1
        else:
            part.append(cell[k])
    for c in range(len(cells)):
        begin[c + 1] += begin[c]
    parts = Polygons(polygons, cell, part, begin)
    owner, triangles = [], []
    for k in range(len(polygons)):
        for triangle in fan(polygons[k], tips, sizes[cell[k]]):
            owner.append((part[k],))
            triangles.append(triangle)
    pairs, ends = joins(corners, neighbours, sizes, parts)
    between, spans = lips(corners, sizes, parts, segments)
    touch = touched(corners, sizes, parts, tips)
    behind, outline = rim(corners, neighbours, parts)
    return (
        np.array(cell),
        (_table(owner, np.empty((len(owner), 1), np.int64)), _table(triangles, np.empty((len(owner), 6)))),
        (_table(pairs, np.empty((len(pairs), 2), np.int64)), _table(ends, np.empty((len(pairs), 4)))),
        (_table(between, np.empty((len(spans), 5), np.int64)), _table(spans, np.empty((len(spans), 2)))),
        (_table(behind, np.empty((len(behind), 1), np.int64)), _table(outline, np.empty((len(behind), 4)))),
        _table(touch, np.empty((len(touch), 2), np.int64)),
    )


@njit
def _table(rows, table):
    """The table (n, k), filled with a list of n tuples of k numbers."""
    for n in range(len(rows)):
        for k in range(table.shape[1]):
            table[n, k] = rows[n][k]
    return table
