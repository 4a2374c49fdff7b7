"""How what is drawn splits a mesh: parts of cells, where they touch, and what bounds them.

This is the border of the dimension. The makers below it know the plane (`geometry.plane.subcells`) or space
(`geometry.solid`); what is above it reads the dimension off the shapes of these arrays.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numba import njit

from xfemnav.geometry.mesh import frozen_array, volumes


def freeze(table, **kinds) -> None:
    """Make the arrays of a frozen dataclass read-only, each of the type and shape given."""
    for name, (kind, *shape) in kinds.items():
        object.__setattr__(table, name, frozen_array(getattr(table, name), kind, shape, name))


@njit(cache=True)
def shared(one, other):
    """Which corner of the other cell (j, d + 1) each corner of the first (j, d + 1) is, -1 for none (j, d + 1)."""
    found = np.full(one.shape, -1)
    for j in range(len(one)):
        for a in range(one.shape[1]):
            for b in range(other.shape[1]):
                if one[j, a] == other[j, b]:
                    found[j, a] = b
    return found


class Rows:
    """A frozen table whose arrays have one row each of what it lists."""

    def rows(self, chosen):
        """The table with some of its rows: indices, or a mask (n,)."""
        return replace(self, **{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    def with_rows(self, other):
        """The table, and the rows of another one after its own."""
        return replace(self, **{field.name: np.concatenate([getattr(self, field.name), getattr(other, field.name)])
                                for field in fields(self)})


@dataclass(frozen=True, eq=False)
class Faces(Rows):
    """Facets of parts, with tissue on one side: the organ's outline, or walls of what was taken out.

    facets (b, d, d) mm: edges with tissue on their left, triangles that turn left as seen from outside.
    parts (b,): the part of each. source (b,): the resection that took the other side, -1 for none.
    """

    facets: np.ndarray
    parts: np.ndarray
    source: np.ndarray

    def __post_init__(self):
        freeze(self, facets=(float, None, None, None), parts=(np.int64, None), source=(np.int64, None))


@dataclass(frozen=True, eq=False)
class Lips(Rows):
    """Facets of the cuts, each inside one cell or on a face between two.

    facets (l, d, d) mm, turned as the border of the left part: in the plane in travel order. at (l, d, c): chart
    coordinates of their corners, in the plane mm from the mouth, in space along and in depth, and mm from the sheet's
    border. parts (l, 2): on the left (+1) and on the right (-1).
    cut (l,): the cut of each. on_face (l, d): whether each corner lies on a face of the mesh.
    """

    facets: np.ndarray
    at: np.ndarray
    parts: np.ndarray
    cut: np.ndarray
    on_face: np.ndarray

    def __post_init__(self):
        d = np.shape(self.facets)[-1]
        freeze(self, facets=(float, None, d, d), at=(float, None, d, None), parts=(np.int64, None, 2),
               cut=(np.int64, None), on_face=(bool, None, d))

    @property
    def arc(self) -> np.ndarray:
        """In the plane: distance (l, 2) mm of both ends from the mouth, along the cut."""
        return self.at[..., 0]


@dataclass(frozen=True, eq=False)
class Fronts(Rows):
    """Where cuts end inside the organ, in the plane: tips.

    cut (t,): the cut of each; end (t,): its end, 0 or -1; at (t, d) mm; travel (t, d): the unit direction in which the
    cut would go on.
    """

    cut: np.ndarray
    end: np.ndarray
    at: np.ndarray
    travel: np.ndarray

    def __post_init__(self):
        d = np.shape(self.at)[-1]
        freeze(self, cut=(np.int64, None), end=(np.int64, None), at=(float, None, d), travel=(float, None, d))


@dataclass(frozen=True, eq=False)
class Parts:
    """Parts of a mesh's cells and how they touch. Part c < n_cells belongs to cell c; further parts come after those.

    corners (s, d + 1, d) mm: simplices, positively oriented; part (s,): the part that each belongs to.
    cell (p,): the cell of each part. removed (p,): whether it is taken out.
    joins (j, 2): pairs of parts that touch where nothing cuts. through (j, d + 1): which corner of the second part's
        cell each corner of the first one's is, -1 for none: a face lets its corners through, a contact inside a cell
        all. middles (j, d) mm: the middle of the contact.
    lips, rim (the organ's border), walls (of what is taken out), fronts: none belongs to a removed part. touch (k, 2):
        pairs (front, part) of the parts that a tip touches.
    paths: the snapped cuts, in the plane a tuple of (k, 2) mm.
    """

    corners: np.ndarray
    part: np.ndarray
    cell: np.ndarray
    removed: np.ndarray
    joins: np.ndarray
    through: np.ndarray
    middles: np.ndarray
    lips: Lips
    rim: Faces
    walls: Faces
    fronts: Fronts
    touch: np.ndarray
    paths: tuple = ()

    def __post_init__(self):
        d = np.shape(self.corners)[-1]
        freeze(self, corners=(float, None, d + 1, d), part=(np.int64, None), cell=(np.int64, None),
               removed=(bool, len(self.cell)), joins=(np.int64, None, 2), through=(np.int64, None, d + 1),
               middles=(float, None, d), touch=(np.int64, None, 2))
        object.__setattr__(self, "paths", tuple(frozen_array(path, float, (None, d), "path") for path in self.paths))

    @property
    def n_parts(self) -> int:
        """Number of parts."""
        return len(self.cell)

    @cached_property
    def volumes(self) -> np.ndarray:
        """Volumes (s,) mm^d of the simplices."""
        return volumes(self.corners)
