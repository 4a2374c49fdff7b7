"""Every setting that a flag gives, in one table: its type, its key in the scenario, its default, choices and meaning.

The options of the command and their help, the schema of scenarios, `help(xfemnav.run)` and docs/reference/scenario.md
are made of it. It imports nothing that takes time. What the mechanics owns, choices and defaults, comes from its
values.
"""

import os
from collections.abc import Collection, Sequence
from typing import Annotated, Any, NamedTuple, TypedDict, get_args

from xfemnav.mechanics.rules import (
    BLADE,
    LIP_CONSTRAINTS,
    LIPS,
    LOOSE,
    MODELS,
    SKULLS,
    STRESS_STATES,
    TIP_ENRICHMENTS,
    LipRules,
    Rules,
    Skull,
    Solid,
)

AnyPath = str | os.PathLike[str]
Drawn = AnyPath | Collection[Any]

#: Commands that end after a stage, in order; each takes the settings of its stage and of those before it.
STAGES = ("segment", "mesh", "constrain", "solve", "warp")
#: Heading of the help -> the first of the stages that needs what stands under it; "" are for every command.
INPUT, ORGAN, CUTS, RESECTION, MESH = "Input", "Organ", "Cuts and retraction", "Resection", "Mesh"
TISSUE, SOLVER, IMAGE, CARRIED, CONTROL = ("Tissue and skull", "Solver", "Updated image", "Carried along",
                                           "Output and control")
GROUPS = {INPUT: "segment", ORGAN: "segment", CUTS: "constrain", RESECTION: "constrain", MESH: "mesh",
          TISSUE: "constrain", SOLVER: "constrain", IMAGE: "warp", CARRIED: "warp", CONTROL: ""}


class SolidDefaults(NamedTuple):
    """What is left out is this in a volume: sizes of elements, mm, and what has no contact there yet."""

    element_size_mm: float = 5.0
    corridor_mm: float = 4.0
    corridor_element_mm: float = 1.25
    lips: str = "free"
    lip_constraint: str = "nitsche"
    tip_enrichment: str = "none"


SOLID = SolidDefaults()


class Setting(NamedTuple):
    """A flag: the key of the scenario that it is ("" where it is no single one), what it is when it is not given, its
    heading in the help, and what it means, with units.

    metavar: what stands for its value in the help; choices: the words that it may be; bounds: of a number, as the
    schema calls them; stage: the first that needs it, where that is not its heading's.
    """

    place: str
    default: Any
    group: str
    meaning: str
    metavar: str = ""
    choices: tuple[str, ...] = ()
    bounds: tuple[tuple[str, float], ...] = ()
    stage: str = ""


#: No number of a setting is larger, but for values of images: its squares and what it is multiplied with stay finite.
LARGEST = 1e9
POSITIVE, NOT_NEGATIVE = (("gt", 0),), (("ge", 0),)
#: Kinds of images that are carried along, and of what else is.
KINDS = ("continuous", "label", "vector", "axis", "tensor")


