"""Solve the problem and read the answer: displacements, moved triangles, strains, retractor forces."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import csc_array, csr_array, eye_array

from xfemnav.geometry.mesh import frozen_array, volumes
from xfemnav.geometry.motion import Motion
from xfemnav.geometry.plane.moved_outline import moved_outline
from xfemnav.geometry.solid.moved_surface import moved_surface
from xfemnav.mechanics.conditions.bodies import rigid_motions
from xfemnav.mechanics.conditions.constraints import Constraints, eliminate, multipliers
from xfemnav.mechanics.conditions.contact import ContactForce, contact_forces
from xfemnav.mechanics.conditions.lips import lip_quadrature, lip_rows
from xfemnav.mechanics.conditions.nitsche import nitsche_traction
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.solving.drift import refuse_drift, refuse_flight, warn_of_sway
from xfemnav.mechanics.solving.factor import factor
from xfemnav.mechanics.solving.hyperelastic import Equilibrium, equilibrium
from xfemnav.mechanics.solving.intensity import FreeTip, free_tips
from xfemnav.mechanics.solving.measures import SHARE, displacement_gradient, exceeded, principal_size, strains
from xfemnav.mechanics.solving.minimise import Minimum, minimise
from xfemnav.mechanics.solving.multigrid import by_multigrid
from xfemnav.mechanics.solving.tip_basis import node_blocks, owners, vector_tip_basis
from xfemnav.mechanics.space.enrichment import BRANCH
from xfemnav.mechanics.space.map_triangles import graded_triangles
from xfemnav.mechanics.tissue.elasticity import stiffness


@dataclass(frozen=True)
class RetractorForce:
    """What one retractor does to its lip: force (d,) mN, in the plane per mm of thickness; mean normal pressure kPa."""

    cut: int
    side: int
    force_mN_per_mm: tuple[float, ...]
    mean_pressure_kPa: float


@dataclass(frozen=True, eq=False)
class Solution:
    """The deformed organ.

    U (n_rows, d) mm: coefficients of the basis; residual: relative; energy: strain energy, kPa mm^2 (per mm thick), in
    space uJ. motion: that of the triangles (tetrahedra) of the cut organ, finer at the tips. Of these the part (t,) of
    each, its strain (t, k), see `measures.strains` (Green-Lagrange's with the neo-Hookean model), and det_F (t,), the
    ratio of moved to resting area.
    outline (k, 2) mm: the organ's moved outline, a closed loop that bridges the mouths by straight lines, and goes on
    as at rest where tissue was removed; in space triangles (k, 3, 3) mm that do the same.
    lips (l, 2, 3, 3) mm: in space the facets of the cuts, as they are now on the left and on the right.
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
    lips: np.ndarray
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
            ("U", (None, None)),
            ("strain", (t, None)),
            ("det_F", (t,)),
            ("outline", (None,) * np.ndim(self.outline)),
            ("contact_force", (None,)),
            ("lips", (None,) * 4),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), float, shape, name))
        for name in ("part", "body"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), np.int64, (t,), name))

    @property
    def rest(self) -> np.ndarray:
        """Triangles (t, 3, 2) mm at rest, in space tetrahedra (t, 4, 3)."""
        return self.motion.rest

    @property
    def moved(self) -> np.ndarray:
        """The same (t, d + 1, d) mm now."""
        return self.motion.moved

    @property
    def rest_areas(self) -> np.ndarray:
        """Resting areas (t,) mm^2 of the triangles, in space volumes mm^3."""
        return volumes(self.rest)

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
    d = problem.mesh.dim
    found, touching, U = state.found, problem.contacts, state.found.U.reshape(-1, d)
    triangles = _triangles(problem, U)
    motion = triangles["motion"]
    refuse_flight(problem, motion, triangles["body"])
    by_linear = _moved(problem, motion.rest, triangles["part"], state.linear.U.reshape(-1, d))
    return Solution(
        U=U,
        residual=found.residual,
        energy=found.energy,
        **triangles,
        outline=OUTLINES[d](problem, motion, U),
        lips=_moved_lips(problem, U),
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
        # Plain elements couple each node with itself and its neighbours, all components.
        added_nnz=elastic.nnz - d * d * (len(problem.mesh.points) + 2 * len(problem.mesh.edges)),
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
    basis, solver = SOLVERS[problem.mesh.dim](problem, K)
    constraints = replace(problem.constraints, C=problem.constraints.C @ basis)
    U0, T = eliminate(constraints)
    U0, T = basis @ U0, (basis @ T).tocsc()
    linear = minimise(
        K, problem.load, U0, T, problem.contacts, problem.means, solver(T), problem.hung
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


def _factored(problem, K):
    """The basis in which the problem is solved, and a factor for its unknowns."""
    return scaled_basis(problem, K), lambda T: partial(factor, semidefinite=not problem.rules.lips.nitsche)


def _iterated(problem, K):
    """All functions as they are, and an iteration that knows the rigid motions and whose each unknown is."""
    table, d = problem.enrichment, problem.mesh.dim
    motions = rigid_motions(problem.mesh.points[table.node] - problem.mesh.points.mean(axis=0))
    motions = motions.reshape(table.n_dof, -1)
    return eye_array(K.shape[0], format="csr"), lambda T: partial(
        by_multigrid, motions=T.T @ motions, owner=T.indices[T.indptr[:-1]] // d)


#: How the unknowns of a problem are found, by the dimension: a matrix of the plane is factored, in space it is too
#: large.
SOLVERS = {2: _factored, 3: _iterated}
#: The organ's moved outline, by the dimension.
OUTLINES = {2: lambda problem, motion, _: moved_outline(problem.mesh.outline, motion),
            3: lambda problem, _, U: moved_surface(problem.mesh.points[problem.mesh.boundary_facets],
                                                   problem.parts.rim.facets, _moved(
                                                       problem, problem.parts.rim.facets, problem.parts.rim.parts, U))}


def _moved_lips(problem, U):
    """The facets of all cuts (l, 2, d, d) mm as they are now, on the left and on the right."""
    lips = problem.parts.lips
    return np.stack([_moved(problem, lips.facets, parts, U) for parts in lips.parts.T], axis=1)


def _triangles(problem, U):
    """The map: resting and moved corners of every triangle, with its strain and det F."""
    space = problem.space
    rest, part = graded_triangles(space)
    keep = ~problem.removed[part]
    rest, part = rest[keep], part[keep]
    moved = _moved(problem, rest, part, U)
    H = displacement_gradient(rest, moved)
    return {
        "motion": Motion(rest, moved, space.parts.paths or tuple(cut.corners for cut in problem.cuts)),
        "part": part,
        "body": problem.enrichment.body[part],
        "strain": strains(H, problem.rules.model != "linear"),
        "det_F": np.linalg.det(H + np.eye(H.shape[1])),
    }


def _moved(problem, rest, part, U):
    """Moved corners (t, k, d) mm of simplices (t, k, d) mm at rest in parts (t,)."""
    _, k, d = rest.shape
    return rest + (problem.space.basis_in(rest.reshape(-1, d), np.repeat(part, k)) @ U).reshape(rest.shape)


def _forces(problem, constraints, reaction, U):
    """What each retractor does to its lip, from the conditions and the reaction on the unknowns of `scaled_basis`.

    Where branch functions are combined, a single one of them is not in equilibrium.
    The work of its forces on a unit displacement away from the other lip is the integral of the normal pressure.
    """
    forces, space = [], problem.space
    lambdas = multipliers(constraints, reaction) if (problem.constraints.group >= 0).any() else None
    # A condition's weights on the partition of unity give the length of lip that its multiplier acts on.
    weights = problem.constraints.C @ np.repeat(problem.enrichment.kind < BRANCH, problem.mesh.dim)
    for group, (retraction, span) in enumerate(zip(problem.retractions, problem.spans)):
        span = _ended(problem, retraction, span)
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
            total = (lambdas[rows] * weights[rows]).reshape(-1, problem.mesh.dim).sum(axis=0)
            normal = lambdas[rows] @ lip_rows(space, unit, span, group, problem.rules.lips).d
        pressure = float(normal / q.weights.sum())
        forces.append(RetractorForce(retraction.cut, retraction.side, tuple(total.tolist()), pressure))
    return tuple(forces)


def _ended(problem, retraction, span):
    """The held part of a lip; in the plane, of pointwise rows without a blade, it has no end but the cut's."""
    return span if np.ndim(span) > 1 else (span[0], min(span[1], problem.cuts[retraction.cut].length))


def _lip_error(problem, U):
    """Deviation from the prescribed displacements at 200 uniform points of every held lip, in space at the middles of
    its facets: rms and largest, mm."""
    errors = [np.zeros(0)]
    for retraction, span in zip(problem.retractions, problem.spans):
        if not retraction.holds:
            continue
        points, parts, normals = _uniform(problem.space, retraction, _ended(problem, retraction, span), 200)
        # From where the prescribed displacement counts.
        before = problem.under.reshape(U.shape) if problem.under is not None and retraction.from_loads else 0 * U
        u = problem.space.basis_in(points, parts) @ (U - before)
        errors.append(np.linalg.norm(u - retraction.displacement(normals), axis=1))
    error = np.concatenate(errors)
    return {
        "lip_error_rms_mm": float(np.sqrt((error**2).mean())) if len(error) else 0.0,
        "lip_error_max_mm": float(error.max(initial=0.0)),
    }


def _uniform(space, retraction, span, n):
    """n points evenly spaced along a held lip, the parts they are taken in, and the left normals there."""
    if np.ndim(span) > 1:
        q = lip_quadrature(space, retraction.cut, retraction.side, span, n=1)
        return q.points, q.parts, q.normals
    arc = span[0] + (np.arange(n) + 0.5) / n * (span[1] - span[0])
    breaks = np.linspace(*span, n + 1)
    q = lip_quadrature(space, retraction.cut, retraction.side, span, breaks, n=1)
    near = np.abs(q.arc[:, None] - arc).argmin(axis=0)
    return q.points[near], q.parts[near], q.normals[near]
