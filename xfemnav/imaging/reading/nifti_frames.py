"""The two frames of a NIfTI header: which one is read, which one other programs take, and how far apart they lie.

nibabel, and what is built on it, takes the sform wherever its code is not 0. ITK (3D Slicer, ANTs) takes it only for
code 1 or where the qform has none, and only when its axes are perpendicular; else the qform. The sizes of voxels are
to ITK always those that the header states beside the frames.
"""

from dataclasses import dataclass

import numpy as np

from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging.reading.lean import nibabel
from xfemnav.limits import APART

OTHER = {"sform": "qform", "qform": "sform"}
PERPENDICULAR = 1e-4  # entry of D D^T - 1, D the directions of the axes, from which on ITK takes no sform
ITK = "3D Slicer, ANTs and other programs built on ITK"


@dataclass(frozen=True, eq=False)
class Frames:
    """What a header says of the place of its voxels.

    `sform` and `qform` (4, 4) voxel -> RAS mm, None where the code is 0 or the frame cannot be used; the `codes` of
    both; `sizes` (3,) mm of the voxels (pixdim).
    """

    sform: np.ndarray | None
    qform: np.ndarray | None
    codes: tuple[int, int]
    sizes: np.ndarray

    def __post_init__(self):
        for name, shape in (("sform", (4, 4)), ("qform", (4, 4)), ("sizes", (3,))):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, frozen_array(value, float, shape, name))
        object.__setattr__(self, "codes", tuple(self.codes))

    @property
    def listed(self) -> dict:
        """The frames as plain numbers: `Frames(**listed)` has them again."""
        matrices = {name: None if (value := getattr(self, name)) is None else value.tolist() for name in OTHER}
        return {**matrices, "codes": list(self.codes), "sizes": self.sizes.tolist()}

    def taken(self, wanted: str = "auto") -> str:
        """Which one is read; see `chosen`."""
        return chosen(*self.codes, wanted)

    def affine(self, wanted: str = "auto") -> np.ndarray | None:
        """The one that is read, (4, 4) voxel -> RAS mm; None where it cannot be used."""
        return getattr(self, self.taken(wanted))

    def itk(self) -> tuple[str, np.ndarray | None]:
        """Which one programs built on ITK take, and where they put voxels by it (4, 4); None where they cannot."""
        sform, qform = self.codes
        if self.sform is not None and sform > 0 and (sform == 1 or qform <= 0):
            directions = self.sform[:3, :3] / np.linalg.norm(self.sform[:3, :3], axis=0)
            if abs(directions @ directions.T - np.eye(3)).max() < PERPENDICULAR:
                affine = self.sform.copy()
                affine[:3, :3] = directions * self.sizes
                return "sform", affine
        return "qform", self.qform

    def header(self, axis: int, index: int) -> nibabel.Nifti1Header:
        """A header with both frames and their codes, of the one slice at `index` along an array axis."""
        header = nibabel.Nifti1Header()
        if self.qform is not None:
            header.set_qform(from_voxel(self.qform, axis, index), 1)
        if self.sform is not None:
            header.set_sform(from_voxel(self.sform, axis, index), 1)
        header["pixdim"][1:4] = self.sizes
        for name, code in zip(OTHER, self.codes):
            header[f"{name}_code"] = 0 if getattr(self, name) is None else np.clip(code, -2**15, 2**15 - 1)
        return header


def chosen(sform_code: int, qform_code: int, wanted: str = "auto") -> str:
    """Which frame, "sform" or "qform", is read: the one that is `wanted` where it has a code, with "auto" the sform."""
    return "qform" if qform_code and (wanted == "qform" or not sform_code) else "sform"


def from_voxel(frame: np.ndarray, axis: int, index: int) -> np.ndarray:
    """The frame (4, 4) of voxels that count from `index` on along an array axis."""
    frame = frame.copy()
    frame[:3, 3] += index * frame[:3, axis]
    return frame


