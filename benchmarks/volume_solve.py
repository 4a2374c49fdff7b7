"""Seconds of what a cut in space costs, beside scikit-fem's and PyAMG's own ways, and iterations at any sliver.

    python -m benchmarks.volume_solve

A ball of 36 mm filled evenly, the lower half of its surface fixed. *Without a cut*: assembly of the same linear
tetrahedra by xfemnav and by scikit-fem, and the solution of the same system to 1e-10, by xfemnav's conjugate gradients
and by those of SciPy with PyAMG's smoothed aggregation as it comes, given the rigid motions. *Embedding* is the cut's
level sets at the nodes, and the division of the cells, in a mesh that knows its edges and neighbours already. Seconds
are those of a processor, the best of several.

Slivers: a block of 16 cubes each way, cut through beside a plane of its nodes (nearer than 1e-3 of an edge it is
snapped to them); the volume of the smallest part is that over its cell's. And planes through the ball at random.
"""

from benchmarks.timing import keep, mark, table  # isort: skip (sets the number of threads)

from contextlib import contextmanager
from time import process_time

import numpy as np
import pyamg
from scipy.sparse.linalg import cg
from skfem import Basis as Elements
from skfem import ElementTetP1, ElementVector, MeshTet
from skfem.models.elasticity import lame_parameters, linear_elasticity

from benchmarks.reference.solid import Case
from benchmarks.verification.opened_ball import RADIUS, RULES, ball_field, drawn, posed
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.solid.split import split
from xfemnav.geometry.solid.stuffing import stuff
from xfemnav.geometry.solid.sweep import flat
from xfemnav.mechanics.conditions.bodies import rigid_motions
from xfemnav.mechanics.conditions.placing import functions_on
from xfemnav.mechanics.conditions.problem import pose
from xfemnav.mechanics.rules import Retraction, Skull
from xfemnav.mechanics.solving import multigrid
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material, stiffness

#: Edges (mm) of the even meshes: about 20k and 100k nodes.
EVEN = (2.7, 1.57)
BRAIN = Material(3.0, 0.45)
REPEATS = 3


def best(runs: dict, repeats: int = REPEATS) -> dict[str, float]:
    """Least processor seconds of each of `runs`, taken in turns after one run of each that is not counted."""
    seconds = {name: [] for name in runs}
    for k in range(repeats + 1):
        for name, run in runs.items():
            start = process_time()
            run()
            seconds[name] += [process_time() - start] if k else []
    return {name: min(times) for name, times in seconds.items()}


@contextmanager
def counted():
    """A list that grows by one with every iteration of xfemnav's conjugate gradients."""
    steps, own = [], multigrid.checkpoint
    multigrid.checkpoint = lambda: steps.append(own())
    try:
        yield steps
    finally:
        multigrid.checkpoint = own