class Flags(TypedDict, total=False):
    """Every flag with its type, and its `Setting`; those of one section in the order of its keys.

    It types the keyword arguments of `xfemnav.run` and `xfemnav.Session`; the options of the command have its names.
    """

    plane: Annotated[str | None, Setting(
        "slice.plane", None, INPUT, "plane of the slice; left out: the plane of an image with one slice, else axial",
        choices=("axial", "coronal", "sagittal"))]
    slice: Annotated[int | None, Setting(
        "slice.index", None, INPUT, "voxel index along the plane's normal, from 0", "K", bounds=NOT_NEGATIVE)]
    slice_mm: Annotated[float | None, Setting(
        "slice.position_mm", None, INPUT, "position along the plane's normal, mm", "S")]

    cut: Annotated[Drawn | None, Setting(
        "", (), CUTS, "points of a cut, mouth first, of 2 numbers each (plane mm) or 3 (world mm): 'x,y x,y ...', or a "
        "point file (.mrk.json, .fcsv, .csv, .tsv, .tag); in a volume a curve on the surface, or a Plane of Slicer's",
        "'X,Y X,Y ...'|FILE", stage="mesh")]
    towards: Annotated[str | Sequence[float] | None, Setting(
        "", None, CUTS, "in a volume: the deep point that the curves of cuts are swept to, world mm", "X,Y,Z",
        stage="mesh")]
    depth_mm: Annotated[float | None, Setting(
        "", None, CUTS, "in a volume: how deep cuts go below the surface, mm; without a target along its normal", "D",
        stage="mesh")]
    markup: Annotated[str | None, Setting(
        "", None, CUTS, "which markup of a point file with several", "NAME", stage="mesh")]
    internal: Annotated[bool | None, Setting("", False, CUTS, "the cuts lie inside, with two tips")]
    left: Annotated[str | float | Collection[float] | None, Setting(
        "", None, CUTS, "displacement of the first cut's left lip, plane mm: 'dx,dy', in a volume world mm: "
                        "'dx,dy,dz'; "
        "or mm away from the other lip", "DX,DY|X")]
    right: Annotated[str | float | Collection[float] | None, Setting(
        "", None, CUTS, "the same of its right lip", "DX,DY|X")]
    lip_force: Annotated[str | Sequence[str] | None, Setting(
        "", (), CUTS, "force on a lip of the first cut, mN per mm of thickness: 'left=fx,fy'; in a volume mN: "
        "'left=fx,fy,fz'", "left=FX,FY")]
    opening_mm: Annotated[float | None, Setting("", None, CUTS, "opens the first cut along its normal, mm in all", "X")]
    blade: Annotated[str | Collection[float] | None, Setting(
        "", None, CUTS, "held part of the cuts, in a volume of their depth: 'from,to', 0 at the mouth, 1 at the tip; "
        f"left out: {BLADE[0]:g} to {BLADE[1]:g}", "FROM,TO")]
    blade_along: Annotated[str | Collection[float] | None, Setting(
        "", None, CUTS, "in a volume: held part of the cuts along the mouth, 0 at the first point, 1 at the last; left "
        "out: all", "FROM,TO")]
    resect: Annotated[Drawn | None, Setting(
        "", (), RESECTION, "closed outline of what is taken out, drawn as a cut, or a point file with it; or a mask, "
        "or labels of the label map: 'label=n,n'", "'X,Y X,Y ...'|FILE|label=N,N", stage="mesh")]

    companion: Annotated[AnyPath | Sequence[AnyPath] | None, Setting(
        "", (), CARRIED, f"another image to carry along: '[kind=]file', its kind one of {', '.join(KINDS)}; left out: "
        "label or continuous, by the file's name, header and data", "[KIND=]FILE")]
    axes: Annotated[str | None, Setting(
        "companion.*.axes", "file", CARRIED, "whose axes vectors and tensors are in: what the file states, the world's "
        "(RAS, or LPS in formats that are LPS), the image's as FSL counts them, or the array's (ANTs)",
        choices=("file", "world", "image", "index"))]
    tensor_order: Annotated[str | None, Setting(
        "companion.*.order", None, CARRIED, "of a tensor's six components: xx xy xz yy yz zz; xx yy zz xy xz yz; xx xy "
        "yy xz yz zz; left out: as the file states, else fsl", choices=("fsl", "mrtrix", "nifti"))]

    dim: Annotated[int | None, Setting(
        "dimension", 2, INPUT, "2: one slice of the image; 3: the whole volume, cut by surfaces", "2|3",
        bounds=(("ge", 2), ("le", 3)))]
    mask: Annotated[AnyPath | None, Setting(
        "mask", None, ORGAN, "the organ, on the image's grid: a slice or a volume", "FILE")]
    space: Annotated[str | None, Setting(
        "space", "ras", INPUT, "how points are read, and surfaces that do not say theirs; displacements and forces of "
        "lips are plane RAS in each", choices=("ras", "lps", "voxel"))]
    volume: Annotated[int | None, Setting(
        "volume", None, INPUT, "which volume of a 4-D image; masks are 3-D", "N", bounds=NOT_NEGATIVE)]
    nan: Annotated[float | None, Setting(
        "nan", None, INPUT, "value for NaN and infinite voxels of the image; in masks they are 0", "VALUE")]
    spacing: Annotated[str | Sequence[float] | None, Setting(
        "spacing", None, INPUT, "pixel sizes, mm, in place of the header's frame", "DX,DY[,DZ]")]
    nifti_frame: Annotated[str | None, Setting(
        "nifti_frame", "auto", INPUT, "which frame of NIfTI headers with two is taken, in every file of the run; auto: "
        "the sform", choices=("auto", "sform", "qform"))]
    resample_mask: Annotated[bool | None, Setting("resample_mask", False, ORGAN, "accept a mask on another grid")]
    min_resection_mm: Annotated[float | None, Setting(
        "min_resection_mm", 4.0, RESECTION, "of labels and masks that are taken out: bits smaller than a disc this "
        "wide stay, holes go", "D", bounds=NOT_NEGATIVE, stage="mesh")]
    max_memory: Annotated[float | None, Setting(
        "max_memory_gb", 4.0, INPUT, "largest image to read, GB", "GB", bounds=POSITIVE)]
    strict: Annotated[bool | None, Setting("strict", False, CONTROL, "warnings are errors")]
    allow_outside: Annotated[bool | None, Setting(
        "allow_outside", False, INPUT, "paths may lead out of the scenario's folder")]
    points: Annotated[AnyPath | Sequence[AnyPath] | None, Setting(
        "points", (), CARRIED, "files of landmarks to move: .mrk.json, .fcsv, .csv, .tsv, .tag", "FILE")]
    streamlines: Annotated[AnyPath | Sequence[AnyPath] | None, Setting(
        "streamlines", (), CARRIED, "tractograms to move: .trk, .trk.gz, .tck", "FILE")]
    surfaces: Annotated[AnyPath | Sequence[AnyPath] | None, Setting(
        "surfaces", (), CARRIED, "surfaces to move: .stl, .vtk, .vtp, .gii, .obj, .ply", "FILE")]
    display: Annotated[str | None, Setting(
        "display", "neurological", IMAGE, "of figure and report, in axial and coronal slices: the patient's left on "
        "the viewer's left, or on the viewer's right; changes no data", choices=("neurological", "radiological"),
        stage="report")]

    segment_method: Annotated[str | None, Setting(
        "segment.method", "auto", ORGAN, "how it is found; auto: fill stripped images, else vote",
        choices=("auto", "otsu", "vote", "svc"))]
    skull_on: Annotated[str | None, Setting(
        "segment.skull", "auto", ORGAN, "whether the head's skull is in the image", choices=("auto", "on", "stripped"))]
    template: Annotated[AnyPath | None, Setting("segment.template", None, ORGAN, "template image, for svc", "FILE")]
    template_mask: Annotated[AnyPath | None, Setting(
        "segment.template_mask", None, ORGAN, "the template's mask, for svc", "FILE")]

    young_kpa: Annotated[float | None, Setting(
        "tissue.young_kpa", Solid.young_kpa, TISSUE, "Young's modulus, kPa", "E", bounds=POSITIVE)]
    poisson: Annotated[float | None, Setting(
        "tissue.poisson", Solid.poisson, TISSUE, "Poisson's ratio, below 0.5", "NU", bounds=(("ge", 0), ("le", 0.499)))]
    labels: Annotated[AnyPath | None, Setting(
        "tissue.labels", None, RESECTION, "label map on any grid, for other tissues and for resections", "FILE")]

    skull: Annotated[str | None, Setting(
        "boundary.skull", Skull.kind, TISSUE, "what the skull does to the outline; contact: tissue may leave it, not "
        "pass through it", choices=SKULLS)]
    skull_gap_mm: Annotated[float | None, Setting(
        "boundary.skull_gap_mm", Skull.gap_mm, TISSUE, "gap between the outline and the skull, for contact", "G",
        bounds=NOT_NEGATIVE)]
    craniotomy_mm: Annotated[float | None, Setting(
        "boundary.craniotomy_mm", Skull.craniotomy_mm, TISSUE, "distance from a mouth within which the skull is off",
        "R", bounds=NOT_NEGATIVE)]
    skull_ramp_mm: Annotated[float | None, Setting(
        "boundary.skull_ramp_mm", Skull.ramp_mm, TISSUE, "length over which the skull's grip sets in; 0: at a point",
        "R", bounds=NOT_NEGATIVE)]
    boundary_displacement: Annotated[AnyPath | None, Setting(
        "boundary.displacement", None, TISSUE, "CSV of the outline's measured motion: x,y,ux,uy[,side], plane mm, read "
        "in `space`", "FILE.csv")]
    lips: Annotated[str | None, Setting(
        "boundary.lips", LipRules.lips, CUTS, "lips do not pass through each other, or are free", choices=LIPS)]
    loose_pieces: Annotated[str | None, Setting(
        "boundary.loose_pieces", Rules.loose, RESECTION, "pieces cut free that nothing holds: an error, kept where "
        "they are, or taken out", choices=LOOSE)]

    gravity: Annotated[str | Sequence[float] | None, Setting(
        "load.gravity", None, TISSUE, "direction in the plane, plane RAS; its length, at most 1, is the share of "
        "gravity there; in a volume of three numbers, world RAS", "X,Y")]

    mesh: Annotated[AnyPath | None, Setting(
        "mesh.file", None, MESH, "VTU of triangles in RAS mm, in place of the mesh stage", "FILE.vtu")]
    element_size_mm: Annotated[float | None, Setting(
        "mesh.element_size_mm", 3.0, MESH, "edge length of the elements; in a volume, unless it is given, "
                                           f"{SOLID.element_size_mm:g}",
        "H", bounds=POSITIVE)]
    corridor_mm: Annotated[float | None, Setting(
        "mesh.corridor_mm", 12.0, MESH, "width of the fine band on either side of the cuts; 0 for none; in a volume, "
                                        "unless it "
        f"is given, {SOLID.corridor_mm:g}", "W", bounds=NOT_NEGATIVE)]
    corridor_element_mm: Annotated[float | None, Setting(
        "mesh.corridor_element_mm", 1.0, MESH, "edge length of the elements there; in a volume, unless it is given, "
        f"{SOLID.corridor_element_mm:g}", "H", bounds=POSITIVE)]
    grade_at_data_ends: Annotated[bool | None, Setting(
        "mesh.grade_at_data_ends", False, MESH, "finer where held lips end and where the outline begins to be held, "
        "for verification")]

    stress_state: Annotated[str | None, Setting(
        "solve.stress_state", Solid.stress_state, SOLVER, "plane strain or plane stress", choices=STRESS_STATES)]
    tip_enrichment: Annotated[str | None, Setting(
        "solve.tip_enrichment", None, SOLVER, "nodes with tip functions: those about the tip, those near it, or none; "
        "left out: topological, but none with the neo-Hookean model", choices=TIP_ENRICHMENTS)]
    lip_constraint: Annotated[str | None, Setting(
        "solve.lip_constraint", LipRules.lip_constraint, SOLVER, "how lips are held", choices=LIP_CONSTRAINTS)]
    model: Annotated[str | None, Setting(
        "solve.model", Rules.model, SOLVER, "small strains, or finite ones", choices=MODELS)]
    hold_tip: Annotated[bool | None, Setting(
        "solve.hold_tip", LipRules.hold_tip, SOLVER, "hold the tip cell's crossings too (pointwise only)")]

    interp: Annotated[str | None, Setting(
        "warp.interp", "linear", IMAGE, "interpolation of the image", choices=("linear", "cubic", "nearest"))]
    outside: Annotated[str | None, Setting(
        "warp.outside", "keep", IMAGE, "pixels outside the organ: as they were, or 0", choices=("keep", "zero"))]
    fill: Annotated[float | None, Setting(
        "warp.fill", None, IMAGE, "value of pixels without tissue; left out: each image's own background, from its "
        "corners", "VALUE")]
    transform_spacing_mm: Annotated[float | None, Setting(
        "warp.transform_spacing_mm", None, IMAGE, "in a volume: distance of the vectors in transforms; left out: the "
        "image's", "H", bounds=POSITIVE)]
    transforms: Annotated[str | None, Setting(
        "warp.transforms", "itk", IMAGE, "the motion for other programs: one ITK transform for viewers, or every form "
        "and direction", choices=("none", "itk", "all"))]

