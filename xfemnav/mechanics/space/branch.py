"""The crack-tip functions of Eq. (3) and their analytic derivatives."""

import numpy as np


def branch_functions(r, theta) -> np.ndarray:
    """F_1..F_4 (..., 4) mm^.5 at polar coordinates r mm, theta rad about the tip (Eq. 3).

    theta is 0 ahead of the tip and +pi, -pi on the left and right lip: F_1 alone jumps there.
    """
    s = np.sqrt(r)
    sin_half, cos_half, sin = np.sin(theta / 2), np.cos(theta / 2), np.sin(theta)
    return np.stack([s * sin_half, s * cos_half, s * sin_half * sin, s * cos_half * sin], axis=-1)


def branch_gradients(r, theta) -> np.ndarray:
    """Gradients (..., 4, 2) mm^-.5 of F_1..F_4 in the tip's frame: first axis along the cut's travel. r must be > 0."""
    s = np.sqrt(r)
    sin_half, cos_half, sin, cos = np.sin(theta / 2), np.cos(theta / 2), np.sin(theta), np.cos(theta)
    # By r, and by theta divided by r; both carry 1 / sqrt(r).
    by_r = np.stack([sin_half, cos_half, sin_half * sin, cos_half * sin], axis=-1) / 2
    by_theta = np.stack(
        [cos_half / 2, -sin_half / 2, cos_half * sin / 2 + sin_half * cos, -sin_half * sin / 2 + cos_half * cos],
        axis=-1,
    )
    cos, sin, s = cos[..., None], sin[..., None], s[..., None]
    return np.stack([cos * by_r - sin * by_theta, sin * by_r + cos * by_theta], axis=-1) / s[..., None]


def polar(points, tip, travel, reference) -> tuple[np.ndarray, np.ndarray]:
    """Polar coordinates r (n,) mm, theta (n,) rad of points (n, 2) about a tip (n, 2) with unit travel (n, 2).

    theta is the value nearest to `reference` (n,), the unwrapped angle of the part that the point is taken in: so the
    jump lies on the real cut, also behind a kink, and a point on a lip belongs to the lip of its part.
    """
    x = points - tip
    along = np.einsum("ni,ni->n", x, travel)
    across = travel[:, 0] * x[:, 1] - travel[:, 1] * x[:, 0]
    raw = np.arctan2(across, along)
    return np.hypot(along, across), reference + np.mod(raw - reference + np.pi, 2 * np.pi) - np.pi
