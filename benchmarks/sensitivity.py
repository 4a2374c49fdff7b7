"""How much the answer depends on what the user chooses: the blade's end, the craniotomy, nu, plane stress; locking.

    python -m benchmarks.sensitivity [--page]

The choices are compared on the conforming quadratic reference, so that no discretisation error stands between them;
locking is xfemnav's own error against it. Writes benchmarks/results/sensitivity.json and docs/measured/sensitivity.md.
"""

import json
import sys
from pathlib import Path

import numpy as np
import shapely

from benchmarks.reference.cases import BRAIN, FREE, LIFT, retraction
from benchmarks.reference.elasticity import Tissue
from benchmarks.verification.retraction import PATH, compare, corridor, posed, uniform
from benchmarks.verification.sensitivity_page import write_page
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

RESULTS = Path("benchmarks/results/sensitivity.json")
LENGTH = float(np.linalg.norm(PATH[1] - PATH[0]))
HELD = 0.5
POISSON = (0.0, 0.2, 0.3, 0.4, 0.45, 0.47, 0.48, 0.49, 0.495, 0.499)


def choices():
    """Rows: what is changed, and the largest change of displacement, mm, beyond 5, 10 and 20 mm of the cut."""
    x = np.stack(np.meshgrid(*[np.linspace(-69, 69, 139)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    x = x[np.hypot(*x.T) < 69.5]
    away = shapely.LineString(PATH).distance(shapely.points(x))
    x, away = x[away > 5], away[away > 5]
    base = retraction(HELD).field(x)
    for name, changed in (
        ("blade's end .5 mm nearer the tip", lambda: retraction(HELD + 0.5 / LENGTH)),
        ("blade's end .5 mm nearer the mouth", lambda: retraction(HELD - 0.5 / LENGTH)),
        ("blade's end 2 mm nearer the tip", lambda: retraction(HELD + 2 / LENGTH)),
        ("blade's end 5 mm nearer the tip", lambda: retraction(HELD + 5 / LENGTH)),
        ("lips held 10 % farther apart", lambda: retraction(HELD, lift=LIFT * (1.1, 1.0))),
        ("craniotomy 1 mm larger", lambda: retraction(HELD, free_mm=FREE + 1)),
        ("craniotomy 5 mm larger", lambda: retraction(HELD, free_mm=FREE + 5)),
        ("nu .40 instead of .45", lambda: retraction(HELD, Tissue(BRAIN.young, 0.40))),
        ("nu .49 instead of .45", lambda: retraction(HELD, Tissue(BRAIN.young, 0.49))),
        ("plane stress instead of plane strain", lambda: retraction(HELD, Tissue(BRAIN.young, 0.45, "stress"))),
        ("Young's modulus doubled", lambda: retraction(HELD, Tissue(2 * BRAIN.young, 0.45))),
    ):
        change = np.linalg.norm(changed().field(x) - base, axis=1)
        yield {"change": name, **{f"{d}": float(change[away > d].max()) for d in (5, 10, 20)}}


def locking():
    """Rows: nu, and xfemnav's error in energy and (relative rms) displacement on a uniform and the default mesh."""
    meshes = {"uniform": uniform(8_800), "corridor": corridor()}
    for nu in POISSON:
        known = retraction(HELD, Tissue(BRAIN.young, nu))
        row = {"poisson": nu}
        for name, mesh in meshes.items():
            problem = posed(mesh, HELD, "topological", material=Material(BRAIN.young / 1000, nu))
            solution = solve(problem)
            c = compare(problem, solution, known.field)
            size = np.sqrt(np.average((known.field(c.points) ** 2).sum(axis=1), weights=c.weights))
            row[f"energy, {name}"] = 1000 * solution.energy / known.energy - 1
            row[f"displacement, {name}"] = float(np.sqrt(np.average(c.error**2, weights=c.weights)) / size)
            row[f"worst, {name}"] = c.worst(beyond_mm=6.0)
        yield row


def main(arguments):
    """Measure, unless --page is given, and write the page."""
    if "--page" not in arguments:
        found = {}
        for study in (choices, locking):
            found[study.__name__] = []
            for row in study():
                found[study.__name__].append(row)
                print("  ".join(f"{x:.4g}" if isinstance(x, float) else str(x) for x in row.values()), flush=True)
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps(found, indent=0) + "\n")
    write_page(json.loads(RESULTS.read_text()))


if __name__ == "__main__":
    main(sys.argv[1:])
