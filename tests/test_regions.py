"""What images mark to be taken out: labels united, masks of any values, bits and holes under a size."""

import warnings

import numpy as np
import pytest
import shapely

from data_synthetic.tumours import CORE, tumour
from tests import small
from tests.images import affine_of, image_of, slice_of
from xfemnav import run
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.geometry.plane.resection import even_odd
from xfemnav.imaging.organ.masks import mask_of
from xfemnav.imaging.organ.regions import marked, outlined, sizeable, warn_of_left

FRAME = slice_of(np.zeros((60, 50)))
ORGAN = shapely.box(-1, -1, 60, 50)
LEAST = np.pi / 4 * 4**2


def map_of(values, name="seg.nii.gz", step=1.0):
    return image_of(np.asarray(values, float)[:, :, None], affine_of(np.diag([step, step, 1.0]), (0, 0, 0)), name)


def nested():
    """A ring of label 4 about a disc of label 1, both in label 2; the areas of all three."""
    x, y = np.indices((60, 50)) - np.array([30, 25])[:, None, None]
    radius = np.hypot(x, y)
    return np.select([radius < 8, radius < 12, radius < 18], [1, 4, 2], 0)


def told(caught):
    return [f"{item.message.code} {item.message.message}" for item in caught]


def test_labels_are_united_before_they_are_outlined():
    values = nested()
    found = marked(map_of(values), FRAME, (1, 3, 4))
    own, united = outlined([found], FRAME, LEAST)
    assert found.name == "labels 1, 3, 4 of seg.nii.gz" and len(united) == 1
    assert even_odd(united).area == pytest.approx(np.isin(values, (1, 4)).sum() - np.pi, rel=5e-3)
    assert shapely.equals(even_odd(own[0]), even_odd(united))


def test_a_map_on_a_finer_grid_that_starts_elsewhere():
    fine = np.kron(nested(), np.ones((2, 2)))
    image = image_of(fine[::-1, :, None], affine_of(np.diag([-0.5, 0.5, 1.0]), (59.25, -0.25, 0)), "seg.nii.gz")
    assert np.array_equal(marked(image, FRAME, (4,)).mask, nested() == 4)


def test_what_is_no_label_of_the_slice_is_said():
    with pytest.raises(XfemnavError, match=r"E311 labels 3, 5 of seg.nii.gz are nowhere on this slice, .* 1, 2, 4"):
        marked(map_of(nested()), FRAME, (3, 5))
    with pytest.raises(XfemnavError, match=r"E131 seg.nii.gz is no label map"):
        marked(map_of(nested() * 0.3), FRAME, (1,))
    scaled = np.float32(0.1) * np.float32(10) * nested()  # as a header's slope leaves whole numbers
    assert marked(map_of(scaled.astype(np.float32) * (1 + 1e-7)), FRAME, (4,)).mask.sum() == (nested() == 4).sum()


def test_bits_and_holes_under_the_size():
    mask = nested() == 1
    mask[30:33, 25:28] = False  # 9 pixels
    mask[2:5, 2:6], mask[5, 6] = True, True  # 12 and, at its corner, 1: together one of 13
    mask[50:53, 40:44] = True  # 12
    whole = sizeable(mask, LEAST)
    assert whole[30:33, 25:28].all() and whole[2:5, 2:6].all() and whole[5, 6] and not whole[50:53, 40:44].any()
    assert np.array_equal(sizeable(mask, 0.0), mask)
    assert sizeable(np.zeros((3, 3), bool), LEAST).sum() == 0 and sizeable(np.ones((5, 5), bool), LEAST).all()


def left_of(values, labels=None, least=LEAST):
    """What is warned of when the outlines of what is marked are taken out."""
    found = marked(map_of(values), FRAME, labels)
    _, united = outlined([found], FRAME, least)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_left(found, FRAME, even_odd(united), ORGAN, least)
    return told(caught)


def test_a_number_that_the_map_does_not_hold_is_told():
    """In a list the others are taken, and a slip of the keyboard leaves tumour: one on another slice is no slip."""
    with pytest.warns(XfemnavWarning, match=r"W314 nothing is taken out for labels 3, 9, nowhere in seg.nii.gz"):
        marked(map_of(nested()), FRAME, (1, 3, 4, 9))
    values = np.stack([nested(), np.full_like(nested(), 3)], axis=2)
    image = image_of(values, affine_of(np.eye(3), (0, 0, 0)), "seg.nii.gz")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        marked(image, FRAME, (1, 3, 4))


def test_what_stays_is_told_with_its_label_and_area():
    values = nested()
    assert left_of(values, (1, 4)) == []
    values[2:4, 2:5], values[50, 40] = 4, 1
    (text,) = left_of(values, (1, 4))
    assert text.startswith("W208 7 mm2 of labels 1, 4 of seg.nii.gz (1 mm2 of label 1, 6 mm2 of label 4) stay: 2 "
                           "separate bits under 12.6 mm2")
    assert left_of(values, (1, 4), least=0.0)[0].startswith("W208 1 mm2")  # the pixel has no outline of its own
    single = nested()
    single[50:52, 40] = 1
    (text,) = left_of(single, (1, 4), least=0.2)
    assert "1 separate bit of 2 mm2 at most, under two pixels wide." in text  # a smaller size would not take it
    thin = np.zeros((60, 50))
    thin[20:36, 20:36], thin[36:56, 30] = 1, 1  # and the square's corners
    (text,) = left_of(thin)
    assert text.startswith("W208 23 of 276 mm2 of seg.nii.gz") and "under two pixels wide" in text


