"""Calls that change files counted, and made to fail, where Python makes them: for commands run in this process."""

import builtins
import contextlib
import errno
import fcntl
import io
import os
from pathlib import Path

from faults.battery import HALF, Bench, Ended, Fault
from small import main

FREEING = ("unlink", "remove", "rmdir", "flock")  # a full disk lets go what is there
MOVES = (os.rename, os.replace)
OF_PATHS = ("mkdir", "rename", "replace", "unlink", "remove", "rmdir", "utime")


class Here(Bench):
    """Commands run in this process, one after the other."""

    def __init__(self, root: Path, monkeypatch):
        super().__init__(root)
        for name, value in self.environment.items():
            monkeypatch.setenv(name, value)
        self.monkeypatch = monkeypatch

    def run(self, arguments, fault=None, log=None):
        """See Bench."""
        said, code = (io.StringIO(), io.StringIO()), 0
        with (self.monkeypatch.context() as patched, contextlib.redirect_stdout(said[0]),
              contextlib.redirect_stderr(said[1])):
            Calls(self.case, fault or Fault(0, 0), [] if log is None else log).watch(patched.setattr)
            try:
                main(list(arguments))
            except SystemExit as end:
                code = end.code or 0
        return Ended(code, *(text.getvalue() for text in said))


class Calls:
    """Calls that change files below `root`: each is appended to `log`, and that which `fault` names fails."""

    def __init__(self, root: Path, fault: Fault, log: list[str]):
        self.root, self.fault, self.log, self.number = f"{root}/", fault, log, 0

    def watch(self, setattr) -> None:
        """Let all of Python's ways to change files go through this."""
        setattr(io, "open", self._opening(io.open))
        setattr(builtins, "open", io.open)
        setattr(os, "open", self._low_opening(os.open))
        setattr(os, "fsync", self._of_handle(lambda handle: None, "fsync"))  # there is no power cut to be afraid of
        setattr(fcntl, "flock", self._of_handle(fcntl.flock, "flock"))
        for name in OF_PATHS:
            setattr(os, name, self._of_path(getattr(os, name)))

    def counted(self, call: str, path, at: int | None = None) -> bool:
        """Count a call for a path (beneath the open folder `at`); whether half of it is to be done. Raises OSError."""
        folder = os.getcwd() if at is None else os.readlink(f"/proc/self/fd/{at}")
        path = path if isinstance(path, int) else os.path.join(folder, os.fsdecode(path))
        if isinstance(path, int) or not f"{path}/".startswith(self.root):
            return False
        self.number += 1
        self.log.append(f"{call} {path}")
        at, how, lasting = self.fault.at, self.fault.how, self.fault.lasting
        if not at or self.number < at or (self.number > at and not lasting):
            return False
        if how == HALF or (lasting and how == errno.ENOSPC and call in FREEING):
            return how == HALF
        raise OSError(self.fault.how, os.strerror(self.fault.how), path)

    def _opening(self, real):
        def opened(file, mode="r", *rest, **named):
            if not set(mode) & set("wxa+"):
                return real(file, mode, *rest, **named)
            self.counted("open", file)
            return Written(real(file, mode, *rest, **named), self)
        return opened

    def _low_opening(self, real):
        def opened(path, flags, *rest, dir_fd=None, **named):
            if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                self.counted("open", path, dir_fd)
            return real(path, flags, *rest, dir_fd=dir_fd, **named)
        return opened

    def _of_handle(self, real, name):
        def called(handle, *rest):
            self.counted(name, os.readlink(f"/proc/self/fd/{handle}"))
            return real(handle, *rest)
        return called

    def _of_path(self, real):
        def called(path, *rest, dir_fd=None, **named):
            self.counted(real.__name__, rest[0] if real in MOVES else path, dir_fd)
            return real(path, *rest, **named | ({} if dir_fd is None else {"dir_fd": dir_fd}))
        return called


class Written:
    """A file opened for writing, whose writes are counted."""

    def __init__(self, file, calls: Calls):
        self.file, self.calls = file, calls

    def write(self, data):
        """Write all, or half and then find the disk full, or nothing."""
        if self.calls.counted("write", self.file.name):
            self.file.write(data[:len(data) // 2])
            self.file.flush()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self.file.write(data)

    def __getattr__(self, name):
        if name == "fileno":  # a library would write past us
            raise AttributeError(name)
        return getattr(self.file, name)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()
