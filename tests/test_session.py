"""A session answers as runs do: the same cut, blades, image and forces, whatever moved before; and what it refuses."""

import contextlib
import doctest
import queue
import subprocess
import sys
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import CUT, brain, write

import xfemnav
from data_synthetic import domains
from tests.meshes import posed
from xfemnav import Session, XfemnavError
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.imaging.carrying.warp import covered, pull_back, update
from xfemnav.mechanics.live.incision import OutOfReach
from xfemnav.mechanics.rules import Retraction, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material
from xfemnav.pipeline.running import session as module

COARSE = {"element_size_mm": 6.0, "corridor_element_mm": 2.0}
PLAN = np.array([[-60.0, 10.0], [-15.0, 5.0]])
# The mark of a live answer: far above rounding (1e-12 mm here), far below what matters.
SAME_MM = 1e-9
pytestmark = pytest.mark.filterwarnings("ignore:W404", "ignore:W402")


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    return write(tmp_path_factory.mktemp("session") / "head.nii.gz")


@pytest.fixture(scope="module")
def session(head):
    return Session(head, corridor=CUT, **COARSE)


def solved(session, path, moves, blade=(0.0, 0.8)):
    """The batch's answer on the session's mesh; moves {side: (dx, dy) or mm}."""
    cut = place_cut(path, session.mesh.outline)
    blades = tuple(Retraction(0, side, blade=blade, **({"normal_mm": move} if np.isscalar(move) else
                                                       {"displacement_mm": move})) for side, move in moves.items())
    return solve(posed(session.mesh, (cut,), Material(), Skull(), blades)), cut


def assert_answers(session, path, moves, blade=(0.0, 0.8)):
    whole, cut = solved(session, path, moves, blade)
    assert_allclose(session.nodes, whole.U[: len(session.mesh.points)], atol=SAME_MM)
    motion = whole.motion
    points = np.random.default_rng(0).uniform((-50, -60), (50, 60), (400, 2))
    assert_allclose(session.to_current(points), motion.to_current(points), atol=SAME_MM)
    on_the_cut = np.array([cut.at(t) for t in np.linspace(0.02, 0.98, 40)])
    for name, side in (("left", 1), ("right", -1)):
        assert_allclose(session.to_current(on_the_cut, name), motion.to_current(on_the_cut, side), atol=SAME_MM)
    found = session.forces()
    for blade in whole.retractor:
        live = found[{1: "left", -1: "right"}[blade.side]]
        scale = np.abs(blade.force_mN_per_mm).max()
        assert_allclose(live.force_mN_per_mm, blade.force_mN_per_mm, atol=1e-7 * scale)
        assert live.mean_pressure_kPa == pytest.approx(blade.mean_pressure_kPa, rel=1e-7)
    return whole


def test_example_of_the_documentation():
    found = doctest.testmod(module)
    assert found.attempted > 4 and found.failed == 0


def test_cuts_and_blades_one_after_the_other(session):
    """Moved, opened, held elsewhere, lengthened: nothing of what was before is left."""
    rng = np.random.default_rng(2)
    for _ in range(3):
        path = PLAN + rng.uniform(-4, 4, (2, 2))
        session.cut(path)
        session.open(left=(1.5, 2.5), right=(-1.0, -2.0))
        assert_answers(session, path, {1: (1.5, 2.5), -1: (-1.0, -2.0)})
        session.open(left=2.0, right=1.0)
        assert_answers(session, path, {1: 2.0, -1: 1.0})
    for blade in ((0.3, 0.8), (0.1, 0.6)):
        session.open(left=2.5, blade=blade)
        assert_answers(session, path, {1: 2.5}, blade)
    session.extend_cut([-8.0, 3.0])
    assert_answers(session, np.vstack([path, [-8.0, 3.0]]), {1: 2.5}, (0.1, 0.6))
    session.open(right=-1.0)  # pushed onto the left lip, which presses back
    assert session.motion is not None
    assert assert_answers(session, np.vstack([path, [-8.0, 3.0]]), {-1: -1.0}).contact_force.max() > 0


