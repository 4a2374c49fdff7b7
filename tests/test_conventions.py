"""Vectors and tensors as FSL, ANTs, MRtrix, DIPY, 3D Slicer, AFNI and ITK write them: known ones go through a known
rotation, and what is written is read as that program reads it.

Readers and writers of each program are spelled out here by hand: world means RAS mm.
"""

import gzip
import warnings
from contextlib import contextmanager
from typing import NamedTuple

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tests.images import affine_of, image_of
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.carrying.companions import carry
from xfemnav.imaging.carrying.kinds import read_companion
from xfemnav.imaging.carrying.warp import covered, pull_back, update
from xfemnav.imaging.frames.slices import take_slice

LPS = np.diag([-1.0, -1.0, 1.0])
UPPER, LOWER, DIAGONAL_FIRST = (
    [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)], [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)],
    [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])
EIGENVALUES = np.array([0.2, 0.4, 1.7])    # 1e-3 mm2/s
DEGREES = 0.01
#: Storage of companion and of the run's image: linear parts of their affines, right- and left-handed, oblique.
OBLIQUE = Rotation.from_euler("xyz", [12, -8, 25], degrees=True).as_matrix() * 3.0
STORAGE = {"RAS": np.diag([3.0, 3, 3]), "LAS": np.diag([-3.0, 3, 3]),
           "PSR": 3.0 * np.array([[0, 0, 1.0], [-1, 0, 0], [0, 1, 0]]),
           "oblique": OBLIQUE}


class Known(NamedTuple):
    """A turn of a disc about its middle, on an axial slice of a grid stored in some order."""

    frame: object
    update: object
    turn: np.ndarray


def known(linear, degrees=30.0) -> Known:
    shape = np.array([40, 40, 40])
    affine = affine_of(linear, -linear @ ((shape - 1) / 2))
    frame = take_slice(image_of(np.ones(shape), affine), plane="axial", index=20)
    grid = frame.origin, frame.spacing, frame.values.shape
    middle = frame.pixel_centres().mean(axis=(0, 1))
    around = np.linspace(0, 2 * np.pi, 25)
    ring = middle + 40 * np.column_stack([np.cos(around), np.sin(around)])
    rest = np.stack([np.broadcast_to(middle, ring[1:].shape), ring[:-1], ring[1:]], axis=1)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    plane_turn = np.array([[c, -s], [s, c]])
    moved = (rest - middle) @ plane_turn.T + middle
    turn = np.eye(3)
    turn[:2, :2] = plane_turn
    made = update(frame.values, covered(rest, *grid), pull_back(rest, moved, *grid))
    return Known(frame, made, frame.axes.T @ turn @ frame.axes)


@contextmanager
def quiet():
    """Warnings of the program are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", XfemnavWarning)
        yield


def fsl_axes(affine):
    """FSL's: along the array axes, the first counted the other way where they are right-handed."""
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    return axes * ([-1, 1, 1] if np.linalg.det(axes) > 0 else [1, 1, 1])


def array_axes(affine):
    return affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)


def world_axes(affine):
    return np.eye(3)


def lps_axes(affine):
    return LPS


def nifti(path, values, affine, intent=0):
    """`values` (nc,) in every voxel, 4-D, or 5-D with an intent."""
    data = np.broadcast_to(values.astype(np.float32), (30, 30, 30, len(values)))
    image = nib.Nifti1Image(data[:, :, :, None] if intent else data, affine)
    image.set_sform(affine, 1)
    image.set_qform(affine, 1)
    if intent:
        image.header.set_intent(intent, (3,) if intent == 1005 else (), allow_unknown=True)
    nib.save(image, path)


