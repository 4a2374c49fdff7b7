"""Which codes of the table the package has really raised or said while the tests ran, here or in a process of theirs.

A run of all tests fails where one never was; a run of some of them asks for nothing.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from xfemnav import errors
from xfemnav_cli import telling

PACKAGE = tuple(str(Path(__file__).parents[1] / folder) for folder in ("xfemnav", "cli"))
SAID = re.compile(r"(?:^|: )([EW]\d{3})\b", re.MULTILINE)
noted: set[str] = set()


def note() -> None:
    """Begin: whatever the package makes an error or a warning of, and what its commands say on stderr."""
    made, said, waited = errors.Coded.__init__, telling.complain, subprocess.Popen.communicate

    def make(self, code, text):
        frame = sys._getframe(1)
        while frame and frame.f_code.co_filename == errors.__file__:
            frame = frame.f_back
        if frame and frame.f_code.co_filename.startswith(PACKAGE):
            noted.add(code)
        made(self, code, text)

    def say(text):
        noted.update(SAID.findall(text))
        said(text)

    def wait(self, *args, **kwargs):
        found = waited(self, *args, **kwargs)
        for text in filter(None, found):
            noted.update(SAID.findall(text if isinstance(text, str) else text.decode(errors="replace")))
        return found

    errors.Coded.__init__, subprocess.Popen.communicate = make, wait
    for module in list(sys.modules.values()):
        if getattr(module, "complain", None) is said:
            module.complain = say


def missing(config) -> list[str]:
    """Codes that a run of all tests, slow ones or not, has not seen; none where only some were run."""
    option = config.option
    some = (config.args != config.getini("testpaths") or option.keyword or option.markexpr not in ("", "not slow")
            or option.collectonly or getattr(option, "lf", False) or hasattr(config, "workerinput"))
    return [] if some else sorted(set(errors.FAULTS) - noted)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    """A worker has ended: what it has noted."""
    noted.update(getattr(node, "workeroutput", {}).get("codes", ()))


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session, exitstatus):
    """A worker hands over what it has noted; a run of all tests that misses codes has failed."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["codes"] = sorted(noted)
    if exitstatus == 0 and missing(session.config):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, exitstatus, config):
    """Say which."""
    if codes := missing(config):
        terminalreporter.write_line(f"never raised in a test: {', '.join(codes)}", red=True)
