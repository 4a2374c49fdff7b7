"""Organs that nothing but contact with the skull holds: random ones, whole or cut in pieces, under gravity.

Each is solved, or refused because the skull does not keep it from sliding, turning or falling away. What is solved lies
within the organ's size of its place, and where springs that keep it from drifting have a say in that, it is told.
"""

import warnings
from dataclasses import dataclass, replace

import numpy as np
import pytest
import shapely
from scipy.optimize import linprog

from data_synthetic import domains
from tests.meshes import BRAIN, cut_in, disc, outline, posed, turn
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.limits import SWAY
from xfemnav.mechanics.conditions import skull as module
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.rules import Arc, Gravity, Retraction, Skull
from xfemnav.mechanics.solving.solution import Solution, solve
from xfemnav.mechanics.tissue.elasticity import Material


def polygon(rng):
    """A convex polygon with rounded corners."""
    angle = rng.uniform(0, 2 * np.pi, rng.integers(3, 9))
    points = rng.uniform(20, 70, (len(angle), 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    hull = shapely.MultiPoint(points).convex_hull.buffer(rng.uniform(5, 10)).simplify(0.2)
    return np.array(shapely.geometry.polygon.orient(hull).exterior.coords)[:-1]


SHAPES = {
    "disc": lambda rng: domains.disc(rng.uniform(10, 80)),
    "ellipse": lambda rng: domains.ellipse(*rng.uniform(15, 80, 2)),
    "polygon": polygon,
    "gyrated": lambda rng: domains.gyrated(rng.uniform(30, 70), rng.uniform(1, 6)),
}


def hanging(k) -> tuple[Problem, float]:
    """A random organ in a skull that it touches, whole, cut, or cut in two, and its size mm."""
    rng = np.random.default_rng(k)
    loop = SHAPES[rng.choice(sorted(SHAPES))](rng) @ turn(rng.uniform(0, 2 * np.pi)).T
    centre = np.array(shapely.Polygon(loop).centroid.coords[0])
    mesh = distmesh(loop, np.linalg.norm(loop - centre, axis=1).max() / rng.uniform(6, 14))
    mouth = outline(mesh)[rng.integers(len(outline(mesh)))]
    how = rng.choice(["whole", "craniotomy", "cut", "through"])
    tip = centre + rng.uniform(-0.3, 0.3) * (mouth - centre) if how == "cut" else centre - 2 * (mouth - centre)
    cuts = (cut_in(mesh, mouth + 0.3 * (mouth - centre), tip),) if how in ("cut", "through") else ()
    skull = Skull("contact", rng.choice([0.0, 2.0, 5.0, 10.0, 15.0]), 4.0, rng.choice([0.0, 0.0, 0.3, 1.0, 3.0]))
    angle, level = rng.uniform(0, 2 * np.pi), rng.uniform(-50, 50) if rng.uniform() < 0.3 else None
    weight = Gravity((np.cos(angle), np.sin(angle)), fluid_level_mm=level)
    if how == "craniotomy":
        skull = replace(skull, openings=(mouth,))
    problem = posed(mesh, cuts, Material(rng.choice([1.0, 3.0, 10.0])), skull, gravity=weight)
    return problem, float(np.ptp(mesh.points, axis=0).max())


def slides_away(problem, size) -> bool:
    """Whether stiff pieces could sink by half the organ's size, or turn by half a radian, before the skull stops them.

    By a linear programme of its own: the weight's work is largest over the pieces' rigid motions, under the contacts.
    """
    table = problem.enrichment
    bodies = np.unique(table.body[~problem.removed])
    motions = np.zeros((table.n_rows, 2, 3 * len(bodies)))
    for k, body in enumerate(bodies):
        own = np.unique(table.dof[table.body == body])
        x = problem.mesh.points[table.node[own]]
        x = (x - x.mean(axis=0)) / (size / 2)
        motions[own, 0, 3 * k], motions[own, 1, 3 * k + 1] = 1, 1
        motions[own, :, 3 * k + 2] = np.stack([-x[:, 1], x[:, 0]], axis=1)
    motions = motions.reshape(-1, 3 * len(bodies))
    found = linprog(-(problem.load @ motions), -(problem.contacts.G @ motions), problem.contacts.gap,
                    bounds=(-size / 4, size / 4))
    assert found.status == 0
    return bool(np.abs(found.x).max() > size / 4 - 1e-6)


@dataclass(frozen=True)
class Outcome:
    """What came of a piece: its solution or the code of the refusal, what was told, and its size mm."""

    problem: Problem
    solution: Solution | None
    code: str
    told: tuple[str, ...]
    size: float


def outcome(k) -> Outcome:
    problem, size = hanging(k)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            solution, code = solve(problem), ""
        except XfemnavError as error:
            solution, code = None, error.code
    return Outcome(problem, solution, code, tuple(item.message.code for item in told), size)


def judged(k) -> Outcome:
    """The outcome, which must be a motion within the organ's size or a refusal with a reason."""
    found = outcome(k)
    if found.solution is None:
        assert found.code == "E406" and slides_away(found.problem, found.size), k
    else:
        assert found.solution.max_displacement_mm <= found.size, k
        assert found.solution.residual <= 1e-8 and found.solution.min_gap_mm > -1e-9 * found.size, k
    return found


@pytest.mark.parametrize("first", range(0, 24, 6))
def test_random_pieces_lie_on_the_skull_or_are_refused_for_a_reason(first, monkeypatch):
    """And where nothing was told, springs half as stiff move nothing by more than the limit says."""
    found = {k: judged(k) for k in range(first, first + 6)}
    monkeypatch.setattr(module, "WEAK", module.WEAK / 2)
    for k, before in found.items():
        if before.solution is not None and "W410" not in before.told:
            after = solve(hanging(k)[0])
            assert np.linalg.norm(after.moved - before.solution.moved, axis=2).max() < 2 * SWAY.value, k


@pytest.mark.slow
def test_nearly_all_of_two_hundred_random_pieces_are_solved():
    found = [judged(k) for k in range(200)]
    assert sum(item.solution is not None for item in found) >= 190


BOX = distmesh(domains.rectangle(40, 30, centre=(20, 15)), 2.5)


def test_a_small_piece_that_is_pulled_away_does_not_hide_behind_a_large_one():
    """A slab of 2 mm beside a block that lies well: the springs under it carry far less than 5 % of all that acts."""
    skull = Skull("free", arcs=(Arc((0.1, 0.0), (39.9, 0.0), "contact"),))
    cut = cut_in(BOX, (38.0, 35.0), (38.0, -5.0))  # left of it, walking down, is the slab
    pull = Retraction(0, 1, force_mN_per_mm=(0.05, 0.0), blade=(0.0, 1.0))
    weight = Gravity((0.0, -1.0))
    assert solve(posed(BOX, (cut,), BRAIN, skull, gravity=weight)).max_displacement_mm < 2
    problem = posed(BOX, (cut,), BRAIN, skull, (pull,), gravity=weight)
    assert 0.05 * np.abs(problem.load).sum() > 0.05
    with pytest.raises(XfemnavError, match=r"E406 nothing holds the piece of 60 mm2 about \(3[89]\."):
        solve(problem)


def test_tissue_that_moves_farther_than_the_organ_is_large_is_refused():
    """Whatever holds it: an organ a thousand times too soft, in a fixed skull with a large craniotomy."""
    mesh, cut = disc(), cut_in(disc(), (3, 80), (1.7, 12.3))
    skull, weight = Skull("fixed", craniotomy_mm=60.0), Gravity((0.0, 1.0))
    solve(posed(mesh, (cut,), BRAIN, skull, gravity=weight))
    with pytest.raises(XfemnavError, match=r"E406 the organ moves by \d+ mm, .* large \(140 mm\)"):
        solve(posed(mesh, (cut,), Material(0.003), skull, gravity=weight))


@pytest.mark.parametrize("shape,told", [("disc", True), ("ellipse", False)])
def test_a_circle_that_contact_alone_holds_is_told_of(shape, told, monkeypatch):
    """It turns under a lip that is pushed along, as far as the springs let it; an ellipse cannot turn."""
    mesh = distmesh(domains.disc(40) if shape == "disc" else domains.ellipse(30, 50), 4.0)
    problems = []
    for weak in (module.WEAK, module.WEAK / 2):
        monkeypatch.setattr(module, "WEAK", weak)
        push = Retraction(0, 1, force_mN_per_mm=(1e-3, 0.0), blade=(0.0, 0.6))
        cut = cut_in(mesh, (1, 60), (0.3, 20))
        problems.append(posed(mesh, (cut,), BRAIN, Skull("contact", 5.0), (push,), gravity=Gravity((0.0, -1.0))))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        before, after = map(solve, problems)
    change = np.linalg.norm(after.moved - before.moved, axis=2).max()
    assert ("W410" in {item.message.code for item in found}) == told
    assert change > SWAY.value if told else change < 0.1 * SWAY.value


def test_a_disc_that_turns_out_of_its_contact_is_refused_for_that():
    """At finite strains the contact of the shape at rest lets a disc turn over."""
    problem = posed(distmesh(domains.disc(40), 5.0), (), BRAIN, Skull("contact"), gravity=Gravity((0.0, -1.0)),
                   model="neo-hookean")
    with pytest.raises(XfemnavError, match=r"E406.*turned out of the skull"):
        solve(problem)
