"""A graded body-centred cubic lattice: tetrahedra between the centres and corners of a balanced octree's cells.

Two cells of one size share a face, and a tetrahedron for each of its edges spans it with both centres; an edge that
smaller cells halve gives two. A cell beside a larger one has half a pyramid, and so has the larger, over each half of
its face, which the diagonal to the middle of the larger's face divides (Labelle & Shewchuk 2007). Cells that touch,
if only in a corner, differ by one level at most.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

CLOSE = 1e-9  # of a size: as much is rounding, so that a size that is a side wants that side
MISS = 1.0  # mm: a cell in which the surface bends by more is divided, so that nothing is overlooked
FAR = 3  # sides that a cell's centre may lie outside the organ: all tetrahedra that reach the organ are between others


class Octree(NamedTuple):
    """Cells of sides `fine` * 2^level mm from `corner` (3,) mm: `split`, for each level but 0 the cells (n1, n2, n3)
    that fall into eight of the level below; `roots` (3,) cells of the highest level."""

    corner: np.ndarray
    fine: float
    roots: np.ndarray
    split: dict[int, np.ndarray]

    def side(self, level: int) -> float:
        """Side of a level's cells, mm."""
        return self.fine * 2.0**level

    def centres(self, cells, level: int) -> np.ndarray:
        """Centres (k, 3) mm of cells (k, 3) of a level."""
        return self.corner + (cells + 0.5) * self.side(level)


def octree(field, size, fine: float, coarse: float) -> Octree:
    """Octree over a field, its cells no larger than `size(points (n, 3)) -> (n,)` mm wants where the organ is, nor than
    they may be to see its surface.

    `field(points (n, 3)) -> (n,)` is a `Field` in its own frame; `fine` and `coarse` bound the sides, mm.
    """
    top = max(0, int(np.floor(np.log2(coarse / fine) + CLOSE)))
    extent = (np.array(field.values.shape) - 1) * field.axes
    low, high = np.minimum(extent, 0).sum(axis=0), np.maximum(extent, 0).sum(axis=0)
    roots = np.ceil((high - low) / (fine * 2**top)).astype(int) + 2  # beyond the field it is as at its border: outside
    tree = Octree((low + high - roots * fine * 2**top) / 2, fine, roots, {})
    cells = np.stack(np.indices(roots), axis=-1).reshape(-1, 3)
    for level in range(top, 0, -1):
        tree.split[level] = np.zeros(roots << (top - level), bool)
        cells = cells[near(tree, field, cells, level)]
        parts = tree.centres(children(cells), level - 1)
        wanted = size(parts).reshape(-1, 8).min(axis=1, initial=np.inf)
        cells = cells[(wanted < tree.side(level) * (1 - CLOSE)) | _misses(tree, field, cells, level)]
        tree.split[level][tuple(cells.T)] = True
        cells = children(cells)
    for level in range(1, top):  # what is split has neighbours of its own size at least
        about = maximum_filter(tree.split[level], 3, mode="constant")
        n1, n2, n3 = tree.split[level + 1].shape
        tree.split[level + 1][:] |= about.reshape(n1, 2, n2, 2, n3, 2).any(axis=(1, 3, 5))
    return tree


def near(tree: Octree, field, cells, level: int) -> np.ndarray:
    """Which cells (k,) of a level a tetrahedron that reaches the organ may touch."""
    return field(tree.centres(cells, level)) > -FAR * tree.side(level)


def _misses(tree, field, cells, level):
    """Which cells (k,) of a level the surface passes, or nearly, and bends in by more than MISS."""
    quarters = np.array(list(product((0.25, 0.75), repeat=3)))
    corners = np.array(list(product((0, 1), repeat=3)))
    shares = np.where(corners, quarters[:, None], 1 - quarters[:, None]).prod(axis=2)
    low, side = tree.centres(cells, level) - tree.side(level) / 2, tree.side(level)
    own = field((low[:, None] + quarters * side).reshape(-1, 3)).reshape(-1, 8)
    bent = np.abs(own - field((low[:, None] + corners * side).reshape(-1, 3)).reshape(-1, 8) @ shares.T).max(axis=1)
    return (bent > MISS) & (np.abs(own).min(axis=1) < side / 2)


def children(cells) -> np.ndarray:
    """The eight cells (8 k, 3) of the level below of each of cells (k, 3)."""
    return (2 * cells[:, None] + np.array(list(product((0, 1), repeat=3)))).reshape(-1, 3)


def leaves(tree: Octree, field) -> list[np.ndarray]:
    """For each level its cells (k, 3) near the organ that are not split, sorted."""
    top, found = len(tree.split), []
    for level in range(top + 1):
        if level == top:
            cells = np.stack(np.indices(tree.roots), axis=-1).reshape(-1, 3)
        else:
            cells = children(np.argwhere(tree.split[level + 1]))
            cells = cells[np.lexsort(cells.T[::-1])]
        if level:
            cells = cells[~tree.split[level][tuple(cells.T)]]
        found.append(cells[near(tree, field, cells, level)])
    return found


