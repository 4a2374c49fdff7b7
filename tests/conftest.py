"""Hypothesis draws the same examples in every run of the suite; `make test-all` draws new ones.

Kernels are those of the code as it is: numba alone would not see a change in a file that another's kernel calls.
"""

import locale
import os
import signal
import sys

import pytest
from hypothesis import settings

from tests import raised
from tests.raised import pytest_sessionfinish, pytest_terminal_summary, pytest_testnodedown  # noqa: F401
from xfemnav.interruption import ENDING
from xfemnav.pipeline.keeping.kernels import settle_kernel_cache

settle_kernel_cache()  # before kernels are imported
raised.note()
# What a shell has put in the background ignores SIGINT, and with nohup SIGHUP: commands that tests start would too.
for signum in ENDING:
    if signal.getsignal(signum) is signal.SIG_IGN:
        signal.signal(signum, signal.default_int_handler if signum == signal.SIGINT else signal.SIG_DFL)
settings.register_profile("steady", derandomize=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "steady"))


@pytest.fixture(autouse=True)
def same_handlers():
    """The command notes signals from its first line on; the test program that runs it in its own process must not."""
    before, hook = {signum: signal.getsignal(signum) for signum in ENDING}, sys.unraisablehook
    yield
    sys.unraisablehook = hook
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.fixture(autouse=True)
def same_locale():
    """Writing DICOM, SimpleITK leaves the process in the C locale, in which text files would be read as ASCII."""
    before = locale.setlocale(locale.LC_ALL)
    yield
    locale.setlocale(locale.LC_ALL, before)
