"""What the values of an image are, labels or measurements, where nobody says it: its name, its header, its data.

Averaged labels are wrong without a trace, and measurements taken from the nearest voxel are coarse. A BIDS suffix or
a NIfTI intent settles it; else labels are whole numbers most of which have neighbours of their own kind.
"""

import re
from pathlib import Path

import numpy as np

from xfemnav.errors import XfemnavError, warn
from xfemnav.imaging.carrying.background import background, corner_values
from xfemnav.imaging.reading.conventions import DIRECTED
from xfemnav.imaging.reading.gate import Components, Image, read_components, read_image
from xfemnav.limits import CONTINUOUS_ALIKE, LABELS_ALIKE

#: Suffixes of BIDS (and .seg, -label of 3D Slicer), in small letters.
LABELS = {"dseg", "mask", "defacemask", "seg", "label"}
MEASURED = {"probseg", "bold", "boldref", "sbref", "cbv", "dwi", "dwiref", "dwimap", "asl", "m0scan", "cbf", "perf",
            "pet", "ct", "t1w", "t2w", "t2starw", "flair", "pd", "pdw", "pdt2", "unit1", "inplanet1", "inplanet2",
            "angio", "flash", "t1map", "t2map", "t2starmap", "r1map", "r2map", "r2starmap", "pdmap", "mtrmap", "mtsat",
            "chimap", "s0map", "t1rho", "mp2rage", "megre", "mese", "vfa", "mts", "mtr", "statmap", "tmap", "zmap",
            "fieldmap", "magnitude", "magnitude1", "magnitude2", "phasediff", "epi", "fa", "md", "adc"}
LABEL_INTENT, STATISTICS = 1002, range(2, 25)  # NIfTI's codes


def read_companion(path, kind: str | None = None, *, max_memory_gb=4.0, nifti_frame="auto") -> Image | Components:
    """The image at `path`, with all its values a voxel where it may have several; NaN is 0.

    Raises E131 for several values of which neither `kind` nor the name says what they are, and what reading raises.
    """
    options = {"nan": 0.0, "max_memory_gb": max_memory_gb, "nifti_frame": nifti_frame}
    if kind in DIRECTED:
        return read_components(path, **options)
    try:
        return read_image(path, **options)
    except XfemnavError as error:
        if error.code not in ("E121", "E122") or kind == "label":
            raise
        if kind is None and _by_name(Path(path).name) != "continuous":
            raise XfemnavError("E131", f"{Path(path).name} holds several values a voxel. Say what they are: "
                                       f"continuous, {', '.join(DIRECTED)}.") from None
        return read_components(path, **options)


def kind_of(image: Image | Components) -> str:
    """The kind of an image of which nobody said it: label or continuous, by name, header and data.

    Raises E131 where they leave it open; warns W135 where it is a guess from the data.
    """
    stated = _by_name(image.name) or _by_intent(image.intent)
    if image.values.ndim == 4 or stated == "continuous":
        return "continuous"
    whole = bool((image.values == np.rint(image.values)).all())
    if stated == "label" and not whole:
        warn("W135", f"{image.name} is taken as continuous: its name or header says labels, but it holds fractions.")
        return "continuous"
    if stated or not whole:
        return stated or "continuous"
    alike = _alike(image.values)
    told = f"{alike:.0%} of its neighbouring voxels that are not both background are equal"
    if CONTINUOUS_ALIKE.value <= alike <= LABELS_ALIKE.value:
        raise XfemnavError("E131", f"{image.name} holds whole numbers, and {told}: they may be labels or measurements. "
                                   "Say which: kind label or continuous.")
    kind = "label" if alike > LABELS_ALIKE.value else "continuous"
    warn("W135", f"{image.name} is taken as {kind}: it holds whole numbers, and {told}.")
    return kind


def _by_name(name: str) -> str | None:
    """Kind by the suffix of a file's name: sub-01_dseg.nii.gz, tumour.seg.nrrd, tumour-label.nrrd."""
    match = re.search(r"(?:^|[_.-])([A-Za-z0-9]+)(?:\.(?:nii|nrrd|nhdr|mha|mhd|mgz|mgh))?(?:\.gz)?$", name)
    suffix = match[1].lower() if match else ""
    return "label" if suffix in LABELS else "continuous" if suffix in MEASURED else None


def _by_intent(intent: int) -> str | None:
    return "label" if intent == LABEL_INTENT else "continuous" if intent in STATISTICS else None


def _alike(values: np.ndarray) -> float:
    """Share of neighbouring pairs of voxels (ni, nj, nk) that are equal, but for those of background; 1 for a mask."""
    blank = background(corner_values(values), [])
    equal = pairs = 0
    for axis in range(3):
        a, b = np.moveaxis(values, axis, 0)[:-1], np.moveaxis(values, axis, 0)[1:]
        same = a == b
        empty = int((same & ((a == 0) | (a == blank))).sum())
        equal += int(same.sum()) - empty
        pairs += a.size - empty
    two_valued = np.isin(values, (values.min(), values.max())).all()
    return 1.0 if two_valued else equal / max(pairs, 1)
