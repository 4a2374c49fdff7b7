"""A folder of DICOM files -> one volume: its slices sorted along their normal, and refused unless they make a grid.

Files without the mark DICM are skipped with a warning (W113) when their name has the ending of something else (notes,
previews, ...); with no ending, a number, .dcm or .ima for one they are refused (E101), because they look like slices
that are damaged. DICOM files without pixels (DICOMDIR, reports) are skipped too. Folders inside the folder and hidden
files are not looked at. A series that lacks its first or last slices is a smaller volume: nothing in it tells.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.reading import dicom
from xfemnav.imaging.reading.formats import LPS_TO_RAS, Header, check_affine

NO_POSITION = "its DICOM file has no ImagePositionPatient or ImageOrientationPatient"
UNEVEN = 0.02  # of the distance of two slices: how far one may lie off its place
SKEW = 1e-3  # of unit vectors in the files: how far off unit length, square, or each other
OF_SLICES = {"", ".dcm", ".ima", ".dicom"}


class Series(NamedTuple):
    """A series whose headers are checked: `frame()` gives the affine (4, 4) voxel -> RAS mm and its code, `voxels()`
    the values (ni, nj, nk) in float64, i along a row, j down a column, k along the normal of the slices."""

    header: Header
    frame: Callable
    voxels: Callable


@np.errstate(all="ignore")  # what overflows is refused by its result
def read_series(folder: Path, files: dict[str, bytes], limit: int) -> Series:
    """The one series of a folder whose `files` hold these bytes, or none where they are no DICOM.

    Deflated files are unpacked to `limit` bytes at most, what the files hold counted in.

    Raises E101, E102, E105, E106, E110 and E122 as `read_plane`; E121 (several images at each position), E123 (several
    series), E124 (slices missing, doubled, or not on one grid); warns W113 (files skipped).
    """
    planes = _one_series(folder, _planes(folder, files, limit))
    shape = (*planes[0].shape, len(planes))
    if len({plane.shape for plane in planes}) > 1:
        raise _no_volume(folder, f"has slices of {len({plane.shape for plane in planes})} sizes")
    planes = _sorted(folder, planes)

    def voxels() -> np.ndarray:
        values = np.empty(shape, order="F")
        for k, plane in enumerate(planes):
            values[:, :, k] = dicom.pixels(plane)
        return values

    return Series(Header(shape, np.dtype(float), 0), lambda: _frame(folder, planes), voxels)


def _planes(folder: Path, files: dict[str, bytes], limit: int) -> list[dicom.Plane]:
    if not any(files.values()):
        raise XfemnavError("E106", f"{folder} is a folder without DICOM files; give an image file (.nii.gz), or the "
                                   "folder that holds one DICOM series itself.")
    planes, room = {}, limit - sum(map(len, files.values()))
    for name, data in files.items():
        if data:
            planes[name] = plane = dicom.read_plane(folder / name, data, room)
            room -= len(plane.data) if plane else 0
    foreign = [name for name, data in files.items() if not data]
    for name in foreign:
        if Path(name).suffix.lower() in OF_SLICES or Path(name).suffix[1:].isdigit():
            raise XfemnavError("E101", f"{name} in {folder.name} is no DICOM file (it has no mark DICM), though its "
                                       "name could be a slice's. Copy it again, or move it away.")
    skipped = foreign + [name for name, plane in planes.items() if plane is None]
    if skipped:
        warn("W113", f"{len(skipped)} files in {folder.name} are no DICOM images and were skipped: "
                     f"{', '.join(skipped[:5])}{', ...' if len(skipped) > 5 else ''}.")
    found = [plane for plane in planes.values() if plane is not None]
    if not found:
        raise XfemnavError("E106", f"the DICOM files in {folder} are no images; give the folder of one series.")
    return found


def _one_series(folder: Path, planes: list[dicom.Plane]) -> list[dicom.Plane]:
    counts = Counter(plane.series for plane in planes)
    if len(counts) > 1:
        titles = {plane.series: plane.title or plane.series for plane in planes}
        listing = "; ".join(f"{titles[series]}: {n} files" for series, n in counts.most_common(12))
        raise XfemnavError("E123", f"{folder.name} holds {len(counts)} DICOM series ({listing}). Give a folder with "
                                   "the files of one.")
    copies = [instance for instance, n in Counter(plane.instance for plane in planes).items() if n > 1 and instance]
    if copies:
        names = [plane.path.name for plane in planes if plane.instance == copies[0]]
        raise _no_volume(folder, f"holds one slice twice ({', '.join(names[:3])})")
    return planes


def _no_volume(folder: Path, what: str) -> XfemnavError:
    return XfemnavError("E124", f"{folder.name} {what}, so its slices make no volume. Export the series again, whole, "
                                "into an empty folder.")


def _sorted(folder: Path, planes: list[dicom.Plane]) -> list[dicom.Plane]:
    """The slices in the order of their positions along the normal. Raises E110, E121, E124."""
    if len(planes) == 1:
        return planes
    if any(plane.position is None or plane.turn is None for plane in planes):
        raise _no_volume(folder, "has slices without position or orientation")
    turns = np.array([plane.turn for plane in planes])
    if np.ptp(turns, axis=0).max() > SKEW:
        raise _no_volume(folder, "has slices that are not parallel")
    positions = np.array([plane.position for plane in planes])
    along = positions @ np.cross(*turns[0])
    order = np.argsort(along, kind="stable")
    _check_steps(folder, positions[order], along[order])
    return [planes[k] for k in order]


def _check_steps(folder: Path, positions: np.ndarray, along: np.ndarray) -> None:
    """Slices at `positions` (n, 3), sorted, must follow each other by one vector."""
    gaps = np.diff(along)
    step = np.median(gaps[gaps > 1e-3]) if (gaps > 1e-3).any() else 0.0
    doubled = int((gaps <= UNEVEN * step).sum())
    _, times = np.unique(np.cumsum(np.r_[0, gaps > UNEVEN * step]), return_counts=True)
    if doubled and len(set(times)) == 1:
        raise XfemnavError("E121", f"{folder.name} holds {times[0]} images at each of {len(times)} positions (echoes, "
                                   "directions, times); give a folder with one of them.")
    if doubled:
        raise _no_volume(folder, f"has {doubled} slices at the place of another")
    uneven = np.flatnonzero(abs(gaps - step) > UNEVEN * step)
    if len(uneven):
        k = uneven[np.argmax(gaps[uneven])]
        raise _no_volume(folder, f"has a gap of {gaps[k]:.4g} mm after slice {k + 1} of {len(along)}, where others are "
                                 f"{step:.4g} mm apart: slices are missing, or were taken unevenly")
    line = positions[0] + np.arange(len(positions))[:, None] * (positions[-1] - positions[0]) / (len(positions) - 1)
    if np.linalg.norm(positions - line, axis=1).max() > UNEVEN * step:
        raise _no_volume(folder, "has slices that are shifted sideways or unevenly")


@np.errstate(all="ignore")
def _frame(folder: Path, planes: list[dicom.Plane]) -> tuple[np.ndarray, int]:
    """Affine (4, 4) voxel -> RAS mm, and its code: 1, or 0 for a single slice that states no position. Raises E110."""
    first, last, name = planes[0], planes[-1], folder.name
    spacing = first.spacing
    if spacing is None or any(p.spacing is None or abs(p.spacing - spacing).max() > SKEW * spacing.min()
                              for p in planes):
        raise XfemnavError("E110", f"{name} has slices without PixelSpacing, or with different ones. Give the pixel "
                                   "sizes: ⟦spacing=0.9,0.9,2⟧.")
    stated = first.position is not None and first.turn is not None
    turn = first.turn if stated else np.eye(3)[:2]
    if not abs(turn @ turn.T - np.eye(2)).max() <= SKEW:  # nor NaN
        raise XfemnavError("E110", f"{name} has an ImageOrientationPatient of {turn.ravel().round(4).tolist()}, which "
                                   "are no two perpendicular unit vectors. Export it again.")
    affine = np.eye(4)
    affine[:3, :2] = turn.T * spacing
    affine[:3, 2] = np.cross(*turn) * first.thickness if len(planes) == 1 else (
        (last.position - first.position) / (len(planes) - 1))
    affine[:3, 3] = first.position if stated else 0
    affine = LPS_TO_RAS @ affine
    check_affine(affine, name)
    return affine, int(stated)