def test_a_cut_that_moves_keeps_its_blades(session):
    session.cut(PLAN)
    session.open(left=(1.5, 2.0), right=(-1.0, -2.0))
    session.cut(PLAN + np.array([0.0, 2.5]))
    assert_answers(session, PLAN + np.array([0.0, 2.5]), {1: (1.5, 2.0), -1: (-1.0, -2.0)})


def test_blades_answer_in_proportion_and_add_up(session):
    session.cut(PLAN)
    fields = []
    for left, right in ((1.0, 0.5), (2.0, 1.0), ((0.0, 1.5), (0.5, -1.0)), ((0.0, 3.0), (1.0, -2.0))):
        session.open(left=left, right=right)
        fields.append(session.nodes)
    for one, two in (fields[:2], fields[2:]):
        assert_allclose(2 * one, two, atol=1e-12)


@pytest.mark.parametrize("move", [(0.5, 1.5), (-0.5, -1.5)])
def test_lips_may_go_along_with_each_other_but_not_into_each_other(session, move):
    session.cut(PLAN)
    session.open(left=move, right=move)
    assert_answers(session, PLAN, {1: move, -1: move})
    with pytest.raises(XfemnavError, match="E405"):
        session.open(left=(0.5, -1.5), right=(-0.5, 1.5))


def test_the_image_is_that_of_the_stages(session):
    session.cut(PLAN + np.array([0.0, -1.0]))
    session.open(left=1.0)
    session.image()  # of blades that go on
    session.open(left=2.0, right=2.0)
    whole, _ = solved(session, PLAN + np.array([0.0, -1.0]), {1: 2.0, -1: 2.0})
    grid = session.frame.origin, session.frame.spacing, session.frame.values.shape
    pulled = pull_back(whole.rest, whole.moved, *grid)
    organ = covered(session.mesh.corners, *grid)
    # Grey values change by some hundred a pixel, so places 1e-9 mm apart give values 1e-7 apart; images are float32.
    expected = update(session.frame.values, organ, pulled).updated
    assert_allclose(session.image(), expected, atol=1e-3)
    companion = np.random.default_rng(0).normal(size=grid[2])
    assert_allclose(session.image(companion), update(companion, organ, pulled).updated, atol=1e-5)
    assert np.abs(session.image() - session.frame.values).max() > 100


def test_a_session_and_a_run_of_one_image(head, tmp_path):
    """Segmentation, mesh, cut and warp: the session's slice is that of the run."""
    flags = {"slice": 0} | COARSE
    result = xfemnav.run(head, cut=CUT, left=(0.5, 2.5), right=(-0.5, -2.5), output=tmp_path / "out",
                         cache=tmp_path / "cache", report=False, **flags)
    session = Session(head, corridor=CUT, **flags)
    session.cut(CUT)
    session.open(left=(0.5, 2.5), right=(-0.5, -2.5))
    assert_allclose(session.image(), result.warp(brain()), atol=1e-3)
    points = np.random.default_rng(1).uniform((-30, -40), (30, 40), (100, 2))
    world = np.column_stack([points, np.linspace(9, 11, 100)])  # about the slice: each keeps its distance from it
    now = session.to_current(world)
    assert_allclose(now, result.to_current(world), atol=SAME_MM)
    assert_allclose(now[np.isfinite(now[:, 2]), 2], world[np.isfinite(now[:, 2]), 2], atol=SAME_MM)
    assert_allclose(session.to_preoperative(points), result.to_preoperative(points), atol=SAME_MM)


def test_an_organ_at_rest_stays_where_it_is(head):
    session = Session(head, corridor=CUT, **COARSE)
    points = np.array([[0.0, 0.0], [-20.0, 8.0], [100.0, 0.0]])
    assert_allclose(session.displacement(points), [[0, 0], [0, 0], [np.nan, np.nan]], atol=1e-14)
    assert np.array_equal(session.image(), session.frame.values.astype(np.float32))
    assert session.forces() == {} and session.inverted_mm2 == 0


