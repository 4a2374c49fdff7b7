"""What belongs to a volume goes where its image goes: companions, points, tracts, surfaces, transforms, lips."""

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from nibabel.streamlines import Tractogram, TrkFile
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.solids import AFFINE, FRONT, SHAPE, WALL, N, Opened, side_of
from xfemnav.errors import XfemnavError
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.solid.moved_surface import moved_surface
from xfemnav.imaging.carrying.companions import carry
from xfemnav.imaging.carrying.gaps import NOWHERE
from xfemnav.imaging.carrying.landmarks import moved_points, resting_points
from xfemnav.imaging.carrying.lip_labels import LEFT, RIGHT, lip_labels
from xfemnav.imaging.carrying.streamlines import move_streamlines
from xfemnav.imaging.carrying.surfaces import move_surface
from xfemnav.imaging.carrying.transform import backward, forward, itk_bytes, itk_transform, roomy
from xfemnav.imaging.carrying.vectors import field_nifti, nrrd_bytes, vector_nifti
from xfemnav.imaging.carrying.warp import covered, enclosed, pull_back, update
from xfemnav.imaging.frames.volume import Volume, take_volume, upright
from xfemnav.imaging.points.surface_files import Surface
from xfemnav.imaging.reading.conventions import ORDERS
from xfemnav.imaging.reading.formats import NOT_SAID
from xfemnav.imaging.reading.gate import Components, Image

SCENE = Opened()
MOTION, ORGAN = SCENE.motion, SCENE.mesh.corners
HOLE = Opened(ball=True)
HOLED = HOLE.motion
TURN = Rotation.from_rotvec([0.3, 0.4, -0.2]).as_matrix()
TURNED = Motion(ORGAN, (ORGAN - N / 2) @ TURN.T + N / 2)
OTHER = np.eye(4)    # another grid, far coarser and turned otherwise
OTHER[:3, :3] = Rotation.from_rotvec([-0.2, 0.1, 0.6]).as_matrix()[:, [2, 0, 1]] * (0.8, 0.9, -0.7)
OTHER[:3, 3] = N / 2 - OTHER[:3, :3] @ [7, 8, 9]
SLOPE = np.array([2.0, -1.0, 0.5])


def at(affine, shape):
    return np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]


def image(values, affine=AFFINE, name="image.nii.gz"):
    return Image(values, affine, "int16", 1, "", name)


VOLUME = take_volume(image(at(AFFINE, SHAPE) @ SLOPE))


def updated(motion=MOTION, frame=VOLUME, **options):
    organ = covered(ORGAN, *frame.lattice)
    return update(frame.values, organ, pull_back(motion.rest, motion.moved, *frame.lattice), **options)


UPDATE = updated()
CENTRES = VOLUME.pixel_centres()


def exact(points):
    """Where the tissue that is now at points rested: the inverse of `Opened.now` without a lift."""
    height = np.clip(points[..., 2] - FRONT, 0, None) / (N - FRONT)
    rest = points.copy()
    rest[..., 0] -= side_of(points) * SCENE.gap / 2 * height
    return rest


def test_the_image_is_two_valued_across_the_opened_cut():
    tissue, rest = UPDATE.pull_back.tissue, exact(CENTRES)
    # Lips are planes at rest and now, the motion is bilinear: chords of elements 1 mm high
    known = tissue & (abs(CENTRES[..., 2] - FRONT) > 0.01)
    off = UPDATE.pull_back.resting[known] - rest[known]
    assert abs(off).max() < 1e-9
    assert_allclose(UPDATE.updated[known], (rest @ SLOPE)[known], atol=0.01 * 3)
    wedge = (abs(CENTRES[..., 0] - WALL) < SCENE.gap / 2 * (CENTRES[..., 2] - FRONT) / 2) & (CENTRES[..., 2] < N) \
        & (CENTRES[..., 1] > 0) & (CENTRES[..., 1] < N)
    assert_array_equal(UPDATE.cavity, wedge)


def test_the_opened_cut_is_cavity_and_where_the_surface_has_sunk_is_vacated():
    sunk = Opened(lift=-0.8)
    now = enclosed(moved_surface(sunk.outline, *sunk.rim), *VOLUME.lattice)
    found = updated(sunk.motion, now=now, fill=-7)
    above = CENTRES[..., 2] > N - 0.8
    assert found.cavity.sum() > 50 and found.vacated.sum() > 50
    assert not found.cavity[above].any() and not found.vacated[~above & (CENTRES[..., 0] > 0.8)].any()
    assert (found.updated[found.cavity | found.vacated] == -7).all()
    assert_array_equal(found.cavity | found.vacated, covered(ORGAN, *VOLUME.lattice) & ~found.pull_back.tissue)