def nrrd(path, values, affine, kind, space="left-posterior-superior", frame=None):
    """A NRRD by hand; affine RAS."""
    signs = np.array({"left-posterior-superior": [-1, -1, 1], "right-anterior-superior": [1, 1, 1],
                      "left-anterior-superior": [-1, 1, 1]}[space])

    def word(vector):
        return "(" + ",".join(f"{x:.17g}" for x in vector) + ")"

    lines = ["NRRD0005", "type: double", "dimension: 4", f"space: {space}", f"sizes: {len(values)} 30 30 30",
             "space directions: none " + " ".join(word(signs * column) for column in affine[:3, :3].T),
             f"kinds: {kind} domain domain domain", "endian: little", "encoding: gzip",
             "space origin: " + word(signs * affine[:3, 3])]
    if frame is not None:
        lines.append("measurement frame: " + " ".join(word(column) for column in frame.T))
    data = np.tile(np.asarray(values, "<f8"), 30**3)
    path.write_bytes("\n".join(lines).encode() + b"\n\n" + gzip.compress(data.tobytes(), mtime=0))


class Way(NamedTuple):
    """How a program writes tensors: its axes, its order, NIfTI's intent, and what a user has to say of it."""

    axes: object
    places: list
    intent: int
    said: dict


#: The rows of the table in docs/use/companions.md.
TENSORS = {
    "FSL": Way(fsl_axes, UPPER, 0, {"axes": "image"}),
    "ANTs": Way(array_axes, LOWER, 1005, {"axes": "index"}),
    "ITK, world": Way(lps_axes, LOWER, 1005, {"axes": "world"}),
    "MRtrix": Way(world_axes, DIAGONAL_FIRST, 0, {"axes": "world", "order": "mrtrix"}),
    "DIPY, b-vectors in image axes": Way(fsl_axes, LOWER, 0, {"axes": "image", "order": "nifti"}),
    "DIPY, b-vectors in world axes": Way(world_axes, LOWER, 0, {"axes": "world", "order": "nifti"}),
    "AFNI, array axes": Way(array_axes, LOWER, 0, {"axes": "index", "order": "nifti"}),
}


def tensor(seed):
    E = Rotation.random(random_state=seed).as_matrix()
    return E @ np.diag(EIGENVALUES) @ E.T


def components(D, places):
    return np.array([D[i, j] for i, j in places])


def tensors_in(image, places, axes):
    """World tensors (n1, n2, n3, 3, 3) of a NIfTI, read with these axes and this order."""
    data = np.asarray(image.dataobj, float)
    data = data.reshape(*data.shape[:3], 6)
    D = np.empty((*data.shape[:3], 3, 3))
    for c, (i, j) in enumerate(places):
        D[..., i, j] = D[..., j, i] = data[..., c]
    A = axes(image.affine)
    return A @ D @ A.T


def check_tensors(scene, found, D):
    """Eigenvalues to 1e-6 and the first eigenvector to a hundredth of a degree, turned with the tissue."""
    tissue = scene.frame.to_storage(scene.update.pull_back.tissue)
    still = scene.frame.to_storage(~scene.update.pull_back.tissue & ~scene.update.cavity)
    for where, wanted in ((tissue, scene.turn @ D @ scene.turn.T), (still, D)):
        values, E = np.linalg.eigh(found[where])
        assert_allclose(values, np.tile(EIGENVALUES, (len(values), 1)), atol=1e-6)
        cosine = abs(E[:, :, 2] @ np.linalg.eigh(wanted)[1][:, 2])
        assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < DEGREES
        assert_allclose(found[where], np.tile(wanted, (len(values), 1, 1)), atol=2e-6)


def grids():
    """Storage of the companion, and of the run's image."""
    return [("LAS", "RAS"), ("RAS", "LAS"), ("PSR", "oblique"), ("oblique", "RAS")]


def companion_affine(name):
    linear = STORAGE[name] * 2.4
    return affine_of(linear, -linear @ np.full(3, 14.5))


