"""Waiting for another process, by flock: the kernel releases the lock however its holder dies."""

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.interruption import checkpoint
from xfemnav.pipeline.keeping.disk import writing

LIMIT_S = 600.0


@contextmanager
def locked(path: Path, *, shared: bool = False, waiting: Callable[[], None] = lambda: None,
           limit_s: float = LIMIT_S) -> Iterator[None]:
    """Hold the lock on `path` (a folder, or a file that is made when missing).

    `waiting` is called once if somebody else holds it. Raises XfemnavError E503 after `limit_s` seconds, E501 and E502
    where it cannot be made, or the disk has no locks.
    """
    with writing(path.parent, f"the lock {path.name}"):
        handle = os.open(path, os.O_RDONLY if os.path.isdir(path) else os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        _take(handle, path, fcntl.LOCK_SH if shared else fcntl.LOCK_EX, waiting, limit_s)
        yield
    finally:
        os.close(handle)


def _take(handle: int, path: Path, kind: int, waiting: Callable[[], None], limit_s: float) -> None:
    deadline = time.monotonic() + limit_s
    told = False
    while True:
        try:
            return fcntl.flock(handle, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise XfemnavError("E503", f"another run has held {path} for {limit_s:.0f} s. "
                                           "Wait for it to end, or use another folder.") from None
        except OSError as error:  # a network disk without locks
            raise XfemnavError("E502", f"cannot lock {path}: {error.strerror}. Use a folder on a local disk.") from None
        if not told:
            waiting()
            told = True
        checkpoint()
        time.sleep(0.05)
