"""From a cut to displacements, two ways: xfemnav on a mesh that stays, and the remeshing chain for the same problem.

xfemnav: find the cut cells, the basis functions, conditions, stiffness, factor, solve. The chain: gmsh with the cut
embedded, its nodes split, scikit-fem's stiffness (linear or quadratic), scipy's splu with its defaults.
"""

from dataclasses import replace
from functools import partial

import gmsh
import numpy as np
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTriP1, ElementTriP2, ElementVector, FacetBasis, LinearForm, MeshTri
from skfem.helpers import ddot, eye, sym_grad, trace

from benchmarks.reference.elasticity import Field, Tissue
from benchmarks.reference.mesh import SplitMesh, split
from benchmarks.reference.mesh import _network as network
from xfemnav.mechanics.conditions.constraints import eliminate
from xfemnav.mechanics.conditions.problem import Problem
from xfemnav.mechanics.solving.factor import factor
from xfemnav.mechanics.solving.minimise import minimise
from xfemnav.mechanics.solving.solution import scaled_basis
from xfemnav.mechanics.tissue.elasticity import stiffness

OPTIONS = {
    "General.Terminal": 0,
    "General.NumThreads": 1,
    "Mesh.Algorithm": 6,
    "Mesh.MeshSizeExtendFromBoundary": 0,
    "Mesh.MeshSizeFromPoints": 0,
    "Mesh.MeshSizeFromCurvature": 0,
}


def displaced(problem: Problem) -> np.ndarray:
    """Coefficients U (n_rows, 2) mm of a posed problem, without what a run reports of it."""
    K = (stiffness(problem.space, problem.material) + problem.springs).tocsc()
    basis = scaled_basis(problem, K)
    U0, T = eliminate(replace(problem.constraints, C=problem.constraints.C @ basis))
    found = minimise(K, problem.load, basis @ U0, (basis @ T).tocsc(), problem.contacts,
                     by=partial(factor, semidefinite=True))
    return found.U.reshape(-1, 2)


def split_mesh(outline, path, h, marks=(), focus=()) -> SplitMesh:
    """gmsh's frontal mesh of edges h with the cut `path` (k, 2) mm in it, opened, and with nodes at `marks` (k, 2) mm.

    focus: (x, y, size, by): shorter edges about these points, growing by `by` mm a mm. Sizes are fields of gmsh's own.
    """
    vertices, rings, inner = network([np.asarray(outline, float)], [np.asarray(path, float)], marks)
    gmsh.initialize(interruptible=False)
    try:
        for option, value in OPTIONS.items():
            gmsh.option.setNumber(option, value)
        geo, field = gmsh.model.geo, gmsh.model.mesh.field
        tags = [geo.addPoint(x, y, 0) for x, y in vertices]
        loop = geo.addCurveLoop([geo.addLine(tags[a], tags[b]) for a, b in rings[0]])
        cut = [geo.addLine(tags[a], tags[b]) for a, b in inner]
        surface = geo.addPlaneSurface([loop])
        geo.synchronize()
        gmsh.model.mesh.embed(1, cut, 2, surface)
        sizes = [f"{h:.12f}"]
        sizes += [f"{size:.12f} + {by:.12f} * Sqrt((x {-x:+.12f})^2 + (y {-y:+.12f})^2)" for x, y, size, by in focus]
        each = [field.add("MathEval") for _ in sizes]
        for tag, formula in zip(each, sizes):
            field.setString(tag, "F", formula)
        least = field.add("Min")
        field.setNumbers(least, "FieldsList", each)
        field.setAsBackgroundMesh(least)
        gmsh.model.mesh.generate(2)
        node, xyz, _ = gmsh.model.mesh.getNodes()
        number = np.full(int(node.max()) + 1, -1)
        number[node.astype(int)] = np.arange(len(node))
        cells = number[gmsh.model.mesh.getElementsByType(2)[1].astype(int)].reshape(-1, 3)
        edges = [gmsh.model.mesh.getElementsByType(1, tag)[1].astype(int) for tag in cut]
    finally:
        gmsh.finalize()
    points, edges = xyz.reshape(-1, 3)[:, :2].copy(), number[np.concatenate(edges)].reshape(-1, 2)
    used = np.unique(cells)
    kept = np.full(len(points), -1)
    kept[used] = np.arange(len(used))
    return split(points[used], kept[cells], kept[edges])


