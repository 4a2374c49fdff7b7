"""Nodes on an outline: its corners, and points between them spaced by arc length as a size function asks."""

import numpy as np
from numba import njit

CORNER = np.radians(40)  # an outline that turns by more keeps a node there


def outline_nodes(outline, size_at) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (k, 2) on the closed `outline` (n, 2) mm and how far (k,) mm it strays from the edge after each.

    Between corners the nodes divide the integral of ds / size into equal parts near 1.
    """
    points = _dense(outline, size_at)
    h = size_at(points)
    corners = np.flatnonzero(_corners(points, h))
    if len(corners):
        points, h = np.roll(points, -corners[0], axis=0), np.roll(h, -corners[0])
        corners = corners - corners[0]
    points, h = np.concatenate([points, points[:1]]), np.append(h, h[0])
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    wanted = np.append(0, np.cumsum(length * (1 / h[1:] + 1 / h[:-1]) / 2))  # number of edges from the first point on
    stops = np.append(corners if len(corners) else 0, len(points) - 1)
    fewest = max(1, -(-3 // (len(stops) - 1)))
    places = []
    for start, stop in zip(wanted[stops[:-1]], wanted[stops[1:]]):
        n = max(fewest, round(stop - start))
        places.append(start + (stop - start) * np.arange(n) / n)
    places = np.concatenate(places)
    nodes = np.stack([np.interp(places, wanted, points[:, i]) for i in (0, 1)], axis=1)
    return nodes, _stray(points, wanted, nodes, np.append(places, wanted[-1]))


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
def _corners(points, h):
    """Marks (n,) the points where the closed outline turns by more than `CORNER` between h/3 before and h/3 after.

    Of such points within h/3 of each other the sharpest counts; the scale keeps the steps of a pixel contour from
    being corners.
    """
    n = len(points)
    turn, corner = np.zeros(n), np.zeros(n, np.bool_)
    for a in range(n):
        ends = np.empty((2, 2))
        for k in range(2):
            step = 2 * k - 1
            b, left = a, h[a] / 3
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
def _stray(points, wanted, nodes, places):
    """Largest distance (k,) mm of the points of the outline from the edge of `nodes` that stands for them."""
    stray = np.zeros(len(nodes))
    k = 0
    for n in range(len(points)):
        while wanted[n] > places[k + 1]:
            k += 1
        ax, ay = nodes[k]
        bx, by = nodes[(k + 1) % len(nodes)]
        dx, dy = bx - ax, by - ay
        s = ((points[n, 0] - ax) * dx + (points[n, 1] - ay) * dy) / max(dx * dx + dy * dy, 1e-300)
        s = min(1.0, max(0.0, s))
        stray[k] = max(stray[k], np.hypot(points[n, 0] - ax - s * dx, points[n, 1] - ay - s * dy))
    return stray
