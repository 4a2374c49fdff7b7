"""From a scenario and flags to what each stage reads: one frozen dataclass of parameters a stage.

A stage's key holds exactly its dataclass, so a parameter stands in the stage that uses it and nowhere else.
"""

import csv
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.flags import FLAG_OF, FLAGS, PATHS, add_flags, confined, numbers, printed

if TYPE_CHECKING:
    from xfemnav.pipeline.scenario import Scenario

STAGES = ("segment", "mesh", "constrain", "solve", "warp")
BLADE = (0.0, 0.8)  # a lip held right up to the tip has infinite energy

NO_CUT = "cut: no cut was given (--cut 'x,y x,y ...')"


@dataclass(frozen=True)
class ReadParams:
    """How image files become numbers."""

    volume: int | None = None
    nan: float | None = None
    spacing: tuple[float, ...] | None = None


@dataclass(frozen=True)
class SegmentParams:
    """Which slice, and how the organ is found in it."""

    plane: str | None
    index: int | None
    position_mm: float | None
    method: str
    skull: str
    resample_mask: bool


@dataclass(frozen=True)
class CutParams:
    """One drawn cut, points in the user's space."""

    name: str
    points: tuple[tuple[float, ...], ...]
    craniotomy: bool
    internal: bool


@dataclass(frozen=True)
class DataEnds:
    """Where the data of a retraction stop: blades (cut's index, from, to), how far from a mouth the outline is held."""

    cuts: tuple[CutParams, ...]
    blades: tuple[tuple[int, float, float], ...]
    grip_mm: float | None


@dataclass(frozen=True)
class MeshParams:
    """Sizes of the elements; `corridor` are paths in the user's `space`, empty when the mesh is uniform.

    Only `data_ends`, None unless asked for, make a mesh depend on blades and skull.
    """

    from_file: bool
    element_size_mm: float | None
    corridor_mm: float
    corridor_element_mm: float | None
    corridor: tuple[tuple[tuple[float, ...], ...], ...]
    data_ends: DataEnds | None
    space: str


@dataclass(frozen=True)
class RetractParams:
    """One blade on one lip; `cut` is an index, `side` is +1 (left) or -1 (right)."""

    cut: int
    side: int
    displacement_mm: tuple[float, float] | None
    normal_mm: float | None
    force_mN_per_mm: tuple[float, float] | None
    blade: tuple[float, float] | None


@dataclass(frozen=True)
class ConstrainParams:
    """Cuts, blades, material, and what holds the outline: the whole boundary value problem."""

    cuts: tuple[CutParams, ...]
    retractions: tuple[RetractParams, ...]
    space: str
    young_kpa: float
    poisson: float
    stress_state: str
    skull: str
    craniotomy_mm: float
    skull_ramp_mm: float
    tip_enrichment: str
    lip_constraint: str
    hold_tip: bool
    boundary_displacement: tuple[tuple[float, ...], ...] | None


@dataclass(frozen=True)
class SolveParams:
    """The problem says it all."""


@dataclass(frozen=True)
class WarpParams:
    """How the new image is sampled."""

    interp: str
    outside: str
    fill: float


@dataclass(frozen=True)
class Config:
    """A checked run: its input files, the parameters of reading and of each stage, and the scenario that says all.

    `also_read` are files whose content the parameters hold: the scenario, the measured boundary.
    """

    parameters: dict
    image: Path
    mask: Path | None
    template: Path | None
    template_mask: Path | None
    mesh_file: Path | None
    also_read: tuple[Path, ...]
    max_memory_gb: float
    strict: bool
    read: ReadParams
    segment: SegmentParams
    mesh: MeshParams
    constrain: ConstrainParams
    solve: SolveParams
    warp: WarpParams

    def inputs(self) -> dict[str, Path]:
        """Input files by role."""
        roles = ("image", "mask", "template", "template_mask", "mesh_file")
        return {role: getattr(self, role) for role in roles if getattr(self, role) is not None}


def configure(image=None, scenario=None, flags: dict | None = None, *, until: str = "warp") -> Config:
    """The checked configuration of a run up to the stage `until`.

    `image` and the `flags` (by name, without dashes) win over the file `scenario`. Raises E100, E780 and E781.
    """
    from xfemnav.pipeline.scenario import read_toml, validated

    raw, files = {"xfemnav": 1}, {}
    if scenario is not None:
        raw = read_toml(Path(scenario))
        files = confined(raw, Path(scenario).parent)
    flags = dict(flags or {})
    found = add_flags(raw, flags)
    if image is not None:
        flags["image"], raw["image"] = image, printed(image)
    files |= {place: Path(flags[name]) for name, place in (("image", "image"), *FLAGS.items())
              if place in PATHS and flags.get(name) is not None}
    if "image" not in files:
        found.append("image: no image was given")
    if STAGES.index(until) >= STAGES.index("constrain") and not raw.get("cut"):
        found.append(NO_CUT)
    also_read = (scenario and Path(scenario), files.get("boundary.displacement"))
    return _resolved(validated(raw, FLAG_OF, tuple(found)), files, tuple(filter(None, also_read)))


def scenario_problems(path: Path) -> list[str]:
    """Everything that is wrong with a scenario file, one line each: its form, its paths, the files that it names."""
    from xfemnav.pipeline.scenario import problems, read_toml

    try:
        raw = read_toml(path)
        found = problems(raw)
        files = confined(raw, path.parent)
    except XfemnavError as error:
        return [str(error)]
    if not raw.get("cut"):
        found.append(NO_CUT)
    found += [f"E100 {place}: no file at {file}" for place, file in files.items() if not os.path.isfile(file)]
    return found


