"""Writing that survives a full disk, a read-only folder and `kill -9`: a file is there whole, or not at all."""

import errno
import itertools
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from xfemnav.errors import XfemnavError

FULL, NO_MEMORY = (errno.ENOSPC, errno.EDQUOT), (errno.ENOMEM,)
TEMPORARY = ".xfemnav-tmp"  # ending of files that a killed run may leave; the next run removes them
OTHER_TMPDIR = "Set TMPDIR to a folder that can be."
UNFINISHED = re.compile(rf"\.\d+-\d+{re.escape(TEMPORARY)}")  # what `write_together` calls them

NUMBERS = itertools.count()


@contextmanager
def writing(where: Path, what: str, mend: str = "Give another folder with ⟦output⟧ or ⟦cache⟧.") -> Iterator[None]:
    """Turn a full disk into E501 and any other refused write into E502; `what` names the thing that was written, and
    `mend` says what to do where it cannot be.

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
                                   f"{mend}") from error


def temporary_folder() -> Path:
    """A new folder among the temporary files. Raises XfemnavError E501, E502 where none can be made."""
    with writing(Path(os.environ.get("TMPDIR", "/tmp")), "temporary files", OTHER_TMPDIR):
        return Path(tempfile.mkdtemp(prefix="xfemnav-"))


@contextmanager
def scratch() -> Iterator[Path]:
    """A temporary folder, which goes with all that is in it; where that is refused it is left, for no file depends on
    it."""
    folder = temporary_folder()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


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
