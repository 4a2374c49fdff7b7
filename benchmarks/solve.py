"""The linear solve beside scipy's defaults; what enrichment costs, phase by phase; a cut beside the remeshing chain.

    python -m benchmarks.solve

On the retraction disc (problem p of docs/measured/accuracy.md), uniform meshes, topological tip functions.
CHOLMOD is timed where scikit-sparse is installed.
"""

from benchmarks.timing import exponent, interleaved, keep, mark, peak_mb, table  # isort: skip (sets the number of threads)

import importlib.util
import resource
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.sparse.linalg import splu

from benchmarks.accuracy_time import retracted_chain
from benchmarks.chains import displaced
from benchmarks.verification import retraction
from benchmarks.verification.outcome import reduced_system
from xfemnav.geometry.plane.subcells import embed
from xfemnav.mechanics.conditions.constraints import eliminate
from xfemnav.mechanics.solving.factor import by_cholmod, by_superlu
from xfemnav.mechanics.solving.solution import scaled_basis, solve
from xfemnav.mechanics.space.enrichment import enrich
from xfemnav.mechanics.space.space import Space
from xfemnav.mechanics.tissue.elasticity import stiffness, stiffness_of_parts

#: Number of nodes, and repetitions.
TARGETS = {1_000: 9, 5_000: 7, 20_000: 5, 80_000: 5}
HELD = 0.5
SUPERLU = partial(by_superlu, semidefinite=True)  # as a linear run's systems are


def factorisations(problems) -> tuple[str, list[dict]]:
    """Factor and one solve of the reduced system: splu by default, xfemnav's, CHOLMOD's."""
    ways = {"splu, default": splu, "xfemnav": SUPERLU}
    if importlib.util.find_spec("sksparse"):
        ways["xfemnav, CHOLMOD"] = by_cholmod
    rows, marks, sizes, seconds = [], [], [], {name: [] for name in ways}
    for target, problem in problems.items():
        A, b = reduced_system(problem)
        times = interleaved({name: lambda way=way, A=A, b=b: way(A).solve(b) for name, way in ways.items()},
                            TARGETS[target])
        x = {name: way(A).solve(b) for name, way in ways.items()}
        residual = np.linalg.norm(b - A @ x["xfemnav"]) / np.linalg.norm(b)
        apart = max(abs(other - x["xfemnav"]).max() for other in x.values()) / abs(x["xfemnav"]).max()
        ratio = {name: time / times["splu, default"] for name, time in times.items()}
        rows += [(A.shape[0], name, times[name], ratio[name], f"{residual:.0e}" if name == "xfemnav" else "",
                  f"{apart:.0e}" if name == "xfemnav" else "") for name in ways]
        sizes.append(A.shape[0])
        for name in ways:
            seconds[name].append(times[name])
        if target >= 5_000:
            marks.append(mark(f"solve: time over splu's default, {target // 1000}k nodes", 0.65, ratio["xfemnav"]))
            if "xfemnav, CHOLMOD" in ratio:
                marks.append(mark(f"solve: with CHOLMOD, {target // 1000}k nodes", 0.4, ratio["xfemnav, CHOLMOD"]))
    growth = {name: exponent(sizes[1:], times[1:]) for name, times in seconds.items()}
    marks += [mark(f"solve: growth from 5k to 80k nodes, power of N, {name}", 1.4, p)
              for name, p in growth.items() if name != "splu, default"]
    text = table(("unknowns", "solver", "seconds", "over the default", "residual", "largest difference"), rows)
    growths = ", ".join(f"{name} N^{p:.2f}" for name, p in growth.items())
    return f"{text}\nGrowth from 5k to 80k nodes: {growths}.\n", marks


def phases(problems) -> tuple[str, list[dict]]:
    """Seconds and memory of each phase from a mesh and a cut to displacements."""
    rows, grown = [], []
    for target, problem in problems.items():
        mesh, cuts, material = problem.mesh, problem.cuts, problem.material
        split = embed(mesh, cuts)
        space = Space(mesh, split, enrich(mesh, split))
        rich = (space.enrichment.dof >= len(mesh.points)).any(axis=1)
        rich[space.branch_parts] = True
        K = (stiffness(space, material) + problem.springs).tocsc()
        basis = scaled_basis(problem, K)
        A, b = reduced_system(problem)
        factor = SUPERLU(A)
        parts = {
            "find the cut cells": lambda mesh=mesh, cuts=cuts: embed(mesh, cuts),
            "basis functions (H, F)": lambda mesh=mesh, split=split: enrich(mesh, split),
            "stiffness of enriched parts": lambda s=space, m=material, r=rich: stiffness_of_parts(s, m, r),
            "stiffness of plain parts": lambda s=space, m=material, r=rich: stiffness_of_parts(s, m, ~r),
            "conditions eliminated, scaling": lambda p=problem, K=K, B=basis: (
                scaled_basis(p, K), eliminate(replace(p.constraints, C=p.constraints.C @ B))),
            "factor": lambda A=A: SUPERLU(A),
            "solve": lambda f=factor, b=b: f.solve(b),
        }
        first = len(mesh.points), space.enrichment.n_dof - 2 * len(mesh.points)
        rows.append((*first, *interleaved(parts, TARGETS[target]).values()))
        grown.append((*first, *map(peak_mb, parts.values())))
    head = "nodes", "unknowns added", *parts
    return (f"{table(head, rows)}\nMemory: the MB by which each phase makes the process grow at most, what it leaves "
            f"included.\n\n{table(head, grown)}"), []


def cuts(problems) -> tuple[str, list[dict]]:
    """A changed cut: xfemnav on its mesh, beside gmsh + scikit-fem + splu, linear triangles of the same size."""
    rows, sizes, seconds = [], [], []
    for problem in problems.values():
        mesh = problem.mesh
        h = float(np.median(mesh.sizes))
        times = interleaved({
            "xfemnav": lambda mesh=mesh: displaced(retraction.posed(mesh, HELD, "topological")),
            "whole solve stage": lambda mesh=mesh: solve(retraction.posed(mesh, HELD, "topological")),
            "chain": lambda h=h: retracted_chain(h, 1),
        }, 5)
        rows.append((len(mesh.points), *times.values(), times["chain"] / times["xfemnav"]))
        sizes.append(len(mesh.points))
        seconds.append(times["xfemnav"])
    head = "nodes", "xfemnav, s", "with all that a run reports, s", "remeshing chain, s", "chain over xfemnav"
    text = table(head, rows)
    growth = exponent(sizes[1:], seconds[1:])
    found = [mark("a changed cut: growth from 5k to 80k nodes, power of N", 1.25, growth)]
    return text + f"\nGrowth of xfemnav from 5k to 80k nodes: N^{growth:.2f}.\n", found


def main() -> None:
    """Print the three tables."""
    problems = {n: retraction.posed(retraction.uniform(n), HELD, "topological") for n in TARGETS}
    text, marks = [], []
    parts = {"Factor and solve": factorisations, "Phases: seconds and memory": phases, "A changed cut": cuts}
    for title, part in parts.items():
        words, found = part(problems)
        text.append(f"### {title}\n\n{words}")
        marks += found
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    text.append(f"Peak memory of this benchmark, all sizes and peers together: {peak:.0f} MB.\n")
    keep("solve", "\n".join(text), marks)


if __name__ == "__main__":
    main()
