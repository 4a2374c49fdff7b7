"""VTK's XML files (.vtp, .vtu): their arrays, ASCII, binary or appended, plain or compressed, read and put back.

The format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html. An array is unpacked when it is
asked for, and only where it is as long as the file says elsewhere that it must be.
"""

import base64
import lzma
import re
import zlib
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.surface_form import numbers, texts
from xfemnav.imaging.reading.content import size, unpacked_limit

TYPES = {"Float32": "f4", "Float64": "f8", "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4",
         "UInt32": "u4", "Int64": "i8", "UInt64": "u8"}
ENDINGS = {"PolyData": ".vtp", "UnstructuredGrid": ".vtu"}
LZMA_MEMORY = 1 << 28  # bytes, for its dictionary
BLOCK = 1 << 18  # bytes that are compressed at a time when an array is written
TAGS = 100_000
APPENDED = re.compile(rb"<AppendedData\b[^>]*>")
#: What a broken file makes of the functions here; their caller says of which file.
FAULTS = (ElementTree.ParseError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError,
          zlib.error, lzma.LZMAError)


class Unknown(Exception):
    """What is sound but not read; the text says what it is and how to mend it."""


def _inflate(block: bytes, n: int) -> bytes:
    inflater = zlib.decompressobj()
    return _whole(inflater.decompress(block, n + 1), n, inflater)


def _unxz(block: bytes, n: int) -> bytes:
    unpacker = lzma.LZMADecompressor(memlimit=LZMA_MEMORY)
    return _whole(unpacker.decompress(block, n + 1), n, unpacker)


def _whole(found: bytes, n: int, unpacker) -> bytes:
    if len(found) != n or not unpacker.eof:
        raise ValueError(f"a compressed block holds {len(found)} bytes or more, not {n}")
    return found


#: Name: how a block of n bytes is unpacked, and how one is packed.
COMPRESSORS = {"vtkZLibDataCompressor": (_inflate, zlib.compress), "vtkLZMADataCompressor": (_unxz, lzma.compress)}


