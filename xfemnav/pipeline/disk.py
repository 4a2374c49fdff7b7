"""Writing that survives a full disk, a read-only folder and `kill -9`: a file is there whole, or not at all."""

import errno
import itertools
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from xfemnav.errors import XfemnavError

FULL, NO_MEMORY = (errno.ENOSPC, errno.EDQUOT), (errno.ENOMEM,)
TEMPORARY = ".xfemnav-tmp"  # ending of files that a killed run may leave; the next run removes them
UNFINISHED = re.compile(rf"\.\d+-\d+{re.escape(TEMPORARY)}")  # what `write_together` calls them

NUMBERS = itertools.count()


@contextmanager
def writing(where: Path, what: str) -> Iterator[None]:
    """Turn a full disk into E501 and any other refused write into E502; `what` names the thing that was written.

    Memory that the system refuses is no matter of the disk: MemoryError, which is told as E800.
    """
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise XfemnavError("E501", f"no space left while writing {what} in {where}. Finished stages are kept; "
                                       "run the same command again after freeing space.") from error
        if error.errno in NO_MEMORY:
            raise MemoryError(f"while writing {what}: {error.strerror}") from error
        raise XfemnavError("E502", f"cannot write {what} in {where}: {error.strerror or error}. "
                                   "Give another folder with -o or -w.") from error


def write_atomic(path: Path, data: bytes) -> None:
    """Put `data` at `path` in one step."""
    write_together(path.parent, {path.name: data})


def write_together(folder: Path, files: dict[str, bytes], before: Callable[[], None] = lambda: None) -> None:
    """Put `files` (name -> bytes) into `folder`, each in one step: temporary siblings, fsync, rename; then fsync it.

    `before` is called when all is on the disk and nothing has been renamed.
    """
    temporaries = [folder / f".{os.getpid()}-{next(NUMBERS)}{TEMPORARY}" for _ in files]
    with writing(folder, ", ".join(files)):
        try:
            for temporary, data in zip(temporaries, files.values()):
                temporary.write_bytes(data)
            for temporary in temporaries:  # when all are written, or the disk waits for each
                sync(temporary)
            before()
            for temporary, name in zip(temporaries, files):
                os.replace(temporary, folder / name)
            sync(folder)
        finally:
            for temporary in temporaries:
                temporary.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """fsync a file or folder."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def remove_temporaries(folder: Path) -> None:
    """Remove what a killed run left half-written in `folder`; call it only while holding the folder's lock."""
    for left in folder.glob(f".*{TEMPORARY}"):
        if UNFINISHED.fullmatch(left.name) and left.is_file() and not left.is_symlink():
            left.unlink()
