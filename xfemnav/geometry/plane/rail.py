"""Nodes on an outline: its corners, and points between them spaced by arc length as a size function asks."""

from typing import NamedTuple

import numpy as np
from numba import njit

CORNER = np.radians(40)  # an outline that turns by more, from h/3 before to h/3 after a point, keeps a node there
KINK = np.radians(4.5)  # a node where it turns by more within h/9 does not slide: its edges would cut the kink


class Rail(NamedTuple):
    """The outline as a rail for its nodes: `points` (m, 2) mm, the first repeated at the end, at the `ticks` (m,).

    A tick is the integral of ds / size from the first point: a count of edges. The nodes stand at the `places` (k,),
    and those that are `free` (k,), no corners, may slide.
    """

    points: np.ndarray
    ticks: np.ndarray
    places: np.ndarray
    free: np.ndarray


@njit(cache=True)
def rail_point(rail, place):
    """Position x, y mm on the rail; `place` counts on past the end of the loop."""
    place = place % rail.ticks[-1]
    k = min(max(1, np.searchsorted(rail.ticks, place, side="right")), len(rail.ticks) - 1)
    span = rail.ticks[k] - rail.ticks[k - 1]
    part = (place - rail.ticks[k - 1]) / span if span > 0 else 0.0
    ax, ay = rail.points[k - 1]
    bx, by = rail.points[k]
    return ax + part * (bx - ax), ay + part * (by - ay)


def outline_nodes(outline, size_at) -> Rail:
    """Nodes on the closed `outline` (n, 2) mm: its corners, and between them equal parts, near 1, of its ticks."""
    points = _dense(outline, size_at)
    h = size_at(points)
    corners = np.flatnonzero(_corners(points, h, _turns(points, h / 3)))
    kink = _turns(points, h / 9)
    first = corners[0] if len(corners) else 0
    loop = np.append(np.roll(np.arange(len(points)), -first), first)
    points, h, kink = points[loop], h[loop], kink[loop]
    corners = corners - first
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    ticks = np.append(0, np.cumsum(length * (1 / h[1:] + 1 / h[:-1]) / 2))
    stops = np.append(corners if len(corners) else 0, len(points) - 1)
    fewest = max(1, -(-3 // (len(stops) - 1)))
    places = []
    for start, stop in zip(ticks[stops[:-1]], ticks[stops[1:]]):
        n = max(fewest, round(stop - start))
        places.append(start + (stop - start) * np.arange(n) / n)
    places = np.concatenate(places)
    return Rail(points, ticks, places, np.interp(places, ticks, kink) < KINK)


def rail_nodes(rail) -> np.ndarray:
    """Positions (k, 2) mm of the nodes on the rail."""
    return np.stack([np.interp(rail.places, rail.ticks, rail.points[:, i]) for i in (0, 1)], axis=1)


def _dense(outline, size_at) -> np.ndarray:
    """The outline with points added until no segment is longer than half the size at its ends."""
    for _ in range(30):
        h = size_at(outline)
        following = np.roll(outline, -1, axis=0)
        length = np.linalg.norm(following - outline, axis=1)
        parts = np.ceil(length / (0.5 * np.minimum(h, np.roll(h, -1)))).astype(int)
        if (parts <= 1).all():
            break
        parts = np.minimum(np.maximum(parts, 1), 64)
        place = (np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)) / np.repeat(parts, parts)
        outline = np.repeat(outline, parts, axis=0) + place[:, None] * np.repeat(following - outline, parts, axis=0)
    return outline


@njit(cache=True)
def _turns(points, reach):
    """Angle (n,) by which the closed outline turns at each point, from `reach` (n,) mm before it to `reach` after it.

    The reach keeps the steps of a pixel contour from being corners.
    """
    n = len(points)
    turn, ends = np.zeros(n), np.empty((2, 2))
    for a in range(n):
        for k in range(2):
            step = 2 * k - 1
            b, left = a, reach[a]
            x, y = points[a]
            for _ in range(n):
                b = (b + step) % n
                length = np.hypot(points[b, 0] - x, points[b, 1] - y)
                part = min(1.0, left / length) if length > 0 else 1.0
                x, y = x + part * (points[b, 0] - x), y + part * (points[b, 1] - y)
                left -= length
                if left <= 0:
                    break
            ends[k] = x, y
        ux, uy = points[a, 0] - ends[0, 0], points[a, 1] - ends[0, 1]
        vx, vy = ends[1, 0] - points[a, 0], ends[1, 1] - points[a, 1]
        turn[a] = abs(np.arctan2(ux * vy - uy * vx, ux * vx + uy * vy))
    return turn


@njit(cache=True)
def _corners(points, h, turn):
    """Marks (n,) the points with a `turn` over `CORNER`; of those within h/3 of each other the sharpest."""
    n = len(points)
    corner = np.zeros(n, np.bool_)
    for a in range(n):
        if turn[a] < CORNER:
            continue
        corner[a] = True
        for step in (-1, 1):
            b, way = a, 0.0
            for _ in range(n):
                c = (b + step) % n
                way += np.hypot(points[c, 0] - points[b, 0], points[c, 1] - points[b, 1])
                b = c
                if way > h[a] / 3:
                    break
                if turn[b] > turn[a] + 1e-9 or (step < 0 and corner[b] and turn[b] > turn[a] - 1e-9):
                    corner[a] = False
    return corner


@njit(cache=True)
def strays(rail, nodes):
    """Largest distance (k,) mm of the outline from the edge after each of its `nodes` (k, 2) that stands for it."""
    points, stray = rail.points, np.zeros(len(nodes))
    for n in range(len(points)):
        k = np.searchsorted(rail.places, rail.ticks[n], side="right") - 1
        ax, ay = nodes[k]
        bx, by = nodes[(k + 1) % len(nodes)]
        dx, dy = bx - ax, by - ay
        s = ((points[n, 0] - ax) * dx + (points[n, 1] - ay) * dy) / max(dx * dx + dy * dy, 1e-300)
        s = min(1.0, max(0.0, s))
        stray[k] = max(stray[k], np.hypot(points[n, 0] - ax - s * dx, points[n, 1] - ay - s * dy))
    return stray
