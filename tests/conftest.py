"""Hypothesis draws the same examples in every run of the suite; `make test-all` draws new ones."""

import locale
import os

import pytest
from hypothesis import settings

settings.register_profile("steady", derandomize=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "steady"))


@pytest.fixture(autouse=True)
def same_locale():
    """Writing DICOM, SimpleITK leaves the process in the C locale, in which text files would be read as ASCII."""
    before = locale.setlocale(locale.LC_ALL)
    yield
    locale.setlocale(locale.LC_ALL, before)
