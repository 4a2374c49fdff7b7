"""Companions: other images of the preoperative patient, carried through the same map as the image itself.

A companion has a grid of its own: a 3 mm functional map, a 1 mm label map, another stack of slices, one slice. Each
pixel of the run's slice or volume knows where its tissue rested; that place, in world mm and then in the companion's
voxels, is where the companion is sampled, once. The motion is computed once a run, and one matrix takes its places to
voxels, a part of the rows after the other.
"""

from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.carrying import tensors
from xfemnav.imaging.carrying.background import background, corner_values, storable, warn_of_blank
from xfemnav.imaging.carrying.lattice import slabs
from xfemnav.imaging.carrying.solid import SolidPullBack
from xfemnav.imaging.carrying.voxels import sample_volume
from xfemnav.imaging.carrying.warp import PullBack, Update
from xfemnav.imaging.frames.grid import Grid
from xfemnav.imaging.frames.slices import to_nifti
from xfemnav.imaging.reading.conventions import DIRECTED, ORDERS, Convention, convention, six
from xfemnav.imaging.reading.formats import RAS
from xfemnav.imaging.reading.gate import Components, Image
from xfemnav.imaging.reading.nifti import SYMMETRIC
from xfemnav.limits import NEGATIVE_TENSORS, SHORT, SHRUNK_VECTORS

KINDS = ("continuous", "label", "vector", "axis", "tensor")
ENOUGH = 1 << 19  # tensors that tell what order they are in: more than a slice has
UNSEEN = 0.01  # part of the tissue that a companion may miss without a warning
ROUNDED = 1e-6  # of the largest eigenvalue: how negative float32 makes one that is 0
VECTOR_INTENTS = range(1004, 1012)  # NIfTI's for several values a voxel, which stand along its fifth axis


