"""Bytes of files and folders: bounded, read once, unpacked to the end of their checksums, and their digests.

What libraries that decode them warn of goes no further than `silenced`.
"""

import codecs
import gzip
import hashlib
import io
import math
import os
import stat
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from xfemnav.errors import XfemnavError, XfemnavWarning

CHUNK = 1 << 22
FILES = 20_000  # in a folder
GZIP_MAGIC = b"\x1f\x8b"
# Points pack to no less than a hundredth of their size: what unpacks to more, small files aside, is to fill memory.
TIMES, SMALL = 100, 1 << 24


#: What is said of a file that is not read, by what is wrong with it: code and words.
IMAGE = {
    "no file": ("E106", "{path} is a pipe, a device or a folder, not a file. Give a file."),
    "empty": ("E106", "{name} is empty (0 bytes); copy it again."),
    "large": ("E102", "{name} holds {size}, over the limit of {limit}; raise it with ⟦max_memory⟧ if the file is "
                      "right."),
    "unread": ("E101", "cannot read {name}: {reason}. Copy it again."),
}


def file_bytes(path, limit: int, words: dict[str, tuple[str, str]] = IMAGE) -> bytes:
    """Bytes of a regular file of at most `limit` bytes; a pipe or device is never waited for.

    Raises E100 where nothing can be opened, and what `words` have for other files.
    """
    def refused(what: str, **facts) -> XfemnavError:
        code, text = words[what]
        return XfemnavError(code, text.format(path=path, name=name, **facts))

    name = Path(path).name or str(path)
    try:
        # O_NONBLOCK: a pipe that nobody writes to opens at once, and is then refused as what it is.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise XfemnavError("E100", f"cannot open {path}: {reason}. Correct the path.") from None
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise refused("no file")
        if status.st_size == 0:
            raise refused("empty")
        if status.st_size > limit:
            raise refused("large", size=size(status.st_size), limit=size(limit))
        with os.fdopen(handle, "rb", closefd=False) as file:
            return file.read(status.st_size)
    except OSError as error:
        raise refused("unread", reason=error.strerror) from None
    finally:
        os.close(handle)


def each_file(path: Path, limit: int) -> Iterator[tuple[str, bytes]]:
    """Names and bytes of the regular files in a folder, sorted; not of its folders, and no hidden one."""
    try:
        sizes = {entry.name: entry.stat().st_size for entry in os.scandir(path)
                 if os.path.isfile(entry.path) and not entry.name.startswith(".")}
    except OSError as error:
        raise XfemnavError("E100", f"cannot open {path}: {error.strerror}. Correct the path.") from None
    if len(sizes) > FILES:
        raise XfemnavError("E102", f"{path} holds {len(sizes)} files, over the limit of {FILES}; give the folder of "
                                   "one DICOM series.")
    return ((name, file_bytes(path / name, limit) if sizes[name] else b"") for name in sorted(sizes))


def decoded(data: bytes) -> str:
    """The text of a file: UTF-8, with a byte-order mark or without. Raises ValueError, which says what it is else."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or 0 in data[:2]:
        raise ValueError("is UTF-16 text ('Unicode' to Notepad and Excel). Save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"is no UTF-8 text (byte {error.start}). Save it as UTF-8") from None


def opened(packed: bytes, name: str, n_head: int):
    """First `n_head` bytes of a file's content, gunzipped where it is gzip, and the stream of what follows them."""
    stream = gzip.GzipFile(fileobj=io.BytesIO(packed)) if packed.startswith(GZIP_MAGIC) else io.BytesIO(packed)
    return read(stream, n_head, name), stream


def read(stream, n_bytes: int, name: str) -> bytes:
    """At most `n_bytes` of a stream, in chunks: memory follows what is there, not what a header claims.

    A gzip stream that comes to its end has its CRC and length checked. Raises E101.
    """
    parts, missing = [], n_bytes
    try:
        while missing > 0 and (part := stream.read(min(CHUNK, missing))):
            parts.append(part)
            missing -= len(part)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        check = f"; check with: gzip -t {name}" if isinstance(stream, gzip.GzipFile) else "."
        raise XfemnavError("E101", f"{name} is damaged: {error} (after {n_bytes - missing} of {n_bytes} bytes). "
                                   f"Copy it again{check}") from None
    return b"".join(parts)


class Zlib:
    """Reads a zlib stream as gzip.GzipFile reads its own, to the end of its checksum; zeros may follow it.

    With `raw`, one that is deflated alone, without checksum.
    """

    def __init__(self, packed: bytes, raw: bool = False):
        self._packed, self._place, self._waiting = packed, 0, b""
        self._inflater = zlib.decompressobj(-zlib.MAX_WBITS if raw else zlib.MAX_WBITS)

    def read(self, n_bytes: int) -> bytes:
        """Between 1 and `n_bytes` bytes, or none at the end."""
        while not self._inflater.eof:
            self._waiting = self._waiting or self._packed[self._place : self._place + CHUNK]
            self._place += 0 if self._inflater.unconsumed_tail else len(self._waiting)
            if not self._waiting:
                raise EOFError("its deflated stream ends early")
            part = self._inflater.decompress(self._waiting, n_bytes)
            self._waiting = self._inflater.unconsumed_tail
            if part:
                return part
        if (self._inflater.unused_data + self._packed[self._place :]).strip(b"\0"):
            raise zlib.error("bytes that are no padding follow its deflated stream")
        return b""


