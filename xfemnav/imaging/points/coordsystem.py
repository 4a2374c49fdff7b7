"""BIDS: in what a table of electrodes counts, which a *_coordsystem.json beside it says.

Systems and units: appendix "Coordinate systems" of the BIDS specification. Only what is the world of an image is read:
the scanner's, AC-PC, and the templates', all RAS. Systems of the head (CTF, Captrak, ...) are about landmarks on it.
"""

import json
import os
import re
from pathlib import Path

from xfemnav.imaging.reading.content import decoded, file_bytes

LIMIT_BYTES = 1_000_000
ENDING = "_coordsystem.json"
MODALITIES = ("iEEG", "EEG", "MEG", "NIRS", "EMG")
IMAGES = re.compile(r"scanras|acpc|(mni|icbm|fsaverage|fslr|talairach|ixi549|oasis|nki|uncinfant)\w*", re.IGNORECASE)
ELSEWHERE = ("ctf", "elektaneuromag", "4dbti", "kityokogawa", "chietiitab", "besa", "captrak", "eeglab", "eeglab-hj",
             "pixels")
MM = {"mm": 1.0, "cm": 10.0, "m": 1e3}


def beside(path: Path) -> Path | None:
    """The file that says what a table counts in: all its entities are the table's, and `space` is one; None for none.

    Of several the one with most entities in common.
    """
    own = _entities(path.name)
    found = [(len(entities), file) for file in path.parent.glob(f"*{ENDING}")
             if (entities := _entities(file.name)) <= own and _space(entities) == _space(own) and os.path.isfile(file)]
    closest = [file for n, file in found if n == max(n for n, _ in found)]
    return closest[0] if len(closest) == 1 else None


def unit(path: Path) -> float | None:
    """Millimetres of the unit of a table whose system is an image's, RAS; None where that is not said.

    Raises E308 for a system or unit that is no image's.
    """
    from xfemnav.imaging.points.point_set import POINT_FILE, shown, unusable  # numpy, which `beside` does without

    try:
        stated = json.loads(decoded(file_bytes(path, LIMIT_BYTES, POINT_FILE)))
    except (ValueError, RecursionError) as error:
        raise unusable(path.name, f"is no JSON: {shown(str(error))}. Write it again.") from None
    stated = stated if isinstance(stated, dict) else {}
    kind = next((kind for kind in MODALITIES if f"{kind}CoordinateSystem" in stated), "")
    system, units = (str(stated.get(f"{kind}Coordinate{field}", "")) for field in ("System", "Units"))
    if system.lower() in ELSEWHERE or (IMAGES.fullmatch(system) and units not in MM):
        raise unusable(path.name, f"says {shown(system)} in {shown(units)}, which is no place in an image. Convert the "
                                  "points to the image's world (ScanRAS) in mm.")
    return MM.get(units, 1.0) if IMAGES.fullmatch(system) else None


def _entities(name: str) -> set[str]:
    """sub-01, ses-1, ... of a BIDS name."""
    return {part for part in name.split("_") if re.fullmatch(r"[a-z]+-[A-Za-z0-9+]+", part)}


def _space(entities: set[str]) -> set[str]:
    return {part for part in entities if part.startswith("space-")}
