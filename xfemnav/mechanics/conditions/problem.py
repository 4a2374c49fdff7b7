"""Pose the mechanical problem: mesh, cuts, tissue, skull and retractors as matrices and vectors."""

import warnings
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.chart import Chart
from xfemnav.geometry.mesh import Mesh, frozen_array
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.plane.removal import take_out
from xfemnav.geometry.plane.resection import Resection
from xfemnav.mechanics.conditions.bare import without_blades
from xfemnav.mechanics.conditions.bodies import Piece, sort_out
from xfemnav.mechanics.conditions.conditions import Conditions
from xfemnav.mechanics.conditions.constraints import stack
from xfemnav.mechanics.conditions.contact import join, lip_contacts
from xfemnav.mechanics.conditions.lips import held_spans, lip_load, lip_quadrature, lip_rows
from xfemnav.mechanics.conditions.loads import dead_loads
from xfemnav.mechanics.conditions.nitsche import nitsche_load, nitsche_terms
from xfemnav.mechanics.conditions.placing import functions_on, open_mouths, place
from xfemnav.mechanics.conditions.skull import OutlineConditions, hung, refuse_mouths, skull_conditions
from xfemnav.mechanics.conditions.slivers import warn_of_slivers, warn_of_strips
from xfemnav.mechanics.rules import Loads, Retraction, Rules, Skull
from xfemnav.mechanics.space.enrichment import BRANCH, Enrichment
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import Material, Tissue

#: Above this ratio linear triangles lock in plane strain (how much: docs/measured/sensitivity.md).
LOCKING_POISSON = 0.48


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem(Conditions):
    """What acts on an organ, and what it was made of.

    spans (r, 2) mm: the held part of each retraction's lip, in space windows (r, 2, 3); removed (p,): parts that are
    resected or loose, not in the result; pieces: the bodies of tissue that cuts and resections leave, largest first,
    those removed last. With the 'neo-hookean' model the tissue's stored energy takes the place of 1/2 U'KU.
    bare: what takes the place of these conditions without the blades, where a blade's displacement counts from its
    lip's place then and that is not at rest; once that is known, `under` (n_dof,) mm are its coefficients, and the data
    count on.
    """

    space: Space
    cuts: tuple[Chart, ...]
    material: Material | Tissue
    skull: Skull
    retractions: tuple[Retraction, ...]
    spans: np.ndarray
    removed: np.ndarray
    rules: Rules
    resections: tuple[Resection, ...] = ()
    pieces: tuple[Piece, ...] = ()
    bare: Conditions | None = None
    under: np.ndarray | None = None

    def __post_init__(self):
        super().__post_init__()
        spans = len(self.retractions), *np.shape(self.spans)[1:]
        object.__setattr__(self, "spans", frozen_array(self.spans, float, spans, "spans"))
        object.__setattr__(self, "removed", frozen_array(self.removed, bool, (self.space.parts.n_parts,), "removed"))
        if self.under is not None:
            object.__setattr__(self, "under", frozen_array(self.under, float, self.load.shape, "under"))

    def without_blades(self) -> "Problem":
        """The same problem without blades, for one that has `bare`."""
        return replace(self, retractions=(), spans=np.empty((0, 2)), bare=None, **vars(self.bare))

    def counted_from(self, U) -> "Problem":
        """The same problem with blades' displacements as they count, from U (n_dof,) mm where a blade says so.

        Raises XfemnavError E405 where lips are pushed into each other.
        """
        load, moved = np.array(self.load), np.zeros(len(self.constraints.d))
        for group, (retraction, span) in enumerate(zip(self.retractions, self.spans)):
            if retraction.from_loads and self.rules.lips.nitsche:
                load += nitsche_load(self.space, self.material, retraction, span, U)
            elif retraction.from_loads:
                own = np.flatnonzero(self.constraints.group == group)
                moved[own] = self.constraints.C[own] @ U
        found = replace(
            self, load=load, constraints=replace(self.constraints, d=self.constraints.d + moved), bare=None, under=U
        )
        apart = self.bare.contacts is not None and (self.bare.contacts.cut >= 0).any()
        _refuse_swapped(self.space, self.cuts, self.retractions, self.spans, U.reshape(-1, self.mesh.dim), apart)
        return found

    @property
    def mesh(self) -> Mesh:
        """The mesh, which does not know the cuts."""
        return self.space.mesh

    @property
    def parts(self) -> Parts:
        """What the cuts do to the mesh."""
        return self.space.parts

    @property
    def enrichment(self) -> Enrichment:
        """The table of basis functions."""
        return self.space.enrichment