def test_a_mouth_elsewhere_condenses_the_organ_anew(head):
    session = Session(head, corridor=CUT, **COARSE)
    path = np.array([[0.0, 70.0], [2.0, 20.0]])
    with pytest.warns(xfemnav.XfemnavWarning, match="W315"):
        session.cut(path)
    session.open(left=2.0, right=2.0)
    assert_answers(session, path, {1: 2.0, -1: 2.0})


def test_what_a_session_cannot_do_is_named(session, head):
    for flags in ({"left": (3, 1)}, {"skull": "free"}, {"lip_constraint": "nitsche"}, {"model": "neo-hookean"},
                  {"gravity": (0, -1)}):
        with pytest.raises(XfemnavError, match="E780"):
            Session(head, corridor=CUT, **COARSE, **flags)
    with pytest.raises(XfemnavError, match="plan"):
        Session(head, **COARSE)
    session.cut(PLAN)
    for moves in ({"left": (1, 2, 3)}, {"left": np.nan}, {"left": "wide"}):
        with pytest.raises(XfemnavError, match="E780"):
            session.open(**moves)
    with pytest.raises(XfemnavError, match="E405"):
        session.open(left=-2.0, right=1.0)
    with pytest.raises(XfemnavError, match="E301"):
        session.cut([[-80.0, 0.0], [-70.0, 0.0]])
    with pytest.raises(XfemnavError, match="E314"):
        session.cut([[-60.0, 10.0], [-30.0, 8.0], [-60.0, 0.0]])
    shape = session.frame.values.shape
    for companion in (np.zeros((3, 3)), np.zeros(shape, complex), np.full(shape, "a")):
        with pytest.raises(XfemnavError, match="E130"):
            session.image(companion)
    for how in ({"interp": "spline"}, {"outside": "elsewhere"}):
        with pytest.raises(XfemnavError, match="E780"):
            session.image(**how)
    for points in ([[1, 2, 3, 4]], "x", "0,60", [["a", "b"]], np.zeros((2, 2, 2))):
        with pytest.raises(XfemnavError, match="E780"):
            session.displacement(points)
    bare = Session(session.mesh, corridor=PLAN)
    for asked in (lambda: bare.to_current([[0, 0, 0.0]]), lambda: bare.cut([[0, 75, 0], [0, 30, 0]]),
                  lambda: Session(session.mesh, corridor=PLAN, cut=PLAN),
                  lambda: Session(session.mesh, corridor=PLAN, reach_mm=-1),
                  lambda: Session(session.mesh, corridor=PLAN, reach_mm="x")):
        with pytest.raises(XfemnavError, match="E780"):
            asked()


def test_a_cut_that_fails_leaves_the_one_before(session):
    session.cut(PLAN)
    session.open(left=2.0, right=2.0, blade=(0.0, 0.7))
    before = session.image(), session.nodes, session.forces()
    for path in ([[-80.0, 0.0], [-70.0, 0.0]], [[-46.0, 9.0], [-43.0, 8.5]]):  # outside; too short for its blades
        with pytest.raises(XfemnavError, match=r"E301|E402"):
            session.cut(path)
        assert np.array_equal(session.image(), before[0]) and np.array_equal(session.nodes, before[1])
        assert session.forces() == before[2]
    session.open(left=1.0, right=1.0, blade=(0.0, 0.7))
    assert_allclose(2 * session.nodes, before[1], atol=1e-12)


def test_tip_functions_reach_the_skull_across_the_organ():
    """Geometric tip functions of a long cut change what the skull holds far from it."""
    mesh, path = distmesh(domains.disc(70.0), 6.0), np.array([[0.0, 75.0], [1.0, -54.0]])
    session = Session(mesh, corridor=[[0, 75], [0, 30]], tip_enrichment="geometric")
    with pytest.warns(xfemnav.XfemnavWarning, match="W315"):
        session.cut(path)
    session.open(left=3.0, right=3.0)
    cut = place_cut(path, mesh.outline)
    blades = tuple(Retraction(0, side, normal_mm=3.0, blade=(0.0, 0.8)) for side in (1, -1))
    whole = solve(posed(mesh, (cut,), Material(), Skull(), blades, tip_enrichment="geometric"))
    assert_allclose(session.nodes, whole.U[: len(mesh.points)], atol=SAME_MM)


