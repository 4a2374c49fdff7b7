"""Where the data of a retraction stop."""

import numpy as np

from data_synthetic.domains import disc
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.geometry.plane.grading import data_ends


def test_data_ends_are_the_singular_points():
    """Mouth, tip, the blade's end and both switches of the skull's grip, which lie on the outline at its distance."""
    cut = place_cut([(0.0, 75.0), (0.0, 30.0)], disc())
    spots = data_ends(disc(), (cut,), ((0, 0.0, 0.5),), 15.0)
    points = np.array([spot[0] for spot in spots])
    np.testing.assert_allclose(points[:3], [(0, 70), (0, 30), (0, 50)], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points[3:] - (0, 70), axis=1), 15, atol=1e-3)  # the circle's 1,024 chords
    assert len(points) == 5 and np.ptp(np.sign(points[3:, 0])) == 2
    assert len(data_ends(disc(), (cut,), ((0, 0.0, 0.5),), None)) == 3
