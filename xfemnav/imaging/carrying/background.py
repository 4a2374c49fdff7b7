"""What a pixel without tissue shows: the background of its image, and when that would look like tissue.

0 is air in most images, but water in CT and a value of tissue where intensities are z-scores. The corners of a slice
show what an image has where there is nothing.
"""

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.reading.gate import LARGEST

BLOCK = 0.1  # of each side of an image: the edge of its corner blocks
INTERP, OUTSIDE = ("linear", "cubic", "nearest"), ("keep", "zero")
RANGE = 1.0, 99.0  # percentiles of the organ's values between which a value looks like tissue


def corner_values(values) -> np.ndarray:
    """The finite values (k,) in the corner blocks of an image (n1, n2) or volume (n1, n2, n3)."""
    values = np.asarray(values)
    for axis, n in enumerate(values.shape):
        width = max(1, int(BLOCK * n))
        values = values.take(np.union1d(np.arange(width), np.arange(n - width, n)), axis)
    return values[np.isfinite(values)]


def background(corners, tissue) -> float:
    """What an image holds where there is nothing: the median of its `corners` (k,), one of its own values.

    0 where that median lies among the values of the `tissue` (n,), for then the corners hold tissue too.
    """
    if not len(corners):
        return 0.0
    median = float(np.sort(corners)[(len(corners) - 1) // 2])
    return 0.0 if _is_among(median, tissue) else median


def blank_of(values, organ, fill: float | None = None) -> float:
    """The value for pixels without tissue of an image (n1, n2): `fill`, or the background where that is None.

    `organ` (n1, n2) bool is where the organ was. Raises E780 for a `fill` that no image can hold.
    """
    return background(corner_values(values), values[organ]) if fill is None else storable(fill)


def storable(fill: float) -> float:
    """A given `fill`. Raises E780 where it is NaN or infinite in float32, in which results are stored."""
    if not abs(fill) <= LARGEST:
        raise XfemnavError("E780", f"fill {fill:g} is no finite number of float32, in which images are stored.")
    return float(fill)


def asked_blank(values, organ, interp: str, outside: str, fill: float | None) -> float:
    """`blank_of` an array that somebody asks for, by the way. Warns W211 of what was asked for alone.

    Raises E130 where the array is none on the grid of the `organ`; E780 for words that are none, and where a `fill` is
    none of the array's own numbers, which nearest neighbours are.
    """
    if values.dtype.kind not in "buif":
        raise XfemnavError("E130", f"the companion has values of type {values.dtype}; give real numbers.")
    if values.shape != organ.shape:
        raise XfemnavError("E130", f"the companion has {values.shape} pixels and the slice {organ.shape}; give it on "
                                   "the slice's grid, along e1 and e2.")
    if interp not in INTERP or outside not in OUTSIDE:
        raise XfemnavError("E780", f"interp {interp!r}, outside {outside!r}: wanted one of {', '.join(INTERP)}, and "
                                   f"one of {', '.join(OUTSIDE)}.")
    blank = blank_of(values, organ, fill)
    if interp == "nearest" and values.dtype.kind in "iu":
        ends = np.iinfo(values.dtype)
        if not (ends.min <= blank <= ends.max and blank == int(blank)):
            raise XfemnavError("E780", f"fill {blank:g} is no number of the type {values.dtype} that the image has.")
    if fill is not None or outside == "zero":
        warn_of_blank(blank, values[organ], "the image", given=fill is not None, outside=outside)
    return blank


def warn_of_blank(blank: float, tissue, name: str, *, given: bool, outside: str = "keep") -> None:
    """W211 when pixels without tissue look like the values of the `tissue` (n,): the `given` fill or the background,
    `blank`, or the 0 `outside` of the organ."""
    if (ends := _ends(tissue)) is None:
        return
    low, high = ends
    among = f"lies among the organ's values in {name} ({low:.4g} to {high:.4g})"
    if _is_among(blank, tissue):
        warn("W211", f"fill {blank:g} {among}: pixels without tissue look like it. Leave ⟦fill⟧ out for the "
                     "background's value." if given else
                     f"no background is known that differs from the tissue: {blank:g} {among}, and pixels without "
                     f"tissue look like it. Give a value beyond them, such as ⟦fill={low - (high - low):.3g}⟧.")
    if outside == "zero" and _is_among(0.0, tissue):
        warn("W211", f"0 {among}: with ⟦outside=zero⟧ all about the organ looks like it. Leave it out to keep what is "
                     "there.")


def _ends(tissue) -> tuple[float, float] | None:
    """The values between which the tissue's lie, but for few; None where there is no tissue."""
    tissue = np.asarray(tissue, float)
    tissue = tissue[np.isfinite(tissue)]
    return tuple(np.percentile(tissue, RANGE).tolist()) if len(tissue) else None


def _is_among(value: float, tissue) -> bool:
    """Whether a value lies among those of the `tissue` (n,); its very ends are not among them, unless they are one."""
    if (ends := _ends(tissue)) is None:
        return False
    low, high = ends
    return low < value < high or low == value == high