@pytest.mark.parametrize("place, fails", [
    ("incision.incise", OutOfReach), ("live_cut.lip_modes", KeyboardInterrupt), ("incision.incise", MemoryError)])
def test_whatever_fails_leaves_the_cut_before(monkeypatch, place, fails):
    session = Session(distmesh(domains.disc(70.0), 6.0), corridor=[[0, 75], [0, 30]])
    session.cut([[0, 75], [0, 30]])
    session.open(left=2.0, right=2.0)
    before = session.nodes, session.forces(), dict(session.__dict__)

    def broken(*_):
        raise fails

    monkeypatch.setattr(f"xfemnav.mechanics.live.{place}", broken)
    with pytest.raises(XfemnavError if fails is OutOfReach else fails) as caught, \
            pytest.warns() if fails is OutOfReach else contextlib.nullcontext():
        session.cut([[0, 75], [2, 32]])
    assert fails is not OutOfReach or caught.value.code == "E780"
    assert session.__dict__ == before[2]
    monkeypatch.undo()
    session.open(left=2.0, right=2.0)
    assert np.array_equal(session.nodes, before[0]) and session.forces() == before[1]


@pytest.mark.parametrize("flags", [{"internal": True}, {"craniotomy": False}])
def test_tip_functions_within_a_radius_of_any_cut(flags, tmp_path):
    """Inside the organ no facet of the outline is near; through closed bone none that the cut sets free."""
    mesh = distmesh(domains.disc(70.0), 6.0)
    path = np.array([[-20.0, 10.0], [15.0, 4.0]] if flags.get("internal") else [[0.0, 75.0], [0.0, 45.0]])
    (name, value), = flags.items()
    scenario = tmp_path / "cut.toml"
    scenario.write_text(f"xfemnav = 1\n[[cut]]\npoints = {path.tolist()}\n{name} = {str(value).lower()}\n")
    session = Session(mesh, scenario=scenario, tip_enrichment="geometric")
    session.cut(path)
    session.open(left=1.0, right=1.0, blade=(0.4, 0.6))
    cut = place_cut(path, mesh.outline, **flags)
    blades = tuple(Retraction(0, side, normal_mm=1.0, blade=(0.4, 0.6)) for side in (1, -1))
    whole = solve(posed(mesh, (cut,), Material(), Skull(), blades, tip_enrichment="geometric"))
    assert_allclose(session.nodes, whole.U[: len(mesh.points)], atol=SAME_MM)


def test_what_needs_a_cut_or_an_image_says_so(session):
    bare = Session(session.mesh, corridor=PLAN)
    for refused in (lambda: bare.open(left=1.0), lambda: bare.extend_cut([0, 0]), bare.image):
        with pytest.raises(XfemnavError, match="E780"):
            refused()


def example():
    return Path(__file__).parents[1] / "docs" / "live_example.py"


def test_the_example_follows_the_poses():
    """By itself, as a user would start it: 6 poses of the blades at 30 Hz and 1 of the tip, some of them at once."""
    code = f"import runpy; print(runpy.run_path({str(example())!r})['main'](seconds=0.2))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd="/").stdout
    *lines, answered = told.splitlines()
    assert 1 <= int(answered) <= 7 and len(lines) == int(answered) and all("mm apart" in line for line in lines)


def test_the_latest_pose_of_each_kind_is_taken_and_the_end_is_not_lost():
    poses, latest = queue.Queue(), run_path(example())["latest"]
    for each in (("blades", 1), ("tip", 2), ("blades", 3), None):
        poses.put(each)
    assert latest(poses) == {"blades": 3, "tip": 2} and latest(poses) == {} == latest(poses)
