"""Side by side: a cut and blades that move in a session, the same by pose and solve, and by meshing anew with gmsh.

    python -m benchmarks.live [--rounds 7] [--moves 20] [--size 512] [--element-size-mm 2.6]

The rows take turns, so that a busy machine is busy for all. Times are of one thread; beside the wall clock stands the
processor's own, which other programs disturb less. The table goes to docs/use/live.md.
"""

from benchmarks.timing import keep, mark, processor  # isort: skip (sets the number of threads)

import argparse
import os
import platform
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path
from time import perf_counter, process_time

import gmsh
import numpy as np
import scipy.sparse.linalg
from skfem import Basis, BilinearForm, ElementTriP1, ElementVector, MeshTri
from skfem.helpers import ddot, eye, sym_grad, trace

from benchmarks.reference.mesh import split
from data_synthetic import files, phantom
from xfemnav import Session
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.mechanics.conditions.problem import pose
from xfemnav.mechanics.rules import Retraction, Skull
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

PAGE = Path(__file__).parents[1] / "docs" / "use" / "live.md"
BEGIN, END = "<!-- measured -->", "<!-- /measured -->"
FINE = 0.95  # mm, elements in the corridor
HELD = 0.8


def paths(n: int) -> list[np.ndarray]:
    """Cuts (2, 2) mm of the phantom that moved by up to 3 mm at either end."""
    rng = np.random.default_rng(0)
    return [phantom.cut_path() + rng.uniform(-3, 3, (2, 2)) for _ in range(n)]


def moves(n: int) -> list[tuple]:
    """What the left and the right lip do: (dx, dy) mm each, 2 to 4 mm away from the other with some shear."""
    rng = np.random.default_rng(1)
    along = phantom.TRAVEL
    left = np.array([-along[1], along[0]])
    return [(rng.uniform(2, 4) * left + rng.uniform(-1, 1) * along, -rng.uniform(2, 4) * left) for _ in range(n)]


def solved(mesh, path, move):
    """The batch's answer."""
    cut = place_cut(path, mesh.outline)
    blades = tuple(Retraction(0, side, tuple(d), blade=(0.0, HELD)) for side, d in zip((1, -1), move))
    return solve(pose(mesh, (cut,), Material(), Skull(), blades))


def remeshed(outline, path, move, coarse):
    """Displacements (n, 2) mm by the usual chain: gmsh with the cut embedded, scikit-fem's P1, SuperLU."""
    cut = place_cut(path, outline)
    points, cells, on_cut = _gmsh(outline, cut.path, coarse)
    doubled = split(points, cells, on_cut)
    mesh, element = MeshTri(doubled.points.T.copy(), doubled.cells.T.copy()), ElementVector(ElementTriP1())
    basis, tissue = Basis(mesh, element), Material()
    lam, mu = (float(x[0]) for x in reversed(tissue.lame_in(np.array([0]))))

    @BilinearForm
    def form(u, v, w):
        e = sym_grad(u)
        return ddot(lam * eye(trace(e), 2) + 2 * mu * e, sym_grad(v))

    K = form.assemble(basis).tocsc()
    u, fixed = np.zeros((len(doubled.points), 2)), np.zeros(len(doubled.points), dtype=bool)
    rim = np.unique(mesh.facets[:, mesh.boundary_facets()])
    fixed[rim[np.linalg.norm(doubled.points[rim] - cut.path[0], axis=1) > Skull().craniotomy_mm]] = True
    travel = (cut.path[-1] - cut.path[0]) / cut.length
    middle = doubled.points[doubled.cells].mean(axis=1)
    away = (middle - cut.path[0]) @ [-travel[1], travel[0]]
    offset = doubled.points - cut.path[0]
    along, off = offset @ travel, offset @ [-travel[1], travel[0]]
    for side, d in zip((1, -1), move):
        lip = np.zeros(len(doubled.points), dtype=bool)
        lip[doubled.cells[side * away > 0]] = True
        lip &= (np.abs(off) < 1e-6) & (along < HELD * cut.length)
        u[lip], fixed[lip] = d, True
    free = np.flatnonzero(~np.repeat(fixed, 2))
    load = -K @ u.ravel()
    flat = u.ravel()
    flat[free] = scipy.sparse.linalg.splu(K[free][:, free].tocsc()).solve(load[free])
    return flat.reshape(-1, 2)


def _gmsh(outline, path, coarse):
    """Points (n, 2), cells (m, 3), and the mesh edges on the cut (e, 2)."""
    where = int(np.argmin(np.linalg.norm(outline - path[0], axis=1)))
    ring = np.roll(outline, -where, axis=0)
    ring[0] = path[0]
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        geo, field = gmsh.model.geo, gmsh.model.mesh.field
        tags = [geo.addPoint(x, y, 0) for x, y in ring]
        loop = geo.addCurveLoop([geo.addLine(a, b) for a, b in zip(tags, [*tags[1:], tags[0]])])
        line = geo.addLine(tags[0], geo.addPoint(*path[-1], 0))
        surface = geo.addPlaneSurface([loop])
        geo.synchronize()
        gmsh.model.mesh.embed(1, [line], 2, surface)
        field.add("Distance", 1)
        field.setNumbers(1, "CurvesList", [line])
        field.setNumber(1, "Sampling", 100)
        field.add("Threshold", 2)
        for name, value in {"InField": 1, "SizeMin": FINE, "SizeMax": coarse, "DistMin": 12, "DistMax": 20}.items():
            field.setNumber(2, name, value)
        field.setAsBackgroundMesh(2)
        gmsh.model.mesh.generate(2)
        node_tags, xyz, _ = gmsh.model.mesh.getNodes()
        number = np.zeros(int(node_tags.max()) + 1, dtype=int)
        number[node_tags.astype(int)] = np.arange(len(node_tags))
        cells = number[gmsh.model.mesh.getElementsByType(2)[1].astype(int)].reshape(-1, 3)
        edges = number[gmsh.model.mesh.getElementsByType(1, line)[1].astype(int)].reshape(-1, 2)
    finally:
        gmsh.finalize()
    return xyz.reshape(-1, 3)[:, :2].copy(), cells, edges