def test_a_measured_companion_on_another_grid_is_as_the_image():
    ramp = at(OTHER, (15, 17, 19)) @ SLOPE
    found = np.asarray(carry(image(ramp, OTHER), VOLUME, UPDATE, kind="continuous", fill=-99).dataobj)
    assert found.shape == SHAPE and found.dtype == np.float32
    tissue = UPDATE.pull_back.tissue
    assert_allclose(found[tissue], (UPDATE.pull_back.resting @ SLOPE)[tissue], atol=1e-5)
    assert (found[UPDATE.cavity] == -99).all()
    outside = ~(tissue | UPDATE.cavity) & (np.linalg.norm(CENTRES - N / 2, axis=-1) < 4)
    assert_allclose(found[outside], (CENTRES @ SLOPE)[outside], atol=1e-5)


def test_labels_stay_labels_and_keep_their_type():
    labels = np.random.default_rng(0).integers(0, 7, (15, 17, 19)).astype(float)
    found = np.asarray(carry(image(labels, OTHER), VOLUME, UPDATE, kind="label", outside="zero").dataobj)
    assert found.dtype == np.int16
    tissue = UPDATE.pull_back.tissue
    voxels = (UPDATE.pull_back.resting[tissue] - OTHER[:3, 3]) @ np.linalg.inv(OTHER[:3, :3]).T
    assert_array_equal(found[tissue], labels[tuple(np.rint(voxels).astype(int).T)])
    assert (found[~tissue] == 0).all()


def components(values, affine, intent):
    return Components(values, affine, intent, "float32", "", "it.nii.gz", None, NOT_SAID)


@pytest.mark.parametrize("kind", ["vector", "axis", "tensor"])
def test_what_has_a_direction_turns_with_the_tissue(kind):
    frame, shape = VOLUME, (15, 17, 19)
    about, e = updated(TURNED, frame), np.array([0.6, 0.0, 0.8])
    tissue = about.pull_back.tissue
    if kind == "tensor":
        D = 0.3 * np.eye(3) + np.outer(e, e)
        values, wanted = (np.array([M[i, j] for i, j in ORDERS["fsl"]]) for M in (D, TURN @ D @ TURN.T))
        given = components(np.broadcast_to(values, (*shape, 6)), OTHER, 0)
        found = carry(given, frame, about, kind=kind, axes="world", order="fsl")
    else:
        given = components(np.broadcast_to(e, (*shape, 3)), OTHER, 0)
        found, wanted = carry(given, frame, about, kind=kind, axes="world"), TURN @ e
    found = np.asarray(found.dataobj).reshape(*SHAPE, -1)
    assert_allclose(found[tissue], np.broadcast_to(wanted, found[tissue].shape), atol=1e-6)


def test_one_slice_or_another_patient_is_no_companion_of_a_volume():
    flat = np.zeros((15, 17, 1))
    with pytest.raises(XfemnavError) as error:
        carry(image(flat, OTHER), VOLUME, UPDATE, kind="continuous")
    assert error.value.code == "E130"
    far = OTHER.copy()
    far[:3, 3] += 100
    with pytest.raises(XfemnavError) as error:
        carry(image(np.zeros((15, 17, 19)), far), VOLUME, UPDATE, kind="continuous")
    assert error.value.code == "E130"


def test_each_lip_is_the_tissue_of_its_side():
    labels = lip_labels(UPDATE.pull_back, UPDATE.cavity, MOTION.rest, MOTION.cuts)
    for label, side in ((LEFT, 1), (RIGHT, -1)):
        assert (labels == label).sum() > 50
        assert (side_of(CENTRES[labels == label]) == side).all()
    assert not (labels[~UPDATE.pull_back.tissue]).any()