TABLE: dict[str, Setting] = {name: hint.__metadata__[0] for name, hint in Flags.__annotations__.items()}


def kind(name: str) -> type:
    """What a flag takes: bool, int, float, os.PathLike (of a file), or str, for words, lists and drawn points."""
    setting, taken = TABLE[name], get_args(get_args(Flags.__annotations__[name])[0])
    if setting.place and os.PathLike[str] in taken:
        return os.PathLike
    return taken[0] if len(taken) == 2 else str


def bounds_of(name: str) -> dict[str, float]:
    """The bounds of a number, as the schema calls them; a value of images may be as large as those go."""
    ends = {"ge": -LARGEST, "le": LARGEST} if kind(name) in (int, float) and name not in ("nan", "fill") else {}
    given = dict(TABLE[name].bounds)
    return {end: value for end, value in (ends | given).items() if end != "ge" or "gt" not in given}


#: Flags of files, which come after the scenario's own.
FILE_FLAGS = ("companion", "points", "streamlines", "surfaces")
#: Flag -> key of every companion that is given by a flag.
OF_COMPANIONS = {name: setting.place.rpartition(".")[2] for name, setting in TABLE.items() if "*" in setting.place}
#: Flag -> the one place in the scenario that it sets.
FLAGS = {name: setting.place for name, setting in TABLE.items()
         if setting.place and name not in (*FILE_FLAGS, *OF_COMPANIONS)}
