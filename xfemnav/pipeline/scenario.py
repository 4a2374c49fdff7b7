"""The scenario, version 1: what a run is asked to do, as TOML sections or as flags, checked in one place.

`Scenario` is the schema. `problems` lists everything that is wrong with a raw scenario at once, each with its place,
the flag that sets it, and the nearest valid name for one that is not known.
"""

import difflib
import math
import os
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, WrapValidator, model_validator
from pydantic.fields import FieldInfo

from xfemnav.errors import XfemnavError
from xfemnav.imaging.content import decoded
from xfemnav.pipeline.crosscheck import cross_problems
from xfemnav.pipeline.flags import BACKSLASH, FLAGS, KEYS, MASKS, numbers, tables

LIMIT_BYTES, LIMIT_DEPTH = 1_000_000, 32
SHOWN = 50  # problems of a scenario that are told
# Dotted keys deeper than that; the parser's time grows with the square of their length.
LONG_KEY = re.compile(r"""(?<![\w.-])(?:(?:"[^"\n]*"|'[^'\n]*'|[\w-]+)[ \t]*\.[ \t]*){32}""")
ESCAPE = re.compile(r"hex value|[Ee]scape")  # in the parser's words
# Problems that the mechanics has a code for, by their words.
OWN_CODES = {
    "E404": re.compile(r"^(tissue\.\w+.*|⟦!(young_kpa|poisson)⟧): input should be (greater|less) than"),
    "E303": re.compile(r"points must be at least two different ones"),
    "E402": re.compile(r"blade must be FROM,TO"),
}

Vector = Annotated[tuple[float, float], Strict(False)]
Point = Annotated[tuple[float, ...], Strict(False), Field(min_length=2, max_length=3)]
Points = Annotated[tuple[Point, ...], Strict(False)]
Path_ = Annotated[str, Field(min_length=1, max_length=4096)]
Paths_ = Annotated[tuple[Path_, ...], Strict(False), Field(max_length=200)]
MANY = Field(max_length=200)  # cuts, steps, companions: more is a mistake, and would take for ever
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Name = Annotated[str, Field(pattern=r"^[\w .+-]{1,64}$")]


def _in_one_line(value, check):
    """A label or labels; what is wrong with them is told once, not for each of the two."""
    try:
        return check(value)
    except ValidationError:
        raise ValueError("give a whole number from 1 on, or a list of such: [1, 3, 4]") from None


Label = Annotated[int, Field(ge=1)]
Labels = Annotated[Label | Annotated[tuple[Label, ...], Strict(False), Field(min_length=1, max_length=200)],
                   WrapValidator(_in_one_line)]


