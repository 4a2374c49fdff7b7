"""Removing what we have made from folders that others can write to, and nothing else.

Folders are opened one within the other, never through a link, and names are looked up in what is open: a link that
somebody puts in the way between looking and removing leads nowhere else. Only regular files are removed, and the
folders that are empty then; of a file with several names (hard links) that one name goes.
"""

import errno
import os
import re
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def open_folder(name: str | Path, within: int | None = None, *, linked: bool = False) -> Iterator[int]:
    """A descriptor of the folder `name`, in the open folder `within`; one that is a link only where it may be `linked`.

    Raises OSError.
    """
    handle = os.open(name, os.O_RDONLY | os.O_DIRECTORY | (0 if linked else os.O_NOFOLLOW), dir_fd=within)
    try:
        yield handle
    finally:
        os.close(handle)


def bytes_of(name: str, within: int, limit: int = 50_000_000) -> bytes:
    """At most `limit` bytes of a regular file in an open folder. Raises OSError for a link, and for what is no file."""
    handle = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=within)
    with open(handle, "rb") as stream:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, f"{name} is no regular file")
        return stream.read(limit)


def folders(within: int, form: re.Pattern) -> list[str]:
    """Names of a `form` of the folders in an open one, sorted; a link is none."""
    return _entries(within, form, os.DirEntry.is_dir)


def files(within: int, form: re.Pattern) -> list[str]:
    """The same of regular files."""
    return _entries(within, form, os.DirEntry.is_file)


def stranger(name: str, within: int, ours: Callable[[str], bool]) -> str | None:
    """The first thing in a folder that is not `ours`: a regular file that is, by its name relative to the folder."""
    found = (place for place, folder, file in _under(name, within) if not _is_ours(place, folder, file, ours))
    return min(found, default=None)


def remove(name: str, within: int, ours: Callable[[str], bool]) -> int:
    """Remove the files in a folder that are `ours`, the folders that are empty then, and itself; the bytes freed.

    Raises OSError where something cannot be removed, or is left in the folder.
    """
    freed = 0
    for place, folder, file in _under(name, within):
        if _is_ours(place, folder, file, ours):
            freed += os.stat(file, dir_fd=folder, follow_symlinks=False).st_size
            os.unlink(file, dir_fd=folder)
    for _, inner, _, folder in os.fwalk(name, topdown=False, dir_fd=within):
        for empty in inner:
            os.rmdir(empty, dir_fd=folder)
    os.rmdir(name, dir_fd=within)
    return freed


def _under(name: str, within: int) -> Iterator[tuple[str, int, str]]:
    """Whatever in a folder is no folder: its relative name, and the open folder and the name in which it stands."""
    for place, inner, found, folder in os.fwalk(name, dir_fd=within):
        linked = [item for item in inner if not stat.S_ISDIR(_mode(item, folder))]
        for item in (*found, *linked):
            yield os.path.relpath(os.path.join(place, item), name), folder, item


def _is_ours(place: str, folder: int, file: str, ours: Callable[[str], bool]) -> bool:
    return stat.S_ISREG(_mode(file, folder)) and ours(place)


def _mode(name: str, within: int) -> int:
    return os.stat(name, dir_fd=within, follow_symlinks=False).st_mode


def _entries(within: int, form: re.Pattern, kind) -> list[str]:
    with os.scandir(within) as found:
        return sorted(item.name for item in found if form.fullmatch(item.name) and kind(item, follow_symlinks=False))
