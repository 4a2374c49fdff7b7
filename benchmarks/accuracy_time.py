"""Error against seconds for a changed cut: xfemnav on a mesh that stays, beside the remeshing chain.

    python -m benchmarks.accuracy_time

The problems of docs/measured/accuracy.md: a (edge crack: K_I), d (singular field: energy norm), p (retraction disc: u).
xfemnav's seconds run from the new cut to displacements; the chain's also hold its mesh, which it has to make anew.
`live` is what a session does: the organ without the cut was condensed before. Graded meshes are fine where the data of
this cut end: as good for other cuts only as far as theirs end there too.
xfemnav's elements are linear. Graded quadratic elements are its strongest peer: below some error their order wins over
the mesh that need not be made. `x`: how many times xfemnav's seconds a way needs for the same error; under 1 it wins.
GetFEM's enriched elements are timed on problem d where Debian's python3-getfem is installed.
"""

from benchmarks.probes import basis_at

from benchmarks.timing import interleaved, keep, table  # isort: skip (sets the number of threads)

import json
import os
import subprocess
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from skfem import Basis, Functional

from benchmarks.chains import Chain, displaced, split_mesh
from benchmarks.reference.cases import BRAIN, LIFT, MOUTH, TIP, disc, switches
from benchmarks.reference.elasticity import Tissue
from benchmarks.reference.stress_intensity import stress_intensity as conforming_intensity
from benchmarks.reference.stress_intensity import williams as singular
from benchmarks.verification import cases, fields, retraction
from benchmarks.verification.outcome import energy_error
from benchmarks.verification.plates import cut_space, given_on_rim, plate_problem, rim, supports, traction_load
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.mechanics import rules
from xfemnav.mechanics.live.incision import incise
from xfemnav.mechanics.live.lip_modes import lip_modes
from xfemnav.mechanics.live.live_motion import LiveMotion, Soup
from xfemnav.mechanics.solving.intensity import stress_intensity

SIZES = (500, 2_000, 8_000, 32_000)
REPEATS = 5
DEBIAN = "/usr/bin/python3"
STEEL = Tissue(1.0, 0.3)
WIDTH, LENGTH, CRACK, FACTOR = 7.0, 16.0, 3.5, 2.82468
HELD = 0.5
COLOURS = {
    "xfemnav, live, graded": "k", "xfemnav, topological": "C0", "xfemnav, topological, graded": "C9",
    "xfemnav, geometric": "C1", "xfemnav, geometric, graded": "C1", "chain, P1": "C2", "chain, P2": "C3",
    "chain, P1, graded": "C8", "chain, P2, graded": "C4", "GetFEM, P1, fixed area": "C5",
}
PLOT = Path("docs/figures/accuracy-time.png")
FAR_MM = 5.0  # problem p: displacements are compared this far from the cut, and from the ends of the skull's hold


def plate(mesh, enrichment):
    """Problem a, solved for a cut in a mesh that is there: space and coefficients."""
    cut = place_cut([[-0.1 * WIDTH, LENGTH / 2], [CRACK, LENGTH / 2]], mesh.outline)
    space = cut_space(mesh, (cut,), enrichment, cases.ENRICHED * CRACK)
    top, bottom = (rim(space, lambda x, y=y: np.abs(x[:, 1] - y) < 1e-9) for y in (LENGTH, 0.0))
    load = traction_load(space, top, (0, 1)) + traction_load(space, bottom, (0, -1))
    held = supports(space, [(WIDTH, 0), (WIDTH, 0), (WIDTH, LENGTH)], [0, 1, 0])
    problem = plate_problem(space, (cut,), cases.STEEL, [held], load, enrichment)
    return problem, displaced(problem)


