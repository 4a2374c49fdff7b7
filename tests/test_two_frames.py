"""NIfTI headers with two frames: which one is taken, what is said of it, and that outputs lie on their input in both.

nibabel and SimpleITK are asked, not quoted: for every pair of codes, and for frames that one of them cannot use.
"""

import json
from itertools import product

import nibabel as nib
import numpy as np
import pytest
from small import CUT, OPEN, QUICK, RAS, brain, write, xfemnav

import xfemnav as package
from tests.headers import TURNED, itk_affine, two_frames
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.frames.slices import take_slice, to_nifti, values_on
from xfemnav.imaging.reading.gate import read_components, read_image
from xfemnav.imaging.reading.nifti_frames import doubts, facts

SFORM, QFORM = RAS, TURNED @ RAS
VOLUME = np.arange(4 * 5 * 3, dtype=np.int16).reshape(4, 5, 3)
SHEARED = RAS.copy()
SHEARED[0, 2] = 0.4  # slices stacked askew: right angles within each of them


def told(image, wanted="auto", points=((0.0, 0, 0), (40, 40, 10))):
    """What is said of an image's frames where it is the image of the run."""
    found = facts(image.frames, image.values.shape[:3])
    return " ".join(doubts("head.nii", found, wanted, np.array(points), "head.nii", found))


def frame_of(affine) -> str:
    """Which of the two frames of these tests an affine is."""
    return next(name for name, frame in (("sform", SFORM), ("qform", QFORM)) if np.allclose(affine, frame, atol=1e-3))


def told_of_itk(text: str) -> str:
    return text.partition("built on ITK take the ")[2][:5]


@pytest.mark.parametrize("codes", list(product(range(5), repeat=2)), ids=str)
def test_what_is_taken_and_what_is_said_of_other_programs(tmp_path, codes):
    """Every pair of codes of sform and qform."""
    path = two_frames(tmp_path / "head.nii", VOLUME, codes=codes)
    if codes == (0, 0):
        with pytest.warns(XfemnavWarning, match="W112"):
            image = read_image(path)
        assert image.frames is None and told(image) == ""
        return
    image = read_image(path)
    np.testing.assert_allclose(image.affine, nib.load(path).affine, atol=1e-5)
    assert image.frame_code == (codes[0] or codes[1])
    text = told(image)
    assert bool(text) == all(codes)
    if text:
        assert f"The {frame_of(image.affine)} was taken" in text and "mm apart in the organ" in text
        assert told_of_itk(text) == frame_of(itk_affine(path))
    assert told(image, "sform") == told(image, "qform") == ""
    for wanted in ("sform", "qform"):
        there = {"sform": codes[0], "qform": codes[1]}[wanted]
        found = read_image(path, nifti_frame=wanted).affine
        assert frame_of(found) == (wanted if there else {"sform": "qform", "qform": "sform"}[wanted])
        np.testing.assert_array_equal(found, read_components(path, nifti_frame=wanted).affine)


@pytest.mark.parametrize("wanted", ["auto", "qform"])
@pytest.mark.parametrize("codes", [pair for pair in product(range(5), repeat=2) if any(pair)], ids=str)
def test_an_output_lies_on_its_input_in_both(tmp_path, codes, wanted):
    """One slice of three, in nibabel and in SimpleITK, whichever frame was taken; the codes are the input's."""
    path = two_frames(tmp_path / "head.nii", VOLUME, codes=codes)
    frame = take_slice(read_image(path, nifti_frame=wanted), index=2)
    nib.save(to_nifti(frame, frame.values), tmp_path / "out.nii.gz")
    out = nib.load(tmp_path / "out.nii.gz")
    assert (int(out.header["sform_code"]), int(out.header["qform_code"])) == codes
    corner = np.array([0, 0, 2, 1.0])
    for affine, own in ((nib.load(path).affine, out.affine), (itk_affine(path), itk_affine(tmp_path / "out.nii.gz"))):
        np.testing.assert_allclose(own[:3, :2], affine[:3, :2], atol=1e-5)
        np.testing.assert_allclose(own[:3, 3], (affine @ corner)[:3], atol=1e-4)
    np.testing.assert_array_equal(out.get_fdata()[:, :, 0], VOLUME[:, :, 2])


