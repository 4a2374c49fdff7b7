"""What goes along with the image: the value of pixels without tissue, vectors, tensors, axes, and labels."""

import gzip
import json
import tempfile
import warnings
from functools import cache
from pathlib import Path

import nibabel as nib
import numpy as np
from rows import Row
from scipy.spatial.transform import Rotation
from small import CUT, RAS, brain, write

import xfemnav
from xfemnav.pipeline.running.apply import apply
from xfemnav.pipeline.stages.inputs import recorded

SMALL = {"element_size_mm": 8, "corridor_element_mm": 4, "report": False, "opening_mm": 6, "blade": (0, 0.5)}
LPS = np.diag([-1.0, -1.0, 1.0])


@cache
def done():
    """A run on the small head, and the folder that it stands in."""
    folder = tempfile.TemporaryDirectory()
    home = Path(folder.name)
    with recorded():
        result = xfemnav.run(write(home / "head.nii.gz"), cut=CUT, output=home / "out", cache=home / "cache", **SMALL)
    return result, folder


def turned(result):
    """Rotations (n, 3, 3) of the tissue pixels, by the triangles' deformation, and where those are (i, j, 1)."""
    pull = result.update.pull_back
    U, _, V = np.linalg.svd(pull.F[pull.triangle[pull.tissue]])
    whole = np.tile(np.eye(3), (len(U), 1, 1))
    whole[:, :2, :2] = U @ V    # an axial slice along R and A
    return whole, result.frame.to_storage(pull.tissue)


def degrees(a, b):
    """The largest angle between the axes of two fields (n, 3)."""
    return float(np.degrees(np.arccos(np.minimum(abs((a * b).sum(axis=1)), 1))).max())


def unit(v):
    return np.asarray(v) / np.linalg.norm(v, axis=-1, keepdims=True)


def water_is_tissue(folder):
    ct = np.where(brain() > 0, brain() / 20, -1000).astype(np.int16)
    with recorded() as warned:
        result = xfemnav.run(write(folder / "head.nii.gz", ct), cut=CUT, output=folder / "out", cache=folder / "cache",
                             mask=write(folder / "mask.nii.gz", (ct > -1000).astype(np.uint8)), **SMALL)
    name = result.record["outputs"]["updated"]
    updated = nib.load(folder / "out" / name).get_fdata()
    empty = result.frame.to_storage(result.update.cavity | result.update.vacated)
    fill = json.loads((folder / "out" / name.replace(".nii.gz", ".json")).read_text())["Fill"]
    assert empty.sum() > 10 and (updated[empty] == -1000).all() and fill == -1000 and not warned
    return f"{empty.sum()} pixels without tissue hold {fill:g}, recorded as Fill", ""


def a_fill_of_water(folder):
    ct = np.where(brain() > 0, brain() / 20 - 30, -1000).astype(np.int16)
    with recorded() as warned:
        made = done()[0].warp(write(folder / "ct.nii.gz", ct), kind="continuous", fill=0)
    assert [item.code for item in warned] == ["W211"] and made.extra["Fill"] == 0
    return warned[0].text[:70], "W211"


def vectors_of_slicer(folder):
    """Known vectors in a NRRD that says left-posterior-superior: read as RAS they would be 102 degrees off."""
    import SimpleITK as sitk

    v = unit([0.8, 0.35, 0.5])
    image = sitk.GetImageFromArray(np.tile(LPS @ v, (40, 80, 80, 1)), isVector=True)
    image.SetOrigin((LPS @ [-79.0, -79, -28]).tolist())
    image.SetSpacing([2.0] * 3)
    image.SetDirection(LPS.ravel().tolist())
    sitk.WriteImage(image, str(folder / "v.nrrd"))
    result = done()[0]
    made, (R, tissue) = result.warp(folder / "v.nrrd", kind="vector"), turned(result)
    found = np.asarray(made.dataobj)[tissue].reshape(-1, 3) @ LPS
    off = degrees(unit(found), R @ v)
    assert off < 0.01 and made.header["intent_code"] == 1007
    return f"LPS by the file, {off:.0e} degrees off; written as intent 1007", ""