def tetrahedra(tree: Octree, cells: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (n, 3) as whole numbers of half the finest side from the corner, and tetrahedra (m, 4) between them.

    `cells` are the leaves of each level.
    """
    shape = (tree.roots << (len(tree.split) + 1)) + 1
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    levels = [Level(tree, level, own, strides) for level, own in enumerate(cells)]
    found = [part for low, high in zip(levels, [*levels[1:], None]) for part in _of_level(low, high)]
    keys = np.concatenate(found)
    corners = [own.corner[:, None] + own.side * (np.array(list(product((0, 1), repeat=3))) @ strides) for own in levels]
    names = np.unique(np.concatenate([each.ravel() for each in (*(own.centre for own in levels), *corners)]))
    number = np.minimum(np.searchsorted(names, keys), len(names) - 1)
    known = (names[number] == keys).all(axis=1)  # the middle of an edge may be a corner of cells far outside alone
    return np.stack(np.unravel_index(names, shape), axis=1), number[known]


class Level:
    """Leaves of one level, by keys: sums of coordinates, whole numbers of half the finest side, times `strides`.

    `side` in these numbers, `corner` (k,) and `centre` (k,) keys; `place` (k,) is what neighbours are found by.
    """

    def __init__(self, tree, level, cells, strides):
        self.cells, self.strides, self.side = cells, strides, 2 << level
        self.corner = cells @ strides * self.side
        self.centre = self.corner + self.side // 2 * strides.sum()
        shape = (tree.roots << (len(tree.split) - level)) + 2  # a rim: neighbours of the border's cells are none
        self.steps = np.array([shape[1] * shape[2], shape[2], 1])
        self.place = (cells + 1) @ self.steps
        self.split = np.pad(tree.split[level], 1).ravel() if level else np.zeros(0, bool)

    def find(self, place) -> np.ndarray:
        """Number (k,) of the leaves at places, -1 where there is none."""
        at = np.minimum(np.searchsorted(self.place, place), max(len(self.place) - 1, 0))
        return np.where(self.place[at] == place, at, -1) if len(self.place) else np.full(len(place), -1)

    def splits(self, place) -> np.ndarray:
        """Whether cells of this level at places (k,) are split."""
        return self.split[place] if len(self.split) else np.zeros(len(place), bool)


def _of_level(own: Level, larger: Level | None):
    """Tetrahedra (m, 4) as keys between leaves of one level, and between them and the next larger ones."""
    for axis in range(3):
        yield from _between_equals(own, axis)
        if larger is not None:
            for sign in (-1, 1):
                yield _beside_larger(own, larger, axis, sign)


def _between_equals(own, axis):
    """Tetrahedra over the edges of faces between leaves along an axis."""
    over = own.find(own.place + own.steps[axis])
    a = np.flatnonzero(over >= 0)
    b, side = over[a], own.side
    one, other = own.strides[[axis - 2, axis - 1]] * side
    step_one, step_other = own.steps[[axis - 2, axis - 1]]
    face = own.corner[a] + own.strides[axis] * side
    ends = [face, face + one, face + one + other, face + other]
    for k, beyond in enumerate((-step_other, step_one, step_other, -step_one)):
        first, last = ends[k], ends[(k + 1) % 4]
        halved = own.splits(own.place[a] + beyond) | own.splits(own.place[b] + beyond)
        middle = (first + last) // 2
        yield np.stack([own.centre[a], own.centre[b], first, np.where(halved, middle, last)], axis=1)
        yield np.stack([own.centre[a], own.centre[b], middle, last], axis=1)[halved]


def _beside_larger(own, larger, axis, sign):
    """Half pyramids on both sides of faces of leaves with larger ones before (sign -1) or behind them on an axis."""
    beyond = own.cells + sign * np.eye(3, dtype=int)[axis]
    over = larger.find((beyond // 2 + 1) @ larger.steps)
    a = np.flatnonzero((over >= 0) & (beyond[:, axis] // 2 != own.cells[:, axis] // 2))
    face = own.corner[a] + (own.strides[axis] * own.side if sign > 0 else 0)
    odd = own.cells[a][:, [axis - 2, axis - 1]] % 2  # which quarter of the larger one's face it is
    reach = own.strides[[axis - 2, axis - 1]] * own.side
    centre, outer = face + (1 - odd) @ reach, face + odd @ reach
    beside = (face + (1 - odd[:, 0]) * reach[0] + odd[:, 1] * reach[1],
              face + odd[:, 0] * reach[0] + (1 - odd[:, 1]) * reach[1])
    return np.concatenate([np.stack([apex, centre, outer, third], axis=1)
                           for apex in (own.centre[a], larger.centre[over[a]]) for third in beside])
