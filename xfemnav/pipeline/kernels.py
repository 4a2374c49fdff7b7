"""Where numba keeps compiled kernels. It must be settled before numba is imported."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from xfemnav.pipeline.keys import PACKAGE


def settle_kernel_cache() -> str | None:
    """Make sure that numba has a folder to write to; what to tell the user (W602) when it is a passing one.

    Numba keeps kernels beside the source, else below the home folder, and refuses to work where it can do neither.
    NUMBA_CACHE_DIR wins over both.
    """
    if os.environ.get("NUMBA_CACHE_DIR") or _writable(PACKAGE / "geometry") or _writable(Path.home() / ".cache"):
        return None
    folder = tempfile.mkdtemp(prefix="xfemnav-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder
    return ("neither the installed package nor the home folder can be written, so kernels are compiled anew in every "
            "run; set NUMBA_CACHE_DIR to a folder that can.")


def _writable(folder: Path) -> bool:
    """Whether `folder`, or the nearest folder above it that exists, can be written."""
    while not folder.exists():
        folder = folder.parent
    return os.access(folder, os.W_OK)
