"""The Python face: run, then ask where tissue is and where it was."""

import os
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from xfemnav.errors import XfemnavError, warn
from xfemnav.naming import ARGUMENTS
from xfemnav.pipeline.asking.arguments import path_of
from xfemnav.pipeline.asking.config import configure
from xfemnav.pipeline.asking.flags import keys
from xfemnav.pipeline.asking.settings import STAGES, AnyPath, Flags
from xfemnav.pipeline.asking.signatures import own_names, takes_flags
from xfemnav.pipeline.keeping.disk import write_atomic
from xfemnav.pipeline.keeping.kernels import settle_kernel_cache, spare_the_run
from xfemnav.pipeline.keeping.record import read_record
from xfemnav.pipeline.running import job
from xfemnav.pipeline.running.reopening import preoperative, refuse_a_volume, refuse_changed, taken

if TYPE_CHECKING:
    from xfemnav.geometry.mesh import Mesh
    from xfemnav.geometry.motion import Motion
    from xfemnav.imaging.carrying.landmarks import MovedPoints
    from xfemnav.imaging.carrying.streamlines import MovedStreamlines
    from xfemnav.imaging.carrying.surfaces import MovedSurface
    from xfemnav.imaging.carrying.warp import PullBack, Update
    from xfemnav.imaging.frames.slices import Slice
    from xfemnav.imaging.frames.volume import Volume
    from xfemnav.imaging.reading.lean import nibabel

SIDES = {"left": 1, "right": -1}
Side = Literal["left", "right"] | ArrayLike | None


def side_number(side: Side) -> ArrayLike | None:
    """+1 for "left" and -1 for "right"; numbers, one for all or one a point, and None stay. Raises E780."""
    if isinstance(side, str) and side in SIDES:
        return SIDES[side]
    found = None if side is None else np.asarray(side)
    if found is not None and (found.dtype.kind not in "iuf" or found.ndim > 1):
        raise XfemnavError("E780", f"side is {side!r}; it is 'left' or 'right'.")
    return found


@takes_flags
def run(image: AnyPath | None = None, *, scenario: AnyPath | None = None, output: AnyPath | None = None,
        cache: AnyPath | None = None, report: bool = True, force: bool = False, **flags: Unpack[Flags]) -> "Result":
    """Update `image` after a cut, as `xfemnav run` does, and return the `Result`.

    The settings are those of the TOML file `scenario`, and of flags, which win over it: the command's, with
    underscores. Files go to the folder `output` (left out: <stem>_xfemnav in the current one), finished stages to
    `cache` (left out: that of the command); `force` computes all of them again. `report`: with figure and page.
    Warnings of the run are issued as Python warnings. Raises XfemnavError.

    Cut the phantom, open it by 6 mm, and follow a point on each lip:

    >>> import tempfile, xfemnav
    >>> from xfemnav_examples import files, phantom
    >>> folder = tempfile.TemporaryDirectory()
    >>> paths = files.write(phantom.Phantom(), folder.name)
    >>> result = xfemnav.run(paths["image"], mask=paths["mask"], cut=phantom.cut_path(), opening_mm=6.0, report=False,
    ...                      element_size_mm=5, corridor_element_mm=2, output=folder.name + "/out")
    >>> on_the_cut = phantom.cut_path()[1] - 30 * phantom.TRAVEL
    >>> left, right = (result.to_current(on_the_cut, side) for side in ("left", "right"))
    >>> print(f"{np.linalg.norm(left - right):.1f} mm apart")
    6.0 mm apart
    >>> bool(np.allclose(result.to_preoperative([left, right]), on_the_cut, atol=1e-6))
    True
    >>> result.to_preoperative((left + right) / 2)  # between the lips there is no tissue
    array([nan, nan])
    >>> folder.cleanup()
    """
    config = configure(image, scenario, dict(flags), own=own_names(run))
    options = job.Options(
        output=path_of(output, "output") if output is not None else job.default_output(config.image),
        cache=path_of(cache, "cache") if cache is not None else job.default_cache(),
        force_from=STAGES[0] if force else None, report=report, argv=("xfemnav.run",),
        names=ARGUMENTS if scenario is None else keys(ARGUMENTS),
    )
    record = job.run(config, options)
    for item in (*record["warnings"], *filter(None, [record.get("error")])):
        warn(item["code"], item["text"])
    return Result(options.output, record)


