"""Cuts right through the organ: the pieces are counted exactly, their areas add up, and each moves on its own."""

import heapq
from functools import partial

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose
from shapely.ops import polygonize, unary_union

from benchmarks.probes import basis_at
from benchmarks.verification import plane
from tests.meshes import BRAIN, cut_in, disc, outline, space_of
from xfemnav.geometry.plane.cut import Cut

DISC = disc()


def chord(rng):
    """Two points outside the disc, on different sides of it, whose line passes within 50 mm of the centre."""
    angle, off = rng.uniform(0, 2 * np.pi), rng.uniform(-50, 50)
    along = np.array([np.cos(angle), np.sin(angle)])
    return np.array([-100 * along, 100 * along]) + off * np.array([-along[1], along[0]])


def straight(mesh, rng, _):
    """A chord."""
    return cut_in(mesh, *chord(rng))


def bent(mesh, rng, _):
    """A chord with one to three kinks of up to 6 mm."""
    a, b = chord(rng)
    t = np.linspace(0.3, 0.7, rng.integers(1, 4) + 2)[1:-1, None]
    return cut_in(mesh, a, *(a + t * (b - a) + rng.uniform(-6, 6, (len(t), 2))), b)


def through_nodes(mesh, rng, _):
    """The line through two inner nodes that lie well apart."""
    inner = np.setdiff1d(np.arange(len(mesh.points)), mesh.boundary_facets)
    a, b = mesh.points[rng.choice(inner, 2, replace=False)]
    while np.linalg.norm(b - a) < 20:
        b = mesh.points[rng.choice(inner)]
    travel = (b - a) / np.linalg.norm(b - a)
    return cut_in(mesh, a - 200 * travel, b + 200 * travel)


def along_edges(mesh, rng, used):
    """A walk along inner edges that no other cut has used, between two nodes of the outline."""
    rim = np.unique(mesh.boundary_facets)
    near = {}
    for a, b in mesh.edges.tolist():
        if not (a in rim and b in rim) and (a, b) not in used:
            near.setdefault(a, []).append(b)
            near.setdefault(b, []).append(a)
    start = int(rng.choice([i for i in rim.tolist() if i in near]))
    far = rim[np.linalg.norm(mesh.points[rim] - mesh.points[start], axis=1) > 0.5 * np.ptp(mesh.points)]
    goal = int(rng.choice([i for i in far.tolist() if i in near]))
    walk = shortest(mesh.points, near, start, goal, set(rim.tolist()))
    used |= {tuple(sorted(edge)) for edge in zip(walk, walk[1:])}
    return Cut(mesh.points[walk])


def shortest(points, near, start, goal, rim):
    """Dijkstra's walk from node to node, that meets the outline at its ends only."""
    before, queue = {}, [(0.0, start, start)]
    while queue:
        length, node, came = heapq.heappop(queue)
        if node in before:
            continue
        before[node] = came
        if node == goal:
            break
        if node == start or node not in rim:
            for i in near[node]:
                heapq.heappush(queue, (length + np.linalg.norm(points[i] - points[node]), i, node))
    walk = [goal]
    while walk[-1] != start:
        walk.append(before[walk[-1]])
    return walk[::-1]


COURSES = {f.__name__: f for f in (straight, bent, through_nodes, along_edges)}


def mixed(mesh, rng, used):
    """Any of them."""
    return rng.choice(list(COURSES.values()))(mesh, rng, used)


def network(course, n, seed):
    """The space of a disc cut right through n times."""
    rng, used = np.random.default_rng([n, seed]), set()
    return space_of(DISC, *(course(DISC, rng, used) for _ in range(n)))


def pieces(space):
    """What shapely makes of the outline and the cuts: the polygons between them."""
    lines = [shapely.LinearRing(outline(space.mesh))]
    for path in space.parts.paths:
        # A mouth lies on the outline to rounding only: both ends go on for 1e-9 mm, and dangle.
        back = path[[0, -1]] - path[[1, -2]]
        on = path[[0, -1]] + 1e-9 * back / np.linalg.norm(back, axis=1)[:, None]
        lines.append(shapely.LineString([on[0], *path, on[1]]))
    return list(polygonize(unary_union(lines)))


def motions(n):
    """Rigid motions of n pieces: u = angle (-y, x) + shift, of 1 mm and .1 rad; (n,) rad and (n, 2) mm."""
    rng = np.random.default_rng(n)
    return rng.uniform(-0.1, 0.1, n), rng.uniform(-1, 1, (n, 2))


def moved(points, body, motion):
    """Displacement (k, 2) mm of points (k, 2) mm of the pieces body (k,)."""
    angle, shift = motion
    return angle[body, None] * np.stack([-points[:, 1], points[:, 0]], axis=1) + shift[body]


def coefficients(space, motion):
    """U (n_rows, 2) mm of the rigid motions: each function takes the motion of its piece at its node."""
    table, body = space.enrichment, np.full(space.enrichment.n_rows, -1)
    body[table.dof] = table.body[:, None]
    assert (body[table.dof] == table.body[:, None]).all(), "a basis function lives on two pieces"
    return moved(space.mesh.points[table.node], body, motion)


ANY = [(course, n, seed) for course in (*COURSES.values(), mixed) for n in range(1, 6) for seed in range(3)]
#: Networks with a mouth that lies within 1e-4 h of another segment's line.
IN_LINE = [(straight, 4, 17), (bent, 5, 31), (mixed, 1, 20), (mixed, 5, 19)]
IN_LINE += [(through_nodes, 4, 52), (through_nodes, 4, 58), (through_nodes, 5, 15), (through_nodes, 5, 37)]


@pytest.mark.parametrize("course, n, seed", ANY + IN_LINE, ids=lambda x: getattr(x, "__name__", x))
def test_pieces_areas_and_jumps(course, n, seed):
    space = network(course, n, seed)
    split, body = space.parts, space.enrichment.body
    wanted = pieces(space)
    assert body.max() + 1 == len(wanted)
    area = np.bincount(body[split.part], split.volumes)
    # Areas of the plane's polygons: sums of some hundred products, each good to 1e-16.
    assert_allclose(np.sort(area), np.sort([p.area for p in wanted]), rtol=1e-12)

    motion = motions(len(wanted))
    U = coefficients(space, motion)
    d = np.abs(U).max()
    middle, part = split.corners.mean(axis=1), split.part
    near = partial(assert_allclose, rtol=0, atol=1e-12 * d)
    near(space.basis_in(middle, part) @ U, moved(middle, body[part], motion))
    H = np.stack([g @ U for g in space.gradient_in(middle, part)], axis=-1)
    strain = np.stack([H[:, 0, 0], H[:, 1, 1], H[:, 0, 1] + H[:, 1, 0]], axis=1)
    energy = np.einsum("c,cs,st,ct->", split.volumes, strain, plane.stiffness(BRAIN), strain) / 2
    assert energy <= 1e-13 * BRAIN.young_kpa * d**2

    at, (left, right) = split.lips.facets.mean(axis=1), split.lips.parts.T
    assert (body[left] != body[right]).any()
    jump = (space.basis_in(at, left) - space.basis_in(at, right)) @ U
    near(jump, moved(at, body[left], motion) - moved(at, body[right], motion))
    for side, parts in ((1, left), (-1, right)):
        near(basis_at(space, at, side) @ U, moved(at, body[parts], motion))
