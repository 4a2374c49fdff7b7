"""From a scenario and flags to what each stage reads."""

import os
from dataclasses import asdict, dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.rules import (
    BLADE,
    LEFT,
    RIGHT,
    Arc,
    Basis,
    Gravity,
    LipRules,
    Loads,
    Measured,
    Pressure,
    Retraction,
    Rules,
    Skull,
    Solid,
)
from xfemnav.pipeline.asking.arguments import path_of
from xfemnav.pipeline.asking.crosscheck import OUTLINE, actors
from xfemnav.pipeline.asking.dimension import in_its_dimension
from xfemnav.pipeline.asking.displacements import read_displacements
from xfemnav.pipeline.asking.flags import add_flags, confined, path_places, printed, set_by
from xfemnav.pipeline.asking.parameters import (
    KINDS,
    CarryParams,
    CompanionParams,
    ConstrainParams,
    CutParams,
    DataEnds,
    FigureParams,
    LabelParams,
    MeshParams,
    ReadParams,
    ResectParams,
    SegmentParams,
    SolveParams,
    Step,
    WarpParams,
)
from xfemnav.pipeline.asking.settings import STAGES
from xfemnav.pipeline.asking.whereabouts import Known, found_again

if TYPE_CHECKING:
    from xfemnav.pipeline.asking.scenario import Scenario

NO_CUT = "nothing moves: give a cut (⟦cut=x,y x,y ...⟧), a resection, gravity, or a measured boundary"


@dataclass(frozen=True)
class Config:
    """A checked run: its input files by role, the parameters of reading and of each stage, and the scenario.

    `parameters` is the scenario with all that was left out filled in, `settings` the same without what would read
    otherwise when it is given (blades), and `named` are all files that it names, by place; `places` are those of
    `files`, by role. `changed` are files of a run that is made again, by place, whose bytes are no longer those that it
    knew. `constrain` is the problem of the last step. `also_read` are files whose content the parameters hold: the
    scenario, the measured boundary, drawn cuts.
    """

    parameters: dict
    settings: dict
    named: dict[str, Path]
    places: dict[str, str]
    changed: dict[str, Known]
    files: dict[str, Path]
    also_read: tuple[Path, ...]
    max_memory_gb: float
    strict: bool
    read: ReadParams
    segment: SegmentParams
    mesh: MeshParams
    steps: tuple[Step, ...]
    solve: SolveParams
    warp: WarpParams
    carry: CarryParams
    figure: FigureParams

    @property
    def image(self) -> Path:
        """The preoperative image."""
        return self.files["image"]

    @property
    def limit(self) -> int:
        """Most bytes of a file that is read."""
        return int(self.max_memory_gb * 1e9)

    @property
    def constrain(self) -> ConstrainParams:
        """The problem of the last step."""
        return self.steps[-1].constrain


def configure(image=None, scenario=None, flags: dict | None = None, *, until: str = "warp",
              own: tuple[str, ...] = ()) -> Config:
    """The checked configuration of a run up to the stage `until`.

    `image` and the `flags` (by name, without dashes) win over the file `scenario`. `own` are the other arguments of the
    function that was given them. Raises E100, E780 and E781.
    """
    from xfemnav.pipeline.asking.scenario import validated
    from xfemnav.pipeline.asking.scenario_file import read_toml

    raw, files, flags = {"xfemnav": 1}, {}, dict(flags or {})
    image = None if image is None else path_of(image, "image")
    if image is not None and image.name.lower().endswith(".toml"):
        raise XfemnavError("E780", f"{image} is a scenario, not an image; give it as ⟦!scenario={image}⟧.")
    if scenario is not None:
        scenario = path_of(scenario, "scenario")
        raw = read_toml(scenario)
        files = confined(raw, scenario.parent, flags.get("allow_outside"))
    found, given = add_flags(raw, flags, own)
    if image is not None:
        given["image"], raw["image"] = _with_a_name(image), printed(image)
    files = {place: path for place, path in (files | given).items() if place in path_places(raw)}
    if "image" not in files:
        found.append("image: no image was given")
    if STAGES.index(until) >= STAGES.index("constrain") and not _moves(raw):
        found.append(NO_CUT)
    checked, changed = validated(raw, set_by(flags), tuple(found)), {}
    if scenario is not None:
        own = {place: path for place, path in files.items() if place not in given}
        again, changed = found_again(own, scenario, checked.max_memory_gb)
        files |= again
    return _resolved(checked, files, changed, (scenario,) if scenario is not None else ())