class Document:
    """A VTK XML file of the type `wanted` (PolyData, UnstructuredGrid): its tree, and access to its arrays.

    Raises FAULTS, `Unknown`, and E102 from `array` where the file unpacks to more than `limit` bytes.
    """

    def __init__(self, content: bytes, wanted: str, name: str, limit: int):
        text, self._appended, self._encoded = _split(content)
        if re.search(rb"<!(?!--)", text) or text.count(b"<") > TAGS:
            raise ValueError(f"it defines entities, or has over {TAGS} tags")
        if b"<VTKFile" not in text[:2000]:
            raise ValueError("it is no XML file of VTK's")
        self.root = ElementTree.fromstring(text)
        if (kind := self.root.get("type")) != wanted:
            raise Unknown(f"holds {kind}, not {wanted}. Write it as {wanted} ({ENDINGS[wanted]}), for instance with "
                          "ParaView.")
        order = {"LittleEndian": "<", "BigEndian": ">"}[self.root.get("byte_order", "LittleEndian")]
        self._order, self._length = order, np.dtype(TYPES[self.root.get("header_type", "UInt32")]).newbyteorder(order)
        self._compressor = self.root.get("compressor")
        self._unpack, self._pack = COMPRESSORS.get(self._compressor, (None, None))
        self._name, self._most = name, unpacked_limit(len(content), limit)
        self._left = self._most
        offsets = sorted({int(item.get("offset")) for item in self._arrays() if item.get("format") == "appended"})
        self._ends = dict(pairwise([*offsets, len(self._appended)]))

    def _arrays(self):
        return (item for item in self.root.iter() if item.tag in ("DataArray", "Array"))

    def piece(self):
        """The one Piece of the data."""
        grid = self.root.find(self.root.get("type"))
        pieces = [] if grid is None else grid.findall("Piece")
        if len(pieces) != 1:
            raise Unknown(f"holds {len(pieces)} pieces; one is read. Append them to one (ParaView: Merge Blocks).")
        return pieces[0]

    def array(self, item, n: int) -> np.ndarray:
        """The array of a DataArray `item`, (n,), or (n, k) where it has k components."""
        k = int(item.get("NumberOfComponents") or 1)
        if not 0 < k < 1000 or n < 0:
            raise ValueError(f"an array has {k} components of {n} rows")
        if item.get("format", "ascii") not in ("ascii", "binary", "appended"):
            raise ValueError(f"an array has the format {item.get('format')!r}")
        if item.get("type") not in TYPES:
            raise Unknown(f"has an array of type {item.get('type')}, which is not read. Leave it out.")
        dtype = np.dtype(TYPES[item.get("type")]).newbyteorder(self._order)
        if item.get("format", "ascii") == "ascii":
            words = _text(item).split()
            if len(words) != n * k:
                raise ValueError(f"an array has {len(words)} of {n * k} numbers")
            values = numbers(words, n * k, dtype.newbyteorder("="))
        else:
            values = np.frombuffer(self._bytes(item, n * k * dtype.itemsize), dtype)
        return values if k == 1 else values.reshape(n, k)

    def words(self, item) -> bytes:
        """The characters of a String Array, short ones."""
        if item.get("format", "ascii") == "ascii":
            return bytes(int(word) for word in _text(item).split()[:1000])
        return self._bytes(item, None)

    def _bytes(self, item, wanted: int | None) -> bytes:
        """The unpacked bytes of an array: `wanted` of them, or few where that is not known."""
        if self._compressor and self._unpack is None:
            raise Unknown(f"is compressed by {self._compressor}, which is not read. Write it with ZLib, or "
                          "uncompressed (ParaView: Compressor Type).")
        if item.get("format") == "appended":
            at = int(item.get("offset"))
            source, encoded = self._appended[at : self._ends[at]], self._encoded
        else:
            source, encoded = "".join(_text(item).split()).encode(), True
        take = _Base64(source) if encoded else _Raw(source)
        h = self._length.itemsize
        if self._unpack is None:
            n = self._count(take(0, h))
            self._claim(n, wanted)
            data = take.rest(h, n)
        else:
            n_blocks, whole, last = (self._count(part) for part in _thirds(take(0, 3 * h)))
            if n_blocks * h > len(source):
                raise ValueError(f"an array claims {n_blocks} blocks")
            sizes = [whole] * n_blocks
            if n_blocks and last:
                sizes[-1] = last
            self._claim(sum(sizes), wanted)
            packed = np.frombuffer(take(3 * h, n_blocks * h), self._length)
            at = np.concatenate([[0], np.cumsum(packed.astype(np.int64))])
            blocks = take.apart((3 + n_blocks) * h, int(at[-1]))
            data = b"".join(self._unpack(blocks[a:b], n) for a, b, n in zip(at, at[1:], sizes))
        if wanted is not None and len(data) != wanted:
            raise ValueError(f"an array has {len(data)} of {wanted} bytes")
        return data

    def _count(self, data: bytes) -> int:
        return int(np.frombuffer(data, self._length, 1)[0])

    def _claim(self, n: int, wanted: int | None) -> None:
        """Refuse an array of `n` bytes that is not as long as `wanted`, or too much with those before it (E102)."""
        if n < 0 or (n != wanted if wanted is not None else n > 10_000):
            raise ValueError(f"an array has {n} bytes, not {wanted}")
        self._left -= n
        if self._left < 0:
            raise XfemnavError("E102", f"{self._name} unpacks to more than {size(self._most)}, which no points do from "
                                       "so small a file, or the limit. Check where it comes from.")

    def replace(self, item, values) -> None:
        """Put other `values` into a DataArray, in the same form, when the document is written."""
        values = np.asarray(values).astype(np.dtype(TYPES[item.get("type")]).newbyteorder(self._order))
        for about in ("RangeMin", "RangeMax"):
            item.attrib.pop(about, None)
        item[:] = []
        form = item.get("format", "ascii")
        if form == "ascii":
            item.text = "\n" + " ".join(texts(values).ravel()) + "\n"
        elif form == "binary":
            item.text = self._packed(values.tobytes(), True).decode()
        else:
            at = int(item.get("offset"))
            self._ends[-1 - at] = self._packed(values.tobytes(), self._encoded)

    def written(self) -> bytes:
        """The document as a file."""
        blocks, place = [], 0
        for item in self._arrays():
            if item.get("format") == "appended":
                at = int(item.get("offset"))
                block = self._ends.get(-1 - at) or self._appended[at : self._ends[at]]
                item.set("offset", str(place))
                blocks.append(block)
                place += len(block)
        data = self.root.find("AppendedData")
        if data is None:
            return b'<?xml version="1.0"?>\n' + ElementTree.tostring(self.root) + b"\n"
        data.text = "@"
        before, after = ElementTree.tostring(self.root).split(b"@</AppendedData>")
        return b"".join([b'<?xml version="1.0"?>\n', before, b"_", *blocks, b"\n</AppendedData>", after, b"\n"])

    def _packed(self, data: bytes, encoded: bool) -> bytes:
        encode = base64.b64encode if encoded else bytes
        if self._pack is None:
            return encode(np.array(len(data), self._length).tobytes() + data)
        blocks = [data[at : at + BLOCK] for at in range(0, len(data), BLOCK)]
        packed = [self._pack(block) for block in blocks]
        head = [len(blocks), BLOCK, len(data) % BLOCK, *map(len, packed)]
        return encode(np.array(head, self._length).tobytes()) + encode(b"".join(packed))


