"""The angle about a tip, unwrapped: continuous from part to part, jumping on the real cut only, also behind a kink."""

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order

from xfemnav.geometry.subcells import Subcells


def adjacency(subcells: Subcells) -> csr_array:
    """Symmetric matrix (p, p) with an entry where two parts are joined: one more than the index of the join."""
    p, q = subcells.joins[:, 0], subcells.joins[:, 1]
    n, join = subcells.n_parts, 1 + np.arange(len(p))
    # Two parts may be joined twice; one of them is enough for the walk.
    _, one_each = np.unique(p * n + q, return_index=True)
    p, q, join = p[one_each], q[one_each], join[one_each]
    at = (np.concatenate([p, q]), np.concatenate([q, p]))
    return coo_array((np.concatenate([join, join]), at), (n, n)).tocsr()


def centroids(subcells: Subcells) -> np.ndarray:
    """Centre of mass (p, 2) mm of each part."""
    weight = np.bincount(subcells.part, subcells.areas, subcells.n_parts)
    moment = subcells.corners.mean(axis=1) * subcells.areas[:, None]
    sums = [np.bincount(subcells.part, moment[:, i], subcells.n_parts) for i in (0, 1)]
    return np.stack(sums, axis=1) / weight[:, None]


def touched_parts(subcells: Subcells, tip: int) -> np.ndarray:
    """Parts (k,) that have the tip as a corner."""
    return subcells.tip_touch[subcells.tip_touch[:, 0] == tip, 1]


def unwrap(subcells: Subcells, near, middle, tip: int, inside) -> np.ndarray:
    """Angle (p,) rad of each part's centroid about the tip; NaN for parts that are not reached.

    near : `adjacency`; middle : `centroids`; inside (p,) bool : the parts to walk through, outwards from the tip.
    From part to part the walk passes the middle of their contact: inside one convex part, which does not hold the tip
    in its interior, the angle turns by less than pi, so each step is unambiguous.
    """
    x, travel = subcells.tips[tip], subcells.tip_travel[tip]
    raw, raw_contact = _angle(middle - x, travel), _angle(subcells.join_middle - x, travel)
    start = touched_parts(subcells, tip)
    start = start[inside[start]]
    angle = np.full(len(middle), np.nan)
    if not len(start):
        return angle
    angle[start[0]] = raw[start[0]]
    some = np.flatnonzero(inside)
    index = np.full(len(middle), -1)
    index[some] = np.arange(len(some))
    walkable = near[some][:, some]
    order, before = breadth_first_order(walkable, index[start[0]], directed=False)
    if len(order) == 1:
        return angle
    contact = np.asarray(walkable[order[1:], before[order[1:]]]).ravel() - 1
    for k, join in zip(order[1:], contact):
        p, q = some[k], some[before[k]]
        between = angle[q] + _wrap(raw_contact[join] - angle[q])
        angle[p] = between + _wrap(raw[p] - between)
    return angle


def torn(subcells: Subcells, middle, tip: int, angle) -> np.ndarray:
    """Parts (k,) across whose contact the angle (p,) jumps although no cut is there.

    So it does somewhere on a ring of tissue around another cut's tip or around a hole: walks meet that went both ways.
    """
    x, travel = subcells.tips[tip], subcells.tip_travel[tip]
    p, q = subcells.joins[:, :2].T
    reached = np.isfinite(angle[p]) & np.isfinite(angle[q])
    p, q = p[reached], q[reached]
    raw, raw_contact = _angle(middle - x, travel), _angle(subcells.join_middle[reached] - x, travel)
    between = angle[q] + _wrap(raw_contact - angle[q])
    there = between + _wrap(raw[p] - between)
    return np.unique(subcells.joins[reached, :2][np.abs(there - angle[p]) > np.pi])


def _angle(offset, travel):
    return np.arctan2(travel[0] * offset[:, 1] - travel[1] * offset[:, 0], offset @ travel)


def _wrap(angle):
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi
