"""What a displacement field says where no tissue is: two ways to fill an opened cut.

A field has a value at every pixel, also in an opened cut, where nothing rested. Bridged from lip to lip, any viewer
shows it without a jump, but stretched lips are drawn across the gap. Or the lips' own values go on for one pixel and
beyond them a displacement leads out of the image, so that resampling gives background there.
"""

from itertools import product

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import bicgstab, splu

from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.solid import SolidPullBack
from xfemnav.imaging.carrying.warp import PullBack
from xfemnav.imaging.organ.masks import touched

NOWHERE = 1e4    # mm, farther than any image reaches
MANY = 60_000    # pixels of a gap from which on its equations are solved step by step
RESIDUAL = 1e-8    # of what drives them, then
HALVINGS = 12    # of a pixel, to find a lip: to 1/4096, which also bounds a link's weight


def bridged(motion: PullBack | SolidPullBack, empty, tissue: Motion | None = None) -> np.ndarray:
    """The field (n1, ..., d) mm of `motion` with a harmonic bridge over the pixels `empty` (n1, ...) bool.

    Between two near lips that is linear from one to the other. The tissue keeps its field, and takes the pixels next to
    it along where they are not `empty`, so that nothing is lost at the outline; what is farther outside stays at 0.
    With the `tissue` the bridge ends where the lips are, else at the pixels next to them; then a reader that
    interpolates between pixels is off by up to a pixel at a lip instead of a quarter.
    """
    field = _carried(motion, ~empty)
    places = np.argwhere(empty)
    if not len(places):
        return field
    number = np.full(empty.shape, -1)
    number[empty] = np.arange(len(places))
    diagonal, right, links = np.zeros(len(places)), np.zeros(places.shape), []
    for step in np.eye(empty.ndim, dtype=int):
        ends = [_end(motion, field, number, places, sign * step, tissue) for sign in (1, -1)]
        for (there, distance, value), (_, other, _) in (ends, ends[::-1]):
            # Second difference of unequal steps (Shortley and Weller); past the image's edge there is no flux.
            apart = np.where(np.isinf(other), distance, other)
            weight = np.where(np.isinf(distance), 0, 2 / (distance * (distance + apart)))
            diagonal += weight
            right += weight[:, None] * value
            k = np.flatnonzero(there >= 0)
            links.append(np.column_stack([k, there[k], -weight[k]]))
    rows, columns, values = np.concatenate(links).T
    laplacian = sparse.csc_array((values, (rows.astype(int), columns.astype(int))), (len(places),) * 2)
    field[empty] = _solution(laplacian + sparse.diags_array(diagonal, format="csc"), right, diagonal)
    return field


def _solution(laplacian, right, diagonal) -> np.ndarray:
    """The solution (n, d) of the bridge's equations: directly, or where there are MANY of them by iterations, which
    take as many steps as the gap is pixels wide. Unequal steps leave the matrix without symmetry."""
    if len(right) >= MANY:
        inverse = sparse.diags_array(1 / diagonal)
        found = [bicgstab(laplacian, b, rtol=RESIDUAL, M=inverse) for b in right.T]
        if not any(failed for _, failed in found):
            return np.stack([solution for solution, _ in found], axis=1)
    return splu(laplacian).solve(right)


def _rim(motion) -> np.ndarray:
    """Pixels (n1, ...) bool without tissue that touch tissue, also across a corner."""
    return ~motion.tissue & touched(motion.tissue)


def neighbours(n_axes: int) -> list[tuple[int, ...]]:
    """Steps to the pixels that touch one, the nearest first; of equals that of the first column, then row."""
    steps = [step for step in product((-1, 0, 1), repeat=n_axes) if any(step)]
    return sorted(steps, key=lambda step: (np.abs(step).sum(), step[::-1]))


def _carried(motion, among) -> np.ndarray:
    """The field of `motion`, where pixels `among` (n1, ...) bool that touch tissue have that of the nearest tissue."""
    known = motion.field
    field, places = known.copy(), np.argwhere(_rim(motion) & among)
    tissue = np.pad(motion.tissue, 1)
    for step in neighbours(among.ndim)[::-1]:  # what is nearer is written later
        to = places + step
        there = tissue[tuple(to.T + 1)]
        field[tuple(places[there].T)] = known[tuple(to[there].T)]
    return field


def _end(motion, field, number, places, step, tissue):
    """What lies a `step` (d,) from the empty pixels `places` (n, d): an empty one's number or -1, the distance mm, the
    known value (n, d) mm, 0 for empty ones. The distance is infinite past the image's edge."""
    to = places + step
    inside = ((to >= 0) & (to < number.shape)).all(axis=1)
    pixel = tuple(np.where(inside[:, None], to, places).T)
    there = np.where(inside, number[pixel], -1)
    length = float(np.linalg.norm(step * motion.spacing))
    distance, value = np.where(inside, length, np.inf), np.where((inside & (there < 0))[:, None], field[pixel], 0)
    if tissue is not None:
        k = np.flatnonzero(inside & motion.tissue[pixel])
        fraction, lip = _lip(tissue, *(motion.centres_of(at[k]) for at in (places, to)))
        found = np.isfinite(lip[:, 0])    # not where rounding puts the pixel in the tissue for one and not the other
        distance[k[found]], value[k[found]] = length * fraction[found], lip[found]
    return there, distance, value


def _lip(tissue, start, end):
    """On the ways from `start` in a gap to `end` in tissue, (n, d) mm: the fraction (n,) at which tissue begins, and
    resting place minus position (n, d) mm there."""
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        within = np.isfinite(tissue.to_preoperative(start + middle[:, None] * (end - start))[:, 0])
        low, high = np.where(within, low, middle), np.where(within, middle, high)
    at = start + high[:, None] * (end - start)
    return high, tissue.to_preoperative(at) - at


def extended(motion: PullBack | SolidPullBack, empty) -> np.ndarray:
    """The field (n1, ..., d) mm of `motion`; pixels next to tissue go with it, others of `empty` are NOWHERE."""
    field = _carried(motion, np.ones_like(empty))
    field[empty & ~_rim(motion)] = NOWHERE
    return field
