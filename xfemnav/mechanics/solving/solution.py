"""Solve the problem and read the answer: displacements, moved triangles, strains, retractor forces."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array, csr_array, eye_array

from xfemnav.geometry.mesh import frozen_array, orient
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.plane.moved_outline import moved_outline
from xfemnav.mechanics.conditions.constraints import Constraints, eliminate, multipliers
from xfemnav.mechanics.conditions.contact import ContactForce, contact_forces
from xfemnav.mechanics.conditions.lips import lip_quadrature, lip_rows
from xfemnav.mechanics.conditions.nitsche import nitsche_traction
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.solving.drift import refuse_drift, refuse_flight, warn_of_sway
from xfemnav.mechanics.solving.hyperelastic import Equilibrium, equilibrium
from xfemnav.mechanics.solving.intensity import FreeTip, free_tips
from xfemnav.mechanics.solving.measures import SHARE, displacement_gradient, exceeded, principal_size
from xfemnav.mechanics.solving.minimise import Minimum, minimise
from xfemnav.mechanics.solving.tip_basis import node_blocks, owners, vector_tip_basis
from xfemnav.mechanics.space.enrichment import BRANCH
from xfemnav.mechanics.space.map_triangles import graded_triangles
from xfemnav.mechanics.tissue.elasticity import stiffness


@dataclass(frozen=True)
class RetractorForce:
    """What one retractor does to its lip: force (2,) mN per mm of thickness, mean normal pressure kPa."""

    cut: int
    side: int
    force_mN_per_mm: tuple[float, float]
    mean_pressure_kPa: float


@dataclass(frozen=True, eq=False)
class Solution:
    """The deformed organ.

    U (n_rows, 2) mm: coefficients of the basis; residual: relative; energy: strain energy, kPa mm^2 (per mm thick).
    motion: that of the triangles of the cut organ, finer at the tips. Of these the part (t,) of each, its strain (t, 3)
    xx, yy, xy (Green-Lagrange's with the neo-Hookean model), and det_F (t,), the ratio of moved to resting area.
    outline (k, 2) mm: the organ's moved outline, a closed loop that bridges the mouths by straight lines,
    and goes on as at rest where tissue was removed.
    contact: where lips press on each other and the outline on the skull, by contact_force (g,) mN per mm, those of the
    problem's `contacts`; min_gap_mm: the smallest mean gap there.
    linear_difference_mm: the largest distance between a moved corner and where the linear model puts it; load_steps
    and newton_iterations: what the neo-Hookean model took. What the cut costs: nnz entries of the linear stiffness
    matrix, added_nnz of them beyond those of plain elements, and its memory in kB.
    """

    U: np.ndarray
    residual: float
    energy: float
    motion: Motion
    part: np.ndarray
    body: np.ndarray
    strain: np.ndarray
    det_F: np.ndarray
    outline: np.ndarray
    retractor: tuple[RetractorForce, ...]
    contact: tuple[ContactForce, ...]
    contact_force: np.ndarray
    min_gap_mm: float | None
    tips: tuple[FreeTip, ...]
    lip_error_rms_mm: float
    lip_error_max_mm: float
    model: str
    load_steps: int
    newton_iterations: int
    linear_difference_mm: float
    nnz: int
    added_nnz: int
    matrix_kB: float

    def __post_init__(self):
        t = len(self.rest)
        for name, shape in (
            ("U", (None, 2)),
            ("strain", (t, 3)),
            ("det_F", (t,)),
            ("outline", (None, 2)),
            ("contact_force", (None,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), float, shape, name))
        for name in ("part", "body"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), np.int64, (t,), name))

    @property
    def rest(self) -> np.ndarray:
        """Triangles (t, 3, 2) mm at rest."""
        return self.motion.rest

    @property
    def moved(self) -> np.ndarray:
        """Triangles (t, 3, 2) mm now."""
        return self.motion.moved

    @property
    def rest_areas(self) -> np.ndarray:
        """Resting areas (t,) mm^2 of the triangles."""
        return orient(*self.rest.swapaxes(0, 1)) / 2

    @property
    def inverted_mm2(self) -> float:
        """Resting area of tissue that is turned inside out, mm^2: what is flagged as folded."""
        return float(self.rest_areas[self.det_F <= 0].sum())

    @property
    def det_F_p01(self) -> float:
        """The 1 % quantile by area of det F."""
        order = np.argsort(self.det_F)
        share = np.cumsum(self.rest_areas[order])
        return float(self.det_F[order][np.searchsorted(share, 0.01 * share[-1])])

    @property
    def largest_strain(self) -> float:
        """The largest absolute principal strain that 1 % of the tissue, by area, exceeds.

        Not the maximum, which a finer mesh raises without end at tips, blades' ends and edges of the bone.
        """
        return exceeded(principal_size(self.strain), self.rest_areas, SHARE * self.rest_areas.sum())

    @property
    def max_displacement_mm(self) -> float:
        """Largest displacement of a triangle's corner, mm."""
        return float(np.linalg.norm(self.moved - self.rest, axis=2).max())


def solve(problem: Problem) -> Solution:
    """Minimise 1/2 U'KU - f'U under the problem's conditions; or the potential energy of neo-Hookean tissue.

    The conditions are eliminated exactly (U = U0 + T q); see `minimise` and `equilibrium` for what is left. Where
    blades count from where their lips lie without them, that is found first. Raises XfemnavError E405, E406, E407; E410
    where neo-Hookean tissue has no equilibrium.
    """
    elastic = stiffness(problem.space, problem.material)
    if problem.bare is not None:
        problem = problem.counted_from(_minimum(problem.without_blades(), elastic).found.U)
    state = _minimum(problem, elastic)
    found, touching, U = state.found, problem.contacts, state.found.U.reshape(-1, 2)
    triangles = _triangles(problem, U)
    motion = triangles["motion"]
    refuse_flight(problem, motion, triangles["body"])
    by_linear = _moved(problem, motion.rest, triangles["part"], state.linear.U.reshape(-1, 2))
    return Solution(
        U=U,
        residual=found.residual,
        energy=found.energy,
        **triangles,
        outline=moved_outline(problem.mesh.outline, motion),
        retractor=_forces(problem, state.constraints, state.basis.T @ state.reaction, U),
        contact_force=found.force,
        contact=() if touching is None else contact_forces(touching, found.force),
        min_gap_mm=None if touching is None else float((touching.G @ found.U + touching.gap).min()),
        tips=free_tips(problem, U, found.force) if problem.rules.model == "linear" else (),
        **_lip_error(problem, U),
        model=problem.rules.model,
        load_steps=found.load_steps,
        newton_iterations=found.newton_iterations,
        linear_difference_mm=float(np.linalg.norm(motion.moved - by_linear, axis=2).max()),
        nnz=elastic.nnz,
        # Plain elements couple each node with itself and its neighbours, both components.
        added_nnz=elastic.nnz - 4 * (len(problem.mesh.points) + 2 * len(problem.mesh.edges)),
        matrix_kB=(elastic.data.nbytes + elastic.indices.nbytes + elastic.indptr.nbytes) / 1000,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """A problem's minimum, `found`, and that of its linear model; its conditions on the unknowns of `basis`; and the
    forces (n_dof,) mN of what holds it."""

    found: Equilibrium
    linear: Minimum
    constraints: Constraints
    basis: csr_array
    reaction: np.ndarray


def _minimum(problem, elastic):
    """The state of least energy, which what touches the skull alone must not drift from."""
    K = (elastic + problem.springs).tocsc()
    basis = scaled_basis(problem, K)
    constraints = replace(problem.constraints, C=problem.constraints.C @ basis)
    U0, T = eliminate(constraints)
    U0, T = basis @ U0, (basis @ T).tocsc()
    linear = minimise(
        K, problem.load, U0, T, problem.contacts, problem.means, not problem.rules.lips.nitsche, problem.hung
    )
    if problem.rules.model == "linear":
        tissue = elastic @ linear.U
        energy, forces = float(linear.U @ tissue / 2), (linear.force, linear.mean_force)
        found = Equilibrium(linear.U, linear.residual, tissue, energy, *forces, 1, 1)
    else:
        found = equilibrium(problem, U0, T, linear)
    touching, lips = problem.contacts, np.zeros(len(found.U))
    reaction = found.tissue + problem.springs @ found.U - problem.load
    if touching is not None:
        lips = touching.G.T @ np.where(touching.cut >= 0, found.force, 0.0)
        reaction = reaction - touching.G.T @ found.force
    if problem.means is not None:
        reaction = reaction - problem.means.C.T @ found.mean_force
    refuse_drift(problem, found.U, lips, reaction)
    warn_of_sway(problem, linear.sway)
    return _State(found, linear, constraints, basis, reaction)


def scaled_basis(problem: Problem, K) -> csr_array:
    """Basis (n_dof, n) in which the problem is solved: vector tip functions if geometric, each node's block scaled."""
    if problem.rules.basis.geometric:
        T = vector_tip_basis(problem.space, problem.material)
    else:
        T = eye_array(K.shape[0], format="csc")
    return csr_array(T @ node_blocks(csc_array(T.T @ K @ T), owners(problem.enrichment, T)))


def _triangles(problem, U):
    """The map: resting and moved corners of every triangle, with its strain and det F."""
    space = problem.space
    rest, part = graded_triangles(space)
    keep = ~problem.removed[part]
    rest, part = rest[keep], part[keep]
    moved = _moved(problem, rest, part, U)
    H = displacement_gradient(rest, moved)
    strain = np.stack([H[:, 0, 0], H[:, 1, 1], (H[:, 0, 1] + H[:, 1, 0]) / 2], axis=1)
    if problem.rules.model != "linear":
        strain += np.einsum("tki,tkj->tij", H, H).reshape(-1, 4)[:, [0, 3, 1]] / 2
    det_F = (1 + H[:, 0, 0]) * (1 + H[:, 1, 1]) - H[:, 0, 1] * H[:, 1, 0]
    return {
        "motion": Motion(rest, moved, space.parts.paths),
        "part": part,
        "body": problem.enrichment.body[part],
        "strain": strain,
        "det_F": det_F,
    }


def _moved(problem, rest, part, U):
    """Moved corners (t, 3, 2) mm of triangles (t, 3, 2) mm at rest in parts (t,)."""
    return rest + (problem.space.basis_in(rest.reshape(-1, 2), np.repeat(part, 3)) @ U).reshape(rest.shape)


def _forces(problem, constraints, reaction, U):
    """What each retractor does to its lip, from the conditions and the reaction on the unknowns of `scaled_basis`.

    Where branch functions are combined, a single one of them is not in equilibrium.
    The work of its forces on a unit displacement away from the other lip is the integral of the normal pressure.
    """
    forces, space = [], problem.space
    lambdas = multipliers(constraints, reaction) if (problem.constraints.group >= 0).any() else None
    # A condition's weights on the partition of unity give the length of lip that its multiplier acts on.
    weights = problem.constraints.C @ np.repeat(problem.enrichment.kind < BRANCH, 2)
    for group, (retraction, span) in enumerate(zip(problem.retractions, problem.spans)):
        span = (span[0], min(span[1], problem.cuts[retraction.cut].length))
        q = lip_quadrature(space, retraction.cut, retraction.side, span)
        away = retraction.side * q.normals
        if not retraction.holds:
            total = np.asarray(retraction.force_mN_per_mm)
            normal = (q.weights * (away @ total)).sum() / q.weights.sum()
        elif problem.rules.lips.nitsche:
            under = problem.under if retraction.from_loads else None
            at, traction = nitsche_traction(space, problem.material, retraction, span, U, under)
            total = at.weights @ traction
            normal = at.weights @ (retraction.side * at.normals * traction).sum(axis=1)
        else:
            rows = problem.constraints.group == group
            unit = replace(retraction, displacement_mm=None, normal_mm=1.0)
            total = (lambdas[rows] * weights[rows]).reshape(-1, 2).sum(axis=0)
            normal = lambdas[rows] @ lip_rows(space, unit, span, group, problem.rules.lips).d
        pressure = float(normal / q.weights.sum())
        forces.append(RetractorForce(retraction.cut, retraction.side, tuple(total.tolist()), pressure))
    return tuple(forces)


def _lip_error(problem, U):
    """Deviation from the prescribed displacements at 200 uniform points of every held lip: rms and largest, mm."""
    errors = [np.zeros(0)]
    for retraction, span in zip(problem.retractions, problem.spans):
        if not retraction.holds:
            continue
        span = (span[0], min(span[1], problem.cuts[retraction.cut].length))
        points, parts, normals = _uniform(problem.space, retraction, span, 200)
        # From where the prescribed displacement counts.
        before = problem.under.reshape(-1, 2) if problem.under is not None and retraction.from_loads else 0 * U
        u = problem.space.basis_in(points, parts) @ (U - before)
        errors.append(np.linalg.norm(u - retraction.displacement(normals), axis=1))
    error = np.concatenate(errors)
    return {
        "lip_error_rms_mm": float(np.sqrt((error**2).mean())) if len(error) else 0.0,
        "lip_error_max_mm": float(error.max(initial=0.0)),
    }


def _uniform(space, retraction, span, n):
    """n points evenly spaced along a held lip, the parts they are taken in, and the left normals there."""
    arc = span[0] + (np.arange(n) + 0.5) / n * (span[1] - span[0])
    breaks = np.linspace(*span, n + 1)
    q = lip_quadrature(space, retraction.cut, retraction.side, span, breaks, n=1)
    near = np.abs(q.arc[:, None] - arc).argmin(axis=0)
    return q.points[near], q.parts[near], q.normals[near]
