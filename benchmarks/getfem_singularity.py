"""Problem d by GetFEM's enriched elements; run by Debian's own Python, which has python3-getfem.

    /usr/bin/python3 benchmarks/getfem_singularity.py 500 2000 ...

For each number of nodes one JSON line for degree 1: unknowns, seconds, energy norm of the error. Seconds run from a
mesh that is there: level set, spaces, quadrature, assembly, solve. Functions at the tip within .5 of it, as xfemnav's.
"""

import json
import sys
from time import process_time

import getfem as gf
import numpy as np

E, NU, RADIUS = 1.0, 0.3, 0.5
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
MODES = (1.0, 0.5)
ERROR = "lam*sqr(Trace(Grad_u-Grad_exact))+2*mu*Norm_sqr(Sym(Grad_u-Grad_exact))"
EXACT = "lam*sqr(Trace(Grad_exact))+2*mu*Norm_sqr(Sym(Grad_exact))"


def coefficients() -> np.ndarray:
    """Coefficients (8,) of the singular field in GetFEM's four functions, found by their values around the tip."""
    mesh = gf.Mesh("regular_simplices", np.linspace(-1, 1, 4), np.linspace(-1, 1, 4))
    level, _cut = cracked(mesh)
    space = gf.MeshFem("global function", mesh, level, functions(), 1)
    t = np.linspace(-3, 3, 61)
    at = gf.Slice("points", mesh, np.array([np.cos(t), np.sin(t)]) / 4)
    x, y = at.pts()
    t, values = np.arctan2(y, x), [gf.compute_interpolate_on(space, row, at) for row in np.eye(4)]
    kappa, (K_1, K_2), s, c = 3 - 4 * NU, MODES, np.sin(t / 2), np.cos(t / 2)
    u = np.array([K_1 * c * (kappa - np.cos(t)) + K_2 * s * (kappa + 2 + np.cos(t)),
                  K_1 * s * (kappa - np.cos(t)) - K_2 * c * (kappa - 2 + np.cos(t))])
    u *= np.sqrt(np.hypot(x, y) / (2 * np.pi)) / (2 * MU)
    found = np.linalg.lstsq(np.array(values).T, u.T, rcond=None)[0]
    off = abs(np.array(values).T @ found - u.T).max()
    assert off < 1e-10, f"GetFEM's functions do not span the field: {off:.1e}"
    return found.ravel()


def cracked(mesh):
    """The level set of the crack, and the mesh cut by it."""
    level, cut = gf.LevelSet(mesh, 1, "y", "x"), gf.MeshLevelSet(mesh)
    cut.add(level)
    cut.adapt()
    return level, cut


def functions() -> list:
    """GetFEM's four functions at a crack's tip."""
    return [gf.GlobalFunction("crack", k) for k in range(4)]


def solve(n: int, wanted) -> dict:
    """One row."""
    side = round(np.sqrt(n)) // 2 * 2 + 1  # an odd number of squares: the crack runs inside cells
    ticks = np.linspace(-1, 1, side + 1)
    mesh = gf.Mesh("regular_simplices", ticks, ticks)
    mesh.set_region(1, mesh.outer_faces())
    start = process_time()
    level, cut = cracked(mesh)
    plain = gf.MeshFem(mesh)
    plain.set_fem(gf.Fem("FEM_PK(2,1)"))
    singular = gf.MeshFem("product", plain, gf.MeshFem("global function", mesh, level, functions(), 1))
    singular.set_enriched_dofs(np.nonzero((plain.basic_dof_nodes() ** 2).sum(axis=0) < RADIUS**2)[0])
    space = gf.MeshFem("sum", singular, gf.MeshFem("levelset", cut, plain))
    space.set_qdim(2)
    rule = gf.MeshIm("levelset", cut, "all", gf.Integ("IM_STRUCTURED_COMPOSITE(IM_TRIANGLE(6),3)"),
                     gf.Integ("IM_STRUCTURED_COMPOSITE(IM_GAUSS_PARALLELEPIPED(2,6),9)"),
                     gf.Integ("IM_STRUCTURED_COMPOSITE(IM_TRIANGLE(6),5)"))
    exact = gf.MeshFem("global function", mesh, level, functions(), 1)
    exact.set_qdim(2)
    model = gf.Model("real")
    model.add_fem_variable("u", space)
    model.add_initialized_data("lam", [LAM])
    model.add_initialized_data("mu", [MU])
    model.add_initialized_fem_data("exact", exact, wanted)
    model.add_isotropic_linearized_elasticity_brick(rule, "u", "lam", "mu")
    model.add_Dirichlet_condition_with_penalization(rule, "u", 1e8, 1, "exact")
    model.solve()
    seconds = process_time() - start
    error, norm = (gf.asm_generic(rule, 0, text, -1, model) for text in (ERROR, EXACT))
    return {"unknowns": int(space.nbdof()), "seconds": seconds, "error": float(np.sqrt(error / norm))}


if __name__ == "__main__":
    gf.util_trace_level(0)
    known = coefficients()
    for word in sys.argv[1:]:
        print(json.dumps(solve(int(word), known)), flush=True)
