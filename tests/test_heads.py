"""Heads up to the vertex in three contrasts: the brain is found or doubted, and the whole head never taken for it."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from data_synthetic.heads import CONTRASTS, CSF, HALF_HEIGHT, SCALP, SKULL, Head, _edge
from data_synthetic.phantom import BRAIN, Grid
from tests.images import affine_of, brain, image_of
from xfemnav.errors import XfemnavWarning
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.organ.masks import dice, one_piece
from xfemnav.imaging.organ.segment import segment
from xfemnav.imaging.organ.stripped import judge

COARSE = Grid((128, 150), (1.5, 1.5))


def stack(contrast, heights, seed=None, grid=COARSE):
    """A head as a volume with slices at `heights` mm, evenly spaced, and its brain mask."""
    values, mask = Head(contrast, grid).volume(heights, seed)
    step = heights[1] - heights[0] if len(heights) > 1 else 5.0
    affine = affine_of(np.diag([*grid.spacing, step]), (*grid.origin, heights[0]))
    return image_of(values, affine), mask


def found_in(slice, **kwargs):
    """The segmentation, and whether it warned W206."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", XfemnavWarning)
        found = segment(slice, **kwargs)
    return found, "W206" in [w.message.code for w in caught]


# The scene ------------------------------------------------------------------------------------------------------------

def test_shells_lie_one_in_the_other_and_end_one_above_the_other():
    head, points = Head(), np.array([[0.0, y] for y in np.arange(0, 110, 0.5)])
    for height in (0.0, 40.0, 69.0, 75.0):
        labels = head.labels_at(points, height)
        order = [BRAIN, (CSF,), (SKULL,), (SCALP,), (0,)]
        rank = np.array([next(k for k, group in enumerate(order) if label in group) for label in labels])
        assert (np.diff(rank) >= 0).all() and rank[-1] == 4
    assert np.isin(head.labels_at(points[:1], HALF_HEIGHT + 1), (CSF,)).all() and not head.mask(HALF_HEIGHT).any()
    assert _edge(0.0, 0.0, 3.0) == pytest.approx(_edge(0.0, 0.0) + 3.0)
    assert head.mask(0.0).sum() == pytest.approx(np.pi * 68 * 84, rel=2e-3)


# The brain in a head --------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("contrast, height", [("t1", 55.0), ("t2", 20.0), ("flair", 62.0)])
def test_the_brain_is_found_in_three_contrasts(contrast, height):
    image, mask = stack(contrast, [height], seed=1)
    found, doubted = found_in(take_slice(image))
    assert found.method == "vote" and dice(found.mask, mask[:, :, 0]) > 0.95 and not doubted


@pytest.mark.slow
@pytest.mark.parametrize("contrast", CONTRASTS)
@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("seed", [None, 2])
def test_every_slice_up_to_the_vertex_is_right_or_doubted(contrast, gamma, seed):
    """In any tone; and hardly ever is a right one doubted."""
    image, mask = stack(contrast, np.arange(-10.0, 69.0, 6.0), seed)
    image = replace(image, values=(image.values / image.values.max()) ** gamma)
    right = []
    for k in range(mask.shape[2]):
        found, doubted = found_in(take_slice(image, index=k), volume=image)
        good = dice(found.mask, mask[:, :, k])
        assert found.method == "vote" and (doubted or good >= 0.9), (k, good)
        right += [doubted] if good >= 0.95 else []
    assert np.mean(right) <= 0.1, "one of 14 slices: the last one has under 2000 mm2"


def test_a_tone_curve_does_not_matter():
    image, _ = stack("t1", [44.0], seed=3)
    slice = take_slice(image)
    scaled = slice.values / slice.values.max()
    masks = [segment(replace(slice, values=scaled**gamma)).mask for gamma in (0.5, 1.0, 2.0)]
    assert min(dice(masks[1], masks[0]), dice(masks[1], masks[2])) > 0.98


def test_heads_of_a_folder_find_their_masks(tmp_path):
    """By subject and place; other files of the folder are let be."""
    import nibabel as nib

    from benchmarks.segmentation import distorted, of_folder

    values, brain = Head(grid=COARSE).volume([0.0])
    for name in ("ann_t1_head_ax", "ann_brainmask_ax", "bob_t2_cor", "bob_mask_ax", "ann_tmap_ax", "sub-1_T1w",
                 "sub-1_desc-brain_mask"):
        data = brain.astype(np.uint8) if "mask" in name else values
        nib.save(nib.Nifti1Image(data, np.diag([1.5, 1.5, 1.0, 1.0])), tmp_path / f"{name}.nii.gz")
    cases = {case.name: case for case in of_folder(tmp_path)}
    assert {name: case.brain is not None for name, case in cases.items()} == {
        "ann t1 head ax": True, "bob t2 cor": False, "sub-1 T1w": True}
    case = distorted(cases["sub-1 T1w"], 2.0, crop=0.2)
    assert case.slice.values.shape == case.brain.shape and case.brain.shape[0] < brain.shape[0]
    assert case.brain[0].any(), "the crop goes through the brain"
    turned = distorted(cases["sub-1 T1w"], 1.0, degrees=90.0).brain
    assert dice(turned, brain[:, :, 0]) < 0.95 and turned.sum() == pytest.approx(brain.sum(), rel=0.01)


