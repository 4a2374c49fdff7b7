"""Named sets of points in world RAS mm, whatever file they came from."""

from dataclasses import dataclass, field

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import frozen_array

#: Kind -> fewest points of one.
LEAST = {"Fiducial": 1, "Line": 2, "Curve": 2, "ClosedCurve": 3, "points": 1, "Plane": 4}
FARTHEST = 1e4  # mm, farther from the origin than any patient
RAS, LPS = np.array([1.0, 1.0, 1.0]), np.array([-1.0, -1.0, 1.0])  # what turns a file's axes to RAS and back


#: What is said of a point file that is not read: `content.file_bytes`.
POINT_FILE = {
    "no file": ("E308", "{name} is a folder, pipe or device, not a file. Correct the path."),
    "empty": ("E308", "{name} is empty (0 bytes). Save the points again."),
    "large": ("E308", "{name} holds {size}; at most {limit} are read. Is it a point file?"),
    "unread": ("E308", "{name} cannot be read: {reason}. Copy it again."),
}


@dataclass(frozen=True)
class Form:
    """How a table is laid out, so that it is written as it was read.

    Names of all columns, in their order; their `separator`; which of them are coordinates, and which one is the label,
    None for none. `signs` (3,) and mm a `unit` take the coordinates to RAS mm; `stated`: the file says so, or a file
    beside it, or it is assumed.
    """

    header: tuple[str, ...]
    separator: str
    places: tuple[str, str, str]
    label: str | None
    signs: tuple[float, float, float]
    unit: float = 1.0
    stated: bool = True


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points of one `kind` of `LEAST`, in their order: `points` (n, 3) world RAS mm, `labels` (n,), "" where none.

    A ClosedCurve goes on from its last point to its first, which is not repeated. `columns`: further columns of a
    table as text, each of n rows, which its writer puts back in the `form` that it had.
    """

    kind: str
    name: str
    points: np.ndarray
    labels: tuple[str, ...]
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    form: Form | None = None

    def __post_init__(self):
        if self.kind not in LEAST:
            raise ValueError(f"a point set is one of {', '.join(LEAST)}, not {self.kind!r}")
        object.__setattr__(self, "points", frozen_array(self.points, float, (None, 3), "points"))
        object.__setattr__(self, "labels", tuple(self.labels))
        if not np.isfinite(self.points).all():
            raise ValueError("points are not finite")
        if any(len(rows) != len(self.points) for rows in (self.labels, *self.columns.values())):
            raise ValueError("labels and columns have one row a point")


def unusable(file: str, what: str) -> XfemnavError:
    """The error of a point `file`; `what` says where it is wrong and how to mend it."""
    return XfemnavError("E308", f"{file} {what}")


def shown(value) -> str:
    """A value of a file as one short line without control characters, for messages."""
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def point_set(kind: str, name: str, points, labels, file: str, columns: dict | None = None,
              form: Form | None = None) -> PointSet:
    """A `PointSet` of what a `file` holds: E308 when its points are too few or too far away."""
    if len(points) < LEAST[kind]:
        raise unusable(file, f"has {len(points)} usable points for a {kind}, which needs {LEAST[kind]}. Place them, "
                             "and save it again.")
    points = np.asarray(points, float)
    if (far := abs(points).max()) > FARTHEST:
        raise unusable(file, f"has a coordinate of {far:.3g} mm; beyond {FARTHEST:.0e} mm there is no patient. "
                             "Check its units.")
    texts = [label.encode("utf-8", "replace").decode() for label in labels]  # JSON can hold halves of characters
    return PointSet(kind, name, points, tuple(texts), columns or {}, form)


def frame_suspicion(points, inside) -> str | None:
    """One sentence when `points` (n, 3) RAS mm look as if LPS had been read as RAS, or the other way round.

    `inside` tells which of (n, 3) points lie in the organ, (n,) bool. Suspicious is a file of which half of the points
    or more come into the organ when x and y are negated.
    """
    points = np.asarray(points, float)
    n, here, there = len(points), int(np.sum(inside(points))), int(np.sum(inside(points * LPS)))
    if n == 0 or there - here < n / 2:
        return None
    return (f"{here} of {n} points lie in the organ, but {there} with x and y negated: they look like LPS read as RAS, "
            "or the other way round.")