@pytest.mark.parametrize("codes", [(1, 1), (2, 1), (1, 3)], ids=str)
def test_axes_that_are_not_perpendicular_are_no_frame_to_itk(tmp_path, codes):
    path = two_frames(tmp_path / "head.nii", VOLUME, sform=SHEARED, codes=codes)
    image = read_image(path)
    np.testing.assert_allclose(image.affine, nib.load(path).affine, atol=1e-5)
    assert frame_of(itk_affine(path)) == told_of_itk(told(image)) == "qform"
    frame = take_slice(image, index=1)
    nib.save(to_nifti(frame, frame.values), tmp_path / "out.nii")
    np.testing.assert_allclose(itk_affine(tmp_path / "out.nii")[:3, :2], QFORM[:3, :2], atol=1e-5)
    np.testing.assert_allclose(nib.load(tmp_path / "out.nii").affine[:3, :2], SHEARED[:3, :2], atol=1e-5)


@pytest.mark.parametrize("shear, perpendicular", [(5e-5, True), (3e-4, False)])
def test_the_shear_that_itk_bears(tmp_path, shear, perpendicular):
    sform = RAS.copy()
    sform[0, 1] = shear * 2
    path = two_frames(tmp_path / "head.nii", VOLUME, sform=sform, codes=(1, 1))
    theirs = read_image(path).frames.itk()
    assert theirs[0] == ("sform" if perpendicular else "qform")
    np.testing.assert_allclose(theirs[1], itk_affine(path), atol=1e-4)


def test_a_frame_that_cannot_be_used_is_said_where_others_take_it(tmp_path):
    broken = {"quatern_b": 0.9, "quatern_c": 0.9, "quatern_d": 0.9}
    image = read_image(two_frames(tmp_path / "head.nii", VOLUME, **broken))
    assert "its qform, which 3D Slicer" in told(image) and "cannot be used" in told(image)
    assert told(read_image(two_frames(tmp_path / "head.nii", VOLUME, codes=(1, 1), **broken))) == ""
    with pytest.raises(XfemnavError, match="E110"):
        read_image(tmp_path / "head.nii", nifti_frame="qform")
    frame = take_slice(image, index=0)
    out = to_nifti(frame, frame.values)
    assert int(out.header["qform_code"]) == 0 and np.allclose(out.affine, SFORM)


@pytest.mark.parametrize("codes", [(1, 0), (2, 0), (1, 1)], ids=str)
def test_itk_takes_the_voxel_sizes_that_stand_beside_the_frame(tmp_path, codes):
    """An sform of 2 mm voxels, and pixdim of 2.5 mm."""
    path = two_frames(tmp_path / "head.nii", VOLUME, qform=SFORM, codes=codes, pixdim=[1, 2.5, 2.5, 2, 1, 1, 1, 1])
    image = read_image(path)
    np.testing.assert_allclose(image.frames.itk()[1], itk_affine(path), atol=1e-4)
    off = np.linalg.norm([0.25 * 103, 0.25 * 111])  # mm at the farther point: a quarter of its way from voxel 0
    assert f"up to {off:.1f} mm" in told(image) and "pixdim" in told(image)
    frame = take_slice(image, index=1)
    nib.save(to_nifti(frame, frame.values), tmp_path / "out.nii")
    np.testing.assert_allclose(itk_affine(tmp_path / "out.nii")[:3, :2], itk_affine(path)[:3, :2], atol=1e-4)
    np.testing.assert_allclose(nib.load(tmp_path / "out.nii").affine[:3, :2], nib.load(path).affine[:3, :2], atol=1e-4)


@pytest.mark.parametrize("unit, scale", [(1, 1e-3), (3, 1e3)])
def test_frames_in_metres_and_microns(tmp_path, unit, scale):
    small = np.diag([scale, scale, scale, 1.0])
    path = two_frames(tmp_path / "head.nii", VOLUME, sform=small @ SFORM, qform=small @ QFORM, xyzt_units=unit)
    frames = read_image(path).frames
    assert frame_of(frames.sform) == "sform" and frame_of(frames.qform) == "qform"
    np.testing.assert_allclose(frames.sizes, 2, rtol=1e-6)
    np.testing.assert_allclose(frames.itk()[1], itk_affine(path), atol=1e-3)