def plate_chain(h, degree, graded=None):
    """Problem a by the chain; `graded`: the size at the tip and its growth."""
    outline, tip = cases.rectangle(0, 0, WIDTH, LENGTH), (CRACK, LENGTH / 2)
    focus = ((*tip, *graded),) if graded else ()
    chain = Chain(split_mesh(outline, [[0, LENGTH / 2], tip], h, focus=focus), STEEL, degree)
    for y, sign in ((LENGTH, 1), (0.0, -1)):
        chain.pull(np.abs(chain.middle[:, 1] - y) < 1e-9, (0, sign))
    chain.pin((WIDTH, 0), (0, 1))
    chain.pin((WIDTH, LENGTH), (0,))
    return chain, chain.solve()


def plate_error(found) -> float:
    """Relative error of K_I."""
    model, u = found
    if isinstance(model, Chain):
        K_I, _ = conforming_intensity(model, u, (CRACK, LENGTH / 2), (1, 0), 0.2 * CRACK, 0.6 * CRACK)
    else:
        K_I, _ = stress_intensity(model.space, cases.STEEL, u, 0, cases.DISC * CRACK)
    return abs(K_I / (FACTOR * np.sqrt(np.pi * CRACK)) - 1)


def singularity(mesh, enrichment):
    """Problem d for a cut in a mesh that is there."""
    cut = place_cut([[-1.2, 0.0], [0.0, 0.0]], mesh.outline)
    space = cut_space(mesh, (cut,), enrichment, 0.5)
    everywhere = rim(space, lambda x: np.ones(len(x), bool))
    exact = given_on_rim(space, everywhere, lambda x, i: fields.williams(x, cases.STEEL, 1.0, 0.5, i[:, 1] > 0))
    problem = plate_problem(space, (cut,), cases.STEEL, [exact], np.zeros(space.enrichment.n_dof), enrichment)
    return problem, displaced(problem)


def singularity_chain(h, degree, graded=None):
    """Problem d by the chain; `graded`: the size at the tip and its growth."""
    focus = ((0, 0, *graded),) if graded else ()
    chain = Chain(split_mesh(cases.rectangle(-1, -1, 1, 1), [[-1, 0], [0, 0]], h, focus=focus), STEEL, degree)
    outer = np.abs(chain.middle).max(axis=1) > 1 - 1e-9
    chain.hold(outer, lambda x, i: fields.williams(x, cases.STEEL, 1.0, 0.5, i[:, 1] > 0))
    return chain, chain.solve()


def singularity_error(found) -> float:
    """Energy norm of the error over that of the exact field."""
    model, u = found
    if not isinstance(model, Chain):
        return energy_error(model, u, lambda x: fields.williams_strain(x, cases.STEEL, 1.0, 0.5))
    basis = Basis(model.mesh, model.element, intorder=14)
    lam, mu = model.tissue.lame

    def energy(gradient):
        e = (gradient + gradient.swapaxes(0, 1)) / 2
        return lam * (e[0, 0] + e[1, 1]) ** 2 + 2 * mu * np.einsum("ij...,ij...->...", e, e)

    def exact(x):
        return singular(x, (0, 0), (1, 0), model.tissue, 1.0, 0.5)[1]

    error = Functional(lambda w: energy(np.asarray(w["u"].grad) - exact(w.x))).assemble(basis, u=basis.interpolate(u))
    return float(np.sqrt(error / Functional(lambda w: energy(exact(w.x))).assemble(basis)))


def retracted(mesh, enrichment):
    """Problem p for a cut in a mesh that is there."""
    problem = retraction.posed(mesh, HELD, enrichment)
    return problem, displaced(problem)


def live(organ, enrichment):
    """Problem p for a cut in an organ that was condensed before: its motion and the cut's unknowns."""
    cut, blades = retraction.drawn(organ.mesh, HELD)
    incision = incise(organ, (cut,), rules.Basis(enrichment))
    modes = lip_modes(incision, blades)
    answer = modes.free(np.concatenate([[*blade.displacement_mm, 0.0] for blade in blades]))
    U, own = (field[..., 0] for field in modes.carried(answer.u[:, None]))
    return LiveMotion(Soup(organ, incision), U, own), answer.u


