"""A ball with a cut in space on a conforming mesh: gmsh with the cut embedded, split nodes, scikit-fem's P2 tetrahedra.

The cut stands on a plan curve in the plane of x and y and goes straight down from the ball's top to a level z: a flat
one, or a part of a cylinder. Blades hold lips between two places along it, down to a level. The ball's surface is fixed
but for a cap about its top.
"""

from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.spatial import cKDTree
from skfem import Basis, BilinearForm, ElementTetP2, ElementVector, FacetBasis, MeshTet
from skfem.helpers import ddot, dot, eye, sym_grad, trace

from benchmarks.reference.mesh import SplitMesh, split

RADIUS = 36.0
YOUNG, POISSON = 3.0, 0.45
#: Skull springs: k = (E / SPRING_MM) x / (1 - x), x <= STIFFEST the share of the ramp.
SPRING_MM, STIFFEST = 2.0, 0.999
TOLERANCE = 1e-9


@dataclass(frozen=True)
class Case:
    """A cut of `half_mm` on both sides of the ball's top, at `aside_mm` from it, its front at the level `front_mm`;
    `bend_mm`: radius of its plan, towards the left, None for a straight one.

    Blades hold `held` (from, to) of its plan curve down to the level `edge_mm`; the displacements `left`, `right` mm of
    the lips that they hold. Outside of `free_mm` from the top the surface is fixed; its grip grows over `ramp_mm`.
    """

    name: str
    bend_mm: float | None = None
    half_mm: float = 16.0
    aside_mm: float = 0.7
    front_mm: float = 14.0
    edge_mm: float = 24.0
    held: tuple[float, float] = (0.25, 0.75)
    left: tuple[float, float, float] = (0.4, 3.0, -0.8)
    right: tuple[float, float, float] = (0.0, -2.0, 0.0)
    free_mm: float = 24.0
    ramp_mm: float = 0.0

    def plan(self, share) -> np.ndarray:
        """Points (k, 2) mm of the plan curve at shares (k,) of its length, along x; left is +y."""
        s = self.half_mm * (2 * np.asarray(share, float) - 1)
        if self.bend_mm is None:
            return np.stack([s, np.full(len(s), self.aside_mm)], axis=1)
        t = s / self.bend_mm
        return np.stack([self.bend_mm * np.sin(t), self.aside_mm + self.bend_mm * (1 - np.cos(t))], axis=1)

    def height(self, points) -> np.ndarray:
        """Signed distance (k,) mm of points (k, 3) from the sheet prolonged, positive on the left."""
        x, y = points[:, 0], points[:, 1] - self.aside_mm
        return y if self.bend_mm is None else self.bend_mm - np.hypot(x, y - self.bend_mm)

    def share(self, points) -> np.ndarray:
        """Share (k,) of the plan curve's length at points (k, 3) of the sheet."""
        x, y = points[:, 0], points[:, 1] - self.aside_mm
        s = x if self.bend_mm is None else self.bend_mm * np.arctan2(x, self.bend_mm - y)
        return (s / self.half_mm + 1) / 2

    @property
    def switch_mm(self) -> float:
        """The level z below which the surface is fixed rigidly."""
        return RADIUS - (self.free_mm + self.ramp_mm) ** 2 / (2 * RADIUS)

    def edges(self, step=0.25) -> dict[str, np.ndarray]:
        """Points (k, 3) mm on the lines where the displacement is singular: front, blade, switch."""
        below, held = np.linspace(0, 1, int(2 * self.half_mm / step)), np.linspace(*self.held, 200)
        sides = [self._down([end], self.front_mm, step) for end in (0, 1)]
        ends = [self._down([end], self.edge_mm, step) for end in self.held]
        turn = np.linspace(0, 2 * np.pi, int(2 * np.pi * RADIUS / step))
        z = self.switch_mm
        circle = np.sqrt(RADIUS**2 - z**2) * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1) + (0, 0, z)
        return {"front": np.concatenate([self._at(below, self.front_mm), *sides]),
                "blade": np.concatenate([self._at(held, self.edge_mm), *ends]), "switch": circle}

    def _at(self, share, z):
        plan = self.plan(share)
        return np.column_stack([plan, np.broadcast_to(z, len(plan))])

    def _down(self, share, low, step):
        z = np.arange(low, RADIUS, step)
        line = self._at(np.repeat(share, len(z)), z)
        return line[np.linalg.norm(line, axis=1) <= RADIUS]


