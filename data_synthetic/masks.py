"""Random masks, from plain to nasty: lobes, fjords, holes, narrow isthmuses, loose parts, tiny and huge."""

import numpy as np
from scipy import ndimage

KINDS = ("lobes", "fjords", "isthmus", "holes", "parts", "noise", "tiny", "huge")


def random_mask(rng: np.random.Generator, kind: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """One mask (n1, n2) bool, not empty and with background all around, and its spacing (2,) mm.

    `kind` is one of `KINDS`, by default a random one. Same state of `rng`, same mask.
    """
    kind = kind or KINDS[rng.integers(len(KINDS))]
    reach = {"tiny": rng.uniform(4, 9), "huge": rng.uniform(150, 230)}.get(kind, rng.uniform(25, 80))
    x, y = _grid(int(2.9 * reach) + 8, rng)
    mask = _lobed(x, y, reach, rng, roughness=rng.uniform(0, 0.25))
    if kind in CHANGES:
        mask = CHANGES[kind](mask, x, y, reach, rng)
    mask[[0, -1]] = mask[:, [0, -1]] = False
    return mask, rng.uniform(0.5, 1.5) * np.array([1.0, rng.uniform(0.7, 1.4) if rng.random() < 0.3 else 1.0])


def _grid(n, rng):
    """Pixel coordinates x, y (n, n), counted from a centre that is no pixel's, turned at random."""
    x, y = np.meshgrid(np.arange(n) - n / 2 + rng.uniform(-0.5, 0.5), np.arange(n) - n / 2, indexing="ij")
    angle = rng.uniform(0, 2 * np.pi)
    return np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x


def _lobed(x, y, reach, rng, roughness):
    """Star-shaped blob: a radius of `reach` pixels with random harmonics, stretched."""
    angle, radius = np.arctan2(y, x), np.hypot(x, y * rng.uniform(1, 1.6))
    wave = np.ones_like(angle)
    for k in range(2, rng.integers(4, 13)):
        wave += roughness / k**0.7 * rng.normal() * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    return radius < reach * np.clip(wave, 0.25, 1.3)


def _with_fjords(mask, x, y, reach, rng):
    """Cut by 1 to 6 channels of background, 1 to 8 pixels wide, from outside towards the middle."""
    mask = mask.copy()
    for angle in rng.uniform(0, 2 * np.pi, rng.integers(1, 7)):
        along, aside = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
        bend = 0.1 * reach * np.sin(along / reach * rng.uniform(0, 6))
        mask &= (along < rng.uniform(0.15, 0.7) * reach) | (np.abs(aside - bend) > rng.uniform(0.5, 4))
    return mask


def _with_isthmus(mask, x, y, reach, rng):
    """Two discs joined by a bar 2 to 12 pixels wide."""
    r = rng.uniform(0.35, 0.5, 2) * reach
    ends = np.hypot(x - 0.8 * reach, y) < r[0], np.hypot(x + 0.8 * reach, y) < r[1]
    return ends[0] | ends[1] | ((np.abs(y) < rng.uniform(1, 6)) & (np.abs(x) < 0.8 * reach))


def _with_holes(mask, x, y, reach, rng):
    """With 1 to 5 round holes, some of a single pixel."""
    mask = mask.copy()
    for _ in range(rng.integers(1, 6)):
        cx, cy, r = *rng.uniform(-0.5, 0.5, 2) * reach, rng.uniform(0.5, 0.2 * reach)
        mask &= np.hypot(x - cx, y - cy) > r
    return mask


def _with_parts(mask, x, y, reach, rng):
    """Shrunk, with 1 to 4 loose discs about it."""
    mask = ndimage.binary_erosion(mask, iterations=int(0.3 * reach))
    mask |= np.hypot(x, y) < 0.3 * reach
    for angle in rng.uniform(0, 2 * np.pi, rng.integers(1, 5)):
        mask |= np.hypot(x - reach * np.cos(angle), y - reach * np.sin(angle)) < rng.uniform(1, 0.25 * reach)
    return mask


def _noise(mask, x, y, reach, rng):
    """Level set of smooth noise inside the blob: many parts, holes and necks of any width; never empty."""
    field = ndimage.gaussian_filter(rng.normal(size=mask.shape), reach / rng.uniform(6, 14))
    return (mask & (field > np.quantile(field[mask], rng.uniform(0.1, 0.4)))) | (np.hypot(x, y) < 0.15 * reach)


CHANGES = {
    "fjords": _with_fjords, "isthmus": _with_isthmus, "holes": _with_holes, "parts": _with_parts, "noise": _noise,
}
