"""The methods paragraph of a run: what was done, in the words of a paper, with every number that a reader needs.

It is written from the record of the run alone (`run.json`), so that whoever has the record can write it again.
"""

from collections.abc import Callable
from importlib.metadata import version
from pathlib import PurePath
from typing import NamedTuple

from xfemnav.pipeline.asking.parameters import KINDS

LIBRARIES = ("numpy", "scipy", "scikit-image", "SimpleITK", "nibabel", "shapely", "numba")
EXTENDED = (
    "Vigneron LM, Verly JG, Warfield SK. Modelling surgical cuts, retractions, and resections via extended finite "
    "element method. In: Medical Image Computing and Computer-Assisted Intervention (MICCAI 2004), Lecture Notes in "
    "Computer Science 3217, pp. 311–318. Springer, 2004.",
    "Moës N, Dolbow J, Belytschko T. A finite element method for crack growth without remeshing. International Journal "
    "for Numerical Methods in Engineering 46: 131–150, 1999.",
)
#: What the numbers in brackets are, by the dimension of the run.
CITATIONS = {
    2: (*EXTENDED, "Persson P-O, Strang G. A simple mesh generator in MATLAB. SIAM Review 46(2): 329–345, 2004."),
    3: (*EXTENDED,
        "Labelle F, Shewchuk JR. Isosurface stuffing: fast tetrahedral meshes with good dihedral angles. ACM "
        "Transactions on Graphics 26(3): 57, 2007.",
        "Vaněk P, Mandel J, Brezina M. Algebraic multigrid by smoothed aggregation for second and fourth order "
        "elliptic problems. Computing 56: 179–196, 1996.",
        "Bell N, Olson LN, Schroder J. PyAMG: algebraic multigrid solvers in Python. Journal of Open Source Software "
        "7(72): 4142, 2022."),
}
ORGANS = {
    "mask": "The mask of the organ was given.",
    "stripped": "The image was skull-stripped; the organ is its foreground with the holes filled.",
    "otsu": "The organ is the largest component above Otsu's threshold, with the holes filled.",
    "vote": "The organ was segmented by the majority of three methods (Otsu's threshold, a marker watershed, and a "
            "search over thresholds and openings).",
    "svc": "The organ was segmented by template-moderated, spatially varying classification (Warfield et al. 2000).",
}
TIPS = {
    "topological": "the four crack-tip functions by the {} whose support holds the tip",
    "geometric": "the four crack-tip functions by the {} within a fixed distance of the tip",
    "none": "no crack-tip functions were used",
}
LIPS = {
    "mortar": "by Lagrange multipliers along the held part of each lip (mortar)",
    "nitsche": "weakly along the held part of each lip (Nitsche's method)",
    "pointwise": "at every crossing of the cut with a mesh edge, as in [1]",
}
FREE_LIPS = {"contact": "Lips that nothing held could not pass through each other (frictionless contact).",
             "free": "Lips that nothing held were free."}
SKULLS = {"fixed": "The outline was fixed", "sliding": "The outline slid along the skull without friction",
          "contact": "The outline could leave the skull but not pass through it, without friction,"}


def methods_paragraph(run: dict) -> str:
    """Plain text. `run` is the content of run.json for a run that has outputs; numbers in brackets are `CITATIONS`."""
    asked, told = run["parameters"], IN_SPACE if run.get("dimension", 2) > 2 else IN_THE_PLANE
    sentences = [
        told.software(run), told.mesh(run), *map(told.cut, run["cuts"]),
        *(_resection(each, asked) for each in run["resections"]), told.enrichment(run),
        _tissue(asked, told.state.format(**asked["solve"])), *_labels(asked),
        _outline(asked).replace("The outline", told.rim), *_loads(asked),
        *(_retraction(each, run) for each in asked["retract"]), _lips(asked), _model(run), _steps(run),
        _outcome(run, told.size), _image(asked, told.sample), _carried(asked),
    ]
    return " ".join(filter(None, sentences))


def library_versions() -> str:
    """'numpy 2.4.6, scipy 1.17.1, ...': what the numbers were computed with."""
    return ", ".join(f"{name} {version(name)}" for name in LIBRARIES)


def _software(run):
    image, plane = PurePath(run["parameters"]["image"]).name, run["slice"]
    return (f"The preoperative image {image} ({plane['plane']} slice at {plane['offset']:.1f} mm) was updated for the "
            f"surgical cut in two dimensions with xfemnav {run['version']} ({library_versions()}), an implementation "
            "of the method of Vigneron et al. [1].")


def _solid_software(run):
    shape, sizes = (" x ".join(f"{x:.4g}" for x in run["volume"][key]) for key in ("shape", "spacing"))
    return (f"The preoperative image {PurePath(run['parameters']['image']).name} ({shape} voxels of {sizes} mm) was "
            f"updated for the surgical cut in three dimensions with xfemnav {run['version']} ({library_versions()}, "
            f"pyamg {version('pyamg')}), which extends the method of Vigneron et al. [1].")