def mesh_of(case: Case, coarse: float, fine: float, slope: float = 0.3) -> SplitMesh:
    """The ball opened along the cut; edges of `fine` mm at the singular lines, growing by `slope` to `coarse`."""
    import gmsh

    gmsh.initialize(interruptible=False)
    try:
        for option, value in (("General.Terminal", 0), ("General.NumThreads", 1), ("Mesh.Algorithm3D", 1),
                              ("Mesh.MeshSizeExtendFromBoundary", 0), ("Mesh.MeshSizeFromPoints", 0),
                              ("Mesh.MeshSizeFromCurvature", 0)):
            gmsh.option.setNumber(option, value)
        cut = _shape(gmsh.model.occ, case)
        gmsh.model.occ.synchronize()
        _grade(gmsh.model, case, coarse, fine, slope)
        gmsh.model.mesh.generate(3)
        tags, xyz, _ = gmsh.model.mesh.getNodes()
        number = np.full(int(tags.max()) + 1, -1)
        number[tags.astype(int)] = np.arange(len(tags))
        cells = number[gmsh.model.mesh.getElementsByType(4)[1].astype(int)].reshape(-1, 4)
        facets = number[np.concatenate([gmsh.model.mesh.getElementsByType(2, tag)[1] for tag in cut]).astype(int)]
    finally:
        gmsh.finalize()
    return split(xyz.reshape(-1, 3), cells, facets.reshape(-1, 3))


def _shape(occ, case):
    """The ball in parts with the cut's faces, whose tags are returned; the level of the switch divides it."""
    ball = occ.addSphere(0, 0, 0, RADIUS)
    shares = [0.0, *case.held, 1.0]
    sheets = []
    for a, b in zip(shares, shares[1:]):
        (x0, y0), (x1, y1) = case.plan([a, b])
        for low, high in ((case.front_mm, case.edge_mm), (case.edge_mm, RADIUS + 2)):
            ends = [occ.addPoint(x0, y0, low), occ.addPoint(x1, y1, low)]
            if case.bend_mm is None:
                line = occ.addLine(*ends)
            else:
                centre = occ.addPoint(0, case.aside_mm + case.bend_mm, low)
                line = occ.addCircleArc(ends[0], centre, ends[1])
            sheets += [tag for tag in occ.extrude([(1, line)], 0, 0, high - low) if tag[0] == 2]
    level = (2, occ.addRectangle(-RADIUS - 2, -RADIUS - 2, case.switch_mm, 2 * RADIUS + 4, 2 * RADIUS + 4))
    _, made = occ.fragment([(3, ball)], [*sheets, level])
    cut, all_faces = (set(chain.from_iterable(faces)) for faces in (made[1:-1], made[1:]))
    outside = {tag for tag in all_faces if np.linalg.norm(occ.getCenterOfMass(*tag)) > RADIUS - 0.05}
    occ.remove(list(outside), recursive=True)
    return [tag for _, tag in cut - outside]


def _grade(model, case, coarse, fine, slope):
    lines = cKDTree(np.concatenate(list(case.edges(0.05).values())))
    singular = []
    for dim, tag in model.getEntities(1):
        low, high = model.getParametrizationBounds(dim, tag)
        points = np.reshape(model.getValue(dim, tag, np.linspace(low[0], high[0], 5)), (-1, 3))
        if lines.query(points)[0].max() < 0.1:
            singular.append(tag)
    field = model.mesh.field
    distance, size = field.add("Distance"), field.add("Threshold")
    field.setNumbers(distance, "CurvesList", singular)
    field.setNumber(distance, "Sampling", 400)
    for name, value in (("InField", distance), ("SizeMin", fine), ("SizeMax", coarse), ("DistMin", 0),
                        ("DistMax", (coarse - fine) / slope)):
        field.setNumber(size, name, value)
    field.setAsBackgroundMesh(size)


