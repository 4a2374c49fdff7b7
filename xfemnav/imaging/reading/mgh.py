"""FreeSurfer MGH and MGZ header -> what its voxels are and where they lie.

Field meanings: https://surfer.nmr.mgh.harvard.edu/fswiki/FsTutorial/MghFormat. Everything is big-endian.
"""

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.formats import Header, check_affine, impossible

NO_POSITION = "its goodRASFlag is 0, so FreeSurfer's default of 1 mm coronal slices is taken"
TYPES = {0: "u1", 1: ">i4", 3: ">f4", 4: ">i2", 10: ">u2"}
OFFSET = 284
SCAN = 20  # bytes of repetition time, flip angle, echo and inversion time, field of view, after the voxels
TAIL = 1 << 24  # bytes after the voxels: numbers of the scan, then tags (commands, colour table, ...)
_HEADER = np.dtype([("version", ">i4"), ("dims", ">i4", 4), ("type", ">i4"), ("dof", ">i4"), ("good", ">i2"),
                    ("delta", ">f4", 3), ("axes", ">f4", (3, 3)), ("centre", ">f4", 3)])
_CORONAL = np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # rows: where the three array axes point, RAS


def recognises(head: bytes) -> bool:
    """Whether `head`, the first bytes of a file, starts an MGH image: version 1, a flag of 0 or 1."""
    if len(head) < OFFSET:
        return False
    raw = _raw(head)
    return raw["version"] == 1 and raw["good"] in (0, 1)


def _raw(head: bytes):
    return np.frombuffer(head, _HEADER, 1)[0]


def read_header(head: bytes, name: str) -> Header:
    """Checked header of the file `name` whose first bytes are `head`. Raises E105."""
    raw = _raw(head)
    shape, code = tuple(int(n) for n in raw["dims"]), int(raw["type"])
    if min(shape) < 1:
        raise impossible(name, f"dimensions {shape}")
    if code not in TYPES:
        raise impossible(name, f"data type {code}")
    return Header(shape if shape[3] > 1 else shape[:3], np.dtype(TYPES[code]), OFFSET, tail=TAIL)


@np.errstate(all="ignore")  # what overflows is refused by its result
def read_frame(head: bytes, name: str) -> tuple[np.ndarray, int]:
    """Affine (4, 4) voxel -> RAS mm, and its code: 1, or 0 where the header states no position. Raises E110."""
    raw = _raw(head)
    good = bool(raw["good"])
    columns = raw["axes"].astype(float).T * raw["delta"] if good else _CORONAL.T
    centre = raw["centre"].astype(float) if good else np.zeros(3)
    affine = np.eye(4)
    affine[:3, :3] = columns
    affine[:3, 3] = centre - columns @ (raw["dims"][:3] / 2)  # FreeSurfer's centre is voxel n/2, not (n - 1)/2
    check_affine(affine, name)
    return affine, int(good)


def check_tail(tail: bytes, name: str) -> None:
    """What follows the voxels must be numbers of the scan and then tags, or the header's dimensions are wrong (E102).

    A tag starts with its number, a small integer that is not 0.
    """
    tag = int.from_bytes(tail[SCAN : SCAN + 4], "big")
    if (len(tail) <= SCAN and len(tail) % 4 == 0) or (len(tail) >= SCAN + 4 and 0 < tag < 1 << 16):
        return
    raise XfemnavError("E102", f"{name} holds {len(tail)} bytes after its voxels that are no tags of FreeSurfer's, so "
                               "its dimensions are wrong. Convert it again from its source.")