class Result:
    """A finished run: its folder, its `record` (run.json), and the motion of the tissue.

    Points are (2,) or (n, 2) plane mm, or (3,) or (n, 3) world RAS mm; results have the same form, and are NaN where
    there is no tissue. A cut is two-valued: `side` says which lip, "left" (+1) or "right" (-1). A run with steps is as
    it is after `step`, the last one unless another is named.

    Of a volume points are world RAS mm, and the motion, the mesh and the images are there; what else a slice has,
    `side` too, raises E780 so far.
    """

    def __init__(self, folder: Path, record: dict[str, Any], step: str | None = None, image: AnyPath | None = None):
        if "solution" not in record["outputs"]:
            raise XfemnavError("E701", f"the run in {folder} ({record['status']}) has no solution. Run it again.")
        self.folder, self.record, self._image = Path(folder), record, image
        self.step, (self._solution, self._cuts) = step, _step_of(record, step)
        settle_kernel_cache()  # before `motion` imports kernels

    @classmethod
    def load(cls, folder: AnyPath, step: str | None = None, *, image: AnyPath | None = None) -> "Result":
        """The result in an output folder, after a step of the run.

        It needs nothing but that folder, wherever it is now; only `preoperative` reads the run's image again, which is
        at `image` where it has been moved. Raises E100, E701, E703 where what it is made of is not what the run has
        written, and E780 for an unknown step.
        """
        folder = path_of(folder, "folder")
        found = cls(folder, read_record(folder), step, None if image is None else path_of(image, "image"))
        for role in ("mask", "mesh", found._solution):  # those that are gone are told of when they are needed
            if role in found.record["outputs"] and os.path.exists(folder / found.record["outputs"][role]):
                found._path(role)
        return found

    def __repr__(self) -> str:
        from xfemnav.pipeline.telling.card import verdict

        after = f" after {self.step!r}" if self.step else ""
        return f"<xfemnav.Result in {str(self.folder)!r}{after}: {verdict(self.record)}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: the verdict, the slice before and after, checks, files."""
        from xfemnav.pipeline.telling.card import card

        return card(self)

    @property
    def trusted(self) -> bool:
        """False when the retraction folds tissue (E401)."""
        return self.record["status"] == "complete"

    @property
    def nifti_frame(self) -> str:
        """Which frame of NIfTI headers with two was taken: auto, sform or qform."""
        return self.record["parameters"].get("nifti_frame", "auto")

    @cached_property
    def frame(self) -> "Slice | Volume":
        """The plane of the slice: an imaging Slice whose values are the organ's mask; of a volume, a Volume."""
        return self._read("mask")

    @cached_property
    def preoperative(self) -> "Slice | Volume":
        """The slice before surgery, an imaging Slice, or the Volume: the run's image, read again.

        Raises E100 where it is neither where it lay from the run's folder nor where it lay at all, and E702 where it is
        not what the run has read.
        """
        return preoperative(self.record, self.folder, self._image)

    @cached_property
    def updated(self) -> "Slice | Volume":
        """The slice after surgery as the run has written it, an imaging Slice, or the Volume. Raises E701 where it has
        not."""
        return self._read(self._solution.replace("solution", "updated"))

    @cached_property
    def organ(self) -> "Mesh":
        """The whole organ at rest, also what was resected: the Mesh of the run, plane mm; of a volume, tetrahedra."""
        from xfemnav.geometry.mesh import Mesh
        from xfemnav.pipeline.keeping.files import read_vtu

        found = read_vtu(self._path("mesh"), "E701", corners=self.dimension + 1)
        return Mesh(self.frame.from_world(found.points)[0], found.cells)

    @cached_property
    def motion(self) -> "Motion":
        """The map of the tissue, in plane coordinates, or in space: a Motion, of a volume without its cuts."""
        spare_the_run()
        from xfemnav.geometry.motion import Motion
        from xfemnav.pipeline.keeping.files import read_soup

        rest, moved = read_soup(self._path(self._solution), self.frame)
        return Motion(rest, moved, tuple(np.array(cut["path"]) for cut in self._cuts if "path" in cut))

    @cached_property
    def outline(self) -> np.ndarray:
        """The organ's outline now, a closed loop (k, 2) plane mm, its mouths bridged by straight lines."""
        refuse_a_volume(self, "outline")
        from xfemnav.geometry.plane.moved_outline import moved_outline

        return moved_outline(self.organ.outline, self.motion)

    @cached_property
    def update(self) -> "Update":
        """What became of each pixel of the slice: an Update, whose image is the organ's mask."""
        refuse_a_volume(self, "update")
        return self._updated(self.frame.values)

    def to_preoperative(self, points: ArrayLike) -> np.ndarray:
        """Where the tissue that is now at `points` was in the preoperative image."""
        return self._mapped(points, self.motion.to_preoperative)

    def to_current(self, points: ArrayLike, side: Side = None) -> np.ndarray:
        """Where the tissue that was at `points` in the preoperative image is now."""
        if side is not None:
            refuse_a_volume(self, "the side of a cut")
        return self._mapped(points, lambda plane: self.motion.to_current(plane, side_number(side)))

    def displacement(self, points: ArrayLike, side: Side = None) -> np.ndarray:
        """Displacement, mm, of the tissue that was at `points`."""
        return self.to_current(points, side) - np.asarray(points, float)

    def landmarks(self, points: ArrayLike, side: Side = None, *, inverse: bool = False) -> "MovedPoints":
        """Landmarks through the motion, each with a flag of what it is in: `imaging.carrying.landmarks.MovedPoints`.

        From the preoperative image to now, on the lip of `side` where they are on a cut; with `inverse` from now back.
        """
        refuse_a_volume(self, "landmarks")
        from xfemnav.imaging.carrying.landmarks import moved_points, resting_points

        if inverse:
            return resting_points(points, self.frame, self.motion, self.outline)
        return moved_points(points, self.frame, self.motion, self.organ.corners, side_number(side))

    def streamlines(self, path: AnyPath) -> "MovedStreamlines":
        """The tractogram in a .trk, .trk.gz or .tck file after the motion: MovedStreamlines of
        `xfemnav.imaging.carrying.streamlines`."""
        refuse_a_volume(self, "streamlines")
        from xfemnav.imaging.carrying.streamlines import move_streamlines
        from xfemnav.imaging.points.tract_files import read_streamlines

        return move_streamlines(read_streamlines(path_of(path, "path")), self.frame, self.motion, self.organ.corners)

    def surface(self, path: AnyPath, *, space: str | None = None) -> "MovedSurface":
        """The surface in a .stl, .vtk, .vtp, .gii, .obj or .ply file after the motion: MovedSurface of
        `xfemnav.imaging.carrying.surfaces`.

        `space` (ras, lps) is that of a file that does not say its own; by default the run's.
        """
        refuse_a_volume(self, "surface")
        from xfemnav.imaging.carrying.surfaces import move_surface
        from xfemnav.imaging.points.surface_files import read_surface

        read = read_surface(path_of(path, "path"), space=space or self.record["parameters"]["space"])
        return move_surface(read, self.frame, self.motion, self.organ.corners)

    @overload
    def warp(self, image: AnyPath, *, kind: str | None = ..., interp: str = ..., outside: str = ...,
             fill: float | None = ..., axes: str = ..., order: str | None = ...,
             nifti_frame: str | None = ...) -> "nibabel.Nifti1Image": ...

    @overload
    def warp(self, image: ArrayLike, *, interp: str = ..., outside: str = ...,
             fill: float | None = ...) -> np.ndarray: ...

    def warp(self, image: AnyPath | ArrayLike, *, kind: str | None = None, interp: str = "linear",
             outside: str = "keep", fill: float | None = None, axes: str = "file", order: str | None = None,
             nifti_frame: str | None = None) -> "nibabel.Nifti1Image | np.ndarray":
        """Another image of the patient after the motion.

        The path of an image on any grid in the preoperative image's world gives a nibabel image on the grid of the
        run's slice, whose `extra` says how it was made. `kind` is continuous, label, vector, axis or tensor; left out,
        the file's name, header and data say which of the first two. `axes` ("file", "world", "image", "index") and
        `order` ("fsl", "mrtrix", "nifti") are those of vectors and tensors. Pixels outside of the organ are kept, or 0
        with `outside="zero"`; those that tissue has left get `fill`, or the image's own background. `nifti_frame` says
        which frame of a header with two is taken; left out, it is the run's choice. An array (n1, n2) along e1 and e2
        of the run's slice gives an array.
        """
        refuse_a_volume(self, "warp of another image")
        from xfemnav.imaging.carrying.companions import carry
        from xfemnav.imaging.carrying.kinds import kind_of, read_companion

        if not isinstance(image, str | os.PathLike):
            return self._updated(image, interp, outside, fill).updated
        image = path_of(image, "image")
        wanted = nifti_frame or self.nifti_frame
        companion = read_companion(image, kind, nifti_frame=wanted)
        self._warn_of_frames(companion, wanted)
        return carry(companion, self.frame, self.update, kind=kind or kind_of(companion), interp=interp,
                     outside=outside, fill=fill, axes=axes, order=order)

    def _warn_of_frames(self, companion, wanted: str) -> None:
        """W114 of a file that comes later."""
        from xfemnav.imaging.reading.nifti_frames import doubts, facts

        frame = self.frame
        organ = frame.to_world(frame.pixel_centres()[frame.values != 0])
        own = facts(frame.frames, frame.to_storage(frame.values).shape)
        for text in doubts(companion.name, facts(companion.frames, companion.values.shape[:3]), wanted, organ,
                           "the run's image", own):
            warn("W114", text)

    def write_transform(self, path: AnyPath, *, gaps: str = "bridged", direction: str = "backward") -> None:
        """Write the motion as a file for other programs: .h5 (an ITK transform), .nrrd or .nii.gz (fields).

        `direction`: "backward" maps places in the updated slice to the preoperative one, as resampling an image needs;
        "forward" maps tissue at rest to where it is now, as points need. `gaps`, of backward ones: "bridged" runs from
        lip to lip across an opened cut, for viewers; "extended" goes on with the lips for a pixel and then out of the
        image, so that resampling (ANTs, SimpleITK) loses no tissue and gives background. Raises E780 for another
        suffix, E501 and E502.
        """
        refuse_a_volume(self, "transform")
        from xfemnav.imaging.carrying.transform import backward, forward, roomy

        path = path_of(path, "path")
        suffix = next((end for end in TRANSFORMS if str(path).lower().endswith(end)), None)
        if suffix is None:
            raise XfemnavError("E780", f"{path} has no suffix of a transform; give one of {', '.join(TRANSFORMS)}.")
        organ = self.organ.corners
        if direction == "backward":
            frame = roomy(self.frame, np.concatenate([organ, self.motion.moved]))
            field = backward(frame, organ, self.motion, gaps)
        elif direction == "forward":
            frame = roomy(self.frame, organ)
            field = forward(frame, self.motion)
        else:
            raise XfemnavError("E780", f"direction is {direction!r}; it is 'backward' or 'forward'.")
        meaning = {"backward": "resampling", "forward": "modeling"}[direction]
        write_atomic(path, TRANSFORMS[suffix](frame, field, meaning))

    def _updated(self, values, interp: str = "nearest", outside: str = "keep", fill: float | None = None):
        from xfemnav.imaging.carrying.background import asked_blank
        from xfemnav.imaging.carrying.warp import covered, enclosed, update

        values, grid = np.asarray(values), (self.frame.origin, self.frame.spacing, self.frame.values.shape)
        organ = covered(self.organ.corners, *grid)
        blank = asked_blank(values, organ, interp, outside, fill)
        return update(values, organ, self._pull_back, interp, outside, blank,
                      now=enclosed(self.outline, *grid))

    @cached_property
    def _pull_back(self) -> "PullBack":
        from xfemnav.imaging.carrying.warp import pull_back

        frame = self.frame
        return pull_back(self.motion.rest, self.motion.moved, frame.origin, frame.spacing, frame.values.shape)

    def _mapped(self, points, move) -> np.ndarray:
        from xfemnav.imaging.frames.slices import mapped

        return mapped(self.frame, points, move)

    @property
    def dimension(self) -> int:
        """2 of a slice, 3 of a volume."""
        return self.record.get("dimension", 2)

    def _read(self, role: str) -> "Slice | Volume":
        """An image that the run has written."""
        from xfemnav.imaging.reading.gate import read_image

        image = read_image(self._path(role), nifti_frame=self.nifti_frame)
        return taken(image, self.dimension, plane=self.record.get("slice", {}).get("plane"))

    def _path(self, role: str) -> Path:
        if role not in self.record["outputs"]:
            raise XfemnavError("E701", f"the record of the run in {self.folder} names no {role}. Run it again.")
        path = self.folder / self.record["outputs"][role]
        refuse_changed(role, path, self.record)
        return path