class SolidModel:
    """Stiffness and conditions of an elastic body of P2 tetrahedra; kPa, mm."""

    def __init__(self, mesh: SplitMesh, young: float = YOUNG, poisson: float = POISSON):
        self.mesh, self.young = MeshTet(mesh.points.T.copy(), mesh.cells.T.copy()), young
        self.element = ElementVector(ElementTetP2())
        self.basis = Basis(self.mesh, self.element, intorder=2)
        mu = young / (2 * (1 + poisson))
        lam = 2 * mu * poisson / (1 - 2 * poisson)

        @BilinearForm
        def form(u, v, w):
            e = sym_grad(u)
            return ddot(lam * eye(trace(e), 3) + 2 * mu * e, sym_grad(v))

        self.K = form.assemble(self.basis).tocsr()
        self.fixed, self.value = np.zeros(self.basis.N, bool), np.zeros(self.basis.N)
        self.boundary = self.mesh.boundary_facets()
        self.corners = self.mesh.p[:, self.mesh.facets[:, self.boundary]].transpose(2, 1, 0)
        cell = self.mesh.f2t[0, self.boundary]
        self.inward = self.mesh.p[:, self.mesh.t[:, cell]].mean(axis=1).T - self.corners.mean(axis=1)

    def prescribe(self, facets, displacement):
        """u = displacement (callable (k, 3) -> (k, 3), or a vector) on facets; the later call has the last word."""
        nodes, edges = np.unique(self.mesh.facets[:, facets]), np.unique(self.mesh.f2e[:, facets])
        middles = self.mesh.p[:, self.mesh.edges[:, edges]].mean(axis=1).T
        for dofs, at in ((self.basis.nodal_dofs[:, nodes], self.mesh.p[:, nodes].T),
                         (self.basis.edge_dofs[:, edges], middles)):
            u = displacement(at) if callable(displacement) else np.tile(displacement, (len(at), 1))
            self.fixed[dofs], self.value[dofs] = True, u.T

    def spring(self, facets, stiffness):
        """Springs of stiffness(points (3, ...)) kPa/mm on facets."""
        side = FacetBasis(self.mesh, self.element, facets=facets, intorder=6)
        self.K = self.K + BilinearForm(lambda u, v, w: stiffness(w.x) * dot(u, v)).assemble(side)

    def solve(self) -> np.ndarray:
        """Degrees of freedom of the displacement that minimises the energy."""
        import pyamg
        from scipy.sparse.linalg import cg

        u, free = np.where(self.fixed, self.value, 0.0), np.flatnonzero(~self.fixed)
        A, b = self.K[free][:, free], -(self.K @ u)[free]
        x, y, z = self.basis.doflocs[:, free]
        axis = np.eye(3)[free % 3]
        spins = np.stack([axis @ e for e in np.eye(3)] + [
            axis[:, 1] * x - axis[:, 0] * y, axis[:, 2] * y - axis[:, 1] * z, axis[:, 0] * z - axis[:, 2] * x], axis=1)
        levels = pyamg.smoothed_aggregation_solver(A.tobsr((3, 3)), B=spins, strength=("symmetric", {"theta": 0.05}))
        steps = []
        u[free], failed = cg(A, b, rtol=TOLERANCE, maxiter=2000, M=levels.aspreconditioner(), callback=steps.append)
        if failed:
            raise ArithmeticError("the reference's conjugate gradients did not converge")
        return u

    def field(self, u) -> "SolidField":
        """The displacement as a function of place."""
        cells, ends = self.mesh.t, self.mesh.t2e
        return SolidField(self.mesh.p.T[cells.T], np.concatenate(
            [u[self.basis.nodal_dofs[:, cells]], u[self.basis.edge_dofs[:, ends]]], axis=1).transpose(2, 1, 0))


#: Corners of the edges of scikit-fem's tetrahedra, in their order.
ENDS = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])


@dataclass(frozen=True, eq=False)
class SolidField:
    """A P2 displacement: corners (m, 4, 3) mm; u (m, 10, 3) mm at the corners and the middles of edges ENDS."""

    corners: np.ndarray
    u: np.ndarray

    def __call__(self, points, tries: int = 60) -> np.ndarray:
        """Displacement (k, 3) mm at points (k, 3) mm off the cut; beside the mesh that of the cell least outside."""
        points = np.asarray(points, float)
        origin = self.corners[:, 0]
        inverse = np.linalg.inv(self.corners[:, 1:] - origin[:, None])
        tree = cKDTree(self.corners.mean(axis=1))
        found, best = np.zeros((len(points), 4)), np.full(len(points), -np.inf)
        cell = np.zeros(len(points), int)
        left = np.arange(len(points))
        for first, last in ((0, 8), (8, tries)):
            near = tree.query(points[left], last)[1][:, first:]
            for k in near.T:
                rest = np.einsum("ni,nij->nj", points[left] - origin[k], inverse[k])
                share = np.column_stack([1 - rest.sum(axis=1), rest])
                better = share.min(axis=1) > best[left]
                which = left[better]
                found[which], best[which], cell[which] = share[better], share[better].min(axis=1), k[better]
            left = np.flatnonzero(best < -1e-9)
            if not len(left):
                break
        N = np.concatenate([found * (2 * found - 1), 4 * found[:, ENDS[:, 0]] * found[:, ENDS[:, 1]]], axis=1)
        return np.einsum("ka,kai->ki", N, self.u[cell])


def opened_ball(case: Case, coarse: float, fine: float, slope: float = 0.3) -> tuple[SolidField, int]:
    """The displacement of a case, and the number of its unknowns."""
    model = SolidModel(mesh_of(case, coarse, fine, slope))
    x = model.corners
    outline = (np.abs(np.linalg.norm(x, axis=2) - RADIUS) < 1e-6).all(axis=1)
    rigid = outline & (x[..., 2] < case.switch_mm + 1e-6).all(axis=1)
    if case.ramp_mm:
        def grip(p):
            depth = np.sqrt(p[0] ** 2 + p[1] ** 2 + (p[2] - RADIUS) ** 2) - case.free_mm
            x = np.clip(depth / case.ramp_mm, 0, STIFFEST)
            return YOUNG / SPRING_MM * x / (1 - x)
        model.spring(model.boundary[outline & ~rigid], grip)
    middle = x.mean(axis=1)
    on_cut = ~outline & (np.abs(np.stack([case.height(c) for c in x.swapaxes(0, 1)])) < 1e-6).all(axis=0)
    share = case.share(middle)
    held = on_cut & (middle[:, 2] > case.edge_mm) & (share > case.held[0]) & (share < case.held[1])
    left = case.height(middle + 1e-3 * model.inward) > case.height(middle)
    for side, given in ((left, case.left), (~left, case.right)):
        model.prescribe(model.boundary[held & side], given)
    model.prescribe(model.boundary[rigid], np.zeros(3))
    return model.field(model.solve()), model.basis.N
