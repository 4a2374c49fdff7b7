"""The methods paragraph of a run: what was done, in the words of a paper, with every number that a reader needs.

It is written from the record of the run alone (`run.json`), so that whoever has the record can write it again.
"""

from importlib.metadata import version
from pathlib import PurePath

LIBRARIES = ("numpy", "scipy", "scikit-image", "SimpleITK", "nibabel", "shapely", "numba")
CITATIONS = (
    "Vigneron LM, Verly JG, Warfield SK. Modelling surgical cuts, retractions, and resections via extended finite "
    "element method. In: Medical Image Computing and Computer-Assisted Intervention (MICCAI 2004), Lecture Notes in "
    "Computer Science 3217, pp. 311–318. Springer, 2004.",
    "Moës N, Dolbow J, Belytschko T. A finite element method for crack growth without remeshing. International Journal "
    "for Numerical Methods in Engineering 46: 131–150, 1999.",
    "Persson P-O, Strang G. A simple mesh generator in MATLAB. SIAM Review 46(2): 329–345, 2004.",
)
TIPS = {
    "topological": "the four crack-tip functions were carried by the nodes whose support holds the tip",
    "geometric": "the four crack-tip functions were carried by all nodes within a fixed radius of the tip",
    "none": "no crack-tip functions were used",
}
LIPS = {
    "mortar": "by Lagrange multipliers along the held part of each lip (mortar)",
    "nitsche": "by Nitsche's method along the held part of each lip",
    "pointwise": "at every crossing of the cut with a mesh edge, as in [1]",
}
SKULLS = {
    "fixed": "The outline was fixed",
    "sliding": "The outline slid along the skull without friction",
    "free": "The outline was free",
}


def methods_paragraph(run: dict) -> str:
    """Plain text. `run` is the content of run.json for a run that has outputs; numbers in brackets are `CITATIONS`."""
    asked = run["parameters"]
    sentences = [_software(run), _organ(asked), _mesh(run), *map(_cut, asked["cut"]), _enrichment(run), _tissue(asked),
                 _outline(asked), *(_retraction(each, asked) for each in asked["retract"]), _lips(asked), _outcome(run),
                 _image(asked)]
    return " ".join(filter(None, sentences))


def library_versions() -> str:
    """'numpy 2.4.6, scipy 1.17.1, ...': what the numbers were computed with."""
    return ", ".join(f"{name} {version(name)}" for name in LIBRARIES)


def _software(run):
    image = PurePath(run["parameters"]["image"]).name
    return (f"The preoperative image {image} was updated for the surgical cut in two dimensions with xfemnav "
            f"{run['version']} ({library_versions()}), an implementation of the method of Vigneron et al. [1].")


def _organ(asked):
    if asked["mesh"]["file"]:
        return f"The mesh was given ({PurePath(asked['mesh']['file']).name})."
    if asked["mask"]:
        return f"The organ's mask was given ({PurePath(asked['mask']).name})."
    return f"The organ was segmented automatically (method '{asked['segment']['method']}')."


def _mesh(run):
    asked, mesh = run["parameters"]["mesh"], run["mesh"]
    size = "" if asked["file"] else f" with edges of {asked['element_size_mm']:g} mm"
    if not asked["file"] and asked["corridor_mm"] > 0:
        size += f", and of {asked['corridor_element_mm']:g} mm within {asked['corridor_mm']:g} mm of the cut"
    made = "It" if asked["file"] else "A mesh made as in [3]"
    return (f"{made} had {mesh['n_nodes']} nodes and {mesh['n_cells']} linear triangles{size} (quality 2 r_in/r_out: "
            f"smallest {mesh['min_quality']:.2f}, mean {mesh['mean_quality']:.2f}); it does not contain the cut.")


def _cut(cut):
    points = " to ".join(f"({', '.join(f'{x:g}' for x in point)})" for point in cut["points"])
    return f"The cut '{cut['name']}' ran from its mouth to its tip through {points}."


def _enrichment(run):
    nodes, tips = run["enrichment"], TIPS[run["parameters"]["solve"]["tip_enrichment"]]
    return ("It was embedded in the mesh by the extended finite element method [1, 2]: the discontinuous function was "
            f"carried by {nodes['heaviside_nodes']} nodes and the tip functions by {nodes['tip_nodes']}, with "
            f"{nodes['n_dof']} degrees of freedom in all; {tips}.")


def _tissue(asked):
    return (f"The tissue was homogeneous, isotropic, and linearly elastic in plane {asked['solve']['stress_state']} "
            f"(Young's modulus {asked['tissue']['young_kpa']:g} kPa, Poisson's ratio {asked['tissue']['poisson']:g}).")


def _outline(asked):
    boundary = asked["boundary"]
    if boundary["displacement"]:
        return f"The outline moved as measured ({PurePath(boundary['displacement']).name})."
    if boundary["skull"] == "free":
        return SKULLS["free"] + "."
    ramp = f"; the skull's grip set in over {boundary['skull_ramp_mm']:g} mm" if boundary["skull_ramp_mm"] else ""
    return f"{SKULLS[boundary['skull']]} except within {boundary['craniotomy_mm']:g} mm of the cut's mouth{ramp}."


def _retraction(retract, asked):
    lip = f"The {retract['side']} lip" + (f" of '{retract['cut']}'" if len(asked["cut"]) > 1 else "")
    if retract["displacement_mm"] is not None:
        what = "was displaced by ({:g}, {:g}) mm".format(*retract["displacement_mm"])
    elif retract["normal_mm"] is not None:
        what = f"was displaced by {retract['normal_mm']:g} mm away from the other lip"
    else:
        what = "was loaded with ({:g}, {:g}) mN per mm of thickness".format(*retract["force_mN_per_mm"])
    blade = retract["blade"]
    held = f" over {100 * blade[0]:g} to {100 * blade[1]:g} % of the cut's length from its mouth" if blade else ""
    return f"{lip} {what}{held}."


def _lips(asked):
    held = any(retract["force_mN_per_mm"] is None for retract in asked["retract"])
    return f"Displacements of the lips were imposed {LIPS[asked['solve']['lip_constraint']]}." if held else ""


def _outcome(run):
    checks = run["checks"]
    return (f"The tissue moved by at most {checks['max_displacement_mm']:.2f} mm, the opened cavity measured "
            f"{checks['cavity_mm2']:.0f} mm², and {checks['inverted_mm2']:.2g} mm² of tissue was inverted.")


def _image(asked):
    return (f"Every pixel of the updated image was sampled at its resting place in the preoperative image "
            f"({asked['warp']['interp']} interpolation).")
