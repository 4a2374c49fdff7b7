"""Displacement fields in closed form, with the stress that belongs to them.

Every field has `displacement(points, side)` (n, 2) mm and `gradient(points, side)` (n, 2, 2), du_i/dx_j; the elastic
ones also have `stress(points, side)` (n, 3) xx, yy, xy in the unit of `mu`. `points` are (n, 2) mm in the plane. On a
cut a field has two values: `side` is +1 for the left lip and -1 for the right one, walking towards the tip; 0 (the
default) leaves the choice to the point. One number serves for all points, or (n,) numbers one each.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from xfemnav.geometry.mesh import frozen_array


def kolosov(nu: float, stress_state: str = "strain") -> float:
    """Kolosov's constant kappa: 3 - 4 nu in plane strain, (3 - nu) / (1 + nu) in plane stress."""
    return {"strain": 3 - 4 * nu, "stress": (3 - nu) / (1 + nu)}[stress_state]


def frame(direction) -> np.ndarray:
    """Rotation (2, 2) whose rows are the unit vector along `direction` and its left normal."""
    d = np.asarray(direction, float) / np.linalg.norm(direction)
    return np.array([d, [-d[1], d[0]]])


def _angle(y, x, side) -> np.ndarray:
    """Angle (n,) rad about a tip, on the branch of `side`.

    The branch cut of arctan2 is the physical cut: the side, not the sign of y, picks the lip. A branch goes on
    smoothly for a quarter turn beyond its lip, so that a lip met with rounding error still has its own value.
    """
    theta = np.arctan2(y, x)
    return np.where(side * theta < -pi / 2, theta + 2 * pi * np.asarray(side), theta)


def _symmetric(xx, yy, xy) -> np.ndarray:
    return np.moveaxis(np.array([[xx, xy], [xy, yy]]), -1, 0)


def _gradient(stress, rotation, mu, kappa) -> np.ndarray:
    """du_i/dx_j (n, 2, 2) from stress (n, 2, 2) by Hooke's law and the rotation (n,), half of du_y/dx - du_x/dy."""
    mean = np.einsum("nii->n", stress)[:, None, None] * np.eye(2)
    strain = (stress - (3 - kappa) / 4 * mean) / (2 * mu)
    return strain + rotation[:, None, None] * np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class _CrackField:
    """A field given in a crack's own frame: first axis along `direction`, second axis to its left.

    Subclasses say where points are (`_polar`), and the displacement, stress and rotation there, all in that frame.
    """

    def displacement(self, points, side=0) -> np.ndarray:
        """Displacement (n, 2) mm."""
        return self._displacement(*self._polar(points, side)).T @ frame(self.direction)

    def gradient(self, points, side=0) -> np.ndarray:
        """Displacement gradient (n, 2, 2), du_i/dx_j."""
        stress, rotation = self._stress(*self._polar(points, side))
        Q = frame(self.direction)
        return Q.T @ _gradient(stress, rotation, self.mu, self.kappa) @ Q

    def stress(self, points, side=0) -> np.ndarray:
        """Stress (n, 3) xx, yy, xy in the unit of `mu`."""
        Q = frame(self.direction)
        stress = Q.T @ self._stress(*self._polar(points, side))[0] @ Q
        return stress[:, [0, 1, 0], [0, 1, 1]]

    @property
    def kappa(self) -> float:
        """Kolosov's constant of the material."""
        return kolosov(self.nu, self.stress_state)


