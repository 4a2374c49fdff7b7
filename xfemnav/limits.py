"""Limits beyond which a result deserves a warning, or no trust: one table, read by the checks and by the report.

Nothing is imported and nothing decided here: a check compares, warns with its code, and says the number and the limit.
"""

from typing import NamedTuple


class Limit(NamedTuple):
    """The largest (or, where the words say so, smallest) `value` that passes, its `unit`, and what it is a limit of."""

    value: float
    unit: str
    of: str


INVERTED = Limit(1.0, "mm²", "tissue turned inside out; more is not trusted (E401)")
# Linear strains grow as r^-1/2 at a tip, so a speck of tissue there is inverted at any opening: this much is no news.
FOLDED_NOTICE = Limit(0.01, "mm²", "tissue turned inside out (W402)")
APART = Limit(0.1, "mm", "distance in the organ between the two frames of a header (W114)")
# A mesh coarser than this tells nothing of what is thin: wider strips of tissue are real.
SHRED_WIDTH = Limit(4.0, "mm", "the element's width under which tissue beside a resection goes with it (W210)")
# Springs of 1e-6 E / mm: what they carry moves by as much again when they are half as stiff.
SWAY = Limit(0.1, "mm", "motion that hangs on the springs of what only touches the skull (W410)")
PADDING = Limit(1 << 20, "bytes", "zeros after the voxels of an image, which pass for padding (W136)")