class Forwards:
    """A stream as a file that is read forwards: `read`, `tell`, and a `seek` that goes back by BACK bytes at most.

    Of what is skipped nothing is kept, so that memory follows what is asked for. Raises E102 when more than `limit`
    bytes come out of the stream, E101 when it is damaged, and E105 after READS reads: a reader that keeps something of
    each would fill the memory.
    """

    BACK, READS = 1 << 16, 100_000

    def __init__(self, stream, limit: int, name: str):
        self._stream, self._limit, self._name = stream, limit, name
        self._kept, self._end, self._at, self._reads = bytearray(), 0, 0, 0

    def tell(self) -> int:
        """The place that the next bytes are read from."""
        return self._at

    def seek(self, place: int, whence: int = 0) -> int:
        """Go to `place`, from the start or (`whence` 1) from here; the new place. Nothing is read or checked yet."""
        self._at = place + (self._at if whence else 0)
        return self._at

    def read(self, n_bytes: int = CHUNK) -> bytes:
        """At most `n_bytes` from here on; fewer at the end alone."""
        self._reads += 1
        if self._reads > self.READS:
            raise XfemnavError("E105", f"{self._name} has more than {self.READS} parts, as no image has. Get it again "
                                       "from its source.")
        while (missing := self._at + n_bytes - self._end) > 0 and (part := self._part(max(missing, self.BACK))):
            self._kept += part
            self._end += len(part)
            if self._end > self._limit:
                raise XfemnavError("E102", f"{self._name} unpacks to more than {size(self._limit)}, all that the limit "
                                           "leaves; raise it with ⟦max_memory⟧ if the file is right.")
            del self._kept[: max(self._at - self.BACK - self._start, 0)]
        found = bytes(self._kept[self._at - self._start : self._at - self._start + n_bytes])
        self._at += len(found)
        return found

    def finish(self) -> None:
        """Read what is left, and forget it: only at its end does a stream tell that it is whole."""
        while self.read():
            pass

    def _part(self, n_bytes: int) -> bytes:
        try:
            return self._stream.read(min(n_bytes, CHUNK))
        except (EOFError, zlib.error) as error:
            raise XfemnavError("E101", f"{self._name} is damaged: {error}. Copy it again.") from None

    @property
    def _start(self) -> int:
        return self._end - len(self._kept)


def unpacked_limit(n_packed: int, limit: int) -> int:
    """Most bytes that a file of points of `n_packed` bytes may unpack to; never over `limit`."""
    return min(limit, max(SMALL, TIMES * n_packed))


def unpacked(packed: bytes, name: str, limit: int) -> bytes:
    """The content of a file of points, gunzipped to its checksum where it is gzip. Raises E101, E102."""
    if not packed.startswith(GZIP_MAGIC):
        return packed
    most = unpacked_limit(len(packed), limit)
    data = read(gzip.GzipFile(fileobj=io.BytesIO(packed)), most + 1, name)
    if len(data) > most:
        raise XfemnavError("E102", f"{name} unpacks to more than {size(most)} from {size(len(packed))}, which points "
                                   "do not. Check where it comes from.")
    return data


@contextmanager
def silenced() -> Iterator[None]:
    """Within, libraries warn nobody: what they find doubtful is for their caller to see in the file, and to say with a
    code. Coded warnings pass."""
    said = []
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", XfemnavWarning)
            yield
    finally:
        for item in said:
            warnings.warn_explicit(item.message, item.category, item.filename, item.lineno)


def parts_digest(parts: dict[str, bytes]) -> str:
    """sha256 of one file's bytes; of several files, of their names and bytes."""
    if len(parts) == 1:
        return hashlib.sha256(*parts.values()).hexdigest()
    return listed_digest({name: hashlib.sha256(content).digest() for name, content in parts.items()})


def listed_digest(hashes: dict[str, bytes]) -> str:
    """SHA-256, in hex, of several files by the SHA-256 of each, whatever their order."""
    listing = hashlib.sha256()
    for name, content in sorted(hashes.items()):
        listing.update(hashlib.sha256(os.fsencode(name)).digest() + content)
    return listing.hexdigest()


def size(n_bytes: int) -> str:
    """Human-readable size: 17.4 kB, 141 TB."""
    power = min(int(math.log10(max(n_bytes, 1)) / 3), 5)
    return f"{n_bytes / 1e3**power:.4g} {('bytes', 'kB', 'MB', 'GB', 'TB', 'PB')[power]}"