@pytest.mark.parametrize("grid", grids(), ids="-".join)
@pytest.mark.parametrize("who", TENSORS)
@pytest.mark.parametrize("seed", range(3))
def test_tensors_of_each_program(tmp_path, who, seed, grid):
    way, scene, affine, D = TENSORS[who], known(STORAGE[grid[1]]), companion_affine(grid[0]), tensor(seed)
    A = way.axes(affine)
    nifti(tmp_path / "t.nii.gz", components(A.T @ D @ A, way.places), affine, way.intent)
    image = carry(read_companion(tmp_path / "t.nii.gz", "tensor"), scene.frame, scene.update, kind="tensor", **way.said)
    assert image.header["intent_code"] == way.intent and image.ndim == (5 if way.intent else 4)
    check_tensors(scene, tensors_in(image, way.places, way.axes), D)


FRAMES = {"none": None, "identity": np.eye(3), "turned": Rotation.from_euler("zyx", [34, 10, -5], True).as_matrix(),
          "mirrored": np.diag([1.0, -1.0, 1.0])}


@pytest.mark.parametrize("kind", ["3D-symmetric-matrix", "3D-masked-symmetric-matrix", "3D-matrix"])
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("space", ["left-posterior-superior", "right-anterior-superior", "left-anterior-superior"])
def test_tensors_of_slicer(tmp_path, kind, frame, space):
    """NRRD states it all: space, measurement frame and layout. The result is ITK's NIfTI: lower triangle, LPS."""
    scene, affine, D = known(STORAGE["RAS"]), companion_affine("oblique"), tensor(7)
    to_world = np.diag({"l": [-1.0], "r": [1.0]}[space[0]] + [-1.0 if "posterior" in space else 1.0, 1.0])
    A = to_world @ (np.eye(3) if FRAMES[frame] is None else FRAMES[frame])
    inside = A.T @ D @ A
    stored = {"3D-symmetric-matrix": components(inside, UPPER), "3D-matrix": inside.ravel(),
              "3D-masked-symmetric-matrix": np.array([1.0, *components(inside, UPPER)])}[kind]
    nrrd(tmp_path / "t.nrrd", stored, affine, kind, space, FRAMES[frame])
    image = carry(read_companion(tmp_path / "t.nrrd", "tensor"), scene.frame, scene.update, kind="tensor")
    assert image.header["intent_code"] == 1005 and image.extra["VectorFrame"] == "LPS+"
    assert image.extra["TensorOrder"] == ["xx", "xy", "yy", "xz", "yz", "zz"]
    check_tensors(scene, tensors_in(image, LOWER, lps_axes), D)


VECTORS = {
    "FSL": (fsl_axes, 0, {"axes": "image"}), "MRtrix": (world_axes, 0, {"axes": "world"}),
    "array axes": (array_axes, 0, {"axes": "index"}), "ITK, 1007": (lps_axes, 1007, {}),
    "ITK, 1006": (world_axes, 1006, {}),
}
V = np.array([0.6, -0.48, 0.64])    # a unit vector


def check_vectors(scene, image, axes, sign_matters=True):
    data = np.asarray(image.dataobj, float)
    found = data.reshape(*data.shape[:3], 3) @ axes(image.affine).T
    tissue = scene.frame.to_storage(scene.update.pull_back.tissue)
    still = scene.frame.to_storage(~scene.update.pull_back.tissue & ~scene.update.cavity)
    for where, wanted in ((tissue, scene.turn @ V), (still, V)):
        got = found[where]
        if not sign_matters:
            got = got * np.sign(got @ wanted)[:, None]
        assert_allclose(got, np.tile(wanted, (len(got), 1)), atol=1e-6)


@pytest.mark.parametrize("kind", ["vector", "axis"])
@pytest.mark.parametrize("grid", grids(), ids="-".join)
@pytest.mark.parametrize("who", VECTORS)
def test_vectors_of_each_program(tmp_path, who, grid, kind):
    (axes, intent, said), scene, affine = VECTORS[who], known(STORAGE[grid[1]]), companion_affine(grid[0])
    nifti(tmp_path / "v.nii.gz", axes(affine).T @ V, affine, intent)
    image = carry(read_companion(tmp_path / "v.nii.gz", kind), scene.frame, scene.update, kind=kind, **said)
    assert image.header["intent_code"] == intent
    check_vectors(scene, image, axes)