class Clock:
    """Seconds of each row, by the wall and by the processor."""

    def __init__(self):
        self.times = {}

    def __call__(self, row, run):
        """Run and keep the times."""
        wall, own = perf_counter(), process_time()
        result = run()
        self.times.setdefault(row, []).append((perf_counter() - wall, process_time() - own))
        return result

    def row(self, name) -> tuple[float, float, float, float, int]:
        """Milliseconds: median and 99 % quantile by the wall, by the processor; and the number of times."""
        wall, own = 1e3 * np.array(self.times[name]).T
        return float(np.median(wall)), float(np.quantile(wall, 0.99)), float(np.median(own)), \
            float(np.quantile(own, 0.99)), len(wall)


ROWS = {
    "cut": "moved cut: displacements and forces",
    "blade": "moved blade: displacements and forces",
    "image": "moved blade: warped image",
    "thousand": "1,000 blade positions on one cut",
    "batch": "`pose` and `solve`",
    "remesh": "gmsh, scikit-fem P1, SuperLU",
}


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--element-size-mm", type=float, default=2.6)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        scene = phantom.Phantom(grid=phantom.Grid((args.size,) * 2, (204.8 / args.size,) * 2))
        given = files.write(scene, folder)
        start = perf_counter()
        session = Session(given["image"], mask=given["mask"], corridor=phantom.cut_path(),
                          element_size_mm=args.element_size_mm, corridor_element_mm=FINE)
        made = perf_counter() - start
    outline = session.mesh.outline
    drawn, lips = paths(args.rounds * args.moves), moves(args.rounds * args.moves)
    for path, (left, right) in list(zip(drawn, lips))[:2]:  # kernels are compiled
        session.cut(path)
        session.open(left=left, right=right)
        session.image()
    clock, worst = Clock(), 0.0
    for k in range(args.rounds):
        own = slice(k * args.moves, (k + 1) * args.moves)
        for path in drawn[own]:
            clock("cut", lambda path=path: (session.cut(path), session.nodes, session.forces()))
        session.open(*lips[own.start])
        for left, right in lips[own]:
            clock("blade", lambda left=left, right=right: (session.open(left, right), session.nodes, session.forces()))
            clock("image", lambda left=left, right=right: (session.open(left, right), session.image()))
        clock("thousand", lambda: [session.open(*lips[i % len(lips)]) for i in range(1000)])
        session.open(*lips[own.start])
        path = drawn[own.stop - 1]
        whole = clock("batch", lambda path=path, k=own.start: solved(session.mesh, path, lips[k]))
        worst = max(worst, float(np.abs(whole.U[: len(session.mesh.points)] - session.nodes).max()))
        clock("remesh", lambda path=path, k=own.start: remeshed(outline, path, lips[k], args.element_size_mm))
    table = _table(clock, session, args, made, worst)
    cut, blade, image, thousand, batch, remesh = (clock.row(name)[2] for name in ROWS)
    keep("live", table + "\n", [
        mark("live: a moved cut, ms", 10, cut), mark("live: a moved cut over a new solve", 0.25, cut / batch),
        mark("live: a moved cut over the remeshing chain", 1 / 25, cut / remesh),
        mark("live: a moved blade over a new solve", 1e-3, blade / batch),
        mark("live: a moved blade to a warped image, ms", 5, image),
        mark("live: 1,000 blades, s", 2, thousand / 1e3), mark("live: difference from a new solve, mm", 1e-9, worst),
    ])
    text = PAGE.read_text()
    PAGE.write_text(text[: text.index(BEGIN) + len(BEGIN)] + f"\n\n{table}\n\n" + text[text.index(END):])


def _table(clock, session, args, made, worst) -> str:
    lines = ["| | median ms | 99 % | processor ms | 99 % | times | of a new solve |", "|--|--|--|--|--|--|--|"]
    solve_ms = clock.row("batch")[2]
    for name, title in ROWS.items():
        wall, wall_99, own, own_99, n = clock.row(name)
        times = " | ".join(f"{ms:.2f}" for ms in (wall, wall_99, own, own_99))
        lines.append(f"| {title} | {times} | {n} | {own / solve_ms:.2g} |")
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "gmsh", "scikit-fem"))
    lines += ["", f"{len(session.mesh.points)} nodes, {args.size}² pixels, one thread; the session took {made:.1f} s "
                  f"to make. Displacements differ from those of `solve` by at most {worst:.0e} mm. "
                  f"{processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, {libraries}."]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
