"""Generated cuts in all the positions that a mesh can make awkward, each with its generic neighbours' scale.

Every maker takes a mesh of element size about 1 mm on a rectangle with its lower left corner at the origin, and a
random generator; it gives a list of (path (k, 2) mm, internal) to be placed together.
"""

import numpy as np

OFFSETS = 10.0 ** -np.arange(1, 15)


def _size(mesh):
    return mesh.points.max(axis=0)


def _inner_nodes(mesh):
    return np.setdiff1d(np.arange(len(mesh.points)), mesh.boundary_facets.ravel())


def _goal(mesh, rng):
    """Somewhere in the middle half of the rectangle."""
    return _size(mesh) * rng.uniform(0.35, 0.65, 2)


def _mouth(mesh, rng):
    """Somewhere on the left edge, away from the corners."""
    return np.array([0.0, _size(mesh)[1] * rng.uniform(0.25, 0.75)])


def _node_near(mesh, x):
    inner = _inner_nodes(mesh)
    return mesh.points[inner[np.argmin(np.linalg.norm(mesh.points[inner] - x, axis=1))]]


def _edge_near(mesh, x):
    """The inner edge whose middle is nearest to x: its two ends (2, 2)."""
    inner = np.isin(mesh.edges, _inner_nodes(mesh)).all(axis=1)
    ends = mesh.points[mesh.edges[inner]]
    return ends[np.argmin(np.linalg.norm(ends.mean(axis=1) - x, axis=1))]


def _cell_near(mesh, x):
    return mesh.corners[np.argmin(np.linalg.norm(mesh.corners.mean(axis=1) - x, axis=1))]


def _xy(x, y):
    return np.array([x, y], dtype=float)


def _unit(v):
    return v / np.linalg.norm(v)


def generic(mesh, rng):
    return [([_mouth(mesh, rng), _goal(mesh, rng)], False)]


def through_two_nodes(mesh, rng):
    """Straight through two nodes, ending in a cell; the mouth is where the line meets the left edge."""
    a = _node_near(mesh, _size(mesh) * (0.2, rng.uniform(0.3, 0.7)))
    b = _node_near(mesh, _goal(mesh, rng))
    return [([a + (a - b) / (a - b)[0] * (-a[0] - 1), b + 0.37 * _unit(b - a)], False)]


def along_edges(mesh, rng):
    """A walk along mesh edges from a node of the left edge to an inner node."""
    left = np.flatnonzero((mesh.points[:, 0] == 0) & (np.abs(mesh.points[:, 1] / _size(mesh)[1] - 0.5) < 0.25))
    node, walk, goal = rng.choice(left), [], _goal(mesh, rng)
    while not walk or np.linalg.norm(mesh.points[node] - goal) > 0.8:
        walk.append(node)
        near = mesh.edges[(mesh.edges == node).any(axis=1)].sum(axis=1) - node
        near = np.intersect1d(np.setdiff1d(near, walk), _inner_nodes(mesh))
        if not len(near):
            break
        node = near[np.argmin(np.linalg.norm(mesh.points[near] - goal, axis=1))]
    return [(mesh.points[[*walk, node]], False)]


def along_edges_and_half_of_one(mesh, rng):
    """The same, ending in the middle of an edge."""
    path = along_edges(mesh, rng)[0][0].copy()
    path[-1] = path[-2] + rng.uniform(0.2, 0.8) * (path[-1] - path[-2])
    return [(path, False)]


def tip_on_an_edge(mesh, rng):
    a, b = _edge_near(mesh, _goal(mesh, rng))
    return [([_mouth(mesh, rng), a + rng.uniform(0.2, 0.8) * (b - a)], False)]


def tip_on_a_node(mesh, rng):
    return [([_mouth(mesh, rng), _node_near(mesh, _goal(mesh, rng))], False)]


def tip_beside_a_node(mesh, rng):
    x = _node_near(mesh, _goal(mesh, rng))
    return [([_mouth(mesh, rng), x + rng.choice(OFFSETS) * _unit(rng.normal(size=2))], False)]


def tip_beside_an_edge(mesh, rng):
    a, b = _edge_near(mesh, _goal(mesh, rng))
    across = _unit(np.array([a[1] - b[1], b[0] - a[0]]))
    x = a + rng.uniform(0.2, 0.8) * (b - a) + rng.choice([-1, 1]) * rng.choice(OFFSETS) * across
    return [([_mouth(mesh, rng), x], False)]


def beside_a_row_of_nodes(mesh, rng):
    """Along the walk of edges, shifted by 1e-1 to 1e-14 h."""
    path = along_edges(mesh, rng)[0][0] + rng.choice(OFFSETS) * _unit(rng.normal(size=2))
    return [(np.vstack([path[:1] - (1.0, 0.0), path]), False)]


def beside_an_edge(mesh, rng):
    """A straight cut whose last stretch runs beside one edge."""
    a, b = _edge_near(mesh, _goal(mesh, rng))
    a, b = (a, b) if a[0] < b[0] else (b, a)
    off = rng.choice([-1, 1]) * rng.choice(OFFSETS) * _unit(np.array([a[1] - b[1], b[0] - a[0]]))
    return [([_mouth(mesh, rng), a + off, b + off + 0.3 * (b - a)], False)]