@pytest.mark.parametrize("name", ["v.nrrd", "v.mha", "v.nii.gz"])
def test_vectors_of_itk(tmp_path, name):
    """Written by SimpleITK, whose vectors are LPS; what is written is read by SimpleITK where it takes one slice."""
    scene, affine = known(STORAGE["PSR"]), companion_affine("oblique")
    image = sitk.GetImageFromArray(np.tile(LPS @ V, (30, 30, 30, 1)), isVector=True)
    image.SetOrigin((LPS @ affine[:3, 3]).tolist())
    image.SetSpacing([7.2] * 3)
    image.SetDirection((LPS @ affine[:3, :3] / 7.2).ravel().tolist())
    sitk.WriteImage(image, str(tmp_path / name))
    carried = carry(read_companion(tmp_path / name, "vector"), scene.frame, scene.update, kind="vector")
    assert carried.header["intent_code"] == 1007
    check_vectors(scene, carried, lps_axes)
    nib.save(carried, tmp_path / "made.nii.gz")    # its one slice is not along the last axis: ITK keeps it
    read = sitk.ReadImage(str(tmp_path / "made.nii.gz"))
    assert read.GetNumberOfComponentsPerPixel() == 3
    got = sitk.GetArrayFromImage(read).reshape(-1, 3)
    tissue = scene.frame.to_storage(scene.update.pull_back.tissue).transpose(2, 1, 0).ravel()
    assert_allclose(got[tissue], np.tile(LPS @ scene.turn @ V, (tissue.sum(), 1)), atol=1e-6)


def test_a_measurement_frame_of_vectors(tmp_path):
    scene, affine, frame = known(STORAGE["LAS"]), companion_affine("RAS"), FRAMES["turned"]
    nrrd(tmp_path / "v.nrrd", frame.T @ LPS @ V, affine, "vector", frame=frame)
    check_vectors(scene, carry(read_companion(tmp_path / "v.nrrd", "vector"), scene.frame, scene.update, kind="vector"),
                  lps_axes)
    world = carry(read_companion(tmp_path / "v.nrrd", "vector"), scene.frame, scene.update, kind="vector", axes="world")
    with pytest.raises(AssertionError):    # "world" is the file's space, whatever its measurement frame
        check_vectors(scene, world, lps_axes)


def test_what_a_file_leaves_open_is_asked_for(tmp_path):
    scene, affine, D = known(STORAGE["RAS"]), companion_affine("RAS"), tensor(1)
    nifti(tmp_path / "four.nii.gz", components(D, UPPER), affine)
    nifti(tmp_path / "five.nii.gz", components(D, LOWER), affine, 1005)
    nifti(tmp_path / "v1.nii.gz", V, affine)
    for name, kind, words in (("four", "tensor", "world.*image.*index"), ("v1", "vector", "world.*image.*index"),
                              ("v1", "axis", "world.*image.*index"), ("five", "tensor", "index.*ANTs.*world")):
        companion = read_companion(tmp_path / f"{name}.nii.gz", kind)
        with pytest.raises(XfemnavError, match=f"E131.*{words}"):
            carry(companion, scene.frame, scene.update, kind=kind)
    nrrd(tmp_path / "t.nrrd", components(D, UPPER), affine, "3D-symmetric-matrix")
    bare = (tmp_path / "t.nrrd").read_bytes().replace(b"space: left-posterior-superior", b"space dimension: 3")
    (tmp_path / "bare.nrrd").write_bytes(bare)
    with pytest.warns(match="W112"):
        companion = read_companion(tmp_path / "bare.nrrd", "tensor")
    with pytest.raises(XfemnavError, match="E131"):
        carry(companion, scene.frame, scene.update, kind="tensor")


@pytest.mark.parametrize("frame", ["(1,0,0) (0,1,0)", "(1,0,0) (2,0,0) (0,0,1)", "(1,0,0) none (0,0,1)",
                                   "(nan,0,0) (0,1,0) (0,0,1)"])
