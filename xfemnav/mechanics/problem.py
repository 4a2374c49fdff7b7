"""Pose the mechanical problem: mesh, cuts, tissue, skull and retractors as matrices and vectors."""

import warnings
from dataclasses import dataclass, fields, replace

import numpy as np
import shapely
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError, warn
from xfemnav.geometry.cut import Cut
from xfemnav.geometry.mesh import Mesh, frozen_array
from xfemnav.geometry.parts import Parts
from xfemnav.geometry.removal import take_out
from xfemnav.geometry.resection import Resection
from xfemnav.geometry.snapping import SNAP
from xfemnav.geometry.subcells import embed
from xfemnav.mechanics.bare import Bare, without_blades
from xfemnav.mechanics.constraints import Constraints, Contacts, Means, stack
from xfemnav.mechanics.contact import join, lip_contacts
from xfemnav.mechanics.elasticity import Material, Tissue
from xfemnav.mechanics.enrichment import BRANCH, Enrichment, enrich
from xfemnav.mechanics.lips import Retraction, held_spans, lip_load, lip_quadrature, lip_rows
from xfemnav.mechanics.loads import dead_loads
from xfemnav.mechanics.nitsche import nitsche_load, nitsche_terms
from xfemnav.mechanics.outline import hung, refuse_mouths, skull_conditions
from xfemnav.mechanics.pieces import Piece, sort_out
from xfemnav.mechanics.rules import Loads, Rules, Skull
from xfemnav.mechanics.slivers import warn_of_slivers, warn_of_strips
from xfemnav.mechanics.space import Space

