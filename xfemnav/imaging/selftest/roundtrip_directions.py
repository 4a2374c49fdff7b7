"""Vectors and tensors of the known scene, as FSL, ANTs, MRtrix, ITK and 3D Slicer write them, there and back.

Axes and orders are written out here by hand, so that what is wrong in the program is not wrong here too.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import SimpleITK as sitk

from xfemnav.imaging.carrying.companions import carry
from xfemnav.imaging.carrying.kinds import read_companion
from xfemnav.imaging.carrying.warp import covered, pull_back, update
from xfemnav.imaging.frames.slices import Slice, take_slice
from xfemnav.imaging.reading.gate import Image
from xfemnav.imaging.reading.lean import nibabel
from xfemnav.imaging.selftest.known import OBLIQUE, ORDERS, SHAPE, F, Scene, agree
from xfemnav.imaging.selftest.scenes import itk_image, scene_motion

DIRECTION = 2e-6  # float32 components near 1, and affines


class Way(NamedTuple):
    """How a program writes vectors and tensors: along which `axes` of a file's affine (as columns in world RAS), in
    which order of (row, column), with which NIfTI intents of either, and what has to be said of it."""

    axes: Callable
    places: tuple
    intents: tuple[int, int]
    said: dict


def _array_axes(affine) -> np.ndarray:
    return affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)


def _fsl_axes(affine) -> np.ndarray:
    axes = _array_axes(affine)
    return axes * ([-1, 1, 1] if np.linalg.det(axes) > 0 else [1, 1, 1])


UPPER, LOWER = ("xx", "xy", "xz", "yy", "yz", "zz"), ("xx", "xy", "yy", "xz", "yz", "zz")
ITK = Way(lambda affine: np.diag([-1.0, -1.0, 1.0]), LOWER, (1007, 1005), {"axes": "world"})
WAYS = {"FSL": Way(_fsl_axes, UPPER, (0, 0), {"axes": "image"}), "ANTs": Way(_array_axes, LOWER, (0, 1005),
                                                                             {"axes": "index", "order": "nifti"}),
        "MRtrix": Way(lambda affine: np.eye(3), ("xx", "yy", "zz", "xy", "xz", "yz"), (0, 0),
                      {"axes": "world", "order": "mrtrix"}), "ITK": ITK}
V = np.array([0.48, -0.6, 0.64])  # a unit vector, RAS
TENSOR = np.array([[1.3, 0.5, -0.2], [0.5, 0.7, 0.1], [-0.2, 0.1, 0.4]])  # RAS; eigenvalues .30, .52, 1.58


def check_vectors(folder: Path) -> None:
    """A vector turns by the rotation R of F = R U, in the axes of its file."""
    angle = np.arctan2(F[1, 0] - F[0, 1], F[0, 0] + F[1, 1])
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for scene, stored, frame, made in _directed():
        wanted = _in_space(scene, R) @ V
        for who, way in WAYS.items():
            _nifti_of(folder / "v.nii.gz", way.axes(stored).T @ V, stored, way.intents[0])
            _turned(f"vectors of {who}", folder / "v.nii.gz", frame, made, "vector", way, wanted)
        for name in ("v.nrrd", "v.mha"):
            vectors = np.broadcast_to(ITK.axes(stored).T @ V, (*SHAPE, 3))
            sitk.WriteImage(itk_image(vectors, stored), str(folder / name))
            _turned(f"vectors of SimpleITK in {name}", folder / name, frame, made, "vector",
                    ITK._replace(said={}), wanted)


def check_tensors(folder: Path) -> None:
    """The first eigenvector goes along F e1, the second into the plane of F e1 and F e2; eigenvalues stay."""
    eigenvalues, E = np.linalg.eigh(TENSOR)
    for scene, stored, frame, made in _directed():
        first, second = (_in_space(scene, F) @ E[:, k] for k in (2, 1))
        first = first / np.linalg.norm(first)
        second = second - first * (first @ second)
        second = second / np.linalg.norm(second)
        N = np.column_stack([np.cross(first, second), second, first])
        wanted = N @ np.diag(eigenvalues) @ N.T
        for who, way in WAYS.items():
            inside = way.axes(stored).T @ TENSOR @ way.axes(stored)
            _nifti_of(folder / "t.nii.gz", _listed(inside, way.places), stored, way.intents[1])
            _turned(f"tensors of {who}", folder / "t.nii.gz", frame, made, "tensor", way, wanted)
        _write_tensors(folder / "t.nrrd", stored)
        _turned("tensors of .nrrd with a measurement frame", folder / "t.nrrd", frame, made, "tensor",
                ITK._replace(said={}), wanted)


def _directed():
    """Scenes of both hands of storage: the scene, the affine of a companion, the run's slice, and its update."""
    for label in ("LAS", "oblique"):
        scene, order, flips = ORDERS[label]
        values, affine = scene.volume(order, flips)
        image = Image(values, affine, "float64", 2, "", "scene")
        frame = take_slice(image, plane="axial", position_mm=scene.position_mm)
        motion = scene_motion(scene, frame)
        grid = frame.origin, frame.spacing, frame.values.shape
        made = update(frame.values, covered(motion.rest, *grid), pull_back(motion.rest, motion.moved, *grid))
        yield scene, affine, frame, made