#: Keys that say what flags of another form say.
KEYS = {
    "cut": "cut.points", "markup": "cut.markup", "internal": "cut.internal", "left": "retract.displacement_mm",
    "right": "retract.displacement_mm", "lip_force": "retract.force_mN_per_mm", "opening_mm": "retract.normal_mm",
    "blade": "retract.blade", "blade_along": "retract.blade_along", "towards": "cut.towards",
    "depth_mm": "cut.depth_mm", "resect": "resect.outline", "kind": "companion.kind", "axes": "companion.axes",
    "tensor_order": "companion.order", "companion": "companion.image", "points": "points",
    "streamlines": "streamlines", "surfaces": "surfaces",
}
#: Keys that only a slice has, and why a volume has none of them.
OF_A_SLICE = {
    "slice.plane": "the whole volume is used", "slice.index": "the whole volume is used",
    "slice.position_mm": "the whole volume is used",
    "segment.template": "a volume takes a mask, or a stripped image",
    "segment.template_mask": "a volume takes a mask, or a stripped image",
    "mesh.file": "its mesh is made from the mask", "mesh.corridor": "its corridor is about the cuts",
    "mesh.grade_at_data_ends": "it is graded by the distance from the cuts alone",
    "boundary.displacement": "the measured motion of a surface in space is not read yet",
    "boundary.arc": "a place without skull is one of boundary.craniotomies", "resect": "it cuts, and takes nothing out "
                                                                                       "yet",
    "step": "it has one step", "load.pressure": "nothing is taken out whose wall could be pressed",
    "solve.hold_tip": "its front has no tip cell",
}
#: Values that a volume does not know, and why.
UNKNOWN_IN_SPACE = {
    "boundary.lips": ("contact", "in a volume lips do not touch each other yet, and overlap is judged"),
    "boundary.skull": ("contact", "in a volume the skull is fixed, sliding or free"),
    "boundary.loose_pieces": ("hold", "in a volume a loose piece is refused or removed"),
    "solve.lip_constraint": (("mortar", "pointwise"), "in a volume lips are held by Nitsche's condition"),
    "solve.tip_enrichment": (("topological", "geometric"), "fronts in a volume have no tip functions"),
    "solve.stress_state": ("stress", "in space there is but one"),
    "solve.model": ("neo-hookean", "in a volume strains are small"),
}