@dataclass(frozen=True, eq=False)
class Williams(_CrackField):
    """First term of Williams' series at a crack tip (Williams, J. Appl. Mech. 24, 1957): K_I opens, K_II slides.

    `K_I`, `K_II` in unit(mu) mm^.5: with the default mu = 1 they are K / mu. `tip` (2,) mm; `direction` (2,) is ahead
    of the tip, so that the cut is the half-line behind it.
    """

    tip: tuple[float, float]
    direction: tuple[float, float]
    K_I: float = 0.0
    K_II: float = 0.0
    nu: float = 0.45
    mu: float = 1.0
    stress_state: str = "strain"

    def _polar(self, points, side):
        """Distance from the tip and half the angle, both (n,)."""
        x, y = frame(self.direction) @ (np.asarray(points, float) - self.tip).T
        return np.hypot(x, y), _angle(y, x, side) / 2

    def _displacement(self, r, half):
        s, c, kappa, K_I, K_II = np.sin(half), np.cos(half), self.kappa, self.K_I, self.K_II
        return np.sqrt(r / (2 * pi)) / (2 * self.mu) * np.array([
            K_I * c * (kappa - 1 + 2 * s**2) + K_II * s * (kappa + 1 + 2 * c**2),
            K_I * s * (kappa + 1 - 2 * c**2) - K_II * c * (kappa - 1 - 2 * s**2)])

    def _stress(self, r, half):
        s, c, s3, c3, K_I, K_II = np.sin(half), np.cos(half), np.sin(3 * half), np.cos(3 * half), self.K_I, self.K_II
        with np.errstate(divide="ignore", invalid="ignore"):    # the stress at the tip is infinite
            w = 1 / np.sqrt(2 * pi * r)
            stress = _symmetric(w * (K_I * c * (1 - s * s3) - K_II * s * (2 + c * c3)),
                                w * (K_I * c * (1 + s * s3) + K_II * s * c * c3),
                                w * (K_I * s * c * c3 + K_II * c * (1 - s * s3)))
            rotation = -(self.kappa + 1) / (4 * self.mu) * w * (K_II * c + K_I * s)
        return stress, rotation


@dataclass(frozen=True, eq=False)
class CentreCrack(_CrackField):
    """Straight crack of half-length `a` in an infinite plate under a uniform far stress (xx, yy, xy).

    The stress is in the unit of `mu`. Westergaard's functions of both modes (Westergaard, J. Appl. Mech. 6, 1939; Sih
    1966) with the uniform field that they leave out. `direction` (2,) runs along the crack, from which `side` is
    counted. The field is fixed up to a rigid motion.
    """

    direction: tuple[float, float]
    far_stress: tuple[float, float, float] = (0.0, 1.0, 0.0)
    a: float = 1.0
    centre: tuple[float, float] = (0.0, 0.0)
    nu: float = 0.3
    mu: float = 1.0
    stress_state: str = "strain"

    @property
    def far(self) -> np.ndarray:
        """Far stress (2, 2) in the crack's frame."""
        xx, yy, xy = self.far_stress
        Q = frame(self.direction)
        return Q @ np.array([[xx, xy], [xy, yy]]) @ Q.T

    @property
    def K(self) -> tuple[float, float]:
        """Stress intensities (K_I, K_II) at the end that `direction` points to: sqrt(pi a) times the far traction."""
        return float(np.sqrt(pi * self.a) * self.far[1, 1]), float(np.sqrt(pi * self.a) * self.far[0, 1])

    def _polar(self, points, side):
        """The point as z = x + iy and sqrt(z^2 - a^2), whose branch cut is the crack, both (n,) complex."""
        x, y = frame(self.direction) @ (np.asarray(points, float) - self.centre).T
        ends = _angle(y, x - self.a, side) + _angle(y, x + self.a, side)
        return x + 1j * y, np.sqrt(np.hypot(x - self.a, y) * np.hypot(x + self.a, y)) * np.exp(0.5j * ends)

    @property
    def _loads(self):
        """Far stress that opens, that slides, and what is left of the stress along the crack."""
        return self.far[1, 1], self.far[0, 1], self.far[0, 0] - self.far[1, 1]

    def _displacement(self, z, root):
        normal, shear, along = self._loads
        k, x, y = self.kappa, z.real, z.imag
        with np.errstate(divide="ignore", invalid="ignore"):
            Z = np.where(y == 0, 0, z / root)    # y Z vanishes on the crack's line, also at its ends
        return np.array([
            normal * ((k - 1) / 2 * root.real - y * Z.imag) + shear * ((k + 1) / 2 * root.imag + y * Z.real)
            + along * (k + 1) / 4 * x,
            normal * ((k + 1) / 2 * root.imag - y * Z.real) - shear * ((k - 1) / 2 * root.real + y * Z.imag)
            - along * (3 - k) / 4 * y]) / (2 * self.mu)

    def _stress(self, z, root):
        normal, shear, along = self._loads
        y = z.imag
        with np.errstate(divide="ignore", invalid="ignore"):    # the stress at the ends is infinite
            Z, dZ = z / root, -(self.a**2) / root**3
        stress = _symmetric(normal * (Z.real - y * dZ.imag) + shear * (2 * Z.imag + y * dZ.real) + along,
                            normal * (Z.real + y * dZ.imag) - shear * y * dZ.real,
                            -normal * y * dZ.real + shear * (Z.real - y * dZ.imag))
        rotation = (self.kappa + 1) / (4 * self.mu) * (normal * Z.imag - shear * Z.real)
        return stress, rotation


