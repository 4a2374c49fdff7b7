"""The degenerate battery: cuts in every awkward position. A listed code or a solution that opens the cut; no crash.

By default a few cuts a position; `-m slow` runs 1,200. The worst case is printed.
"""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests import cuts
from tests.meshes import BRAIN, FREE, cut_in, grid, jittered, mapped, outline, posed
from xfemnav.errors import XfemnavError
from xfemnav.mechanics.conditions.lips import Retraction, lip_quadrature
from xfemnav.mechanics.rules import Skull
from xfemnav.mechanics.solving.solution import solve

MESHES = [jittered(12.0, 10.0, 1.0, j, seed=int(100 * j)) for j in (0.0, 0.25, 0.35)] + [grid(10, 10.0)]
SKULL = Skull("fixed", 2.0, 1.0)
LIPS = ("mortar", "nitsche", "pointwise")
#: A cut may be refused as it does not enter, touches the outline, frees a piece, or is too short to hold.
LISTED = {"E301", "E302", "E305", "E306", "E402"}
WITHIN = 1.2  # the mark of the design: energy within 1.2 times the median of generic positions of the same cut


def case(name, k):
    """The k-th cut network of a position, placed in one of the meshes."""
    mesh = MESHES[k % len(MESHES)]
    network = cuts.POSITIONS[name](mesh, np.random.default_rng([k, sorted(cuts.POSITIONS).index(name)]))
    return mesh, network


def place(mesh, network):
    return tuple(cut_in(mesh, *path, internal=internal) for path, internal in network)


def pulled(mesh, placed):
    """Energy of the first cut opened by forces on its lips: a lost cut would not give way, so store less."""
    force = (Retraction(0, 1, force_mN_per_mm=(0, 1.0), blade=(0, 0.4)),
             Retraction(0, -1, force_mN_per_mm=(0, -1.0), blade=(0, 0.4)))
    return solve(posed(mesh, placed, BRAIN, SKULL, force)).energy