def _in_space(scene: Scene, plane) -> np.ndarray:
    """A plane map (2, 2) of the scene's axes as one (3, 3) in world RAS; the normal stays."""
    whole = np.eye(3)
    whole[:2, :2] = plane
    return scene.turn @ whole @ scene.turn.T


def _listed(matrix, places) -> np.ndarray:
    return np.array([matrix["xyz".index(i), "xyz".index(j)] for i, j in places])


def _nifti_of(path, components, affine, intent: int) -> None:
    """The same components in every voxel: 4-D, or 5-D with an intent."""
    shape = (*SHAPE, 1, len(components)) if intent else (*SHAPE, len(components))
    image = nibabel.Nifti1Image(np.broadcast_to(components, shape).astype(np.float32), affine)
    image.set_sform(affine, 1)
    image.header.set_intent(intent, (3,) if intent == 1005 else ())
    nibabel.save(image, path)


def _write_tensors(path, affine) -> None:
    """A NRRD as 3D Slicer's: LPS, and a measurement frame that is turned against it."""
    lps, frame = np.diag([-1.0, -1.0, 1.0]), OBLIQUE.turn
    words = ["(" + ",".join(f"{x:.17g}" for x in vector) + ")"
             for vector in (*(lps @ affine[:3]).T, *frame.T)]
    head = ["NRRD0005", "type: double", "dimension: 4", "space: left-posterior-superior",
            f"sizes: 6 {' '.join(map(str, SHAPE))}", f"space directions: none {' '.join(words[:3])}",
            "kinds: 3D-symmetric-matrix domain domain domain", "endian: little", "encoding: raw",
            f"space origin: {words[3]}", f"measurement frame: {' '.join(words[4:])}"]
    inside = frame.T @ lps @ TENSOR @ lps @ frame
    voxels = np.tile(_listed(inside, UPPER), np.prod(SHAPE))
    path.write_bytes("\n".join(head).encode() + b"\n\n" + voxels.astype("<f8").tobytes())


def _turned(what: str, path: Path, frame: Slice, made, kind: str, way: Way, wanted) -> None:
    """Whether a file is carried to the `wanted` vector (3,) or tensor (3, 3), RAS, as its program reads the result."""
    image = carry(read_companion(path, kind), frame, made, kind=kind, **way.said)
    values = np.asarray(image.dataobj, float)[frame.to_storage(made.pull_back.tissue)]
    values = values.reshape(len(values), -1)
    axes = way.axes(image.affine)
    if kind == "tensor":
        nine = [way.places.index(min(i + j, j + i)) for i in "xyz" for j in "xyz"]
        found = axes @ values[:, nine].reshape(-1, 3, 3) @ axes.T
    else:
        found = values @ axes.T
    agree(what, found, np.broadcast_to(wanted, found.shape), DIRECTION)
