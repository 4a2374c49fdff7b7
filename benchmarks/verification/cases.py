"""Problems a-f1 with known answers, solved by xfemnav on uniform meshes of about n nodes.

Each function takes the number of nodes and the tip enrichment and returns an Outcome. The radius of geometric
enrichment is fixed, so that it holds ever more elements; the interaction integral's disc is fixed too.
"""

import numpy as np

from benchmarks.verification import fields, plane
from benchmarks.verification.outcome import Outcome, Value, energy_error, relative
from benchmarks.verification.plates import cut_space, given_on_rim, plate_problem, rim, supports, traction_load
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import Cut, place_cut
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField
from xfemnav.mechanics.solving.intensity import stress_intensity
from xfemnav.mechanics.solving.solution import solve
from xfemnav.mechanics.tissue.elasticity import Material

#: Radius of geometric enrichment and of the interaction integral's disc over the crack's (half-) length.
ENRICHED, DISC = 0.6, 0.6
STEEL = Material(1.0, 0.3)


def rectangle(x0, y0, x1, y1) -> np.ndarray:
    """Outline (4, 2) mm."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=float)


def uniform_mesh(outline, n: int) -> Mesh:
    """DistMesh of about n nodes."""
    x, y = np.asarray(outline, float).T
    area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    return distmesh(outline, float(np.sqrt(2 / np.sqrt(3) * area / n)))


def tension(n: int, enrichment: str, width=7.0, length=16.0, crack=3.5, factor=2.82468) -> Outcome:
    """Problem a: edge crack at half length, unit tension on both ends; K_I = factor sqrt(pi a).

    So stiff a plate that it moves by less than its size: what flies farther is refused, and K does not depend on it.
    """
    material = Material(1000 * STEEL.young_kpa, STEEL.poisson)
    cut, space = _edge_cracked(n, width, length, crack, enrichment)
    top, bottom = (rim(space, lambda x, y=y: np.abs(x[:, 1] - y) < 1e-9) for y in (length, 0.0))
    load = traction_load(space, top, (0, 1)) + traction_load(space, bottom, (0, -1))
    held = supports(space, [(width, 0), (width, 0), (width, length)], [0, 1, 0])
    problem = plate_problem(space, (cut,), material, [held], load, enrichment)
    solution = solve(problem)
    K_I, _ = stress_intensity(space, material, solution.U, 0, DISC * crack)
    return Outcome(problem, solution, (relative("K_I", K_I, factor * np.sqrt(np.pi * crack)),))


def shear(n: int, enrichment: str) -> Outcome:
    """Problem b: bottom clamped, unit shear traction on top."""
    width, length, crack, material = 7.0, 16.0, 3.5, Material(3e7, 0.25)
    cut, space = _edge_cracked(n, width, length, crack, enrichment)
    load = traction_load(space, rim(space, lambda x: x[:, 1] > length - 1e-9), (1, 0))
    clamped = given_on_rim(space, rim(space, lambda x: x[:, 1] < 1e-9), lambda x, _: np.zeros_like(x))
    problem = plate_problem(space, (cut,), material, [clamped], load, enrichment)
    solution = solve(problem)
    K_I, K_II = stress_intensity(space, material, solution.U, 0, DISC * crack)
    return Outcome(
        problem,
        solution,
        (
            relative("K_I", K_I, 34.043),
            relative("K_II", K_II, 4.537),
            relative("strain energy", solution.energy, 8.45507e-5),
        ),
    )


def inclined(n: int, enrichment: str, angle_deg: float = 30.0) -> Outcome:
    """Problem c: centre crack of half-length 1 under tension; the exact displacement is given on the outline."""
    beta = np.deg2rad(angle_deg)
    along = np.array([np.cos(beta), np.sin(beta)])
    mesh = uniform_mesh(rectangle(-3, -3, 3, 3), n)
    cut = Cut(np.array([-along, along]), mouth=False, craniotomy=False)
    space = cut_space(mesh, (cut,), enrichment, ENRICHED)
    exact = given_on_rim(
        space, rim(space, _everywhere), lambda x, _: fields.inclined_crack(x, STEEL, 1.0, beta, 1.0)
    )
    problem = plate_problem(space, (cut,), STEEL, [exact], np.zeros(space.enrichment.n_dof), enrichment)
    solution = solve(problem)
    reference = fields.inclined_crack_factors(1.0, beta, 1.0)
    tip = int(np.argmax(space.parts.fronts.at @ along))
    K = stress_intensity(space, STEEL, solution.U, tip, DISC)
    # Relative to sigma sqrt(pi a): K_II vanishes at 0.
    unit = np.sqrt(np.pi)
    values = [
        Value(f"{name} / sqrt(pi a), {angle_deg:g} deg", k / unit, r / unit, abs(k - r) / unit)
        for name, k, r in zip(("K_I", "K_II"), K, reference)
    ]
    return Outcome(problem, solution, tuple(values))


def williams(n: int, enrichment: str) -> Outcome:
    """Problem d: the exact singular field, K_I = 1 and K_II = .5, given on the outline of [-1, 1]^2."""
    mesh = uniform_mesh(rectangle(-1, -1, 1, 1), n)
    cut = place_cut([[-1.2, 0.0], [0.0, 0.0]], mesh.outline)
    space = cut_space(mesh, (cut,), enrichment, 0.5)
    exact = given_on_rim(
        space, rim(space, _everywhere), lambda x, inside: fields.williams(x, STEEL, 1.0, 0.5, inside[:, 1] > 0)
    )
    problem = plate_problem(space, (cut,), STEEL, [exact], np.zeros(space.enrichment.n_dof), enrichment)
    solution = solve(problem)
    error = energy_error(problem, solution.U, lambda x: fields.williams_strain(x, STEEL, 1.0, 0.5))
    K_I, K_II = stress_intensity(space, STEEL, solution.U, 0, 0.6)
    return Outcome(
        problem,
        solution,
        (Value("energy norm", error, 0.0, error), relative("K_I", K_I, 1.0), relative("K_II", K_II, 0.5)),
    )


def rigid_opening(n: int, enrichment: str, course: str = "anywhere") -> Outcome:
    """Problem e: a square cut right through, its halves moved rigidly by d; the lips part by up to 1.7 mm.

    Energy over E d^2 (from the strains: U'KU is only exact to rounding of its terms) and displacement error over d.
    course: the cut runs 'anywhere', 'through nodes' (a diagonal of a structured mesh that meets its nodes and crosses
    its edges), or 'along edges'.
    """
    mesh = uniform_mesh(rectangle(-1, -1, 1, 1), n) if course == "anywhere" else structured(int(np.sqrt(n) / 2) * 2)
    ends = {"anywhere": ((-1.0, -0.3), (1.0, 0.41)), "along edges": ((-1.0, 0.0), (1.0, 0.0))}
    path = np.array(ends.get(course, ((-1.0, 1.0), (1.0, -1.0))))
    cut = Cut(path)
    space = cut_space(mesh, (cut,), enrichment)
    normal = np.array([path[0, 1] - path[1, 1], path[1, 0] - path[0, 0]])
    motions = {1: (np.array([0.3, 0.8]), 0.1), -1: (np.array([-0.1, -0.6]), -0.07)}

    def moved(x, inside):
        left = (inside - path[0]) @ normal > 0
        (t, w), (t_right, w_right) = motions[1], motions[-1]
        spin = np.stack([-x[:, 1], x[:, 0]], axis=1)
        return np.where(left[:, None], t + w * spin, t_right + w_right * spin)

    exact = given_on_rim(space, rim(space, _everywhere), moved)
    problem = plate_problem(space, (cut,), STEEL, [exact], np.zeros(space.enrichment.n_dof), enrichment)
    solution = solve(problem)
    centre = solution.rest.mean(axis=1)
    wanted = moved(solution.rest.reshape(-1, 2), np.repeat(centre, 3, axis=0)).reshape(-1, 3, 2)
    error = np.abs(solution.moved - solution.rest - wanted).max()
    e = solution.strain * (1, 1, 2)
    energy = float(np.einsum("t,ts,su,tu->", solution.rest_areas, e, plane.stiffness(STEEL), e) / 2)
    d = solution.max_displacement_mm
    scaled = energy / (STEEL.young_kpa * d**2), float(error / d)
    return Outcome(
        problem,
        solution,
        tuple(Value(f"{name}, {course}", x, 0.0, x) for name, x in zip(("energy", "displacement"), scaled)),
    )


def arc(n: int, enrichment: str) -> Outcome:
    """Problem f1: an arc crack of 480 straight segments in a plate of half-width 200, unit tension along its axis.

    The mesh is graded to the arc, all its sizes in proportion to n^-1/2: with a fixed growth the far field's error
    would stay. The references are those of the smooth arc in the infinite plate.
    """
    radius, half_angle, w = 4.25, np.deg2rad(28.0725), 200.0
    t = np.pi / 2 + half_angle * np.linspace(1, -1, 481)
    path = radius * np.stack([np.cos(t), np.sin(t)], axis=1) - (0, radius)
    s = np.sqrt(7_800 / n)
    mesh = distmesh(rectangle(-w, -w, w, w), SizeField(50 * s, 0.08 * s, 1.0, (path,), growth=0.1 * s))
    cut = Cut(path, mouth=False, craniotomy=False)
    space = cut_space(mesh, (cut,), enrichment, 1.0)
    problem = plate_problem(space, (cut,), STEEL, *_pulled(space, w), enrichment)
    solution = solve(problem)
    reference = fields.arc_crack_factors(radius, half_angle, 1.0)
    tip = int(np.argmax(space.parts.fronts.at[:, 0]))
    K_I, K_II = stress_intensity(space, STEEL, solution.U, tip, 1.0)
    return Outcome(
        problem, solution, (relative("K_I", K_I, reference[0]), relative("abs K_II", abs(K_II), reference[1]))
    )


def branched(n: int, enrichment: str) -> Outcome:
    """Problem f2: a crack that forks at 45 degrees into two of its length, in a plate of half-width 40, unit tension
    normal to the stem; K over sqrt(pi c), c = (a + b cos 45) / 2. The mesh is graded to the crack.
    """
    w, arm = 40.0, np.array([np.cos(np.pi / 4), np.sin(np.pi / 4)])
    paths = [np.array(p) for p in ([[-1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], arm], [[0.0, 0.0], arm * (1, -1)])]
    s = np.sqrt(7_800 / n)
    mesh = distmesh(rectangle(-w, -w, w, w), SizeField(20 * s, 0.04 * s, 0.4, tuple(paths), growth=0.11 * s))
    cuts = tuple(Cut(path, f"cut {k}", mouth=False, craniotomy=False) for k, path in enumerate(paths))
    space = cut_space(mesh, cuts, enrichment, 0.5)
    problem = plate_problem(space, cuts, STEEL, *_pulled(space, w), enrichment)
    solution = solve(problem)
    unit = np.sqrt(np.pi * (1 + np.cos(np.pi / 4)) / 2)
    tips = space.parts.fronts.at
    stem, branch = (int(np.argmin(np.linalg.norm(tips - x, axis=1))) for x in ((-1.0, 0.0), arm))
    K = [stress_intensity(space, STEEL, solution.U, tip, 0.6) for tip in (stem, branch)]
    return Outcome(
        problem,
        solution,
        (
            relative("K_I of the stem", K[0][0] / unit, 1.0443),
            relative("K_I of a branch", K[1][0] / unit, 0.4950),
            relative("K_II of a branch", abs(K[1][1]) / unit, 0.5065),
        ),
    )


def _pulled(space, w):
    """Supports and load of a square plate of half-width w under unit tension along y."""
    top, bottom = (rim(space, lambda x, y=y: np.abs(x[:, 1] - y) < 1e-9) for y in (w, -w))
    load = traction_load(space, top, (0, 1)) + traction_load(space, bottom, (0, -1))
    return [supports(space, [(w, -w), (w, -w), (w, w)], [0, 1, 0])], load


def _edge_cracked(n, width, length, crack, enrichment):
    mesh = uniform_mesh(rectangle(0, 0, width, length), n)
    path = [[-0.1 * width, length / 2], [crack, length / 2]]
    cut = place_cut(path, mesh.outline)
    return cut, cut_space(mesh, (cut,), enrichment, ENRICHED * crack)


def _everywhere(x):
    return np.ones(len(x), dtype=bool)


def structured(k) -> Mesh:
    """Squares of [-1, 1]^2, k by k, each in two triangles along the rising diagonal."""
    x = np.linspace(-1, 1, k + 1)
    points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    corner = (np.arange(k)[:, None] * (k + 1) + np.arange(k)).ravel()
    right, up = k + 1, 1
    lower = np.stack([corner, corner + right, corner + right + up], axis=1)
    upper = np.stack([corner, corner + right + up, corner + up], axis=1)
    return Mesh(points, np.concatenate([lower, upper]))

