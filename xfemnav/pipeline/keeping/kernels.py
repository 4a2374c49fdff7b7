"""Where numba keeps compiled kernels. It must be settled before numba compiles any of ours.

Numba compiles a kernel anew when its own file changes, but not when a helper or constant in another file does. So
kernels are kept in a folder named by the digest of all code that they can be made of, the modules with kernels and all
that those import: other code finds none of them, and an edit of a reader of files spares them.

A kernel is machine code, and a damaged one ends the process. So their digests are kept beside them, and those that do
not match are removed before numba looks for any; so are old ones without a digest, whose process was killed. A kernel
is run as it is found: who may write into the folder may run what he likes, so it must not be shared.
"""

import atexit
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.keeping.disk import UNFINISHED, temporary_folder, write_atomic
from xfemnav.pipeline.keeping.keys import PACKAGE, canonical, file_digest, source_digest
from xfemnav.pipeline.keeping.removal import folders, open_folder, remove, stranger

LAYERS = ("geometry", "mechanics", "imaging")  # where kernels stand
NAME = "xfemnav-kernels-"
SLOW = ("mesh", "constrain", "solve", "warp")  # stages whose kernels take seconds to compile
SEALED, COMPILED = "sealed", "*.nb[ic]"  # digests of kernels by their names, and what numba calls its files
KERNEL = re.compile(r"([\w-]+/)*[^/]+\.nb[ic]")
# What is in a folder of kernels, unfinished files of numba's and of ours too.
MADE = re.compile(rf"{KERNEL.pattern}(\.tmp\.\w+)?|{SEALED}|\w+\.compiled|{UNFINISHED.pattern}")
FOLDER = re.compile(rf"{NAME}[0-9a-f]{{16}}")
IMPORT = re.compile(r"^\s*from (xfemnav[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
UNSEALED_S = 3600  # a process seals what it compiles at the end of the stage
FORGET_S = 30 * 86400  # kernels of other code are removed when nothing has been added to them for so long

PASSING = ("no folder for compiled kernels can be written, so they are compiled anew in every run; set NUMBA_CACHE_DIR "
           "to a folder that can.")


def settle_kernel_cache() -> str | None:
    """Give numba a folder for the kernels of this code; what to tell the user (W602) when it is a passing one.

    It lies in NUMBA_CACHE_DIR, else beside the source, else below the home folder, else it is a temporary one. Modules
    of kernels that were imported before keep their kernels where numba would put them.
    """
    name = NAME + source_digest(*made_of())[:16]
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given and Path(given).name == name:
        return None
    if given and Path(given).name.startswith(NAME):  # a parent's, of other code
        given = Path(given).parent
    base = next((base for base in ([Path(given)] if given else _places())
                 if _writable(base / name) and _rid_of_damage(base / name)), None)
    passing = base is None
    if passing:
        base = temporary_folder()
        atexit.register(shutil.rmtree, base, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = str(base / name)
    atexit.register(_seal, base / name)
    if "numba" in sys.modules:
        sys.modules["numba"].config.reload_config()
        spare_the_run()
    _forget_old(base, name)
    return PASSING if passing else None


def made_of(package: Path = PACKAGE) -> set[Path]:
    """The modules of `package` that have kernels, and all in its `LAYERS` that they import, directly or not."""
    modules = (path for layer in LAYERS for path in (package / layer).rglob("*.py"))
    waiting = [path for path in modules if "njit" in path.read_text(encoding="utf-8")]
    found = set()
    while waiting:
        path = waiting.pop()
        if path not in found and path.is_file() and path.relative_to(package).parts[0] in LAYERS:
            found.add(path)
            for module, names in IMPORT.findall(path.read_text(encoding="utf-8")):
                place = package.joinpath(*module.split(".")[1:])  # a module, or a package of the modules named
                waiting += [place.with_suffix(".py"), *((place / name).with_suffix(".py")
                                                        for name in re.findall(r"\w+", names))]
    return found


def spare_the_run() -> None:
    """Let a kernel that cannot be kept be compiled anew in the next run: numba would end this one. It loads numba.

    Numba passes over such errors where they are usual, on Windows, at this place.
    """
    from numba.core.caching import Cache

    Cache._guard_against_spurious_io_errors = lambda cache: suppress(OSError)


@contextmanager
def compiling(stage: str, tell: Callable[[], None]) -> Iterator[None]:
    """While a stage is computed, after `settle_kernel_cache`: `tell` if it was never computed by this code before."""
    done = Path(os.environ["NUMBA_CACHE_DIR"]) / f"{stage}.compiled"
    new = stage in SLOW and not os.path.exists(done)
    if new:
        tell()
    if stage in SLOW:
        spare_the_run()
    yield
    if new:
        with suppress(OSError):  # then it is told again
            done.parent.mkdir(parents=True, exist_ok=True)
            done.touch()
        _seal(done.parent)


def _rid_of_damage(folder: Path) -> bool:
    """Remove the kernels in `folder` that are not as they were sealed; all, where the seal itself is damaged.

    False where one cannot be removed: it may be another user's, and whoever runs it may crash.
    """
    try:
        sealed = _sealed(folder)
    except (OSError, ValueError):
        with suppress(OSError), open_folder(folder.parent, linked=True) as within:
            remove(folder.name, within, MADE.fullmatch)
        return not any(folder.rglob(COMPILED))
    found = {path.relative_to(folder).as_posix(): "" for path in folder.rglob(COMPILED)}
    return all([_rid_of_damaged(folder / name, digest) for name, digest in (found | sealed).items()])


def _sealed(folder: Path) -> dict[str, str]:
    """The digests under the seal of a folder, by names of kernels; none where there is no seal yet.

    Raises OSError and ValueError for a damaged one.
    """
    try:
        sealed = json.loads((folder / SEALED).read_bytes())
    except FileNotFoundError:
        return {}
    except RecursionError:
        raise ValueError("no digests of kernels") from None
    if not isinstance(sealed, dict) or not all(
            KERNEL.fullmatch(name) and isinstance(digest, str) for name, digest in sealed.items()):
        raise ValueError("no digests of kernels")
    return sealed


def _rid_of_damaged(path: Path, sealed: str) -> bool:
    """Remove a kernel whose digest is not the one that was `sealed`, or that is old and was never ("").

    False where that cannot be done.
    """
    try:
        if sealed:
            wrong = path.is_file() and file_digest(path) != sealed
        else:
            wrong = path.stat().st_mtime < time.time() - UNSEALED_S
        if wrong:
            path.unlink()
    except FileNotFoundError:  # numba, or another process, has replaced it
        return True
    except OSError:
        return False
    return True


def _forget_old(base: Path, name: str) -> None:
    """Remove what nobody uses any more from the folder of kernels `base`, but not `name`, and nothing of anybody's."""
    with suppress(OSError), open_folder(base, linked=True) as within:
        for other in folders(within, FOLDER):
            changed = os.stat(other, dir_fd=within, follow_symlinks=False).st_mtime
            if other != name and time.time() - changed > FORGET_S and not stranger(other, within, MADE.fullmatch):
                with suppress(OSError):  # another process removes it too
                    remove(other, within, MADE.fullmatch)


def _seal(folder: Path) -> None:
    """Keep the digests of the kernels in `folder`; where that cannot be written, they are not looked at later.

    What was sealed and has not been written since keeps its digest: it may be damaged by now.
    """
    with suppress(OSError, XfemnavError, ValueError):
        sealed = _sealed(folder)
        when = (folder / SEALED).stat().st_mtime_ns if sealed else 0
        found = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob(COMPILED))}
        kept = {name: digest for name, digest in sealed.items()
                if name in found and found[name].stat().st_mtime_ns <= when}
        if found:
            write_atomic(folder / SEALED, canonical({name: file_digest(path) for name, path in found.items()} | kept))


def _places() -> Iterator[Path]:
    yield PACKAGE / "__pycache__"  # above the layers, whose files are looked through for keys
    yield Path.home() / ".cache" / "xfemnav"


def _writable(folder: Path) -> bool:
    """Whether `folder`, or the nearest folder above it that exists, can be written."""
    while not os.path.exists(folder):
        folder = folder.parent
    return os.access(folder, os.W_OK)
