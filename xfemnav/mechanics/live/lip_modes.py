"""What a cut in a condensed organ does when its lips are moved: modes, to be combined.

For each held lip there are three: it is moved by 1 mm along each axis, or by 1 mm away from the other lip. The answer
to any displacement of the blades is a sum of modes, and so are the forces on the blades. What presses on lips that
touch is found among unit forces of the contact hats, as in `minimise`, and added.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.conditions.constraints import Constraints, Contacts, refuse_contradiction, stack
from xfemnav.mechanics.conditions.contact import lip_contacts
from xfemnav.mechanics.conditions.lips import held_length, held_spans, lip_quadrature, lip_rows
from xfemnav.mechanics.live.incision import Incision, too_stiff
from xfemnav.mechanics.rules import LipRules, Retraction
from xfemnav.mechanics.solving.minimise import CONTRADICTION_MM, SETTLED, TOUCH_MM, pressed
from xfemnav.mechanics.space.enrichment import BRANCH

#: A condition is left out when what it asks beyond the others is smaller than this, relative.
DEPENDENT = 1e-10
#: Modes of a held lip: along the plane's axes, and away from the other lip.
PER_LIP = 3
#: Conditions that are met less exactly than this, relative, are nearly dependent, and solved once more.
EXACT = 1e-14
#: An answer is not given out when its balance with the organ's own stiffness would change it by more than this,
#: relative to the largest displacement.
SOUND = 1e-8


@dataclass(frozen=True, eq=False)
class Answer:
    """What a combination of modes gives: unknowns u (2 a,) mm, and for each blade its force (r, 2) mN per mm and the
    part of it, push (r,) mN per mm, that is away from the other lip."""

    u: np.ndarray
    force: np.ndarray
    push: np.ndarray

    def __add__(self, other: "Answer") -> "Answer":
        return Answer(self.u + other.u, self.force + other.force, self.push + other.push)


@dataclass(frozen=True, eq=False)
class LipModes:
    """The modes of the held lips of an incision.

    blades (r,): Retractions that name cut, side and blade; spans (r, 2) mm: what they hold. conditions: those of the
    blades, then those of the skull; their data for a unit of each mode are d (m, 3 r) mm. u (2 a, 3 r) mm: the
    unknowns of each mode, and multipliers (m, 3 r) mN per mm of the conditions; missed (k, 3 r) mm: how far each is
    from the conditions that were left out because others imply them, or the skull does.
    """

    incision: Incision
    blades: tuple[Retraction, ...]
    spans: np.ndarray
    conditions: Constraints
    weights: np.ndarray
    d: np.ndarray
    system: "System"
    u: np.ndarray
    multipliers: np.ndarray
    missed: np.ndarray

    def free(self, amounts) -> Answer:
        """The answer when mode m is taken `amounts` (3 r,) times and lips pass through each other. Raises E403."""
        refuse_contradiction(self.missed @ amounts, amounts)
        return self._answer(self.u @ amounts, self.multipliers @ amounts)

    def opening(self, amounts) -> float:
        """Smallest distance mm by which the lips are pulled apart where both are held; infinite where not."""
        apart = np.zeros(len(self._normals))
        for k, blade in enumerate(self.blades):
            *along, away = amounts[PER_LIP * k : PER_LIP * (k + 1)]
            apart += blade.side * (self._normals @ along) + away
        return float(apart.min(initial=np.inf))

    @cached_property
    def fields(self) -> tuple[np.ndarray, np.ndarray]:
        """The modes on the whole organ: see `carried`."""
        return self.carried(self.u)

    def carried(self, u) -> tuple[np.ndarray, np.ndarray]:
        """Answers u (2 a, k) mm on the whole organ, as `Incision.expand` has them, if the organ's own stiffness bears
        them out. Raises XfemnavError E407.

        Condensing an inclusion costs digits, twice as many as it is stiffer by. What is out of balance for that would
        move the answer: that is its error, but for a factor of some units.
        """
        U, own = self.incision.expand(u)
        change = self.system.moved_by(self.incision.R.rows(self.incision.unbalanced(u, U).T).T)
        if not (np.abs(self.incision.R @ change).max(axis=0) <= SOUND * np.abs(U).max(axis=(0, 1))).all():
            raise too_stiff()
        return U, own

    @cached_property
    def lengths(self) -> np.ndarray:
        """Held length (r,) mm of each lip."""
        return np.array([held_length(self.incision.space, b.cut, span) for b, span in zip(self.blades, self.spans)])

    @cached_property
    def contacts(self) -> Contacts:
        """Conditions that lips do not pass through each other, where not both are held."""
        removed = np.zeros(self.incision.space.parts.n_parts, dtype=bool)
        return lip_contacts(self.incision.space, self.blades, self.spans, removed)

    @cached_property
    def gaps(self) -> np.ndarray:
        """Mean gap (g, 3 r) mm of each contact in each mode."""
        return self.incision.local(self.contacts.G) @ self.u

    def pressing(self, amounts) -> Answer | None:
        """What contact adds; None when no lips touch. Raises XfemnavError E405 where held lips would overlap."""
        gap = self.gaps @ amounts + self.contacts.gap
        if gap.min(initial=0.0) >= -TOUCH_MM:
            return None
        G, live = self._live_contacts
        settled = ~live
        if settled.any() and gap[settled].min() < -CONTRADICTION_MM:
            x, y = self.contacts.points[settled][np.argmin(gap[settled])]
            raise XfemnavError(
                "E405",
                f"what is held pushes the lips of a cut into each other by {-gap[settled].min():.2g} mm at "
                f"({x:.1f}, {y:.1f}) mm; correct the displacements there, or give lips='free'.",
            )
        zero = np.zeros(len(self.system.A))
        _, force, _ = pressed(self.system, self.system.A, zero, zero, csr_array(G[live]), gap[live])
        q, multipliers = self.system.constrained((G[live].T @ force)[:, None], np.zeros((len(self.d), 1)))
        return self._answer((self.incision.R @ q)[:, 0], multipliers[:, 0])

    @cached_property
    def _normals(self):
        """Left normals (q, 2) of the cut where both lips are held."""
        if len({blade.side for blade in self.blades}) < 2:
            return np.empty((0, 2))
        start, stop = self.spans[:, 0].max(), self.spans[:, 1].min()
        cut = self.blades[0].cut
        stop = min(stop, self.incision.cuts[cut].length)
        return lip_quadrature(self.incision.space, cut, 1, (start, max(start, stop)), n=1).normals

    @cached_property
    def _live_contacts(self):
        """Contacts as rows (g, n) on the unknowns q, and those (g,) bool that are not settled by what is held."""
        G = self.incision.R.rows(self.incision.local(self.contacts.G))
        kept = np.einsum("gn,ng->g", G, self.system.solve(G.T))
        free = np.einsum("gn,ng->g", G, self.system.unheld(G.T))
        return G, kept > SETTLED**2 * free

    def _answer(self, u, multipliers) -> Answer:
        group, axis = self.conditions.group, np.arange(len(self.d)) % 2
        force, push = np.zeros((len(self.blades), 2)), np.zeros(len(self.blades))
        for blade in range(len(self.blades)):
            own = group == blade
            for i in (0, 1):
                force[blade, i] = (self.weights * multipliers)[own & (axis == i)].sum()
            # The work on a unit displacement away from the other lip.
            push[blade] = self.d[own, PER_LIP * blade + 2] @ multipliers[own]
        return Answer(u, force, push)


class System:
    """A q = b + C' f under C q = d, for any b and d: by the Cholesky factor of A, and that of C's compliance."""

    iterated = False

    def __init__(self, A, C):
        # Symmetric: the transpose is in the order that LAPACK wants.
        self.factor, info = lapack.dpotrf(A.T, lower=True)
        if info:
            raise too_stiff()
        Y = blas.dtrsm(1.0, self.factor, C.T, lower=True)
        # Conditions are compared in units of their own compliance.
        size = np.linalg.norm(Y, axis=0)
        self.A, self.size = A, np.where(size > 0, size, 1.0)
        self.C, self.Y = C / self.size[:, None], Y / self.size
        S = self.Y.T @ self.Y
        _, pivot, rank, _ = lapack.dpstrf(S, lower=True, tol=DEPENDENT)
        self.kept = np.sort(pivot[:rank] - 1)
        self.root, lost = lapack.dpotrf(S[np.ix_(self.kept, self.kept)], lower=True)
        if lost:
            raise too_stiff()

    def constrained(self, b, d):
        """q (n, k) and multipliers (m, k) with A q = b + C' multipliers and C q = d; b (n, k), d (m, k)."""
        d = d / self.size[:, None]
        q, force = self._once(b, d)
        miss = d - self.C @ q
        if np.abs(miss).max(initial=0.0) > EXACT * np.abs(d).max(initial=0.0):
            more, extra = self._once(b - self.A @ q + self.C.T @ force, miss)
            q, force = q + more, force + extra
        return q, force / self.size[:, None]

    def _once(self, b, d):
        z = blas.dtrsm(1.0, self.factor, b, lower=True)
        force = np.zeros(d.shape)
        if len(self.kept):
            force[self.kept] = lapack.dpotrs(self.root, (d - self.Y.T @ z)[self.kept], lower=True)[0]
        return blas.dtrsm(1.0, self.factor, z + self.Y @ force, lower=True, trans_a=True), force

    def solve(self, b):
        """q with C q = 0."""
        flat = b.reshape(len(b), -1)
        return self.constrained(flat, np.zeros((len(self.C), flat.shape[1])))[0].reshape(b.shape)

    def moved_by(self, b):
        """q (n, k) with C q = 0 for forces b (n, k), to some digits."""
        return self._once(b, np.zeros((len(self.C), b.shape[1])))[0]

    def unheld(self, b):
        """q without the conditions."""
        return lapack.dpotrs(self.factor, b, lower=True)[0]