def test_points_move_both_ways_with_a_word_on_what_they_are_in():
    points = np.array([[0.5, 1, 3.5], [3, 1, 3.5], [WALL, 2, 3], [WALL, 2, 1], [9, 9, 9], [3.5, 2, 3.6]])
    found = moved_points(points, VOLUME, HOLED, ORGAN)
    assert found.flag == ("tissue", "tissue", "on a cut", "tissue", "outside", "resected")
    assert_allclose(found.moved[:2], SCENE.now(points[:2], side_of(points[:2])), atol=1e-9)
    assert np.isnan(found.moved[2]).all()
    assert_allclose(found.lips[2], SCENE.now(points[[2, 2]], np.array([1, -1])), atol=1e-9)
    assert_allclose(moved_points(points[2:3], VOLUME, HOLED, ORGAN, side=-1).moved, found.lips[2, 1:], atol=1e-12)
    assert_allclose(found.moved[3], points[3], atol=1e-12)
    back = resting_points(np.vstack([found.moved[:2], [[WALL, 2, 3.8], [9, 9, 9]]]), VOLUME, HOLED,
                          moved_surface(HOLE.outline, *HOLE.rim))
    assert back.flag == ("tissue", "tissue", "in the cut", "outside")
    assert_allclose(back.moved[:2], points[:2], atol=1e-9)


def tracts(*lines):
    return TrkFile(Tractogram([np.asarray(line, np.float32) for line in lines], affine_to_rasmm=np.eye(4)))


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("n", [40, 41, 2])
def test_streamlines_end_at_lips_and_go_round_the_front(way, n):
    """All of them, not those of a slab; also with a point on the cut, and with none but its ends."""
    along = WALL + way * np.linspace(-1.4, 1.4, n)
    over, under = (np.stack([along, np.full(n, 1.3), np.full(n, z)], axis=1) for z in (3.3, 1.2))
    found = move_streamlines(tracts(over, under), VOLUME, MOTION, ORGAN)
    assert found.flag == ("split", "split", "moved")
    assert_array_equal(found.source, [0, 0, 1])
    first, second, whole = found.file.streamlines
    ends = SCENE.now(np.array([[WALL, 1.3, 3.3]] * 2), np.array([-way, way]))
    assert_allclose([first[-1], second[0]], ends, atol=1e-5)
    assert (side_of(first) == -way).all() and (side_of(second) == way).all()
    assert_allclose([first[0], second[-1]], SCENE.now(over[[0, -1]], side_of(over[[0, -1]])), atol=1e-5)
    assert_allclose(whole[[0, -1]], under[[0, -1]], atol=1e-5)


def test_streamlines_lose_what_was_resected_and_keep_what_is_outside():
    way = np.stack([np.linspace(2.2, 6.0, 60), np.full(60, 2.0), np.full(60, 3.8)], axis=1)
    found = move_streamlines(tracts(way, way + 20), VOLUME, HOLED, ORGAN)
    assert set(found.flag) == {"trimmed", "kept"}
    assert_allclose(found.file.streamlines[-1], way + 20, atol=1e-4)
    moved = found.file.streamlines[0]
    assert np.isfinite(HOLED.to_preoperative(moved[1:-1].astype(float))).all()


def sheet(z=None, n=17):
    """A square of triangles across the block: at height z, or else upright along x."""
    u, v = np.meshgrid(np.linspace(0.2, 3.8, n), np.linspace(0.2, 3.8, n), indexing="ij")
    points = np.stack([u, v, np.full(u.shape, z)] if z else [u, np.full(u.shape, 1.1), v], axis=-1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + n, i + n + 1, i + 1], 1)])
    count = np.full(len(faces), 3)
    return Surface(points, faces.ravel(), count, "RAS", True, lambda points, kept: b""), faces


@pytest.mark.parametrize("z", [3.3, 1.0, None])
def test_no_face_is_stretched_across_the_cut_and_no_other_is_lost(z):
    surface, faces = sheet(z)
    moved = move_surface(surface, VOLUME, MOTION, ORGAN)
    corners = surface.points[faces]
    x, height = corners[..., 0], corners[..., 2]
    meets = (x.min(axis=1) < WALL - 0.05) & (x.max(axis=1) > WALL + 0.05) & (height.max(axis=1) > FRONT)
    near = abs(height.max(axis=1) - FRONT) < 0.3
    assert_array_equal(moved.kept[~near], ~meets[~near])
    assert moved.left_out["on a cut"] == (~moved.kept).sum() and moved.off == 0
    ends = moved.points[faces][moved.kept]
    assert np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).max() < 0.6    # .32 at rest
    side = side_of(surface.points)
    assert_allclose(moved.points, SCENE.now(surface.points, side), atol=1e-9)


