"""What a run calls its files: public names as BIDS forms them, and its record and pages."""

import os
import re
from pathlib import Path

RECORD = "run.json"
SCHEMA, LIMIT_BYTES = "xfemnav-run/2", 50_000_000  # of the record
KNOWN_SCHEMAS = (SCHEMA, "xfemnav-run/1")  # that are read: those without a `dimension` are of slices
LONGEST_NAME = 255  # bytes, on the usual file systems
BIDS = re.compile(r"(sub-[A-Za-z0-9]+(?:_[a-z]+-[A-Za-z0-9]+)*)_([A-Za-z0-9]+)$")
#: role: (description entity, suffix; None keeps the image's own, ending)
NAMES = {
    "mask": ("brain", "mask", ".nii.gz"),
    "mesh": (None, "mesh", ".vtu"),
    "solution": (None, "solution", ".vtu"),
    "lips-surface": ("lips", "surface", ".vtp"),
    "organ-surface": ("organ", "surface", ".vtp"),
    "updated": ("updated", None, ".nii.gz"),
    "cavity": ("cavity", "mask", ".nii.gz"),
    "overlap": ("overlap", "mask", ".nii.gz"),
    "field": ("field", "xfm", ".nii.gz"),
    "lips": ("lips", "dseg", ".nii.gz"),
    "transform": ("updated", "xfm", ".h5"),
    "transform-extended": ("extended", "xfm", ".h5"),
    "field-nrrd": ("fieldnrrd", "xfm", ".nrrd"),
    "field-nifti": ("fielditk", "xfm", ".nii.gz"),
    "forward-nrrd": ("forward", "xfm", ".nrrd"),
    "cuts": ("cuts", "markups", ".mrk.json"),
    "companion": ("updated", None, ".nii.gz"),
    "points": ("updated", "points", ""),
    "points-markups": ("updated", "points", ".mrk.json"),
    "streamlines": ("updated", "streamlines", ""),
    "surfaces": ("updated", "surfaces", ""),
}
WITH_SIDECAR = (".nii.gz", ".nrrd", ".h5")
PAGES = {"figure": ("figure", ".png"), "report": ("report", ".html"), "scenario": ("scenario", ".toml")}
#: Roles whose files are named after a carried file, not after the image.
CARRIED = ("companion", "points", "streamlines", "surfaces")
#: Those of them whose own suffix says what they are of (pial, white), and is kept where they have one.
OWN_SUFFIX = ("surfaces",)
#: What a run calls its files: `public_name` of any image, step and carried file, and their sidecars.
OWN_NAME = re.compile("|".join([
    *(rf"{name}(_step-\w+)?{re.escape(ending)}" for name, ending in PAGES.values()),
    *(r"[^/\0]*" + (f"_desc-{what}" if what else "")
      + (f"_{suffix}" if suffix and role not in OWN_SUFFIX else "(_[^/]+)?")
      + (f"({re.escape(ending)}|[.]json)" if ending else r"[.]\w[\w.]*")
      for role, (what, suffix, ending) in NAMES.items())]))


def stem(image: Path) -> str:
    """Name of an image, point file, tractogram or surface without its ending."""
    endings = (r"\.(nii|nrrd|nhdr|mha|mhd|mgz|mgh|mrk\.json|json|fcsv|csv|tsv|tag|trk|tck|"
               r"stl|vtk|vtp|surf\.gii|gii|obj|ply)(\.gz)?$")
    return re.sub(endings, "", image.name, flags=re.IGNORECASE)


def slug(name: str) -> str:
    """The letters and digits of a name: what a file name holds of it."""
    return re.sub(r"[^A-Za-z0-9]+", "", name)


def public_name(image: Path, role: str, source: str = "") -> str:
    """File name of an output: BIDS names keep their suffix (sub-01_T1w -> sub-01_desc-updated_T1w).

    A role "what:which" is of the step, or of the carried file, called `which`; points, streamlines and surfaces keep
    the ending of their `source`, and surfaces their suffix, which says what they are of.
    """
    what, _, which = role.partition(":")
    carried = which and what.partition("-")[0] in CARRIED
    step = f"step-{slug(which)}" if which and not carried else None
    if what in PAGES:
        name, ending = PAGES[what]
        return "_".join(filter(None, (name, step))) + ending
    description, suffix, ending = NAMES[what]
    match = BIDS.match(which if carried else stem(image))
    base, own = match.groups() if match else (which if carried else stem(image), None)
    if match and description:
        base = re.sub(r"_desc-[A-Za-z0-9]+", "", base)
    suffix = own or suffix if carried and what in OWN_SUFFIX else suffix or own
    parts = [step, description and f"desc-{description}", suffix]
    tail = "".join(f"_{part}" for part in parts if part) + (ending or source)
    while max(len(os.fsencode(name)) for name in (base + tail, sidecar_name(base + tail))) > LONGEST_NAME:
        base = base[:-1]
    return base + tail


def sidecar_name(name: str) -> str:
    """Name of the JSON beside an image or a transform."""
    return re.sub(r"\.(nii\.gz|nrrd|h5)$", "", name) + ".json"
