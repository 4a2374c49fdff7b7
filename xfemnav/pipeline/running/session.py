"""A session: the organ is condensed once, then a cut and its blades move in milliseconds.

It is for whoever holds a tracked instrument: each of its poses moves the cut or the blades, and asks for tissue,
image and forces. The answers are those of a run with the same cut and lips, to rounding.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import ArrayLike

from xfemnav.errors import XfemnavError, warn
from xfemnav.pipeline.asking.arguments import plain, real
from xfemnav.pipeline.asking.config import configure
from xfemnav.pipeline.asking.flags import numbers
from xfemnav.pipeline.asking.settings import AnyPath, Drawn, Flags
from xfemnav.pipeline.asking.signatures import own_names, takes_flags
from xfemnav.pipeline.keeping.kernels import settle_kernel_cache, spare_the_run
from xfemnav.pipeline.running.result import SIDES, Side, side_number

if TYPE_CHECKING:
    from xfemnav.geometry.mesh import Mesh
    from xfemnav.geometry.motion import Motion
    from xfemnav.imaging.carrying.warp import PullBack
    from xfemnav.imaging.frames.slices import Slice
    from xfemnav.mechanics.live.condensation import Condensation
    from xfemnav.mechanics.live.live_cut import LiveCut
    from xfemnav.mechanics.solving.solution import RetractorForce

NAME = "cut"
#: What a session cannot do, by the name of the setting, and the value that it must have.
ONLY = {"resections": (), "skull.gap_mm": 0.0, "skull.arcs": (), "skull.measured": None, "loads.gravity": None,
        "loads.pressures": (), "rules.model": "linear", "rules.loose": "refuse"}


@dataclass(frozen=True, eq=False)
class _Now:
    """What a session answers from, swapped whole: the cut, the path (k, 2 or 3) mm that it was drawn by, what its lips
    were asked to do, and the pull-back of the image, once it was asked for."""

    live: "LiveCut"
    drawn: np.ndarray | None = None
    asked: tuple[dict, tuple[float, float] | None] = field(default_factory=lambda: ({}, None))
    pulled: "PullBack | None" = None


class Session:
    """An organ ready to be cut: from an image (segmented and meshed as in a run), or from a `Mesh` in plane mm.

    corridor : where cuts are planned, as `cut` of `run` (rows of numbers or "x,y x,y ..."), from the surface inwards.
        The mesh is fine about it, and a cut that stays within `reach_mm` of it moves in milliseconds. One farther away
        takes longer; one with its mouth farther away condenses the organ anew (W315).
    flags : those of `xfemnav.run`, or a `scenario`: mask, slice_mm, element_size_mm, young_kpa, craniotomy_mm, ...

    Points are (2,) or (n, 2) plane mm, or (3,) or (n, 3) world RAS mm; results have the same form, and are NaN where
    there is no tissue. `side` is the lip, "left" (+1) or "right" (-1), of points on the cut.

    >>> import numpy as np
    >>> from xfemnav_examples import domains
    >>> from xfemnav.geometry.plane.distmesh import distmesh
    >>> session = Session(distmesh(domains.disc(70.0), 6.0), corridor=[[0, 75], [0, 30]])
    >>> session.cut([[0, 75], [0, 30]])
    >>> session.open(left=3.0, right=3.0)  # mm, away from the other lip
    >>> left, right = (session.displacement([0.0, 60.0], side) for side in ("left", "right"))
    >>> print(f"{left[0] - right[0]:.0f} mm apart")
    6 mm apart
    """

    frame: "Slice | None"
    mesh: "Mesh"

    @takes_flags
    def __init__(self, image: "AnyPath | Mesh | None" = None, *, corridor: Drawn | None = None,
                 scenario: AnyPath | None = None, reach_mm: float = 6.0, **flags: Unpack[Flags]) -> None:
        """Segment, mesh and condense the organ."""
        from xfemnav.geometry.mesh import Mesh

        settle_kernel_cache()  # before kernels are imported
        spare_the_run()
        from xfemnav.mechanics.live.live_cut import LiveCut

        if corridor is not None and "cut" in flags:
            raise XfemnavError("E780", "corridor and cut both say where cuts are planned: give the corridor alone.")
        if not (real(reach_mm) or 0) > 0:
            raise XfemnavError("E780", f"reach_mm is {reach_mm!r}, wanted a positive number, mm.")
        given = dict(flags) if corridor is None else dict(flags) | {"cut": corridor}
        organ = image if isinstance(image, Mesh) else None
        # A mesh stands in for the image that it was made of: no file is read.
        config = configure("organ" if organ is not None else image, scenario, given, until="mesh",
                           own=own_names(Session.__init__))
        self._settings, self._warp, self.reach_mm = config.constrain, config.warp, reach_mm
        _refuse(config)
        self.frame, self.mesh, self._material, self._border, plan = _prepared(config, organ)
        self._now = _Now(LiveCut.at_rest(self._condensed(self._placed(plan))))

    def __repr__(self) -> str:
        if self._now.drawn is None:
            return f"<xfemnav.Session: {len(self.mesh.points)} nodes, uncut>"
        mouth, tip = (", ".join(f"{x:.1f}" for x in point) for point in self._now.drawn[[0, -1]])
        moved = np.linalg.norm(self.nodes, axis=1).max()
        cut = f"cut from ({mouth}) to ({tip}), moved by {moved:.2f} mm"
        return f"<xfemnav.Session: {len(self.mesh.points)} nodes, {cut}>"

    def cut(self, path: str | ArrayLike) -> None:
        """Cut along a path, from the surface inwards, in the place of the cut before; the blades keep what they do.

        Raises what a run would of the cut (E301 to E305), and E314 when it goes right through; then the cut before
        stays.
        """
        cut = self._incised(self._placed(self._plane(path)))
        live = cut.moved(*self._now.asked, self._settings.rules.lips, at_once=True)
        self._now = _Now(live, self._rows(path), self._now.asked)

    def extend_cut(self, point: ArrayLike) -> None:
        """Lengthen the cut to a point."""
        self._refuse_uncut()
        self.cut(np.vstack([self._now.drawn, self._rows(point)]))

    def open(self, left: ArrayLike | None = None, right: ArrayLike | None = None, *,
             blade: tuple[float, float] | None = None) -> None:
        """Move the lips: (dx, dy) plane mm, or one number, mm away from the other lip; None leaves a lip to itself.

        Each blade holds the part `blade` of the cut, from the mouth; 0 to .8 of it, or as much as stays two elements
        from the tip, unless it is given. Raises E402, E403 and E405 as a run, and E407 where tissue beside the cut is
        so stiff that it wants a run.
        """
        self._refuse_uncut()
        moves = {side: _move(move) for side, move in ((1, left), (-1, right)) if move is not None}
        asked = moves, None if blade is None else tuple(blade)
        live = self._now.live.moved(*asked, self._settings.rules.lips, at_once=False)
        self._now = _Now(live, self._now.drawn, asked)

    def displacement(self, points: ArrayLike, side: Side = None) -> np.ndarray:
        """Displacement, mm, of the tissue that was at `points`."""
        return self.to_current(points, side) - np.asarray(points, float)

    def to_current(self, points: ArrayLike, side: Side = None) -> np.ndarray:
        """Where the tissue that was at `points` in the preoperative image is now."""
        return self._mapped(points, lambda plane: self._now.live.motion.to_current(plane, side_number(side)))

    def to_preoperative(self, points: ArrayLike) -> np.ndarray:
        """Where the tissue that is now at `points` was in the preoperative image."""
        return self._mapped(points, self.motion.to_preoperative)

    @property
    def motion(self) -> "Motion":
        """The map of the tissue, in plane coordinates: a Motion, as that of a run."""
        return self._now.live.motion.all

    @property
    def nodes(self) -> np.ndarray:
        """Displacements (n, 2) mm, plane frame, of the nodes of `mesh`."""
        return self._now.live.motion.U

    @property
    def inverted_mm2(self) -> float:
        """Area of tissue, mm^2, that is turned inside out: above 1 the result is not to be trusted (E401)."""
        from xfemnav.pipeline.stages.stage_solve import inverted_area

        return inverted_area(self._now.live.soup.rest, self._now.live.motion.moved)

    def image(self, values: ArrayLike | None = None, *, interp: str | None = None, outside: str | None = None,
              fill: float | None = None) -> np.ndarray:
        """The slice as it looks now, (n1, n2) along e1 and e2; or other `values` on its grid, a companion."""
        from xfemnav.imaging.carrying.background import asked_blank
        from xfemnav.imaging.carrying.warp import pull_back, update

        if self.frame is None:
            raise XfemnavError("E780", "image: this session was made of a mesh; make it of an image to warp one.")
        values = self.frame.values if values is None else np.asarray(values)
        grid = self.frame.origin, self.frame.spacing, self.frame.values.shape
        live = self._now.live
        if self._now.pulled is None:
            self._now = replace(self._now, pulled=pull_back(live.soup.rest, live.motion.moved, *grid))
        own = self._warp
        how = [own.interp if interp is None else interp, own.outside if outside is None else outside]
        blank = asked_blank(values, self._at_rest, *how, own.fill if fill is None else fill)
        return update(values, self._at_rest, self._now.pulled, *how, blank).updated

    def forces(self) -> "dict[str, RetractorForce]":
        """What each blade does: {"left": RetractorForce, ...}, mN per mm of thickness, kPa."""
        return {name: self._now.live.forces[side] for name, side in SIDES.items() if side in self._now.live.forces}

    @cached_property
    def _at_rest(self):
        """Pixels (n1, n2) of the organ at rest."""
        from xfemnav.imaging.carrying.warp import covered

        return covered(self.mesh.corners, self.frame.origin, self.frame.spacing, self.frame.values.shape)

    def _incised(self, placed) -> "LiveCut":
        """The organ with a cut in it, condensed anew where that is out of reach."""
        from xfemnav.mechanics.live.incision import CutThrough, OutOfReach, incise
        from xfemnav.mechanics.live.live_cut import LiveCut

        organ, how = self._now.live.soup.organ, self._settings.rules.basis
        try:
            try:
                incision = incise(organ, (placed,), how)
            except OutOfReach:
                warn("W315", "the cut has left the session's corridor, and the organ is condensed anew about it.")
                organ = self._condensed(placed)
                incision = incise(organ, (placed,), how)
        except OutOfReach:
            raise XfemnavError("E780", f"cut '{NAME}' changes tissue that the skull holds far from it, which a session "
                                       "cannot do; use smaller elements there, or make a run of it.") from None
        except CutThrough:
            raise XfemnavError("E314", f"cut '{NAME}' goes right through the tissue, which a session cannot do; let it "
                                       "end inside, or make a run of it.") from None
        return LiveCut.at_rest(organ, incision)

    def _condensed(self, plan) -> "Condensation":
        """The organ condensed about a planned cut, uncut and at rest."""
        from xfemnav.mechanics.live.condensation import condense, tip_reach

        settings, mouths = self._settings, plan.path[:1] if plan.mouth and plan.craniotomy else ()
        skull = replace(settings.skull, border=self._border)
        tips, radius = plan.path[-1:] if plan.mouth else plan.path[[0, -1]], 0.0
        if settings.rules.basis.geometric:
            radius = tip_reach(self.mesh, plan)
        return condense(self.mesh, self._material, skull, plan.path, reach_mm=self.reach_mm, mouths=mouths,
                        tips=tips, tip_radius_mm=radius)

    def _placed(self, path):
        """The cut inside the organ, with its mouth."""
        from xfemnav.geometry.plane.cut import place_cut

        drawn = self._settings.cuts[0]
        return place_cut(path, self.mesh.outline, drawn.name, internal=drawn.internal, craniotomy=drawn.craniotomy)

    def _rows(self, points) -> np.ndarray:
        """Points as rows of numbers, plane (n, 2) or world (n, 3) mm."""
        from xfemnav.imaging.frames.slices import rows_of

        if isinstance(points, str):
            points = [numbers(word) for word in points.replace(";", " ").split()]
        rows = rows_of(points)
        if self.frame is None and rows.shape[1] != 2:
            raise XfemnavError("E780", "points are numbers, (n, 2) plane mm: the session was made of a mesh.")
        return rows

    def _plane(self, points) -> np.ndarray:
        """Points (n, 2) plane mm."""
        rows = self._rows(points)
        if self.frame is None:
            return rows
        from xfemnav.imaging.frames.slices import plane_points

        return plane_points(self.frame, rows)

    def _mapped(self, points, move) -> np.ndarray:
        from xfemnav.imaging.frames.slices import mapped

        self._rows(None if isinstance(points, str) else points)
        return mapped(self.frame, points, move)

    def _refuse_uncut(self) -> None:
        if self._now.drawn is None:
            raise XfemnavError("E780", "the organ is not cut yet: give a path to Session.cut first.")


def _move(move) -> np.ndarray:
    """What a lip does: (1,) mm away from the other lip, or (2,) plane mm."""
    numeric = plain(numbers(move) if isinstance(move, str) else move)
    found = numeric if isinstance(numeric, list) else [numeric]
    if len(found) not in (1, 2) or None in map(real, found):
        raise XfemnavError("E780", "a lip moves by one finite number, or by two: left=3.0 or left=(3.5, 1.0).")
    return np.array(found, float)


def _refuse(config) -> None:
    """Name every setting that a session cannot have."""
    params = config.constrain
    if config.segment.dimension > 2:
        raise XfemnavError("E780", "a session is of a slice: a volume is for runs so far.")
    if not params.cuts:
        raise XfemnavError("E780", "a session needs to know where cuts are planned: give a corridor.")
    found = [name.replace(".", " ").replace("_", " ") for name, value in ONLY.items()
             if attrgetter(name)(params) != value]
    found += [f"skull {params.skull.kind!r}"] if params.skull.kind not in ("fixed", "sliding") else []
    found += ["lip constraint 'nitsche'"] if params.rules.lips.nitsche else []
    found += ["points in LPS or voxels"] if params.space != "ras" else []
    found += ["several cuts or steps"] if len(params.cuts) > 1 or len(config.steps) > 1 else []
    found += ["retractions: say them to Session.open"] if params.retractions else []
    if found:
        raise XfemnavError("E780", f"a session is for a cut in a fixed or sliding skull, not for {'; '.join(found)}.")


def _prepared(config, organ):
    """The slice, the mesh, the tissue, where the image ends inside it, and the planned cut (k, 2) plane mm, by the
    functions of the stages."""
    from xfemnav.pipeline.stages import stage_constrain, stage_mesh, stage_segment
    from xfemnav.pipeline.stages.inputs import Inputs

    params, inputs = config.constrain, Inputs(config)
    drawn, slice, border = params.cuts[0], None, None
    plan = np.array(drawn.points)
    if organ is None:
        from xfemnav.imaging.frames.slices import plane_points
        from xfemnav.imaging.reading.nifti_frames import facts
        from xfemnav.pipeline.stages.frame_check import frame_doubts

        inputs.values["segment"] = slice, segmentation = stage_segment.compute(config.segment, inputs)
        found = {role: facts(image.frames, image.values.shape) for role, image in inputs.images.items()}
        for text in frame_doubts(inputs, found):
            warn("W114", text)
        border = slice.border(segmentation.mask)
        inputs.values["mesh"] = organ = stage_mesh.compute(config.mesh, inputs)
        plan = plane_points(slice, plan, drawn.space)
    return slice, organ, stage_constrain.tissue(params, organ, inputs), border, plan
