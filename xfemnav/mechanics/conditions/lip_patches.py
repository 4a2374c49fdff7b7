"""A blade's patch of a lip in space: all of the lip inside a window of chart coordinates, its edges exact."""

import numpy as np
from numba import njit

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.mesh import area_vectors
from xfemnav.geometry.solid.staircase import divide
from xfemnav.mechanics.space.quadrature import gauss_in_simplex

#: Elements by which a blade stays away from the border of its cut: a lip held right up to it has infinite energy.
MARGIN = 2.0
#: A blade that holds less than this part of what was asked is told of.
LOST = 0.98


def held_patch(space, cuts, retraction) -> np.ndarray:
    """The window (2, 3) of chart coordinates, from and to, that a blade holds: what was asked along the mouth and in
    depth, and two elements short of the cut's border inside the organ (W404 of a blade that was given and loses by it).
    Raises XfemnavError E402 when that is nothing."""
    cut, lips = cuts[retraction.cut], space.parts.lips
    own = np.flatnonzero(lips.cut == retraction.cut)
    if not len(own):
        raise XfemnavError("E402", f"cut '{cut.name}' has no tissue on its two sides, so no blade can hold it.")
    margin = MARGIN * float(space.mesh.sizes[space.parts.cell[lips.parts[own]]].mean())
    asked = np.array([_ends(retraction.blade_along), _ends(retraction.blade, cut.mouth), (-np.inf, np.inf)]).T
    held = asked.copy()
    held[0, 2] = margin
    kept, whole = _area(lips, own, held), _area(lips, own, asked)
    if not kept > 0:
        raise XfemnavError("E402", f"of {whole:.3g} mm2 that a blade should hold of cut '{cut.name}' nothing is "
                                   "farther than "
                                   f"two elements ({margin:.1f} mm) from the cut's border; use a larger cut, another "
                                   "part "
                                   "of it, or smaller elements (⟦corridor_element_mm⟧).")
    given = retraction.blade_along is not None or (retraction.blade is not None and retraction.blade_given)
    if given and kept < LOST * whole:
        warn("W404", f"the blade on cut '{cut.name}' came within two elements ({margin:.1f} mm) of the cut's border "
                     "and was "
                     f"shortened: it holds {kept:.0f} of {whole:.0f} mm2.")
    return held


def _ends(span, open_at_0=True):
    """The ends of a part of a cut; without an end where it is one of the cut's own, which lies in no tissue."""
    low, high = span or (0.0, 1.0)
    return -np.inf if low == 0 and open_at_0 else low, np.inf if high == 1 else high


def _area(lips, facets, window):
    shares, owner = _clipped(lips, facets, window)
    return float(np.linalg.norm(area_vectors(shares @ lips.facets[owner]), axis=1).sum())


def patch_points(lips, cut: int, window, n: int):
    """Gauss points of a cut's lip in a window (2, c): the points (q, 3) mm, weights (q,) mm^2, depth (q,), the facet
    (q,) of each, and the left normals there (q, 3); n^2 points in each triangle."""
    shares, owner = _clipped(lips, np.flatnonzero(lips.cut == cut), np.asarray(window, float))
    corners = shares @ lips.facets[owner]
    area = np.linalg.norm(area_vectors(corners), axis=1)
    at, weights = gauss_in_simplex(2, n)
    facet = np.repeat(owner, len(weights))
    left = -area_vectors(lips.facets)[facet]
    depth = (at @ shares @ lips.at[owner])[..., 1].ravel()
    return ((at @ corners).reshape(-1, 3), np.outer(area, weights).ravel(), depth, facet,
            left / np.linalg.norm(left, axis=1)[:, None])


def _clipped(lips, facets, window):
    """Triangles (t, 3, 3) inside the window, by their shares of the corners of facets (t,)."""
    bounds = [(axis, sign, end) for axis, ends in enumerate(window.T) for sign, end in zip((1, -1), ends)
              if np.isfinite(end)]
    values = np.array([sign * (lips.at[facets][..., axis] - end) for axis, sign, end in bounds])
    shares, owner = _inside(values.reshape(len(bounds), len(facets), 3))
    area = np.linalg.norm(area_vectors(shares @ lips.facets[facets[owner]]), axis=1)
    some = area > 1e-14 * area.max(initial=0.0)
    return shares[some], facets[owner[some]]


@njit(cache=True)
def _inside(values):
    """What of each of f triangles has all functions positive, whose values at the corners are (b, f, 3)."""
    n_bounds, n_facets, _ = values.shape
    found, owner, n = np.empty((n_facets, 3, 3)), np.empty(n_facets, np.int64), 0
    nodal = np.empty(3)
    for f in range(n_facets):
        work, count = np.eye(3).reshape(1, 3, 3), 1
        for b in range(n_bounds):
            above, n_above, below = np.empty((4, 3, 3)), 0, np.empty((4, 3, 3))
            for s in range(count):
                for i in range(3):
                    nodal[i] = 0.0
                    for j in range(3):
                        nodal[i] += work[s, i, j] * values[b, f, j]
                above, n_above, below, _ = divide(work[s], nodal, 1e-14, above, n_above, below, 0)
            work, count = above, n_above
        if n + count > len(found):
            larger, owners = np.empty((2 * (n + count), 3, 3)), np.empty(2 * (n + count), np.int64)
            larger[:n], owners[:n] = found[:n], owner[:n]
            found, owner = larger, owners
        for s in range(count):
            found[n], owner[n] = work[s], f
            n += 1
    return found[:n], owner[:n]
