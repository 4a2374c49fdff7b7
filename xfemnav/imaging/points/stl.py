"""STL, binary and ASCII: facets of three corners each.

Equal corners are one point here. Normals are made anew; colours (the two bytes of a binary facet) are kept, and so are
the names of several solids in one text.
"""

import re

import numpy as np

from xfemnav.imaging.points.surface_form import Form, numbers, texts, unreadable

HEADER = 84
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
CORNER = re.compile(rb"^\s*vertex\s+(.*?)\s*$", re.IGNORECASE | re.MULTILINE)
SOLID, END = (re.compile(rb"^\s*" + word + rb"\b", re.IGNORECASE | re.MULTILINE) for word in (b"solid", b"endsolid"))
OPENING = re.compile(rb"^\s*(?:end)?(?:facet|solid)\b", re.IGNORECASE | re.MULTILINE)
OF_TEXT = re.compile(rb"^\s*facet\b.*?^\s*endfacet\b[^\n]*\n?", re.IGNORECASE | re.MULTILINE | re.DOTALL)


def decoded(content: bytes, name: str, limit: int) -> Form:
    """The surface in the bytes of an STL file."""
    n = int.from_bytes(content[HEADER - 4 : HEADER], "little")
    if len(content) >= HEADER and len(content) == HEADER + n * FACET.itemsize:
        return _binary(content)
    if content.lstrip()[:5].lower() == b"solid":
        return _text(content, name)
    raise unreadable(name, f"is no STL, or a damaged one: it has {len(content)} bytes, and a binary file of {n} facets "
                           f"{HEADER + n * FACET.itemsize}. Save the surface again.")


def _binary(content: bytes) -> Form:
    facets = np.frombuffer(content, FACET, offset=HEADER)
    points, corners = _welded(facets["corners"])

    def rewritten(new, kept) -> bytes:
        found = facets[kept].copy()
        found["corners"] = new[corners.reshape(-1, 3)[kept]]
        found["normal"] = _normals(found["corners"])
        return content[: HEADER - 4] + len(found).to_bytes(4, "little") + found.tobytes()

    return Form(points, corners, np.full(len(facets), 3), rewritten, content[: HEADER - 4])


def _text(content: bytes, name: str) -> Form:
    facets = list(OF_TEXT.finditer(content))
    words = [found[1].split() for facet in facets for found in CORNER.finditer(facet[0])]
    try:
        if (len(words) != 3 * len(facets) or len(CORNER.findall(content)) != len(words)
                or any(len(OPENING.findall(facet[0])) != 2 for facet in facets)):
            raise ValueError("a facet has other than three corners, or no end")
        if len(SOLID.findall(content)) != len(END.findall(content)) or not END.match(content.rstrip().splitlines()[-1]):
            raise ValueError("a solid has no end")
        corner = numbers((word for three in words for word in three), 3 * len(words), "f8").reshape(-1, 3, 3)
    except (ValueError, OverflowError) as error:
        raise unreadable(name, f"is a damaged STL text ({error}). Save the surface again.") from None
    points, corners = _welded(corner)

    def rewritten(new, kept) -> bytes:
        found = new.astype("f4")[corners.reshape(-1, 3)]
        parts, end = [], 0
        for facet, keep, normal, three in zip(facets, kept, texts(_normals(found)), texts(found)):
            parts.append(content[end : facet.start()])
            end = facet.end()
            if keep:
                parts.append(_facet(normal, three))
        return b"".join([*parts, content[end:]])

    return Form(points, corners, np.full(len(facets), 3), rewritten, content.lstrip().partition(b"\n")[0])


def _facet(normal, three) -> bytes:
    rows = "".join(f"    vertex {' '.join(corner)}\n" for corner in three)
    return f"  facet normal {' '.join(normal)}\n   outer loop\n{rows}   endloop\n  endfacet\n".encode()


def _welded(facets) -> tuple[np.ndarray, np.ndarray]:
    """The different corners (n, 3) of facets (m, 3, 3), and their numbers (3 m,)."""
    points, corners = np.unique(facets.reshape(-1, 3).astype(float), axis=0, return_inverse=True)
    return points, corners.reshape(-1)


def _normals(corners) -> np.ndarray:
    """Unit normals (m, 3) of triangles (m, 3, 3), 0 of flat ones."""
    a, b, c = corners.astype(float).swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)[:, None]
    return (normal / np.where(length > 0, length, 1)).astype("f4")
