"""Surfaces in VTK's legacy format, POLYDATA (.vtk), versions 1 to 5, ASCII and binary.

The format: https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html. What is said of points is kept
as it is, what is said of cells without the cells that are left out. Normals are left out, since they would be those of
the old surface. Triangle strips become triangles.
"""

import re
from typing import NamedTuple

import numpy as np

from xfemnav.imaging.points.surface_form import Form, damaged, numbers, starts, texts, unreadable
from xfemnav.imaging.points.vtk_cells import KINDS, Cells

TYPES = {"unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4",
         "unsigned_long": "u8", "long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4", "vtktypeint64": "i8",
         "vtktypeuint64": "u8", "vtktypeint32": "i4", "vtktypeuint32": "u4", "vtktypeint16": "i2",
         "vtktypeuint16": "u2", "vtktypeint8": "i1", "vtktypeuint8": "u1"}
WIDTH = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1, "EDGE_FLAGS": 1}
WORD = re.compile(rb"\S+")
ARRAYS = 10_000  # in a file


class Unknown(Exception):
    """What is sound but not read; the text says what it is and how to mend it."""


class _Part(NamedTuple):
    """A stretch of the file that is kept: its lines, and the `rows` of an array behind them. Where there is a `tail`,
    the number of rows stands between it and the `head`."""

    head: bytes
    rows: np.ndarray | None = None
    tail: bytes = b""


def decoded(content: bytes, name: str, limit: int) -> Form:
    """The surface in the bytes of a legacy .vtk file."""
    try:
        file = _Reader(content)
        points, groups = file.geometry()
        cells = Cells.of(groups)
        about = file.data(len(points), cells.n_rows)
    except Unknown as error:
        raise unreadable(name, str(error)) from None
    except (ValueError, LookupError, TypeError, ArithmeticError, MemoryError) as error:
        raise damaged(name, error) from None

    def rewritten(new, kept) -> bytes:
        parts = [file.head, file.line(f"POINTS {len(new)} {file.kind}"), file.rows(new.astype(TYPES[file.kind]))]
        for kind in KINDS[:3]:
            corners, count = cells.of_kind(kind, kept)
            if len(count):
                parts += file.cells(kind, corners, count)
        for section, n in (("POINT_DATA", len(points)), ("CELL_DATA", int(kept.sum()))):
            if about.get(section):
                parts.append(file.line(f"{section} {n}"))
            for part in about.get(section, ()):
                rows = part.rows
                if rows is not None and section == "CELL_DATA":
                    rows = rows[cells.row[kept]]
                parts += [part.head, str(n).encode() + part.tail if part.tail else b""]
                parts.append(b"" if rows is None else file.rows(rows))
        return b"".join(parts)

    return Form(points.astype(float), cells.corners, cells.count, rewritten, file.remarks)


