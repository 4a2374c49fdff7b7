"""Linear elasticity in the plane: one material or one a cell, and the stiffness matrix K."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array
from xfemnav.mechanics.assembly import assemble
from xfemnav.mechanics.quadrature import tip_rule
from xfemnav.mechanics.space import Space
from xfemnav.mechanics.tip_stiffness import tip_blocks


@dataclass(frozen=True)
class Material:
    """Isotropic linear elasticity: Young's modulus kPa, Poisson's ratio, plane 'strain' or 'stress'.

    Raises XfemnavError E404 for constants out of range.
    """

    young_kpa: float = 3.0
    poisson: float = 0.45
    stress_state: str = "strain"

    def __post_init__(self):
        if not (np.isfinite(self.young_kpa) and self.young_kpa > 0):
            raise XfemnavError("E404", f"Young's modulus is {self.young_kpa:g} kPa; it must be positive.")
        if not 0 <= self.poisson <= 0.499:
            raise XfemnavError("E404", f"Poisson's ratio is {self.poisson:g}; it must lie in 0..0.499.")
        if self.stress_state not in ("strain", "stress"):
            raise XfemnavError("E404", f"stress state is {self.stress_state!r}; it must be 'strain' or 'stress'.")

    @property
    def stiffness(self) -> np.ndarray:
        """D (3, 3) kPa: stress (xx, yy, xy) from strain (xx, yy, 2 xy)."""
        E, nu = self.young_kpa, self.poisson
        if self.stress_state == "stress":
            return E / (1 - nu**2) * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
        return E / ((1 + nu) * (1 - 2 * nu)) * np.array([[1 - nu, nu, 0], [nu, 1 - nu, 0], [0, 0, (1 - 2 * nu) / 2]])

    @property
    def shear_modulus(self) -> float:
        """mu, kPa."""
        return self.young_kpa / (2 * (1 + self.poisson))

    @property
    def kappa(self) -> float:
        """Kolosov's constant: 3 - 4 nu in plane strain, (3 - nu) / (1 + nu) in plane stress."""
        nu = self.poisson
        return 3 - 4 * nu if self.stress_state == "strain" else (3 - nu) / (1 + nu)

    def at(self, cell: int) -> "Material":
        """The material of a cell: this one."""
        return self

    def young_in(self, cells) -> np.ndarray:
        """Young's modulus (k,) kPa in cells (k,)."""
        return np.full(len(cells), self.young_kpa)

    def lame_in(self, cells) -> tuple[np.ndarray, np.ndarray]:
        """Lame's constants mu and lambda, each (k,) kPa, of the solid in cells (k,)."""
        return lame(self.young_in(cells), np.full(len(cells), self.poisson))

    def stiffness_in(self, cells) -> np.ndarray:
        """D (k, 3, 3) kPa in cells (k,)."""
        return np.broadcast_to(self.stiffness, (len(cells), 3, 3))


@dataclass(frozen=True, eq=False)
class Tissue:
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

    def lame_in(self, cells) -> tuple[np.ndarray, np.ndarray]:
        """Lame's constants mu and lambda, each (k,) kPa, of the solid in cells (k,)."""
        return lame(self.young_kpa[cells], self.poisson[cells])

    def stiffness_in(self, cells) -> np.ndarray:
        """D (k, 3, 3) kPa in cells (k,)."""
        different, which = np.unique(
            np.stack([self.young_kpa[cells], self.poisson[cells]], axis=1), axis=0, return_inverse=True
        )
        D = np.array([Material(E, nu, self.stress_state).stiffness for E, nu in different.tolist()])
        return D.reshape(-1, 3, 3)[which.ravel()]


def lame(young, poisson) -> tuple[np.ndarray, np.ndarray]:
    """Lame's constants mu and lambda, in the unit of Young's modulus, of a solid."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def mixed(materials: tuple[Material, ...], shares) -> Tissue:
    """Tissue of cells that hold `materials` by `shares` (m, k) of their area: Lame's constants in proportion."""
    shares = np.asarray(shares, float) / np.sum(shares, axis=1, keepdims=True)
    E, nu = (np.array([getattr(each, name) for each in materials]) for name in ("young_kpa", "poisson"))
    mu, lam = (shares @ constant for constant in lame(E, nu))
    return Tissue(mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu)), materials[0].stress_state)


def strain_operator(gradient) -> np.ndarray:
    """Rows xx, yy, 2 xy (..., 3, 2 a) of the strain of basis functions with gradients (..., a, 2); DOF 2 a + i."""
    B = np.zeros((*gradient.shape[:-2], 3, 2 * gradient.shape[-2]))
    B[..., 0, 0::2], B[..., 1, 1::2] = gradient[..., 0], gradient[..., 1]
    B[..., 2, 0::2], B[..., 2, 1::2] = gradient[..., 1], gradient[..., 0]
    return B


def stiffness(space: Space, material: Material | Tissue, cells=None) -> csc_array:
    """K (n_dof, n_dof) kPa, per mm of thickness; symmetric. With `cells`, only their share: their element stiffness."""
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
    mu, lam = material.lame_in(split.cell)
    if material.stress_state == "stress":
        lam = 2 * lam * mu / (lam + 2 * mu)
    area = np.bincount(split.part, split.volumes, split.n_parts)[plain]
    tip_rows, blocks = np.empty((0, 3), np.int64), np.empty((0, 6, 6))
    about_tip = np.flatnonzero((chosen & branched)[split.part])
    if len(about_tip):
        points, weights, owner = tip_rule(split.corners[about_tip], split.fronts.at)
        parts = split.part[about_tip][owner]
        blocks, tip_rows = tip_blocks(space, points, weights, parts, lam, mu)
    gradients = space.mesh.gradients[split.cell[plain]]
    return assemble(table.n_rows, table.dof[plain], gradients, lam[plain] * area, mu[plain] * area, tip_rows, blocks)


def plain_blocks(gradients, area, D) -> np.ndarray:
    """K_c = area B'DB (k, 6, 6) kPa of linear triangles with gradients (k, 3, 2) 1/mm, area (k,) mm^2, D (k, 3, 3)."""
    B = strain_operator(gradients)
    return B.swapaxes(1, 2) @ (area[:, None, None] * D) @ B


def stress_matrices(strain: list[csr_array], D) -> list[csr_array]:
    """Three matrices (q, n_dof): stress xx, yy, xy from the DOFs, from `strain_matrices` and D (q, 3, 3) kPa."""
    return [csr_array(sum(strain[t].multiply(D[:, s, t, None]) for t in range(3))) for s in range(3)]


def strain_matrices(space: Space, points, parts) -> list[csr_array]:
    """Three matrices (k, n_dof), 1/mm: strain xx, yy, 2 xy at points (k, 2) in parts (k,) from the DOFs."""
    gx, gy = space.gradient_in(points, parts)
    return [_spread(gx, None), _spread(None, gy), _spread(gy, gx)]


def _spread(first, second):
    """Interleave the columns of two (k, n) matrices into (k, 2 n): component i of row r is DOF 2 r + i."""
    parts = [(m.tocoo(), i) for i, m in ((0, first), (1, second)) if m is not None]
    shape = (parts[0][0].shape[0], 2 * parts[0][0].shape[1])
    data = np.concatenate([m.data for m, _ in parts])
    rows = np.concatenate([m.row for m, _ in parts])
    columns = np.concatenate([2 * m.col + i for m, i in parts])
    return csr_array((data, (rows, columns)), shape)
