"""A ball with a cut in space: xfemnav beside the conforming reference, on meshes graded to the cut as a run's are."""

from dataclasses import astuple, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.reference.solid import POISSON, RADIUS, YOUNG, Case, SolidField, opened_ball
from benchmarks.verification.sheets import woven
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.solid.field import Field
from xfemnav.geometry.solid.sheet import Sheet
from xfemnav.geometry.solid.stuffing import stuff
from xfemnav.mechanics.conditions.problem import Problem, pose
from xfemnav.mechanics.rules import Basis, LipRules, Retraction, Rules, Skull
from xfemnav.mechanics.solving.solution import Solution, solve
from xfemnav.mechanics.tissue.elasticity import Material

#: Computed references are kept here, outside the repository's files.
KEEP = Path("out/reference")
#: As a run's in space: largest element, half width of the corridor, growth beyond it.
COARSE_MM, CORRIDOR_MM, GROWTH = 5.0, 4.0, 0.35
#: The sheet's vertices are so far apart, mm, and it goes on so far beyond the ball.
STEP_MM, BEYOND_MM = 0.75, 10.0
RULES = Rules(Basis("none"), LipRules("free", "nitsche"))


@cache
def reference(case: Case, coarse: float, fine: float, slope: float) -> tuple[SolidField, int]:
    """The conforming reference and the number of its unknowns, computed once and kept in KEEP."""
    name = sha256(repr((astuple(case)[1:], coarse, fine, slope)).encode()).hexdigest()[:12]
    file = KEEP / f"ball_{name}.npz"
    if not file.exists():
        field, n_dof = opened_ball(case, coarse, fine, slope)
        KEEP.mkdir(parents=True, exist_ok=True)
        np.savez(file, corners=field.corners, u=field.u, n_dof=n_dof)
    with np.load(file) as kept:
        return SolidField(kept["corners"], kept["u"]), int(kept["n_dof"])


def ball_field(radius=RADIUS, step=1.0) -> Field:
    """The signed distance of a ball, on a grid that knows nothing of it."""
    n, low = int(2 * (radius + 4) / step) + 1, -radius - 4 + 0.137
    axis = low + step * np.arange(n)
    return Field(radius - np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1),
                 np.full(3, low), step * np.eye(3))


def drawn(case: Case) -> Sheet:
    """The case's cut; its chart's depth is that below the ball's top."""
    n, m = (int(np.ceil(length / STEP_MM)) + 1 for length in (2 * case.half_mm, RADIUS + BEYOND_MM - case.front_mm))
    share, z = np.linspace(0, 1, n), np.linspace(RADIUS + BEYOND_MM, case.front_mm, m)[:, None]
    plan, depth = case.plan(share), (RADIUS - z) / (RADIUS - case.front_mm)
    x, y = plan.T
    vertices = np.stack(np.broadcast_arrays(x, y, z), axis=-1)
    mouth = np.column_stack([plan, np.sqrt(RADIUS**2 - (plan**2).sum(axis=1))])
    return woven(vertices, np.stack(np.broadcast_arrays(share, depth), axis=-1), mouth, craniotomy=False)


def mesh(case: Case, fine: float, data_ends: float | None = None) -> Mesh:
    """A run's mesh with elements of `fine` mm about the cut; with `data_ends` mm also there where the skull's grip and
    the blades end."""
    cut, edges = cKDTree(drawn(case).vertices), case.edges()
    ends = cKDTree(np.concatenate([edges["blade"], edges["switch"]]))

    def size(points):
        sizes = fine + GROWTH * (cut.query(points)[0] - CORRIDOR_MM)
        if data_ends is not None:
            sizes = np.minimum(sizes, data_ends + GROWTH * ends.query(points)[0])
        return np.clip(sizes, min(fine, data_ends or fine), COARSE_MM)

    return stuff(ball_field(), size, min(fine, data_ends or fine), COARSE_MM)


def posed(case: Case, of: Mesh) -> Problem:
    """The case on a mesh."""
    depth = (RADIUS - case.edge_mm) / (RADIUS - case.front_mm)
    blades = tuple(Retraction(0, side, displacement_mm=given, blade=(0.0, depth), blade_along=case.held)
                   for side, given in ((1, case.left), (-1, case.right)))
    skull = Skull("fixed", case.free_mm, case.ramp_mm, openings=((0.0, 0.0, RADIUS),))
    return pose(of, (drawn(case),), Material(YOUNG, POISSON), skull, blades, rules=RULES)


@dataclass(frozen=True, eq=False)
class Compared:
    """Error |u - reference| (k,) mm at random points (k, 3) mm of the cut organ's tetrahedra, with their weights (k,)
    mm^3, and how far (k,) mm they are from the cut, and from the lines where data end."""

    points: np.ndarray
    error: np.ndarray
    weights: np.ndarray
    from_cut: np.ndarray
    from_data: np.ndarray

    def beyond(self, mm: float = 3.0, cut_alone: bool = False) -> tuple[float, float]:
        """Largest error and its root mean square, mm, at points farther than this from cut, blade's edge, switch."""
        far = (self.from_cut if cut_alone else np.minimum(self.from_cut, self.from_data)) > mm
        return float(self.error[far].max()), float(np.sqrt(np.average(self.error[far] ** 2, weights=self.weights[far])))


def compare(case: Case, found: Solution, field: SolidField, n: int = 50_000) -> Compared:
    """A solution beside the reference at n points spread evenly."""
    rng = np.random.default_rng(0)
    share = found.rest_areas / found.rest_areas.sum()
    chosen = rng.choice(len(share), n, p=share)
    at = rng.dirichlet(np.ones(4), n)
    points = np.einsum("ka,kai->ki", at, found.rest[chosen])
    u = np.einsum("ka,kai->ki", at, found.moved[chosen]) - points
    edges = case.edges()
    data = cKDTree(np.concatenate([edges["blade"], edges["switch"]])).query(points)[0]
    return Compared(points, np.linalg.norm(u - field(points), axis=1), np.full(n, found.rest_areas.sum() / n),
                    cKDTree(_sampled(case)).query(points)[0], data)


def _sampled(case, step=0.25):
    """Places (k, 3) mm of the cut."""
    share = np.linspace(0, 1, int(2 * case.half_mm / step) + 1)
    z = np.arange(case.front_mm, RADIUS + step, step)
    return np.column_stack([np.tile(case.plan(share), (len(z), 1)), np.repeat(z, len(share))])


def solved(case: Case, fine: float, data_ends: float | None = None) -> tuple[Problem, Solution]:
    """The case posed and solved on a run's mesh."""
    problem = posed(case, mesh(case, fine, data_ends))
    return problem, solve(problem)
