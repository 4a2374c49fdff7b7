"""Problem p, the retraction disc: xfemnav beside the conforming reference, on uniform, corridor and graded meshes."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import shapely

from benchmarks.probes import basis_at
from benchmarks.reference.cases import BRAIN, FREE, LIFT, MOUTH, TIP, Retracted, disc, retraction, switches
from benchmarks.reference.elasticity import Field, Tissue
from benchmarks.verification.cases import uniform_mesh
from benchmarks.verification.outcome import Outcome, Value, relative
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import Cut, place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.grading import data_ends
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.mechanics.conditions.problem import Problem, pose
from xfemnav.mechanics.live.condensation import Condensation, condense
from xfemnav.mechanics.rules import Basis, LipRules, Retraction, Rules, Skull
from xfemnav.mechanics.solving.solution import Solution, solve
from xfemnav.mechanics.tissue.elasticity import Material

PATH = np.array([MOUTH, TIP])
#: Computed references are kept here, outside the repository's files.
KEEP = Path("out/reference")


@cache
def reference(held: float, tissue: Tissue = BRAIN, lift=tuple(LIFT)) -> Retracted:
    """The conforming reference for a held fraction, computed once and kept in KEEP."""
    name = f"p_{held:g}_{tissue.young:g}_{tissue.poisson:g}_{tissue.stress_state}_{lift[0]:g}_{lift[1]:g}.npz"
    file = KEEP / name
    if not file.exists():
        found = retraction(held, tissue, 1.4, np.array(lift))
        KEEP.mkdir(parents=True, exist_ok=True)
        np.savez(file, corners=found.field.corners, u=found.field.u, energy=found.energy, n_dof=found.n_dof)
    with np.load(file) as kept:
        return Retracted(Field(kept["corners"], kept["u"]), float(kept["energy"]), int(kept["n_dof"]))


def uniform(n: int) -> Mesh:
    """A uniform mesh of the disc with about n nodes."""
    return uniform_mesh(disc(), n)


def corridor(element_mm=3.0, corridor_mm=12.0, corridor_element_mm=1.0) -> Mesh:
    """The mesh of a run with xfemnav's defaults."""
    return distmesh(disc(), SizeField(element_mm, corridor_element_mm, corridor_mm, (PATH,)))


def graded(n: int, held: float) -> Mesh:
    """Graded where data begin or end, to xfemnav's own points; about n nodes: all sizes go as n^-1/2."""
    s = np.sqrt(8_500 / n)
    focus = tuple((point, size * s**2, growth * s) for point, size, growth in _data_ends(held))
    return distmesh(disc(), SizeField(2.6 * s, focus=focus, growth=0.11 * s))


def corridor_graded(held: float) -> Mesh:
    """The mesh of a run with xfemnav's defaults and --grade-at-data-ends."""
    return distmesh(disc(), SizeField(3.0, 1.0, 12.0, (PATH,), _data_ends(held)))


def _data_ends(held):
    return data_ends(disc(), (Cut(PATH),), ((0, 0.0, held),), FREE)


def drawn(mesh: Mesh, held: float, path=PATH, lift=LIFT) -> tuple[Cut, tuple[Retraction, ...]]:
    """The cut in a mesh, and what holds its lips."""
    beyond = np.vstack([path[0] - 0.1 * (path[-1] - path[0]), path[1:]])
    cut = place_cut(beyond, mesh.outline)
    lift = np.asarray(lift, float)
    return cut, tuple(Retraction(0, side, displacement_mm=tuple(side * lift), blade=(0.0, held)) for side in (1, -1))


def condensed(mesh: Mesh) -> Condensation:
    """The disc without the cut, condensed for cuts about it."""
    material = Material(BRAIN.young / 1000, BRAIN.poisson)
    return condense(mesh, material, Skull("fixed", FREE, 0.0), PATH, mouths=PATH[:1])


