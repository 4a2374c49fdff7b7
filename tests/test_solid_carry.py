"""What a volume's pull-back adds to that of tetrahedra: its rim, an opened block; and where its organ is."""

import numpy as np
import pytest
from blocks import block
from numpy.testing import assert_allclose

from xfemnav.errors import XfemnavError
from xfemnav.imaging.carrying.rim import with_rim
from xfemnav.imaging.carrying.warp import covered, pull_back, update
from xfemnav.imaging.frames.volume import Volume, take_volume
from xfemnav.imaging.organ.solid import organ_in
from xfemnav.imaging.reading.gate import Image


def volume(shape=(17, 15, 19), shift=(0.0, 0.0, 0.0), seed=0):
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    affine[:3, 3] = shift
    return Volume(np.random.default_rng(seed).normal(size=shape), affine, 1)


def parted(gap):
    """A block of which the half beyond y = 3 moves by a gap."""
    rest = block(3, 6).corners
    beyond = rest.mean(axis=1)[:, 1] > 3
    return rest, rest + np.where(beyond, gap, 0.0)[:, None, None] * [0, 1.0, 0]


def test_an_opened_cut_is_a_cavity_and_one_that_closes_lies_twice():
    grid = volume((14, 20, 14), (0.21, 0.27, 0.24))  # no centre is on a face
    rest, moved = parted(1.5)
    organ = covered(rest, *grid.lattice)
    found = update(grid.values, organ, pull_back(rest, moved, *grid.lattice), fill=-7.0)
    y = grid.pixel_centres()[..., 1]
    assert (found.cavity == (organ & (y > 3) & (y < 4.5))).all()
    assert (found.updated[found.cavity] == -7).all() and not found.overlap.any()
    together = update(grid.values, organ, pull_back(rest, parted(-1.5)[1], *grid.lattice))
    assert together.overlap.sum() == 12 * 12 * 3 and together.cavity.sum() == 12 * 12 * 3
    elsewhere = update(grid.values, organ, found.pull_back, now=np.zeros_like(organ))
    assert elsewhere.vacated.sum() == found.cavity.sum() and not elsewhere.cavity.any()


def test_voxels_just_outside_of_the_surface_go_with_the_tissue_beside_them():
    grid, cells = volume((20, 20, 20), (-1.0,) * 3), block(3, 6).corners
    pull = pull_back(cells, cells + np.array([0.5, 0, 0]), *grid.lattice)
    at = grid.pixel_centres()
    rim = (at[..., 0] > 6.6) & (at[..., 0] < 7.1)
    wider = with_rim(pull, rim)
    beside = rim & ((at[..., 1:] > -0.01) & (at[..., 1:] < 6.01)).all(axis=-1)
    assert (wider.tissue == (pull.tissue | beside)).all()
    new = rim & ~pull.tissue & wider.tissue
    assert_allclose(wider.places_of(new), at[new] - [0.5, 0, 0], atol=1e-9)
    assert (wider.overlap == pull.overlap).all()


def test_a_head_needs_a_mask_and_a_stripped_volume_none():
    ball = np.linalg.norm(np.stack(np.meshgrid(*[np.arange(-20.0, 21)] * 3, indexing="ij")), axis=0)
    stripped = np.where(ball < 15, 100.0 + ball, 0.0)
    image = Image(stripped, np.diag([3.0, 3, 3, 1]), "float32", 1, "", "head.nii")
    found = organ_in(take_volume(image), image, None, "stripped")
    assert found.method == "stripped" and (found.mask == (ball < 15)).all()
    with pytest.raises(XfemnavError, match="E205") as error:
        organ_in(take_volume(image), image, None, "on")
    assert all(tool in error.value.text for tool in ("SynthStrip", "HD-BET", "ANTs"))
    holed = (ball < 12) & (ball > 3)
    assert (organ_in(take_volume(image), image, holed).mask == (ball < 12)).all()
    for code, mask in (("E201", holed & False), ("E203", holed | True)):
        with pytest.raises(XfemnavError, match=code):
            organ_in(take_volume(image), image, mask)
