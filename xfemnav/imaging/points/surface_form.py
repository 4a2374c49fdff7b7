"""What the surface formats share: what each of them reads of a file, and how faces are kept.

A format is a module with decoded(content, name, limit): the `Form` of the bytes of a file called `name`, of which no
more than `limit` bytes are unpacked. It raises E701 (`unreadable`), and E102 for what unpacks to too much.
"""

from collections.abc import Callable, Iterable
from itertools import islice
from typing import NamedTuple

import numpy as np

from xfemnav.errors import XfemnavError


class Form(NamedTuple):
    """A file's points (n, 3) in its own frame, and its faces: `corners` (k,), `count` (m,) of them each.

    `rewritten(points, kept)` is the file with other points of its own frame and with the faces that are `kept` (m,)
    bool. Of its frame the file says something in its `remarks` (SPACE=LPS), or by an `affine` (4, 4) to world RAS mm,
    described in `words`; `doubt` says why nothing is known where its format should say it.
    """

    points: np.ndarray
    corners: np.ndarray
    count: np.ndarray
    rewritten: Callable[[np.ndarray, np.ndarray], bytes]
    remarks: bytes = b""
    affine: np.ndarray | None = None
    words: str = ""
    doubt: str = ""


def unreadable(name: str, what: str) -> XfemnavError:
    """The error of a surface `name`; `what` says where it is wrong and how to mend it."""
    return XfemnavError("E701", f"{name} {what}")


def damaged(name: str, error) -> XfemnavError:
    """E701 for a file that is not as its format has it."""
    return unreadable(name, f"is damaged ({error}). Save the surface again.")


def starts(count) -> np.ndarray:
    """Where each of faces of `count` (m,) corners begins among the corners, and their number: (m + 1,)."""
    return np.concatenate([[0], np.cumsum(count)]).astype(int)


def kept_corners(corners, count, kept) -> np.ndarray:
    """The `corners` (k,) of the faces that are `kept` (m,) bool, `count` (m,) of them each."""
    return corners[np.repeat(kept, count)]


def strips_as_triangles(corners, count) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (t, 3) of triangle strips, turned alike, and the strip (t,) that each is of."""
    strip = np.repeat(np.arange(len(count)), np.maximum(count - 2, 0))
    first = starts(np.maximum(count - 2, 0))[:-1]
    k = np.arange(len(strip)) - first[strip]
    at = starts(count)[:-1][strip] + k
    odd = k % 2
    return corners[np.column_stack([at, at + 1 + odd, at + 2 - odd])].reshape(-1, 3), strip


def numbers(words: Iterable[bytes], n: int, dtype) -> np.ndarray:
    """The first `n` numbers of some words. Raises ValueError."""
    convert = float if np.dtype(dtype).kind == "f" else int
    found = np.fromiter(map(convert, islice(words, n)), float if convert is float else np.int64)
    if len(found) != n:
        raise ValueError(f"{len(found)} of {n} numbers are there")
    return found.astype(dtype)


def texts(values: np.ndarray) -> np.ndarray:
    """The shortest texts that give back the `values`, in their shape."""
    return np.asarray(values).astype(str)