def _mesh(run):
    asked, mesh = run["parameters"]["mesh"], run["mesh"]
    size = f"{mesh['n_nodes']} nodes and {mesh['n_cells']} linear triangles"
    quality = f"(quality 2 r_in/r_out: smallest {mesh['min_quality']:.2f}, mean {mesh['mean_quality']:.2f})"
    if asked["file"]:
        return f"The mesh was given; it had {size} {quality}."
    return (f"{ORGANS[run['segmentation']['method']]} A mesh made after [3] had {size} with {_edges(asked)} {quality}; "
            "it does not contain the cut.")


def _edges(asked):
    edges = f"edges of {asked['element_size_mm']:g} mm"
    if asked["corridor_mm"] > 0:
        edges += f", and of {asked['corridor_element_mm']:g} mm within {asked['corridor_mm']:g} mm of the cut"
    return edges


def _solid_mesh(run):
    mesh, edges = run["mesh"], _edges(run["parameters"]["mesh"])
    return (f"{ORGANS[run['segmentation']['method']]} A mesh made of its signed distance by isosurface stuffing [3] "
            f"had {mesh['n_nodes']} nodes and {mesh['n_cells']} linear tetrahedra with {edges} (quality 3 r_in/r_out: "
            f"smallest {mesh['min_quality']:.2f}, mean {mesh['mean_quality']:.2f}); it does not contain the cut.")


def _cut(cut):
    points = " to ".join("({:.1f}, {:.1f})".format(*point) for point in cut["path"])
    return f"The cut '{cut['name']}' was {cut['length_mm']:.1f} mm long, in plane coordinates from {points} mm."


def _solid_cut(cut):
    return (f"The cut '{cut['name']}', a surface of {cut['area_mm2'] / 100:.1f} cm², was {cut['along_mm']:.1f} mm long "
            f"and {cut['depth_mm']:.1f} mm deep in the mean.")


def _resection(resection, asked):
    drawn = next(item for item in asked["resect"] if item["name"] == resection["name"])
    source = f"the mask {PurePath(drawn['mask'] or '').name}"
    if drawn["label"] is not None:
        labels = drawn["label"] if isinstance(drawn["label"], list) else [drawn["label"]]
        source = (f"label{'s' * (len(labels) > 1)} {', '.join(map(str, labels))} of "
                  f"{PurePath(asked['tissue']['labels']).name}")
    rule = f"bits under a disc of {asked['min_resection_mm']:g} mm were left, and holes under it filled"
    told = f" ({source}; {rule})" if drawn["label"] is not None or drawn["mask"] is not None else ""
    return f"The resection '{resection['name']}'{told} took out {resection['area_mm2']:.0f} mm² of tissue."


def _enrichment(run):
    nodes = run["enrichment"]
    tips = TIPS[run["parameters"]["solve"]["tip_enrichment"]].format(nodes["tip_nodes"])
    return ("It was embedded in the mesh by the extended finite element method [1, 2]: the discontinuous function was "
            f"carried by {nodes['heaviside_nodes']} nodes, {tips}; in all there were {nodes['n_dof']} degrees "
            "of freedom.")


def _solid_enrichment(run):
    nodes = run["enrichment"]
    return ("It was embedded in the mesh by the extended finite element method [1, 2]: level sets at the nodes, signed "
            "distances from it and from its border, split the tetrahedra that it crosses, and a discontinuous function "
            f"was carried by {nodes['heaviside_nodes']} nodes; in all there were {nodes['n_dof']} degrees of freedom. "
            "The equations were solved by conjugate gradients with smoothed aggregation [4, 5] to a relative residual "
            f"of {run['checks']['residual']:.0e}.")


def _tissue(asked, state):
    kind = {"linear": "linearly elastic", "neo-hookean": "neo-Hookean"}[asked["solve"]["model"]]
    where = " but for the labels below" if asked["tissue"]["by_label"] else ""
    return (f"The tissue was homogeneous{where}, isotropic, and {kind}{state} "
            f"(Young's modulus {asked['tissue']['young_kpa']:g} kPa, Poisson's ratio {asked['tissue']['poisson']:g}).")


def _labels(asked):
    tissue = asked["tissue"]
    for label, item in sorted(tissue["by_label"].items(), key=lambda pair: int(pair[0])):
        times, ratio = KINDS[item["kind"]]
        young = item["young_kpa"] if item["young_kpa"] is not None else times * tissue["young_kpa"]
        own = next(value for value in (item["poisson"], ratio, tissue["poisson"]) if value is not None)
        yield f"Label {label} of {PurePath(tissue['labels'] or '').name} was {item['kind']} ({young:g} kPa, {own:g})."


def _loads(asked):
    load = asked["load"]
    if load["gravity"] is not None:
        fluid = load["fluid_level_mm"]
        drained = "drained" if fluid is None else (f"floating in fluid of {load['fluid_density_kg_m3']:g} kg/m³ beyond "
                                                   f"{fluid:g} mm along gravity")
        yield (f"Gravity acted along {_vector(load['gravity'])}"
               f" on tissue of {load['density_kg_m3']:g} kg/m³, {drained}.")
    for pressure in load["pressure"]:
        yield f"A pressure of {pressure['kpa']:g} kPa acted on '{pressure['on']}'."


