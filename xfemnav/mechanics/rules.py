"""What the mechanics is asked, as small frozen values: the solid, the skull, the loads, the basis, the lips, the
blades.

Choices, defaults and what they mean to the mechanics stand here, and nowhere else: flags, the scenario's schema and the
keys of the cache are made of these values. No numerics are imported, so that the command's help knows them too.
"""

import math
from dataclasses import dataclass, replace

from xfemnav.errors import XfemnavError

STRESS_STATES = ("strain", "stress")
MODELS = ("linear", "neo-hookean")
SKULLS = ("fixed", "sliding", "free", "contact")
LIPS = ("contact", "free")
LIP_CONSTRAINTS = ("mortar", "nitsche", "pointwise")
TIP_ENRICHMENTS = ("topological", "geometric", "none")
LOOSE = ("refuse", "hold", "remove")
RELATIVE_TO = ("loads", "rest")
LEFT, RIGHT = 1, -1
#: The part of a cut that a blade holds unless it is said: a lip held right up to the tip has infinite energy.
BLADE = (0.0, 0.8)


def _refuse_others(value, name: str, choices: tuple) -> None:
    """Raises ValueError where the field `name` of a value is none of its choices."""
    if getattr(value, name) not in choices:
        raise ValueError(f"{name} is {getattr(value, name)!r}, not one of {choices}")


@dataclass(frozen=True)
class Solid:
    """Isotropic elasticity: Young's modulus kPa, Poisson's ratio, and in the plane 'strain' or 'stress'.

    Raises XfemnavError E404 for constants out of range.
    """

    young_kpa: float = 3.0
    poisson: float = 0.45
    stress_state: str = "strain"

    def __post_init__(self):
        if not 0 < self.young_kpa < math.inf:
            raise XfemnavError("E404", f"Young's modulus is {self.young_kpa:g} kPa; it must be positive.")
        if not 0 <= self.poisson <= 0.499:
            raise XfemnavError("E404", f"Poisson's ratio is {self.poisson:g}; it must lie in 0..0.499.")
        if self.stress_state not in STRESS_STATES:
            raise XfemnavError("E404", f"stress state is {self.stress_state!r}; it must be 'strain' or 'stress'.")


@dataclass(frozen=True)
class Arc:
    """A part of the outline with a kind of its own, counter-clockwise from the outline's point nearest to `start` to
    the one nearest to `end` (2,) mm; `gap_mm` for contact."""

    start: tuple[float, float]
    end: tuple[float, float]
    kind: str
    gap_mm: float = 0.0

    def __post_init__(self):
        _check_hold(self)


@dataclass(frozen=True)
class Measured:
    """Measured motion of the outline: rows x, y, ux, uy mm and, where it matters, side (+1 left, -1 right), which is
    interpolated along it. `weight` None: it is held exactly; else kPa/mm: springs of that stiffness, per mm of outline,
    pull towards it (weighted least squares)."""

    rows: tuple[tuple[float, ...], ...]
    weight: float | None = None

    def __post_init__(self):
        object.__setattr__(self, "rows", tuple(tuple(map(float, row)) for row in self.rows))


@dataclass(frozen=True)
class Skull:
    """The outline is 'fixed', 'sliding', 'free' or in 'contact', except within `craniotomy_mm` of a mouth.

    The grip of a fixed or sliding skull grows over `ramp_mm` by springs, from the craniotomy and from free and contact
    arcs on; 0 switches it on at a point. Contact has no ramp: it can only push, so that nothing pulls at its edge.
    `gap_mm`: how far the outline is from a skull in contact. `arcs` have their own kinds, the later ones before the
    earlier; the craniotomy opens them too.
    What is held by nothing but contact (which holds nobody back from leaving, or from sliding along) also hangs on
    springs of 1e-6 E / mm along the outline: they carry under 1e-4 of a brain's weight where contact bears it, and keep
    it in its place where nothing else does.
    `border`: None, or the rectangle (low, high) (d,) mm in which the image ends, and how near to it (mm) the outline is
    the image's end and no skull (in space in voxels, with the rows (3, 4) that take points to them): tissue goes on
    there, so it is fixed whatever else is said, and no mouth opens it. `openings` (d,) mm: further places about which
    the skull is open. `measured`: where the outline's motion is known, it is that, whatever the skull does there.
    """

    kind: str = "fixed"
    craniotomy_mm: float = 20.0
    ramp_mm: float = 4.0
    gap_mm: float = 0.0
    arcs: tuple[Arc, ...] = ()
    border: tuple | None = None
    openings: tuple[tuple[float, ...], ...] = ()
    measured: Measured | None = None

    def __post_init__(self):
        _check_hold(self)


def _check_hold(value: Skull | Arc) -> None:
    """Raises ValueError for an unknown kind, XfemnavError E409 for a gap below zero."""
    if value.kind not in SKULLS:
        raise ValueError(f"skull {value.kind!r} is not {', '.join(SKULLS[:-1])} or {SKULLS[-1]}")
    if not 0 <= value.gap_mm < math.inf:
        raise XfemnavError("E409", f"the gap to the skull is {value.gap_mm:g} mm; give a length of 0 mm or more.")


@dataclass(frozen=True)
class Gravity:
    """Weight of the tissue: `direction` (d,), in the plane its length the share of gravity there.

    Tissue farther along the direction than `fluid_level_mm` floats: its weight is that of the difference of the
    densities. None: no fluid, as after drainage of the cerebrospinal fluid. Densities in kg/m^3.
    """

    direction: tuple[float, ...]
    density: float = 1000.0
    fluid_density: float = 1007.0
    fluid_level_mm: float | None = None