def _with_a_name(path: Path) -> Path:
    """The path of a file or folder by its own name, of which outputs are called: '.' and '..' have none."""
    return path if path.name not in ("", "..") else Path(os.path.realpath(path))


def _moves(raw: dict) -> bool:
    """Whether anything in a raw scenario can move tissue."""
    load, boundary = (raw.get(name) if isinstance(raw.get(name), dict) else {} for name in ("load", "boundary"))
    return bool(raw.get("cut") or raw.get("resect") or load.get("gravity") or load.get("pressure")
                or boundary.get("displacement"))


def scenario_problems(path: Path) -> list[str]:
    """Everything that is wrong with a scenario file, one line each: its form, its paths, the files that it names.
    Raises E100 where it is not there."""
    from xfemnav.pipeline.asking.scenario import problems
    from xfemnav.pipeline.asking.scenario_file import read_toml

    try:
        raw = read_toml(path)
        found = problems(raw)
        files = confined(raw, path.parent)
    except XfemnavError as error:
        if error.code == "E100":
            raise
        return [f"{error.code} {error.text}"]
    if not _moves(raw):
        found.append(NO_CUT)
    found += [f"E100 {place}: no file at {file}" for place, file in files.items() if not os.path.isfile(file)]
    return found


def _resolved(s: "Scenario", files: dict[str, Path], changed: dict, also_read: tuple[Path, ...]) -> Config:
    s = in_its_dimension(s)
    basis = taken(Basis, s.solve).suiting(s.solve.model)
    own = {name: value for name, value in asdict(basis).items() if name in type(s.solve).model_fields}
    s = s.model_copy(update={"solve": s.solve.model_copy(update=own)})
    settings, given = s.model_dump(mode="json", exclude={"xfemnav"}), tuple(r.blade is not None for r in s.retract)
    s = s.model_copy(update={"retract": tuple(_filled(r, s) for r in s.retract)})
    drawn = Drawn.read(s, files)
    carried = tuple(_carried(s, files))
    places = {role: place for role, place in ROLES.items() if place in files}
    places |= {f"resection:{i}": f"resect.{i}.mask" for i, r in enumerate(s.resect) if r.mask is not None}
    places |= {item.role: place for item, place in carried}
    held = [path for place, path in files.items() if place == "boundary.displacement" or place.endswith(".markups")]
    return Config(
        parameters=s.model_dump(mode="json", exclude={"xfemnav"}), settings=settings, named=files,
        places=places, changed=changed, files={role: files[place] for role, place in places.items()},
        also_read=(*also_read, *held),
        max_memory_gb=s.max_memory_gb, strict=s.strict,
        read=ReadParams(s.volume, s.nan, s.spacing, s.nifti_frame),
        segment=SegmentParams(s.dimension, s.slice.plane, s.slice.index, s.slice.position_mm, s.segment.method,
                              s.segment.skull, s.resample_mask),
        mesh=_mesh_params(s, drawn), steps=_steps(s, drawn, files.get("boundary.displacement"), given),
        solve=SolveParams(),
        warp=WarpParams(s.warp.interp, s.warp.outside, s.warp.fill, s.warp.transforms,
                        s.warp.transform_spacing_mm),
        carry=CarryParams(tuple(item for item, _ in carried), s.warp.interp, s.warp.outside, s.warp.fill,
                          s.space if s.surfaces else "ras"),
        figure=FigureParams(s.display),
    )


#: Role of an input file -> its place in the scenario.
ROLES = {"image": "image", "mask": "mask", "template": "segment.template", "template_mask": "segment.template_mask",
         "mesh_file": "mesh.file", "labels": "tissue.labels"}


@dataclass(frozen=True)
class Drawn:
    """The points of every cut and of every drawn resection outline (None for the others), and the space of each."""

    cuts: tuple[tuple[tuple, str], ...]
    resections: tuple[tuple[tuple | None, str], ...]
    forms: tuple[str, ...] = ()

    @classmethod
    def read(cls, s: "Scenario", files: dict[str, Path]) -> "Drawn":
        """From the scenario, or from the point files that it names, which say their own frame."""
        cuts = tuple(_path(cut.points, cut.markup, s.space, files.get(f"cut.{i}.markups"), cut.smooth, s.dimension)
                     for i, cut in enumerate(s.cut))
        outlines = tuple(_path(r.outline, r.markup, s.space, files.get(f"resect.{i}.markups"), False)[:2]
                         for i, r in enumerate(s.resect))
        return cls(tuple(cut[:2] for cut in cuts), outlines, tuple(form for _, _, form in cuts))