def lip_modes(incision: Incision, blades: tuple[Retraction, ...], rules: LipRules = LipRules()) -> LipModes:
    """Hold the lips that the `blades` name, whatever they do with them. Raises XfemnavError E402, E407."""
    space = incision.space
    units = [replace(blade, displacement_mm=None, normal_mm=1.0) for blade in blades]
    spans = held_spans(space, incision.cuts, units, rules)
    rows = [lip_rows(space, unit, span, group, rules) for group, (unit, span) in enumerate(zip(units, spans))]
    conditions = stack([*rows, incision.skull], space.enrichment.n_dof)
    # A condition's weights on the partition of unity are its right-hand side for a unit translation.
    weights = conditions.C @ np.repeat(space.enrichment.kind < BRANCH, 2)
    axis = np.arange(len(weights)) % 2
    d = np.zeros((len(weights), PER_LIP * len(blades)))
    start = 0
    for group, own in enumerate(rows):
        at = slice(start, start + len(own.d))
        for i in (0, 1):
            d[at, PER_LIP * group + i] = weights[at] * (axis[at] == i)
        d[at, PER_LIP * group + 2] = own.d
        start = at.stop
    C, R = incision.local(conditions.C), incision.R
    size = np.sqrt(np.einsum("mn,mn->m", C, C))
    # A row that acts on what the skull fixes, but for rounding, is left out.
    acts = np.linalg.norm(C[:, np.concatenate([R.plain, R.tips])], axis=1) > DEPENDENT * size
    system = System(incision.A, np.where(acts[:, None], R.rows(C), 0.0))
    q, multipliers = system.constrained(np.zeros((len(incision.A), d.shape[1])), d)
    u, dropped = R @ q, np.ones(len(d), dtype=bool)
    dropped[system.kept] = False
    missed = (d[dropped] - C[dropped] @ u) / size[dropped, None]
    return LipModes(incision, blades, spans, conditions, weights, d, system, u, multipliers, missed)
