"""Hypothesis draws the same examples in every run of the suite; `make test-all` draws new ones."""

import os

from hypothesis import settings

settings.register_profile("steady", derandomize=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "steady"))