class Section(BaseModel):
    """A table of the scenario: unknown keys are refused, numbers are finite, and "12" is no number."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _refuse_mixed(points) -> None:
    if points is not None and len({len(point) for point in points}) > 1:
        raise ValueError("points of 2 and of 3 numbers are mixed")


class SliceSection(Section):
    """Which slice of a volume."""

    plane: Literal["axial", "coronal", "sagittal"] | None = Field(
        None, description="left out: the plane of an image with one slice, else axial")
    index: int | None = Field(None, ge=0, description="voxel index along the plane's normal, from 0")
    position_mm: float | None = Field(None, description="position along the plane's normal, mm")

    @model_validator(mode="after")
    def _one_position(self):
        if self.index is not None and self.position_mm is not None:
            raise ValueError("give index or position_mm, not both")
        return self


class CutSection(Section):
    """A cut, drawn from its mouth to its tip."""

    name: Name = Field("cut", description="what retractions, steps and reports call it")
    points: Points | None = Field(None, description="2 numbers a point (plane), or 3 (world)")
    markups: Path_ | None = Field(
        None, description="point file in place of `points`: .mrk.json, .fcsv, .csv, .tsv, .tag; it says its own frame")
    markup: str | None = Field(None, description="which markup of a file with several")
    smooth: bool = Field(False, description="the points are those of a smooth curve, sampled to 0.05 mm")
    craniotomy: bool = Field(True, description="false: this mouth frees nothing at the skull")
    internal: bool = Field(False, description="the cut lies inside, with two tips")

    @model_validator(mode="after")
    def _one_kind_of_point(self):
        if (self.points is None) == (self.markups is None):
            raise ValueError("give points or markups, one of them")
        _refuse_mixed(self.points)
        if self.points is not None and len(set(self.points)) < 2:
            raise ValueError("points must be at least two different ones, from the mouth to the tip")
        return self


class RetractSection(Section):
    """A blade that moves or pushes one lip of a cut."""

    name: Name | None = Field(None, description="what steps call it; '<cut> <side>' when left out")
    cut: Name | None = Field(None, description="name of the cut; may be left out when there is one")
    side: Literal["left", "right"]
    displacement_mm: Vector | None = Field(None, description="displacement of the lip in the plane, mm")
    normal_mm: float | None = Field(None, description="displacement away from the other lip, mm")
    force_mN_per_mm: Vector | None = Field(None, description="force on the lip, mN per mm of thickness")
    blade: Vector | None = Field(None, description="held part of the cut: 0 at the mouth, 1 at the tip")
    relative_to: Literal["loads", "rest"] | None = Field(
        None, description="from where the lip's displacement counts: where it lies under all that acts but blades, or "
                          "its preoperative place; left out: loads for normal_mm, rest for displacement_mm")

    @model_validator(mode="after")
    def _one_datum(self):
        given = [self.displacement_mm, self.normal_mm, self.force_mN_per_mm]
        if sum(value is not None for value in given) != 1:
            raise ValueError("give exactly one of displacement_mm, normal_mm, force_mN_per_mm")
        if self.force_mN_per_mm is not None and self.relative_to is not None:
            raise ValueError("relative_to is for displacement_mm and normal_mm; a force counts from nowhere")
        return self

    @model_validator(mode="after")
    def _blade_on_the_cut(self):
        if self.blade is not None and not 0 <= self.blade[0] < self.blade[1] <= 1:
            raise ValueError("blade must be FROM,TO with 0 <= FROM < TO < 1, 0 the mouth and 1 the tip")
        return self


class ResectSection(Section):
    """Tissue that is taken out."""

    name: Name = Field("resection", description="what steps, loads and reports call it")
    outline: Points | None = Field(None, description="closed outline, 2 or 3 numbers a point")
    markups: Path_ | None = Field(None, description="point file with the outline, such as a closed curve of Slicer")
    markup: str | None = Field(None, description="which markup of a file with several")
    label: Labels | None = Field(
        None, description="a label of [tissue] labels, or a list of labels that are taken out as one")
    mask: Path_ | None = Field(None, description="image of the resected tissue, a mask on any grid")

    @model_validator(mode="after")
    def _one_form(self):
        if sum(value is not None for value in (self.outline, self.markups, self.label, self.mask)) != 1:
            raise ValueError("give exactly one of outline, markups, label, mask")
        _refuse_mixed(self.outline)
        if self.outline is not None and len(set(self.outline)) < 3:
            raise ValueError("outline must have at least three different points")
        return self

    @property
    def labels(self) -> tuple[int, ...] | None:
        """The labels, each once, None where none is given."""
        given = (self.label,) if isinstance(self.label, int) else self.label
        return given and tuple(sorted(set(given)))


class CompanionSection(Section):
    """Another image of the patient, on any grid, carried along with the tissue."""

    image: Path_ = Field(description="any format and grid; vectors and tensors with all their components")
    kind: Literal["continuous", "label", "vector", "axis", "tensor"] | None = Field(
        None, description="labels are taken from the nearest voxel; vectors, axes (without a sign) and tensors turn "
                          "with the tissue; left out: label or continuous, by the file's name, header and data")
    axes: Literal["file", "world", "image", "index"] = Field(
        "file", description="whose axes vectors and tensors are in: what the file states, the world's (RAS, or LPS in "
                            "formats that are LPS), the image's as FSL counts them, or the array's (ANTs)")
    order: Literal["fsl", "mrtrix", "nifti"] | None = Field(
        None, description="of a tensor's six components: xx xy xz yy yz zz; xx yy zz xy xz yz; xx xy yy xz yz zz; "
                          "left out: as the file states, else fsl")


class SegmentSection(Section):
    """How the organ is found when no mask is given."""

    method: Literal["auto", "otsu", "vote", "svc"] = Field("auto", description="auto: fill stripped images, else vote")
    skull: Literal["auto", "on", "stripped"] = Field("auto", description="whether the head's skull is in the image")
    template: Path_ | None = Field(None, description="template image, for svc")
    template_mask: Path_ | None = Field(None, description="the template's mask, for svc")


class LabelSection(Section):
    """The tissue of one label: a kind with its constants from the literature, or constants of your own."""

    kind: Literal["parenchyma", "tumour", "ventricle", "cavity"] = Field(
        "parenchyma", description="as the rest; three times as stiff; a soft solid (0.1 kPa, 0.1); without stiffness")
    young_kpa: Positive | None = Field(None, description="Young's modulus, kPa, in place of the kind's")
    poisson: float | None = Field(None, ge=0, le=0.499, description="Poisson's ratio, in place of the kind's")


class TissueSection(Section):
    """The material."""

    young_kpa: Positive = Field(3.0, description="Young's modulus, kPa")
    poisson: float = Field(0.45, ge=0, le=0.499, description="Poisson's ratio, below 0.5")
    labels: Path_ | None = Field(None, description="label map on any grid, for other tissues and for resections")
    by_label: dict[Annotated[str, Field(pattern=r"^[1-9]\d{0,8}$")], LabelSection] = Field(
        default={}, description="tissues of labels; what has no entry is as above")


class ArcSection(Section):
    """A part of the outline with a skull of its own: counter-clockwise from near `start` to near `end`."""

    start: Vector = Field(description="plane mm, read in `space`")
    end: Vector = Field(description="plane mm, read in `space`")
    skull: Literal["fixed", "sliding", "free", "contact"] = Field(description="what the skull does there")
    skull_gap_mm: NotNegative = Field(0.0, description="gap to the skull, for contact")


class BoundarySection(Section):
    """What holds the organ's outline, and the lips that no blade holds."""

    skull: Literal["fixed", "sliding", "free", "contact"] = Field(
        "fixed", description="what the skull does to the outline; contact: tissue may leave it, not pass through it")
    skull_gap_mm: NotNegative = Field(0.0, description="gap between the outline and the skull, for contact")
    craniotomy_mm: NotNegative = Field(20.0, description="distance from a mouth within which the skull is off")
    skull_ramp_mm: NotNegative = Field(4.0, description="length over which the skull's grip sets in; 0: at a point")
    displacement: Path_ | None = Field(
        None, description="CSV of the outline's measured motion: x,y,ux,uy[,side], plane mm, read in `space`")
    displacement_weight: Positive | None = Field(
        None, description="kPa/mm: follow the measured motion by springs this stiff (least squares); else exactly")
    lips: Literal["contact", "free"] = Field("contact", description="lips do not pass through each other, or are free")
    loose_pieces: Literal["refuse", "hold", "remove"] = Field(
        "refuse", description="pieces cut free that nothing holds: an error, kept where they are, or taken out")
    arc: Annotated[tuple[ArcSection, ...], Strict(False), MANY] = ()


