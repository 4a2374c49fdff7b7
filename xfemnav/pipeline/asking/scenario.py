"""The scenario, version 1: what a run is asked to do, as TOML sections or as flags, checked in one place.

`Scenario` is the schema. `problems` lists everything that is wrong with a raw scenario at once, each with its place,
the flag that sets it, and the nearest valid name for one that is not known.
"""

import difflib
import math
import os
import re
from collections.abc import Sequence
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, WrapValidator, create_model, model_validator

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.rules import RELATIVE_TO, SKULLS
from xfemnav.pipeline.asking.arguments import shown
from xfemnav.pipeline.asking.crosscheck import cross_problems
from xfemnav.pipeline.asking.flags import by_option, numbers, tables
from xfemnav.pipeline.asking.settings import FLAGS, KEYS, KINDS, LARGEST, TABLE, bounds_of, kind

SHOWN = 50  # problems of a scenario that are told
# Problems that the mechanics has a code for, by their words.
OWN_CODES = {
    "E404": re.compile(r"^(tissue\.\w+.*|⟦!(young_kpa|poisson)⟧): input should be (greater|less) than"),
    "E303": re.compile(r"points must be at least two different ones"),
    "E402": re.compile(r"blade must be FROM,TO"),
}

Real = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Whole = Annotated[int, Field(le=int(LARGEST))]
Pair = Annotated[tuple[Real, Real], Strict(False)]
Point = Vector = Annotated[tuple[Real, ...], Strict(False), Field(min_length=2, max_length=3)]  # 3 in a volume
Points = Annotated[tuple[Point, ...], Strict(False)]
Path_ = Annotated[str, Field(min_length=1, max_length=4096)]
Paths_ = Annotated[tuple[Path_, ...], Strict(False), Field(max_length=200)]
MANY = Field(max_length=200)  # cuts, steps, companions: more is a mistake, and would take for ever
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Name = Annotated[str, Field(pattern=r"^[\w .+-]{1,64}$")]
#: What keys take: by the kind of their flag, or by the flag where it takes several values.
OF_KIND = {bool: bool, int: int, float: float, os.PathLike: Path_}
OF_FLAG = {"spacing": Annotated[tuple[Positive, ...], Strict(False), Field(min_length=2, max_length=3)],
           "gravity": Vector, "points": Paths_, "streamlines": Paths_, "surfaces": Paths_}


def _in_one_line(value, check):
    """A label or labels; what is wrong with them is told once, not for each of the two."""
    try:
        return check(value)
    except ValidationError:
        raise ValueError("give a whole number from 1 on, or a list of such: [1, 3, 4]") from None


Label = Annotated[Whole, Field(ge=1)]
Labels = Annotated[Label | Annotated[tuple[Label, ...], Strict(False), Field(min_length=1, max_length=200)],
                   WrapValidator(_in_one_line)]


