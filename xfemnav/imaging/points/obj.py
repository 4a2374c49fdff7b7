"""Wavefront OBJ: lines of text, of which those of points and faces are written anew and all others kept.

Normals (`vn`) are left out, since they would be those of the old surface; programs make their own. Further numbers of a
point (a weight, a colour) stay behind it.
"""

import numpy as np

from xfemnav.imaging.points.surface_form import Form, damaged

FACES = (b"f", b"l", b"p")


def decoded(content: bytes, name: str, limit: int) -> Form:
    """The surface in the bytes of an OBJ file."""
    lines = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").split(b"\n")
    words = [line.split(None, 1)[:1] for line in lines]
    kind = [first[0] if first else b"" for first in words]
    at = [k for k, first in enumerate(kind) if first == b"v"]
    face_at = [k for k, first in enumerate(kind) if first in FACES]
    try:
        points = np.array([[float(x) for x in lines[k].split()[1:4]] for k in at], float).reshape(len(at), 3)
        before = np.searchsorted(at, face_at)  # a negative number counts back from the points read so far
        faces = [[_number(word, n) for word in lines[k].split()[1:]] for k, n in zip(face_at, before.tolist())]
        corners = np.array([corner for face in faces for corner in face], np.int64)
    except (ValueError, OverflowError) as error:
        raise damaged(name, error) from None
    count = np.array([len(face) for face in faces], int)

    def rewritten(new, kept) -> bytes:
        told = {k: b" ".join([b"v", *(f"{x:.9g}".encode() for x in point), *lines[k].split()[4:]])
                for k, point in zip(at, new)}
        told |= {k: _without_normals(lines[k]) if keep else None for k, keep in zip(face_at, kept)}
        told |= {k: None for k, first in enumerate(kind) if first == b"vn"}
        left = (told.get(k, line) for k, line in enumerate(lines))
        # What ends in a backslash would go on in the next line.
        return b"\n".join(line + b" " * line.endswith(b"\\") for line in left if line is not None)

    remarks = b"\n".join(line for line in lines if line.lstrip().startswith(b"#"))
    return Form(points, corners, count, rewritten, remarks)


def _number(word: bytes, n: int) -> int:
    """The number, from 0, of the point that a face's word "7/1/2" or "-1" names behind `n` points."""
    k = int(word.partition(b"/")[0])
    if k == 0:
        raise ValueError("a face names point 0; the first one is 1")
    return k - 1 if k > 0 else n + k


def _without_normals(line: bytes) -> bytes:
    """A face's line, its words "7/1/2" as "7/1"."""
    first, *words = line.split()
    return b" ".join([first, *(b"/".join(word.split(b"/")[:2]).rstrip(b"/") for word in words)])
