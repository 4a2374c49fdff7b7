"""Bytes of files and folders: bounded, read once, unpacked to the end of their checksums, and their digests."""

import gzip
import hashlib
import io
import math
import os
import stat
import zlib
from collections.abc import Iterator
from pathlib import Path

from xfemnav.errors import XfemnavError

CHUNK = 1 << 22
FILES = 20_000  # in a folder
GZIP_MAGIC = b"\x1f\x8b"


def file_bytes(path, limit: int) -> bytes:
    """Bytes of a regular file of at most `limit` bytes; a pipe or device is never waited for."""
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
            raise XfemnavError("E106", f"{path} is a pipe or device, not a file; give an image file (.nii.gz).")
        if status.st_size == 0:
            raise XfemnavError("E106", f"{name} is empty (0 bytes); copy it again.")
        if status.st_size > limit:
            raise XfemnavError("E102", f"{name} holds {size(status.st_size)}, over the limit of {size(limit)}; "
                                       "raise it with --max-memory if the file is right.")
        with os.fdopen(handle, "rb", closefd=False) as file:
            return file.read(status.st_size)
    except OSError as error:
        raise XfemnavError("E101", f"cannot read {name}: {error.strerror}. Copy it again.") from None
    finally:
        os.close(handle)


def each_file(path: Path, limit: int) -> Iterator[tuple[str, bytes]]:
    """Names and bytes of the regular files in a folder, sorted; not of its folders, and no hidden one."""
    try:
        sizes = {entry.name: entry.stat().st_size for entry in os.scandir(path)
                 if entry.is_file() and not entry.name.startswith(".")}
    except OSError as error:
        raise XfemnavError("E100", f"cannot open {path}: {error.strerror}. Correct the path.") from None
    if len(sizes) > FILES:
        raise XfemnavError("E102", f"{path} holds {len(sizes)} files, over the limit of {FILES}; give the folder of "
                                   "one DICOM series.")
    return ((name, file_bytes(path / name, limit) if sizes[name] else b"") for name in sorted(sizes))


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
        raise XfemnavError("E101", f"{name} is damaged: {error} (after {n_bytes - missing} of {n_bytes} bytes). "
                                   f"Copy it again; check with: gzip -t {name}") from None
    return b"".join(parts)


class Zlib:
    """Reads a zlib stream as gzip.GzipFile reads its own, to the end of its checksum."""

    def __init__(self, packed: bytes):
        self._packed, self._place, self._inflater, self._waiting = packed, 0, zlib.decompressobj(), b""

    def read(self, n_bytes: int) -> bytes:
        """Between 1 and `n_bytes` bytes, or none at the end."""
        while not self._inflater.eof:
            self._waiting = self._waiting or self._packed[self._place : self._place + CHUNK]
            self._place += 0 if self._inflater.unconsumed_tail else len(self._waiting)
            if not self._waiting:
                raise EOFError("its zlib stream ends early")
            part = self._inflater.decompress(self._waiting, n_bytes)
            self._waiting = self._inflater.unconsumed_tail
            if part:
                return part
        if self._inflater.unused_data or self._place < len(self._packed):
            raise zlib.error("bytes follow its zlib stream")
        return b""


def parts_digest(parts: dict[str, bytes]) -> str:
    """sha256 of one file's bytes; of several files, of their names and bytes."""
    if len(parts) == 1:
        return hashlib.sha256(*parts.values()).hexdigest()
    return listed_digest({name: hashlib.sha256(content).digest() for name, content in parts.items()})


def listed_digest(hashes: dict[str, bytes]) -> str:
    listing = hashlib.sha256()
    for name, content in sorted(hashes.items()):
        listing.update(hashlib.sha256(os.fsencode(name)).digest() + content)
    return listing.hexdigest()


def size(n_bytes: int) -> str:
    """Human-readable size: 17.4 kB, 141 TB."""
    power = min(int(math.log10(max(n_bytes, 1)) / 3), 5)
    return f"{n_bytes / 1e3**power:.4g} {('bytes', 'kB', 'MB', 'GB', 'TB', 'PB')[power]}"
