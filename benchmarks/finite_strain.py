"""Where linear elasticity ends: the neo-Hookean model beside it, on the retraction disc, by opening, tip and mesh.

    python -m benchmarks.finite_strain [--page]

Writes benchmarks/results/finite_strain.json and docs/measured/finite-strain.md.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import shapely

from benchmarks.probes import basis_at
from benchmarks.verification.finite_strain_page import write_page
from benchmarks.verification.retraction import PATH, corridor, corridor_graded, posed, uniform
from xfemnav.errors import XfemnavError
from xfemnav.mechanics.solving import hyperelastic
from xfemnav.mechanics.solving.solution import solve

RESULTS = Path("benchmarks/results/finite_strain.json")
HELD = 0.5


def of(problem, model):
    """The problem with tissue of another model."""
    return replace(problem, rules=replace(problem.rules, model=model))


def neo_hookean(mesh, lift, ramp_mm=4.0, enrichment="none"):
    """The retraction disc with the left lip moved by `lift` mm, the right one back."""
    problem = posed(mesh, HELD, enrichment, ramp_mm=ramp_mm, lift=lift)
    return of(problem, "neo-hookean")


def timed(problem):
    """The solution, or the text of why there is none, and the seconds that it took."""
    start = perf_counter()
    try:
        found = solve(problem)
    except XfemnavError as error:
        found = str(error)
    return found, perf_counter() - start


def reached(text: str) -> float:
    """Percentage of the load that an E410 says had an equilibrium."""
    return float(text.split("beyond ")[1].split(" %")[0])


def openings():
    """Rows: the linear and the neo-Hookean answer by opening and ramp, on a run's own mesh."""
    mesh = corridor()
    for ramp in (4.0, 0.0):
        for half in (0.2, 1.0, 2.0, 3.5, 5.0, 6.5, 8.0, 10.0):
            problem = neo_hookean(mesh, (half, 0.0), ramp)
            (linear, quick), (found, slow) = timed(of(problem, "linear")), timed(problem)
            row = {"ramp": ramp, "opening": 2 * half, "linear s": quick, "s": slow}
            if isinstance(found, str):
                yield row | {"reached": reached(found), "linear inverted": linear.inverted_mm2}
                continue
            away = shapely.LineString(PATH).distance(shapely.points(found.rest)) > 10
            change = np.linalg.norm(found.moved - linear.moved, axis=2)
            yield row | {
                "reached": 100.0, "det F": found.det_F.min(),
                "linear inverted": linear.inverted_mm2, "inverted": found.inverted_mm2,
                "difference": found.linear_difference_mm, "beyond 10 mm": change[away].max(),
                "linear strain": linear.largest_strain, "strain": found.largest_strain,
                "linear kPa": linear.retractor[0].mean_pressure_kPa, "kPa": found.retractor[0].mean_pressure_kPa,
                "steps": found.load_steps, "iterations": found.newton_iterations,
            }


def tips():
    """Rows: what tip functions change, and how far they come."""
    mesh = corridor()
    for lift in ((1.0, 0.0), (3.5, 0.0), (5.0, 0.0), (1.0, -0.3), (3.5, -1.0), (5.0, -1.5)):
        (plain, _), (found, _) = (timed(neo_hookean(mesh, lift, 4.0, e)) for e in ("none", "topological"))
        row = {"across": lift[0], "along": lift[1]}
        if isinstance(found, str):
            yield row | {"reached": reached(found)}
            continue
        n = len(mesh.points)
        change = np.linalg.norm(found.U[:n] - plain.U[:n], axis=1)
        away = shapely.LineString(PATH).distance(shapely.points(mesh.points)) > 2.0
        yield row | {"reached": 100.0, "energy": found.energy / plain.energy - 1, "beyond 2 mm": change[away].max()}


def meshes():
    """Rows: the same opening on finer meshes; displacements at points beyond 5 mm of the cut, beside the finest's."""
    x = np.stack(np.meshgrid(*[np.linspace(-69, 69, 70)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    x = x[(np.hypot(*x.T) < 69) & (shapely.LineString(PATH).distance(shapely.points(x)) > 5)]
    finest = None
    for name, mesh in (
        ("uniform", uniform(16_000)), ("uniform", uniform(8_000)), ("uniform", uniform(4_000)),
        ("uniform", uniform(2_000)), ("a run's", corridor()), ("graded at data ends", corridor_graded(HELD)),
    ):
        problem = neo_hookean(mesh, (5.0, 0.0))
        (linear, quick), (found, slow) = timed(of(problem, "linear")), timed(problem)
        row = {"mesh": name, "nodes": len(mesh.points), "linear s": quick, "s": slow}
        if isinstance(found, str):
            yield row | {"reached": reached(found), "linear inverted": linear.inverted_mm2}
            continue
        u = basis_at(problem.space, x) @ found.U
        finest = u if finest is None else finest
        yield row | {
            "reached": 100.0, "linear inverted": linear.inverted_mm2, "inverted": found.inverted_mm2,
            "det F": found.det_F.min(), "energy": found.energy, "kPa": found.retractor[0].mean_pressure_kPa,
            "to finest": np.linalg.norm(u - finest, axis=1).max(), "iterations": found.newton_iterations,
        }


def residuals():
    """Rows: the unbalanced forces, relative to the first, before each of Newton's steps and after the last."""
    seen, step = [], hyperelastic._newton_step

    def watched(organ, T, U, start):
        found = step(organ, T, U, start)
        seen[-1].append(np.linalg.norm(T.T @ organ.slope(U)))
        seen[-1].append(np.linalg.norm(T.T @ organ.slope(found.U)))
        return found

    hyperelastic._newton_step = watched
    for half in (1.0, 3.5, 5.0):
        seen.append([])
        solve(neo_hookean(corridor(), (half, 0.0)))
        values = np.array([*seen[-1][::2], seen[-1][-1]])
        yield {"opening": 2 * half, "residuals": (values / values[0]).tolist()}
    hyperelastic._newton_step = step


def main(arguments):
    """Measure, unless --page is given, and write the page."""
    if "--page" not in arguments:
        found = {}
        for study in (openings, tips, meshes, residuals):
            found[study.__name__] = []
            for row in study():
                row = {k: float(v) if isinstance(v, np.floating) else v for k, v in row.items()}
                found[study.__name__].append(row)
                texts = (f"{k} {x:.4g}" if isinstance(x, float) else f"{k} {x}" for k, x in row.items())
                print("  ".join(texts), flush=True)
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps(found, indent=0) + "\n")
    write_page(json.loads(RESULTS.read_text()))


if __name__ == "__main__":
    main(sys.argv[1:])