def _step_of(record: dict, step: str | None) -> tuple[str, list]:
    """The role of the solution after a step, and the cuts that act then. Raises E780 for an unknown step."""
    if step is None:
        return "solution", record["cuts"]
    names = [item["name"] for item in record.get("steps", ())]
    if step not in names:
        known = f"its steps are {', '.join(names)}" if names else "it has none"
        raise XfemnavError("E780", f"the run has no step {step!r}: {known}.")
    last = step == names[-1]
    return "solution" if last else f"solution:{step}", record["steps"][names.index(step)]["cuts"]


def _h5(frame, field, meaning) -> bytes:
    from xfemnav.imaging.carrying.transform import itk_bytes

    return itk_bytes(frame, field)


def _nrrd(frame, field, meaning) -> bytes:
    from xfemnav.imaging.carrying.vectors import nrrd_bytes

    return nrrd_bytes(frame, field, meaning)


def _nifti(frame, field, meaning) -> bytes:
    from xfemnav.imaging.carrying.vectors import field_nifti
    from xfemnav.pipeline.keeping.files import nifti_bytes

    return nifti_bytes(field_nifti(frame, field))


#: Suffix of a transform's file: what makes its bytes.
TRANSFORMS = {".h5": _h5, ".nrrd": _nrrd, ".nii.gz": _nifti}
