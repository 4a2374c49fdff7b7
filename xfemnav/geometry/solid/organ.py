"""An organ in space: its mesh, and the signed distance that this was made of."""

from dataclasses import dataclass

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.solid.field import Field


@dataclass(frozen=True, eq=False)
class Organ(Mesh):
    """A mesh, which does not know the cuts, and the `field` whose zero level is its surface."""

    field: Field | None = None
