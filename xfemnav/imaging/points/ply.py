"""PLY, ASCII and binary of either byte order: points, faces, and whatever else a file says of them.

Rows are kept as they are but for the three coordinates of a point. Normals (nx, ny, nz) of points are left out, since
they would be those of the old surface; programs make their own.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.recfunctions import repack_fields

from xfemnav.imaging.points.surface_form import Form, damaged, texts, unreadable

TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
         "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
         "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8"}
FORMATS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
AXES, NORMALS, CORNERS = ("x", "y", "z"), ("nx", "ny", "nz"), ("vertex_indices", "vertex_index")


class _Property(NamedTuple):
    """A column: its `name`, type, and, of a list, the type of its length."""

    name: str
    type: str
    length: str = ""


class _Element(NamedTuple):
    name: str
    n: int
    properties: tuple[_Property, ...]


def decoded(content: bytes, name: str, limit: int) -> Form:
    """The surface in the bytes of a PLY file."""
    try:
        order, elements, lines, body = _header(content)
        rows, end = {}, 0
        for element in elements:
            rows[element.name], end = (_binary_rows if order else _text_rows)(body, end, element, order)
        vertex, face = ({element.name: element for element in elements}.get(what) for what in ("vertex", "face"))
        if vertex is None or "tristrips" in rows:
            raise unreadable(name, "holds triangle strips or no vertices; triangles are read. Save it as triangles.")
        points = _points(rows["vertex"], vertex, order)
        corners, count = _corners(rows["face"], face, order) if face else (np.zeros(0, int), np.zeros(0, int))
    except (ValueError, LookupError, ArithmeticError, TypeError) as error:
        raise damaged(name, error) from None

    def rewritten(new, kept) -> bytes:
        parts = [*_kept_lines(lines, int(kept.sum()))]
        for element in elements:
            own = rows[element.name]
            if element.name == "vertex":
                own = _moved(own, vertex, order, new)
            elif element.name == "face":
                own = _kept(own, kept, order)
            parts += [table.tobytes() for table in own] if order else [line + b"\n" for line in own]
        return b"".join(parts) + bytes(body[end:])

    return Form(points, corners, count, rewritten, b"\n".join(lines))


def _header(content: bytes):
    """Byte order ("" for ASCII), elements, lines of the header with their ends, and what follows it."""
    end = content.find(b"end_header")
    after = content.find(b"\n", end) + 1
    if not content.startswith(b"ply") or end < 0 or after == 0 or end > 1 << 20:
        raise ValueError("it has no header of a PLY")
    lines = content[:after].splitlines(keepends=True)
    order, elements = None, []
    for line in lines[1:-1]:
        what, *words = line.split() or [b"comment"]
        words = [word.decode("ascii", "replace") for word in words]
        if what == b"format":
            order = FORMATS[words[0].encode()]
        elif what == b"element":
            elements.append(_Element(words[0], int(words[1]), ()))
        elif what == b"property" and len(words) == (4 if words[0] == "list" else 2):
            found = _Property(words[3], TYPES[words[2]], TYPES[words[1]]) if words[0] == "list" else _Property(
                words[1], TYPES[words[0]])
            elements[-1] = elements[-1]._replace(properties=(*elements[-1].properties, found))
        elif what not in (b"comment", b"obj_info"):
            raise ValueError(f"its header has a line {line[:40]!r}")
    if order is None or len({element.name for element in elements}) != len(elements) or any(
            element.n < 0 for element in elements):
        raise ValueError("its header names no format, or elements twice")
    return order, elements, lines, memoryview(content)[after:]


def _text_rows(body, start: int, element: _Element, order: str):
    """The lines of an element, and where the next one begins."""
    if element.n > len(body) - start:
        raise ValueError(f"it has no {element.n} rows of {element.name}")
    text, rows = bytes(body[start:]), []
    at = 0
    while len(rows) < element.n:
        end = text.find(b"\n", at)
        end = len(text) if end < 0 else end
        if at >= len(text):
            raise ValueError(f"it ends after {len(rows)} of {element.n} rows of {element.name}")
        line = text[at:end].strip()
        rows += [line] if line else []
        at = end + 1
    return rows, start + min(at, len(text))


def _binary_rows(body, start: int, element: _Element, order: str):
    """Tables of the rows of an element, each of rows whose lists are equally long; and where the next one begins."""
    at, tables, n_read, window = start, [], 0, 16
    while n_read < element.n:
        row = _row_type(body, at, element, order)
        ahead = (len(body) - at) // row.itemsize if row.itemsize else 0
        if ahead < 1:
            raise ValueError(f"it ends after {n_read} of {element.n} rows of {element.name}")
        table = np.frombuffer(body, row, min(ahead, element.n - n_read, window), at)
        same = np.ones(len(table), bool)
        for column in row.names:
            if column.startswith("length "):
                same &= table[column] == table[column][0]
        n = len(table) if same.all() else int(np.argmin(same))
        window = 16 if n < len(table) else 4 * window
        tables.append(table[:n])
        at, n_read = at + n * row.itemsize, n_read + n
    return tables, at


def _row_type(body, at: int, element: _Element, order: str) -> np.dtype:
    """The type of the row at a place of the body, its lists as long as they are there."""
    columns = []
    for k, column in enumerate(element.properties):
        if column.length:
            columns.append((f"length {k}", order + column.length))
            place = at + np.dtype(columns).itemsize
            head = body[place - np.dtype(column.length).itemsize : place]
            if len(head) < np.dtype(column.length).itemsize:
                raise ValueError(f"it ends in a row of {element.name}")
            n = int(np.frombuffer(head, order + column.length)[0])
            if not 0 <= n <= len(body):
                raise ValueError(f"a list has {n} values")
            columns.append((f"{k} {column.name}", order + column.type, n))
        else:
            columns.append((f"{k} {column.name}", order + column.type))
    return np.dtype(columns)


def _column(element: _Element, *names: str) -> int:
    found = [k for k, column in enumerate(element.properties) if column.name in names]
    if len(found) != 1:
        raise ValueError(f"{element.name} has no column {names[0]}, or several")
    return found[0]


def _points(rows, vertex: _Element, order: str) -> np.ndarray:
    axes = [_column(vertex, axis) for axis in AXES]
    if any(column.length for column in vertex.properties):
        raise ValueError("a vertex has a list")
    if not order:
        words = [row.split() for row in rows]
        if any(len(row) != len(vertex.properties) for row in words):
            raise ValueError("a vertex has other than its columns")
        return np.array([[float(row[k]) for k in axes] for row in words], float).reshape(-1, 3)
    tables = [np.column_stack([table[table.dtype.names[k]] for k in axes]) for table in rows]
    return np.concatenate([np.zeros((0, 3)), *tables]).astype(float)


def _moved(rows, vertex: _Element, order: str, new) -> list[bytes]:
    """The rows of the points at other places, without normals."""
    axes = [_column(vertex, axis) for axis in AXES]
    left = [k for k, column in enumerate(vertex.properties) if column.name not in NORMALS]
    if order:
        # Joined as bytes: numpy would turn them to the byte order of this machine.
        table = np.frombuffer(b"".join(part.tobytes() for part in rows), rows[0].dtype).copy()
        names = table.dtype.names
        for k, values in zip(axes, new.T):
            table[names[k]] = values
        return [repack_fields(table[[names[k] for k in left]])]
    kinds = [vertex.properties[k].type for k in axes]
    written = [texts(values.astype(kind)) for kind, values in zip(kinds, new.T)]
    rows = [row.split() for row in rows]
    for k, words in zip(axes, written):
        for row, word in zip(rows, words):
            row[k] = word.encode()
    return [b" ".join(row[k] for k in left) for row in rows]


def _corners(rows, face: _Element, order: str) -> tuple[np.ndarray, np.ndarray]:
    """Corners (k,) of the faces and their number (m,) of each."""
    chosen = _column(face, *CORNERS)
    if not face.properties[chosen].length:
        raise ValueError("its faces are no lists")
    if order:
        found = [table[table.dtype.names[_place(table, chosen)]].reshape(len(table), -1) for table in rows]
        count = np.concatenate([np.zeros(0, int), *(np.full(len(part), part.shape[1]) for part in found)])
    else:
        found = [_text_list(row, face, chosen) for row in rows]
        count = np.array([len(part) for part in found])
    return np.concatenate([np.zeros(0, int), *(part.reshape(-1) for part in found)]).astype(int), count.astype(int)


def _place(table, chosen: int) -> int:
    """Where the column number `chosen` stands in a table, in which a list's length is a column too."""
    return next(k for k, name in enumerate(table.dtype.names) if name.startswith(f"{chosen} "))


def _kept(rows, kept, order: str):
    """Those of an element's rows that are `kept` (m,) bool."""
    if not order:
        return [rows[k] for k in np.flatnonzero(kept)]
    ends = np.cumsum([len(table) for table in rows])
    return [table[part] for table, part in zip(rows, np.split(kept, ends[:-1]))] if rows else []


def _text_list(row: bytes, face: _Element, chosen: int) -> np.ndarray:
    words, at = row.split(), 0
    for k, column in enumerate(face.properties):
        n = int(words[at]) if column.length else 1
        at += bool(column.length)
        if k == chosen:
            corners = [int(word) for word in words[at : at + n]]
            if len(corners) != n:
                raise ValueError("a face ends early")
            return np.array(corners, int)
        at += n
    raise ValueError("a face has no corners")


def _kept_lines(lines: list[bytes], n_faces: int):
    """The lines of a header with another number of faces, and without the normals of points."""
    element = b""
    for line in lines:
        words = line.split()
        if words[:1] == [b"element"]:
            element = words[1]
            if element == b"face":
                line = line.replace(words[2], str(n_faces).encode())
        if not (element == b"vertex" and words[:1] == [b"property"] and words[-1].decode("latin-1") in NORMALS):
            yield line
