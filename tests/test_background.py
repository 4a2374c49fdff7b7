"""The value of pixels without tissue: the image's own background, and a doubt where that looks like tissue."""

import warnings

import numpy as np
import pytest

from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.carrying.background import asked_blank, blank_of, corner_values, warn_of_blank

SHAPE = (60, 80)
X, Y = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij")
ORGAN = X**2 + Y**2 < 0.8
TISSUE = 500 + 300 * np.sin(3 * X) * np.cos(2 * Y)


def slice_of(background, tissue=TISSUE):
    return np.where(ORGAN, tissue, background)


@pytest.mark.parametrize("values, wanted", [
    (slice_of(0), 0), (slice_of(-1000, TISSUE / 10), -1000), ((slice_of(0) - 500) / 105, -500 / 105),
    (-slice_of(0), 0), (slice_of(0) - 2000, -2000), (slice_of(4095), 4095),
])
def test_the_background_is_that_of_the_corners(values, wanted):
    assert blank_of(values, ORGAN) == wanted
    assert blank_of(values, ORGAN, 7.0) == 7.0


def test_noise_leaves_one_of_the_images_own_values():
    values = np.rint(slice_of(np.random.default_rng(0).integers(0, 9, SHAPE), TISSUE / 4)).astype(np.uint8)
    assert blank_of(values, ORGAN) == int(blank_of(values, ORGAN)) == 4


def test_corners_are_a_tenth_of_the_sides_wide():
    values = np.zeros(SHAPE)
    values[:6, :8] = values[-6:, :8] = values[:6, -8:] = values[-6:, -8:] = 1
    assert corner_values(values).size == 4 * 6 * 8 and (corner_values(values) == 1).all()
    assert corner_values(np.ones((3, 5, 1))).size == 4


def test_corners_that_hold_tissue_are_no_background():
    """A cropped image: 0, as in images that are padded; and a value that is nowhere else is none of tissue."""
    assert blank_of(TISSUE, ORGAN) == 0
    values = slice_of(-4.0, TISSUE / 100)
    values[:10], values[:, :30] = 5.0, 5.0    # tissue in three of the corners
    assert blank_of(values, ORGAN) == 0


def test_nan_is_no_background():
    values = slice_of(-1000.0, TISSUE / 10)
    values[:4] = np.nan
    assert blank_of(values, ORGAN) == -1000
    assert blank_of(np.full(SHAPE, np.nan), ORGAN) == 0


def told(blank, tissue, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", XfemnavWarning)
        warn_of_blank(blank, tissue, "the image", **options)
    return " | ".join(str(item.message) for item in caught)


def test_a_value_of_tissue_is_told():
    tissue = TISSUE[ORGAN]
    assert "W211 fill 500" in told(500.0, tissue, given=True)
    assert told(0.0, tissue, given=True) == told(-5.0, tissue, given=True) == told(0.0, tissue, given=False) == ""
    assert "no background is known" in told(0.0, tissue - 500, given=False)
    assert 'outside="zero"' in told(-4.0, (tissue - 500) / 100, given=False, outside="zero")
    assert told(0.0, np.array([]), given=True) == ""
    low, _ = np.percentile(tissue, [1, 99])
    assert told(low - 1e-9, tissue, given=True) == "" != told(low + 1e-9, tissue, given=True)


def test_a_fill_that_the_type_cannot_hold():
    values = slice_of(0).astype(np.uint8)
    with pytest.raises(XfemnavError, match=r"E780.*uint8"):
        asked_blank(values, ORGAN, "nearest", "keep", -1000.0)
    with pytest.raises(XfemnavError, match="E780"):
        asked_blank(values, ORGAN, "nearest", "keep", 0.5)
    assert asked_blank(values, ORGAN, "linear", "keep", -1000.0) == -1000
    for fill in (float("nan"), float("inf"), 1e39):
        with pytest.raises(XfemnavError, match="E780"):
            blank_of(values, ORGAN, fill)
    assert asked_blank(values > 0, ORGAN, "nearest", "keep", None) == 0
