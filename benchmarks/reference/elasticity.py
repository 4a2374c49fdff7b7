"""Plane elasticity with quadratic triangles (scikit-fem) on a split mesh."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTriP2, ElementVector, FacetBasis, LinearForm, MeshTri
from skfem.helpers import ddot, eye, sym_grad, trace

from benchmarks.reference.mesh import SplitMesh


@dataclass(frozen=True)
class Tissue:
    """Young's modulus, Poisson's ratio, plane 'strain' or 'stress'."""

    young: float
    poisson: float
    stress_state: str = "strain"

    @property
    def lame(self) -> tuple[float, float]:
        """lambda (that of the plane) and mu."""
        E, nu = self.young, self.poisson
        mu = E / (2 * (1 + nu))
        return (E * nu / (1 - nu**2) if self.stress_state == "stress" else E * nu / ((1 + nu) * (1 - 2 * nu))), mu


class Model:
    """Stiffness matrix, loads and conditions of a cut plate or disc; P2 displacement.

    Facets are numbers of scikit-fem's facets, from `facets`.
    """

    def __init__(self, mesh: SplitMesh, tissue: Tissue):
        self.tissue = tissue
        self.mesh = MeshTri(mesh.points.T.copy(), mesh.cells.T.copy())
        self.element = ElementVector(ElementTriP2())
        self.basis = Basis(self.mesh, self.element)
        lam, mu = tissue.lame

        @BilinearForm
        def form(u, v, w):
            e = sym_grad(u)
            return ddot(lam * eye(trace(e), 2) + 2 * mu * e, sym_grad(v))

        self.K = form.assemble(self.basis).tocsc()
        self.load = np.zeros(self.basis.N)
        self.fixed, self.value = np.zeros(self.basis.N, bool), np.zeros(self.basis.N)

    @cached_property
    def boundary(self) -> np.ndarray:
        """Facets (b,) with tissue on one side only: the outline and both lips."""
        return self.mesh.boundary_facets()

    def facets(self, where) -> np.ndarray:
        """Boundary facets whose middle (k, 2) and inward direction (k, 2) satisfy where(middle, inward)."""
        ends = self.mesh.p[:, self.mesh.facets[:, self.boundary]]
        middle = ends.mean(axis=1).T
        inward = self.mesh.p[:, self.mesh.t[:, self.mesh.f2t[0, self.boundary]]].mean(axis=1).T - middle
        return self.boundary[where(middle, inward)]

    def prescribe(self, facets, displacement, components=(0, 1)):
        """u = displacement (callable (k, 2) -> (k, 2), or a vector) at the nodes and middles of facets.

        scikit-fem gives nodal and facet degrees of freedom the same names, so both are taken by number here.
        """
        nodes = np.unique(self.mesh.facets[:, facets])
        middles = self.mesh.p[:, self.mesh.facets[:, facets]].mean(axis=1).T
        corner, edge = self.basis.nodal_dofs[:, nodes], self.basis.facet_dofs[:, facets]
        for dofs, at in ((corner, self.mesh.p[:, nodes].T), (edge, middles)):
            u = displacement(at) if callable(displacement) else np.tile(displacement, (len(at), 1))
            for i in components:
                self.fixed[dofs[i]], self.value[dofs[i]] = True, u[:, i]

    def pin(self, point, components):
        """u_i = 0 at the node nearest to a point (2,): against rigid motions."""
        node = int(np.argmin(np.linalg.norm(self.mesh.p.T - point, axis=1)))
        for i in components:
            self.fixed[self.basis.nodal_dofs[i, node]] = True

    def pull(self, facets, traction):
        """Add a traction (2,), force per area, on facets."""
        side = FacetBasis(self.mesh, self.element, facets=facets)
        t = np.asarray(traction, float)
        self.load += LinearForm(lambda v, w: t[0] * v[0] + t[1] * v[1]).assemble(side)

    def solve(self) -> np.ndarray:
        """Degrees of freedom of the displacement that minimises the energy."""
        u, free = np.where(self.fixed, self.value, 0.0), np.flatnonzero(~self.fixed)
        A, b = self.K[free][:, free].tocsc(), (self.load - self.K @ u)[free]
        lu = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        u[free] = lu.solve(b)
        u[free] += lu.solve(b - A @ u[free])
        return u

    def energy(self, u) -> float:
        """Strain energy of the degrees of freedom u."""
        return float(u @ (self.K @ u) / 2)

    def field(self, u) -> "Field":
        """The displacement as a function of place."""
        cells = self.mesh.t.T
        nodal = np.stack([u[self.basis.nodal_dofs[:, cells[:, a]]].T for a in range(3)], axis=1)
        middle = np.stack([u[self.basis.facet_dofs[:, self.mesh.t2f[a]]].T for a in range(3)], axis=1)
        return Field(self.mesh.p.T[cells], np.concatenate([nodal, middle], axis=1))


@dataclass(frozen=True, eq=False)
class Field:
    """A P2 displacement: corners (m, 3, 2) mm; u (m, 6, 2) mm at the corners and at the middles of edges 01, 12, 02."""

    corners: np.ndarray
    u: np.ndarray

    @cached_property
    def _tree(self):
        return shapely.STRtree(shapely.polygons(self.corners))

    def __call__(self, points) -> np.ndarray:
        """Displacement (k, 2) mm at points (k, 2) mm off the cuts; NaN outside the mesh."""
        points = np.asarray(points, float)
        at, cell = self._tree.query(shapely.points(points), predicate="intersects")
        found = np.full(len(points), -1)
        found[at] = cell
        a, b, c = self.corners[found].swapaxes(0, 1)
        area = _cross(b - a, c - a)
        l1, l2 = _cross(points - a, c - a) / area, _cross(b - a, points - a) / area
        l0 = 1 - l1 - l2
        corner, edge = [l0 * (2 * l0 - 1), l1 * (2 * l1 - 1), l2 * (2 * l2 - 1)], [l0 * l1, l1 * l2, l0 * l2]
        N = np.stack([*corner, *(4 * n for n in edge)], axis=1)
        u = np.einsum("ka,kai->ki", N, self.u[found])
        u[found < 0] = np.nan
        return u


def _cross(p, q):
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
