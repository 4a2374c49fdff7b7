"""HDF5 files without their clocks: the same content gives the same bytes."""

import struct
from pathlib import Path


def clear_times(path: Path) -> None:
    """Set all times of the objects in an HDF5 file to 0, where they are.

    They are in the object headers (HDF5 file format 3.0, IV.A.1.b): OHDR, version 2, flags, four times if flag 5 is
    set, the first chunk and its checksum. What has these letters by chance has no such checksum and is left alone.
    """
    data, at, changed = path.read_bytes(), 0, {}
    while (at := data.find(b"OHDR\x02", at)) >= 0:
        if (header := _without_times(data, at)) is not None:
            changed[at] = header
        at += 1
    with path.open("r+b") as file:
        for at, header in changed.items():
            file.seek(at)
            file.write(header)


def _without_times(data: bytes, at: int) -> bytes | None:
    """The object header at `at` with times of 0 and its checksum; None where it has no times, or is none."""
    flags = data[at + 5] if at + 5 < len(data) else 0
    size_at = at + 6 + (16 if flags & 32 else 0) + (4 if flags & 16 else 0)
    width = 1 << (flags & 3)
    end = size_at + width + int.from_bytes(data[size_at:size_at + width], "little")
    if not flags & 32 or data[end:end + 4] != _lookup3(data[at:end]):
        return None
    header = data[at:at + 6] + bytes(16) + data[at + 22:end]
    return header + _lookup3(header)


def _lookup3(message: bytes) -> bytes:
    """Checksum of HDF5's metadata: Bob Jenkins' lookup3 hash (2006, public domain), initial value 0."""
    def rotated(x, k):
        return (x << k | x >> (32 - k)) & 0xFFFFFFFF

    start = (0xDEADBEEF + len(message)) & 0xFFFFFFFF
    a = b = c = start
    padded = bytes(message) + bytes(-len(message) % 12)
    blocks = list(struct.iter_unpack("<3I", padded))
    for x, y, z in blocks[:-1]:
        a, b, c = ((v + w) & 0xFFFFFFFF for v, w in ((a, x), (b, y), (c, z)))
        for k in (4, 6, 8, 16, 19, 4):
            a = ((a - c) ^ rotated(c, k)) & 0xFFFFFFFF
            c = (c + b) & 0xFFFFFFFF
            a, b, c = b, c, a
    a, b, c = ((v + w) & 0xFFFFFFFF for v, w in zip((a, b, c), blocks[-1]))
    for k in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - rotated(b, k)) & 0xFFFFFFFF
        a, b, c = b, c, a
    return struct.pack("<I", b)
