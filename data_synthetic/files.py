"""A phantom as the files a user would have: NIfTI images, a cut for 3D Slicer, tables, a scenario."""

import json
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path

import nibabel as nib
import numpy as np

from .phantom import Grid, Phantom, boundary_displacement, cut_path, landmarks

SCHEMA = "https://raw.githubusercontent.com/Slicer/Slicer/main/Modules/Loadable/Markups/Resources/Schema/" \
         "markups-schema-v1.0.3.json#"


def turned(oblique: float) -> np.ndarray:
    """Rotation (3, 3) by `oblique` degrees about the R axis; plane coordinates do not change under it."""
    c, s = cos(radians(oblique)), sin(radians(oblique))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def to_nifti(values, grid: Grid, *, oblique: float = 0.0, slope: float | None = None) -> nib.Nifti1Image:
    """One-slice volume of `values` (n1, n2) or (n1, n2, k), 1 mm thick, in the grid's storage order (any of the 48).

    With `slope`, int16 numbers that `slope` multiplies; else the type of `values`.
    """
    volume = np.asarray(values)[:, :, None]
    affine = np.diag([*grid.spacing, 1.0, 1.0])
    affine[:2, 3] = grid.origin
    rotation = np.eye(4)
    rotation[:3, :3] = turned(oblique)
    if slope is not None:
        volume = np.round(volume / slope).astype(np.int16)
    image = nib.Nifti1Image(volume, rotation @ affine)
    here, there = nib.io_orientation(image.affine), nib.orientations.axcodes2ornt(grid.order)
    image = image.as_reoriented(nib.orientations.ornt_transform(here, there))
    image.set_sform(image.affine, code=1)
    image.set_qform(image.affine, code=1)
    image.header.set_xyzt_units("mm")
    if slope is not None:
        image.header.set_slope_inter(slope, 0)
    return image


def world(points, oblique: float = 0.0) -> np.ndarray:
    """World RAS mm (n, 3) of points (n, 2) mm in the plane."""
    return np.column_stack([points, np.zeros(len(points))]) @ turned(oblique).T


def markup(path, oblique: float = 0.0) -> dict:
    """3D Slicer curve of a cut `path` (n, 2) mm in the plane, in LPS."""
    points = [{"id": str(k + 1), "label": f"cut-{k + 1}", "position": [round(float(x), 9) for x in p],
               "positionStatus": "defined"} for k, p in enumerate(world(path, oblique) * (-1, -1, 1))]
    return {"@schema": SCHEMA, "markups": [{"type": "Curve", "coordinateSystem": "LPS", "coordinateUnits": "mm",
                                            "controlPoints": points}]}


SCENARIO = """xfemnav = 1
image = "sub-phantom_T1w.nii.gz"
mask = "sub-phantom_desc-brain_mask.nii.gz"
space = "ras"

[[companion]]
image = "sub-phantom_dseg.nii.gz"
kind = "label"

[boundary]
displacement = "boundary.csv"
"""
CUT = """
[[cut]]
name = "approach"
markups = "cut.mrk.json"
"""


def write(phantom: Phantom, folder, *, seed: int | None = None, order: str | None = None,
          oblique: float = 0.0) -> dict[str, Path]:
    """Write the phantom in `folder`, made if need be; returns role: path. The same arguments give the same bytes.

    `seed` adds noise to the image, `order` overrides the grid's storage order, `oblique` turns the slice about the R
    axis.
    """
    folder = Path(folder)
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    grid = phantom.grid if order is None else replace(phantom.grid, order=order)
    truth, centres = phantom.truth, phantom.grid.centres()
    motion = np.nan_to_num(truth.places - centres)
    images = {
        "image": ("sub-phantom_T1w", phantom.image(seed), grid.slope),
        "mask": ("sub-phantom_desc-brain_mask", phantom.mask.astype(np.uint8), None),
        "labels": ("sub-phantom_dseg", phantom.labels, None),
        "truth_image": ("truth/sub-phantom_T1w", truth.image, grid.slope),
        "truth_labels": ("truth/sub-phantom_dseg", truth.labels, None),
        "truth_cavity": ("truth/sub-phantom_label-cavity_mask", truth.cavity.astype(np.uint8), None),
        "truth_field": ("truth/sub-phantom_field", motion, None),
    }
    paths = {}
    for role, (stem, values, slope) in images.items():
        values = values.astype(np.float32) if values.dtype == float and slope is None else values
        paths[role] = folder / f"{stem}.nii.gz"
        nib.save(to_nifti(values, grid, oblique=oblique, slope=slope), paths[role])
    rest = landmarks()
    tables = {
        "boundary": ("boundary.csv", "x,y,ux,uy,side", boundary_displacement(phantom)),
        "points": ("landmarks.csv", "r,a,s", world(rest, oblique)),
        "truth_points": ("truth/landmarks.csv", "r,a,s", world(rest + phantom.displacement(rest), oblique)),
    }
    for role, (name, header, rows) in tables.items():
        paths[role] = folder / name
        np.savetxt(paths[role], rows, fmt="%.12g", delimiter=",", header=header, comments="")
    paths["scenario"] = folder / "scenario.toml"
    paths["scenario"].write_text(SCENARIO + (CUT if phantom.has_cut else ""))
    if phantom.has_cut:
        paths["cut"] = folder / "cut.mrk.json"
        paths["cut"].write_text(json.dumps(markup(cut_path(), oblique), indent=2) + "\n")
    return paths