# Whether the skull is off ---------------------------------------------------------------------------------------------

def roofed(contrast="t1"):
    """A head with exact air whose highest slices have no dark ring: fat and bone in thick slices look like scalp."""
    heights = np.arange(-30.0, 66.0, 6.0)
    image, mask = stack(contrast, heights)
    values, points = image.values.copy(), COARSE.centres().reshape(-1, 2)
    for k in np.flatnonzero(heights > 50):
        labels = Head(contrast, COARSE).labels_at(points, heights[k]).reshape(COARSE.shape)
        ring = ndimage.binary_dilation(np.isin(labels, (CSF, SKULL)), iterations=3)
        values[:, :, k] = np.where(ring, np.maximum(values[:, :, k], 680), values[:, :, k])
    return replace(image, values=values), mask


def test_stripped_is_a_property_of_the_volume():
    """A lone high slice without a dark ring looks like a stripped one; its volume says that it is none."""
    image, mask = roofed()
    last = take_slice(image, index=image.values.shape[2] - 1)
    assert judge(last).stripped, "nothing in it tells"
    verdict = judge(last, image)
    assert not verdict.stripped
    found, doubted = found_in(last, volume=image)
    assert found.method == "vote" and (doubted or dice(found.mask, mask[:, :, -1]) >= 0.9)


def test_the_stage_looks_at_the_volume(tmp_path):
    import nibabel as nib

    import xfemnav

    image, _ = roofed()
    nib.save(nib.Nifti1Image(image.values.astype(np.float32), image.affine), tmp_path / "head.nii.gz")
    with pytest.warns(XfemnavWarning):
        result = xfemnav.run(tmp_path / "head.nii.gz", slice=15, cut="60,0 10,0", opening_mm=2, output=tmp_path / "out",
                             cache=tmp_path / "cache", report=False, element_size_mm=8.0, corridor_element_mm=4.0)
    assert result.record["segmentation"]["method"] == "vote"


@pytest.mark.parametrize("plane, place", [("axial", 70), ("coronal", -92), ("sagittal", 62)])
def test_a_stripped_volume_is_one_in_all_its_slices(plane, place):
    image, mask = brain()
    for values in (image.values, image.values**2, np.where(image.values > 0, image.values - 120, -300)):
        volume = replace(image, values=values)
        found, doubted = found_in(take_slice(volume, plane=plane, position_mm=place), volume=volume)
        truth = one_piece(take_slice(mask, plane=plane, position_mm=place).values > 0)
        assert found.method == "stripped" and not doubted and dice(found.mask, truth) > 0.95


def test_a_thin_slab_is_judged_by_its_slice():
    image, _ = stack("t1", np.arange(0.0, 12.0, 6.0))
    assert not judge(take_slice(image, index=0), image).stripped


def test_a_lone_slice_that_comes_close_is_doubted():
    image, _ = brain()
    slice = take_slice(image, position_mm=20)
    depth = ndimage.distance_transform_edt(slice.values > 0)
    for share, doubted in ((1.0, False), (0.86, True)):  # of the brightness, in a ring as wide as a skull
        ring = np.where((depth > 6) & (depth < 12), share, 1.0)
        assert bool(judge(replace(slice, values=slice.values * ring)).doubt) == doubted
    wide = replace(slice, spacing=slice.spacing * 1.2)
    assert judge(wide) == (True, "") and found_in(wide)[1], "larger than any brain"


def test_a_head_in_ct_is_not_taken_for_stripped():
    """Air -1000, scalp 20, bone 1000, brain 35: the ring is bright."""
    labels = Head(grid=COARSE).labels_at(COARSE.centres().reshape(-1, 2), 10.0).reshape(COARSE.shape)
    hounsfield = {0: -1000.0, CSF: 8.0, SKULL: 1000.0, SCALP: 20.0}
    values = np.vectorize(lambda label: hounsfield.get(label, 35.0))(labels)
    slice = take_slice(image_of(values[:, :, None], affine_of(np.diag([1.5, 1.5, 1.0]))))
    assert not judge(slice).stripped
    assert found_in(slice)[1], "and whatever is found is doubted"


@pytest.mark.parametrize("air", [0.0, -4.76])
def test_the_background_need_not_be_the_darkest(air):
    """z-scored heads: air is 0 amid the values of tissue, or far below."""
    image, mask = stack("t1", [20.0])
    values = image.values[:, :, 0]
    tissue = values > 30
    scored = np.where(tissue, (values - values[tissue].mean()) / values[tissue].std(), air)
    slice = take_slice(replace(image, values=scored[:, :, None]))
    assert scored[tissue].min() < -1 and not judge(slice).stripped
    found, doubted = found_in(slice)
    assert dice(found.mask, mask[:, :, 0]) > 0.95 and not doubted