def test_a_measurement_frame_that_is_none_is_refused(tmp_path, frame):
    nrrd(tmp_path / "t.nrrd", components(tensor(1), UPPER), companion_affine("RAS"), "3D-symmetric-matrix",
         frame=np.eye(3))
    (tmp_path / "bad.nrrd").write_bytes((tmp_path / "t.nrrd").read_bytes().replace(
        b"measurement frame: (1,0,0) (0,1,0) (0,0,1)", f"measurement frame: {frame}".encode()))
    with pytest.raises(XfemnavError, match=r"E105.*measurement frame"):
        read_companion(tmp_path / "bad.nrrd", "tensor")


def test_matrices_that_are_not_symmetric_are_refused(tmp_path):
    scene = known(STORAGE["RAS"])
    nrrd(tmp_path / "m.nrrd", np.arange(9.0), companion_affine("RAS"), "3D-matrix")
    with pytest.raises(XfemnavError, match=r"E131.*not symmetric"):
        carry(read_companion(tmp_path / "m.nrrd", "tensor"), scene.frame, scene.update, kind="tensor")


def test_masked_tensors_are_0_where_their_mask_is(tmp_path):
    scene = known(STORAGE["RAS"])
    nrrd(tmp_path / "m.nrrd", np.array([0.0, *components(tensor(1), UPPER)]), companion_affine("RAS"),
         "3D-masked-symmetric-matrix")
    image = carry(read_companion(tmp_path / "m.nrrd", "tensor"), scene.frame, scene.update, kind="tensor")
    assert not np.asarray(image.dataobj).any()


def test_digests_tell_frames_apart(tmp_path):
    stored, affine = components(tensor(1), UPPER), companion_affine("RAS")
    digests = set()
    for k, frame in enumerate((None, FRAMES["turned"], FRAMES["mirrored"])):
        nrrd(tmp_path / f"{k}.nrrd", stored, affine, "3D-symmetric-matrix", frame=frame)
        digests.add(read_companion(tmp_path / f"{k}.nrrd", "tensor").digest)
    assert len(digests) == 3


ORDERS = {"fsl": UPPER, "mrtrix": DIAGONAL_FIRST, "nifti": LOWER}


@pytest.mark.parametrize("written, taken", [("mrtrix", "fsl"), ("mrtrix", "nifti"), ("nifti", "fsl"),
                                            ("fsl", "mrtrix")])
def test_another_order_is_noticed(tmp_path, written, taken):
    scene = known(STORAGE["RAS"])
    e = np.random.default_rng(0).normal(size=(30, 30, 30, 3))
    e /= np.linalg.norm(e, axis=-1, keepdims=True)
    data = np.stack([0.3 * (i == j) + 1.4 * e[..., i] * e[..., j] for i, j in ORDERS[written]], axis=-1)
    nib.save(nib.Nifti1Image(data.astype(np.float32), companion_affine("RAS")), tmp_path / "t.nii.gz")
    companion = read_companion(tmp_path / "t.nii.gz", "tensor")
    with pytest.warns(match=rf"W133.*order is {taken}'s.*Taken as .*{written}.*none has.*tensor_order="):
        carry(companion, scene.frame, scene.update, kind="tensor", axes="world", order=taken)
    with quiet():
        carry(companion, scene.frame, scene.update, kind="tensor", axes="world", order=written)


def test_a_few_tensors_may_be_negative(tmp_path):
    """Noise makes some at the brain's edge: under 1 % of the organ is no other order, above it is."""
    scene = known(STORAGE["RAS"])
    rng, shape, affine = np.random.default_rng(0), (90, 90, 3), affine_of(np.diag([2.0, 2, 6]), (-89.0, -89, -6))
    for share, warned in ((0.004, False), (0.03, True)):
        data = np.tile(components(np.diag(EIGENVALUES), UPPER), (*shape, 1))
        data[rng.uniform(size=shape) < share] = components(np.diag([1.0, 0.5, -0.1]), UPPER)
        nib.save(nib.Nifti1Image(data.astype(np.float32), affine), tmp_path / "t.nii.gz")
        companion = read_companion(tmp_path / "t.nii.gz", "tensor")
        with pytest.warns(match="W133.*No order") if warned else quiet():
            carry(companion, scene.frame, scene.update, kind="tensor", axes="world")