def kinks_in_a_cell(mesh, rng):
    """Two to four kinks inside one cell, then on to the goal."""
    corners = _cell_near(mesh, _size(mesh) * (0.25, rng.uniform(0.4, 0.6)))
    inside = rng.dirichlet(np.ones(3), rng.integers(2, 5)) @ corners
    inside = inside[np.argsort(inside[:, 0])]
    return [([_mouth(mesh, rng), *inside, _goal(mesh, rng)], False)]


def sharp_turn(mesh, rng):
    """Back by nearly half a turn inside one cell's neighbourhood."""
    goal = _goal(mesh, rng)
    mouth = _mouth(mesh, rng)
    back = goal - rng.uniform(0.5, 2) * _unit(goal - mouth) + rng.uniform(0.02, 0.3) * np.array([0.0, 1.0])
    return [([mouth, goal, back], False)]


def two_tips_in_a_cell(mesh, rng):
    corners = _cell_near(mesh, _goal(mesh, rng))
    one, other = rng.dirichlet(3 * np.ones(3), 2) @ corners
    one, other = (one, other) if one[0] < other[0] else (other, one)
    far = np.array([_size(mesh)[0], _size(mesh)[1] * rng.uniform(0.25, 0.75)])
    return [([_mouth(mesh, rng), one], False), ([far, other], False)]


def short_from_the_outline(mesh, rng):
    mouth = _mouth(mesh, rng)
    return [([mouth, mouth + rng.uniform(0.02, 0.9) * _unit(np.array([1.0, rng.uniform(-1, 1)]))], False)]


def short_inside(mesh, rng):
    x = _goal(mesh, rng)
    return [([x, x + rng.uniform(0.02, 2.5) * _unit(rng.normal(size=2))], True)]


def internal(mesh, rng):
    x = _goal(mesh, rng)
    return [([x, x + rng.uniform(3.2, 4) * _unit(rng.normal(size=2))], True)]


def grazing(mesh, rng):
    """Close along the left edge after a short way in."""
    mouth, depth = _mouth(mesh, rng), rng.choice([0.5, 0.1, 1e-2, 1e-3, 1e-4])
    return [([mouth, mouth + _xy(depth, 0), mouth + _xy(depth, 0.2 * _size(mesh)[1])], False)]


def mouth_at_a_node(mesh, rng):
    left = mesh.points[(mesh.points[:, 0] == 0) & (np.abs(mesh.points[:, 1] / _size(mesh)[1] - 0.5) < 0.25)]
    return [([rng.choice(left), _goal(mesh, rng)], False)]


def mouth_at_a_corner(mesh, rng):
    return [([np.zeros(2), _goal(mesh, rng)], False)]


def tip_near_the_outline(mesh, rng):
    """Nearly through: the tip stays 1e-1 to 1e-14 h short of the far edge."""
    far = np.array([_size(mesh)[0] - rng.choice(OFFSETS), _size(mesh)[1] * rng.uniform(0.25, 0.75)])
    return [([_mouth(mesh, rng), far], False)]


def tip_at_a_corner(mesh, rng):
    """To the domain's far corner, exactly or up to 1e-1 to 1e-14 h."""
    return [([_mouth(mesh, rng), _size(mesh) - rng.choice([0.0, *OFFSETS])], False)]


def right_through(mesh, rng):
    far = np.array([_size(mesh)[0], _size(mesh)[1] * rng.uniform(0.25, 0.75)])
    return [([_mouth(mesh, rng), far], False)]


def crossing(mesh, rng):
    """Two cuts that cross, one from the left and one from below."""
    below = np.array([_size(mesh)[0] * rng.uniform(0.2, 0.35), 0.0])
    return [
        ([_mouth(mesh, rng), _goal(mesh, rng)], False),
        ([below, below + _xy(0.3, _size(mesh)[1] * rng.uniform(0.8, 0.9))], False),
    ]


def branch(mesh, rng):
    """A second cut that starts on the first."""
    mouth, goal = _mouth(mesh, rng), _goal(mesh, rng)
    stem = mouth + rng.uniform(0.4, 0.8) * (goal - mouth)
    return [([mouth, goal], False), ([stem, stem + _xy(1.5, 2.5 * rng.choice([-1, 1]))], True)]


#: Position -> maker. The first list are positions of one cut from the left edge to the middle: their energies compare.
COMPARABLE = {
    f.__name__: f
    for f in (
        generic, through_two_nodes, along_edges, along_edges_and_half_of_one, tip_on_an_edge, tip_on_a_node,
        tip_beside_a_node, tip_beside_an_edge, beside_a_row_of_nodes, beside_an_edge, kinks_in_a_cell, mouth_at_a_node,
    )
}
SPECIAL = {
    f.__name__: f
    for f in (
        sharp_turn, two_tips_in_a_cell, short_from_the_outline, short_inside, internal, grazing, mouth_at_a_corner,
        tip_near_the_outline, tip_at_a_corner, right_through, crossing, branch,
    )
}
POSITIONS = COMPARABLE | SPECIAL
