"""Companions: other images of the preoperative patient, carried through the same map as the image itself.

A companion has a grid of its own: a 3 mm functional map, a 1 mm label map, another stack of slices, one slice. Each
pixel of the run's slice knows where its tissue rested; that place, in world mm and then in the companion's voxels, is
where the companion is sampled, once. The resting places are computed once a run, and one matrix takes them to voxels.
"""

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging import tensors
from xfemnav.imaging.reading import Components, Image
from xfemnav.imaging.slices import Slice, to_nifti
from xfemnav.imaging.voxels import sample_volume
from xfemnav.imaging.warp import Update

COMPONENTS = {"continuous": None, "label": 1, "vector": 3, "tensor": 6}  # kind: values a voxel, None for any
UNSEEN = 0.01  # part of the tissue that a companion may miss without a warning


def carry(companion: Image | Components, frame: Slice, update: Update, *, kind: str, interp: str = "linear",
          outside: str = "keep", fill: float = 0.0, axes: str = "world"):
    """The `companion` after the motion of `update`, a nibabel image on the grid of `frame` and in its storage order.

    `kind` says what the values are. "continuous": float32, by `interp` linear, cubic or nearest. "label": nearest, in
    the companion's own integer type, so that no label is new. "vector": interpolated, then turned by the rotation of
    the tissue. "tensor" (symmetric): interpolated component by component, then turned by preservation of principal
    direction. Pixels with neither organ nor tissue keep the companion's value at their place, or get 0 with
    `outside="zero"`; the organ's pixels without tissue get `fill`; 0 where the companion has no voxel.

    `axes` are those of vectors and tensors, in the file and in the result: "world" (RAS; LPS with the NIfTI intents
    1005 and 1007) or "image" (FSL's: the file's array axes, the first one reversed where they are right-handed). The
    result has the companion's intent and order of components. Raises E130 (off the slice), E131 (not of its kind);
    warns W130.
    """
    values = _values(companion, kind)
    pull = update.pull_back
    empty = update.cavity | update.vacated
    wanted = ~empty if outside == "keep" else pull.tissue
    carried = _resampled(values, companion, frame, pull, wanted, "nearest" if kind == "label" else interp)
    if kind in ("vector", "tensor"):
        carried = _turned(carried, companion, frame, pull, kind, axes)
    dtype = _label_type(carried, companion) if kind == "label" else np.dtype(np.float32)
    carried = carried.astype(dtype)
    np.copyto(carried, np.array(fill).astype(dtype), where=empty[..., None])
    return _image(carried, frame, companion, dtype)


def _values(companion, kind: str) -> np.ndarray:
    """Values (ni, nj, nk, nc) of a companion of this kind. Raises E131."""
    values = companion.values.reshape(*companion.values.shape[:3], -1)
    wanted = COMPONENTS[kind]
    if wanted is not None and values.shape[3] != wanted:
        raise XfemnavError("E131", f"{companion.name} has {values.shape[3]} values a voxel, a {kind} image has "
                                   f"{wanted}. Say what it is: {', '.join(COMPONENTS)}.")
    return values


def _to_voxels(companion, frame: Slice) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (3, 2) and shift (3,) from plane mm of `frame` to the companion's voxels."""
    inverse = np.linalg.inv(companion.affine)
    return inverse[:3, :3] @ frame.axes[:2].T, inverse[:3, :3] @ (frame.offset * frame.axes[2]) + inverse[:3, 3]


def _resampled(values, companion, frame: Slice, pull, wanted, interp: str) -> np.ndarray:
    """Values (n1, n2, nc) at the `wanted` (n1, n2) places of `pull`, else 0. Raises E130, warns W130."""
    matrix, shift = _to_voxels(companion, frame)
    _check_distance(companion, frame, pull, matrix, shift)
    out, seen = sample_volume(values, matrix, shift, pull.places.reshape(-1, 2), wanted.reshape(-1), interp)
    missed = pull.tissue & ~seen.reshape(pull.tissue.shape)
    if missed.any():
        _report_missed(companion, pull, missed, matrix, shift)
    return out.reshape(*pull.tissue.shape, -1)


