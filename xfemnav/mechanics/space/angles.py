"""The angle about a tip, unwrapped: continuous from part to part, jumping on the real cut only, also behind a kink."""

import numpy as np

from xfemnav.geometry.parts import Parts


def centroids(split: Parts) -> np.ndarray:
    """Centre of mass (p, 2) mm of each part."""
    weight = np.bincount(split.part, split.volumes, split.n_parts)
    moment = split.corners.mean(axis=1) * split.volumes[:, None]
    sums = [np.bincount(split.part, moment[:, i], split.n_parts) for i in (0, 1)]
    return np.stack(sums, axis=1) / weight[:, None]


def touched_parts(split: Parts, tip: int) -> np.ndarray:
    """Parts (k,) that have the tip as a corner."""
    return split.touch[split.touch[:, 0] == tip, 1]


def unwrap(split: Parts, middle, tip: int, inside) -> np.ndarray:
    """Angle (p,) rad of each part's centroid about the tip; NaN for parts that are not reached.

    middle : `centroids`; inside (p,) bool : the parts to walk through, outwards from the tip.
    From part to part the walk passes the middle of their contact: inside one convex part, which does not hold the tip
    in its interior, the angle turns by less than pi, so each step is unambiguous.
    """
    x, travel = split.fronts.at[tip], split.fronts.travel[tip]
    start = touched_parts(split, tip)
    start = start[inside[start]]
    angle = np.full(len(middle), np.nan)
    if not len(start):
        return angle
    some = np.flatnonzero(inside)
    raw, index = _angle(middle[some] - x, travel), np.full(len(middle), -1)
    index[some] = np.arange(len(some))
    pairs = index[split.joins]
    joins = np.flatnonzero((pairs >= 0).all(axis=1))
    one, other = np.concatenate([pairs[joins], pairs[joins, ::-1]]).T
    order = np.lexsort((other, one))
    ends = np.searchsorted(one[order], np.arange(len(some) + 1)).tolist()
    passed = np.tile(_angle(split.middles[joins] - x, travel), 2)[order].tolist()
    other, raw, walk = other[order].tolist(), raw.tolist(), [int(index[start[0]])]
    found = {walk[0]: raw[walk[0]]}
    for q in walk:
        for j in range(ends[q], ends[q + 1]):
            if other[j] not in found:
                between = found[q] + _wrap(passed[j] - found[q])
                found[other[j]] = between + _wrap(raw[other[j]] - between)
                walk.append(other[j])
    angle[some[walk]] = list(found.values())
    return angle


def torn(split: Parts, middle, tip: int, angle) -> np.ndarray:
    """Parts (p,) bool across whose contact the angle (p,) jumps although no cut is there.

    So it does somewhere on a ring of tissue around another cut's tip or around a hole: walks meet that went both ways.
    """
    x, travel = split.fronts.at[tip], split.fronts.travel[tip]
    p, q = split.joins.T
    reached = np.isfinite(angle[p]) & np.isfinite(angle[q])
    p, q = p[reached], q[reached]
    raw, raw_contact = _angle(middle[p] - x, travel), _angle(split.middles[reached] - x, travel)
    between = angle[q] + _wrap(raw_contact - angle[q])
    there = between + _wrap(raw - between)
    jumps = np.zeros(len(angle), dtype=bool)
    jumps[split.joins[reached, :2][np.abs(there - angle[p]) > np.pi]] = True
    return jumps


def _angle(offset, travel):
    return np.arctan2(travel[0] * offset[:, 1] - travel[1] * offset[:, 0], offset @ travel)


def _wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi
