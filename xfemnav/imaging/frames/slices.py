"""Slices and frames: the only file that knows RAS and LPS, voxel order and affines.

A slice is taken from an image in any storage order and turned to plane axes e1, e2: the array axes, ordered and signed
to be nearest to +R, +A, +S (axial R, A; coronal R, S; sagittal A, S). Plane coordinates of a world point p are
(p.e1, p.e2) mm. All 48 storage orders of one grid give the same slice; only what writes back to the file differs.

Voxel indices that a user gives (`index`, space 'voxel') count from 0 in the file's own storage order, as nibabel
and 3D Slicer show them. What is given in mm does not depend on the order.
"""

from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging.frames.grid import SAME_PIXEL, SKEW, Grid, at, by
from xfemnav.imaging.frames.volume import Volume, values_in
from xfemnav.imaging.reading.gate import Image
from xfemnav.imaging.reading.lean import nibabel
from xfemnav.imaging.reading.nifti_frames import OTHER, Frames, from_voxel, plain_header

PLANES = {"axial": (0, 1, 2), "coronal": (0, 2, 1), "sagittal": (1, 2, 0)}  # world axes (R A S) of e1, e2, normal
FLAT = 0.1  # mm off a plane up to which drawn points lie in it
BESIDE = 0.75  # pixels: an outline of pixels that touch the image's border lies nearer to it, any other one farther


