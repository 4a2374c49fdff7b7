"""The paper's experiment on a real slice that nilearn brings along, and an approach through the whole of its brain: no
network is needed."""

from importlib.util import find_spec
from pathlib import Path

from xfemnav.errors import XfemnavError

VOLUME = "datasets/data/mni_icbm152_t1_tal_nlin_sym_09a_converted.nii.gz"
SLICE = {"plane": "axial", "slice_mm": 18.0}
CUT = {"cut": ("-54.7,41.5 -22,18",)}  # from the surface of the left frontal lobe to a plausible tumour
LIPS = {"left": "3.5,1", "right": "-3.5,-1"}  # the paper's Sect. 5, with the signs that open the cut
#: Of a volume: a curve on the right frontal lobe, front to back above the sulcus, swept towards the frontal horn; and a
#: blade that keeps off the ends of the cut.
SOLID_CUT = {"cut": ("27,12,68 25,27,61 23,40,52",), "towards": "14,24,14"}
SOLID_LIPS = {"opening_mm": 8.0, "blade": "0,0.4", "blade_along": "0.25,0.75"}


def image() -> Path:
    """The MNI152 T1 volume of the installed nilearn. Raises E100 when nilearn is not there."""
    found = find_spec("nilearn")
    path = Path(found.submodule_search_locations[0]) / VOLUME if found else None
    if path is None or not path.is_file():
        raise XfemnavError("E100", "the demo needs the MNI152 image of nilearn: pip install 'xfemnav[demo]'.")
    return path


def with_defaults(flags: dict) -> dict:
    """`flags` with the demo's slice, or its volume, and its cut and lips where they name none."""
    solid = flags.get("dim") == 3
    own = {} if solid else SLICE
    if not flags.get("cut"):
        own = own | (SOLID_CUT if solid else CUT)
    if not any(flags.get(name) for name in ("left", "right", "lip_force", "opening_mm")):
        own = own | (SOLID_LIPS if solid else LIPS)
    return flags | own
