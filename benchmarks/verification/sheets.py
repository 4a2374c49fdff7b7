"""Cuts in space for checks: a sheet woven of rows of places."""

import numpy as np

from xfemnav.geometry.solid.sheet import Sheet


def woven(vertices, chart, mouth, **named) -> Sheet:
    """A sheet of places (m, n, 3) mm, m of them down and n along, with chart coordinates (m, n, 2): its left is that of
    t x d. `mouth` (k, 3) mm, and what it is `named`."""
    m, n, _ = vertices.shape
    corner = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([corner, corner + 1, corner + n], axis=1),
                                np.stack([corner + 1, corner + n + 1, corner + n], axis=1)])
    return Sheet(vertices.reshape(-1, 3), triangles, chart.reshape(-1, 2), mouth, **named)