def plain_header(affine, frame_code: int) -> nibabel.Nifti1Header:
    """A NIfTI header with one `affine` (4, 4) as both of its frames."""
    header = nibabel.Nifti1Header()
    code = frame_code or 1  # a position that was not stated is now, or readers would centre the image anew
    header.set_qform(affine, code)
    header.set_sform(affine, code)
    if not np.allclose(header.get_qform(), affine, atol=1e-3):
        header.set_qform(affine, 0)  # tilted slices: a quaternion cannot hold the shear between them
    return header


def facts(frames: Frames | None, shape) -> dict:
    """What is kept of the frames of a file with `shape` (3,) voxels.

    Their `codes`; and the `frames` as they are listed, where any voxel lies elsewhere by the other one, or to ITK.
    """
    if frames is None:
        return {}
    found, here = {"codes": list(frames.codes)}, frames.affine()
    if here is not None:
        corners = np.stack(np.meshgrid(*[(0.0, n - 1.0) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
        if _two_places("", frames, corners @ here[:3, :3].T + here[:3, 3]):
            found["frames"] = frames.listed
    return found


def doubts(name: str, found: dict, wanted: str, points, image: str, image_found: dict) -> list[str]:
    """The texts of W114 for the file `name` with these `facts`, of a run of an `image` with its own.

    `points` (n, 3) RAS mm are those of the organ. A frame that was `wanted` by its name is not doubted, but a file that
    lacks it is.
    """
    texts = []
    if wanted == "auto" and "frames" in found:
        texts.append(_two_places(name, Frames(**found["frames"]), points))
    if "codes" in found and "frames" in image_found:
        frames = Frames(**image_found["frames"])
        if chosen(*found["codes"], wanted) != frames.taken(wanted):
            texts.append(_lacking(name, image, frames, wanted, points))
    return list(filter(None, texts))


def _two_places(name: str, frames: Frames, points) -> str | None:
    """Where voxels that are at `points` by the frame that "auto" takes lie by the other one, and to ITK."""
    taken = frames.taken()
    other, (theirs, there) = OTHER[taken], frames.itk()
    if all(frames.codes) and getattr(frames, other) is None and theirs == other:
        return (f"{name}: its {other}, which {ITK} take, cannot be used: where they show it is not known. The {taken} "
                "was taken.")
    apart, off = (_farthest(frames.affine(), to, points) for to in (getattr(frames, other), there))
    sizes = off > APART.value and theirs == taken
    if apart > APART.value:
        too = " too" if theirs == taken else ""
        too += f", with the voxel sizes of its pixdim, which puts it up to {off:.1f} mm away" if sizes else ""
        return (f"{name}: its sform and qform lie up to {apart:.1f} mm apart in the organ. The {taken} was taken, as "
                f"nibabel does; {ITK} take the {theirs}{too}. Say which one is right, ⟦nifti_frame=sform|qform⟧, "
                "and draw where the same one is shown.")
    if sizes:
        return (f"{name}: its {taken} and its pixdim state different voxel sizes. The {taken} was taken as it is, as "
                f"nibabel does; {ITK} take the sizes of pixdim, which puts it up to {off:.1f} mm away in the organ. "
                "Write it again with one of them.")
    return None


def _lacking(name: str, image: str, frames: Frames, wanted: str, points) -> str | None:
    """What is said of a file without the frame that was taken of the image, when the image's other one is elsewhere."""
    taken = frames.taken(wanted)
    other = OTHER[taken]
    apart = _farthest(frames.affine(wanted), getattr(frames, other), points)
    if apart <= APART.value:
        return None
    return (f"{name} has no {taken}: its {other} was taken, but of {image} the {taken}, which lies up to {apart:.1f} "
            f"mm from its {other} in the organ. If the two do not lie on each other, give ⟦nifti_frame={other}⟧.")


def _farthest(here: np.ndarray, there: np.ndarray | None, points) -> float:
    """How far at most, mm, the voxels that are at `points` (n, 3) by the frame `here` are by the frame `there`."""
    if there is None or len(points) == 0:
        return 0.0
    move = there @ np.linalg.inv(here)
    points = np.asarray(points, float)
    return float(np.linalg.norm(points @ move[:3, :3].T + move[:3, 3] - points, axis=1).max())
