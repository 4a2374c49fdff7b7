"""In the plane nothing has moved: displacements, energies and forces are those of before."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.former import KEPT, answer

with np.load(KEPT) as kept:
    FORMER = dict(kept)


@pytest.mark.parametrize("seeds", [list(FORMER)[k : k + 10] for k in range(0, 20, 10)]
                         + [pytest.param(list(FORMER)[20:], marks=pytest.mark.slow)],
                         ids=lambda seeds: f"from {seeds[0]}")
def test_random_networks_answer_as_before(seeds):
    for seed in seeds:
        now = answer(int(seed))
        assert now is not None, seed
        assert_allclose(now, FORMER[seed], rtol=0, atol=1e-10 * np.abs(FORMER[seed]).max(initial=1.0), err_msg=seed)
