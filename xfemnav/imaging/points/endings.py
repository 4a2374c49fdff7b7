"""Endings of the files of tracts and surfaces that are read here: a file is told by its name, and nothing is loaded."""

from pathlib import Path

TRACTS = (".trk", ".trk.gz", ".tck", ".tck.gz")
SURFACES = (".stl", ".vtk", ".vtp", ".gii", ".surf.gii", ".obj", ".ply")


def ending_of(path, endings: tuple[str, ...]) -> str:
    """The longest of the `endings` that the name at `path` has, in lower case; "" for none."""
    name = Path(path).name.lower()
    return max((ending for ending in endings if name.endswith(ending)), key=len, default="")
