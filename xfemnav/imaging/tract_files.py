"""Files of fibre tracts: TrackVis (.trk) and MRtrix (.tck), checked where their readers trust."""

import struct
from pathlib import Path

import nibabel
import numpy as np
from nibabel.streamlines import Tractogram
from nibabel.streamlines.tractogram_file import DataError, HeaderError, TractogramFile

from xfemnav.errors import XfemnavError

PROPERTY, PROPERTIES = "motion", 10  # what a .trk calls our flags, and how many values a streamline it can hold


def read_streamlines(path) -> TractogramFile:
    """The tractogram in a .trk or .tck file, told by its content; points in RAS mm. Raises E100, E701."""
    path = Path(path)
    if not path.is_file():
        raise XfemnavError("E100", f"cannot open {path}: no such file. Correct the path.")
    try:
        with np.errstate(invalid="ignore"):    # infinite points are told below
            file = nibabel.streamlines.load(path)
        header = nibabel.streamlines.load(path, lazy_load=True).header  # as it is written
        claimed = int(header.get("count", header.get("nb_streamlines", 0)))
    except (DataError, HeaderError, struct.error, OSError, ValueError, LookupError, TypeError, AttributeError,
            MemoryError, ArithmeticError) as error:
        raise XfemnavError("E701", f"{path.name} is no .trk or .tck file, or a damaged one ({error}). "
                                   "Write it again.") from None
    found = len(file.streamlines)
    if claimed not in (0, found) or found == 0:
        raise XfemnavError("E701", f"{path.name} holds {found} streamlines, {claimed} by its header. Write it again.")
    if not np.isfinite(file.streamlines.get_data()).all():
        raise XfemnavError("E701", f"{path.name} has points that are NaN or infinite. Write it again.")
    return file


def file_like(file: TractogramFile, points, count, places, source, code) -> TractogramFile:
    """A file of the format of `file`, with its header and data.

    Its streamlines are `points` (n, 3) RAS mm, `count` (m,) of them each, parts of the streamlines `source` (m,) of
    `file`, with the flags `code` (m,). Point by point they lie at `places`: behind its points k (n,), before the ones
    that follow (n,), a part t (n,) of the way on. Raises E701 when a .trk has no room for the flags.
    """
    ends, old = np.cumsum(count)[:-1], file.tractogram
    per_point = {name: np.split(_between(values.get_data(), *places), ends)
                 for name, values in old.data_per_point.items()}
    per_streamline = {name: values[source] for name, values in old.data_per_streamline.items() if name != PROPERTY}
    if isinstance(file, nibabel.streamlines.TrkFile):
        if sum(values.shape[1] for values in per_streamline.values()) >= PROPERTIES:
            raise XfemnavError("E701", f"the .trk has {PROPERTIES} values a streamline, all that it can hold, and none "
                                       f"is left for {PROPERTY!r}. Write it again with fewer.")
        per_streamline[PROPERTY] = code[:, None].astype(np.float32)
    if not len(count):
        return type(file)(Tractogram(affine_to_rasmm=np.eye(4)), header=file.header)
    pieces = np.split(points.astype(np.float32), ends)
    return type(file)(Tractogram(pieces, per_streamline, per_point, affine_to_rasmm=np.eye(4)), header=file.header)


def _between(values, k, following, t) -> np.ndarray:
    """Rows k of `values`, and a part t of the way on to the rows that are `following`; all (n,)."""
    new, on = values[k], t > 0    # a point's own value needs no other, which may be NaN
    new[on] += t[on, None] * (values[following[on]] - new[on])
    return new
