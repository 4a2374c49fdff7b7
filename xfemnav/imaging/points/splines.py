"""Curves through control points, as 3D Slicer draws them.

Its curve (VTK's cardinal spline with Slicer's settings) is the cubic spline with continuous second derivatives whose
parameter grows by 1 from one control point to the next, however far apart they are. At the ends of an open one the
derivative along the parameter is 0; a closed one is periodic. Slicer shows ten chords from point to point.
"""

import numpy as np
from scipy.interpolate import CubicSpline

LIMIT_VERTICES = 1_000_000


def drawn(points, closed: bool, chord_mm: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (m, 3) mm of the curve through control `points` (n, 3), and the indices (n,) of these among them.

    No chord is farther than `chord_mm` from the curve. `closed`: the last vertex is the one before the first.
    Raises ValueError when there would be more than a million vertices.
    """
    points = np.asarray(points, float)
    through = np.vstack([points, points[:1]]) if closed else points
    knots = np.arange(len(through))
    spline = CubicSpline(knots, through, bc_type="periodic" if closed else "clamped")
    # A chord over the parameter h leaves a cubic by at most max|p''| h^2 / 8, and |p''| is largest at an end.
    bend = np.linalg.norm(spline(knots, 2), axis=1)
    pieces = np.maximum(np.ceil(np.sqrt(np.maximum(bend[:-1], bend[1:]) / (8 * chord_mm))), 1).astype(int)
    starts = np.concatenate([[0], np.cumsum(pieces)])
    if starts[-1] > LIMIT_VERTICES:
        raise ValueError(f"the curve needs {starts[-1]} vertices; at most {LIMIT_VERTICES} are made")
    at = starts[:len(points)]
    parts = (np.arange(starts[-1]) - np.repeat(starts[:-1], pieces)) / np.repeat(pieces, pieces)
    t = np.repeat(knots[:-1], pieces) + parts
    vertices = spline(t if closed else np.append(t, knots[-1]))
    vertices[at] = points  # not rounded
    return vertices, at