@dataclass(frozen=True, eq=False)
class Linear:
    """u = G x + shift, everywhere the same gradient: `G` (2, 2), `shift` (2,) mm."""

    G: np.ndarray
    shift: np.ndarray = (0.0, 0.0)

    def __post_init__(self):
        object.__setattr__(self, "G", frozen_array(self.G, float, (2, 2), "G"))
        object.__setattr__(self, "shift", frozen_array(self.shift, float, (2,), "shift"))

    def displacement(self, points, side=0) -> np.ndarray:
        """Displacement (n, 2) mm; the field is continuous, so `side` changes nothing."""
        return np.asarray(points, float) @ self.G.T + self.shift

    def gradient(self, points, side=0) -> np.ndarray:
        """Displacement gradient (n, 2, 2)."""
        return np.broadcast_to(self.G, (len(points), 2, 2))


def rigid(angle: float, shift=(0.0, 0.0), centre=(0.0, 0.0)) -> Linear:
    """Rotation by `angle` rad (counter-clockwise) about `centre` (2,) mm, then a `shift` (2,) mm."""
    G = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) - np.eye(2)
    return Linear(G, np.asarray(shift, float) - G @ np.asarray(centre, float))


def resting(field, points, side=0, *, tolerance: float = 1e-10) -> np.ndarray:
    """Resting places x (n, 2) mm with x + u(x) = `points`, by Newton's method on the branch of `side`.

    Points whose iteration does not come within `tolerance` mm are NaN. A result beyond the lip of `side` lies on the
    branch's continuation and is no tissue: the caller keeps what lies on the right side.
    """
    points = np.asarray(points, float)
    x = points - field.displacement(points, side)
    side, open_ = np.broadcast_to(side, len(x)), np.arange(len(x))
    for _ in range(50):
        error = x[open_] + field.displacement(x[open_], side[open_]) - points[open_]
        wrong = ~(np.linalg.norm(error, axis=1) <= tolerance)
        open_, error = open_[wrong], error[wrong]
        if not len(open_):
            break
        (a, b), (c, d) = np.moveaxis(np.eye(2) + field.gradient(x[open_], side[open_]), 0, -1)
        x[open_] -= (np.array([[d, -b], [-c, a]]) / (a * d - b * c) * error.T).sum(axis=1).T
    x[open_] = np.nan
    return x


@dataclass(frozen=True, eq=False)
class Sum:
    """Two fields added: displacements and gradients."""

    first: Williams | CentreCrack | Linear
    second: Williams | CentreCrack | Linear

    def displacement(self, points, side=0) -> np.ndarray:
        """Displacement (n, 2) mm."""
        return self.first.displacement(points, side) + self.second.displacement(points, side)

    def gradient(self, points, side=0) -> np.ndarray:
        """Displacement gradient (n, 2, 2)."""
        return self.first.gradient(points, side) + self.second.gradient(points, side)
