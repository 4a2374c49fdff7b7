"""Plant faults in the mechanics, one at a time, and see that the tests notice: `python benchmarks/mutations.py`.

Each fault is planted in a copy of the project, where the tests of geometry and mechanics run until the first failure.
Prints one line a fault and exits 1 if one went unnoticed.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TESTS = ("branch", "quadrature", "subcells", "enrichment", "space", "elasticity", "constraints", "lips", "outline_conditions",
         "nitsche", "fracture", "reduction", "problem", "solution", "phantom_run")

# What is wrong, file under xfemnav/, the right text, the wrong text.
FAULTS = (
    ("a sign in the gradient of F_3", "mechanics/branch.py", "cos_half * sin / 2 + sin_half * cos", "cos_half * sin / 2 - sin_half * cos"),
    ("a wrong weight in the polar rule", "mechanics/quadrature.py", "w * 2 * s**3", "w * 1.9 * s**3"),
    ("a dropped Jacobian in the collapsed rule", "mechanics/quadrature.py", "return s, t, w * s\n", "return s, t, w / 2\n"),
    ("branch functions without their shift", "mechanics/space.py", "branch_functions(r, theta) - table.shift", "branch_functions(r, theta) - 0 * table.shift"),
    ("swapped lips", "mechanics/lips.py", "own = 0 if side == LEFT else 1", "own = 1 if side == LEFT else 0"),
    ("lips of the paper's rows swapped", "mechanics/lips.py", "np.repeat(split.lips.parts[facets, 0 if side == LEFT else 1], 2)", "np.repeat(split.lips.parts[facets, 1 if side == LEFT else 0], 2)"),
    ("pieces not joined at a cell's third node", "mechanics/enrichment.py", "for local in range(3):", "for local in range(2):"),
    ("shear modulus of plane stress in plane strain", "mechanics/elasticity.py", "[0, 0, (1 - 2 * nu) / 2]])", "[0, 0, (1 - nu) / 2]])"),
    ("shear strain with its derivatives exchanged", "mechanics/elasticity.py", "_spread(gy, gx)]", "_spread(gx, gy)]"),
    ("hats of the mortar condition reversed", "mechanics/lips.py", "np.stack([1 - t, t])", "np.stack([t, 1 - t])"),
    ("targets not permuted with their conditions", "mechanics/constraints.py", "(d[block_rows] / scale)[pivot]", "d[block_rows] / scale"),
    ("angles about a tip not unwrapped", "mechanics/branch.py", "reference + np.mod(raw - reference + np.pi, 2 * np.pi) - np.pi", "raw"),
    ("a facet of the cut still joined", "geometry/bisection.py", "low, high = max(min(t0, t1), 0.0), min(max(t0, t1), length)", "low, high = max(min(t0, t1), 0.1), min(max(t0, t1), length)"),
    ("measured sides of a mouth exchanged", "mechanics/measured.py", "mouth - 1e-7 * sense", "mouth + 1e-7 * sense"),
    ("Nitsche's traction with the wrong sign", "mechanics/nitsche.py", "m = -retraction.side * q.normals", "m = retraction.side * q.normals"),
    ("mode II read with the wrong sign", "mechanics/reduction.py", "M[1, 1, 1], M[1, 2, 1] = kappa + 1, 1, 1 - kappa, 1", "M[1, 1, 1], M[1, 2, 1] = kappa + 1, 1, kappa - 1, 1"),
)


def noticed(fault, folder) -> str:
    """Name of the first test that fails with the fault planted in the copy `folder`; empty if none does."""
    _, path, right, wrong = fault
    source = folder / "xfemnav" / path
    text = source.read_text()
    if text.count(right) != 1:
        raise SystemExit(f"{path} holds {right!r} {text.count(right)} times; mend the list of faults")
    source.write_text(text.replace(right, wrong))
    tests = [str(path) for name in TESTS if (path := folder / f"tests/test_{name}.py").exists()]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env={"PYTHONPATH": str(folder), "PATH": "/usr/bin:/bin"})
    source.write_text(text)
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split(" - ")[0].split(" ", 1)[1] if done.returncode == 1 and failed else ""


def main() -> int:
    """Plant every fault in turn."""
    unnoticed = 0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "xfemnav"
        for name in ("xfemnav", "tests", "data_synthetic", "cli"):
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)
        for fault in FAULTS:
            test = noticed(fault, folder)
            unnoticed += not test
            print(f"{fault[0]:55s} {test or 'UNNOTICED'}", flush=True)
    print(f"{len(FAULTS) - unnoticed} of {len(FAULTS)} faults noticed")
    return int(unnoticed > 0)


if __name__ == "__main__":
    sys.exit(main())
