"""Signals that end a run are taken at safe points: between stages, and in loops that may run for long.

An exception that a handler raises wherever the interpreter happens to be is lost where it is in a callback, and leaves
a library half-way elsewhere. So a handler only notes its signal, and `checkpoint` raises. Only the command line has
such handlers; in a program that uses the package as a library nothing is noted, and Ctrl-C is what it is there.
"""

import atexit
import signal
import sys
import threading
from functools import partial

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(BaseException):
    """SIGINT, SIGTERM or SIGHUP arrived; `signum` is its number."""

    def __init__(self, signum: int):
        super().__init__(f"interrupted by signal {signum}")
        self.signum = signum


_waiting: list[int] = []  # numbers of signals that no checkpoint has seen yet
_working = False  # whether a signal can still end anything


def note_signals() -> None:
    """From here on signals are noted for the next `checkpoint`. A second one does not wait for it.

    A signal that is ignored stays ignored, as under nohup; and a thread, which can have no handlers, is not ended.
    """
    global _working
    _working = threading.current_thread() is threading.main_thread()
    for signum in ENDING if _working else ():
        if signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, _note)
    if getattr(sys.unraisablehook, "func", None) is not _lost:
        sys.unraisablehook = partial(_lost, sys.unraisablehook)
    atexit.register(_ignore)


def _lost(hook, unraisable) -> None:
    """What a second signal raised in a callback, where nothing can take it, is noted again for the next checkpoint."""
    if not isinstance(unraisable.exc_value, Interrupted):
        hook(unraisable)
    elif _working:
        _waiting.append(unraisable.exc_value.signum)


def _ignore() -> None:
    """While the interpreter ends it would give up our handlers, and a signal end the process in its last moment."""
    for signum in ENDING:
        if signal.getsignal(signum) is _note:
            signal.signal(signum, signal.SIG_IGN)


def _note(signum: int, frame) -> None:
    if _working:
        _waiting.append(signum)
        if len(_waiting) > 1:
            checkpoint()


def checkpoint() -> None:
    """Raise Interrupted where a signal was noted since the last one was raised."""
    if _waiting:
        signum = _waiting[0]
        _waiting.clear()
        raise Interrupted(signum)


def forget() -> None:
    """The work is done, or is being cleared up: signals, those that are noted too, end nothing any more."""
    global _working
    _working = False
    _waiting.clear()
