"""Where the tip lies in the mesh: on nodes, on edges, 1e-1 to 1e-14 h beside them; Williams' field as in problem d."""

import numpy as np

from benchmarks.verification import cases, fields
from benchmarks.verification.outcome import energy_error
from benchmarks.verification.plates import cut_space, given_on_rim, plate_problem, rim
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import place_cut
from xfemnav.mechanics.solving.intensity import stress_intensity
from xfemnav.mechanics.solving.solution import solve

NODES = 2_000
OFFSETS = (0.0, *(10.0**-k for k in range(1, 15)))


def placements():
    """Errors of K_I and of the energy norm for every place of the tip and of the cut behind it: dicts."""
    mesh = cases.uniform_mesh(cases.rectangle(-1, -1, 1, 1), NODES)
    h = float(np.median(mesh.sizes))
    edge = mesh.edges[np.argmin(np.linalg.norm(mesh.points[mesh.edges].mean(axis=1), axis=1))]
    places = {"node": mesh.points[edge[0]], "edge": mesh.points[edge].mean(axis=0)}
    for enrichment in ("topological", "geometric"):
        for name, place in places.items():
            for direction in ((0.0, 1.0), (1.0, 0.0)):
                for offset in OFFSETS:
                    row = _errors(mesh, place + offset * h * np.array(direction), enrichment)
                    yield {"case": enrichment, "place": name, "direction": direction, "offset": offset, **row}


def _errors(mesh, tip, enrichment):
    """The mesh is moved so that the tip is the origin, where the exact field has its own."""
    mesh = Mesh(mesh.points - tip, mesh.cells)
    cut = place_cut([[-1.5, 0.0], [0.0, 0.0]], mesh.outline)
    space = cut_space(mesh, (cut,), enrichment, 0.4)
    exact = given_on_rim(
        space,
        rim(space, lambda x: np.ones(len(x), bool)),
        lambda x, inside: fields.williams(x, cases.STEEL, 1.0, 0.5, inside[:, 1] > 0),
    )
    problem = plate_problem(space, (cut,), cases.STEEL, [exact], np.zeros(space.enrichment.n_dof), enrichment)
    U = solve(problem).U
    K_I, _ = stress_intensity(space, cases.STEEL, U, 0, 0.6)
    error = energy_error(problem, U, lambda x: fields.williams_strain(x, cases.STEEL, 1.0, 0.5))
    return {"K_I": abs(K_I - 1), "energy": float(error)}