def test_nifti_2_has_two_frames_too(tmp_path):
    image = read_image(two_frames(tmp_path / "head.nii", VOLUME, kind=nib.Nifti2Image))
    assert frame_of(image.affine) == "sform" and told_of_itk(told(image)) == "qform"
    assert frame_of(read_image(tmp_path / "head.nii", nifti_frame="qform").affine) == "qform"


@pytest.mark.parametrize("shift, doubted", [(0.09, False), (0.11, True)])
def test_a_tenth_of_a_millimetre_is_no_other_place(tmp_path, shift, doubted):
    qform = SFORM.copy()
    qform[0, 3] += shift
    assert bool(told(read_image(two_frames(tmp_path / "head.nii", VOLUME, qform=qform)))) == doubted


def test_only_the_organ_counts(tmp_path):
    """Frames turned about a point: they agree in the organ about it, and not at the corner of the volume."""
    about = np.eye(4)
    about[:3, 3] = (0.0, 0, 10)
    qform = about @ np.block([[TURNED[:3, :3], np.zeros((3, 1))], [0, 0, 0, 1]]) @ np.linalg.inv(about) @ SFORM
    image = read_image(two_frames(tmp_path / "head.nii", qform=qform))
    near = np.array([[0.3, 0, 10.0], [0, 0.3, 10]])
    assert told(image, points=near) == "" and told(image) != ""


# In a run -------------------------------------------------------------------------------------------------------------

# A qform in the plane of the sform, as a registration in the plane leaves it.
FLAT = np.array([[0.8, -0.6, 0, 4], [0.6, 0.8, 0, -7], [0, 0, 1, 0], [0, 0, 0, 1]]) @ SFORM


@pytest.fixture
def head(tmp_path, monkeypatch):
    """A folder with a small brain with two frames, a label map and a mask likewise, and a companion with one."""
    monkeypatch.chdir(tmp_path)
    two_frames(tmp_path / "head.nii", qform=FLAT)
    mask = (brain() > 0)[:, :, None]
    two_frames(tmp_path / "mask.nii", mask.astype(np.uint8), qform=FLAT)
    two_frames(tmp_path / "labels.nii", (mask * 2).astype(np.int16), qform=FLAT)
    two_frames(tmp_path / "other.nii", brain()[:, :, None] * 2, qform=FLAT)
    write(tmp_path / "one.nii.gz")
    return tmp_path


VOXELS = "--space", "voxel", "--cut", "1,40 20,36"  # the same places of the image in either frame


def run(capfd, *arguments, code=0):
    cut = () if "--cut" in arguments else ("--cut", CUT)
    got, stdout, stderr = xfemnav(capfd, "run", *QUICK, *OPEN, *cut, "-o", "out", "-w", "cache", "--json", *arguments)
    assert got == code, stderr
    return json.loads(stdout)


def doubted(record) -> list[str]:
    """The files of which W114 speaks."""
    return sorted(text.split()[0].strip(":") for text in texts(record))


def texts(record) -> list[str]:
    return [item["text"] for item in record["warnings"] if item["code"] == "W114"]


EVERY = ("head.nii", "--mask", "mask.nii", "--labels", "labels.nii", "--companion", "other.nii", "--companion",
         "one.nii.gz")
TWO = ["head.nii", "labels.nii", "mask.nii", "other.nii"]


def test_every_file_of_a_run_is_told_by_its_name(head, capfd):
    for _ in ("run", "cached"):
        assert doubted(run(capfd, *EVERY)) == TWO
    (head / "head.nii").rename(head / "renamed.nii")
    assert doubted(run(capfd, "renamed.nii", *EVERY[1:])) == [*TWO[1:], "renamed.nii"]
    assert doubted(run(capfd, "renamed.nii", "--stop-after", "segment")) == ["renamed.nii"]
    assert run(capfd, "renamed.nii", "--strict", code=65)["error"]["code"] == "W114"