#: Above this ratio linear triangles lock in plane strain (how much: docs/measured/sensitivity.md).
LOCKING_POISSON = 0.48


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise 1/2 U'(K + springs)U - load'U under C U = d and, where surfaces may touch, G U + gap >= 0 (`contacts`);
    and with mean 0 over each piece that nothing else holds (`means`).

    springs: the skull's ramp and the terms of Nitsche's condition, as stiffness, among them those by which `hung` holds
    what else only touches; spans (r, 2) mm: the held part of each retraction's lip; removed (p,): parts that are
    resected or loose, not in the result; pieces: the bodies of tissue that cuts and resections leave, largest first,
    those removed last.
    With the 'neo-hookean' model the tissue's stored energy takes the place of 1/2 U'KU.
    bare: what takes the place of these without the blades, where a blade's displacement counts from its lip's place
    then and that is not at rest; once that is known, `under` (n_dof,) mm are its coefficients, and the data count on.
    """

    space: Space
    cuts: tuple[Cut, ...]
    material: Material | Tissue
    skull: Skull
    retractions: tuple[Retraction, ...]
    spans: np.ndarray
    constraints: Constraints
    springs: csr_array
    load: np.ndarray
    removed: np.ndarray
    rules: Rules
    contacts: Contacts | None = None
    hung: csr_array | None = None
    resections: tuple[Resection, ...] = ()
    pieces: tuple[Piece, ...] = ()
    means: Means | None = None
    bare: Bare | None = None
    under: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "spans", frozen_array(self.spans, float, (len(self.retractions), 2), "spans"))
        object.__setattr__(self, "springs", csr_array(self.springs))
        object.__setattr__(self, "load", frozen_array(self.load, float, (self.space.enrichment.n_dof,), "load"))
        object.__setattr__(self, "removed", frozen_array(self.removed, bool, (self.space.parts.n_parts,), "removed"))
        if self.under is not None:
            object.__setattr__(self, "under", frozen_array(self.under, float, self.load.shape, "under"))

    def without_blades(self) -> "Problem":
        """The same problem without blades, for one that has `bare`."""
        own = {field.name: getattr(self.bare, field.name) for field in fields(Bare)}
        return replace(self, retractions=(), spans=np.empty((0, 2)), bare=None, **own)

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
        _refuse_swapped(self.space, self.cuts, self.retractions, self.spans, U.reshape(-1, 2), apart)
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
    cuts: tuple[Cut, ...],
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
    refuse_mouths(skull, cuts)
    if rules.model != "linear" and rules.lips.nitsche:
        raise XfemnavError("E411", "lips by Nitsche's condition are linear; use ⟦lip_constraint=mortar⟧ with it.")
    if not material.plane_stress and (poisson := float(np.max(material.poisson))) > LOCKING_POISSON:
        warn(
            "W405",
            f"Poisson's ratio {poisson:g} is above {LOCKING_POISSON:g}: linear triangles stiffen, and energy "
            "or displacement may be over 5 % off; use 0.45 to 0.48, or smaller elements.",
        )
    split, taken = embed(mesh, cuts, resections), []
    space = Space(mesh, split, enrich(mesh, split, rules.basis))
    _refuse_cuts_without_lips(space, cuts, resections)
    _warn_of_lost_cuts(space, cuts)
    mouths = [path[0] for path, cut in zip(split.paths, cuts) if cut.mouth and cut.craniotomy]
    while True:  # again without the loose pieces, until there are none
        n_dof = space.enrichment.n_dof
        spans = _spans(space, cuts, retractions, rules.lips, again=bool(taken))
        _refuse_overlap(cuts, retractions, spans)
        outline = skull_conditions(space, skull, mouths, material, {r.cut for r in retractions})
        conditions, springs = [outline.constraints], outline.springs
        dead = dead_loads(space, loads, resections)
        load = outline.load + dead
        for group, (retraction, span) in enumerate(zip(retractions, spans)):
            if not retraction.holds:
                load += lip_load(space, retraction, span)
            elif rules.lips.nitsche:
                terms, forces = nitsche_terms(space, material, retraction, span)
                springs, load = csr_array(springs + terms), load + forces
            else:
                conditions.append(lip_rows(space, retraction, span, group, rules.lips))
        weak = hung(space, stack(conditions, n_dof), springs, outline.weak)
        springs = springs if weak is None else csr_array(springs + weak)
        conditions = stack(conditions, n_dof)
        constraints, means, gone, pieces = sort_out(space, cuts, resections, retractions, conditions, springs,
                                                  rules.loose)
        if not gone.any():
            break
        taken.extend(piece for piece in pieces if piece.fate == "removed")
        split = take_out(split, gone)
        space = Space(mesh, split, enrich(mesh, split, rules.basis))
    contacts = [outline.contacts]
    if rules.lips.touch:
        contacts.append(lip_contacts(space, retractions, spans, split.removed))
    contacts, bare = join(contacts, n_dof), None
    if any(r.from_loads for r in retractions) and (dead.any() or outline.load.any() or outline.constraints.d.any()):
        if skull.measured is not None:  # a mouth that no blade opens may be held shut
            outline = skull_conditions(space, skull, mouths, material)
        try:
            bare = without_blades(space, cuts, resections, outline, dead, rules.lips)
        except XfemnavError:  # without blades the organ has no place
            if any(r.relative_to == "loads" for r in retractions):
                raise
            retractions = tuple(replace(r, relative_to="rest") for r in retractions)
    if bare is None:
        _refuse_swapped(space, cuts, retractions, spans)
    warn_of_strips(space, cuts, resections)
    warn_of_slivers(space, cuts, resections, retractions, spans)
    return Problem(
        space,
        cuts,
        material,
        skull,
        retractions,
        spans,
        constraints,
        springs,
        load,
        split.removed,
        rules,
        contacts=contacts if len(contacts.gap) else None,
        hung=weak,
        resections=resections,
        pieces=(*pieces, *sorted(taken, key=lambda piece: -piece.area_mm2)),
        means=means,
        bare=bare,
    )


def _refuse_cuts_without_lips(space, cuts, resections):
    """A cut within 1e-3 h of the outline is snapped onto it, where tissue is on one side only: it cuts nothing.

    What lies in a resection, or along its wall, has been cut and taken out.
    """
    split = space.parts
    gone = shapely.union_all([r.region.buffer(4 * SNAP * space.mesh.sizes.max()) for r in resections])
    for k, cut in enumerate(cuts):
        own = split.lips.cut == k
        lost = shapely.LineString(cut.path).difference(gone).length - np.diff(split.lips.arc[own], axis=1).sum()
        if lost > 0.1 * min(cut.length, space.mesh.sizes.min()):
            raise XfemnavError(
                "E305",
                f"cut '{cut.name}' runs along the outline, or along another cut, for {lost:.2g} of its "
                f"{cut.length:.2g} mm, where it cuts nothing; keep it inside, or leave that part out.",
            )


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
            if (one.cut, one.side) == (other.cut, other.side) and min(a[1], b[1]) > max(a[0], b[0]):
                side = "left" if one.side > 0 else "right"
                raise XfemnavError(
                    "E403",
                    f"two retractions hold the {side} lip of cut '{cuts[one.cut].name}' between "
                    f"{max(a[0], b[0]):.1f} and {min(a[1], b[1]):.1f} mm; give each its own part of the lip.",
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
            span = max(a[0], b[0]), min(a[1], b[1], cuts[one.cut].length)
            if span[1] <= span[0]:
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
