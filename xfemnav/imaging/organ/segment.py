"""Organ segmentation of one slice: slice -> one-component mask without holes.

Ventricles and sulci are inside: they are labels, not holes. A mask that is given wins; a slice of a skull-stripped
image is filled; else three methods vote. Whatever comes out is the user's to judge: a doubtful mask warns, with
reasons.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging.frames.slices import Slice, touching, values_on
from xfemnav.imaging.organ.masks import clean, dice, mask_of, one_piece
from xfemnav.imaging.reading.gate import Image
from xfemnav.limits import (
    BRAIN_MM2,
    HIGH_MERIT,
    HIGH_MM2,
    LEAST_OF_HEAD,
    MERIT,
    MOST_OF_HEAD,
    ORGAN_MM2,
    VOTERS_AGREE,
    VOTERS_NEAR,
    VOTERS_SURE,
)

if TYPE_CHECKING:
    from xfemnav.imaging.organ.vote import Ballot
    from xfemnav.imaging.organ.working import Working

METHODS = ("auto", "otsu", "vote", "svc")


@dataclass(frozen=True, eq=False)
class Segmentation:
    """`mask` (n1, n2) bool on the slice's pixels, or (n1, n2, n3) on a volume's voxels, and how it was found: mask,
    stripped, vote, otsu or svc.

    `info` has area_mm2 and, by method, share_of_head, agreement (Dice of each pair of voters), merit (of
    `vote.Looks`), kept (Dice with svc's prior).
    """

    mask: np.ndarray
    method: str
    info: dict = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "mask", frozen_array(self.mask, bool, (None,) * np.ndim(self.mask), "mask"))


def segment(slice: Slice, *, method: str = "auto", mask: np.ndarray | None = None, skull: str = "auto",
            volume: Image | None = None, template: Image | None = None,
            template_mask: Image | None = None) -> Segmentation:
    """Mask of the organ in `slice`.

    `mask` (n1, n2): wins, except with method svc, whose prior it is. `skull`: "on" and "stripped" overrule the test,
    which looks at the whole `volume` that the slice is of, where it is given. `template` and `template_mask`: images on
    one grid in the slice's world frame, for svc without `mask`.
    Raises E201 (nothing found), E202 (constant slice), E203 (no background), E206 (template); warns W205, W206, W209,
    W212.
    """
    if method not in METHODS:
        raise XfemnavError("E780", f"no segmentation method {method!r}; choose one of {', '.join(METHODS)}.")
    if method != "svc" and mask is not None:
        return _result(slice, clean(mask, slice.spacing), "mask", {})
    # scipy.ndimage and scikit-image, which a given mask does without
    from xfemnav.imaging.organ.stripped import Verdict, foreground, judge
    from xfemnav.imaging.organ.working import working_copy

    work = working_copy(slice)
    if method == "svc":
        prior = _prior(slice, work, mask, template, template_mask)
        from xfemnav.imaging.organ.svc import classify  # SimpleITK and scipy.spatial, for this method alone

        found = classify(work, prior)
        return _result(slice, one_piece(work.back(found)), "svc", {"kept": dice(found, prior)})
    if method == "auto" and skull != "on":
        verdict = Verdict(True) if skull == "stripped" else judge(slice, volume)
        if verdict.stripped:
            return _result(slice, one_piece(foreground(slice)), "stripped", {}, verdict.doubt)
    from xfemnav.imaging.organ.vote import head_of, largest_otsu, vote

    head = head_of(work)
    if method == "otsu":
        found, info, doubts = largest_otsu(work), {}, []
    else:
        found, ballots = vote(work, head)
        small = slice.plane == "axial" and found.sum() * work.pixel**2 < HIGH_MM2.value
        info, doubts = _judged(ballots, (HIGH_MERIT if small else MERIT).value)
    share = info["share_of_head"] = float(found.sum() / max(head.sum(), 1))
    if not LEAST_OF_HEAD.value <= share <= MOST_OF_HEAD.value:
        doubts.append(f"it is {share:.0%} of the head (usual: {LEAST_OF_HEAD.value:.0%} to {MOST_OF_HEAD.value:.0%})")
    return _result(slice, one_piece(work.back(found)), "otsu" if method == "otsu" else "vote", info, *doubts)


def _judged(ballots: "list[Ballot]", least: float) -> tuple[dict, list[str]]:
    """What is told of the best ballot, and the reasons to doubt it; `least`: merit of its outline."""
    if not ballots:
        return {}, []
    best, doubts = ballots[0], []
    second, first = sorted(best.agreement.values())[-2:]
    if first < VOTERS_AGREE.value or (first < VOTERS_SURE.value and second < VOTERS_NEAR.value):
        doubts.append(f"its methods disagree (best Dice of two {first:.2f}, next {second:.2f})")
    if best.looks.merit < least:
        doubts.append(f"its outline does not stand out as a brain's does (merit {best.looks.merit:.2f}, usual for its "
                      f"size: above {least:g})")
    return {"agreement": best.agreement, "merit": best.looks.merit}, doubts


def _prior(slice: Slice, work: "Working", mask, template: Image | None, template_mask: Image | None) -> np.ndarray:
    """Where the organ should be, on the working copy: the user's mask, or the template's laid on the slice."""
    if mask is not None:
        return work.forth(clean(mask, slice.spacing).astype(float)) > 0.5
    if template is None or template_mask is None:
        raise XfemnavError("E206", "svc needs a prior: ⟦mask=FILE⟧, or ⟦template=IMG⟧ with ⟦template_mask=FILE⟧.")
    same_shape = template.values.shape == template_mask.values.shape
    if not same_shape or not np.allclose(template.affine, template_mask.affine, atol=1e-3):
        raise XfemnavError("E206", f"{template.name} and {template_mask.name} have different grids; give one grid.")
    from xfemnav.imaging.organ.svc import register
    from xfemnav.imaging.organ.working import robust_range

    values = values_on(template, slice, resample="linear")
    low, high = robust_range(values) if values.max() > values.min() else (0.0, 1.0)
    organ = mask_of(template_mask, values_on(template_mask, slice, resample="nearest")).astype(float)
    return register(work.values, work.forth((values - low) / (high - low)), work.forth(organ), work.pixel)


def _result(slice: Slice, mask: np.ndarray, method: str, info: dict, *doubts: str) -> Segmentation:
    """The segmentation with its area; W206 with every reason to doubt it, W212 where the image ends inside it."""
    area = float(mask.sum() * slice.spacing.prod())
    doubts = list(filter(None, doubts))
    if area < ORGAN_MM2.value and method != "mask":
        doubts.insert(0, f"its area is only {area:.0f} mm2")
    if area > BRAIN_MM2.value and method != "mask":
        doubts.insert(0, f"its area is {area:.0f} mm2, and a brain's is {BRAIN_MM2.value:g} at most")
    if doubts:
        warn("W206", f"the segmentation ({method}) is doubtful: {'; '.join(doubts)}. Look at it; give ⟦mask=FILE⟧.")
    if length := touching(mask, slice.spacing):
        warn("W212", f"the image ends inside the organ along {length:.0f} mm of its border: there is no skull there, "
                     "and the outline is held. Do not trust the motion beside it; give an image that holds the whole "
                     "organ.")
    return Segmentation(mask, method, {"area_mm2": area, **info})