class PressureSection(Section):
    """A pressure on the wall of a resection, or on the outline."""

    name: Name = Field("pressure", description="what steps call it")
    on: Name = Field(description="name of the resection, with which it begins, or `outline`")
    kpa: float = Field(description="kPa, positive into the tissue (1 kPa is 7.5 mmHg)")


class LoadSection(Section):
    """Forces on the tissue beside the retractors'."""

    gravity: Vector | None = Field(
        None, description="direction in the plane, plane RAS; its length, at most 1, is the share of gravity there")
    density_kg_m3: Positive = Field(1000.0, description="density of the tissue")
    fluid_density_kg_m3: NotNegative = Field(1007.0, description="density of the cerebrospinal fluid")
    fluid_level_mm: float | None = Field(
        None, description="tissue farther along gravity than this (mm from the origin) floats in fluid; none: drained")
    pressure: Annotated[tuple[PressureSection, ...], Strict(False), MANY] = ()

    @model_validator(mode="after")
    def _a_direction(self):
        if self.gravity is not None and not 1e-3 < math.hypot(*self.gravity) <= 1.00005:
            raise ValueError("⟦gravity⟧ must be a direction whose length is more than 0 and at most 1: 0,-1, not "
                             "0,-9.81")
        return self


class StepSection(Section):
    """One of several steps in order: what acts from then on, and what ends. What no step names acts from the first."""

    name: Name = Field(description="what files and the report call it")
    acts: Annotated[tuple[Name, ...], Strict(False)] = Field(
        (), description="names of cuts, retractions, resections, pressures, and `gravity`")
    ends: Annotated[tuple[Name, ...], Strict(False)] = Field(
        (), description="names of retractions, pressures, or `gravity`, that end here")
    frame: Literal["preoperative", "current"] = Field(
        "preoperative", description="current: the cuts and outlines of `acts` are drawn in the slice as it is by then")