def _path(points, markup: str | None, space: str, file: Path | None, smooth: bool, dimension: int = 2):
    form = ""
    if file is not None:
        from xfemnav.imaging.points.point_files import read_points

        found = read_points(file, name=markup, planes=dimension > 2)
        form = found.kind if found.kind == "Plane" else ""
        if found.form is not None and not found.form.stated:
            raise XfemnavError("E308", f"{file.name} does not say in which frame its x,y,z count. Name the columns "
                                       "r,a,s or l,p,s, or put its coordsystem.json beside it.")
        points, space = tuple(map(tuple, found.points.tolist())), "ras"
    if smooth:
        from xfemnav.imaging.points.splines import drawn

        points = tuple(map(tuple, drawn(points, closed=False)[0].tolist()))
    return points, space, form


def _carried(s: "Scenario", files: dict[str, Path]):
    """What goes with the image, and its place; what would be called as another gets a number."""
    from xfemnav.pipeline.keeping.names import public_name, stem

    listed = [("companion", item.kind, item.axes, item.order, f"companion.{i}.image")
              for i, item in enumerate(s.companion)]
    for role in ("points", "streamlines", "surfaces"):
        listed += [(role, role, "file", None, f"{role}.{i}") for i in range(len(getattr(s, role)))]
    taken = {public_name(files["image"], "updated")}
    for role, kind, axes, order, place in listed:
        base, number = stem(files[place]), 1
        own = role if role != "companion" and place.endswith(".0") else f"{role}:{base}"
        while {own, called := public_name(files["image"], own, ".")} & taken:
            number += 1
            own = f"{role}:{base}-{number}"
        taken |= {own, called, f"{role}:{base}"}
        yield CompanionParams(own, files[place].name, kind, axes, order), place


def _filled(r, s: "Scenario"):
    """A blade with what was left out: the only cut, and 0 to .8 of its length. Pointwise rows then hold the whole lip
    but the tip's cell, as the paper."""
    whole = taken(LipRules, s.solve).pointwise and r.force_mN_per_mm is None
    cut = r.cut or s.cut[0].name
    return r.model_copy(update={"cut": cut, "blade": r.blade or (None if whole else BLADE),
                                "name": r.name or f"{cut} {r.side}"})


def _mesh_params(s: "Scenario", drawn: Drawn) -> MeshParams:
    """Sizes; the cuts and drawn resections are in it only where they draw the corridor."""
    if s.dimension > 2:
        return MeshParams(False, s.mesh.element_size_mm, s.mesh.corridor_mm, s.mesh.corridor_element_mm, (), None,
                          _cuts(s, drawn))
    uniform = MeshParams(False, s.mesh.element_size_mm, 0.0, None, (), _data_ends(s, drawn))
    if s.mesh.file is not None:
        return replace(uniform, from_file=True, element_size_mm=None, data_ends=None)
    closed = [((*points, points[0]), space) for points, space in drawn.resections if points is not None]
    paths = ((s.mesh.corridor, s.space),) if s.mesh.corridor is not None else (*drawn.cuts, *closed)
    if s.mesh.corridor_mm == 0 or not paths:
        return uniform
    return replace(uniform, corridor=paths, corridor_mm=s.mesh.corridor_mm,
                   corridor_element_mm=s.mesh.corridor_element_mm)


def _cuts(s: "Scenario", drawn: Drawn) -> tuple[CutParams, ...]:
    return tuple(CutParams(cut.name, points, space, cut.craniotomy, cut.internal, None, form, cut.towards, s.space,
                           cut.depth_mm)
                 for cut, (points, space), form in zip(s.cut, drawn.cuts, drawn.forms))


def _data_ends(s: "Scenario", drawn: Drawn) -> DataEnds | None:
    if not s.mesh.grade_at_data_ends:
        return None
    names = [cut.name for cut in s.cut]
    blades = tuple((names.index(r.cut), *(r.blade or BLADE)) for r in s.retract)
    boundary = s.boundary
    grip = None if boundary.skull == "free" else boundary.craniotomy_mm + boundary.skull_ramp_mm
    return DataEnds(_cuts(s, drawn), blades, grip)