class _Raw:
    """Bytes of an appended block as they are."""

    def __init__(self, source: bytes):
        self._source = source

    def __call__(self, at: int, n: int) -> bytes:
        if at + n > len(self._source):
            raise ValueError(f"an array ends after {len(self._source)} of {at + n} bytes")
        return self._source[at : at + n]

    rest = apart = __call__


class _Base64:
    """Bytes of a block in base64. What follows the lengths may be encoded with them, or for itself."""

    def __init__(self, source: bytes):
        self._source = source

    def __call__(self, at: int, n: int) -> bytes:
        """Bytes of the lengths; they are at the beginning."""
        found = base64.b64decode(self._source[: _characters(at + n)], validate=True)[at : at + n]
        if len(found) != n:
            raise ValueError("an array ends early")
        return found

    def rest(self, at: int, n: int) -> bytes:
        """`n` bytes that follow `at` bytes of lengths."""
        if b"=" in self._source[: _characters(at)]:
            return self.apart(at, n)
        return self(at, n)

    def apart(self, at: int, n: int) -> bytes:
        """The same where they are encoded for themselves."""
        return _Base64(self._source[_characters(at) :])(0, n)


def _characters(n: int) -> int:
    """How many characters of base64 hold `n` bytes."""
    return (n + 2) // 3 * 4


def _thirds(data: bytes):
    n = len(data) // 3
    return data[:n], data[n : 2 * n], data[2 * n :]


def _text(item) -> str:
    """The text of an element and behind its children, which say more of the array."""
    return (item.text or "") + "".join(child.tail or "" for child in item)


def _split(content: bytes) -> tuple[bytes, bytes, bool]:
    """The XML without its appended data, these, and whether they are in base64."""
    tag = APPENDED.search(content)
    if tag is None:
        return content, b"", False
    end = content.rfind(b"</AppendedData>")
    start = content.find(b"_", tag.end()) + 1
    if end < start or start == 0 or content[tag.end() : start - 1].strip():
        raise ValueError("its appended data have no beginning or no end")
    encoded = b"base64" in tag[0]
    data = content[start:end]
    return content[: tag.end()] + content[end:], data.strip() if encoded else data, encoded
