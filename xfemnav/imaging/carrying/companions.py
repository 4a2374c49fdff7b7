"""Companions: other images of the preoperative patient, carried through the same map as the image itself.

A companion has a grid of its own: a 3 mm functional map, a 1 mm label map, another stack of slices, one slice. Each
pixel of the run's slice knows where its tissue rested; that place, in world mm and then in the companion's voxels, is
where the companion is sampled, once. The resting places are computed once a run, and one matrix takes them to voxels.
"""

from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.carrying import tensors
from xfemnav.imaging.carrying.background import background, corner_values, storable, warn_of_blank
from xfemnav.imaging.carrying.voxels import sample_volume
from xfemnav.imaging.carrying.warp import PullBack, Update
from xfemnav.imaging.frames.slices import Slice, to_nifti
from xfemnav.imaging.reading.conventions import DIRECTED, ORDERS, Convention, convention, six
from xfemnav.imaging.reading.formats import RAS
from xfemnav.imaging.reading.gate import Components, Image
from xfemnav.imaging.reading.nifti import SYMMETRIC
from xfemnav.limits import NEGATIVE_TENSORS, SHORT, SHRUNK_VECTORS

KINDS = ("continuous", "label", "vector", "axis", "tensor")
UNSEEN = 0.01  # part of the tissue that a companion may miss without a warning
ROUNDED = 1e-6  # of the largest eigenvalue: how negative float32 makes one that is 0
VECTOR_INTENTS = range(1004, 1012)  # NIfTI's for several values a voxel, which stand along its fifth axis


def carry(companion: Image | Components, frame: Slice, update: Update, *, kind: str, interp: str = "linear",
          outside: str = "keep", fill: float | None = None, axes: str = "file", order: str | None = None):
    """The `companion` after the motion of `update`, a nibabel image on the grid of `frame` and in its storage order.

    `kind` says what the values are. "continuous": float32, by `interp` linear, cubic or nearest. "label": nearest, in
    the companion's own integer type, so that no label is new. "vector": interpolated, then turned by the rotation of
    the tissue. "axis": a unit vector without a sign: its dyad is interpolated and turned, and the sign is that of the
    nearest voxel. "tensor" (symmetric): interpolated component by component, then turned by preservation of principal
    direction. Pixels with neither organ nor tissue keep the companion's value at their place, or get 0 with
    `outside="zero"`; the organ's pixels without tissue, and those for which the companion has no voxel, get `fill`: by
    default the companion's own background, and 0 of labels and of what turns.

    `axes` and `order` of vectors, axes and tensors are those of `convention`, for reading and for the result, whose
    intent is the companion's. The result's `extra` says in words how it was made. Raises E130 (off the slice), E131
    (not of its kind, or without axes); warns W130, W133, W134, W211.
    """
    if kind not in KINDS:
        raise XfemnavError("E780", f"no kind {kind!r}: wanted one of {', '.join(KINDS)}.")
    given = _Given(companion, frame, update.pull_back, interp)
    _check_distance(given)
    values, empty = _values(companion, kind), update.cavity | update.vacated
    wanted = ~empty if outside == "keep" else update.pull_back.tissue
    if kind in DIRECTED:
        how = convention(companion, frame.affine, tensors=kind == "tensor", axes=axes, order=order)
        carried, seen = {"vector": _vectors, "axis": _axes, "tensor": _tensors}[kind](given, values, wanted, how)
        about = {"Kind": kind, "Fill": 0.0, "VectorFrame": how.frame}
        if kind == "tensor":
            about["TensorOrder"] = ["".join(sorted("xyz"[i] + "xyz"[j])) for i, j in ORDERS[how.order_out]]
        _check_seen(given, seen)
        carried[empty] = 0
        return _image(carried, frame, companion, np.dtype(np.float32), how.intent, about)
    carried, seen = given.sampled(values, wanted, "nearest" if kind == "label" else interp)
    _check_seen(given, seen)
    blank = _blank(given, values, carried, seen, kind, fill, outside)
    np.copyto(carried, blank, where=(empty | (wanted & ~seen))[..., None])
    dtype = _label_type(carried, companion) if kind == "label" else np.dtype(np.float32)
    about = {"Kind": kind, "Fill": blank[0].item() if len(blank) == 1 else blank.tolist()}
    return _image(carried.astype(dtype), frame, companion, dtype, getattr(companion, "intent", 0), about)


def _values(companion, kind: str) -> np.ndarray:
    """Values (ni, nj, nk, nc) of a companion of this kind. Raises E131."""
    values = companion.values.reshape(*companion.values.shape[:3], -1)
    if kind == "tensor" and values.shape[3] != 1:
        return six(companion)
    wanted = {"continuous": values.shape[3], "label": 1, "tensor": 6}.get(kind, 3)
    if values.shape[3] != wanted:
        raise XfemnavError("E131", f"{companion.name} has {values.shape[3]} values a voxel, a {kind} image has "
                                   f"{wanted}. Say what it is: {', '.join(KINDS)}.")
    return values


