"""The plane is the limit of space: the middle of a long cylinder, cut along all of it, moves as its section does."""

from functools import cache

import pytest

from benchmarks.verification import slab


@cache
def section():
    return slab.section(0.5)


def test_a_long_cylinder_moves_as_its_section():
    """Its left is the section's: swapped blades would differ by millimetres."""
    solid = slab.extruded(slab.cylinder(4.0, 8.0, 20.0, half=60.0))
    found = slab.beside(solid, section(), 5000)
    assert found.worst < 0.16 and found.rms < 0.08 and found.out < 0.03
    left, right = solid[1].retractor
    assert left.force_mN_per_mm[0] > 0 > right.force_mN_per_mm[0]


@pytest.mark.slow
def test_a_fine_cylinder_moves_as_its_section():
    found = slab.beside(slab.extruded(slab.cylinder(1.25, 2.5, 12.0)), section())
    assert found.worst < 0.05 and found.rms < 0.0125 and found.out < 0.005