def tensors_of_slicer(folder):
    """A measurement frame turned by 34 degrees."""
    E = Rotation.random(random_state=1).as_matrix()
    D, frame = E @ np.diag([0.2, 0.4, 1.7]) @ E.T, Rotation.from_euler("z", 34, degrees=True).as_matrix()
    inside = frame.T @ LPS @ D @ LPS @ frame
    header = ["NRRD0005", "type: double", "dimension: 4", "space: left-posterior-superior", "sizes: 6 80 80 40",
              "space directions: none (-2,0,0) (0,-2,0) (0,0,2)", "kinds: 3D-symmetric-matrix domain domain domain",
              "endian: little", "encoding: gzip", "space origin: (79,79,-28)", "measurement frame: " +
              " ".join("(" + ",".join(f"{x:.17g}" for x in column) + ")" for column in frame.T)]
    data = np.tile(inside[np.triu_indices(3)], 80 * 80 * 40)
    (folder / "d.nrrd").write_bytes("\n".join(header).encode() + b"\n\n" + gzip.compress(data.tobytes(), 1))
    return _tensors(folder / "d.nrrd", E, LPS, "nifti", {})


def tensors_of_ants(folder):
    """Array axes, in a file whose first axis runs to the left."""
    E = Rotation.random(random_state=1).as_matrix()
    D, las = E @ np.diag([0.2, 0.4, 1.7]) @ E.T, np.diag([-1.0, 1.0, 1.0])
    inside = las @ D @ las
    values = np.tile(np.array([inside[i, j] for i, j in _order("nifti")]), (80, 80, 40, 1, 1)).astype(np.float32)
    affine = np.array([[-2.0, 0, 0, 79], [0, 2, 0, -79], [0, 0, 2, -28], [0, 0, 0, 1]])
    image = nib.Nifti1Image(values, affine)
    image.header.set_intent(1005, (3,))
    nib.save(image, folder / "d.nii.gz")
    try:
        done()[0].warp(folder / "d.nii.gz", kind="tensor")
    except xfemnav.XfemnavError as error:
        assert error.code == "E131" and "index" in error.message and "world" in error.message
    else:
        raise AssertionError("taken without a word")
    text, _ = _tensors(folder / "d.nii.gz", E, np.eye(3), "nifti", {"axes": "index"})    # the run's image is RAS
    return f"asked for; index: {text}", "E131"


def _order(name):
    return {"nifti": [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)],
            "mrtrix": [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]}[name]


def _tensors(path, E, axes, order, said):
    """Carry tensors of eigenvectors E along, and read what comes in known axes and order."""
    result = done()[0]
    made, (_, tissue) = result.warp(path, kind="tensor", **said), turned(result)
    values = np.asarray(made.dataobj, float)[tissue].reshape(-1, 6)
    D = np.empty((len(values), 3, 3))
    for c, (i, j) in enumerate(_order(order)):
        D[:, i, j] = D[:, j, i] = values[:, c]
    eigenvalues, found = np.linalg.eigh(axes @ D @ axes.T)
    pull = result.update.pull_back
    F = np.tile(np.eye(3), (len(values), 1, 1))
    F[:, :2, :2] = pull.F[pull.triangle[pull.tissue]]
    order_of = result.frame.to_storage(np.arange(pull.tissue.size).reshape(pull.tissue.shape))[tissue]
    rows = np.searchsorted(np.flatnonzero(pull.tissue), order_of)
    off, wrong = degrees(found[:, :, 2], unit(F[rows] @ E[:, 2])), abs(eigenvalues - [0.2, 0.4, 1.7]).max()
    assert off < 0.01 and wrong < 1e-6
    return f"V1 {off:.0e} degrees off, eigenvalues {wrong:.0e}", ""


