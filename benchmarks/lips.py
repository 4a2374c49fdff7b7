"""The three lip conditions under shifts of the mesh: worst error of the retraction disc beside the reference.

    python -m benchmarks.lips

Problem p's disc is its own image under turns by whole degrees, so the mesh is turned under the cut: 20 turns, and 5 by
which a node of the mesh comes to lie 2e-3 h from the held lip, so that the cut leaves slivers. Prints a table and keeps
it in benchmarks/results/lips.json; `python -m benchmarks.accuracy --page` writes it into docs/measured/accuracy.md.
"""

import json
import warnings
from pathlib import Path

import numpy as np

from benchmarks.reference.cases import MOUTH, TIP
from benchmarks.verification import retraction
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.geometry.mesh import Mesh
from xfemnav.mechanics.solving.solution import solve

RESULTS = Path("benchmarks/results/lips.json")
CONDITIONS = ("mortar", "nitsche", "pointwise")
FRACTIONS = (0.25, 0.5, 0.75)
#: Number of nodes, and how many of the 25 turns are used there.
MESHES = ((2_600, 25), (8_800, 5))
SLIVER = 2e-3
#: The skull's switch has an error of its own: points as near as this to it are left out, mm.
SWITCH_MM = 6.0


def turned(mesh: Mesh, degrees: float) -> Mesh:
    """The mesh turned about the disc's centre."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return Mesh(mesh.points @ np.array([[c, s], [-s, c]]), mesh.cells)


def turns(mesh: Mesh, held: float) -> list[float]:
    """25 angles, degrees: every fifth puts a node beside the held lip at SLIVER h."""
    h = float(np.median(mesh.sizes))
    radius, angle = np.hypot(*mesh.points.T), np.rad2deg(np.arctan2(mesh.points[:, 1], mesh.points[:, 0]))
    end = MOUTH[1] - held * (MOUTH[1] - TIP[1])
    beside = np.flatnonzero((radius > end + h) & (radius < MOUTH[1] - h))
    found = []
    for k in range(25):
        whole = 360 * k // 25
        if k % 5 == 4:
            # The cut lies on the ray at 90 degrees: bring the nearest node there, but for the offset.
            to_cut = np.mod(90 - angle[beside] - whole + 180, 360) - 180
            near = int(np.argmin(np.abs(to_cut)))
            whole += to_cut[near] - np.rad2deg(SLIVER * h / radius[beside[near]])
        found.append(float(whole))
    # Those with slivers first, so that a shorter list keeps some.
    return found[4::5] + [angle for k, angle in enumerate(found) if k % 5 != 4]


def study():
    """Rows: condition, mesh, held fraction, worst and median error over the turns, lip error, failures."""
    for n, count in MESHES:
        mesh = retraction.uniform(n)
        for held in FRACTIONS:
            field = retraction.reference(held).field
            for condition in CONDITIONS:
                worst, lip, failures = [], [], 0
                for angle in turns(mesh, held)[:count]:
                    try:
                        problem = retraction.posed(turned(mesh, angle), held, "topological", condition)
                        solution = solve(problem)
                    except XfemnavError:
                        failures += 1
                        continue
                    c = retraction.compare(problem, solution, field)
                    far = (c.from_cut > 2 * c.size) & (c.from_switch > SWITCH_MM)
                    worst.append(float(c.error[far].max()))
                    lip.append(solution.lip_error_rms_mm)
                yield {
                    "condition": condition,
                    "nodes": len(mesh.points),
                    "turns": count,
                    "held": held,
                    "worst": max(worst),
                    "median": float(np.median(worst)),
                    "lip": max(lip),
                    "failures": failures,
                }


if __name__ == "__main__":
    warnings.simplefilter("ignore", XfemnavWarning)
    rows = []
    for row in study():
        rows.append(row)
        print("  ".join(f"{x:.4g}" if isinstance(x, float) else str(x) for x in row.values()), flush=True)
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(rows, indent=0) + "\n")