def _vector(numbers):
    return f"({', '.join(f'{x:g}' for x in numbers)})"


def _model(run):
    model = run["model"]
    if model["name"] == "linear":
        return ""
    return (f"Finite strains were solved with a compressible neo-Hookean material in {model['load_steps']} load steps; "
            f"the linear answer differs from it by up to {model['linear_difference_mm']:.2f} mm.")


def _steps(run):
    names = [step["name"] for step in run.get("steps", ())]
    return f"The steps were {', '.join(names)}; the numbers are those of the last one." if names else ""


def _carried(asked):
    names = [PurePath(item["image"]).name for item in asked["companion"]]
    names += [PurePath(name).name for key in ("points", "streamlines", "surfaces") for name in asked[key]]
    return f"Through the same map went {', '.join(names)}." if names else ""


def _outline(asked):
    boundary = asked["boundary"]
    if boundary["displacement"]:
        weight = boundary["displacement_weight"]
        how = f", followed by springs of {weight:g} kPa/mm" if weight else ""
        return f"The outline moved as measured ({PurePath(boundary['displacement']).name}){how}."
    if boundary["skull"] == "free":
        return "The outline was free."
    ramp = f"; the skull's grip set in over {boundary['skull_ramp_mm']:g} mm" if boundary["skull_ramp_mm"] else ""
    return f"{SKULLS[boundary['skull']]} except within {boundary['craniotomy_mm']:g} mm of the cut's mouth{ramp}."


def _retraction(retract, run):
    asked = run["parameters"]
    lip = f"The lip {retract['side']} of " + (f"'{retract['cut']}'" if len(asked["cut"]) > 1 else "the cut")
    if retract["displacement_mm"] is not None:
        what = f"was displaced by {_vector(retract['displacement_mm'])} mm{_from_where(retract, asked)}"
    elif retract["normal_mm"] is not None:
        what = f"was displaced by {retract['normal_mm']:g} mm away from the other lip{_from_where(retract, asked)}"
    else:
        unit = "mN" if run.get("dimension", 2) > 2 else "mN per mm of thickness"
        what = f"was loaded with {_vector(retract['force_mN_per_mm'])} {unit}"
    found = [row["blade"] for row in run["retractor"] if (row["cut"], row["side"]) == (retract["cut"], retract["side"])]
    blade = retract["blade"]
    if blade and len(found) == 1:
        blade = found[0]  # it ends before a tip, whatever was asked
    held = f" over {100 * blade[0]:.3g} to {100 * blade[1]:.3g} % of the cut's length from its mouth" if blade else ""
    along = retract.get("blade_along")
    beside = f", and {100 * along[0]:.3g} to {100 * along[1]:.3g} % of the way along it" if along else ""
    return f"{lip} {what}{held}{beside}."


def _from_where(retract, asked):
    """From where a displacement counts, where anything but blades moves the lips."""
    others = asked["load"]["gravity"] or asked["load"]["pressure"] or asked["boundary"]["displacement"]
    if not others:
        return ""
    counts = retract["relative_to"] or ("rest" if retract["normal_mm"] is None else "loads")
    where = "where the lip lay without blades" if counts == "loads" else "its place at rest"
    return f", from {where}"


def _lips(asked):
    held = any(retract["force_mN_per_mm"] is None for retract in asked["retract"])
    imposed = f"Displacements of the lips were imposed {LIPS[asked['solve']['lip_constraint']]}. " if held else ""
    return (imposed + FREE_LIPS[asked["boundary"]["lips"]]) if asked["cut"] else ""


def _outcome(run, size):
    checks = run["checks"]
    return (f"The tissue moved by at most {checks['max_displacement_mm']:.2f} mm, the opened cavity measured "
            f"{checks[f'cavity_{size}']:.0f} {UNITS[size]}, and {checks[f'inverted_{size}']:.2f} {UNITS[size]} of "
            "tissue was inverted.")


def _image(asked, sample):
    return (f"Every {sample} of the updated image was sampled at its resting place in the preoperative image "
            f"({asked['warp']['interp']} interpolation).")


UNITS = {"mm2": "mm²", "mm3": "mm³"}


class Told(NamedTuple):
    """The sentences and words that a run has by its dimension."""

    software: Callable[[dict], str]
    mesh: Callable[[dict], str]
    cut: Callable[[dict], str]
    enrichment: Callable[[dict], str]
    rim: str
    state: str
    size: str
    sample: str


IN_THE_PLANE = Told(_software, _mesh, _cut, _enrichment, "The outline", " in plane {stress_state}", "mm2",
                    "pixel")
IN_SPACE = Told(_solid_software, _solid_mesh, _solid_cut, _solid_enrichment, "The surface", "", "mm3", "voxel")