def mrtrix_order(folder):
    e = unit(np.random.default_rng(0).normal(size=(80, 80, 3, 3)))
    D = 0.3 * np.eye(3) + 1.4 * e[..., :, None] * e[..., None, :]
    values = np.stack([D[..., i, j] for i, j in _order("mrtrix")], axis=-1).astype(np.float32)
    affine = np.array([[2.0, 0, 0, -79], [0, 2, 0, -79], [0, 0, 4, 6], [0, 0, 0, 1]])
    nib.save(nib.Nifti1Image(values, affine), folder / "dt.nii.gz")
    with recorded() as warned:
        done()[0].warp(folder / "dt.nii.gz", kind="tensor", axes="world")
    assert [item.code for item in warned] == ["W133"] and "⟦tensor_order=mrtrix⟧" in warned[0].text
    with recorded() as right:
        done()[0].warp(folder / "dt.nii.gz", kind="tensor", axes="world", order="mrtrix")
    assert not right
    return warned[0].text.partition(" of ")[0] + " negative as fsl, none as mrtrix", "W133"


def signs_of_axes(folder):
    rng, at = np.random.default_rng(0), np.moveaxis(np.indices((80, 80, 3)), 0, -1)
    angle = 0.02 * at.sum(axis=-1)
    v1 = np.stack([np.cos(angle), np.sin(angle), 0.3 + 0 * angle], axis=-1) * rng.choice([-1.0, 1.0], (80, 80, 3, 1))
    affine = np.array([[2.5, 0, 0, -99], [0, 2.5, 0, -99], [0, 0, 4, 6], [0, 0, 0, 1]])
    nib.save(nib.Nifti1Image(unit(v1).astype(np.float32), affine), folder / "V1.nii.gz")
    result = done()[0]
    tissue = result.frame.to_storage(result.update.pull_back.tissue)
    with recorded() as warned:
        vector = np.asarray(result.warp(folder / "V1.nii.gz", kind="vector", axes="image").dataobj)[tissue]
    axis = np.asarray(result.warp(folder / "V1.nii.gz", kind="axis", axes="image").dataobj)[tissue]
    short = (np.linalg.norm(vector, axis=1) < 0.9).mean()
    assert [item.code for item in warned] == ["W134"] and abs(np.linalg.norm(axis, axis=1) - 1).max() < 1e-6
    return f"axis: all of length 1; vector: {short:.0%} short, told", "W134"


def labels_without_a_kind(folder):
    labels = np.select([brain() > 710, brain() > 600, brain() > 0], [3, 2, 1]).astype(np.uint8)
    values = []
    with warnings.catch_warnings(record=True), tempfile.TemporaryDirectory() as out:
        for name in ("x_dseg.nii.gz", "x.nii.gz"):
            found = apply(done()[0], write(folder / name, labels, RAS), Path(out))
            values.append(len(np.unique(np.asarray(nib.load(found.target).dataobj))))
            codes = [item.code for item in found.warnings]
    assert values == [4, 4] and found.text == "label image" and codes == ["W135"]
    return "3 labels and background: 4 values, by the name and by the data", "W135"


ROWS = [
    Row("A2", "CT: 0 is water, air -1000", "0 in the cavity, seen as tissue", water_is_tissue),
    Row("A2", "a fill of 0 in CT", "taken without a word", a_fill_of_water),
    Row("A7", "vectors in NRRD, LPS by the file", "read as RAS: 102 degrees off", vectors_of_slicer),
    Row("A7", "tensors in a NRRD with a measurement frame", "34 degrees off", tensors_of_slicer),
    Row("A7", "ANTs' tensors in a LAS file", "read as LPS: 62 degrees off", tensors_of_ants),
    Row("A8", "tensors in MRtrix's order", "read as FSL's: V1 58 degrees off", mrtrix_order),
    Row("A9", "FSL's V1, signs at random", "41 % of the vectors under .9 in length", signs_of_axes),
    Row("A14", "apply to x_dseg.nii.gz", "labels averaged: 3 values become 410", labels_without_a_kind),
]