class MeshSection(Section):
    """The mesh, or a file with yours."""

    file: Path_ | None = Field(None, description="VTU of triangles in RAS mm, in place of the mesh stage")
    element_size_mm: Positive = Field(3.0, description="edge length of the elements")
    corridor_mm: NotNegative = Field(12.0, description="width of the fine band on either side of the cuts; 0 for none")
    corridor_element_mm: Positive = Field(1.0, description="edge length of the elements there")
    corridor: Annotated[tuple[Point, ...], Strict(False)] | None = Field(
        None, description="the planned region's path, in place of the cuts themselves")
    grade_at_data_ends: bool = Field(
        False, description="finer where held lips end and where the outline begins to be held, for verification")


class SolveSection(Section):
    """How the equations are set up."""

    stress_state: Literal["strain", "stress"] = Field("strain", description="plane strain or plane stress")
    tip_enrichment: Literal["topological", "geometric", "none"] | None = Field(
        None, description="nodes with tip functions: those about the tip, those near it, or none; left out: "
                          "topological, but none with the neo-Hookean model")
    lip_constraint: Literal["mortar", "nitsche", "pointwise"] = Field("mortar", description="how lips are held")
    model: Literal["linear", "neo-hookean"] = Field("linear", description="small strains, or finite ones")
    hold_tip: bool = Field(False, description="hold the tip cell's crossings too (pointwise only)")

    @model_validator(mode="after")
    def _tip_of_pointwise_lips(self):
        if self.hold_tip and self.lip_constraint != "pointwise":
            raise ValueError("⟦hold_tip⟧ needs ⟦lip_constraint=pointwise⟧")
        return self


class WarpSection(Section):
    """How the new image is sampled."""

    interp: Literal["linear", "cubic", "nearest"] = Field("linear", description="interpolation")
    outside: Literal["keep", "zero"] = Field("keep", description="pixels outside the organ: as they were, or 0")
    fill: float | None = Field(
        None, description="value of pixels without tissue; left out: each image's own background, from its corners")
    transforms: Literal["none", "itk", "all"] = Field(
        "itk", description="the motion for other programs: one ITK transform for viewers, or every form and direction")


class Scenario(Section):
    """Everything that a run can be asked for. Paths are relative to the file and, unless `allow_outside`, stay in its
    folder."""

    xfemnav: Literal[1] = Field(description="version of this format")
    image: Path_ | None = Field(None, description="NIfTI; may be given on the command line instead")
    mask: Path_ | None = Field(None, description="the organ, on the image's grid: a slice or a volume")
    space: Literal["ras", "lps", "voxel"] = Field(
        "ras", description="how points are read, and surfaces that do not say theirs; displacements and forces of lips "
                           "are plane RAS in each")
    volume: int | None = Field(None, ge=0, description="which volume of a 4-D image; masks are 3-D")
    nan: float | None = Field(None, description="value for NaN and infinite voxels of the image; in masks they are 0")
    spacing: Annotated[tuple[Positive, ...], Strict(False), Field(min_length=2, max_length=3)] | None = Field(
        None, description="pixel sizes, mm, in place of the header's frame")
    nifti_frame: Literal["auto", "sform", "qform"] = Field(
        "auto", description="which frame of NIfTI headers with two is taken, in every file of the run; auto: the sform")
    resample_mask: bool = Field(False, description="accept a mask on another grid")
    min_resection_mm: NotNegative = Field(
        4.0, description="of labels and masks that are taken out: bits smaller than a disc this wide stay, holes go")
    max_memory_gb: Positive = Field(4.0, description="largest image to read, GB")
    strict: bool = Field(False, description="warnings are errors")
    allow_outside: bool = Field(False, description="paths may lead out of the scenario's folder")
    points: Paths_ = Field((), description="files of landmarks to move: .mrk.json, .fcsv, .csv, .tsv, .tag")
    streamlines: Paths_ = Field((), description="tractograms to move: .trk, .trk.gz, .tck")
    surfaces: Paths_ = Field((), description="surfaces to move: .stl, .vtk, .vtp, .gii, .obj, .ply")
    display: Literal["neurological", "radiological"] = Field(
        "neurological", description="of figure and report, in axial and coronal slices: the patient's left on the "
                                    "viewer's left, or on the viewer's right; changes no data")
    slice: SliceSection = SliceSection()
    segment: SegmentSection = SegmentSection()
    cut: Annotated[tuple[CutSection, ...], Strict(False), MANY] = ()
    retract: Annotated[tuple[RetractSection, ...], Strict(False), MANY] = ()
    resect: Annotated[tuple[ResectSection, ...], Strict(False), MANY] = ()
    companion: Annotated[tuple[CompanionSection, ...], Strict(False), MANY] = ()
    tissue: TissueSection = TissueSection()
    boundary: BoundarySection = BoundarySection()
    load: LoadSection = LoadSection()
    mesh: MeshSection = MeshSection()
    solve: SolveSection = SolveSection()
    warp: WarpSection = WarpSection()
    step: Annotated[tuple[StepSection, ...], Strict(False), MANY] = ()


