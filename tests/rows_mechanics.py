"""Rows of the table of real data: what holds an outline, what blades hold, and what hardly hangs together."""

import warnings

import numpy as np

import xfemnav
from data_synthetic import domains
from tests import small
from tests.meshes import BRAIN, posed
from tests.rows import Row
from tests.test_free_pieces import outcome
from tests.test_measured import change, measured, symmetric
from tests.test_slivers import BOX, DOWN, OPEN
from xfemnav.errors import XfemnavError
from xfemnav.geometry.plane.cut import Cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.mechanics.rules import Gravity, Skull
from xfemnav.mechanics.solving.solution import solve


def measured_outline(folder):
    """Measured to within 4, 12 and 16 mm of the mouth of a cut on the axis of symmetry, which stays shut."""
    off = [change(symmetric(), Skull("fixed"), measured(half_width, 2.5)) for half_width in (4.0, 12.0, 16.0)]
    worst = max(change for change, _ in off)
    assert worst < 1e-3
    return f"changes {worst:.0e} of {max(size for _, size in off):.2f} mm", ""


def contact_on_springs(folder):
    """Random organs that only touch the skull, and one that falls out through its craniotomy."""
    found = [outcome(k) for k in range(30, 42)]
    assert all(item.solution and item.solution.max_displacement_mm < item.size for item in found)
    told = sum("W410" in item.told for item in found)
    mesh = distmesh(domains.disc(40), 5.0)
    try:
        solve(posed(mesh, (), BRAIN, Skull("contact", 35.0, openings=((0.0, -40.0),)), gravity=Gravity((0.0, -1.0))))
    except XfemnavError as error:
        assert error.code == "E406"
        return f"12 of 12 random organs solved, {told} of them told of; what falls out is refused", "W410, E406"
    raise AssertionError("what falls out through the craniotomy was not refused")



def told(cuts, retractions=()):
    """Codes of the warnings that a problem brings."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        posed(BOX, cuts, BRAIN, Skull("fixed", 5.0, 2.0), retractions)
    return [item.message.code for item in found]


def blade_on_a_shred(folder):
    """A second cut 1.5 mm beside the first: the blade between them holds what is left; and one on sound brain."""
    codes = told((DOWN, Cut([(31.5, 30.0), (31.5, 6.0)], name="other")), OPEN)
    assert "W305" in codes and "W305" not in told((DOWN,), OPEN)
    return "a shred of 1.5 mm under a blade is named; sound brain is not", "W305"


def blades_under_gravity(folder):
    """A run with normal_mm on both sides, and one without blades: how far apart the lips have come."""
    scenario = folder / "sinking.toml"
    small.write(folder / "brain.nii.gz")
    text = """xfemnav = 1
image = "brain.nii.gz"
[[cut]]
points = [[-60, 10], [-15, 5]]
[load]
gravity = [0, -0.3]
[boundary]
craniotomy_mm = 50
[mesh]
element_size_mm = 8
corridor_element_mm = 4
"""
    lips = {}
    for name, blades in (("lying", ""), ("parted", "[[retract]]\nside = \"left\"\nnormal_mm = 4\n[[retract]]\n"
                                                   "side = \"right\"\nnormal_mm = 4\n")):
        scenario.write_text(text + blades)
        run = xfemnav.run(scenario=scenario, output=folder / name, cache=folder / "cache", report=False)
        path = np.array(run.record["cuts"][0]["path"])
        along = np.linspace(0.1, 0.5, 9)[:, None] * (path[-1] - path[0]) + path[0]
        normal = np.array([path[0, 1] - path[-1, 1], path[-1, 0] - path[0, 0]]) / np.linalg.norm(path[-1] - path[0])
        lips[name] = [run.motion.displacement(along, np.full(9, side)) @ normal * side for side in (1, -1)]
    parted = [float((after - before).mean()) for after, before in zip(lips["parted"], lips["lying"])]
    assert np.allclose(parted, 4.0, atol=0.2)
    return "parted by {:.1f} and {:.1f} mm from where they lay".format(*parted), ""


def thin_strip(folder):
    """2.5 mm of tissue over an internal cut, in elements of 1 mm."""
    codes = told((Cut([(15.0, 27.5), (40.0, 27.5)], mouth=False),))
    assert codes == ["W306"]
    return "the strip and the size that it wants are named", "W306"


ROWS = [
    Row("A3", "blades on shreds of 1 to 3 mm", "green, while the brain stays put", blade_on_a_shred),
    Row("A4", "measured outline that ends beside a mouth", "carried on to the mouth: .49 of .94 mm", measured_outline),
    Row("A18", "normal_mm = 4 with gravity", "parted by 4.7 and 2.9 mm", blades_under_gravity),
    Row("A19", "contact alone holds", "E407 for 5 of 6 discs, a piece flies 789 mm", contact_on_springs),
    Row("A20", "a strip of 2.5 elements", "18 % too stiff, no warning", thin_strip),
]
