"""Label maps: shares of the cells' area, whatever grid the map is on."""

import nibabel as nib
import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from tests.meshes import disc
from xfemnav.errors import XfemnavError
from xfemnav.imaging.frames.slices import take_slice
from xfemnav.imaging.organ.labels import label_shares
from xfemnav.imaging.reading.gate import read_image

MESH = disc(40.0, 4.0)


@pytest.fixture
def half_plane(tmp_path):
    """A slice, and a finer label map stored the other way round: label 3 where x > 1, 5 where y > 10 of the rest."""
    affine = np.diag([1.0, 1.0, 2.0, 1.0])
    affine[:2, 3] = -50.0
    nib.save(nib.Nifti1Image(np.zeros((101, 101, 1), np.float32), affine), tmp_path / "slice.nii.gz")
    fine = np.diag([-0.25, 0.25, 2.0, 1.0])
    fine[:2, 3] = 50.0, -50.0
    x, y = np.meshgrid(50 - 0.25 * np.arange(401), -50 + 0.25 * np.arange(401), indexing="ij")
    labels = np.where(x > 1, 3, np.where(y > 10, 5, 0)).astype(np.uint8)
    nib.save(nib.Nifti1Image(labels[..., None], fine), tmp_path / "labels.nii.gz")
    return take_slice(read_image(tmp_path / "slice.nii.gz")), read_image(tmp_path / "labels.nii.gz")


def test_shares_are_those_of_the_area(half_plane):
    frame, labels = half_plane
    shares = label_shares(labels, frame, MESH.corners, [3, 5])
    line = 1.125  # between the last voxel at x = 1 and the first beyond
    for share, corners, area in zip(shares[:, 0], MESH.corners, MESH.volumes):
        exact = shapely.Polygon(corners).intersection(shapely.box(line, -99, 99, 99)).area / area
        assert abs(share - exact) <= 0.15  # 36 parts; a side crosses at most 6 of them by halves
    assert_allclose(shares @ [1, 1] <= 1, True)
    total = shares.T @ MESH.volumes
    whole = shapely.Polygon(MESH.outline)
    assert total[0] == pytest.approx(whole.intersection(shapely.box(line, -99, 99, 99)).area, rel=0.01)


def test_outside_of_the_map_is_no_label(half_plane):
    frame, labels = half_plane
    assert (label_shares(labels, frame, MESH.corners + 200.0, [3, 5]) == 0).all()


def test_what_is_no_label_map_is_said(half_plane, tmp_path):
    frame, _ = half_plane
    image = nib.load(tmp_path / "labels.nii.gz")
    nib.save(nib.Nifti1Image(np.asarray(image.dataobj) * 0.3, image.affine), tmp_path / "share.nii.gz")
    with pytest.raises(XfemnavError, match=r"E131 share.nii.gz is no label map"):
        label_shares(read_image(tmp_path / "share.nii.gz"), frame, MESH.corners, [3])
