"""Whose axes the vectors and tensors of a file are in, in which order a tensor's six components stand, and how the
result is written: so that the program that wrote the file reads the result right.

Files rarely say it. What a format states is taken (`file`), what it leaves open is asked for, never guessed.
"""

from dataclasses import dataclass

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.formats import LPS, RAS
from xfemnav.imaging.reading.gate import Components
from xfemnav.imaging.reading.nifti import SYMMETRIC, VECTOR

DIRECTED = ("vector", "axis", "tensor")  # kinds of values that turn with the tissue
AXES = ("file", "world", "image", "index")
#: Order of a tensor's components by (row, column): FSL's upper triangle, MRtrix's, NIfTI's lower triangle.
ORDERS = {
    "fsl": ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)),
    "mrtrix": ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)),
    "nifti": ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)),
}
ASYMMETRY = 1e-4  # of the largest entry: what float32 leaves of a symmetric matrix that was turned


@dataclass(frozen=True, eq=False)
class Convention:
    """How a file's vectors or tensors are read and how the result's are written.

    `from_file` and `to_file` (3, 3): axes of the components in the file and in the result, as columns in world RAS;
    `order_in` and `order_out`, names of ORDERS; the result's NIfTI `intent`; `frame`, its axes in words.
    """

    from_file: np.ndarray
    to_file: np.ndarray
    order_in: str
    order_out: str
    intent: int
    frame: str


def convention(companion: Components, affine, *, tensors: bool, axes: str = "file",
               order: str | None = None) -> Convention:
    """The convention of a `companion`, of `tensors` or of vectors, whose result lies on the grid of `affine` (4, 4).

    `axes` of AXES: "file", what the file states; "world", RAS, or LPS in formats that are LPS; "image" (FSL), the
    array's axes, the first one reversed where they are right-handed; "index", the array's axes. `order` of ORDERS;
    None: by what the file states, else FSL's. Raises E131 where a file states no axes, E780 for unknown names.
    """
    if axes not in AXES or order not in (None, *ORDERS):
        raise XfemnavError("E780", f"axes {axes!r}, order {order!r}: wanted one of {', '.join(AXES)}, and one of "
                                   f"{', '.join(ORDERS)}.")
    vectors, known = companion.vectors, order or ("nifti" if companion.vectors.layout == "lower" else "fsl")
    intent = companion.intent or _itk_intent(companion, tensors, axes)
    written = known if companion.intent or not intent else "nifti"  # readers of the intent know but this order
    if axes in ("image", "index"):
        name = "image" if axes == "image" else "index"
        frame = {"image": "array axes, the first reversed where they are right-handed (FSL)", "index": "array axes"}
        return Convention(_array_axes(companion.affine, name), _array_axes(affine, name), known, written, intent,
                          frame[axes])
    if axes == "file" and vectors.stated is None:
        raise _unstated(companion)
    lps = intent in (SYMMETRIC, VECTOR)
    return Convention(vectors.stated if axes == "file" else vectors.world, LPS if lps else RAS, known, written,
                      intent, "LPS+" if lps else "RAS+")


def _itk_intent(companion: Components, tensors: bool, axes: str) -> int:
    """NIfTI's intent for what comes from ITK's formats, which state their axes; 0 for others, and for axes that no
    intent stands for."""
    if companion.vectors.stated is None or axes == "image" or (axes == "index" and not tensors):
        return 0
    return SYMMETRIC if tensors else VECTOR


def _unstated(companion: Components) -> XfemnavError:
    if companion.vectors.layout == "lower":
        return XfemnavError("E131", f"{companion.name} states the order of its tensors (intent 1005), not whose axes "
                                    "they are in. Say it: axes index (ANTs: the array's own) or world (LPS).")
    return XfemnavError("E131", f"{companion.name} does not state whose axes its values are in. Say it: axes world "
                                "(RAS, as MRtrix), image (FSL) or index (the array's own).")


def _array_axes(affine, axes: str) -> np.ndarray:
    """Unit vectors (3, 3) along the array axes of `affine` (4, 4), as columns; of FSL's image, with its reversal."""
    U, _, V = np.linalg.svd(affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0))  # the nearest perpendicular axes
    directions = U @ V
    reverse = axes == "image" and np.linalg.det(directions) > 0
    return directions * ([-1, 1, 1] if reverse else [1, 1, 1])


def six(companion: Components) -> np.ndarray:
    """The six components (ni, nj, nk, 6) a voxel of a file of tensors, in its own order; 0 where its mask is 0.

    Raises E131 where they are no six, nor what the file states them to be, or no symmetric matrices.
    """
    values, layout = companion.values, companion.vectors.layout
    count = values.shape[3]
    if layout == "masked" and count == 7:
        return values[..., 1:] * (values[..., :1] != 0)
    if layout == "matrix" and count == 9:
        matrices = values.reshape(*values.shape[:3], 3, 3)
        if abs(matrices - matrices.swapaxes(3, 4)).max() > ASYMMETRY * abs(matrices).max():
            raise XfemnavError("E131", f"{companion.name} holds matrices that are not symmetric; a tensor image holds "
                                       "symmetric ones.")
        return np.stack([matrices[..., i, j] for i, j in ORDERS["fsl"]], axis=-1)
    if count != 6:
        raise XfemnavError("E131", f"{companion.name} has {count} values a voxel, a tensor image has 6.")
    return values
