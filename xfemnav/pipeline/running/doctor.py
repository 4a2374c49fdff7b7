"""Is this installation sound? A small known motion through every format and frame, then the folders and libraries.

Nothing of a user's is read, and only the cache folder is written to, besides temporary files.
"""

import fcntl
import os
import platform
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

from xfemnav.errors import EXIT_BUG, EXIT_CANNOT_WRITE, EXIT_DATA, EXIT_DISK_FULL, XfemnavError, XfemnavWarning
from xfemnav.pipeline.keeping.cache import Cache
from xfemnav.pipeline.keeping.disk import scratch
from xfemnav.pipeline.keeping.kernels import settle_kernel_cache
from xfemnav.pipeline.stages.table import ALL

LEAST_FREE = 500e6  # bytes: a run with its report and entries in the cache takes a tenth of it
LIBRARIES = (*ALL, "matplotlib", "jinja2", "pydantic", "rich", "click")


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at: `what`, what is the `matter` ("": nothing), how to `mend` it, the exit status."""

    what: str
    matter: str = ""
    mend: str = ""
    exit_code: int = 0

    @property
    def line(self) -> str:
        """The finding in one line."""
        return f"BAD  {self.what}: {self.matter}. {self.mend}" if self.matter else f"ok   {self.what}"


def examine(cache: Path) -> Iterator[Finding]:
    """Look at everything, one finding after the other; a fault of one stops no other."""
    yield _libraries()
    yield _kernels()
    yield _cache(cache)
    yield _space(cache, "the cache")
    temporary = _temporary()
    yield temporary
    if temporary.exit_code != EXIT_CANNOT_WRITE:
        yield from _formats()


def _formats() -> Iterator[Finding]:
    """The known scene through readers, writers and frames."""
    try:
        from xfemnav.imaging.selftest.roundtrip import CHECKS
    except Exception as error:  # a library that cannot be loaded fails in its own way
        yield Finding("libraries load", _told(error), "Install xfemnav anew in a fresh environment", EXIT_BUG)
        return
    checks = (*CHECKS, ("meshes .vtu by meshio", _check_vtu, "meshio"))
    for what, check, library in checks:
        yield _looked(what, partial(_aside, check), _remedy(library))


def _aside(check: Callable[[Path], None]) -> None:
    """A check in a temporary folder."""
    with scratch() as folder:
        check(folder)


def _remedy(library: str) -> str:
    if library == "xfemnav":
        return "Install xfemnav anew, and report this if it stays."
    return f"Install another version of {library} (this is {_version(library)}), and report this."


def _looked(what: str, check: Callable[[], None], mend: str) -> Finding:
    """The finding of a check that raises when something is wrong."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", XfemnavWarning)
            check()
    except Exception as error:  # whatever a broken library raises is a finding
        return Finding(what, _told(error), mend, EXIT_BUG)
    return Finding(what)


def _told(error: Exception) -> str:
    told = f"{error.code} {error.text}" if isinstance(error, XfemnavError) else str(error)
    text = told if type(error).__name__ == "Mismatch" else f"{type(error).__name__}: {told}"
    return re.sub(r"\s+", " ", text).strip().rstrip(".")


def _check_vtu(folder: Path) -> None:
    """The triangles of the scene as VTU: world RAS mm in the file, and the same motion when read."""
    import meshio
    import numpy as np

    from xfemnav.imaging.selftest.known import OBLIQUE, agree
    from xfemnav.imaging.selftest.scenes import scene_motion, scene_slice
    from xfemnav.pipeline.keeping.files import read_soup, write_soup

    frame = scene_slice(OBLIQUE)
    motion = scene_motion(OBLIQUE, frame)
    write_soup(folder / "s.vtu", frame, motion.rest, motion.moved, {"det_F": np.ones(len(motion.rest))})
    found = meshio.vtu.read(folder / "s.vtu")
    cells = found.get_cells_type("triangle")
    agree("points", found.points[cells], OBLIQUE.world(OBLIQUE.rest), 1e-5)  # corners are merged to 1e-6 mm
    agree("displacements", (found.points + found.point_data["displacement"])[cells], OBLIQUE.world(OBLIQUE.moved), 1e-5)
    for what, got, wanted in zip(("rest", "moved"), read_soup(folder / "s.vtu", frame), (motion.rest, motion.moved)):
        agree(what, got, wanted, 1e-5)


def _libraries() -> Finding:
    """Versions of Python and of all libraries."""
    versions = {name: _version(name) for name in LIBRARIES}
    what = ", ".join([f"Python {platform.python_version()}", *(f"{name} {each}" for name, each in versions.items())])
    missing = ", ".join(name for name, version in versions.items() if version == "missing")
    if missing:
        return Finding(what, f"{missing} is not installed", "Install xfemnav with its dependencies.", EXIT_BUG)
    return Finding(what)


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "missing"


def _kernels() -> Finding:
    """Whether compiled kernels are kept."""
    passing = settle_kernel_cache()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    if passing:
        return Finding("compiled kernels", "they are compiled anew in every run",
                       "Set NUMBA_CACHE_DIR to a folder that can be written.", EXIT_CANNOT_WRITE)
    return Finding(f"compiled kernels are kept in {folder}")


def _cache(root: Path) -> Finding:
    """Whether the cache can be written and locked."""
    try:
        Cache(root)
        with tempfile.NamedTemporaryFile(dir=root, prefix=".doctor-") as probe, open(probe.name, "rb") as other:
            probe.write(b"probe")
            probe.flush()
            os.fsync(probe.fileno())
            fcntl.flock(probe, fcntl.LOCK_EX)
            if not _is_locked(other):
                return Finding(f"cache {root}", "two programs get one lock at a time",
                               "Give a folder on a local disk with ⟦cache⟧.", EXIT_CANNOT_WRITE)
    except XfemnavError as error:
        return Finding(f"cache {root}", _told(error), "Set XFEMNAV_CACHE to a folder that can be written.",
                       error.exit_code or EXIT_DATA)
    except OSError as error:
        return Finding(f"cache {root}", _told(error), "Give a folder on a local disk with ⟦cache⟧.", EXIT_CANNOT_WRITE)
    return Finding(f"cache {root} can be written and locked")


def _is_locked(stream) -> bool:
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False


def _temporary() -> Finding:
    """Whether temporary files can be written, and the room for them."""
    try:
        with scratch() as folder:
            return _space(folder.parent, "temporary files")
    except XfemnavError as error:
        return Finding("temporary files", _told(error), "The formats are not looked at", EXIT_CANNOT_WRITE)


def _space(folder: Path, name: str) -> Finding:
    """Whether the disk of a folder, or of the nearest one above that exists, has room."""
    folder = folder.absolute()
    while not os.path.exists(folder):
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    what = f"space for {name}: {free / 1e9:.1f} GB in {folder}"
    if free < LEAST_FREE:
        return Finding(what, f"under {LEAST_FREE / 1e9:.1f} GB", "Free some, or give another folder.", EXIT_DISK_FULL)
    return Finding(what)