def of_plain(mesh: Mesh) -> dict:
    """Assembly and solution without a cut, by either way."""
    space = functions_on(mesh, split(mesh, ()), RULES.basis)
    theirs = Elements(MeshTet(mesh.points.T.copy(), mesh.cells.T.copy()), ElementVector(ElementTetP1()),
                      intorder=0)
    form = linear_elasticity(*lame_parameters(BRAIN.young_kpa, BRAIN.poisson))
    assembly = best({"own": lambda: stiffness(space, BRAIN), "peer": lambda: form.assemble(theirs)})
    rigid = np.zeros(len(mesh.points), bool)
    facets = mesh.boundary_facets
    rigid[facets[mesh.points[facets][..., 2].max(axis=1) < 0]] = True
    free = np.flatnonzero(np.repeat(~rigid, 3))
    A = stiffness(space, BRAIN).tocsr()[free][:, free]
    motions = rigid_motions(mesh.points - mesh.points.mean(axis=0)).reshape(3 * len(mesh.points), -1)[free]
    b, steps = np.random.default_rng(0).normal(size=len(free)), []

    def peer():
        levels = pyamg.smoothed_aggregation_solver(A.tobsr((3, 3)), B=motions)
        steps.clear()
        cg(A, b, rtol=multigrid.TOLERANCE, M=levels.aspreconditioner(), callback=steps.append)

    with counted() as own:
        solving = best({"own": lambda: multigrid.by_multigrid(A, motions, free // 3).solve(b), "peer": peer})
    return {"nodes": len(mesh.points), "assembly": assembly, "solving": solving,
            "iterations": {"own": len(own) // (REPEATS + 1), "peer": len(steps)}}


def of_cut(mesh: Mesh) -> tuple:
    """Seconds of a cut's stages on a mesh, and the iterations."""
    case, sheet = Case("flat"), drawn(Case("flat"))
    problem, level = posed(case, mesh), sheet.level(mesh)
    with counted() as steps:
        solve(problem)
    seconds = best({"mesh": lambda: _known(Mesh(mesh.points, mesh.cells)), "level": lambda: sheet.level(mesh),
                    "split": lambda: split(mesh, (level,)),
                    "pose": lambda: posed(case, mesh), "solve": lambda: solve(problem)}, 2)
    return (len(mesh.points), *seconds.values(), len(steps))


def _known(mesh):
    return mesh.edges, mesh.neighbours


def through(mesh, depth, centre, normal, skull) -> tuple[float, int]:
    """The smallest share that a part has of its cell, and the iterations, where a plane parts a whole mesh."""
    normal = normal / np.linalg.norm(normal)
    along = np.linalg.svd(normal[None])[2][1:]
    along[1] *= np.sign(np.linalg.det([*along, normal]))
    blades = tuple(Retraction(0, side, normal_mm=0.5) for side in (1, -1))
    sheet = flat(depth, centre, [*along, normal], (200.0, 200.0))
    problem = pose(mesh, (sheet,), BRAIN, skull, blades, rules=RULES)
    parts = problem.parts
    volume = np.bincount(parts.part, parts.volumes, parts.n_parts)
    with counted() as steps:
        solve(problem)
    return float((volume / mesh.volumes[parts.cell]).min()), len(steps)


def of_slivers() -> tuple[list, int]:
    """Rows of the planes, and the most iterations."""
    from tests.blocks import block

    rows, mesh = [], block(3, 16)
    for offset in (0.5, 0.1, 0.03, 0.01, 0.002):
        share, steps = through(mesh, lambda x: 16 - x[..., 2], np.array([8.0, 8 + offset, 8]), np.array([0, 1.0, 0]),
                               Skull("fixed", 8.0))
        rows.append((f"block, {offset:g} of an edge beside its nodes", f"{share:.1e}", steps))
    ball, rng = stuff(ball_field(), lambda x: np.full(len(x), 3.5), 3.5, 3.5), np.random.default_rng(0)
    found = [through(ball, lambda x: RADIUS - np.linalg.norm(x, axis=-1), rng.normal(size=3) * 5, rng.normal(size=3),
                     Skull("fixed", 15.0)) for _ in range(10)]
    shares, steps = zip(*found)
    rows.append(("ball, ten random planes: the least, the most", f"{min(shares):.1e}", max(steps)))
    return rows, max(row[-1] for row in rows)


def main() -> None:
    """All tables."""
    meshes = [stuff(ball_field(), lambda x, h=h: np.full(len(x), h), h, h) for h in EVEN]
    plain = [of_plain(mesh) for mesh in meshes]
    rows = [(p["nodes"], name, p[what]["own"], p[what]["peer"], p[what]["own"] / p[what]["peer"],
             *(p["iterations"].values() if what == "solving" else ("", "")))
            for p in plain for what, name in (("assembly", "assembly"), ("solving", "setup and solution"))]
    text = "Without a cut:\n\n" + table(("nodes", "", "xfemnav, s", "peer, s", "over the peer's", "iterations",
                                         "the peer's"), rows)
    cut = [of_cut(mesh) for mesh in meshes]
    text += "\nWith a cut; *pose* embeds it too, and *solve* assembles:\n\n" + table(
        ("nodes", "edges and neighbours, s", "level sets, s", "division, s", "pose, s", "solve, s", "iterations"), cut)
    slivers, most = of_slivers()
    text += "\n" + table(("cut through", "smallest part", "iterations"), slivers)
    last, per = plain[-1], 1e5 / plain[-1]["nodes"]
    keep("volume_solve", text, [
        mark("embedding at 100k nodes, s", 0.3, per * (cut[-1][2] + cut[-1][3])),
        mark("assembly at 100k nodes, s", 0.6, per * last["assembly"]["own"]),
        mark("setup and solution at 100k nodes, s", 5, per * last["solving"]["own"]),
        mark("assembly over scikit-fem's", 1, last["assembly"]["own"] / last["assembly"]["peer"]),
        mark("setup and solution over PyAMG's as it comes", 1, last["solving"]["own"] / last["solving"]["peer"]),
        mark("iterations, any sliver", 25, most)])


if __name__ == "__main__":
    main()
