"""The pull-back in space: of every voxel only the tetrahedron that it is in, within a box about the tissue.

Its map is affine, so the place at rest is had from it where it is asked for: no field of vectors is kept. Points are
world RAS mm, and voxel v has its centre at origin + steps v.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from xfemnav.geometry.mesh import determinants
from xfemnav.imaging.carrying.lattice import slabs
from xfemnav.imaging.carrying.tetrahedra import affine_maps, fill, mapped, places, rasterise
from xfemnav.imaging.carrying.voxels import sample_volume

DIGITS = 9  # of places in voxels


@dataclass(frozen=True, eq=False)
class SolidPullBack:
    """Where the tissue in each voxel of a lattice rested: `PullBack` in space.

    `simplex`, `count` and `folded` (m1, m2, m3) are those of the voxels from `first` (3,) on, beyond which there is no
    tissue: the tetrahedron that each is in, -1 for none; how many cover it; how many turned inside out. The lattice has
    its `origin` (3,), `steps` (3, 3) mm as columns, and `shape` (3,); the tetrahedra at `rest` and `moved`, both
    (t, 4, 3) mm.
    """

    simplex: np.ndarray
    count: np.ndarray
    folded: np.ndarray
    first: np.ndarray
    origin: np.ndarray
    steps: np.ndarray
    shape: tuple[int, int, int]
    rest: np.ndarray
    moved: np.ndarray

    @cached_property
    def tissue(self) -> np.ndarray:
        """Voxels (n1, n2, n3) with tissue in them."""
        return self._whole(self.simplex >= 0)

    @cached_property
    def overlap(self) -> np.ndarray:
        """Voxels (n1, n2, n3) with more than one piece of tissue in them."""
        return self._whole(self.count > 1)

    @cached_property
    def spacing(self) -> np.ndarray:
        """Lengths (3,) mm of the steps."""
        return np.linalg.norm(self.steps, axis=0)

    @cached_property
    def F(self) -> np.ndarray:
        """The deformation gradient (t, 3, 3) of each tetrahedron, d moved / d rest; of a flat one the identity."""
        rest, moved = (x[:, 1:] - x[:, :1] for x in (self.rest, self.moved))
        flat = determinants(rest) == 0
        F = np.linalg.solve(np.where(flat[:, None, None], np.eye(3), rest), moved).swapaxes(1, 2)
        F[flat] = np.eye(3)
        return F

    @cached_property
    def box(self) -> np.ndarray:
        """Corners (8, 3) mm of the box that holds all tissue at rest."""
        return np.array(list(product(*np.stack([self.rest.min(axis=(0, 1)), self.rest.max(axis=(0, 1))], axis=1))))

    @property
    def resting(self) -> np.ndarray:
        """Resting place (n1, n2, n3, 3) mm of what is in each voxel, NaN without tissue: 24 bytes a voxel."""
        resting = np.full((*self.shape, 3), np.nan)
        resting[self.tissue] = self.places_of(self.tissue)
        return resting

    @property
    def field(self) -> np.ndarray:
        """Resting place minus position, (n1, n2, n3, 3) mm; 0 where there is no tissue: 24 bytes a voxel."""
        field, tissue = np.zeros((*self.shape, 3)), self.tissue
        field[tissue] = self.places_of(tissue) - self.centres_of(np.argwhere(tissue))
        return field

    def centres_of(self, voxels) -> np.ndarray:
        """Centres (n, 3) mm of `voxels` (n, 3)."""
        return voxels @ self.steps.T + self.origin

    def simplices_of(self, wanted, first: int = 0) -> np.ndarray:
        """The tetrahedron (n,) that each of the `wanted` voxels is in, -1 for none; `wanted` as in `places_of`."""
        return self._rows(first, len(wanted))[wanted]

    def places_of(self, wanted, first: int = 0) -> np.ndarray:
        """Where to look for what is in the `wanted` voxels (m, n2, n3) bool of the rows from `first` on: their resting
        places (n, 3) mm, or their own without tissue."""
        return places(self._rows(first, len(wanted)), wanted, self._maps, self._own, np.array([first, 0, 0]))

    def sample_into(self, out, values, interp: str) -> None:
        """Write an image's `values` (n1, n2, n3) at the resting places of tissue to `out`, as `warp.sample_into`."""
        inverse, low = _inverse(self.origin, self.steps), self.first
        inner = tuple(slice(at, at + n) for at, n in zip(low, self.simplex.shape))
        for rows in slabs(self.simplex.shape):
            simplex = self.simplex[rows]
            wanted = simplex >= 0
            at = places(simplex, wanted, self._maps, self._own, low + np.array([rows.start, 0, 0]))
            found, _ = sample_volume(values[..., None], inverse[:, :3], inverse[:, 3], at, interp, np.inf)
            out[inner][rows][wanted] = found[:, 0]

    @cached_property
    def _own(self) -> np.ndarray:
        return np.column_stack([self.steps, self.origin])

    @cached_property
    def _maps(self) -> np.ndarray:
        return affine_maps(mapped(self.moved, _inverse(self.origin, self.steps)), self.rest, self._own)

    def _rows(self, first: int, count: int) -> np.ndarray:
        """`simplex` of whole rows of the lattice."""
        rows = np.full((count, *self.shape[1:]), -1, np.int32)
        low, high = max(first, self.first[0]), min(first + count, self.first[0] + len(self.simplex))
        if low < high:
            j, k = (slice(at, at + n) for at, n in zip(self.first[1:], self.simplex.shape[1:]))
            rows[low - first:high - first, j, k] = self.simplex[low - self.first[0]:high - self.first[0]]
        return rows

    def _whole(self, inner) -> np.ndarray:
        """On the whole lattice what is False beyond the box."""
        whole = np.zeros(self.shape, bool)
        whole[tuple(slice(at, at + n) for at, n in zip(self.first, inner.shape))] = inner
        return whole


def pull_back_in_space(rest, moved, origin, steps, shape) -> SolidPullBack:
    """`warp.pull_back` of tetrahedra at `rest` and `moved`, both (t, 4, 3) mm, on a lattice of `shape` (3,) with
    `origin` (3,) and `steps` (3, 3) mm as columns."""
    rest, moved = np.ascontiguousarray(rest, float), np.ascontiguousarray(moved, float)
    there = mapped(moved, _inverse(origin, steps))
    low, high = ([find(along) for along in there.T] if len(there) else np.zeros(3) for find in (np.min, np.max))
    first = np.clip(np.floor(low).astype(int), 0, shape)
    size = np.clip(np.ceil(high).astype(int) + 1, first, shape) - first
    found = rasterise(rest, there - first, np.sign(np.linalg.det(steps)), *size.tolist())
    return SolidPullBack(*found, first, np.array(origin, float), np.array(steps, float), tuple(shape), rest, moved)


def enclosed_in_space(surface, origin, steps, shape) -> np.ndarray:
    """`warp.enclosed` of closed triangles (k, 3, 3) mm on a lattice as in `pull_back_in_space`."""
    inverse = _inverse(origin, steps)
    voxels = np.asarray(surface, float) @ inverse[:, :3].T + inverse[:, 3]
    return fill(np.round(voxels, DIGITS), *shape)    # one corner is one place, whoever computed it


def _inverse(origin, steps) -> np.ndarray:
    """The map (3, 4) from mm to voxels."""
    inverse = np.linalg.inv(steps)
    return np.column_stack([inverse, -inverse @ origin])