def survives(name, k):
    """One case through every stage: its parts are sound, and a lip condition solves or has a listed code."""
    mesh, network = case(name, k)
    try:
        placed = place(mesh, network)
        held = tuple(Retraction(0, s, normal_mm=0.2, blade=(0, 0.4)) for s in (1, -1))
        problem = posed(mesh, placed, BRAIN, SKULL, held, lip_constraint=LIPS[k // len(MESHES) % 3])
        split = problem.parts
        assert (split.volumes > 0).all()
        cell = np.bincount(split.cell[split.part], split.volumes, len(mesh.cells))
        assert_allclose(cell, mesh.volumes, rtol=1e-12)
        solution = solve(problem)
    except XfemnavError as error:
        assert error.code in LISTED, f"{name} {k}: {error}"
        return error.code
    assert np.isfinite(solution.U).all() and solution.residual <= 1e-8
    # The cut is open: the mean opening over the blade is the prescribed .4 mm, up to the lip error; about half of it on
    # a staircase, where the displacement along the normal turns by 90 degrees at each step and no field follows.
    # Not asked of a grazing cut: its blade of .15 mm goes round a right angle, and turns that steeply what it holds.
    if name != "grazing":
        q, r = (lip_quadrature(problem.space, 0, side, problem.spans[0]) for side in (1, -1))
        jump = (problem.space.basis_in(q.points, q.parts) - problem.space.basis_in(r.points, r.parts)) @ solution.U
        assert q.weights @ np.einsum("qi,qi->q", jump, q.normals) / q.weights.sum() > 0.1
        assert np.abs(solution.moved - solution.rest).max() < 2.0
    return "solved"


def compare(name, k):
    """Energy of a case over the median of the same path shifted to three generic positions by a tenth of an element."""
    mesh, ((path, _),) = case(name, k)
    path = np.asarray(path, float)
    generic = []
    for angle in (0.4, 2.5, 4.6):
        moved = path + 0.1 * np.array([np.cos(angle), np.sin(angle)])
        moved[0] -= (moved[1] - moved[0]) / np.linalg.norm(moved[1] - moved[0])  # from outside, the same way
        generic.append(pulled(mesh, place(mesh, [(moved, False)])))
    return pulled(mesh, place(mesh, [(path, False)])) / np.median(generic)


def stretched(mesh, placed):
    """Energy of the plate pulled at its upper and lower edges; the sides, 50 mm long, are free."""
    loop = outline(mesh)
    ends = loop[(loop[:, 1] == loop[:, 1].min()) | (loop[:, 1] == loop[:, 1].max())]
    measured = np.column_stack([ends, 0.01 * ends * (0.0, 1.0)])
    return solve(posed(mesh, placed, BRAIN, FREE, boundary_displacement=measured)).energy


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
@pytest.mark.parametrize("name", sorted(cuts.POSITIONS))
def test_every_position_is_solved_or_refused_by_name(name):
    outcomes = [survives(name, k) for k in (0, 5, 10)]  # three meshes, three lip conditions
    print(name, outcomes)
    if name in cuts.COMPARABLE:
        assert set(outcomes) == {"solved"}


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_no_position_loses_the_cut():
    """Compliance under the same forces: within 1.2 of the generic median for every second position."""
    _report({(name, 1): compare(name, 1) for name in sorted(cuts.COMPARABLE)[::2]})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
@pytest.mark.parametrize("name", sorted(cuts.POSITIONS))
def test_battery_of_positions(name):
    """50 cuts a position, 1,200 in all."""
    outcomes = [survives(name, k) for k in range(50)]
    print(name, {o: outcomes.count(o) for o in sorted(set(outcomes))})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_battery_of_energies():
    """20 cuts a comparable position: none is lost."""
    _report({(name, k): compare(name, k) for name in cuts.COMPARABLE for k in range(20)})


def _report(ratios):
    worst = max(ratios, key=lambda case: abs(np.log(ratios[case])))
    print(f"worst of {len(ratios)}: {worst[0]} {worst[1]}, energy {ratios[worst]:.4f} of the generic median")
    assert 1 / WITHIN <= ratios[worst] <= WITHIN


@pytest.mark.parametrize("edge", ["row of nodes", "slanted edge"])
def test_offsets_down_to_rounding_give_one_answer(edge):
    """A cut 1e-1 to 1e-14 h beside mesh edges, and exactly on them: the energy goes to that of the limit, no jump."""
    mesh = grid(10, 10.0)
    start, end = {"row of nodes": ((0.0, 4.0), (6.37, 4.0)), "slanted edge": ((0.0, 1.0), (6.37, 7.37))}[edge]
    normal = np.array([start[1] - end[1], end[0] - start[0]])
    normal = normal / np.linalg.norm(normal)
    energies = []
    offsets = np.array([1e-1, 1e-2, 1e-3, 2e-4, 1e-6, 1e-10, 1e-14, 0.0, -1e-14, -1e-8, -1e-4, -2e-3, -1e-1])
    for offset in offsets:
        path = np.array([start, end]) + offset * normal
        path[0] -= 1e-1 * (path[1] - path[0])
        energies.append(pulled(mesh, place(mesh, [(path, False)])))
    energies = np.array(energies)
    limit = energies[offsets == 0]
    print(f"{edge}: energies within {np.abs(energies / limit - 1).max():.1%} of that on the edges")
    # An offset of .1 h moves the lip's slack by as much; below 1e-3 h the cut is snapped onto the edges.
    assert np.abs(energies / limit - 1).max() < WITHIN - 1
    near = np.abs(offsets) < 5e-4
    assert_allclose(energies[near], np.full(near.sum(), limit), rtol=1e-6)


@pytest.mark.parametrize("length", [0.05, 0.3, 0.6, 1.0, 2.0])
@pytest.mark.parametrize("inside", [False, True])
def test_a_short_cut_opens_or_is_named(length, inside):
    """Pulled across, a plate with a cut of .05 to 2 h stores less than the whole one, or W303 says why."""
    h = 5.0
    mesh = mapped(MESHES[1], h * np.eye(2))
    start = h * (np.array([5.3, 5.2]) if inside else np.array([0.0, 5.13]))
    travel = np.array([0.98, 0.2])
    cut = cut_in(mesh, start - (0.0 if inside else 0.1) * travel, start + length * h * travel, internal=inside)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        energy = stretched(mesh, (cut,))
    whole = stretched(mesh, ())
    assert energy <= whole * (1 + 1e-12)  # a cut only adds functions to minimise over
    assert any("W303" in str(w.message) for w in caught) == inside
    assert inside or energy < whole * (1 - 1e-9)