def read_toml(path: Path) -> dict:
    """The raw scenario in a TOML file. Raises E100 (missing) and E780 (too large, too deep, no TOML)."""
    if not os.path.isfile(path):
        raise XfemnavError("E100", f"no scenario file at {path}. Correct the path.")
    if path.stat().st_size > LIMIT_BYTES:
        raise XfemnavError("E780", f"{path.name} holds {path.stat().st_size} bytes; at most {LIMIT_BYTES} are read.")
    too_deep = XfemnavError("E780", f"{path.name} is nested deeper than {LIMIT_DEPTH} levels.")
    try:
        text = re.sub(r"\r\n?", "\n", decoded(path.read_bytes()))
    except ValueError as error:
        if path.name.lower().endswith(MASKS):
            raise XfemnavError("E780", f"{path.name} is an image, no scenario (a TOML file); an image is for `xfemnav "
                                       "run`.") from None
        raise XfemnavError("E780", f"{path.name} {error}.") from None
    try:
        if LONG_KEY.search(text):
            raise too_deep
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        mend = f" {BACKSLASH}" if ESCAPE.search(str(error)) else _quotes(text, str(error))
        raise XfemnavError("E780", f"{path.name} is no TOML: {error}.{mend}") from None
    except RecursionError:
        raise too_deep from None
    if _depth(raw) > LIMIT_DEPTH:
        raise too_deep
    return raw


def _quotes(text: str, why: str) -> str:
    """What to say of a text without quotes in the line that the parser names."""
    line = re.search(r"at line (\d+)", why)
    row = text.split("\n")[int(line[1]) - 1] if line else ""
    bare = re.fullmatch(r"\s*([\w.-]+)\s*=\s*([^\W\d][^\"'\[{#]*|[./~][^\"'\[{#]*)", row)
    return f' A text, as a path is, stands in quotes: {bare[1]} = "{bare[2].strip()}".' if bare else ""


def validated(raw: dict, flags: dict[str, str], known: tuple[str, ...] = ()) -> Scenario:
    """The scenario of a raw dict. Raises E780 with every problem, those already `known` first.

    Where values are of the right form and only the mechanics refuses them, the code is its own: E303, E402, E404.
    `flags` maps places in the scenario to the options that set them.
    """
    found = [*known, *problems(raw, flags)]
    if found:
        codes = [next((code for code, words in OWN_CODES.items() if words.search(text)), "E780") for text in found]
        code = "E780" if "E780" in codes else codes[0]
        listed = "⟦!?⟧" if all(text in known or text.startswith("⟦!") for text in found) else "⟦?⟧"
        more = f"; and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
        words = "; ".join(found[:SHOWN]) + more
        raise XfemnavError(code, f"{words}{'' if words.endswith('?') else '.'} {listed}")
    return Scenario.model_validate(raw)


