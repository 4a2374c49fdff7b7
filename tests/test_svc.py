"""Template-moderated classification: better than a prior that is off, no worse than one that is right."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.images import brain, head_of, image_of, phantom_head
from xfemnav.errors import XfemnavError
from xfemnav.imaging.frames.slices import take_slice, to_nifti
from xfemnav.imaging.organ.discs import dilate, erode
from xfemnav.imaging.organ.masks import dice
from xfemnav.imaging.organ.segment import segment

mni = cache(brain)


@cache
def real_head(position=20, seed=0):
    return head_of(take_slice(mni()[0], position_mm=position), np.random.default_rng(seed))


def template_of(slice, mask, move):
    """Image and mask of a template that shows `slice` where `move` (4, 4) takes its world frame."""
    one = to_nifti(slice, slice.values)
    return image_of(one.get_fdata(), move @ one.affine), image_of(slice.to_storage(mask), move @ one.affine)


@pytest.mark.parametrize("head", [real_head, phantom_head])
def test_a_prior_that_is_off_is_mended_and_a_right_one_kept(head):
    slice, truth = head()
    for name, prior in {"small": erode(truth, 3), "large": dilate(truth, 3),
                        "moved": np.roll(truth, 4, axis=0)}.items():
        assert dice(segment(slice, method="svc", mask=prior).mask, truth) > dice(prior, truth) + 0.003, name
    # A perfect prior comes back but for the pixels of the rim that scan and truth share.
    assert dice(segment(slice, method="svc", mask=truth).mask, truth) > 0.985


def test_the_vote_is_not_made_worse():
    for slice, truth in (real_head(), phantom_head()):
        prior = segment(slice, skull="on").mask
        assert dice(segment(slice, method="svc", mask=prior).mask, truth) > dice(prior, truth) - 0.002


def test_a_neighbouring_slice_of_another_head_serves_as_template():
    slice, truth = real_head()
    other, other_mask = real_head(26, 5)
    move = np.eye(4)
    move[:2, :2] = [[0.97, 0.06], [-0.05, 1.04]]  # turned by 3 degrees, 4 % longer
    move[:3, 3] = 6, -8, slice.offset - other.offset
    template, mask = template_of(other, other_mask, move)
    found = segment(slice, method="svc", template=template, template_mask=mask)
    assert found.method == "svc" and dice(found.mask, truth) > 0.97
    assert (segment(slice, method="svc", template=template, template_mask=mask).mask == found.mask).all()


def test_svc_without_a_usable_prior_is_refused():
    slice, truth = phantom_head()
    template, mask = template_of(slice, truth, np.eye(4))
    far = np.eye(4)
    far[2, 3] = 50
    for options in ({}, {"template": template}, {"template_mask": mask},
                    {"template": template, "template_mask": replace(mask, values=mask.values[1:])},
                    dict(zip(("template", "template_mask"), template_of(slice, truth, far)))):
        with pytest.raises(XfemnavError, match="E206"):
            segment(slice, method="svc", **options)
