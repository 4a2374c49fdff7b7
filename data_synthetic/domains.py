"""Outlines with a name: closed loops (n, 2) mm, counter-clockwise, the last point not repeated."""

from math import pi

import numpy as np
from shapely import Point, box, union_all
from shapely.geometry.polygon import orient


def disc(radius: float = 70.0, n: int = 360, centre=(0.0, 0.0)) -> np.ndarray:
    """Regular `n`-gon (n, 2) mm on a circle; with n divisible by 4 it has corners at all four extremes."""
    angle = 2 * pi * np.arange(n) / n
    return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def ellipse(a: float = 68.0, b: float = 84.0, n: int = 360, centre=(0.0, 0.0)) -> np.ndarray:
    """Ellipse (n, 2) mm with semi-axes `a` along the first axis and `b` along the second."""
    return np.asarray(centre) + disc(1.0, n) * (a, b)


def rectangle(width: float, height: float, centre=(0.0, 0.0)) -> np.ndarray:
    """The four corners (4, 2) mm, the lower left one first."""
    return np.asarray(centre) + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, height / 2)


def dumbbell(radius: float = 20.0, distance: float = 60.0, bridge: float = 8.0) -> np.ndarray:
    """Two discs `distance` mm apart (centres), joined by a bridge `bridge` mm wide: a cut across it divides it."""
    ends = [Point(x, 0).buffer(radius, quad_segs=32) for x in (-distance / 2, distance / 2)]
    return _loop(union_all([*ends, box(-distance / 2, -bridge / 2, distance / 2, bridge / 2)]))


def gyrated(radius: float = 60.0, depth: float = 6.0, folds: int = 9, n: int = 720) -> np.ndarray:
    """Disc (n, 2) mm whose radius swings `folds` times by +-`depth` mm, like a brain's surface."""
    return (1 + depth / radius * np.cos(folds * 2 * pi * np.arange(n) / n))[:, None] * disc(radius, n)


def _loop(polygon) -> np.ndarray:
    return np.array(orient(polygon).exterior.coords)[:-1]


def area(outline) -> float:
    """Area mm^2 inside a loop (n, 2), positive when it is counter-clockwise."""
    (x, y), (x1, y1) = np.transpose(outline), np.transpose(np.roll(outline, -1, axis=0))
    return float(np.sum(x * y1 - x1 * y) / 2)
