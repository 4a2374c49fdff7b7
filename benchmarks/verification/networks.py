"""Networks of cuts on problem p's disc: xfemnav beside the conforming reference, on uniform and graded meshes."""

from functools import cache

import numpy as np
import shapely

from benchmarks.reference.cases import BRAIN, FREE, LIFT, Retracted, disc
from benchmarks.reference.elasticity import Field
from benchmarks.reference.networks import HELD, NETWORKS, RESECTIONS, Network, retraction
from benchmarks.verification.outcome import Outcome, Value, relative
from benchmarks.verification.retraction import KEEP, compare
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import Cut, place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.grading import data_ends
from xfemnav.geometry.plane.resection import place_resection
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.mechanics.conditions.problem import Problem, pose
from xfemnav.mechanics.rules import Basis, LipRules, Retraction, Rules, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

CASES = NETWORKS | RESECTIONS
#: Element size at the rim of a resection, mm, on 8,500 nodes.
RIM_MM = 1.2
#: The skull's switch has an error of its own within this distance, mm.
SWITCH_MM = 6.0


@cache
def reference(name: str) -> Retracted:
    """The conforming reference of a case, computed once and kept."""
    file = KEEP / f"network_{name.replace(', ', '_').replace(' ', '-')}.npz"
    if not file.exists():
        found = retraction(CASES[name], 1.4)
        KEEP.mkdir(parents=True, exist_ok=True)
        np.savez(file, corners=found.field.corners, u=found.field.u, energy=found.energy, n_dof=found.n_dof)
    with np.load(file) as kept:
        return Retracted(Field(kept["corners"], kept["u"]), float(kept["energy"]), int(kept["n_dof"]))


def places(network: Network, beyond_mm: float) -> np.ndarray:
    """Points (k, 2) mm of a 1 mm grid in the tissue, farther than `beyond_mm` from its cuts and its rims."""
    grid = np.stack(np.meshgrid(*[np.linspace(-69, 69, 139)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    room = network.tissue.buffer(-beyond_mm).difference(network.lines.buffer(beyond_mm))
    return grid[shapely.contains_xy(room, *grid.T)]


def placed(network: Network, boundary) -> tuple[Cut, ...]:
    """The cuts on a mesh's boundary (b, 2) mm; only the held cut's mouth opens the skull."""
    skull, cuts = shapely.LinearRing(disc()), []
    for k, path in enumerate(np.array(path, float) for path in network.cuts):
        mouth = skull.distance(shapely.Point(path[0])) < 1e-6
        drawn = np.vstack([path[0] + 0.1 * (path[0] - path[1]), path[1:]]) if mouth else path
        cuts.append(place_cut(drawn, boundary, f"cut {k + 1}", internal=not mouth, craniotomy=k == 0))
    return tuple(cuts)


def graded(network: Network, n: int) -> Mesh:
    """A mesh of about n nodes, graded to the ends of cuts and data and to a resection; all sizes go as n^-1/2."""
    spots = data_ends(disc(), placed(network, disc()), ((0, 0.0, HELD),), FREE)
    rim = (np.array([*network.removed[1:], *network.removed[:2]]),) if network.removed else ()

    def mesh(s):
        focus = tuple((point, size * s**2, growth * s) for point, size, growth in spots)
        return distmesh(disc(), SizeField(2.6 * s, RIM_MM * s, RIM_MM * s, rim, focus, 0.11 * s))

    scale = np.sqrt(8_500 / n)
    for _ in range(3):
        scale *= np.sqrt(len(mesh(scale).points) / n)
    return mesh(scale)


def posed(network: Network, mesh: Mesh, enrichment: str) -> Problem:
    """The case on a mesh, in kPa."""
    boundary, material = mesh.outline, Material(BRAIN.young / 1000, BRAIN.poisson)
    lips = tuple(Retraction(0, side, displacement_mm=tuple(side * LIFT), blade=(0.0, HELD)) for side in (1, -1))
    resections = (place_resection([network.removed], boundary),) if network.removed else ()
    skull = Skull("fixed", FREE, 0.0)
    cuts = placed(network, boundary)
    return pose(mesh, cuts, material, skull, lips, resections, rules=Rules(Basis(enrichment), LipRules("free")))


def opened(name: str, mesh: Mesh, enrichment: str) -> Outcome:
    """A case with its errors, mm, and strain energy, Pa mm^2."""
    known, network = reference(name), CASES[name]
    problem = posed(network, mesh, enrichment)
    solution = solve(problem)
    c = compare(problem, solution, known.field, network.removed)
    away = (c.from_cut > 2 * c.size) & (c.from_switch > SWITCH_MM)
    values = (
        ("max beyond 2 h, mm", c.worst()),
        ("rms beyond 2 h, mm", c.rms()),
        ("max beyond 2 h and 6 mm of the switches, mm", float(c.error[away].max())),
    )
    energy = relative("strain energy, Pa mm2", 1000 * solution.energy, known.energy)
    return Outcome(problem, solution, (energy, *(Value(name, x, 0.0, x) for name, x in values)))


def about_reference(name: str) -> dict:
    """What the reference is worth, and what the case adds to problem p.

    change: largest change of its displacement from the next coarser refinement, mm, beyond .5 mm of cuts and rims;
    effect: largest difference to problem p's own displacement, mm, beyond 2 mm of them.
    """
    known, network = reference(name), CASES[name]
    near, far = places(network, 0.5), places(network, 2.0)
    coarser = retraction(network, 1.0).field(near)
    plain = retraction(Network("", network.cuts[:1]), 1.0).field(far)
    return {
        "case": name,
        "energy": known.energy,
        "n_dof": known.n_dof,
        "change": float(np.linalg.norm(known.field(near) - coarser, axis=1).max()),
        "effect": float(np.linalg.norm(known.field(far) - plain, axis=1).max()),
    }
