"""Segmentation: Dice on real stripped brains, on heads made around them and on the phantom; invariances; refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from tests.images import ORDERS, brain, head_of, image_of, phantom_head, slice_of, stored
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.organ.masks import dice, one_piece
from xfemnav.imaging.organ.segment import segment
from xfemnav.imaging.organ.stripped import judge

PLACES = [("axial", -20), ("axial", 20), ("axial", 60), ("coronal", -30), ("sagittal", 40)]
mni = cache(brain)


def brain_slice(plane, position):
    """A stripped slice, and its mask as nilearn gives it."""
    image, mask = mni()
    return (take_slice(image, plane=plane, position_mm=position),
            one_piece(take_slice(mask, plane=plane, position_mm=position).values > 0))


def code_of(*args, **kwargs) -> str:
    with pytest.raises(XfemnavError) as failure:
        segment(*args, **kwargs)
    return failure.value.code


# Stripped slices ------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("plane, position", PLACES)
def test_stripped_brain_is_filled(plane, position):
    slice, truth = brain_slice(plane, position)
    found = segment(slice)
    assert found.method == "stripped" and dice(found.mask, truth) > 0.95


def test_stripped_slices_are_known_at_any_scale_of_intensity():
    slice, _ = brain_slice("axial", 20)
    inside = slice.values > 0
    scored = np.where(inside, (slice.values - slice.values[inside].mean()) / slice.values[inside].std(), 0)
    assert scored.min() < -1  # z-scored: the background is 0, tissue lies on both sides
    for values in (scored, 1e-3 * slice.values - 5, 4000 * slice.values + 32768):
        assert dice(segment(replace(slice, values=values)).mask, segment(slice).mask) > 0.99


def test_a_flat_organ_larger_than_its_background_is_found():
    flat = np.zeros((60, 70))
    flat[2:57, 4:66] = 5
    found = segment(slice_of(flat))
    assert found.method == "stripped" and ((flat > 0) == found.mask).all()


@pytest.mark.parametrize("plane, position", PLACES[1:4])
def test_a_head_with_constant_air_is_not_taken_for_stripped(plane, position):
    head, _ = head_of(brain_slice(plane, position)[0], np.random.default_rng(3))
    assert not judge(replace(head, values=np.where(head.values < 100, 0, head.values))).stripped
    assert not judge(head).stripped


def test_noisy_air_is_not_taken_for_stripped():
    slice, _ = brain_slice("axial", 20)
    noise = abs(np.random.default_rng(1).normal(0, 0.02 * slice.values.max(), slice.values.shape))
    assert judge(slice).stripped and not judge(replace(slice, values=slice.values + noise)).stripped
    assert not judge(replace(slice, values=np.rint(50 * (slice.values + noise)))).stripped  # few levels, as in 8 bits


def test_the_user_overrules_the_test():
    slice, _ = brain_slice("axial", 20)
    with pytest.warns(XfemnavWarning, match="W206 .*does not stand out"):  # the brain is all of this "head"
        assert segment(slice, skull="on").method == "vote"
    head, _ = head_of(slice, np.random.default_rng(3))
    thresholded = replace(head, values=np.where(head.values < 100, 0, head.values))
    assert segment(thresholded, skull="stripped").method == "stripped"


# Heads ----------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("plane, position", PLACES)
def test_vote_finds_the_brain_in_a_head(plane, position):
    head, truth = head_of(brain_slice(plane, position)[0], np.random.default_rng(abs(position)))
    found = segment(head)
    assert found.method == "vote" and dice(found.mask, truth) > 0.95
    assert max(found.info["agreement"].values()) > 0.9 and found.info["merit"] > 2.6


@pytest.mark.parametrize("grid, scene", [("B", {}), ("A", {"contrast": "flair", "tumour": "crossed"})])
def test_phantom_is_found(grid, scene):
    slice, truth = phantom_head(grid=grid, **scene)
    found = segment(slice)
    assert found.method == "vote" and dice(found.mask, truth) > 0.95  # a ring of one pixel is .013
    assert ndimage.label(found.mask)[1] == 1 and (ndimage.binary_fill_holes(found.mask) == found.mask).all()


def test_otsu_alone_is_there_when_asked_for():
    slice, truth = phantom_head()
    found = segment(slice, method="otsu")
    assert found.method == "otsu" and dice(found.mask, truth) > 0.9


@cache
def found_in_phantom():
    return segment(phantom_head(grid="B")[0]).mask


@pytest.mark.parametrize("scale, offset", [(0.01, -3.0), (250.0, 1e4)])
def test_scale_and_offset_of_intensities_do_not_matter(scale, offset):
    slice, _ = phantom_head(grid="B")
    changed = segment(replace(slice, values=scale * slice.values + offset))
    assert dice(changed.mask, found_in_phantom()) > 0.999


def test_storage_order_does_not_matter():
    slice, _ = phantom_head(grid="B")
    image = image_of(slice.values[:, :, None], slice.affine)
    truth = found_in_phantom()
    for order, flips in ORDERS[5::20]:
        assert dice(segment(take_slice(stored(image, order, flips))).mask, truth) > 0.999


def test_pixel_size_does_not_matter_in_mm():
    slice, truth = phantom_head()
    fine = ndimage.zoom(slice.values, (2, 1), order=1, grid_mode=True, mode="nearest")
    found = segment(slice_of(fine, slice.spacing * [0.5, 1])).mask
    assert dice(found, np.repeat(truth, 2, axis=0)) > 0.97


# A given mask, refusals, doubts ---------------------------------------------------------------------------------------

def test_a_given_mask_wins():
    slice, _ = phantom_head()
    mask = np.zeros(slice.values.shape, bool)
    mask[100:140, 90:150] = True
    for method in ("auto", "otsu", "vote"):
        found = segment(slice, method=method, mask=mask)
        assert found.method == "mask" and (found.mask == mask).all()
    assert found.info["area_mm2"] == pytest.approx(40 * 60 * 0.64)
    assert code_of(slice, mask=~mask | mask) == "E203"
    assert code_of(slice, mask=mask & ~mask) == "E201"


def test_a_constant_slice_is_refused():
    assert code_of(slice_of(np.full((40, 50), 7.0))) == "E202"
    assert code_of(slice_of(np.zeros((40, 50))), method="otsu") == "E202"


def test_unknown_method_is_refused():
    assert code_of(phantom_head()[0], method="magic") == "E780"


def test_noise_has_no_organ():
    assert code_of(slice_of(np.random.default_rng(0).normal(size=(180, 200))), skull="on") == "E201"


def test_a_small_organ_is_doubted():
    i, j = np.indices((60, 60))
    disc = (np.hypot(i - 30, j - 30) < 15) * (100.0 + i)
    with pytest.warns(XfemnavWarning, match=r"W206 .*its area is only [67]\d\d mm2"):  # pi 15^2 = 707
        segment(slice_of(disc))