def _resolved(s: "Scenario", files: dict[str, Path], also_read: tuple[Path, ...]) -> Config:
    s = s.model_copy(update={"retract": tuple(_filled(r, s) for r in s.retract)})
    return Config(
        parameters=s.model_dump(mode="json", exclude={"xfemnav"}),
        image=files["image"], mask=files.get("mask"), template=files.get("segment.template"),
        template_mask=files.get("segment.template_mask"), mesh_file=files.get("mesh.file"), also_read=also_read,
        max_memory_gb=s.max_memory_gb, strict=s.strict,
        read=ReadParams(s.volume, s.nan, s.spacing),
        segment=SegmentParams(s.slice.plane, s.slice.index, s.slice.position_mm, s.segment.method, s.segment.skull,
                              s.resample_mask),
        mesh=_mesh_params(s), constrain=_constrain_params(s, files.get("boundary.displacement")), solve=SolveParams(),
        warp=WarpParams(s.warp.interp, s.warp.outside, s.warp.fill),
    )


def _filled(r, s: "Scenario"):
    """A blade with what was left out: the only cut, and 0 to .8 of its length. Pointwise rows then hold the whole lip
    but the tip's cell, as the paper."""
    whole = s.solve.lip_constraint == "pointwise" and r.force_mN_per_mm is None
    return r.model_copy(update={"cut": r.cut or s.cut[0].name, "blade": r.blade or (None if whole else BLADE)})


def _mesh_params(s: "Scenario") -> MeshParams:
    """Sizes; the cuts are in it only where they draw the corridor."""
    uniform = MeshParams(False, s.mesh.element_size_mm, 0.0, None, (), _data_ends(s), s.space)
    if s.mesh.file is not None:
        return replace(uniform, from_file=True, element_size_mm=None, data_ends=None, space="ras")
    paths = (s.mesh.corridor,) if s.mesh.corridor is not None else tuple(cut.points for cut in s.cut)
    if s.mesh.corridor_mm == 0 or not paths:
        return uniform if uniform.data_ends else replace(uniform, space="ras")
    return replace(uniform, corridor=paths, corridor_mm=s.mesh.corridor_mm,
                   corridor_element_mm=s.mesh.corridor_element_mm)


def _cuts(s: "Scenario") -> tuple[CutParams, ...]:
    return tuple(CutParams(cut.name, cut.points, cut.craniotomy, cut.internal) for cut in s.cut)


def _data_ends(s: "Scenario") -> DataEnds | None:
    if not s.mesh.grade_at_data_ends:
        return None
    names = [cut.name for cut in s.cut]
    blades = tuple((names.index(r.cut), *(r.blade or BLADE)) for r in s.retract)
    boundary = s.boundary
    grip = None if boundary.skull == "free" else boundary.craniotomy_mm + boundary.skull_ramp_mm
    return DataEnds(_cuts(s), blades, grip)


def _constrain_params(s: "Scenario", measured: Path | None) -> ConstrainParams:
    names = [cut.name for cut in s.cut]
    rows = None if measured is None else read_displacements(measured)
    return ConstrainParams(
        cuts=_cuts(s),
        retractions=tuple(
            RetractParams(names.index(r.cut), 1 if r.side == "left" else -1, r.displacement_mm,
                          r.normal_mm, r.force_mN_per_mm, r.blade) for r in s.retract),
        space=s.space, young_kpa=s.tissue.young_kpa, poisson=s.tissue.poisson, stress_state=s.solve.stress_state,
        skull=s.boundary.skull, craniotomy_mm=s.boundary.craniotomy_mm, skull_ramp_mm=s.boundary.skull_ramp_mm,
        tip_enrichment=s.solve.tip_enrichment, lip_constraint=s.solve.lip_constraint, hold_tip=s.solve.hold_tip,
        boundary_displacement=rows,
    )


def read_displacements(path: Path) -> tuple[tuple[float, ...], ...]:
    """Rows x, y, ux, uy[, side] (plane mm in the run's space) of a CSV with that header. Raises E100 and E408."""
    if not os.path.isfile(path):
        raise XfemnavError("E100", f"no file of boundary displacements at {path}. Correct the path.")
    with open(path, newline="", encoding="utf-8-sig", errors="replace") as stream:
        table = csv.reader(stream)
        header = [name.strip() for name in next(table, [])]
        if header not in (["x", "y", "ux", "uy"], ["x", "y", "ux", "uy", "side"]):
            raise XfemnavError("E408", f"{path.name} starts with {','.join(header)[:60]!r}; its first line must be "
                                       "x,y,ux,uy or x,y,ux,uy,side.")
        rows = [row for row in table if row]
    for line, row in enumerate(rows, start=2):
        values = numbers(",".join(row))
        if values is None or len(values) != len(header) or not all(map(math.isfinite, values)):
            raise XfemnavError("E408", f"line {line} of {path.name} is not {len(header)} finite numbers: {row}.")
    if len(rows) < 2:
        raise XfemnavError("E408", f"{path.name} has {len(rows)} rows; give the motion of at least two points.")
    return tuple(tuple(map(float, row)) for row in rows)