class _Reader:
    """A legacy file, read from its beginning on; `head` is what comes before its points."""

    def __init__(self, content: bytes):
        self.content, self.at, self.arrays = content, 0, 0
        magic, self.title, form, kind = (self.take_line() for _ in range(4))
        found = re.match(rb"# vtk DataFile Version (\d+)\.(\d+)", magic)
        if not found:
            raise ValueError("it is no file of VTK's legacy format")
        self.version = int(found[1]), int(found[2])
        self.binary = {b"ASCII": False, b"BINARY": True}[form.strip().upper()]
        if kind.split()[0].upper() != b"DATASET" or kind.split()[1].upper() != b"POLYDATA":
            raise Unknown(f"holds {kind[:60].decode('ascii', 'replace')!r}; a surface is DATASET POLYDATA. Write it as "
                          "one (ParaView: Extract Surface).")
        self.remarks, self.head = self.title, b""

    def take_line(self) -> bytes:
        """The next line that is not empty; b"" at the end."""
        while self.at < len(self.content):
            end = self.content.find(b"\n", self.at)
            end = len(self.content) if end < 0 else end
            line, self.at = self.content[self.at : end].strip(), end + 1
            if line:
                return line
        return b""

    def geometry(self):
        """Points (n, 3), and corners and their number of the cells of each kind."""
        start, points, groups = 0, None, {}
        while (before := self.at) < len(self.content):
            words = self.take_line().split()
            what = words[0].upper().decode("ascii", "replace") if words else ""
            if what == "FIELD":
                for item, _, rows in self.fields(int(words[2])):
                    if item == "SPACE" and isinstance(rows, list):
                        self.remarks += b"\nSPACE=" + b" ".join(rows)
            elif what == "POINTS":
                self.head = self.content[start:before]
                self.kind = words[2].decode().lower()
                points = self.take(int(words[1]), 3, self.kind)
            elif what in KINDS:
                groups[what] = self.take_cells(int(words[1]), int(words[2]))
            elif what == "METADATA":
                self.skip_metadata()
            elif what in ("POINT_DATA", "CELL_DATA", ""):
                self.at = before
                break
            else:
                raise ValueError(f"a line {b' '.join(words)[:40]!r} was not expected")
        if points is None:
            raise ValueError("it has no POINTS")
        return points, groups

    def take(self, n: int, width: int, kind: str, may_be_text: bool = False):
        """The next array, (n, width); a list of texts where that may be, and is, its kind."""
        self.arrays += 1
        if n < 0 or not 0 < width < 1000 or self.arrays > ARRAYS:
            raise ValueError(f"an array of {n} rows of {width}")
        if kind == "string" and may_be_text:
            return self.take_texts(n * width)
        if kind not in TYPES:
            raise Unknown(f"has an array of type {kind}, which is not read. Leave it out.")
        dtype = np.dtype(TYPES[kind])
        if self.binary:
            found = self.content[self.at : self.at + n * width * dtype.itemsize]
            self.at += len(found)
            values = np.frombuffer(found, dtype.newbyteorder(">"))
            if len(values) != n * width:
                raise ValueError(f"it ends in an array of {n} rows")
        else:
            values = self.take_numbers(n * width, dtype)
        return values.reshape(n, width)

    def take_numbers(self, n: int, dtype) -> np.ndarray:
        """The next `n` words as numbers (n,) of `dtype`. Raises ValueError where there are fewer, or a word is none."""
        if n > len(self.content) - self.at:
            raise ValueError(f"it has no {n} numbers more")
        found = WORD.finditer(self.content, self.at)
        last = self.at

        def words():
            nonlocal last
            for word in found:
                last = word.end()
                yield word[0]

        values = numbers(words(), n, dtype)
        self.at = last
        return values

    def take_texts(self, n: int) -> list[bytes]:
        """Texts, each with its length before it (binary), or on a line."""
        found = []
        for _ in range(n):
            if self.at >= len(self.content):
                raise ValueError("it ends in a text")
            if not self.binary:
                found.append(self.take_line())
                continue
            first = self.content[self.at]
            size = 1 << (3 - (first >> 6))  # two bits say in how many bytes the length stands
            length = int.from_bytes(self.content[self.at : self.at + size], "big") & ((1 << (8 * size - 2)) - 1)
            found.append(self.content[self.at + size : self.at + size + length])
            self.at += size + length
            if self.at > len(self.content):
                raise ValueError("it ends in a text")
        return found

    def take_cells(self, n: int, size: int):
        """Corners and their number of `n` cells: as numbers of corners and corners, `size` in all, or since version 5
        as offsets, n of them, and `size` corners."""
        if self.version >= (5, 0):
            offsets = self.take(n, 1, self.take_line().split()[1].decode().lower()).ravel().astype(int)
            corners = self.take(size, 1, self.take_line().split()[1].decode().lower()).ravel().astype(int)
            count = np.diff(offsets)
            if n and (offsets[0] != 0 or (count < 0).any() or offsets[-1] != size):
                raise ValueError("cells end before they begin")
            return corners, count
        flat, at = self.take(size, 1, "int").ravel().astype(int), 0
        places, listed = np.zeros(max(n, 0), int), flat.tolist()
        for k in range(n):
            places[k] = at
            at += 1 + max(listed[at], 0)
        if at != size:
            raise ValueError(f"{n} cells have {at} numbers, not {size}")
        return np.delete(flat, places), flat[places]

    def skip_metadata(self) -> None:
        """What ends with an empty line."""
        while self.at < len(self.content):
            end = self.content.find(b"\n", self.at)
            end = len(self.content) if end < 0 else end
            line, self.at = self.content[self.at : end].strip(), end + 1
            if not line:
                return

    def fields(self, n: int):
        """Name, the words of the line, and rows of the `n` arrays of a FIELD."""
        found = []
        while len(found) < n:
            line = self.take_line()
            if not line:
                raise ValueError("it ends in a field")
            if line.upper() == b"METADATA":
                self.skip_metadata()
                continue
            name, width, rows, kind = line.split()
            found.append((name.decode("latin-1"), line.split(),
                          self.take(int(rows), int(width), kind.decode().lower(), may_be_text=True)))
        return found

    def data(self, n_points: int, n_cells: int) -> dict[str, list[_Part]]:
        """What is said of points and of cells, without normals, by section."""
        found, section, n = {}, "", 0
        while line := self.take_line():
            what, *words = line.split()
            what = what.upper().decode("ascii", "replace")
            if what in ("POINT_DATA", "CELL_DATA"):
                section, n = what, n_points if what == "POINT_DATA" else n_cells
                if int(words[0]) != n:
                    raise ValueError(f"{section} has {int(words[0])} rows, not {n}")
                found[section] = []
            elif what == "METADATA":
                self.skip_metadata()
            elif not section:
                raise ValueError(f"a line {line[:40]!r} was not expected")
            else:
                found[section] += self.attribute(what, words, line, n)
        return found

    def attribute(self, what: str, words: list[bytes], line: bytes, n: int) -> list[_Part]:
        """One attribute of `n` points or cells."""
        head = line + b"\n"
        if what == "FIELD":
            arrays = [(own, rows) for _, own, rows in self.fields(int(words[1])) if isinstance(rows, np.ndarray)]
            if any(len(rows) != n for _, rows in arrays):
                raise ValueError("a field is not as long as its points or cells")
            return [_Part(self.line(f"FIELD {words[0].decode('latin-1')} {len(arrays)}")),
                    *(_Part(b" ".join(own[:2]) + b" ", rows, b" " + own[3] + b"\n") for own, rows in arrays)]
        if what == "LOOKUP_TABLE":
            kind = "unsigned_char" if self.binary else "float"
            return [_Part(head + self.rows(self.take(int(words[1]), 4, kind)))]
        if what == "COLOR_SCALARS":
            return [_Part(head, self.take(n, int(words[1]), "unsigned_char" if self.binary else "float"))]
        if what == "SCALARS":
            width = int(words[2]) if len(words) > 2 else 1
            before = self.at
            table = self.take_line()
            if table.upper().startswith(b"LOOKUP_TABLE"):
                head += table + b"\n"
            else:
                self.at = before
            return [_Part(head, self.take(n, width, words[1].decode().lower()))]
        if what == "TEXTURE_COORDINATES":
            return [_Part(head, self.take(n, int(words[1]), words[2].decode().lower()))]
        if what not in WIDTH:
            raise Unknown(f"has {what[:40]!a}, which is not read. Leave it out.")
        part = _Part(head, self.take(n, WIDTH[what], words[1].decode().lower()))
        return [] if what == "NORMALS" else [part]

    def line(self, text: str) -> bytes:
        """A line of the file."""
        return text.encode("latin-1") + b"\n"

    def rows(self, values) -> bytes:
        """An array as the file writes it."""
        if self.binary:
            return np.asarray(values).astype(values.dtype.newbyteorder(">")).tobytes() + b"\n"
        return "".join(" ".join(row) + "\n" for row in texts(values)).encode()

    def cells(self, kind: str, corners, count) -> list[bytes]:
        """Cells of a kind as the file's version writes them."""
        if self.version >= (5, 0):
            own = "vtktypeint64"
            return [self.line(f"{kind} {len(count) + 1} {len(corners)}"), self.line(f"OFFSETS {own}"),
                    self.rows(starts(count).astype("i8")[:, None]), self.line(f"CONNECTIVITY {own}"),
                    self.rows(np.asarray(corners, "i8")[:, None])]
        flat = np.insert(corners, starts(count)[:-1], count).astype("i4")
        return [self.line(f"{kind} {len(count)} {len(flat)}"), self.rows(flat[:, None])]