def pose(
    mesh: Mesh,
    cuts: tuple[Chart, ...],
    material: Material | Tissue,
    skull: Skull,
    retractions: tuple[Retraction, ...] = (),
    resections: tuple[Resection, ...] = (),
    loads: Loads = Loads(),
    rules: Rules = Rules(),
) -> Problem:
    """State the problem of Sect. 5: a cut organ in its skull, with retractors on the lips.

    cuts, inside the organ, from `place_cut`; retractions: what holds or pulls their lips, of which a cut may have none;
    resections: tissue taken out, from `place_resection`.

    Raises
    ------
    XfemnavError
        E302 a cut that enters where the image ends, E305 a cut along the outline, E306 a piece that nothing holds, E311
        a resection too small for the mesh, E402 a blade off its cut, E403 two blades on one lip, E405 lips pushed into
        each other, E406 nothing holds the organ, E408 measured points off the outline, E411 Nitsche's lips with the
        neo-Hookean model.
    """
    asked = _Asked(cuts, material, skull, retractions, resections, loads, rules)
    asked.refuse()
    space = functions_on(mesh, place(mesh, cuts, resections), rules.basis)
    _warn_of_lost_cuts(space, cuts)
    space, acting, pieces = _without_loose_pieces(space, asked)
    bare, retractions = _without_blades(space, asked, acting)
    if bare is None:
        _refuse_swapped(space, cuts, retractions, acting.spans)
    warn_of_strips(space, cuts, resections)
    warn_of_slivers(space, cuts, resections, retractions, acting.spans)
    return Problem(**vars(acting.conditions), space=space, cuts=cuts, material=material, skull=skull,
                   retractions=retractions, spans=acting.spans, removed=space.parts.removed, rules=rules,
                   resections=resections, pieces=pieces, bare=bare)


@dataclass(frozen=True)
class _Asked:
    """What `pose` was asked."""

    cuts: tuple[Chart, ...]
    material: Material | Tissue
    skull: Skull
    retractions: tuple[Retraction, ...]
    resections: tuple[Resection, ...]
    loads: Loads
    rules: Rules

    def refuse(self) -> None:
        """Refuse what does not go together, or warn of it."""
        refuse_mouths(self.skull, self.cuts)
        if self.rules.model != "linear" and self.rules.lips.nitsche:
            raise XfemnavError("E411", "lips by Nitsche's condition are linear; use ⟦lip_constraint=mortar⟧ with it.")
        if not self.material.plane_stress and (poisson := float(np.max(self.material.poisson))) > LOCKING_POISSON:
            warn(
                "W405",
                f"Poisson's ratio {poisson:g} is above {LOCKING_POISSON:g}: linear triangles stiffen, and energy "
                "or displacement may be over 5 % off; use 0.45 to 0.48, or smaller elements.",
            )


class _Acting(NamedTuple):
    """Conditions with the blades' spans (r, 2) mm; and what of them does not come from blades: those of the outline,
    and the load (n_dof,) mN of weight and pressures."""

    conditions: Conditions
    spans: np.ndarray
    outline: OutlineConditions
    dead: np.ndarray


def _conditions(space, asked, again) -> _Acting:
    """What acts on the functions of a space; of blades that are shortened it is told unless this is done `again`."""
    lips, n_dof = asked.rules.lips, space.enrichment.n_dof
    spans = _spans(space, asked.cuts, asked.retractions, lips, again)
    _refuse_overlap(asked.cuts, asked.retractions, spans)
    outline = skull_conditions(space, asked.skull, open_mouths(space.parts, asked.cuts), asked.material,
                               {r.cut for r in asked.retractions})
    conditions, springs, dead = [outline.constraints], outline.springs, dead_loads(space, asked.loads, asked.resections)
    load = outline.load + dead
    for group, (retraction, held) in enumerate(zip(asked.retractions, spans)):
        if not retraction.holds:
            load += lip_load(space, retraction, held)
        elif lips.nitsche:
            terms, forces = nitsche_terms(space, asked.material, retraction, held)
            springs, load = csr_array(springs + terms), load + forces
        else:
            conditions.append(lip_rows(space, retraction, held, group, lips))
    conditions = stack(conditions, n_dof)
    weak = hung(space, conditions, springs, outline.weak)
    springs = springs if weak is None else csr_array(springs + weak)
    return _Acting(Conditions(conditions, springs, load, hung=weak), spans, outline, dead)


def _without_loose_pieces(space, asked):
    """The space without pieces that are cut loose and go, what acts on it, and all pieces."""
    taken, gone = [], np.ones(1)
    while gone.any():  # again without the loose pieces, until there are none
        if taken:
            space = functions_on(space.mesh, take_out(space.parts, gone), asked.rules.basis)
        acting = _conditions(space, asked, again=bool(taken))
        constraints, means, gone, pieces = sort_out(space, asked.cuts, asked.resections, asked.retractions,
                                                    acting.conditions.constraints, acting.conditions.springs,
                                                    asked.rules.loose)
        taken.extend(piece for piece in pieces if piece.fate == "removed")
    contacts = [acting.outline.contacts]
    if asked.rules.lips.touch:
        contacts.append(lip_contacts(space, asked.retractions, acting.spans, space.parts.removed))
    contacts = join(contacts, space.enrichment.n_dof)
    conditions = replace(acting.conditions, constraints=constraints, means=means,
                         contacts=contacts if len(contacts.gap) else None)
    pieces = (*pieces, *sorted(taken, key=lambda piece: -piece.area_mm2))
    return space, acting._replace(conditions=conditions), pieces


