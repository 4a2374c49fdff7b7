"""Problem g: a closed inclined crack in compression, frictionless; the lips press on each other and slide.

In the crack's own axes the pressure goes through as if there were no crack, and the shear stress alone feels it: the
field is the uniform one plus Westergaard's of mode II, so that K_I = 0 and K_II = sigma sqrt(pi a) sin beta cos beta.
"""

import numpy as np

from benchmarks.verification import fields
from benchmarks.verification.cases import DISC, ENRICHED, STEEL, rectangle, uniform_mesh
from benchmarks.verification.outcome import Outcome, Value
from benchmarks.verification.plates import cut_space, given_on_rim, plate_problem, rim
from xfemnav.geometry.cut import Cut
from xfemnav.mechanics.contact import lip_contacts, lip_gaps, lip_pressure
from xfemnav.mechanics.elasticity import Material
from xfemnav.mechanics.fracture import stress_intensity
from xfemnav.mechanics.solution import solve

ANGLES = (0, 15, 30, 45, 60, 75)


def closed_crack(points, material: Material, half_length: float, beta: float, pressure: float) -> np.ndarray:
    """Displacement (n, 2) of an infinite plate under `pressure` along y with a closed crack at angle beta rad."""
    closed = fields.inclined_crack(points, material, half_length, beta, -pressure)
    # Without shear on it the crack that a tension along its normal opens: the part that contact takes away.
    normal = -pressure * np.cos(beta) ** 2
    Q = np.array([[np.cos(beta), np.sin(beta)], [-np.sin(beta), np.cos(beta)]])
    p = np.asarray(points, float) @ Q.T
    opened = fields.inclined_crack(p, material, half_length, 0.0, normal)
    strain = np.linalg.solve(material.stiffness, [0.0, normal, 0.0])
    return closed - (opened - p * strain[:2]) @ Q


def pressed(n: int, enrichment: str, angle_deg: float = 30.0) -> Outcome:
    """Problem g: centre crack of half-length 1 in unit compression; the exact displacement is given on the outline."""
    beta = np.deg2rad(angle_deg)
    along = np.array([np.cos(beta), np.sin(beta)])
    mesh = uniform_mesh(rectangle(-3, -3, 3, 3), n)
    cut = Cut(np.array([-along, along]), mouth=False, craniotomy=False)
    space = cut_space(mesh, (cut,), enrichment, ENRICHED)
    exact = given_on_rim(
        space, rim(space, lambda x: np.ones(len(x), dtype=bool)), lambda x, _: closed_crack(x, STEEL, 1.0, beta, 1.0)
    )
    none = np.zeros(space.subcells.n_parts, dtype=bool)
    contacts = lip_contacts(space, (), np.empty((0, 2)), none)
    load = np.zeros(space.enrichment.n_dof)
    problem = plate_problem(space, (cut,), STEEL, [exact], load, enrichment, contacts)
    solution = solve(problem)
    tip = int(np.argmax(space.subcells.tips @ along))

    def pressure(arc):
        return lip_pressure(contacts, solution.contact_force, 0, arc)

    K = stress_intensity(space, STEEL, solution.U, tip, DISC, pressure)
    # Relative to sigma sqrt(pi a): K_I vanishes, and K_II at 0 degrees.
    unit, exact_K = np.sqrt(np.pi), (0.0, -np.sin(beta) * np.cos(beta))
    values = [
        Value(f"{name} / sqrt(pi a), {angle_deg:g} deg", k / unit, k0, abs(k / unit - k0))
        for name, k, k0 in zip(("K_I", "K_II"), K, exact_K)
    ]
    arc, gap = lip_gaps(space, solution.U, 0)
    p = np.cos(beta) ** 2
    values += [
        Value(f"smallest mean gap, {angle_deg:g} deg", solution.min_gap_mm, 0.0, max(0.0, -solution.min_gap_mm)),
        Value(f"deepest penetration / a, {angle_deg:g} deg", gap.min(), 0.0, max(0.0, -gap.min())),
        Value(f"pressure, rms, {angle_deg:g} deg", p, p, float(np.sqrt(np.mean((pressure(arc) - p) ** 2)))),
    ]
    return Outcome(problem, solution, tuple(values))