def carry(companion: Image | Components, frame: Grid, update: Update, *, kind: str, interp: str = "linear",
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
        carried, seen = _directed(given, values, wanted, kind, how)
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
    return _image(carried, frame, companion, dtype, getattr(companion, "intent", 0), about)


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
    frame: Grid
    pull: PullBack | SolidPullBack
    interp: str

    @property
    def to_voxels(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (3, d) and shift (3,) from mm of the frame to the companion's voxels."""
        inverse, (axes, first) = np.linalg.inv(self.companion.affine), self.frame.placed
        return inverse[:3, :3] @ axes, inverse[:3, :3] @ first + inverse[:3, 3]

    def sampled(self, values, wanted, interp: str, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """`values` (ni, nj, nk, nc) at the `wanted` (m, ...) places of the motion, those of the rows from `first` on,
        else 0: (m, ..., nc), and where there was a voxel (m, ...)."""
        out, seen = np.zeros((*wanted.shape, values.shape[3])), np.ones(wanted.shape, bool)
        for rows in slabs(wanted.shape):
            part = wanted[rows]
            places = self.pull.places_of(part, first + rows.start)
            out[rows][part], seen[rows][part] = sample_volume(values, *self.to_voxels, places, interp)
        return out, seen

    def part(self, values) -> np.ndarray:
        """The part of `values` (ni, nj, nk, nc) that the frame runs through: a slice where it is one of the grid's."""
        matrix, shift = self.to_voxels
        ends = self.frame.corners @ matrix.T + shift
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
        voxels = pull.places_of(pull.tissue) @ matrix.T + shift
        beyond = np.maximum(np.maximum(-0.5 - voxels, voxels + 0.5 - companion.values.shape[:3]), 0)
        distance = np.linalg.norm(beyond * _spacing(companion), axis=1).min()
        raise XfemnavError("E130", f"{companion.name} ends {distance:.2f} mm from the run's tissue. Check its "
                                   "affine: it must lie with the preoperative image in world mm.")
    if part > UNSEEN:
        warn("W130", f"{companion.name} has no voxels for {part:.0%} of the tissue, which gets the value of pixels "
                     "without tissue.")


def _directed(given, values, wanted, kind: str, how: Convention):
    """Vectors, axes or tensors (n1, ..., nc) after the motion, float32, and where there were voxels (n1, ...).

    Part by part of the rows: what is known of each pixel meanwhile takes a hundred times as much as its value.
    """
    turned = {"vector": _vectors, "axis": _axes, "tensor": _tensors}[kind]
    source = values
    if kind == "vector":
        source = np.concatenate([values, np.linalg.norm(values, axis=3, keepdims=True)], axis=3)
    elif kind == "axis":
        source = tensors.dyads(values @ how.from_file.T, ORDERS["fsl"])
    if kind == "tensor":
        _warn_of_order(given, values, how.order_in)
    carried, seen = np.zeros((*wanted.shape, values.shape[3]), np.float32), np.ones(wanted.shape, bool)
    short = np.zeros(2, int)
    for rows in slabs(wanted.shape):
        part = _Part(given, values, source, wanted[rows], rows.start)
        carried[rows], seen[rows] = turned(part, how, short)
    if kind == "vector":
        _warn_of_short(given, *short)
    return carried, seen


class _Part(NamedTuple):
    """The rows from `first` on of what is carried: its `values` (ni, nj, nk, nc), and the `source` of what is
    interpolated (vectors and their lengths, axes' dyads, tensors), at the `wanted` (m, ...) pixels."""

    given: _Given
    values: np.ndarray
    source: np.ndarray
    wanted: np.ndarray
    first: int

    @property
    def tissue(self) -> np.ndarray:
        """Pixels (m, ...) with tissue in them."""
        return self.given.pull.tissue[self.first:self.first + len(self.wanted)]

    def sampled(self, values, interp: str):
        """As `_Given.sampled`."""
        return self.given.sampled(values, self.wanted, interp, self.first)

    def of_tissue(self, each) -> np.ndarray:
        """What is so `each` simplex (t, d, d), of every tissue pixel, in the world (n, 3, 3)."""
        simplex = self.given.pull.simplices_of(self.tissue, self.first)
        used, inverse = np.unique(simplex, return_inverse=True)
        return tensors.in_space(each(self.given.pull.F[used]), self.given.frame.axes)[inverse]


def _vectors(part, how: Convention, short):
    """Vectors (m, ..., 3) after the motion, and where there were voxels (m, ...); adds to `short` (2,) how many are
    shorter than their neighbours, of how many."""
    carried, seen = part.sampled(part.source, part.given.interp)
    carried, length = carried[..., :3], carried[..., 3]
    there = part.tissue & (length > 0)
    short += (np.linalg.norm(carried, axis=-1)[there] < SHORT.value * length[there]).sum(), there.sum()
    tissue, world = part.tissue, carried @ how.from_file.T
    world[tissue] = np.einsum("nij,nj->ni", _rotations(part), world[tissue])
    return world @ how.to_file, seen


def _warn_of_short(given, short: int, whole: int) -> None:
    """W134 where many of the interpolated vectors are shorter than their neighbours are."""
    share = 100 * short / max(whole, 1)
    if share > SHRUNK_VECTORS.value:
        warn("W134", f"{share:.0f} % of the vectors of {given.companion.name} in the organ are shorter than "
                     f"{SHORT.value:g} of their neighbours, which point elsewhere. If they are axes, whose sign means "
                     "nothing (FSL's V1), give the kind axis.")


def _axes(part, how: Convention, _):
    """Unit vectors (m, ..., 3) along axes after the motion, 0 where the nearest voxel is 0, and where there were
    voxels. The dyad e e^T knows no sign; the sign of the nearest voxel keeps neighbours alike."""
    dyads, seen = part.sampled(part.source, part.given.interp)
    nearest, _ = part.sampled(part.values, "nearest")
    world, tissue = nearest @ how.from_file.T, part.tissue
    there = world.any(axis=-1)
    D, R = tensors.matrices(dyads, ORDERS["fsl"]), np.tile(RAS, (*there.shape, 1, 1))
    R[tissue] = _rotations(part)
    e = tensors.principal(D[there])
    e *= np.where(np.einsum("ni,ni->n", e, world[there]) < 0, -1, 1)[:, None]
    world[there] = np.einsum("nij,nj->ni", R[there], e)
    return world @ how.to_file, seen


def _tensors(part, how: Convention, _):
    """Tensors (m, ..., 6) after the motion, and where there were voxels."""
    carried, seen = part.sampled(part.source, part.given.interp)
    tissue = part.tissue
    world = how.from_file @ tensors.matrices(carried, ORDERS[how.order_in]) @ how.from_file.T
    world[tissue] = tensors.reoriented(world[tissue], part.of_tissue(lambda F: F))
    return tensors.components(how.to_file.T @ world @ how.to_file, ORDERS[how.order_out]), seen


def _rotations(part) -> np.ndarray:
    """Rotation (n, 3, 3) of each tissue pixel, that of its simplex; a slice's normal stays as it is."""
    return part.of_tissue(tensors.rotations)


def _warn_of_order(given, values, order: str) -> None:
    """W133 when tensors, `values` (ni, nj, nk, 6), have negative eigenvalues in the order taken: of at most ENOUGH."""
    looked_at = np.zeros(given.pull.tissue.size, bool)
    tissue = np.flatnonzero(given.pull.tissue)
    looked_at[tissue[::len(tissue) // ENOUGH + 1]] = True
    looked_at = looked_at.reshape(given.pull.tissue.shape)
    own = given.sampled(values, looked_at, "nearest")[0][looked_at]
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
    odd = np.concatenate([row[row != np.rint(row)] for row in carried])    # row by row: volumes are large
    if odd.size:
        raise XfemnavError("E131", f"{companion.name} holds {odd[0]:g}: labels are whole numbers. If its values are "
                                   "measured ones, its kind is continuous.")
    low, high = carried.min(), carried.max()
    own = [np.dtype(companion.dtype).newbyteorder("=")] if np.dtype(companion.dtype).kind in "iu" else []
    for dtype in (*own, np.dtype(np.int32)):
        if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
            return dtype
    return np.dtype(np.int64)


def _image(carried, frame: Grid, companion, dtype, intent: int, about: dict):
    """`carried` (n1, ..., nc) as NIfTI with as many axes as its intent wants: 3, 4, or 5; `about` is its `extra`."""
    like = to_nifti(frame, np.zeros(frame.values.shape, np.uint8), np.uint8)
    data = frame.to_storage(carried.astype(dtype, copy=False))
    if companion.values.ndim == 3:
        data = data[..., 0]
    elif intent in VECTOR_INTENTS:
        data = data[..., None, :]
    like.header.set_data_dtype(dtype)
    image = type(like)(data, like.affine, like.header, extra=about)
    if companion.values.ndim > 3 and intent:
        image.header.set_intent(intent, (3,) if intent == SYMMETRIC else (), allow_unknown=True)
    return image