def _without_blades(space, asked, acting):
    """The conditions without blades, None where no blade's displacement counts from there; and the retractions, as
    they count."""
    outline, retractions = acting.outline, asked.retractions
    loaded = acting.dead.any() or outline.load.any() or outline.constraints.d.any()
    if not (loaded and any(r.from_loads for r in retractions)):
        return None, retractions
    if asked.skull.measured is not None:  # a mouth that no blade opens may be held shut
        outline = skull_conditions(space, asked.skull, open_mouths(space.parts, asked.cuts), asked.material)
    try:
        return without_blades(space, asked.cuts, asked.resections, outline, acting.dead, asked.rules.lips), retractions
    except XfemnavError:  # without blades the organ has no place
        if any(r.relative_to == "loads" for r in retractions):
            raise
        return None, tuple(replace(r, relative_to="rest") for r in retractions)


def _warn_of_lost_cuts(space, cuts):
    """An internal cut inside the support of every node that it touches opens nothing: say so."""
    table, split = space.enrichment, space.parts
    for k, cut in enumerate(cuts):
        own = split.lips.cut == k
        size = space.mesh.sizes[split.cell[split.lips.parts[own]]].mean() if own.any() else np.inf
        if own.any() and not cut.mouth and cut.length < 3 * size:
            torn = (table.dof[split.lips.parts[own, 0]] != table.dof[split.lips.parts[own, 1]]).any()
            branch = np.isin(split.lips.parts[own], table.entry_part).any() and (table.kind >= BRANCH).any()
            warn(
                "W303",
                f"internal cut '{cut.name}' is {cut.length:.2f} mm long, under three elements ({size:.2f} mm): "
                + ("it is resolved coarsely." if torn or branch else "it cannot open on this mesh."),
            )


def _spans(space, cuts, retractions, rules, again):
    """What the blades hold (r, 2) mm; what is warned of was told already when it is worked out `again`."""
    with warnings.catch_warnings():
        if again:
            warnings.simplefilter("ignore")
        return held_spans(space, cuts, retractions, rules)


def _refuse_overlap(cuts, retractions, spans):
    for i, (one, a) in enumerate(zip(retractions, spans)):
        for other, b in list(zip(retractions, spans))[:i]:
            low, high = np.atleast_1d(np.maximum(a[0], b[0])), np.atleast_1d(np.minimum(a[1], b[1]))
            if (one.cut, one.side) == (other.cut, other.side) and (high > low).all():
                side = "left" if one.side > 0 else "right"
                where = f"{low[0]:.1f} and {high[0]:.1f} mm" if len(low) == 1 else (
                    f"{max(low[1], 0):.2g} and {min(high[1], 1):.2g} of its depth, {max(low[0], 0):.2g} and "
                    f"{min(high[0], 1):.2g} along it")
                raise XfemnavError(
                    "E403",
                    f"two retractions hold the {side} lip of cut '{cuts[one.cut].name}' between {where}; give each its "
                    "own "
                    "part of the lip.",
                )


def _refuse_swapped(space, cuts, retractions, spans, under=None, apart=False):
    """Both lips held over one span must be pulled apart, or at least not into each other.

    under (n_rows, 2) mm: from where displacements count that do not count from rest; `apart`: its lips do not overlap,
    but between the means of their contact.
    """
    for one, a in zip(retractions, spans):
        for other, b in zip(retractions, spans):
            if one.cut != other.cut or one.side != 1 or other.side != -1 or not (one.holds and other.holds):
                continue
            span = np.stack([np.maximum(a[0], b[0]), np.minimum(a[1], b[1])])
            if span.ndim == 1:  # of pointwise rows without a blade it has no end
                span[1] = min(span[1], cuts[one.cut].length)
            if (span[1] <= span[0]).any():
                continue
            q = lip_quadrature(space, one.cut, 1, span, n=1)
            opening = _along(one.displacement(q.normals) - other.displacement(q.normals), q)
            if under is not None:
                lips = [space.basis_in(q.points, parts) @ under * r.from_loads
                        for r, parts in ((one, q.parts), (other, q.across))]
                before = _along(lips[0] - lips[1], q)
                opening += np.maximum(before, 0) if apart and one.from_loads and other.from_loads else before
            if opening.min() < -1e-9:
                raise XfemnavError(
                    "E405",
                    f"left and right look swapped on cut '{cuts[one.cut].name}': its lips are pushed "
                    f"{-opening.min():.1f} mm into each other; left is left when walking from the mouth to the tip.",
                )


def _along(vectors, q):
    return np.einsum("ki,ki->k", vectors, q.normals)
