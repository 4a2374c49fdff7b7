"""Signals that end a run are taken at safe points: between stages, and in loops that may run for long.

An exception that a handler raises wherever the interpreter happens to be is lost where it is in a callback, and leaves
a library half-way elsewhere. So a handler only notes its signal, and `checkpoint` raises.
"""

import signal

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(BaseException):
    """SIGINT, SIGTERM or SIGHUP arrived; `signum` is its number."""

    def __init__(self, signum: int):
        super().__init__(f"interrupted by signal {signum}")
        self.signum = signum


_waiting: list[int] = []  # numbers of signals that no checkpoint has seen yet


def note_signals() -> None:
    """From here on signals are noted for the next `checkpoint`. A second one does not wait for it."""
    _waiting.clear()
    for signum in ENDING:
        signal.signal(signum, _note)


def _note(signum: int, frame) -> None:
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
    """Drop what is noted: the work is done already."""
    _waiting.clear()