class Section(BaseModel):
    """A table of the scenario: unknown keys are refused, numbers are finite, and "12" is no number."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _keys(section: str, base: type[Section] = Section) -> type[Section]:
    """`base`, and the keys of a section that flags give, as the table of settings has them."""
    found = {}
    for name, setting in TABLE.items():
        home, _, key = setting.place.rpartition(".")
        if key and home == section:
            taken = Literal[setting.choices] if setting.choices else OF_FLAG.get(name) or OF_KIND[kind(name)]
            said = Field(setting.default, description=setting.meaning, **bounds_of(name))
            found[key] = (taken | None if setting.default is None else taken, said)
    return create_model(f"{base.__name__}Keys", __base__=base, **found)


def _refuse_mixed(points) -> None:
    if points is not None and len({len(point) for point in points}) > 1:
        raise ValueError("points of 2 and of 3 numbers are mixed")


class SliceSection(_keys("slice")):
    """Which slice of a volume."""

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
    towards: Point | None = Field(None, description="in a volume: where a curve is swept to, world mm")
    depth_mm: Positive | None = Field(None, description="in a volume: how deep a curve goes below the surface, mm")
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
    normal_mm: Real | None = Field(None, description="displacement away from the other lip, mm")
    force_mN_per_mm: Vector | None = Field(None, description="force on the lip, mN per mm of thickness")
    blade: Pair | None = Field(None, description="held part of the cut (volume: of its depth), 0 the mouth, 1 the tip")
    blade_along: Pair | None = Field(None, description="in a volume: held part along the mouth, by its points")
    relative_to: Literal[RELATIVE_TO] | None = Field(
        None, description="from where the lip's displacement counts: where it lies under all that acts but blades, or "
                          "its preoperative place; left out: loads for normal_mm, rest for displacement_mm")

    @model_validator(mode="after")
    def _one_datum_on_the_cut(self):
        given = [self.displacement_mm, self.normal_mm, self.force_mN_per_mm]
        if sum(value is not None for value in given) != 1:
            raise ValueError("give exactly one of displacement_mm, normal_mm, force_mN_per_mm")
        if self.force_mN_per_mm is not None and self.relative_to is not None:
            raise ValueError("relative_to is for displacement_mm and normal_mm; a force counts from nowhere")
        for name, ends in (("blade", "0 the mouth and 1 the tip"), ("blade_along", "0 the first point and 1 the last")):
            span = getattr(self, name)
            if span is not None and not 0 <= span[0] < span[1] <= 1:
                raise ValueError(f"{name} must be FROM,TO with 0 <= FROM < TO < 1, {ends}")
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


class _Image(Section):
    image: Path_ = Field(description="any format and grid; vectors and tensors with all their components")
    kind: Literal[KINDS] | None = Field(
        None, description="labels are taken from the nearest voxel; vectors, axes (without a sign) and tensors turn "
                          "with the tissue; left out: label or continuous, by the file's name, header and data")


class CompanionSection(_keys("companion.*", _Image)):
    """Another image of the patient, on any grid, carried along with the tissue."""


class SegmentSection(_keys("segment")):
    """How the organ is found when no mask is given."""


class LabelSection(Section):
    """The tissue of one label: a kind with its constants from the literature, or constants of your own."""

    kind: Literal["parenchyma", "tumour", "ventricle", "cavity"] = Field(
        "parenchyma", description="as the rest; three times as stiff; a soft solid (0.1 kPa, 0.1); without stiffness")
    young_kpa: Positive | None = Field(None, description="Young's modulus, kPa, in place of the kind's")
    poisson: float | None = Field(None, ge=0, le=0.499, description="Poisson's ratio, in place of the kind's")


class TissueSection(_keys("tissue")):
    """The material."""

    by_label: dict[Annotated[str, Field(pattern=r"^[1-9]\d{0,8}$")], LabelSection] = Field(
        default={}, description="tissues of labels; what has no entry is as above")


class ArcSection(Section):
    """A part of the outline with a skull of its own: counter-clockwise from near `start` to near `end`."""

    start: Pair = Field(description="plane mm, read in `space`")
    end: Pair = Field(description="plane mm, read in `space`")
    skull: Literal[SKULLS] = Field(description="what the skull does there")
    skull_gap_mm: NotNegative = Field(0.0, description="gap to the skull, for contact")


class BoundarySection(_keys("boundary")):
    """What holds the organ's outline, and the lips that no blade holds."""

    displacement_weight: Positive | None = Field(
        None, description="kPa/mm: follow the measured motion by springs this stiff (least squares); else exactly")
    arc: Annotated[tuple[ArcSection, ...], Strict(False), MANY] = ()
    craniotomies: Annotated[Points, MANY] = Field((), description="where the skull is open without a cut")


class PressureSection(Section):
    """A pressure on the wall of a resection, or on the outline."""

    name: Name = Field("pressure", description="what steps call it")
    on: Name = Field(description="name of the resection, with which it begins, or `outline`")
    kpa: Real = Field(description="kPa, positive into the tissue (1 kPa is 7.5 mmHg)")


class LoadSection(_keys("load")):
    """Forces on the tissue beside the retractors'."""

    density_kg_m3: Positive = Field(1000.0, description="density of the tissue")
    fluid_density_kg_m3: NotNegative = Field(1007.0, description="density of the cerebrospinal fluid")
    fluid_level_mm: Real | None = Field(
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


class MeshSection(_keys("mesh")):
    """The mesh, or a file with yours."""

    corridor: Annotated[tuple[Point, ...], Strict(False)] | None = Field(
        None, description="the planned region's path, in place of the cuts themselves")


class SolveSection(_keys("solve")):
    """How the equations are set up."""

    @model_validator(mode="after")
    def _tip_of_pointwise_lips(self):
        if self.hold_tip and self.lip_constraint != "pointwise":
            raise ValueError("⟦hold_tip⟧ needs ⟦lip_constraint=pointwise⟧")
        return self


class WarpSection(_keys("warp")):
    """How the new image is sampled."""


class _Head(Section):
    xfemnav: Literal[1] = Field(description="version of this format")
    image: Path_ | None = Field(None, description="NIfTI; may be given on the command line instead")


class Scenario(_keys("", _Head)):
    """Everything that a run can be asked for. Paths are relative to the file and, unless `allow_outside`, stay in its
    folder."""

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
    return found + [by_option(text, flags or {}) for text in cross_problems(raw)]


def _told(item: dict, flags: dict[str, str]) -> str:
    place = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        return f"{place}: unknown key{_meant(item['loc'])}"
    text = "is no list" if item["type"] == "tuple_type" else item["msg"].removeprefix("Value error, ")
    given = item.get("input")
    got = f", got {shown(given)}" if isinstance(given, str | int | float) and len(shown(given)) < 60 else ""
    return by_option(f"{place}: {text[0].lower()}{text[1:]}{got}{_mend(item)}" if place else text, flags)


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
