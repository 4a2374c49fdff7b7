"""Accuracy of the mechanics on problems with known answers, and the page docs/measured/accuracy.md with its figure.

    python -m benchmarks.accuracy [problem ...] [--page]

Problems: a a3 b c d e f1 f2 p-uniform p-graded angles fractions conditioning slivers placements short g pushes; all
without a name (about a quarter of an hour on one core). Results are kept in benchmarks/results/accuracy.json, one entry
a case; the page is written from all of them, with --page alone from what is there. The conforming references of p are
computed once, into out/reference.
"""

import json
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.reference.cases import FRACTIONS
from benchmarks.verification import cases, conditioning, contact, retraction
from benchmarks.verification.outcome import Value, cg_iterations, condition_number, reduced_system
from benchmarks.verification.page import write_page
from benchmarks.verification.placements import placements
from benchmarks.verification.short_cuts import short_cuts

SIZES = (2_000, 8_000, 32_000)
ENRICHMENTS = ("topological", "geometric", "none")
RESULTS = Path("benchmarks/results/accuracy.json")

PROBLEMS = {
    "a": cases.tension,
    "a3": partial(cases.tension, width=1.0, length=2.0, crack=0.3, factor=1.66112),
    "b": cases.shear,
    "c": cases.inclined,
    "d": cases.williams,
    "f1": cases.arc,
    "f2": cases.branched,
    "p-uniform": lambda n, enrichment: retraction.retracted(retraction.uniform(n), enrichment),
    "p-graded": lambda n, enrichment: retraction.retracted(retraction.graded(n, 0.5), enrichment),
}


def convergence(problem: str):
    """Rows of a problem at all sizes and enrichments."""
    for enrichment in ENRICHMENTS:
        for n in SIZES:
            outcome = PROBLEMS[problem](n, enrichment)
            A, b = reduced_system(outcome.problem)
            solver = {"condition": condition_number(A), "iterations": cg_iterations(A, b)}
            yield from _rows(problem, enrichment, n, outcome, **solver)


def rigid_openings(problem: str):
    """Rows of problem e: no tips, so no tip enrichment."""
    for course in ("anywhere", "through nodes", "along edges"):
        for n in SIZES:
            yield from _rows(problem, "any", n, cases.rigid_opening(n, "topological", course))


def angles(problem: str):
    """Rows of problem c at all angles, 8k nodes."""
    for enrichment in ("geometric", "topological"):
        for angle in range(0, 76, 15):
            yield from _rows(problem, enrichment, 8_000, cases.inclined(8_000, enrichment, angle))


def fractions(problem: str):
    """Rows of problem p for every held fraction, on the meshes of a run, on a uniform and on a fine graded one."""
    for held in FRACTIONS:
        ends = retraction.corridor_graded(held)
        for name, mesh, enrichment in (
            ("uniform, 8k", retraction.uniform(8_800), "topological"),
            ("corridor", retraction.corridor(), "topological"),
            ("corridor, data ends", ends, "topological"),
            ("corridor, data ends", ends, "geometric"),
            ("graded, 22k", retraction.graded(22_000, held), "geometric"),
        ):
            outcome = retraction.retracted(mesh, enrichment, held)
            yield from _rows(problem, f"{name} ({enrichment})", held, outcome)


def closed(problem: str):
    """Rows of problem g at all angles, 8k nodes, and at one angle for all sizes."""
    for enrichment in ("geometric", "topological"):
        for n, angles_of in ((2_000, (30,)), (8_000, contact.ANGLES), (32_000, (30,))):
            for angle in angles_of:
                yield from _rows(problem, enrichment, n, contact.pressed(n, enrichment, angle), angle=angle)


def table(problem: str):
    """Rows of the tables of conditioning, of places of the tip, of short cuts."""
    rows = {"conditioning": conditioning.by_radius, "slivers": conditioning.slivers, "placements": placements,
            "short": short_cuts, "pushes": contact.pushes}[problem]
    for row in rows():
        yield {"problem": problem, **row}


RUNS = {
    **dict.fromkeys(PROBLEMS, convergence),
    "e": rigid_openings,
    "angles": angles,
    "fractions": fractions,
    "conditioning": table,
    "slivers": table,
    "placements": table,
    "short": table,
    "g": closed,
    "pushes": table,
}


def _rows(problem, enrichment, n, outcome, **solver):
    case = {"problem": problem, "enrichment": enrichment, "n": n, "nodes": len(outcome.problem.mesh.points)}
    for value in outcome.values:
        yield {**case, **_plain(value), **solver}


def _plain(value: Value):
    return {"quantity": value.name, **{k: float(getattr(value, k)) for k in ("value", "reference", "error")}}


def main(arguments):
    """Run the problems named, keep their rows, write the page."""
    chosen = [name for name in arguments if name != "--page"] or ([] if "--page" in arguments else list(RUNS))
    for problem in chosen:
        started, rows = time.perf_counter(), []
        for row in RUNS[problem](problem):
            rows.append(row)
            print("  ".join(f"{x:.4g}" if isinstance(x, float) else str(x) for x in row.values()), flush=True)
        print(f"{problem}: {time.perf_counter() - started:.0f} s", flush=True)
        kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps({**kept, problem: rows}, indent=0, sort_keys=True, default=_number) + "\n")
    write_page(json.loads(RESULTS.read_text()))


def _number(x):
    return x.item() if isinstance(x, np.generic) else str(x)


if __name__ == "__main__":
    main(sys.argv[1:])