def _blank(given, values, carried, seen, kind: str, fill: float | None, outside: str) -> np.ndarray:
    """The value (nc,) of each volume for pixels without tissue. Raises E131, E780, warns W211."""
    fill = None if fill is None else storable(fill)
    if kind == "label":
        if fill is not None and not (fill == int(fill) and abs(fill) < 2**31):
            raise XfemnavError("E131", f"{given.companion.name} holds labels, and fill {fill:g} can be none. Leave it "
                                       "out: labels then get 0, and each image its own background.")
        return np.array([0.0 if fill is None else fill])
    companion, tissue = given.companion, carried[given.pull.tissue & seen]
    corners = [corner_values(part) for part in np.moveaxis(given.part(values), -1, 0)]
    blank = [background(*each) if fill is None else fill for each in zip(corners, tissue.T)]
    for value, found, at_corner in zip(blank, tissue.T, corners):
        # 0 about a map of differences or scores is both its background and a value of tissue: that is no doubt
        if fill is not None or outside == "zero" or (len(at_corner) and at_corner.any()):
            warn_of_blank(value, found, companion.name, given=fill is not None, outside=outside)
    return np.array(blank)


class _Given(NamedTuple):
    """What is carried along with which motion: where its values are asked for."""

    companion: Image | Components
    frame: Slice
    pull: PullBack
    interp: str

    @property
    def to_voxels(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (3, 2) and shift (3,) from plane mm of the frame to the companion's voxels."""
        inverse, frame = np.linalg.inv(self.companion.affine), self.frame
        return inverse[:3, :3] @ frame.axes[:2].T, inverse[:3, :3] @ (frame.offset * frame.axes[2]) + inverse[:3, 3]

    def sampled(self, values, wanted, interp: str) -> tuple[np.ndarray, np.ndarray]:
        """`values` (ni, nj, nk, nc) at the `wanted` (n1, n2) places of the motion, else 0: (n1, n2, nc), and where
        there was a voxel (n1, n2)."""
        shape, (matrix, shift) = wanted.shape, self.to_voxels
        out, seen = sample_volume(values, matrix, shift, self.pull.places.reshape(-1, 2), wanted.reshape(-1), interp)
        return out.reshape(*shape, -1), seen.reshape(shape)

    def part(self, values) -> np.ndarray:
        """The part of `values` (ni, nj, nk, nc) that the frame runs through: a slice where it is one of the grid's."""
        matrix, shift = self.to_voxels
        ends = self.frame.pixel_centres()[[0, 0, -1, -1], [0, -1, 0, -1]] @ matrix.T + shift
        last = np.array(values.shape[:3]) - 1
        low, high = (np.clip(np.rint(found(ends, axis=0)), 0, last).astype(int) for found in (np.min, np.max))
        return values[tuple(slice(a, b + 1) for a, b in zip(low, high))]


def _spacing(companion) -> np.ndarray:
    """Distance (3,) mm between the companion's voxel planes along each array axis."""
    return 1 / np.linalg.norm(np.linalg.inv(companion.affine)[:3, :3], axis=1)


def _check_distance(given) -> None:
    """E130 when the one slice of a companion is farther off the tissue than both slices are thick."""
    companion, (matrix, shift) = given.companion, given.to_voxels
    thickness = _spacing(companion)
    for axis in np.flatnonzero(np.array(companion.values.shape[:3]) == 1):
        # the farthest place of a box is a corner of it
        distance = thickness[axis] * abs(given.pull.box @ matrix[axis] + shift[axis]).max(initial=0)
        limit = (thickness[axis] + given.frame.thickness) / 2
        if distance > limit * (1 + 1e-6):
            raise XfemnavError("E130", f"{companion.name} is one slice, up to {distance:.2f} mm off the run's, over "
                                       f"the {limit:.2f} mm that both are thick by half. Give the companion's slice at "
                                       "this place, or its whole volume.")


def _check_seen(given, seen) -> None:
    """W130 when the companion has no voxel for a part of the tissue, E130 when it has none for any."""
    companion, pull, (matrix, shift) = given.companion, given.pull, given.to_voxels
    part = (pull.tissue & ~seen).sum() / max(pull.tissue.sum(), 1)
    if part == 1:
        voxels = pull.resting[pull.tissue] @ matrix.T + shift
        beyond = np.maximum(np.maximum(-0.5 - voxels, voxels + 0.5 - companion.values.shape[:3]), 0)
        distance = np.linalg.norm(beyond * _spacing(companion), axis=1).min()
        raise XfemnavError("E130", f"{companion.name} ends {distance:.2f} mm from the tissue of the slice. Check its "
                                   "affine: it must lie with the preoperative image in world mm.")
    if part > UNSEEN:
        warn("W130", f"{companion.name} has no voxels for {part:.0%} of the tissue, which gets the value of pixels "
                     "without tissue.")


def _vectors(given, values, wanted, how: Convention):
    """Vectors (n1, n2, 3) after the motion, and where there were voxels (n1, n2); warns W134 of those that shrink."""
    lengths = np.linalg.norm(values, axis=3, keepdims=True)
    carried, seen = given.sampled(np.concatenate([values, lengths], axis=3), wanted, given.interp)
    carried, length = carried[..., :3], carried[..., 3]
    _warn_of_short(given, np.linalg.norm(carried, axis=2), length)
    tissue, world = given.pull.tissue, carried @ how.from_file.T
    world[tissue] = np.einsum("nij,nj->ni", _rotations(given), world[tissue])
    return world @ how.to_file, seen


def _warn_of_short(given, found, wanted) -> None:
    """W134 where interpolated vectors of length `found` (n1, n2) are shorter than their neighbours are, `wanted`."""
    there = given.pull.tissue & (wanted > 0)
    share = 100 * (found[there] < SHORT.value * wanted[there]).sum() / max(there.sum(), 1)
    if share > SHRUNK_VECTORS.value:
        warn("W134", f"{share:.0f} % of the vectors of {given.companion.name} in the organ are shorter than "
                     f"{SHORT.value:g} of their neighbours, which point elsewhere. If they are axes, whose sign means "
                     "nothing (FSL's V1), give the kind axis.")


def _axes(given, values, wanted, how: Convention):
    """Unit vectors (n1, n2, 3) along axes after the motion, 0 where the nearest voxel is 0, and where there were
    voxels. The dyad e e^T knows no sign; the sign of the nearest voxel keeps neighbours alike."""
    order = ORDERS["fsl"]
    dyads, seen = given.sampled(tensors.dyads(values @ how.from_file.T, order), wanted, given.interp)
    nearest, _ = given.sampled(values, wanted, "nearest")
    world, tissue = nearest @ how.from_file.T, given.pull.tissue
    there = world.any(axis=2)
    D, R = tensors.matrices(dyads, order), np.tile(RAS, (*there.shape, 1, 1))
    R[tissue] = _rotations(given)
    e = tensors.principal(D[there])
    e *= np.where(np.einsum("ni,ni->n", e, world[there]) < 0, -1, 1)[:, None]
    world[there] = np.einsum("nij,nj->ni", R[there], e)
    return world @ how.to_file, seen


def _tensors(given, values, wanted, how: Convention):
    """Tensors (n1, n2, 6) after the motion, and where there were voxels; warns W133 of another order."""
    _warn_of_order(given, values, how.order_in)
    carried, seen = given.sampled(values, wanted, given.interp)
    tissue, pull = given.pull.tissue, given.pull
    world = how.from_file @ tensors.matrices(carried, ORDERS[how.order_in]) @ how.from_file.T
    F = tensors.in_space(pull.F[pull.triangle[tissue]], given.frame.axes)
    world[tissue] = tensors.reoriented(world[tissue], F)
    return tensors.components(how.to_file.T @ world @ how.to_file, ORDERS[how.order_out]), seen


def _rotations(given) -> np.ndarray:
    """Rotation (n, 3, 3) of each tissue pixel, that of its triangle; the slice's normal stays as it is."""
    pull = given.pull
    return tensors.in_space(tensors.rotations(pull.F[pull.triangle[pull.tissue]]), given.frame.axes)


def _warn_of_order(given, values, order: str) -> None:
    """W133 when tensors, `values` (ni, nj, nk, 6), have negative eigenvalues in the order taken."""
    own, _ = given.sampled(values, given.pull.tissue, "nearest")
    own = own[given.pull.tissue]
    shares = {name: _negative(own, places) for name, places in ORDERS.items()}
    if shares[order] <= NEGATIVE_TENSORS.value:
        return
    least = min(shares.values())
    better = [name for name, share in shares.items() if share == least <= NEGATIVE_TENSORS.value]
    has = "none" if least == 0 else f"{least:.2g} %"
    advice = (f"Taken as {' or '.join(better)}, {has} has: ⟦tensor_order={better[0]}⟧." if better else
              "No order that xfemnav knows is better: are they tensors?")
    warn("W133", f"{shares[order]:.0f} % of the tensors of {given.companion.name} in the organ have a negative "
                 f"eigenvalue when their order is {order}'s. {advice}")


def _negative(values, places) -> float:
    """Share, %, of tensors (n, 6) in an order that have a negative eigenvalue, beyond rounding."""
    eigenvalues = np.linalg.eigvalsh(tensors.matrices(values, places))
    return 100 * float((eigenvalues[:, 0] < -ROUNDED * abs(eigenvalues).max(axis=1)).mean()) if len(values) else 0.0


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


def _image(carried, frame: Slice, companion, dtype, intent: int, about: dict):
    """`carried` (n1, n2, nc) as NIfTI with as many axes as its intent wants: 3, 4, or 5; `about` is its `extra`."""
    like = to_nifti(frame, np.zeros(frame.values.shape), np.uint8)
    data = frame.to_storage(carried.astype(dtype))
    if companion.values.ndim == 3:
        data = data[..., 0]
    elif intent in VECTOR_INTENTS:
        data = data[..., None, :]
    like.header.set_data_dtype(dtype)
    image = type(like)(data, like.affine, like.header, extra=about)
    if companion.values.ndim > 3 and intent:
        image.header.set_intent(intent, (3,) if intent == SYMMETRIC else (), allow_unknown=True)
    return image