@dataclass(frozen=True, eq=False)
class Slice:
    """One plane of an image, in plane coordinates.

    `values` (n1, n2) along e1 and e2; the centre of pixel (i, j) is `origin` + (i, j) * `spacing`, plane mm.
    `axes` (3, 3): rows e1, e2, normal, unit vectors in world RAS (in coronal slices the normal +A is -e1 x e2).
    `offset`: p.normal of the slice, mm. Its place in the file: `array_axes` along e1, e2, normal; `flipped` where the
    file counts e1 or e2 backwards; voxel `index` along the normal; `affine` (4, 4) voxel -> RAS mm, `frame_code`, and
    both `frames` of its header, where it may have two.
    """

    values: np.ndarray
    origin: np.ndarray
    spacing: np.ndarray
    axes: np.ndarray
    offset: float
    thickness: float
    plane: str
    array_axes: tuple[int, int, int]
    flipped: tuple[bool, bool]
    index: int
    affine: np.ndarray
    frame_code: int
    frames: Frames | None = None

    def __post_init__(self):
        shapes = {"values": (None, None), "origin": (2,), "spacing": (2,), "axes": (3, 3), "affine": (4, 4)}
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen_array(getattr(self, name), float, shape, name))

    def to_world(self, points) -> np.ndarray:
        """World RAS mm (n, 3) of plane points (n, 2)."""
        return np.asarray(points, float) @ self.axes[:2] + self.offset * self.axes[2]

    def from_world(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Plane points (n, 2) of world points (n, 3) RAS mm, and their signed distance (n,) mm along the normal."""
        along = np.asarray(points, float) @ self.axes.T
        return along[..., :2], along[..., 2] - self.offset

    def voxels_to_world(self, voxels) -> np.ndarray:
        """World RAS mm (n, 3) of file voxel indices, (n, 2) in this slice or (n, 3)."""
        voxels = np.asarray(voxels, float)
        if voxels.shape[-1] == 2:
            voxels = np.insert(voxels, self.array_axes[2], self.index, axis=-1)
        return voxels @ self.affine[:3, :3].T + self.affine[:3, 3]

    def pixel_centres(self) -> np.ndarray:
        """Plane mm (n1, n2, 2) of the pixel centres."""
        return self.origin + np.moveaxis(np.indices(self.values.shape), 0, -1) * self.spacing

    def border(self, mask) -> tuple | None:
        """Where the image ends inside the organ of a `mask` (n1, n2): the corners (low, high) of the pixels'
        rectangle, plane mm, and how far (mm) from its sides an outline lies on them; None when the mask does not touch
        them.
        """
        if not touching(mask, self.spacing):
            return None
        low = self.origin - self.spacing / 2
        high = low + self.spacing * self.values.shape
        return tuple(low.tolist()), tuple(high.tolist()), float(BESIDE * self.spacing.max())

    def to_storage(self, values) -> np.ndarray:
        """`values` (n1, n2, ...) on the slice's pixels, as an array of the file's order with one slice."""
        values = np.flip(values, [k for k in (0, 1) if self.flipped[k]])
        if self.array_axes[0] > self.array_axes[1]:
            values = values.swapaxes(0, 1)
        return np.expand_dims(values, self.array_axes[2])

    def header(self) -> nibabel.Nifti1Header:
        """A NIfTI header with the frames of the input, or twice the one that it has, of the one slice."""
        if self.frames is not None:
            return self.frames.header(self.array_axes[2], self.index)
        return plain_header(from_voxel(self.affine, self.array_axes[2], self.index), self.frame_code)

    def to_pixels(self, points) -> np.ndarray:
        """Pixel coordinates (n, 2) of plane points (n, 2)."""
        return (np.asarray(points, float) - self.origin) / self.spacing

    def padded(self, before, after) -> "Slice":
        """The slice with so many pixels (2,) of 0 more along e1 and e2, on either side."""
        affine = self.affine.copy()
        for k in (0, 1):
            affine[:3, 3] -= (after if self.flipped[k] else before)[k] * affine[:3, self.array_axes[k]]
        return replace(self, values=np.pad(self.values, np.column_stack([before, after])),
                       origin=self.origin - before * self.spacing, affine=affine, frames=None)

    @property
    def placed(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (3, 2) and shift (3,) that take plane points to the world."""
        return self.axes[:2].T, self.offset * self.axes[2]

    @property
    def corners(self) -> np.ndarray:
        """Centres (4, 2) of the pixels at the slice's corners, plane mm."""
        return self.pixel_centres()[[0, 0, -1, -1], [0, -1, 0, -1]]

    @property
    def lattice(self) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        """Where the pixels are: origin, spacing, and how many along e1 and e2."""
        return self.origin, self.spacing, self.values.shape


def touching(mask: np.ndarray, spacing) -> float:
    """Length, mm, along which a mask (n1, n2) touches the image's border."""
    ends = mask[[0, -1]].sum() * spacing[1] + mask[:, [0, -1]].sum() * spacing[0]
    return float(ends)


def take_slice(image: Image, *, plane: str | None = None, index: int | None = None,
               position_mm: float | None = None) -> Slice:
    """The slice of `image` at voxel `index` along the plane's array axis, or the one nearest to `position_mm`.

    An image with one slice takes its own plane; a volume is axial unless `plane` says otherwise. Raises E120 when the
    slice is not determined or not there, E105 when it is a line of pixels, E111 when it is sheared.
    """
    columns = image.affine[:3, :3]
    sizes = np.linalg.norm(columns, axis=0)
    directions = columns / sizes
    nearest = max(permutations(range(3)), key=lambda order: abs(directions[range(3), order]).sum())
    plane = _plane(image, nearest, plane)
    world_axes = PLANES[plane]
    a1, a2, a3 = (nearest[axis] for axis in world_axes)

    backwards = [bool(directions[axis, nearest[axis]] < 0) for axis in world_axes[:2]]
    e1, e2 = ((-1) ** back * directions[:, a] for back, a in zip(backwards, (a1, a2)))
    e1, e2 = _perpendicular(e1, e2, image.name)
    normal = np.cross(e1, e2)
    normal = normal / np.linalg.norm(normal) * np.copysign(1, normal[world_axes[2]])

    step = columns[:, a3] @ normal
    offsets = image.affine[:3, 3] @ normal + step * np.arange(image.values.shape[a3])
    index = _index(image.name, plane, offsets, abs(step), index, position_mm)
    values = image.values.transpose(a1, a2, a3)[:, :, index]
    corner = np.zeros(3)
    corner[[a1, a2, a3]] = [(n - 1) * back for n, back in zip(values.shape, backwards)] + [index]
    first = columns @ corner + image.affine[:3, 3]
    return Slice(np.flip(values, [k for k in (0, 1) if backwards[k]]), [e1 @ first, e2 @ first], sizes[[a1, a2]],
                 [e1, e2, normal], float(normal @ first), abs(float(step)), plane, (a1, a2, a3), tuple(backwards),
                 index, image.affine, image.frame_code, image.frames)


def _plane(image: Image, nearest, plane: str | None) -> str:
    """The name of the plane to take; `nearest` (3,) is the array axis nearest to each world axis."""
    shape = image.values.shape
    single = [name for name, world_axes in PLANES.items() if shape[nearest[world_axes[2]]] == 1]
    if len(single) > 1:
        raise XfemnavError("E105", f"{image.name} is a line of {by(shape)} voxels, not a slice.")
    if plane is not None and single and plane != single[0]:
        raise XfemnavError("E120", f"{image.name} is one {single[0]} slice, no {plane} one; leave out ⟦plane⟧.")
    return plane or (single[0] if single else "axial")


def _perpendicular(e1, e2, name: str):
    """e1 and e2 turned towards each other alike until they are perpendicular, when rounding is all that is wrong."""
    skew = e1 @ e2
    if abs(skew) > SKEW:
        raise XfemnavError("E111", f"the pixels of {name} are sheared: its in-plane axes meet at "
                                   f"{np.degrees(np.arccos(skew)):.2f} degrees. Resample it to right angles.")
    e1, e2 = e1 - skew / 2 * e2, e2 - skew / 2 * e1
    return e1 / np.linalg.norm(e1), e2 / np.linalg.norm(e2)


def _index(name: str, plane: str, offsets: np.ndarray, thickness: float, index, position_mm) -> int:
    """Voxel index of the slice that is asked for; slices lie at `offsets` (n,) mm along the normal."""
    n, low, high = len(offsets), offsets.min(), offsets.max()
    choices = f"⟦slice=0⟧ to {n - 1}, or ⟦slice_mm={low:.4g}⟧ to {high:.4g}"
    if index is None and position_mm is None:
        if n > 1:
            raise XfemnavError("E120", f"{name} has {n} {plane} slices; say which one: {choices}; or take the whole "
                                       "volume: ⟦dim=3⟧.")
        return 0
    if position_mm is not None:
        there = low - thickness / 2 <= position_mm <= high + thickness / 2
        # midway between two slices: the one further along the normal, in every storage order
        index = max(range(n), key=lambda k: (-round(abs(offsets[k] - position_mm), 9), offsets[k])) if there else -1
    if not 0 <= index < n:
        asked = f"at {position_mm} mm" if position_mm is not None else f"with index {index}"
        raise XfemnavError("E120", f"{name} has no {plane} slice {asked}: give {choices}.")
    return int(index)


def rows_of(points) -> np.ndarray:
    """Points (n, 2) plane mm or (n, 3) world RAS mm of a program's numbers; one point is a row. Raises E780."""
    try:
        rows = np.array(points, ndmin=2)
    except ValueError:  # rows of several lengths
        rows = np.empty((0, 0))
    if rows.dtype.kind not in "iuf" or rows.ndim != 2 or rows.shape[1] not in (2, 3):
        raise XfemnavError("E780", "points are numbers, (n, 2) plane mm or (n, 3) world RAS mm.")
    return rows.astype(float)


def mapped(slice: Slice, points, move) -> np.ndarray:
    """`points` as `move` maps those of a slice (n, 2), or of a Volume (n, 3), in their own form; world points keep
    their distance from a slice (W132). Raises E780."""
    rows, d = rows_of(points), 2 if slice is None else slice.values.ndim  # a session may have no image
    if rows.shape[1] < d:
        raise XfemnavError("E780", "points in a volume are world RAS mm, (n, 3).")
    if rows.shape[1] == d:
        return move(rows).reshape(np.shape(points))
    plane, distance = slice.from_world(rows)
    warn_of_slice(rows, "", slice)
    return (slice.to_world(move(plane)) + distance[:, None] * slice.axes[2]).reshape(np.shape(points))


def warn_of_slice(points, name: str, slice: Grid) -> None:
    """W132 where `points` (n, 3) RAS mm of a file, or of none (""), lie off the slice."""
    distance = np.abs(slice.from_world(points)[1])
    off = distance > slice.thickness / 2 * (1 + 1e-6)
    if off.any():
        warn("W132", f"{off.sum()} of {len(off)} points{name and f' of {name}'} lie off the slice, up to "
                     f"{distance.max():.2f} mm where half its thickness is {slice.thickness / 2:.2f} mm. They were "
                     "moved as its tissue.")


def plane_points(slice: Slice, points, space: str = "ras") -> np.ndarray:
    """Plane mm (n, 2) of a user's `points`, read in `space` ras, lps or voxel.

    Two numbers are plane mm (in LPS the axes R and A count the other way, S does not) or in-plane voxel indices; three
    are world mm or voxel indices. Raises E307 for a point more than half a slice off the plane, E780 for no points.
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not np.isfinite(points).all():
        raise XfemnavError("E780", f"points are rows of 2 or 3 finite numbers; got an array of shape {points.shape}.")
    if points.shape[1] == 2 and space != "voxel":
        return points * [-1.0 if space == "lps" and axis < 2 else 1.0 for axis in PLANES[slice.plane][:2]]
    world = slice.voxels_to_world(points) if space == "voxel" else points * ([-1, -1, 1] if space == "lps" else 1)
    plane, distance = slice.from_world(world)
    worst = int(np.argmax(abs(distance)))
    if abs(distance[worst]) > slice.thickness / 2 * (1 + 1e-6):
        raise XfemnavError("E307", f"point {worst + 1} at {points[worst].tolist()} is {distance[worst]:.2f} mm off the "
                                   f"{slice.plane} slice at {slice.offset:.2f} mm, over half its thickness "
                                   f"({slice.thickness / 2:.2f} mm). {_where_it_lies(slice, world, distance)}")
    return plane


def _where_it_lies(slice: Slice, world, distance) -> str:
    """What to do about points, (n, 3) RAS mm, that are at `distance` (n,) mm from the slice."""
    low, high, thickness = distance.min(), distance.max(), slice.thickness
    steps = thickness * np.rint((low + high) / 2 / thickness)
    if max(high - steps, steps - low) <= thickness / 2 * (1 + 1e-6):
        return f"Choose the slice that holds it: ⟦slice_mm={slice.offset + steps:.4g}⟧."
    flat = [name for name, axes in PLANES.items() if np.ptp(world[:, axes[2]]) < FLAT]
    own = slice.plane if slice.plane in flat or not flat else flat[0]
    if flat:
        tilt = np.degrees(np.arccos(min(abs(slice.axes[2, PLANES[own][2]]), 1)))
        how = f"they lie in one {own} plane of the patient, which is at {tilt:.1f} degrees to the slices"
    else:
        how = f"they run at up to {_steepest(slice, world):.1f} degrees to the slices"
    return (f"No slice holds all points: they span {high - low:.2f} mm across slices of {thickness:.2f} mm, since "
            f"{how}. Draw them in the image's own {slice.plane} slice: in 3D Slicer, 'Rotate to volume plane'.")


def _steepest(slice: Slice, world) -> float:
    """Angle in degrees between the slices and the plane, or line, that goes best through points (n, 3) RAS mm."""
    _, sizes, directions = np.linalg.svd(world - world.mean(axis=0), full_matrices=True)
    sizes = np.append(sizes, np.zeros(3 - len(sizes)))
    if sizes[1] > FLAT:
        return float(np.degrees(np.arccos(min(abs(directions[2] @ slice.axes[2]), 1))))
    return float(np.degrees(np.arcsin(min(abs(directions[0] @ slice.axes[2]), 1))))


def to_nifti(frame: Grid, values, dtype=np.float32) -> nibabel.Nifti1Image:
    """`values` (n1, ...) as a 3-D image, of one slice or many, on the input's grid and in its storage order.

    It has both frames of the input's header, so that it lies on the input whichever of them a program takes.
    """
    data = frame.to_storage(np.asarray(values)).astype(dtype)
    header = frame.header()
    header.set_data_dtype(dtype)
    header.set_xyzt_units("mm")
    return nibabel.Nifti1Image(data, header.get_best_affine(), header)


def values_on(image: Image, like: Slice | Volume, *, resample: str | None = None) -> np.ndarray:
    """Values (n1, ...) of `image`, a slice or a volume in any storage order, at the pixels of `like`.

    Raises E204 when its grid is another one and `resample` is not "nearest" or "linear" (zero outside the image).
    """
    if isinstance(like, Volume):
        return values_in(image, like, resample=resample)
    to_voxels = np.linalg.inv(image.affine)
    voxels = like.to_world(like.pixel_centres()) @ to_voxels[:3, :3].T + to_voxels[:3, 3]
    nearest = np.rint(voxels).astype(int)
    if resample is None and not _same_grid(voxels, nearest, image):
        size, first = np.linalg.norm(image.affine[:3, :3], axis=0), image.affine[:3, 3]
        raise XfemnavError("E204", f"grids differ: {image.name} has {by(image.values.shape)} voxels of {by(size)} mm,"
                                   f" the first at ({at(first)}); the slice has {by(like.values.shape)} pixels of "
                                   f"{by(like.spacing)} mm, the first at ({at(like.to_world(like.origin))}). "
                                   f"{_by_other_frames(image, like)}Resample it, or give ⟦resample_mask=True⟧.")
    if resample is None:
        return image.values[tuple(np.moveaxis(nearest, -1, 0))]
    from scipy.ndimage import map_coordinates

    inside = ((nearest >= 0) & (nearest < image.values.shape)).all(axis=-1)
    values = map_coordinates(image.values, np.moveaxis(voxels if resample == "linear" else nearest, -1, 0),
                             order=1 if resample == "linear" else 0, mode="nearest")
    return np.where(inside, values, 0.0)


def _by_other_frames(image: Image, like: Slice) -> str:
    """A hint where the grids are one when a frame of the headers is taken that was not: "" for none."""
    places = like.to_world(like.pixel_centres())
    for wanted in OTHER:
        affine, own = (item.affine if item.frames is None else item.frames.affine(wanted) for item in (image, like))
        if affine is not None and own is not None:
            matrix = np.linalg.inv(affine) @ own @ np.linalg.inv(like.affine)
            voxels = places @ matrix[:3, :3].T + matrix[:3, 3]
            if _same_grid(voxels, np.rint(voxels).astype(int), image):
                return f"By the {wanted} of their headers they are one grid: ⟦nifti_frame={wanted}⟧. "
    return ""


def _same_grid(voxels: np.ndarray, nearest: np.ndarray, image: Image) -> bool:
    """Whether the pixels at `voxels` (n1, n2, 3) are those of one whole slice of `image`."""
    shape = image.values.shape
    along = [int(np.argmax(abs(step - nearest[0, 0]))) for step in (nearest[1, 0], nearest[0, 1])]
    return bool(abs(voxels - nearest).max() < SAME_PIXEL and ((nearest >= 0) & (nearest < shape)).all()
                and tuple(shape[axis] for axis in along) == voxels.shape[:2])