def retracted_chain(h, degree, focus=()):
    """Problem p by the chain."""
    end, switch = np.array([0.0, MOUTH[1] - HELD * (MOUTH[1] - TIP[1])]), switches()
    chain = Chain(split_mesh(disc(), np.array([MOUTH, TIP]), h, [*switch, end], focus), BRAIN, degree)
    on_lip = (np.abs(chain.middle[:, 0]) < 1e-9) & (chain.middle[:, 1] < MOUTH[1] - 1e-9)
    reach = np.linalg.norm(switch[0] - MOUTH)
    chain.hold(~on_lip & (np.linalg.norm(chain.middle - MOUTH, axis=1) > reach), lambda x, _: np.zeros_like(x))
    lift = np.asarray(LIFT)
    chain.hold(on_lip & (chain.middle[:, 1] > end[1]), lambda x, i: np.where(i[:, :1] > 0, lift, -lift))
    return chain, chain.solve()


def retracted_error(found) -> float:
    """Root of the mean square of the displacement's error, mm, at points away from the cut and the switches."""
    model, u = found
    x = np.random.default_rng(0).uniform(-69, 69, (6_000, 2))
    x = x[np.hypot(*x.T) < 69.0]
    from_cut = np.hypot(x[:, 0], np.maximum(TIP[1] - x[:, 1], 0))
    from_switch = np.linalg.norm(x[:, None] - switches(), axis=2).min(axis=1)
    x = x[(from_cut > FAR_MM) & (from_switch > FAR_MM)]
    known = retraction.reference(HELD).field(x)
    if isinstance(model, LiveMotion):
        got = model.to_current(x) - x
    else:
        got = model.field(u)(x) if isinstance(model, Chain) else basis_at(model.space, x) @ u
    return float(np.sqrt(np.nanmean(((got - known) ** 2).sum(axis=1))))


def focus(n):
    """Where the graded meshes of problem p are finer, as xfemnav's own."""
    s = np.sqrt(8_500 / n)
    return tuple((*point, size * s**2, growth * s) for point, size, growth in retraction._data_ends(HELD))


def ways(problem: str, n: int) -> dict:
    """What is timed at about n nodes: name -> call. xfemnav's mesh is made before."""
    if problem == "p":
        area, made = np.pi * 70**2, {"uniform": retraction.uniform(n), "graded": retraction.graded(n, HELD)}
        h, s = np.sqrt(2 / np.sqrt(3) * area / n), np.sqrt(8_500 / n)
        organ = retraction.condensed(made["graded"])
        return {
            "xfemnav, live, graded": lambda: live(organ, "topological"),
            "xfemnav, topological, graded": lambda: retracted(made["graded"], "topological"),
            "xfemnav, topological": lambda: retracted(made["uniform"], "topological"),
            "xfemnav, geometric, graded": lambda: retracted(made["graded"], "geometric"),
            "chain, P1": lambda: retracted_chain(h, 1),
            "chain, P2": lambda: retracted_chain(2 * h, 2),
            "chain, P1, graded": lambda: retracted_chain(2.6 * s, 1, focus(n)),
            "chain, P2, graded": lambda: retracted_chain(5.2 * s, 2, focus(n / 4)),
        }
    outline = cases.rectangle(0, 0, WIDTH, LENGTH) if problem == "a" else cases.rectangle(-1, -1, 1, 1)
    solved, chained = (plate, plate_chain) if problem == "a" else (singularity, singularity_chain)
    mesh, h = cases.uniform_mesh(outline, n), np.sqrt(2 / np.sqrt(3) * np.prod(np.ptp(outline, axis=0)) / n)
    s, crack = np.sqrt(500 / n), CRACK if problem == "a" else 1.0
    return {
        "xfemnav, topological": lambda: solved(mesh, "topological"),
        "xfemnav, geometric": lambda: solved(mesh, "geometric"),
        "chain, P1": lambda: chained(h, 1),
        "chain, P2": lambda: chained(2 * h, 2),  # as many unknowns
        "chain, P2, graded": lambda: chained(crack / 2 * s, 2, (1e-3 * crack * s**2, 0.4 * s)),
    }