class Chain:
    """Stiffness, loads and conditions of a split mesh; degree 1 or 2. Tractions and displacements at edges' ends and
    middles."""

    def __init__(self, mesh: SplitMesh, tissue: Tissue, degree: int):
        self.tissue, (lam, mu) = tissue, tissue.lame
        self.mesh = MeshTri(mesh.points.T.copy(), mesh.cells.T.copy())
        self.element = ElementVector(ElementTriP1() if degree == 1 else ElementTriP2())
        self.basis = Basis(self.mesh, self.element, intorder=2 * (degree - 1))

        @BilinearForm
        def form(u, v, _):
            e = sym_grad(u)
            return ddot(lam * eye(trace(e), 2) + 2 * mu * e, sym_grad(v))

        self.K = form.assemble(self.basis).tocsc()
        self.load, self.u = np.zeros(self.basis.N), np.full(self.basis.N, np.nan)
        self.boundary = self.mesh.boundary_facets()
        self.middle = self.mesh.p[:, self.mesh.facets[:, self.boundary]].mean(axis=1).T
        self.inside = self.mesh.p[:, self.mesh.t[:, self.mesh.f2t[0, self.boundary]]].mean(axis=1).T

    def hold(self, chosen, displacement):
        """u = displacement(points (k, 2), inside (k, 2)) at the nodes of the `chosen` (b,) boundary facets."""
        facets = self.boundary[chosen]
        ends, inside = self.mesh.facets[:, facets], self.inside[chosen]
        for k in (0, 1):
            self._set(self.basis.nodal_dofs[:, ends[k]], displacement(self.mesh.p[:, ends[k]].T, inside))
        if self.basis.facet_dofs.size:
            self._set(self.basis.facet_dofs[:, facets], displacement(self.middle[chosen], inside))

    def _set(self, dofs, values):
        self.u[dofs[0]], self.u[dofs[1]] = values.T

    def pin(self, point, components):
        """u_i = 0 at the node nearest to a point (2,)."""
        node = int(np.argmin(np.linalg.norm(self.mesh.p.T - point, axis=1)))
        self.u[self.basis.nodal_dofs[list(components), node]] = 0.0

    def pull(self, chosen, traction):
        """Add a traction (2,) kPa on the `chosen` (b,) boundary facets."""
        t = np.asarray(traction, float)
        side = FacetBasis(self.mesh, self.element, facets=self.boundary[chosen])
        self.load += LinearForm(lambda v, _: t[0] * v[0] + t[1] * v[1]).assemble(side)

    def solve(self) -> np.ndarray:
        """Degrees of freedom (N,) mm."""
        free = np.flatnonzero(np.isnan(self.u))
        u = np.nan_to_num(self.u)
        u[free] = splu(self.K[free][:, free].tocsc()).solve((self.load - self.K @ u)[free])
        return u

    def field(self, u) -> Field:
        """The displacement as a function of place."""
        cells = self.mesh.t.T
        corner = np.stack([u[self.basis.nodal_dofs[:, cells[:, a]]].T for a in range(3)], axis=1)
        if self.basis.facet_dofs.size:
            middle = np.stack([u[self.basis.facet_dofs[:, self.mesh.t2f[a]]].T for a in range(3)], axis=1)
        else:  # edges 01, 12, 02
            middle = np.stack([(corner[:, a] + corner[:, b]) / 2 for a, b in ((0, 1), (1, 2), (0, 2))], axis=1)
        return Field(self.mesh.p.T[cells], np.concatenate([corner, middle], axis=1))