def test_a_frame_that_is_asked_for_is_not_doubted_but_a_file_without_it_is(head, capfd):
    assert doubted(run(capfd, *EVERY, "--nifti-frame", "sform")) == []
    record = run(capfd, *EVERY, "--nifti-frame", "qform", *VOXELS)
    assert doubted(record) == ["one.nii.gz"]  # nibabel writes an sform alone
    assert "but of head.nii the qform" in texts(record)[0] and record["parameters"]["nifti_frame"] == "qform"
    np.testing.assert_allclose(record["input"]["affine"], FLAT, atol=1e-5)


@pytest.mark.parametrize("wanted, taken", [("auto", SFORM), ("qform", FLAT)])
def test_every_output_lies_on_the_image_in_both_and_the_result_counts_in_the_one_that_was_taken(
        head, capfd, wanted, taken):
    record = run(capfd, *EVERY, *VOXELS, "--nifti-frame", wanted)
    names = [name for name in record["outputs"].values() if name.endswith(".nii.gz")]
    assert len(names) == 8
    for name in names:
        header = nib.load(head / "out" / name).header
        np.testing.assert_allclose(header.get_sform(), SFORM, atol=1e-5)
        np.testing.assert_allclose(header.get_qform(), FLAT, atol=1e-5)
        assert (int(header["sform_code"]), int(header["qform_code"])) == (2, 1)
    result = package.Result.load(head / "out")
    path = np.array(record["cuts"][0]["path"])
    np.testing.assert_allclose(result.frame.to_world(path)[-1], (taken @ [20, 36, 0, 1])[:3], atol=1e-4)
    left, right = (result.to_current(result.frame.to_world(path[:1] * 0.5 + path[1:] * 0.5)[0], side)
                   for side in ("left", "right"))
    assert np.linalg.norm(left - right) == pytest.approx(4, abs=0.1)


def test_apply_takes_the_frame_of_the_run_or_its_own(head, capfd):
    run(capfd, *EVERY, "--nifti-frame", "qform", *VOXELS)
    code, _, told = xfemnav(capfd, "apply", "out", "other.nii", "-o", "carried")
    assert code == 0 and "W114" not in told
    code, _, told = xfemnav(capfd, "apply", "out", "other.nii", "-o", "elsewhere", "--nifti-frame", "auto")
    assert code == 0 and "W114 other.nii" in told
    here, there = (nib.load(head / folder / "other_desc-updated.nii.gz").get_fdata() for folder in
                   ("carried", "elsewhere"))
    assert abs(here - there).max() > 100


def test_the_frame_that_is_not_read_reaches_what_carries_it(head, capfd):
    """A header whose qform is corrected gives outputs with the new one, not those of the cache."""
    name = run(capfd, "head.nii")["outputs"]["updated"]
    for path, codes in (("head.nii", (2, 1)), ("head.nii", (2, 3))):
        two_frames(head / path, qform=SFORM, codes=codes)
        record = run(capfd, "head.nii")
        header = nib.load(head / "out" / name).header
        np.testing.assert_allclose(header.get_qform(), SFORM, atol=1e-5)
        assert int(header["qform_code"]) == codes[1] and doubted(record) == []


def test_a_mask_that_agrees_by_the_other_frame_is_told_so(head, capfd):
    """As 3D Slicer saves one that was drawn over an image of which it takes the qform."""
    write(head / "drawn.nii", (brain() > 0).astype(np.uint8), affine=FLAT)
    error = run(capfd, "head.nii", "--mask", "drawn.nii", code=65)["error"]
    assert error["code"] == "E204" and "--nifti-frame qform" in error["text"]
    assert doubted(run(capfd, "head.nii", "--mask", "drawn.nii", "--nifti-frame", "qform", *VOXELS)) == ["drawn.nii"]
    with pytest.raises(XfemnavError) as failure:
        values_on(read_image("one.nii.gz"), take_slice(read_image(write(head / "far.nii", affine=FLAT))))
    assert "nifti_frame" not in str(failure.value)


def test_a_session_tells_too(head):
    with pytest.warns(XfemnavWarning, match="W114 head.nii"):
        package.Session("head.nii", corridor=CUT, element_size_mm=8, corridor_element_mm=4)
