"""A cut block in space that is opened: its motion, what is on it now, and an oblique volume about it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tests.blocks import block
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.solid.levels import Level
from xfemnav.geometry.solid.split import split

N, WALL, FRONT = 4, 1.7, 2.0    # the block is [0, N]^3; the cut is the plane x = WALL down to z = FRONT
SHAPE = (37, 33, 31)
STEPS = Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix() * (0.3, -0.35, 0.4)
AFFINE = np.eye(4)
AFFINE[:3, :3], AFFINE[:3, 3] = STEPS, np.full(3, N / 2) - STEPS @ (np.array(SHAPE) // 2)


@dataclass(frozen=True, eq=False)
class Opened:
    """The block whose lips move apart by up to `gap` mm, and up by `lift` mm, at its top."""

    gap: float = 1.5
    lift: float = 0.0
    ball: bool = False    # a ball at the top far from the cut is taken out

    @property
    def mesh(self) -> Mesh:
        return block(3, N)

    @property
    def parts(self) -> Parts:
        x, _, z = self.mesh.points.T
        cuts = [Level(x - WALL, [FRONT - z])]
        if self.ball:
            cuts.append(Level(np.linalg.norm(self.mesh.points - [3.5, 2, N], axis=1) - 0.9, takes_out=True))
        return split(self.mesh, tuple(cuts))

    def now(self, places, side):
        """Where `places` (..., 3) on a `side` (...), +1 at large x, are now."""
        places, side = np.asarray(places, float), np.asarray(side)
        height = np.clip(places[..., 2] - FRONT, 0, None) / (N - FRONT)
        return places + np.stack([side * self.gap / 2 * height, 0 * height, self.lift * height], axis=-1)

    @property
    def motion(self) -> Motion:
        """Its sheet has its left where x is large."""
        parts = self.parts
        rest, lips = parts.corners[~parts.removed[parts.part]], parts.lips.facets
        up = np.cross(lips[:, 1] - lips[:, 0], lips[:, 2] - lips[:, 0])[:, 0] > 0
        sheet = np.where(up[:, None, None], lips, lips[:, ::-1])
        return Motion(rest, self.now(rest, side_of(rest.mean(axis=1))[:, None]), (sheet,))

    @property
    def outline(self) -> np.ndarray:
        """The surface (b, 3, 3) at rest."""
        return self.mesh.points[self.mesh.boundary_facets]

    @property
    def rim(self) -> tuple[np.ndarray, np.ndarray]:
        """The facets of the surface that are left, (f, 3, 3) at rest and now."""
        rest = self.parts.rim.facets
        return rest, self.now(rest, side_of(rest.mean(axis=1))[:, None])


def side_of(places) -> np.ndarray:
    """The side of the cut's plane that places (..., 3) are on, +1 at large x."""
    return np.sign(np.asarray(places)[..., 0] - WALL)
