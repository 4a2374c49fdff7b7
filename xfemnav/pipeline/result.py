"""The Python face: run, then ask where tissue is and where it was."""

from functools import cached_property
from pathlib import Path

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.pipeline import job
from xfemnav.pipeline.config import STAGES, configure
from xfemnav.pipeline.kernels import settle_kernel_cache
from xfemnav.pipeline.runfile import read_record

SIDES = {"left": 1, "right": -1}


def run(image=None, *, scenario=None, output=None, cache=None, report: bool = True, force: bool = False, **flags):
    """Update `image` after a cut, as `xfemnav run` does, and return the `Result`.

    `flags` are those of the command with underscores: cut, left, right, opening_mm, blade, mask, slice_mm, ... A cut is
    "x,y x,y ..." or rows of numbers (several: a list of cuts), a vector "3.5,1" or two numbers. Warnings of the run are
    issued as Python warnings. Raises XfemnavError.

    Cut the phantom, open it by 6 mm, and follow a point on each lip:

    >>> import tempfile, xfemnav
    >>> from data_synthetic import files, phantom
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
    config = configure(image, scenario, flags)
    options = job.Options(
        output=Path(output) if output is not None else job.default_output(config.image),
        cache=Path(cache) if cache is not None else job.default_cache(),
        force_from=STAGES[0] if force else None, report=report, argv=("xfemnav.run",),
    )
    record = job.run(config, options)
    for item in (*record["warnings"], *filter(None, [record.get("error")])):
        warn(item["code"], item["text"])
    return Result(options.output, record)


class Result:
    """A finished run: its folder, its `record` (run.json), and the motion of the tissue.

    Points are (2,) or (n, 2) plane mm, or (3,) or (n, 3) world RAS mm; results have the same form, and are NaN where
    there is no tissue. A cut is two-valued: `side` says which lip, "left" (+1) or "right" (-1).
    """

    def __init__(self, folder: Path, record: dict):
        if "solution" not in record["outputs"]:
            raise XfemnavError("E701", f"the run in {folder} ({record['status']}) has no solution. Run it again.")
        self.folder, self.record = Path(folder), record
        settle_kernel_cache()  # before `motion` imports kernels

    @classmethod
    def load(cls, folder) -> "Result":
        """The result in an output folder. Raises E100 and E701."""
        return cls(Path(folder), read_record(Path(folder)))

    @property
    def trusted(self) -> bool:
        """False when the retraction folds tissue (E401)."""
        return self.record["status"] == "complete"

    @cached_property
    def frame(self):
        """The plane of the slice: an imaging Slice whose values are the organ's mask."""
        from xfemnav.imaging.reading import read_image
        from xfemnav.imaging.slices import take_slice

        return take_slice(read_image(self._path("mask")), plane=self.record["slice"]["plane"])

    @cached_property
    def motion(self):
        """The map of the tissue, in plane coordinates: a PiecewiseAffineMap."""
        from xfemnav.geometry.affine_map import PiecewiseAffineMap
        from xfemnav.pipeline.files import read_soup

        rest, moved = read_soup(self._path("solution"), self.frame)
        return PiecewiseAffineMap(rest, moved, tuple(np.array(cut["path"]) for cut in self.record["cuts"]))

    def to_preoperative(self, points) -> np.ndarray:
        """Where the tissue that is now at `points` was in the preoperative image."""
        return self._mapped(points, self.motion.to_preoperative)

    def to_current(self, points, side=None) -> np.ndarray:
        """Where the tissue that was at `points` in the preoperative image is now."""
        return self._mapped(points, lambda plane: self.motion.to_current(plane, SIDES.get(side, side)))

    def displacement(self, points, side=None) -> np.ndarray:
        """Displacement, mm, of the tissue that was at `points`."""
        return self.to_current(points, side) - np.asarray(points, float)

    def warp(self, image, *, interp: str = "linear", outside: str = "keep", fill: float = 0.0):
        """Another image of the patient after the motion.

        A path of an image on the same grid gives a nibabel image; an array (n1, n2) along e1 and e2 gives an array.
        """
        from xfemnav.imaging.reading import read_image
        from xfemnav.imaging.slices import to_nifti, values_on
        from xfemnav.imaging.warp import covered, pull_back, update

        from_file = isinstance(image, str | Path)
        values = values_on(read_image(image), self.frame) if from_file else np.asarray(image)
        grid = self.frame.origin, self.frame.spacing, self.frame.values.shape
        motion = pull_back(self.motion.rest, self.motion.moved, *grid)
        updated = update(values, *grid[:2], covered(self.motion.rest, *grid), motion, interp, outside, fill).updated
        return to_nifti(self.frame, updated, updated.dtype) if from_file else updated

    def write_transform(self, path, *, gaps: str = "bridged") -> None:
        """Write the motion as an ITK transform (.h5) from the updated to the preoperative slice.

        `gaps`: "bridged" runs from lip to lip across an opened cut, for viewers; "extended" goes on with the lips for a
        pixel and then out of the image, so that resampling (ANTs, SimpleITK) loses no tissue and gives background.
        """
        from xfemnav.imaging.transform import bridged, extended, write_transform
        from xfemnav.imaging.warp import covered, pull_back

        grid = self.frame.origin, self.frame.spacing, self.frame.values.shape
        motion = pull_back(self.motion.rest, self.motion.moved, *grid)
        empty = covered(self.motion.rest, *grid) & ~motion.tissue
        write_transform(path, self.frame, {"bridged": bridged, "extended": extended}[gaps](motion, empty))

    def _mapped(self, points, move) -> np.ndarray:
        points = np.asarray(points, float)
        rows = np.atleast_2d(points)
        if rows.shape[1] == 2:
            return move(rows).reshape(points.shape)
        plane, distance = self.frame.from_world(rows)
        return (self.frame.to_world(move(plane)) + distance[:, None] * self.frame.axes[2]).reshape(points.shape)

    def _path(self, role: str) -> Path:
        return self.folder / self.record["outputs"][role]
