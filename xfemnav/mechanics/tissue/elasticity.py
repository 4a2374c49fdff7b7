"""Linear elasticity: one material or one a cell, Hooke's law, and the stiffness matrix K."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from xfemnav.geometry.mesh import frozen_array
from xfemnav.mechanics.rules import Solid
from xfemnav.mechanics.space.quadrature import tip_rule
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.assembly import assemble
from xfemnav.mechanics.tissue.tip_stiffness import tip_blocks


class Isotropic:
    """Constants in cells, from `young_in` and `poisson_in`."""

    @property
    def plane_stress(self) -> bool:
        """True where tissue is free to thicken across the plane."""
        return self.stress_state == "stress"

    def lame_in(self, cells) -> tuple[np.ndarray, np.ndarray]:
        """Lame's constants mu and lambda, each (k,) kPa, of the solid in cells (k,)."""
        return lame(self.young_in(cells), self.poisson_in(cells))

    def moduli_in(self, cells) -> tuple[np.ndarray, np.ndarray]:
        """The same as they act between strains and stresses along the mesh's axes: of plane 'stress', if it is said."""
        mu, lam = self.lame_in(cells)
        return mu, 2 * lam * mu / (lam + 2 * mu) if self.plane_stress else lam

    def p_wave_in(self, cells) -> np.ndarray:
        """The P-wave modulus lambda + 2 mu (k,) kPa in cells (k,): stress along a strain that is the only one."""
        mu, lam = self.moduli_in(cells)
        return lam + 2 * mu


@dataclass(frozen=True)
class Material(Isotropic, Solid):
    """A solid everywhere: its elasticity."""

    @classmethod
    def of(cls, solid: Solid) -> "Material":
        """The material of a solid."""
        return cls(**vars(solid))

    @property
    def shear_modulus(self) -> float:
        """mu, kPa."""
        return self.young_kpa / (2 * (1 + self.poisson))

    @property
    def kappa(self) -> float:
        """Kolosov's constant: 3 - 4 nu in plane strain, (3 - nu) / (1 + nu) in plane stress."""
        nu = self.poisson
        return (3 - nu) / (1 + nu) if self.plane_stress else 3 - 4 * nu

    def at(self, cell: int) -> "Material":
        """The material of a cell: this one."""
        return self

    def young_in(self, cells) -> np.ndarray:
        """Young's modulus (k,) kPa in cells (k,)."""
        return np.full(len(cells), self.young_kpa)

    def poisson_in(self, cells) -> np.ndarray:
        """Poisson's ratio (k,) in cells (k,)."""
        return np.full(len(cells), self.poisson)


@dataclass(frozen=True, eq=False)
class Tissue(Isotropic):
    """A material for each cell: young_kpa (m,), poisson (m,), plane 'strain' or 'stress'; in use like a `Material`."""

    young_kpa: np.ndarray
    poisson: np.ndarray
    stress_state: str = "strain"

    def __post_init__(self):
        object.__setattr__(self, "young_kpa", frozen_array(self.young_kpa, float, (None,), "young_kpa"))
        object.__setattr__(self, "poisson", frozen_array(self.poisson, float, self.young_kpa.shape, "poisson"))
        for pick in (np.argmin, np.argmax):
            for values in (self.young_kpa, self.poisson):
                self.at(int(pick(values)))

    def at(self, cell: int) -> Material:
        """The material of a cell."""
        return Material(float(self.young_kpa[cell]), float(self.poisson[cell]), self.stress_state)

    def young_in(self, cells) -> np.ndarray:
        """Young's modulus (k,) kPa in cells (k,)."""
        return self.young_kpa[cells]

    def poisson_in(self, cells) -> np.ndarray:
        """Poisson's ratio (k,) in cells (k,)."""
        return self.poisson[cells]


def lame(young, poisson) -> tuple[np.ndarray, np.ndarray]:
    """Lame's constants mu and lambda, in the unit of Young's modulus, of a solid."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def mixed(materials: tuple[Material, ...], shares) -> Tissue:
    """Tissue of cells that hold `materials` by `shares` (m, k) of their area: Lame's constants in proportion."""
    shares = np.asarray(shares, float) / np.sum(shares, axis=1, keepdims=True)
    E, nu = (np.array([getattr(each, name) for each in materials]) for name in ("young_kpa", "poisson"))
    mu, lam = (shares @ constant for constant in lame(E, nu))
    return Tissue(mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu)), materials[0].stress_state)


def hooke(H, mu, lam) -> np.ndarray:
    """Stress (..., d, d) kPa of displacement gradients H (..., d, d); Lame's constants (...) kPa."""
    mu, lam = (np.asarray(constant)[..., None, None] for constant in (mu, lam))
    return lam * np.trace(H, axis1=-2, axis2=-1)[..., None, None] * np.eye(H.shape[-1]) + mu * (H + H.swapaxes(-1, -2))


def stiffness(space: Space, material: Material | Tissue, cells=None) -> csc_array:
    """K (n_dof, n_dof) kPa mm^(d-2), in the plane per mm of thickness; symmetric. With `cells`, only their share: their
    element stiffness."""
    split = space.parts
    chosen = np.ones(split.n_parts, bool) if cells is None else np.isin(split.cell, cells)
    return stiffness_of_parts(space, material, chosen)


def stiffness_of_parts(space: Space, material: Material | Tissue, chosen) -> csc_array:
    """The share of the `chosen` parts (p,) bool in K (n_dof, n_dof) kPa.

    Plain and Heaviside parts carry constant gradients, so their integrals are exact. Parts with branch functions are
    integrated by the tip-adapted rule.
    """
    split, table = space.parts, space.enrichment
    branched = np.zeros(split.n_parts, dtype=bool)
    branched[space.branch_parts] = True
    plain = np.flatnonzero(chosen & ~branched)
    mu, lam = material.moduli_in(split.cell)
    volume = np.bincount(split.part, split.volumes, split.n_parts)[plain]
    tip_rows, blocks = np.empty((0, 1), np.int64), np.empty((0, 1, 1))
    about_tip = np.flatnonzero((chosen & branched)[split.part])
    if len(about_tip):
        points, weights, owner = tip_rule(split.corners[about_tip], split.fronts.at)
        parts = split.part[about_tip][owner]
        blocks, tip_rows = tip_blocks(space, points, weights, parts, lam, mu)
    gradients = space.mesh.gradients[split.cell[plain]]
    return assemble(table.n_rows, table.dof[plain], gradients, lam[plain] * volume, mu[plain] * volume, tip_rows,
                    blocks)


def plain_blocks(gradients, lam, mu) -> np.ndarray:
    """Stiffness (k, (d + 1) d, (d + 1) d) kPa of linear simplices with gradients (k, d + 1, d) 1/mm, of each degree of
    freedom d a + i; lam, mu (k,) kPa mm^d: Lame's constants times its volume."""
    k, corners, d = gradients.shape
    M = gradients.reshape(k, -1, 1) * gradients.reshape(k, 1, -1)
    crossed = mu[:, None, None] * M
    K = (lam[:, None, None] * M).reshape(k, corners, d, corners, d) + crossed.reshape(
        k, corners, d, corners, d).swapaxes(2, 4)
    K[:, :, range(d), :, range(d)] += np.einsum("k,kai,kbi->kab", mu, gradients, gradients)
    return K.reshape(k, corners * d, corners * d)