def _spacing(companion) -> np.ndarray:
    """Distance (3,) mm between the companion's voxel planes along each array axis."""
    return 1 / np.linalg.norm(np.linalg.inv(companion.affine)[:3, :3], axis=1)


def _check_distance(companion, frame: Slice, pull, matrix, shift) -> None:
    """E130 when the one slice of a companion is farther off the tissue than both slices are thick."""
    thickness = _spacing(companion)
    for axis in np.flatnonzero(np.array(companion.values.shape[:3]) == 1):
        # the farthest place of a box is a corner of it
        distance = thickness[axis] * abs(pull.box @ matrix[axis] + shift[axis]).max(initial=0)
        limit = (thickness[axis] + frame.thickness) / 2
        if distance > limit * (1 + 1e-6):
            raise XfemnavError("E130", f"{companion.name} is one slice, up to {distance:.2f} mm off the run's, over "
                                       f"the {limit:.2f} mm that both are thick by half. Give the companion's slice at "
                                       "this place, or its whole volume.")


def _report_missed(companion, pull, missed, matrix, shift) -> None:
    """W130 when the companion has no voxel for a part of the tissue, E130 when it has none for any."""
    part = missed.sum() / pull.tissue.sum()
    if part == 1:
        voxels = pull.resting[pull.tissue] @ matrix.T + shift
        beyond = np.maximum(np.maximum(-0.5 - voxels, voxels + 0.5 - companion.values.shape[:3]), 0)
        distance = np.linalg.norm(beyond * _spacing(companion), axis=1).min()
        raise XfemnavError("E130", f"{companion.name} ends {distance:.2f} mm from the tissue of the slice. Check its "
                                   "affine: it must lie with the preoperative image in world mm.")
    if part > UNSEEN:
        warn("W130", f"{companion.name} has no voxels for {part:.0%} of the tissue; its values are 0 there.")


def _turned(carried, companion, frame: Slice, pull, kind: str, axes: str) -> np.ndarray:
    """Vectors (n1, n2, 3) or tensors (n1, n2, 6) turned with the tissue, and from the companion's axes to the result's.

    The deformation is that of the triangle that each pixel came from; the slice's normal stays as it is.
    """
    intent = getattr(companion, "intent", 0)
    from_file, to_file = (tensors.world_axes(affine, intent, axes) for affine in (companion.affine, frame.affine))
    tissue = pull.tissue
    F = pull.F[pull.triangle[tissue]]
    if kind == "vector":
        world = carried @ from_file.T
        R = tensors.in_space(tensors.rotations(F), frame.axes)
        world[tissue] = np.einsum("nij,nj->ni", R, world[tissue])
        return world @ to_file
    world = from_file @ tensors.matrices(carried, intent) @ from_file.T
    world[tissue] = tensors.reoriented(world[tissue], tensors.in_space(F, frame.axes))
    return tensors.components(to_file.T @ world @ to_file, intent)


def _label_type(carried, companion) -> np.dtype:
    """The integer type of a label map: its own, or int32 or int64 for one that is stored as floats or with a scale."""
    odd = carried[carried != np.rint(carried)]
    if odd.size:
        raise XfemnavError("E131", f"{companion.name} holds {odd[0]:g}: labels are whole numbers. If its values are "
                                   "measured ones, its kind is continuous.")
    low, high = carried.min(), carried.max()
    own = [np.dtype(companion.dtype).newbyteorder("=")] if np.dtype(companion.dtype).kind in "iu" else []
    for dtype in (*own, np.dtype(np.int32)):
        if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
            return dtype
    return np.dtype(np.int64)


def _image(carried, frame: Slice, companion, dtype):
    """`carried` (n1, n2, nc) as NIfTI with the axes of the companion's own: 3, 4, or 5 with an intent."""
    like, intent = to_nifti(frame, np.zeros(frame.values.shape), np.uint8), getattr(companion, "intent", 0)
    data = frame.to_storage(carried)
    if companion.values.ndim == 3:
        data = data[..., 0]
    elif intent:
        data = data[..., None, :]
    like.header.set_data_dtype(dtype)
    image = type(like)(data, like.affine, like.header)
    if intent:
        image.header.set_intent(intent, (3,) if intent == tensors.SYMMETRIC else (), allow_unknown=True)
    return image