def posed(
    mesh: Mesh, held: float, enrichment: str, lip_constraint="mortar", material=None, ramp_mm=0.0, path=PATH, lift=LIFT
) -> Problem:
    """Problem p on a mesh, in kPa; both lips held from the mouth to the fraction `held` of the cut."""
    material = material or Material(BRAIN.young / 1000, BRAIN.poisson)
    cut, lips = drawn(mesh, held, path, lift)
    skull = Skull("fixed", FREE, ramp_mm)
    return pose(mesh, (cut,), material, skull, lips, rules=Rules(Basis(enrichment), LipRules("free", lip_constraint)))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Error |u - reference| (k,) mm at points (k, 2) mm; weights (k,) mm^2; distances to the cuts and the switches, mm.

    The rim of what was resected counts as a cut.

    size (k,) mm is the local element size; the points are one random point of every cell, and the nodes, whose weight
    is 0.
    """

    points: np.ndarray
    error: np.ndarray
    weights: np.ndarray
    size: np.ndarray
    from_cut: np.ndarray
    from_switch: np.ndarray

    def worst(self, cells: float = 2.0, beyond_mm: float = 0.0, nodes: bool = False) -> float:
        """Largest error more than `cells` elements from the cut and `beyond_mm` from the cut and the switches."""
        far = self._far(cells, beyond_mm)
        return float(self.error[far & (self.weights == 0) if nodes else far].max())

    def rms(self, cells: float = 2.0) -> float:
        """Root of the mean square error by area, more than `cells` elements from the cut."""
        far = self._far(cells, 0.0)
        return float(np.sqrt(np.average(self.error[far] ** 2, weights=self.weights[far])))

    def where(self, cells: float = 2.0) -> np.ndarray:
        """Place (2,) mm of the largest error."""
        far = self._far(cells, 0.0)
        return self.points[far][np.argmax(self.error[far])]

    def _far(self, cells, beyond_mm):
        return (self.from_cut > cells * self.size) & (np.minimum(self.from_cut, self.from_switch) >= beyond_mm)


def compare(problem: Problem, solution: Solution, field: Field, removed=()) -> Comparison:
    """Displacements of a solution beside the reference's; `removed`: the loop ((x, y), ...) mm of what was resected."""
    mesh = problem.mesh
    inside = np.random.default_rng(0).dirichlet(np.ones(3), len(mesh.cells))
    points = np.concatenate([np.einsum("ca,cai->ci", inside, mesh.corners), mesh.points])
    node_size = np.zeros(len(mesh.points))
    np.maximum.at(node_size, mesh.cells, mesh.sizes[:, None])
    size = np.concatenate([mesh.sizes, node_size])
    weights = np.concatenate([mesh.volumes, np.zeros(len(mesh.points))])
    removed = shapely.Polygon(removed)
    lines = shapely.union_all([removed.boundary, *(shapely.LineString(cut.path) for cut in problem.cuts)])
    from_cut = lines.distance(shapely.points(points))
    # The mesh's outline and the reference's differ by the chords' sagitta, a rim by its snapping.
    keep = (from_cut > 1e-6) & (np.hypot(*points.T) < np.linalg.norm(MOUTH) - 0.02)
    keep &= ~shapely.contains_xy(removed.buffer(0.02), *points.T)
    points = points[keep]
    error = np.linalg.norm(basis_at(problem.space, points) @ solution.U - field(points), axis=1)
    from_switch = np.linalg.norm(points[:, None] - switches(), axis=2).min(axis=1)
    return Comparison(points, error, weights[keep], size[keep], from_cut[keep], from_switch)


def retracted(mesh: Mesh, enrichment: str, held: float = 0.5, lip_constraint="mortar") -> Outcome:
    """Problem p with its errors, mm, and strain energy, Pa mm^2."""
    known = reference(held)
    problem = posed(mesh, held, enrichment, lip_constraint)
    solution = solve(problem)
    c = compare(problem, solution, known.field)
    values = (
        ("max beyond 2 h, mm", c.worst()),
        ("the same at nodes, mm", c.worst(nodes=True)),
        ("rms beyond 2 h, mm", c.rms()),
        ("max beyond 6 mm, mm", c.worst(beyond_mm=6.0)),
        ("max beyond 6 mm of the cut alone, mm", float(c.error[c.from_cut > 6].max())),
        ("lip error rms, mm", solution.lip_error_rms_mm),
    )
    energy = relative("strain energy, Pa mm2", 1000 * solution.energy, known.energy)
    return Outcome(problem, solution, (energy, *(Value(name, x, 0.0, x) for name, x in values)))
