"""Conditioning: raw basis, unit diagonal, node blocks; for any radius of enrichment and any sliver."""

import numpy as np

from benchmarks.verification import cases
from benchmarks.verification.outcome import cg_iterations, condition_number, reduced_system
from benchmarks.verification.plates import cut_space, given_on_rim, plate_problem, rim
from xfemnav.geometry.plane.cut import Cut

OFFSETS = (1e-1, 1e-2, 2e-3, 5e-4, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14)


def by_radius(n: int = 6_700):
    """Condition numbers and CG steps of a cracked square, outline held, over the enrichment: dicts."""
    mesh = cases.uniform_mesh(cases.rectangle(-1, -1, 1, 1), n)
    cut = Cut(np.array([[-0.413, -0.207], [0.391, 0.224]]), mouth=False, craniotomy=False)
    for label, enrichment, radius in (
        ("Heaviside only", "none", None),
        ("topological", "topological", None),
        *((f"geometric, radius {r:g}", "geometric", r) for r in (0.05, 0.1, 0.2, 0.4, 0.7)),
    ):
        problem = _held_square(mesh, cut, enrichment, radius)
        row = {"case": label, "nodes": len(mesh.points)}
        for scaling in ("none", "jacobi", "block"):
            A, b = reduced_system(problem, scaling)
            row[f"condition, {scaling}"] = condition_number(A)
            row[f"steps, {scaling}"] = cg_iterations(A, b, limit=5_000)
        yield row


def slivers(k: int = 40):
    """The same, node blocks, for a cut at an offset (in h) above a line of edges, beside the same cut in mid-cell."""
    mesh = cases.structured(k)
    h = 2 / k
    for enrichment, radius in (("none", None), ("topological", None), ("geometric", 0.2)):
        for offset in (0.37, *OFFSETS):
            y = offset * h
            cut = Cut(np.array([[-0.513, y], [0.519, y]]), mouth=False, craniotomy=False)
            problem = _held_square(mesh, cut, enrichment, radius)
            A, b = reduced_system(problem)
            condition, steps = condition_number(A), cg_iterations(A, b, limit=5_000)
            yield {"case": enrichment, "offset": offset, "condition": condition, "steps": steps}


def _held_square(mesh, cut, enrichment, radius):
    """The outline moved as a shear and stretch would; the cut opens."""
    space = cut_space(mesh, (cut,), enrichment, radius)
    stretch = np.array([[0.0, 0.3], [0.0, 1.0]])
    held = given_on_rim(space, rim(space, lambda x: np.ones(len(x), bool)), lambda x, _: x @ stretch.T)
    return plate_problem(space, (cut,), cases.STEEL, [held], np.zeros(space.enrichment.n_dof), enrichment)
