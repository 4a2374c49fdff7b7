"""Frames, tables and files that were refused: headers with two frames, columns that mean something, padding, TOML."""

import numpy as np
from rows import Row
from small import CUT, brain

import xfemnav
from tests.headers import itk_affine, two_frames
from xfemnav.pipeline.chain import recorded

SMALL = {"element_size_mm": 8, "corridor_element_mm": 4, "report": False, "opening_mm": 4}


def two_places(folder):
    """A coregistered image: `updated` must lie on it in nibabel and in ITK, and the warning say what Slicer shows."""
    path = two_frames(folder / "sub-01_T1w.nii", brain()[:, :, None])
    with recorded() as warned:
        result = xfemnav.run(path, cut=CUT, output=folder / "out", cache=folder / "cache", **SMALL)
    text = next(item.text for item in warned if item.code == "W114")
    assert "The sform was taken" in text and "built on ITK take the qform" in text
    updated = folder / "out" / result.record["outputs"]["updated"]
    np.testing.assert_allclose(itk_affine(updated), itk_affine(path), atol=1e-4)
    np.testing.assert_allclose(result.frame.affine, result.record["input"]["affine"], atol=1e-4)
    apart = text.partition("up to ")[2].partition(" mm")[0]
    return f"told, {apart} mm apart; updated lies on its input in both", "W114"


ROWS = [
    Row("A6", "sform (code 2) and qform (code 1) differ", "sform in silence; updated off its input in ITK", two_places),
]
