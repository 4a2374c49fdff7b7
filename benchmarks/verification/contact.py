"""Contact: problem g, and lips of the retraction disc that are pushed against each other.

Problem g: a closed inclined crack in compression, frictionless; the lips press on each other and slide.

In the crack's own axes the pressure goes through as if there were no crack, and the shear stress alone feels it: the
field is the uniform one plus Westergaard's of mode II, so that K_I = 0 and K_II = sigma sqrt(pi a) sin beta cos beta.
"""

import numpy as np

from benchmarks.probes import lip_gaps
from benchmarks.verification import fields, plane
from benchmarks.verification.cases import DISC, ENRICHED, STEEL, rectangle, uniform_mesh
from benchmarks.verification.outcome import Outcome, Value
from benchmarks.verification.plates import cut_space, given_on_rim, plate_problem, rim
from data_synthetic import domains
from xfemnav.geometry.plane.cut import Cut, place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.imaging.carrying.warp import pull_back
from xfemnav.mechanics.conditions.contact import lip_contacts, lip_pressure
from xfemnav.mechanics.conditions.problem import pose
from xfemnav.mechanics.rules import LipRules, Retraction, Rules, Skull
from xfemnav.mechanics.solving.intensity import stress_intensity
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

ANGLES = (0, 15, 30, 45, 60, 75)


def closed_crack(points, material: Material, half_length: float, beta: float, pressure: float) -> np.ndarray:
    """Displacement (n, 2) of an infinite plate under `pressure` along y with a closed crack at angle beta rad."""
    closed = fields.inclined_crack(points, material, half_length, beta, -pressure)
    # Without shear on it the crack that a tension along its normal opens: the part that contact takes away.
    normal = -pressure * np.cos(beta) ** 2
    Q = np.array([[np.cos(beta), np.sin(beta)], [-np.sin(beta), np.cos(beta)]])
    p = np.asarray(points, float) @ Q.T
    opened = fields.inclined_crack(p, material, half_length, 0.0, normal)
    strain = np.linalg.solve(plane.stiffness(material), [0.0, normal, 0.0])
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
    none = np.zeros(space.parts.n_parts, dtype=bool)
    contacts = lip_contacts(space, (), np.empty((0, 2)), none)
    load = np.zeros(space.enrichment.n_dof)
    problem = plate_problem(space, (cut,), STEEL, [exact], load, enrichment, contacts)
    solution = solve(problem)
    tip = int(np.argmax(space.parts.fronts.at @ along))

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


#: Cuts of the retraction disc, one lip pushed 3 mm against the other over a part of their length.
PUSHED = {
    "straight": [(0.0, 80.0), (0.0, 30.0)],
    "bent": [(0.0, 80.0), (0.0, 55.0), (12.0, 35.0)],
    "curved": [(25 * np.sin(t) - 10, 80 - 50 * t / 1.2) for t in np.linspace(0, 1.2, 30)],
    "askew": [(3.0, 80.0), (1.7, 32.3)],
}


def pushes():
    """Rows of one-sided retractions on the mesh of a run: how far the lips pass each other, with contact and without.

    penetration: deepest gap below zero at Gauss points, mm; area: its integral, mm^2; overlap: pixels of 1 mm that
    hold tissue twice.
    """
    mesh = distmesh(domains.disc(), SizeField(3.0, 1.0, 12.0, (np.array([(0.0, 70.0), (0.0, 30.0)]),)))
    for name, path in PUSHED.items():
        cut = place_cut(path, mesh.outline)
        for held in (0.8, 0.5):
            blade = (Retraction(0, 1, displacement_mm=(-3.0, 0.0), blade=(0.0, held)),)
            row = {"cut": name, "held": held, "nodes": len(mesh.points)}
            for lips in ("contact", "free"):
                problem = pose(mesh, (cut,), Material(), Skull(), blade, rules=Rules(lips=LipRules(lips)))
                solution = solve(problem)
                arc, gap = lip_gaps(problem.space, solution.U, 0)
                pixels = pull_back(solution.rest, solution.moved, (-75, -75), (1.0, 1.0), (151, 151)).overlap
                row[f"penetration, {lips}"] = float(max(0.0, -gap.min()))
                row[f"area, {lips}"] = float(np.trapezoid(np.maximum(0.0, -gap), arc))
                row[f"overlap, {lips}"] = int(pixels.sum())
                if lips == "contact":
                    (touch,) = solution.contact
                    row |= {"gap": solution.min_gap_mm, "length": touch.length_mm, "pressure": touch.mean_pressure_kPa}
            yield row
