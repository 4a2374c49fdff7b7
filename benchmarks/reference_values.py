"""The reference problems on the conforming reference alone, at three refinements: what it takes for known.

    python -m benchmarks.reference_values

Prints the table and writes it to benchmarks/results/reference.txt.
"""

from pathlib import Path

import numpy as np

from benchmarks.reference.cases import FRACTIONS, arc_crack, branched_crack, edge_crack, retraction
from benchmarks.reference.elasticity import Tissue

RESULTS = Path("benchmarks/results/reference.txt")
REFINEMENTS = (0.7, 1.0, 1.4)


def values(refinement: float) -> dict[str, float]:
    """Every reference value at a refinement."""
    found = {}
    for name, width, length, crack in (("7 x 16, 3.5", 7, 16, 3.5), ("1 x 2, .5", 1, 2, 0.5), ("1 x 2, .3", 1, 2, 0.3)):
        found[f"a {name}: K_I / sqrt(pi a)"] = edge_crack(width, length, crack, refinement)[0] / np.sqrt(np.pi * crack)
    K_I, K_II, energy = edge_crack(7, 16, 3.5, refinement, shear=True, tissue=Tissue(3e7, 0.25))
    found |= {"b: K_I": K_I, "b: K_II": K_II, "b: strain energy": energy}
    K_I, K_II = arc_crack(refinement=refinement)
    found |= {"f1, 120 segments: K_I": K_I, "f1, 120 segments: abs K_II": abs(K_II)}
    (stem, _), (K_I, K_II) = branched_crack(refinement=refinement)
    unit = np.sqrt(np.pi * (1 + np.cos(np.pi / 4)) / 2)
    found |= {"f2: K_I stem": stem / unit, "f2: K_I branch": K_I / unit, "f2: K_II branch": K_II / unit}
    return found | {f"p, held {x:g}: energy, Pa mm2": retraction(x, refinement=refinement).energy for x in FRACTIONS}


if __name__ == "__main__":
    columns = [values(refinement) for refinement in REFINEMENTS]
    lines = [f"{'refinement':32s}" + "".join(f"{r:>16g}" for r in REFINEMENTS)]
    lines += [f"{name:32s}" + "".join(f"{column[name]:16.8g}" for column in columns) for name in columns[0]]
    RESULTS.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