def _steps(s: "Scenario", drawn: Drawn, measured: Path | None, given: tuple[bool, ...]) -> tuple[Step, ...]:
    """The steps in order; a run without any is one step in which everything acts. `given`: whose blade was."""
    every = set(chain.from_iterable(actors(s.model_dump()).values()))
    acting = every - {name for step in s.step for name in step.acts}
    whole = _constrain_params(s, drawn, measured, given)
    if not s.step:
        return (Step("", (), (), whole),)
    steps, drawn_after = [], {}
    for k, step in enumerate(s.step):
        acting = (acting | set(step.acts)) - set(step.ends)
        drawn_after |= {name: k - 1 for name in step.acts if step.frame == "current" and k > 0}
        steps.append(Step(step.name, step.acts, step.ends, _acting(s, whole, acting, drawn_after)))
    return tuple(steps)


def _acting(s: "Scenario", whole: ConstrainParams, acting: set[str], drawn_after: dict[str, int]) -> ConstrainParams:
    """The problem with what acts alone; `drawn_after` says after which step a cut or resection was drawn."""
    cuts = tuple(replace(cut, drawn_after=drawn_after.get(cut.name)) for cut in whole.cuts if cut.name in acting)
    kept = [i for i, resection in enumerate(whole.resections) if resection.name in acting]
    cut_number = {cut.name: i for i, cut in enumerate(cuts)}
    return replace(
        whole, cuts=cuts, later_cuts=tuple(cut for cut in whole.cuts if cut.name not in acting),
        retractions=tuple(replace(blade, cut=cut_number[r.cut]) for blade, r in zip(whole.retractions, s.retract)
                          if r.name in acting),
        resections=tuple(replace(whole.resections[i], drawn_after=drawn_after.get(whole.resections[i].name))
                         for i in kept),
        loads=Loads(
            whole.loads.gravity if "gravity" in acting else None,
            tuple(replace(load, resection=None if load.resection is None else kept.index(load.resection))
                  for load, p in zip(whole.loads.pressures, s.load.pressure)
                  if p.name in acting and (load.resection is None or load.resection in kept))),
    )


def _constrain_params(s: "Scenario", drawn: Drawn, measured: Path | None, given: tuple[bool, ...]) -> ConstrainParams:
    names, resections = [cut.name for cut in s.cut], [item.name for item in s.resect]
    solid = taken(Solid, s.tissue, s.solve)
    return ConstrainParams(
        cuts=_cuts(s, drawn), later_cuts=(),
        retractions=tuple(
            Retraction(names.index(r.cut), LEFT if r.side == "left" else RIGHT, r.displacement_mm,
                          r.normal_mm, r.force_mN_per_mm, r.blade, known, r.relative_to, r.blade_along)
            for r, known in zip(s.retract, given)),
        resections=tuple(ResectParams(r.name, points, space, r.labels, i if r.mask is not None else None, None)
                         for i, (r, (points, space)) in enumerate(zip(s.resect, drawn.resections))),
        min_resection_mm=s.min_resection_mm, space=s.space, solid=solid,
        labels=tuple(_label(int(label), item, solid) for label, item in sorted(s.tissue.by_label.items())),
        skull=_skull(s.boundary, measured), loads=_loads(s.load, resections),
        rules=Rules(taken(Basis, s.solve), taken(LipRules, s.boundary, s.solve), s.solve.model,
                    s.boundary.loose_pieces),
    )


def taken(kind, *sections):
    """A value of the mechanics, of the keys that sections call as it calls its fields."""
    return kind(**{field.name: getattr(section, field.name) for field in fields(kind) for section in sections
                   if hasattr(section, field.name)})


def _skull(boundary, measured: Path | None) -> Skull:
    motion = measured and Measured(read_displacements(measured), boundary.displacement_weight)
    arcs = tuple(Arc(arc.start, arc.end, arc.skull, arc.skull_gap_mm) for arc in boundary.arc)
    return Skull(boundary.skull, boundary.craniotomy_mm, boundary.skull_ramp_mm, boundary.skull_gap_mm, arcs,
                 openings=boundary.craniotomies, measured=motion)


def _loads(load, resections: list[str]) -> Loads:
    gravity = load.gravity and Gravity(load.gravity, load.density_kg_m3, load.fluid_density_kg_m3, load.fluid_level_mm)
    return Loads(gravity, tuple(Pressure(p.kpa, None if p.on == OUTLINE else resections.index(p.on))
                                for p in load.pressure))


def _label(label: int, item, rest: Solid) -> LabelParams:
    """Constants of a label's tissue: its own, else its kind's, which may be those of the rest."""
    times, poisson = KINDS[item.kind]
    young = item.young_kpa if item.young_kpa is not None else times * rest.young_kpa
    own = item.poisson if item.poisson is not None else poisson
    return LabelParams(label, replace(rest, young_kpa=young, poisson=rest.poisson if own is None else own))
