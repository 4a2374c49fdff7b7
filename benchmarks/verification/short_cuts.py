"""Short edge cuts: the energy that they set free, down to a twentieth of an element."""

import numpy as np

from benchmarks.verification import cases
from benchmarks.verification.plates import cut_space, plate_problem, rim, supports, traction_load
from xfemnav.geometry.plane.cut import Cut
from xfemnav.mechanics.solving.solution import solve

WIDTH, HEIGHT, NODES = 2.0, 3.0, 2_700
LENGTHS = (2.0, 1.0, 0.5, 0.3, 0.1, 0.05)  # in elements
PLACES = np.linspace(1.2, 1.8, 12)  # heights of the mouth: wherever it falls in its facet


def released(length: float) -> float:
    """Energy that an edge crack sets free in a plate under unit tension, of the material `cases.STEEL`, plane strain.

    Integral of K^2 (1 - nu^2) / E with K = F sigma sqrt(pi a), F(a / width) of Tada, Paris and Irwin (to .5 %).
    """
    a, w = np.polynomial.legendre.leggauss(12)
    a, w = length * (a + 1) / 2, length * w / 2
    x = a / WIDTH
    F = 1.1215 - 0.231 * x + 10.55 * x**2 - 21.72 * x**3 + 30.39 * x**4
    return float((w * F**2 * np.pi * a).sum() * (1 - cases.STEEL.poisson**2) / cases.STEEL.young_kpa)


def short_cuts():
    """Relative error of the released energy, worst and median over places of the mouth: dicts."""
    mesh = cases.uniform_mesh(cases.rectangle(0, 0, WIDTH, HEIGHT), NODES)
    h = float(np.median(mesh.sizes))
    whole = _energy(mesh, (), "none")
    for enrichment in ("topological", "geometric"):
        for length in LENGTHS:
            errors = []
            for y in PLACES:
                cut = Cut(np.array([[0.0, y], [length * h, y]]), craniotomy=False)
                errors.append((_energy(mesh, (cut,), enrichment) - whole) / released(length * h) - 1)
            worst = max(errors, key=abs)
            yield {"case": enrichment, "length": length, "median": float(np.median(np.abs(errors))), "worst": worst}


def _energy(mesh, cuts, enrichment) -> float:
    """Strain energy of the plate pulled at both ends."""
    space = cut_space(mesh, cuts, enrichment)
    ends = [(rim(space, lambda x, y=y: np.abs(x[:, 1] - y) < 1e-9), s) for y, s in ((HEIGHT, 1), (0.0, -1))]
    load = sum(traction_load(space, facets, (0, sign)) for facets, sign in ends)
    held = supports(space, [(WIDTH, 0), (WIDTH, 0), (WIDTH, HEIGHT)], [0, 1, 0])
    return solve(plate_problem(space, cuts, cases.STEEL, [held], load, enrichment)).energy
