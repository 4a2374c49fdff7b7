"""Nitsche's condition: positive wherever the blade is."""

import pytest

from tests.meshes import BRAIN, HARD_SKULL, cut_in, disc, posed
from xfemnav.mechanics.rules import Retraction
from xfemnav.mechanics.solving.solution import solve


@pytest.mark.parametrize("h", [2.0, 4.0])
def test_it_stays_positive_where_the_blade_reaches_the_tip_functions(h):
    """No constant bounds the strains of branch functions; with their tractions in the form this moved 25 mm, or failed.

    The lips are moved by 3 mm; the condition is weak, so a corner may go a little farther.
    """
    mesh = disc(h=h)
    cut = cut_in(mesh, (1.3, 80), (0.7, 30.2))
    blades = tuple(Retraction(0, side, normal_mm=3.0, blade=(0, 0.8)) for side in (1, -1))
    problem = posed(mesh, (cut,), BRAIN, HARD_SKULL, blades, lip_constraint="nitsche", tip_enrichment="geometric")
    assert solve(problem).max_displacement_mm < 3.2