def test_faces_in_resected_tissue_are_left_out():
    surface, faces = sheet(3.7)
    moved = move_surface(surface, VOLUME, HOLED, ORGAN)
    middle = surface.points[faces].mean(axis=1)
    away = np.linalg.norm(middle - [3.5, 2, N], axis=1)
    assert moved.left_out["resected"] > 10
    assert not moved.kept[away < 0.6].any()
    assert moved.kept[(away > 1.4) & (abs(middle[:, 0] - WALL) > 0.3)].all()
    big = Surface(np.array([[2.3, 0.2, 3.9], [3.9, 2.0, 3.9], [2.3, 3.8, 3.9]]), np.arange(3), np.array([3]), "RAS",
                  True, lambda points, kept: b"")    # its corners are in tissue, its middle is not
    assert not move_surface(big, VOLUME, HOLED, ORGAN).kept.any()


def itk_points(transform, points):
    lps = np.array([-1.0, -1, 1])
    return np.array([transform.TransformPoint((p * lps).tolist()) for p in points]) * lps


@pytest.mark.parametrize("spacing", [None, 0.25])
def test_itk_takes_points_where_their_tissue_rested(tmp_path, spacing):
    frame = roomy(upright(VOLUME, spacing), np.concatenate([ORGAN, MOTION.moved]))
    field = backward(frame, ORGAN, MOTION, "extended")
    (tmp_path / "it.h5").write_bytes(itk_bytes(frame, field))
    points = np.array([[0.6, 1.1, 3.2], [3.1, 2.2, 3.4], [2.0, 2.0, 1.0], [3.0, 1.0, 0.6]])
    rest = exact(points)
    for transform in (itk_transform(frame, field), sitk.ReadTransform(str(tmp_path / "it.h5"))):
        assert_allclose(itk_points(transform, points), rest, atol=0.03)    # linear between the field's voxels
    (tmp_path / "it.nrrd").write_bytes(nrrd_bytes(frame, field, "resampling"))
    nibabel.save(field_nifti(frame, field), tmp_path / "it.nii.gz")
    for name in ("it.nrrd", "it.nii.gz"):
        vectors = sitk.Cast(sitk.ReadImage(str(tmp_path / name)), sitk.sitkVectorFloat64)
        assert_allclose(itk_points(sitk.DisplacementFieldTransform(vectors), points), rest, atol=0.03)
    there = forward(frame, MOTION)
    on = itk_points(itk_transform(frame, there), rest)
    assert_allclose(on, points, atol=0.03)


@pytest.mark.parametrize("gaps", ["bridged", "extended"])
def test_a_field_fills_the_cut_as_it_says(gaps, monkeypatch):
    field = backward(VOLUME, ORGAN, MOTION, gaps, UPDATE.pull_back)
    assert_array_equal(field[UPDATE.pull_back.tissue], UPDATE.pull_back.field[UPDATE.pull_back.tissue])
    inside = field[UPDATE.cavity]
    if gaps == "extended":
        assert (inside == NOWHERE).any() and (field[~UPDATE.cavity] != NOWHERE).all()
        return
    assert (abs(inside[:, 0]) <= SCENE.gap / 2 + 1e-6).all() and (inside[:, 0] > 0).any() and (inside[:, 0] < 0).any()
    # from lip to lip all of it comes from the cut
    deep = UPDATE.cavity & (CENTRES[..., 2] > 3) & (CENTRES[..., 2] < 3.7) & (abs(CENTRES[..., 1] - 2) < 1)
    assert abs((CENTRES + field)[deep][:, 0] - WALL).max() < 0.1
    monkeypatch.setattr("xfemnav.imaging.carrying.gaps.MANY", 0)
    assert_allclose(backward(VOLUME, ORGAN, MOTION, gaps, UPDATE.pull_back), field, atol=1e-6)


def test_a_sheared_volume_has_its_field_on_perpendicular_axes():
    sheared = AFFINE.copy()
    sheared[:3, 2] += 0.2 * sheared[:3, 0]
    volume = Volume(np.zeros(SHAPE), sheared, 1)
    frame = upright(volume)
    assert_allclose(frame.steps.T @ frame.steps, np.diag(frame.spacing**2), atol=1e-12)
    voxels = frame.to_pixels(volume.corners)
    assert (voxels > -0.1).all() and (voxels < np.array(frame.values.shape) - 0.9).all()
    assert upright(VOLUME).affine.tolist() == VOLUME.affine.tolist()


def test_the_field_of_a_volume_is_written_on_its_grid():
    written = vector_nifti(VOLUME, UPDATE.field)
    assert written.shape == (*SHAPE, 1, 3)
    assert_allclose(np.asarray(written.dataobj)[:, :, :, 0] * [-1, -1, 1], UPDATE.field, atol=1e-6)
    assert_allclose(written.affine, AFFINE, atol=1e-5)