@dataclass(frozen=True)
class Pressure:
    """`kpa` on the wall of the resection with index `resection`, or on the outline (None); positive into the tissue."""

    kpa: float
    resection: int | None = None


@dataclass(frozen=True)
class Loads:
    """Dead loads on the tissue, beside the retractors' forces."""

    gravity: Gravity | None = None
    pressures: tuple[Pressure, ...] = ()


@dataclass(frozen=True)
class Basis:
    """Which nodes have branch functions: 'topological' (Eq. 4; those whose support holds the tip), 'geometric' (all
    within `tip_radius_mm` of it, by default `enrichment.default_radius`), or 'none'. None: as suits the model."""

    tip_enrichment: str | None = None
    tip_radius_mm: float | None = None

    def __post_init__(self):
        _refuse_others(self, "tip_enrichment", (None, *TIP_ENRICHMENTS))

    def suiting(self, model: str) -> "Basis":
        """The basis in which nothing is left out: 'none' with the neo-Hookean model, else 'topological'."""
        return replace(self, tip_enrichment=self.tip_enrichment or ("topological" if model == "linear" else "none"))

    @property
    def plain(self) -> bool:
        """True without branch functions."""
        return self.tip_enrichment == "none"

    @property
    def geometric(self) -> bool:
        """True where branch functions reach a given distance from the tip."""
        return self.tip_enrichment == "geometric"


@dataclass(frozen=True)
class LipRules:
    """How lips are held, by 'mortar' or 'nitsche' (stable) or 'pointwise' (Eqs. 5 and 6) conditions; `hold_tip` holds
    the tip cell's crossings too. `lips` that nobody holds are in 'contact', or 'free' to pass through each other."""

    lips: str = "contact"
    lip_constraint: str = "mortar"
    hold_tip: bool = False

    def __post_init__(self):
        _refuse_others(self, "lips", LIPS)
        _refuse_others(self, "lip_constraint", LIP_CONSTRAINTS)

    @property
    def touch(self) -> bool:
        """True where lips do not pass through each other."""
        return self.lips == "contact"

    @property
    def nitsche(self) -> bool:
        """True where lips are held by Nitsche's condition: by springs, not by rows."""
        return self.lip_constraint == "nitsche"

    @property
    def pointwise(self) -> bool:
        """True where lips are held at their crossings with mesh edges; without a blade, all along them."""
        return self.lip_constraint == "pointwise"


@dataclass(frozen=True)
class Retraction:
    """What a retractor does to one lip of one cut.

    Exactly one of `displacement_mm` (d,), `normal_mm` (away from the other lip) and `force_mN_per_mm` (d,), in space
    mN, spread over the blade. `blade` (from, to): the part of the cut's length, in space of its depth, that is held, 0
    at the mouth; None holds, pointwise, every crossing but the tip cell's. `blade_given`: whether the user said so, and
    is told if it cannot be. `blade_along` (from, to): in space the part along the mouth; None holds all.
    `relative_to`: displacements count from where the lip lies under all that acts but blades ('loads', by default for
    normal_mm, unless blades alone hold the organ), or from its place at rest ('rest').
    """

    cut: int
    side: int
    displacement_mm: tuple[float, ...] | None = None
    normal_mm: float | None = None
    force_mN_per_mm: tuple[float, ...] | None = None
    blade: tuple[float, float] | None = BLADE
    blade_given: bool = True
    relative_to: str | None = None
    blade_along: tuple[float, float] | None = None

    def __post_init__(self):
        _refuse_others(self, "relative_to", (None, *RELATIVE_TO))
        if sum(x is not None for x in (self.displacement_mm, self.normal_mm, self.force_mN_per_mm)) != 1:
            raise ValueError("give exactly one of displacement_mm, normal_mm, force_mN_per_mm")
        if self.side not in (LEFT, RIGHT):
            raise ValueError("side is +1 (left) or -1 (right)")
        for blade, ends in ((self.blade, "0 the mouth, 1 the tip"), (self.blade_along, "0 the first end, 1 the last")):
            if blade is not None and not 0 <= blade[0] < blade[1] <= 1:
                raise XfemnavError("E402", f"blade {blade[0]:g},{blade[1]:g} is not on the cut; give FROM,TO with "
                                           f"0 <= FROM < TO < 1 ({ends}).")

    @property
    def holds(self) -> bool:
        """True when the lip's displacement is prescribed, not its force."""
        return self.force_mN_per_mm is None

    @property
    def from_loads(self) -> bool:
        """True when the lip's displacement counts from where it lies under all that acts but blades."""
        default = "rest" if self.normal_mm is None else "loads"
        return self.holds and (self.relative_to or default) == "loads"

    def displacement(self, normals):
        """Prescribed displacement (k, d) mm, from where it counts, where the left normals of the cut are (k, d)."""
        if self.displacement_mm is not None:
            return 0 * normals + self.displacement_mm
        return self.side * self.normal_mm * normals


@dataclass(frozen=True)
class Rules:
    """How a problem is set up: its basis, its lips, 'linear' elasticity or 'neo-hookean' finite strains, and what
    becomes of a loose piece, which nothing holds: 'refuse', 'remove', or 'hold' it at its mean."""

    basis: Basis = Basis()
    lips: LipRules = LipRules()
    model: str = "linear"
    loose: str = "refuse"

    def __post_init__(self):
        _refuse_others(self, "model", MODELS)
        _refuse_others(self, "loose", LOOSE)
        object.__setattr__(self, "basis", self.basis.suiting(self.model))
