"""Heads with skull and scalp in slices up to the vertex, in three contrasts, whose brain is known.

Brain, fluid, skull and scalp are ellipsoids one in the other: in the slice at height 0 the brain is the ellipse of
`phantom.py` with its gyri. Towards the vertex it shrinks, and the shells are cut ever more aslant.
"""

from dataclasses import dataclass, field

import numpy as np

from .phantom import AIR, BRAIN, CSF, GM, SCALP, SKULL, T1, VENTRICLE, WM, Grid, Phantom, radius

HALF_HEIGHT = 70.0  # mm, of the brain
SHELLS = {SCALP: 14.0, SKULL: 9.0, CSF: 3.0}  # mm from the brain's surface to a shell's own, outermost first
CORTEX = 4.0  # mm
ROOF = 25.0  # mm: the ventricles end below
FLAIR = {AIR: 0, CSF: 120, SKULL: 60, SCALP: 700, GM: 620, WM: 520, VENTRICLE: 120}
T2 = {AIR: 0, CSF: 1000, SKULL: 60, SCALP: 650, GM: 560, WM: 420, VENTRICLE: 1000}
CONTRASTS = {"t1": T1, "t2": T2, "flair": FLAIR}
NOISE = 15.0


@dataclass(frozen=True)
class Head:
    """A head in one of `CONTRASTS`, on a `grid` of pixels in each of its axial slices."""

    contrast: str = "t1"
    grid: Grid = field(default=Grid((192, 224), (1.0, 1.0)))

    def labels_at(self, points, height: float) -> np.ndarray:
        """Label (n,) uint8 at points (n, 2) mm of the slice `height` mm above the middle."""
        x, y = np.asarray(points, float).T
        rho, angle = np.hypot(x, y), np.arctan2(y, x)
        label = np.full(len(rho), AIR, np.uint8)
        for tissue, thickness in SHELLS.items():
            label[rho < _edge(angle, height, thickness)] = tissue
        brain = _edge(angle, height)
        label[rho < brain] = GM
        label[rho < brain - CORTEX] = WM
        if abs(height) < ROOF:
            below = Phantom().labels_at(points)
            label[below == VENTRICLE] = VENTRICLE
        return label

    def mask(self, height: float) -> np.ndarray:
        """Brain (n1, n2) bool at the pixel centres."""
        labels = self.labels_at(self.grid.centres().reshape(-1, 2), height)
        return np.isin(labels, BRAIN).reshape(self.grid.shape)

    def image(self, height: float, seed: int | None = 0) -> np.ndarray:
        """Image (n1, n2), blurred and with the coil's bias as `Phantom.scan`; a `seed` adds Rician noise of sigma 15,
        None leaves the air at exactly 0."""
        table = np.array([CONTRASTS[self.contrast].get(label, 0.0) for label in range(8)], float)
        clean = Phantom(grid=self.grid).scan(lambda points: table[self.labels_at(points, height)], self.grid.centres())
        if seed is None:
            return clean
        noise = np.random.default_rng([seed, round(10 * height) % 2**32]).normal(0, NOISE, (2, *self.grid.shape))
        return np.hypot(clean + noise[0], noise[1])

    def volume(self, heights, seed: int | None = 0) -> tuple[np.ndarray, np.ndarray]:
        """Image and brain mask (n1, n2, n3) of slices at `heights` (n3,) mm."""
        return (np.stack([self.image(height, seed) for height in heights], axis=-1),
                np.stack([self.mask(height) for height in heights], axis=-1))


def _edge(angle, height: float, thickness: float = 0.0) -> np.ndarray:
    """Radius mm, in the polar direction `angle` rad, of the surface `thickness` mm outside the brain; 0 above it."""
    share = max(0.0, 1 - (height / (HALF_HEIGHT + thickness)) ** 2)
    return (radius(angle) + thickness) * np.sqrt(share)