def mask_told(values, **image):
    """The mask (n1, n2) in values, and the codes that it comes with."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mask = mask_of(map_of(values), np.asarray(values, float))
    return mask, [text.split()[0] for text in told(caught)]


def soft():
    """A disc of 400 mm2 or so whose edge is a ramp of 6 pixels, 0 to 1; and the disc."""
    x, y = np.indices((60, 50)) - np.array([29.5, 24.5])[:, None, None]
    radius = np.hypot(x, y)
    return np.clip((11.3 - radius) / 6 + 0.5, 0, 1), radius <= 11.3


MASKS = {  # values, what they mark, codes
    "two values": lambda v, disc: (disc * 1.0, disc, []),
    "0 and 255": lambda v, disc: (disc * 255.0, disc, []),
    "two values, scaled": lambda v, disc: (disc * 0.996, disc, []),
    "labels": lambda v, disc: (disc * (1000 + np.arange(50) % 7), disc, ["W209"]),
    "an image": lambda v, disc: (disc * (300 + np.rint(100 * v)), disc, ["W209"]),
    "probabilities": lambda v, disc: (v, disc, ["W209"]),
    "percent": lambda v, disc: (100 * v, disc, ["W209"]),
    "logits": lambda v, disc: (10 * v - 5, disc, ["W209"]),
    "overshot": lambda v, disc: (v - 0.02 * (v == 0) * (np.arange(50) % 2), disc, ["W209"]),
}


@pytest.mark.parametrize("name", sorted(MASKS))
def test_a_mask_is_what_its_values_say(name):
    values, wanted, codes = MASKS[name](*soft())
    mask, found = mask_told(values)
    assert found == codes
    assert abs(mask.sum() / wanted.sum() - 1) < 0.03


def test_a_small_soft_mask_in_a_large_image_keeps_its_range():
    """The range of all voxels would end at 0 where less than one in a thousand is marked."""
    v, disc = soft()
    volume = np.zeros((60, 50, 400))
    volume[:, :, 7] = v
    volume[20, 20, 7] = 40.0  # one voxel off the range
    image = image_of(volume, np.eye(4), "soft.nii.gz")
    with pytest.warns(XfemnavWarning, match=r"W209 soft.nii.gz holds fractions.* 0.5 or more .* from 0 to 1;"):
        mask = mask_of(image, v)
    assert abs(mask.sum() / disc.sum() - 1) < 0.03


SHAPE, AFFINE = (140, 170), affine_of(np.eye(3), (-70.0, -85.0, 10.0))


def head(folder, seed):
    """A brain and a tumour in it, as files, and the tumour's labels."""
    x, y = np.indices(SHAPE) - np.array([70, 85])[:, None, None]
    brain = (x / 62) ** 2 + (y / 76) ** 2 < 1
    labels = tumour(np.random.default_rng(seed), SHAPE, (1, 1), (104, 80 + 4 * seed), radius_mm=10 + 2 * seed) * brain
    image = small.write(folder / "brain.nii.gz", brain * (500.0 + x), AFFINE)
    return image, small.write(folder / "seg.nii.gz", labels, AFFINE), labels


@pytest.mark.parametrize("resect", ["label=1,3,4", ["label=1", "label=4"]], ids=["a list", "one each"])
@pytest.mark.parametrize("seed", range(5))
def test_the_core_of_a_real_looking_tumour_is_taken_out_whole(tmp_path, seed, resect):
    image, seg, labels = head(tmp_path, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", XfemnavWarning)
        result = run(image, labels=seg, resect=resect, gravity="-1,0", skull="contact", element_size_mm=4,
                     output=tmp_path / "out", report=False)
    core = sizeable(np.isin(labels, CORE), LEAST)
    taken = sum(item["area_mm2"] for item in result.record["resections"])
    codes = {warned["code"] for warned in result.record["warnings"]}
    assert result.trusted and codes <= {"W208", "W210", "W314"} and ("W314" in codes) == (resect == "label=1,3,4")
    assert taken > 0.99 * core.sum() - np.pi
    assert [piece["fate"] for piece in result.record["pieces"]] == ["fixed"]
    # Where the core was is the cavity, but for what of its rim is narrower than two pixels.
    pixels = np.argwhere(core) @ AFFINE[:2, :2] + AFFINE[:2, 3]
    assert np.isfinite(result.to_current(pixels)).all(axis=1).mean() < 0.02


def test_what_is_warned_of_names_the_file_of_this_run(tmp_path):
    """The same labels under another name are the same to the mechanics, and not to who reads the warning."""
    image, seg, _ = head(tmp_path, 0)
    other = tmp_path / "other.nii.gz"
    other.write_bytes(seg.read_bytes())
    for labels in (seg, other):
        with pytest.warns(XfemnavWarning, match=f"W314 .* nowhere in {labels.name}"):
            run(image, labels=labels, resect="label=1,3,4", gravity="-1,0", skull="contact", element_size_mm=6,
                output=tmp_path / "out", cache=tmp_path / "cache", report=False)