PROBLEMS = {
    "a": (plate_error, "K_I, relative error"),
    "d": (singularity_error, "energy norm of the error"),
    "p": (retracted_error, f"displacement error rms, mm, {FAR_MM:g} mm off the cut"),
}


def study(problem: str) -> list[tuple]:
    """Rows: way, unknowns, seconds, error."""
    rows = []
    for n in SIZES:
        found = {}

        def kept(name, run, found=found):
            found[name] = run()

        runs = {name: lambda name=name, run=run: kept(name, run) for name, run in ways(problem, n).items()}
        seconds = interleaved(runs, REPEATS)
        rows += [(name, got[1].size, seconds[name], PROBLEMS[problem][0](got)) for name, got in found.items()]
    return rows + (getfem_rows() if problem == "d" else [])


def getfem_rows() -> list[tuple]:
    """Problem d by GetFEM in Debian's Python, a process for each size; none of those that it does not solve."""
    script, rows = Path(__file__).with_name("getfem_singularity.py"), []
    bare = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for n in SIZES[:3]:  # the next one takes it minutes
        told = subprocess.run([DEBIAN, str(script), str(n)], capture_output=True, text=True, env=bare)
        found = [json.loads(line) for line in told.stdout.splitlines() if line.startswith("{")]
        rows += [("GetFEM, P1, fixed area", row["unknowns"], row["seconds"], row["error"]) for row in found]
    return rows


def seconds_for(rows, name, error) -> float:
    """Seconds that a way needs for an error, between its sizes by power laws; NaN where it was not reached."""
    own = sorted((e, t) for way, _, t, e in rows if way == name)
    e, t = np.log(np.array(own)).T
    return float(np.exp(np.interp(np.log(error), e, t, left=np.nan, right=t[-1])))


def drawn(found: dict) -> None:
    """The plot."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.4), layout="constrained")
    for axis, (problem, rows) in zip(axes, found.items()):
        for name in dict.fromkeys(row[0] for row in rows):
            own = [row for row in rows if row[0] == name]
            ours = name.startswith("xfemnav")
            axis.loglog([r[2] for r in own], [r[3] for r in own], "o-" if ours else "s--", label=name,
                        color=COLOURS[name], lw=2 if ours else 1.2)
        axis.set(title=f"problem {problem}", xlabel="seconds for a changed cut", ylabel=PROBLEMS[problem][1])
        axis.grid(alpha=0.3, which="both", lw=0.4)
        axis.legend(fontsize=7, loc="lower left")
    PLOT.parent.mkdir(exist_ok=True)
    figure.savefig(PLOT, dpi=110)


def main() -> None:
    """Print the tables and draw them."""
    found, text = {problem: study(problem) for problem in PROBLEMS}, []
    for problem, rows in found.items():
        text.append(f"### Problem {problem}: {PROBLEMS[problem][1]}\n")
        text.append(table(("way", "unknowns", "seconds", "error"), rows))
        best = min((row for row in rows if row[0].startswith("xfemnav")), key=lambda row: row[3])
        chains = [name for name in dict.fromkeys(row[0] for row in rows) if not name.startswith("xfemnav")]
        for _, _, t, error in [row for row in rows if row[0] == best[0]]:
            needs = ", ".join(f"{name} {seconds_for(rows, name, error) / t:.1f} x" for name in chains)
            text.append(f"- an error of {error:.2g}: {best[0]} {t:.2g} s; {needs}")
        text.append("")
    drawn(found)
    keep("accuracy_time", "\n".join(text).replace("nan x", "not reached"), [])


if __name__ == "__main__":
    main()
