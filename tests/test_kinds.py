"""Labels or measurements: by name, by header, by data, or asked for."""

import warnings

import nibabel as nib
import numpy as np
import pytest
from nilearn.datasets import load_mni152_template
from scipy import ndimage

from tests.images import affine_of, image_of
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.carrying.kinds import kind_of, read_companion

AFFINE = affine_of(np.eye(3))


def image(values, name="x.nii.gz"):
    values = np.asarray(values, float)
    return image_of(values[:, :, None] if values.ndim == 2 else values, AFFINE, name)


def regions(n, shape=(90, 100, 20), seed=0):
    """A parcellation of `n` regions in an ellipsoid, about 12 mm wide each."""
    rng = np.random.default_rng(seed)
    at = np.moveaxis(np.indices(shape), 0, -1)
    inside = (((at - np.array(shape) / 2) / (np.array(shape) / 2)) ** 2).sum(axis=-1) < 1
    seeds = rng.choice(np.argwhere(inside), n, replace=False)
    near = np.full(shape, np.inf)
    labels = np.zeros(shape)
    for k, seed_at in enumerate(seeds, start=1):
        distance = ((at - seed_at) ** 2).sum(axis=-1)
        labels[distance < near] = k * 17
        near = np.minimum(near, distance)
    return labels * inside


def told(found):
    """Kind, and the text of the one warning or ""."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", XfemnavWarning)
        kind = kind_of(found)
    assert len(caught) < 2
    return kind, str(caught[0].message) if caught else ""


@pytest.mark.parametrize("n", [1, 3, 116, 180])
def test_parcellations_are_labels(n):
    kind, text = told(image(regions(n)))
    assert kind == "label" and "W135" in text and "taken as label" in text


def head(seed=0):
    """A T1 slab in scanner units, with noise, in air of 0."""
    rng, t1 = np.random.default_rng(seed), load_mni152_template(resolution=1)
    values = np.asarray(t1.dataobj, float)[:, :, 80:100]
    return np.where(values > 0, 400 * values / values.max() + rng.normal(0, 6, values.shape), 0)


def test_measurements_are_continuous():
    t1 = head()
    rng = np.random.default_rng(1)
    ct = np.where(t1 > 0, 20 + t1 / 20 + rng.normal(0, 4, t1.shape), -1000)    # air that is one value, and not 0
    bone = ndimage.binary_dilation(t1 > 0, iterations=4) & (t1 == 0)
    ct = np.where(bone, 700 + rng.normal(0, 100, t1.shape), ct)
    for values in (np.rint(t1), np.rint(ct), np.rint(ct) + 1024, np.rint(t1 / 2).clip(0, 255)):
        kind, text = told(image(values))
        assert kind == "continuous" and "W135" in text and "taken as continuous" in text
    for values in (t1, (t1 - t1.mean()) / t1.std()):    # fractions are no labels: there is no doubt to tell
        assert told(image(values)) == ("continuous", "")


def test_a_mask_is_labels_however_thin():
    dots = np.zeros((40, 40, 10))
    dots[::5, ::5, ::5] = 1
    assert told(image(dots))[0] == told(image(255 * dots))[0] == told(image(0 * dots))[0] == "label"


def test_what_lies_between_is_asked_for():
    """A percentage map that is saturated inside."""
    near = ndimage.distance_transform_edt(regions(1))
    assert told(image(np.rint((30 * near).clip(0, 100))))[0] == "label"    # wide: most of it is 100
    rng = np.random.default_rng(0)
    pairs = np.repeat(rng.integers(1, 90, (60, 30, 1)), 2, axis=1)    # a half of one axis' pairs, none of the other's
    pairs[::2] = np.repeat(pairs[::2, :1], 60, axis=1)
    with pytest.raises(XfemnavError, match=r"E131.*labels or measurements.*kind label or continuous"):
        kind_of(image(pairs))


@pytest.mark.parametrize("name, kind", [
    ("x_dseg.nii.gz", "label"), ("sub-01_space-T1w_desc-aparcaseg_dseg.nii.gz", "label"), ("brain_mask.nrrd", "label"),
    ("tumour.seg.nrrd", "label"), ("tumour-label.nrrd", "label"), ("dseg.mgz", "label"),
    ("sub-01_label-GM_probseg.nii.gz", "continuous"), ("sub-01_T1w.nii", "continuous"), ("sub-01_FLAIR", "continuous"),
])
def test_names_settle_it(name, kind):
    """Against what the data would say."""
    values = regions(3) if kind == "continuous" else np.rint(head())
    assert told(image(values, name)) == (kind, "")


def test_names_settle_nothing_else():
    for name in ("masked.nii.gz", "dsegs_old.nii.gz", "mask_of_T1.nii.gz", "sub-01_desc-dseg.xyz"):
        assert "W135" in told(image(regions(3), name))[1]


def test_a_soft_mask_is_no_label_map():
    soft = ndimage.gaussian_filter((regions(1) > 0).astype(float), 2)
    kind, text = told(image(soft, "brain_mask.nii.gz"))
    assert kind == "continuous" and "W135" in text and "fractions" in text


def test_headers_settle_it(tmp_path):
    for intent, values, kind in ((1002, np.rint(head()), "label"), (5, regions(3), "continuous")):
        stored = nib.Nifti1Image(values.astype(np.int16), AFFINE)
        stored.header.set_intent(intent)
        nib.save(stored, tmp_path / "x.nii.gz")
        assert told(read_companion(tmp_path / "x.nii.gz")) == (kind, "")


def test_series_are_continuous_where_their_name_says_so(tmp_path):
    for name in ("x_bold.nii.gz", "x.nii.gz"):
        nib.save(nib.Nifti1Image(np.zeros((5, 5, 5, 6), np.float32), AFFINE), tmp_path / name)
    assert told(read_companion(tmp_path / "x_bold.nii.gz")) == ("continuous", "")
    with pytest.raises(XfemnavError, match=r"E131.*several values.*continuous, vector, axis, tensor"):
        read_companion(tmp_path / "x.nii.gz")