def problems(raw: dict, flags: dict[str, str] | None = None) -> list[str]:
    """One line a problem of a raw scenario, empty when there is none."""
    found = []
    try:
        Scenario.model_validate(raw)
    except ValidationError as error:
        items = error.errors(include_url=False)
        # A tuple is too short when one of its items is wrong, which is told already.
        inner = {item["loc"][:n] for item in items for n in range(len(item["loc"]))}
        flat = _flat_points(raw)
        places = {text.partition(":")[0] for text in flat}
        found = flat + [_told(item, flags or {}) for item in items
                        if (item["type"] != "too_short" or item["loc"] not in inner)
                        and ".".join(map(str, item["loc"][:3])) not in places]
    return found + cross_problems(raw)


def _told(item: dict, flags: dict[str, str]) -> str:
    place = ".".join(str(part) for part in item["loc"])
    called = f"⟦!{flags[place]}⟧" if place in flags else place
    if item["type"] == "extra_forbidden":
        return f"{place}: unknown key{_meant(item['loc'])}"
    text = "is no list" if item["type"] == "tuple_type" else item["msg"].removeprefix("Value error, ")
    shown = item.get("input")
    got = f", got {shown!r}" if isinstance(shown, str | int | float) and len(repr(shown)) < 60 else ""
    return f"{called}: {text[0].lower()}{text[1:]}{got}{_mend(item)}" if place else text


def _meant(location: tuple) -> str:
    """What an unknown key may stand for: the key of a flag of that name, or the nearest of its section."""
    *section, name = location
    key = FLAGS.get(str(name)) or KEYS.get(str(name))
    if key is not None and not section and "." in key:
        return f"; it is the key {key}"
    near = difflib.get_close_matches(str(name), _section_at(tuple(section)).model_fields, 1, 0.5)
    return f", did you mean '{near[0]}'?" if near else ""


def _mend(item: dict) -> str:
    """How to write what is not of its form, where that can be told."""
    shown, name = item.get("input"), item["loc"][-1]
    if item["type"] == "missing" and name == "xfemnav":
        return "; write xfemnav = 1 (the version of this format) at the top"
    if item["type"] == "literal_error" and isinstance(shown, str):
        near = difflib.get_close_matches(shown.lower(), re.findall(r"'([^']*)'", item["msg"]), 1, 0.5)
        return f", did you mean '{near[0]}'?" if near else ""
    if item["type"] in ("float_type", "int_type") and isinstance(shown, str) and numbers(shown):
        return f"; write it without quotes: {name} = {shown}"
    if item["type"] == "tuple_type" and isinstance(shown, dict):
        return f"; there may be several, so its header has two brackets: [[{'.'.join(map(str, item['loc']))}]]"
    return ""


def _flat_points(raw: dict) -> list[str]:
    """Points whose numbers stand in one row, without brackets for each."""
    found = []
    for section, key in (("cut", "points"), ("resect", "outline")):
        for i, table in enumerate(tables(raw, section)):
            row = table.get(key)
            if isinstance(row, list | tuple) and len(row) > 3 and all(type(x) in (int, float) for x in row):
                pairs = ", ".join(f"[{x}, {y}]" for x, y in zip(row[::2], row[1::2]))
                meant = f", as {key} = [{pairs}]" if len(row) % 2 == 0 and len(row) % 3 else ""
                found.append(f"{section}.{i}.{key}: wants brackets about each point{meant}")
    return found


def field_at(place: str) -> FieldInfo:
    """The key at a place of the scenario, such as 'slice.index' or 'companion.*.axes'."""
    *sections, name = place.split(".")
    return _section_at(sections).model_fields[name]


def _section_at(location: Sequence) -> type[Section]:
    """The section at `location`."""
    section = Scenario
    for part in location:
        if part in section.model_fields:  # else a place in an array, or a label
            section = _section_of(section.model_fields[part].annotation)
    return section


def _section_of(annotation) -> type[Section] | None:
    """The section inside an annotation such as tuple[CutSection, ...]."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation
    return next(filter(None, map(_section_of, get_args(annotation))), None)


def _depth(value) -> int:
    """Levels of nesting of tables and arrays, without recursion."""
    depth, level = 0, [value]
    while level:
        depth += 1
        level = [inner for item in level if isinstance(item, dict | list)
                 for inner in (item.values() if isinstance(item, dict) else item)]
    return depth
