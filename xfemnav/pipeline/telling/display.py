"""How a slice is shown: which way round, the letters at its edges, and words for both.

Plane coordinates have the patient's right at the end of e1 in axial and coronal slices. Neurological display draws them
as they are; radiological display has the patient's left on the viewer's right, as seen from the feet, or face to face.
Lips are "left" and "right" of a cut, which is neither the patient's nor the viewer's: where they are shown, they are
told by the patient's side that they lie towards.
"""

from itertools import groupby

import numpy as np

NEUROLOGICAL, RADIOLOGICAL = "neurological", "radiological"
ENDS = ("LR", "PA", "IS")  # letters at the negative and positive ends of the three RAS axes
NAMES = {"R": "the patient's right", "L": "the patient's left", "A": "anterior", "P": "posterior", "S": "superior",
         "I": "inferior"}


def ends(axis) -> str:
    """Letters of the patient's sides where a vector (3,), RAS, starts and ends: 'LR' for e1 of an axial slice."""
    k = int(np.argmax(np.abs(axis)))
    return ENDS[k] if axis[k] > 0 else ENDS[k][::-1]


def mirrored(plane: str, display: str) -> bool:
    """Whether e1 of a slice runs to the left on the screen."""
    return plane != "sagittal" and display == RADIOLOGICAL


def edges(plane: str, axes, display: str) -> tuple[str, str, str, str]:
    """Letters at the left, right, lower and upper edge of the picture; rows of `axes` are e1, e2 and the normal."""
    (west, east), (south, north) = ends(axes[0]), ends(axes[1])
    return (east, west, south, north) if mirrored(plane, display) else (west, east, south, north)


def convention(plane: str, axes, display: str) -> str:
    """What the picture shows where, in words."""
    west, east, _, north = edges(plane, axes, display)
    if plane == "sagittal":
        return f"{NAMES[east]} on the right, {NAMES[north]} at the top"
    return f"{display} display: {NAMES[west]} on the left, {NAMES[north]} at the top"


def in_space(display: str) -> str:
    """What the pictures of a volume show where, in words."""
    west = "right" if display == RADIOLOGICAL else "left"
    return (f"{display} display: the patient's {west} on the left of axial and coronal slices, anterior on the right "
            "of sagittal ones, and anterior or superior at the top")


def left_of(normal) -> str:
    """Letter of the patient's side that the left lip of a cut in space lies towards; `normal` (3,) points there."""
    return ends(normal)[1]


def lip_ends(path, axes) -> dict[str, str]:
    """Letter of the patient's side that each lip of a cut lies towards; `path` (k, 2) plane mm, mouth first."""
    x, y = np.asarray(path)[-1] - np.asarray(path)[0]
    right, left = ends(np.array([-y, x]) @ np.asarray(axes)[:2])
    return {"left": left, "right": right}


def lips_told(cuts, plane: str, axes, display: str) -> str:
    """Which lip is which, in a sentence; `cuts` are (name, path)."""
    lefts = [(f"'{name}'", lip_ends(path, axes)["left"]) for name, path in cuts]
    told = [f"left of {', '.join(name for name, _ in group)} is the {letter} lip"
            for letter, group in groupby(lefts, key=lambda each: each[1])]
    where = " in neurological display" if mirrored(plane, display) else ""
    return f"Left and right of a cut are seen from its mouth{where}: {'; '.join(told)}." if told else ""
