"""What each stage reads: one frozen dataclass of parameters a stage.

A stage's key holds exactly its dataclass, so a parameter stands in the stage that uses it and nowhere else.
"""

from dataclasses import dataclass

from xfemnav.mechanics.rules import Loads, Retraction, Rules, Skull, Solid

#: Kind of a label's tissue: Young's modulus over the parenchyma's, and Poisson's ratio (None: the parenchyma's).
KINDS = {"parenchyma": (1.0, None), "tumour": (3.0, None), "ventricle": (1 / 30, 0.1), "cavity": (1e-6, 0.0)}


@dataclass(frozen=True)
class ReadParams:
    """How image files become numbers."""

    volume: int | None = None
    nan: float | None = None
    spacing: tuple[float, ...] | None = None
    nifti_frame: str = "auto"


@dataclass(frozen=True)
class SegmentParams:
    """Which slice, or with `dimension` 3 the whole volume, and how the organ is found in it."""

    dimension: int
    plane: str | None
    index: int | None
    position_mm: float | None
    method: str
    skull: str
    resample_mask: bool


@dataclass(frozen=True)
class CutParams:
    """One drawn cut, points in `space`; `drawn_after`: the step in whose deformed slice it was drawn, None for none.

    In a volume: `form` "Plane" of four corners in order, else a curve on the surface, swept `towards` a point in
    `towards_space`, and to `depth_mm`.
    """

    name: str
    points: tuple[tuple[float, ...], ...]
    space: str
    craniotomy: bool
    internal: bool
    drawn_after: int | None
    form: str = ""
    towards: tuple[float, ...] | None = None
    towards_space: str = "ras"
    depth_mm: float | None = None


@dataclass(frozen=True)
class ResectParams:
    """One resection: a drawn outline in `space`, labels of the label map, or the mask file number `mask`."""

    name: str
    outline: tuple[tuple[float, ...], ...] | None
    space: str
    label: tuple[int, ...] | None
    mask: int | None
    drawn_after: int | None


@dataclass(frozen=True)
class LabelParams:
    """The tissue of a label."""

    label: int
    solid: Solid


@dataclass(frozen=True)
class DataEnds:
    """Where the data of a retraction stop: blades (cut's index, from, to), how far from a mouth the outline is held."""

    cuts: tuple[CutParams, ...]
    blades: tuple[tuple[int, float, float], ...]
    grip_mm: float | None


@dataclass(frozen=True)
class MeshParams:
    """Sizes of the elements; `corridor` are paths and the space of each, empty when the mesh is uniform.

    Only `data_ends`, None unless asked for, make a mesh depend on blades and skull. `sheets`: in a volume the cuts
    about which the mesh is fine.
    """

    from_file: bool
    element_size_mm: float | None
    corridor_mm: float
    corridor_element_mm: float | None
    corridor: tuple[tuple[tuple[tuple[float, ...], ...], str], ...]
    data_ends: DataEnds | None
    sheets: tuple[CutParams, ...] = ()


@dataclass(frozen=True)
class ConstrainParams:
    """Cuts, blades, resections, material, loads, and what holds the outline: the whole boundary value problem.

    Its values are the mechanics' own; points and measured motions among them are in `space`, and pressures count these
    resections. The mouths of `later_cuts`, which act from a later step on, open the skull already.
    """

    cuts: tuple[CutParams, ...]
    later_cuts: tuple[CutParams, ...]
    retractions: tuple[Retraction, ...]
    resections: tuple[ResectParams, ...]
    min_resection_mm: float
    space: str
    solid: Solid
    labels: tuple[LabelParams, ...]
    skull: Skull
    loads: Loads
    rules: Rules


@dataclass(frozen=True)
class SolveParams:
    """The problem says it all."""


@dataclass(frozen=True)
class WarpParams:
    """How the new image is sampled."""

    interp: str
    outside: str
    fill: float | None
    transforms: str
    transform_spacing_mm: float | None = None


@dataclass(frozen=True)
class CompanionParams:
    """Another image to carry, or landmarks, streamlines or a surface to move: the role of its file, the file's name,
    its kind (None: by the file), and whose `axes` and which `order` vectors and tensors have."""

    role: str
    name: str
    kind: str | None
    axes: str
    order: str | None


@dataclass(frozen=True)
class CarryParams:
    """Everything that is carried along with the image, how it is sampled, and the `space` of surfaces that do not say
    theirs."""

    companions: tuple[CompanionParams, ...]
    interp: str
    outside: str
    fill: float | None
    space: str


@dataclass(frozen=True)
class FigureParams:
    """Which way round slices are shown: "neurological" or "radiological"."""

    display: str


@dataclass(frozen=True)
class Step:
    """One step of a run: its name ("" when the run has no steps), what begins and ends with it, and its problem."""

    name: str
    acts: tuple[str, ...]
    ends: tuple[str, ...]
    constrain: ConstrainParams