def swirl(tmp_path, signs):
    """Unit vectors that turn slowly across the grid, with signs (30, 30, 30)."""
    affine = companion_affine("RAS")
    angle = 0.04 * np.indices((30, 30, 30)).sum(axis=0)
    field = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * signs[..., None]
    nib.save(nib.Nifti1Image(field.astype(np.float32), affine), tmp_path / "V1.nii.gz")
    return affine


def test_axes_are_unit_vectors_whatever_their_signs(tmp_path):
    rng, scene = np.random.default_rng(0), known(STORAGE["RAS"], degrees=0.0)
    affine = swirl(tmp_path, rng.choice([-1.0, 1.0], (30, 30, 30)))
    companion = read_companion(tmp_path / "V1.nii.gz", "axis")
    found = np.asarray(carry(companion, scene.frame, scene.update, kind="axis", axes="world").dataobj).squeeze()
    assert_allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-6)
    world = scene.frame.to_world(scene.frame.pixel_centres().reshape(-1, 2))
    angle = 0.04 * ((world - affine[:3, 3]) / 7.2).sum(axis=1)
    wanted = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1).reshape(found.shape)
    inner = (slice(2, -2),) * 2    # beyond the outermost voxel centres the values go on unchanged
    # the mean of dyads .04 rad apart is within h^2 / 8 of the dyad between, the turn itself being linear
    assert np.arccos(abs((found * wanted).sum(axis=-1))[inner].clip(0, 1)).max() < 0.01
    with pytest.warns(match=r"W134.*axis"):
        short = carry(companion, scene.frame, scene.update, kind="vector", axes="world")
    assert (np.linalg.norm(np.asarray(short.dataobj), axis=-1) < 0.9).mean() > 0.3


def test_axes_keep_the_sign_of_the_nearest_voxel_and_zeros(tmp_path):
    scene = known(STORAGE["RAS"], degrees=0.0)
    signs = np.ones((30, 30, 30))
    signs[:15] = -1
    signs[:, :8] = 0
    swirl(tmp_path, signs)
    found = carry(read_companion(tmp_path / "V1.nii.gz", "axis"), scene.frame, scene.update, kind="axis", axes="world")
    near = carry(read_companion(tmp_path / "V1.nii.gz", "vector"), scene.frame, scene.update, kind="vector",
                 axes="world", interp="nearest")
    found, near = (np.asarray(image.dataobj).squeeze() for image in (found, near))
    assert ((found * near).sum(axis=-1)[near.any(axis=-1)] > 0.9).all()
    assert (found.any(axis=-1) == near.any(axis=-1)).all() and not near.any(axis=-1).all()


def test_a_smooth_vector_field_does_not_shrink(tmp_path):
    scene = known(STORAGE["RAS"])
    swirl(tmp_path, np.ones((30, 30, 30)))
    with quiet():
        carry(read_companion(tmp_path / "V1.nii.gz", "vector"), scene.frame, scene.update, kind="vector", axes="world")


def test_names_that_are_none(tmp_path):
    scene = known(STORAGE["RAS"])
    nifti(tmp_path / "t.nii.gz", components(tensor(1), UPPER), companion_affine("RAS"))
    companion = read_companion(tmp_path / "t.nii.gz", "tensor")
    for wrong in ({"axes": "voxel"}, {"axes": "world", "order": "ants"}):
        with pytest.raises(XfemnavError, match="E780"):
            carry(companion, scene.frame, scene.update, kind="tensor", **wrong)
    with pytest.raises(XfemnavError, match="E780"):
        carry(companion, scene.frame, scene.update, kind="tensors")
