"""Files of surfaces: a path -> a checked `Surface` in world RAS mm that can be written back as it came.

A file is opened once, as a regular file, and decoded from memory. Its format is told by its ending, since STL and OBJ
have no mark of their own. Where its points lie, it says itself (`SPACE=LPS`, which 3D Slicer writes into every format;
GIfTI's coordinate system), or its user does.
"""

import codecs
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.mesh import frozen_array
from xfemnav.imaging.points import gifti, obj, ply, stl, vtk_legacy, vtk_polydata
from xfemnav.imaging.points.endings import ending_of
from xfemnav.imaging.points.point_set import FARTHEST
from xfemnav.imaging.points.surface_form import Form, unreadable
from xfemnav.imaging.reading.content import file_bytes
from xfemnav.imaging.reading.formats import LPS_TO_RAS

READERS = {".stl": stl.decoded, ".vtk": vtk_legacy.decoded, ".vtp": vtk_polydata.decoded, ".gii": gifti.decoded,
           ".obj": obj.decoded, ".ply": ply.decoded}
#: What a file begins with, or has there, of the formats that have a mark of their own.
MARKS = {".ply": b"ply", ".vtk": b"# vtk DataFile", ".vtp": b"<VTKFile", ".gii": b"<GIFTI"}
HEAD = 1000  # bytes, where it is
FRAMES = {"ras": np.eye(4), "lps": LPS_TO_RAS}


@dataclass(frozen=True, eq=False)
class Surface:
    """Points (n, 3) world RAS mm, and faces: the numbers of their `corners` one behind the other, `count` (m,) each.

    `frame` says in words whose millimetres the file counts in, and `stated` whether it says so itself.
    `written(points, kept)`: the file with other points (n, 3) RAS mm, and of its faces those that are `kept` (m,) bool.
    """

    points: np.ndarray
    corners: np.ndarray
    count: np.ndarray
    frame: str
    stated: bool
    written: Callable[[np.ndarray, np.ndarray], bytes]

    def __post_init__(self):
        object.__setattr__(self, "points", frozen_array(self.points, float, (None, 3), "points"))
        object.__setattr__(self, "corners", frozen_array(self.corners, int, (int(np.sum(self.count)),), "corners"))
        object.__setattr__(self, "count", frozen_array(self.count, int, (None,), "count"))


def read_surface(path, *, space: str = "ras", max_memory_gb: float = 4.0) -> Surface:
    """The surface in the file at `path`; `space` (ras or lps) is that of a file that does not say its own.

    Raises E100 (cannot be opened), E102 (too large), E106 (no file), E701 (cannot be used).
    """
    limit = int(max_memory_gb * 1e9)
    return decoded_surface(file_bytes(path, limit), Path(path).name, space, limit)


def decoded_surface(content: bytes, name: str, space: str = "ras", limit: int = 4_000_000_000) -> Surface:
    """The surface in the bytes of a file called `name`; see `read_surface`."""
    ending = ending_of(name, tuple(READERS))
    if not ending:
        raise XfemnavError("E701", f"{name} is no surface that xfemnav knows; give {', '.join(READERS)}.")
    _check_mark(content, name, ending)
    with np.errstate(all="ignore"):  # what overflows is refused by its result
        form = READERS[ending](content, name, limit)
    _check(form, name)
    affine, words, stated = _frame(form, name, space)
    inverse = np.linalg.inv(affine)

    def written(points, kept) -> bytes:
        there = np.asarray(points) @ inverse[:3, :3].T + inverse[:3, 3]
        return form.rewritten(there, np.asarray(kept, bool))

    points = form.points @ affine[:3, :3].T + affine[:3, 3]
    return Surface(points, form.corners, form.count, words, stated, written)


def _frame(form: Form, name: str, space: str) -> tuple[np.ndarray, str, bool]:
    """The affine (4, 4) from a file's points to world RAS, how it is known, and whether the file says so."""
    if form.affine is not None:
        return form.affine, form.words, True
    spaces = {found.decode().lower() for found in re.findall(rb"(?i)SPACE\s*[=:]\s*(RAS|LPS)\b", form.remarks)}
    if len(spaces) > 1:
        raise unreadable(name, "says both SPACE=RAS and SPACE=LPS. Leave the wrong one out.")
    if spaces:
        (space,) = spaces
        return FRAMES[space], f"{space.upper()} as the file says", True
    if form.doubt:
        warn("W112", f"{name} states no position: {form.doubt}.")
        return np.eye(4), "RAS, for the file does not say", False
    space = space if space in FRAMES else "ras"  # pixels are no frame of a surface
    return FRAMES[space], f"{space.upper()} as space says", False


def _check_mark(content: bytes, name: str, ending: str) -> None:
    """Raise E701 where a file is of another format than its name says."""
    tagged = content.removeprefix(codecs.BOM_UTF8).lstrip().startswith(b"<")  # else such a mark is a remark
    found = [own for own, mark in MARKS.items()
             if (tagged and mark in content[:HEAD] if mark.startswith(b"<") else content.startswith(mark))]
    if ending not in found and (found or ending in MARKS):
        told = f"its content is that of a {found[0]}" if found else f"it does not begin with {MARKS[ending].decode()!r}"
        raise unreadable(name, f"is no {ending}: {told}. Rename it, or save the surface again.")


def _check(form: Form, name: str) -> None:
    """Raise E701 unless points are finite and near, and faces are of them."""
    if not len(form.points):
        raise unreadable(name, "holds no points. Save the surface again.")
    if not np.isfinite(form.points).all():
        raise unreadable(name, "has points that are NaN or infinite. Save the surface again.")
    if (far := abs(form.points).max()) > FARTHEST:
        raise unreadable(name, f"has a coordinate of {far:.3g} mm; beyond {FARTHEST:.0e} mm there is no patient. Check "
                               "its units.")
    if not len(form.count) or not form.count.all():
        raise unreadable(name, "holds no faces, or faces without points. Save the surface again; points alone are "
                               "landmarks, as .csv.")
    if not 0 <= form.corners.min() <= form.corners.max() < len(form.points):
        raise unreadable(name, f"has faces of points that it does not hold (it has {len(form.points)}). "
                               "Save the surface again.")
