"""Snap a network of cuts to a mesh, so that no part is thinner than rounding can tell."""

import numpy as np
import shapely

from xfemnav.geometry.mesh import orient

# Fractions of the local element size h.
SNAP = 1e-3  # the cut is moved onto a node or edge as near as this
SEVER = 1e-5  # a contact shorter than this joins nothing


def node_sizes(mesh):
    """Mean element size (n,) mm about each node: what snapping is measured in."""
    total = np.bincount(mesh.cells.ravel(), np.repeat(mesh.sizes, 3), len(mesh.points))
    return total / np.maximum(np.bincount(mesh.cells.ravel(), minlength=len(mesh.points)), 1)


def snap(mesh, node_h, paths):
    """Move cut vertices onto near nodes and edges, and make near nodes vertices of the cut."""
    edges = mesh.edges
    edge_h = node_h[edges].min(axis=1)
    snapped = []
    for path in paths:
        path = _simplified(path, mesh.points, node_h)
        path = np.array([_snap_vertex(x, mesh.points, node_h, edges, edge_h) for x in path])
        path = path[np.concatenate([[True], (np.diff(path, axis=0) != 0).any(axis=1)])]
        snapped.append(_through_near_nodes(path, mesh.points, node_h) if len(path) > 1 else path)
    # Ends of a branch are put on the cut that they touch.
    for k, path in enumerate(snapped):
        for end in (0, -1):
            for other in snapped[:k] + snapped[k + 1 :]:
                nearest = _nearest_on_path(other, path[end])
                h = node_h[np.argmin(np.sum((mesh.points - path[end]) ** 2, axis=1))]
                if np.linalg.norm(nearest - path[end]) < SNAP * h:
                    path[end] = nearest
            _onto_near_lines(snapped, path, end, node_h[np.argmin(np.sum((mesh.points - path[end]) ** 2, axis=1))])
    return snapped


def _onto_near_lines(paths, path, end, h):
    """Move a cut's end onto the line of another segment that passes it by a hair: cells are split along whole lines."""
    own = path[:2] if end == 0 else path[-2:]
    for other in paths:
        for a, b in zip(other[:-1], other[1:]):
            if other is path and (np.array_equal(a, own[0]) or np.array_equal(b, own[1])):
                continue
            length = np.linalg.norm(b - a)
            along, off = (path[end] - a) @ (b - a) / length, orient(a, b, path[end]) / length
            if 0 < abs(off) <= SNAP / 10 * h and -2 * h < along < length + 2 * h:
                path[end] = a + along * (b - a) / length


def _simplified(path, points, node_h):
    """The path without vertices that lie on it anyway, to a tenth of the snapping: dense points make no kinks."""
    h = min(node_h[np.argmin(np.sum((points - x) ** 2, axis=1))] for x in path)
    return shapely.get_coordinates(shapely.simplify(shapely.LineString(path), SNAP / 10 * h))


def _snap_vertex(x, points, node_h, edges, edge_h):
    to_node = np.linalg.norm(points - x, axis=1)
    near = np.argmin(to_node / node_h)
    # Farther than a line is bent to a node, so that no node is left on the line just before a tip.
    if to_node[near] <= 2 * SNAP * node_h[near]:
        return points[near].copy()
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    t = np.clip(np.einsum("ei,ei->e", x - a, b - a) / np.einsum("ei,ei->e", b - a, b - a), 0, 1)
    foot = a + t[:, None] * (b - a)
    gap = np.linalg.norm(foot - x, axis=1)
    near = np.argmin(gap / edge_h)
    return foot[near] if gap[near] <= SNAP * edge_h[near] else x


def _through_near_nodes(path, points, node_h):
    """Bend each segment through the nodes that it nearly touches, until it touches no other."""
    for _ in range(10):
        bent = [path[0]]
        for a, b in zip(path[:-1], path[1:]):
            length = np.linalg.norm(b - a)
            t = (points - a) @ (b - a) / length
            off = np.abs(orient(a, b, points)) / length
            near = np.flatnonzero((off <= SNAP * node_h) & (t > 0) & (t < length))
            near = near[(points[near] != a).any(axis=1) & (points[near] != b).any(axis=1)]
            bent.extend(points[near[np.argsort(t[near])]])
            bent.append(b)
        if len(bent) == len(path):
            break
        path = np.array(bent)
    return path


def _nearest_on_path(path, x):
    a, b = path[:-1], path[1:]
    t = np.clip(np.einsum("ki,ki->k", x - a, b - a) / np.einsum("ki,ki->k", b - a, b - a), 0, 1)
    foot = a + t[:, None] * (b - a)
    return foot[np.argmin(np.sum((foot - x) ** 2, axis=1))]


def find_tips(mesh, node_h, paths, loops):
    """Cut ends that are tips, as (cut, path, end): not on the outline, not on another cut, not a loop's end."""
    a, b = mesh.points[mesh.boundary_edges].swapaxes(0, 1)
    tips = []
    for k, path in enumerate(paths):
        for end in (0, -1):
            x = path[end]
            t = np.clip(np.einsum("ei,ei->e", x - a, b - a) / np.einsum("ei,ei->e", b - a, b - a), 0, 1)
            h = node_h[np.argmin(np.sum((mesh.points - x) ** 2, axis=1))]
            to_rim = np.linalg.norm(a + t[:, None] * (b - a) - x, axis=1).min()
            to_cut = min(
                (np.linalg.norm(_nearest_on_path(other, x) - x) for j, other in enumerate(paths) if j != k),
                default=np.inf,
            )
            if not loops[k] and min(to_rim, to_cut) > SEVER * h:
                tips.append((k, path, end))
    return tips
