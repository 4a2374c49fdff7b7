"""Assembly of the stiffness matrix beside scikit-fem and numpy (element matrices by einsum, entries as a list).

    python -m benchmarks.assembly

From a mesh to compressed columns, each time from nothing; linear triangles on the retraction disc, 2 degrees of freedom
a node.
"""

from benchmarks.timing import exponent, interleaved, keep, mark, table  # isort: skip (sets the number of threads)

import numpy as np
from scipy.sparse import coo_array, csc_array
from skfem import Basis, BilinearForm, ElementTriP1, ElementVector, MeshTri
from skfem.helpers import ddot, eye, sym_grad, trace

from benchmarks.verification import retraction
from xfemnav.geometry.mesh import Mesh
from xfemnav.mechanics.tissue.assembly import assemble
from xfemnav.mechanics.tissue.elasticity import Material, plain_blocks

#: Number of nodes, and repetitions.
TARGETS = {1_000: 15, 5_000: 15, 20_000: 7, 80_000: 5}
MATERIAL = Material()


def lame(material: Material) -> tuple[float, float]:
    """lambda and mu, kPa, of the plane."""
    mu, lam = material.moduli_in([0])
    return lam[0], mu[0]


def by_kernel(mesh: Mesh) -> csc_array:
    """xfemnav's kernel."""
    vars(mesh).pop("gradients", None)  # they are kept with the mesh: work them out again
    return assemble(*given(mesh))


def given(mesh: Mesh) -> tuple:
    """What the kernel is given."""
    lam, mu = lame(MATERIAL)
    none = np.empty((0, 1), int), np.empty((0, 1, 1))
    return len(mesh.points), mesh.cells, mesh.gradients, lam * mesh.volumes, mu * mesh.volumes, *none


def by_list(mesh: Mesh) -> csc_array:
    """All element matrices by einsum, as one list of entries."""
    vars(mesh).pop("gradients", None)
    n = 2 * len(mesh.points)
    lam, mu = lame(MATERIAL)
    K = plain_blocks(mesh.gradients, lam * mesh.volumes, mu * mesh.volumes)
    dof = (2 * mesh.cells[:, :, None] + np.arange(2)).reshape(-1, 6)
    return coo_array((K.ravel(), (np.repeat(dof, 6, axis=1).ravel(), np.tile(dof, (1, 6)).ravel())), (n, n)).tocsc()


def by_skfem(mesh: MeshTri):
    """scikit-fem's form."""
    lam, mu = lame(MATERIAL)

    @BilinearForm
    def form(u, v, _):
        e = sym_grad(u)
        return ddot(lam * eye(trace(e), 2) + 2 * mu * e, sym_grad(v))

    return form.assemble(Basis(mesh, ElementVector(ElementTriP1()), intorder=0)).tocsc()


def main() -> None:
    """Print one row for each size."""
    rows, marks, sizes, seconds = [], [], [], []
    for target, repeats in TARGETS.items():
        mesh = retraction.uniform(target)
        theirs, arguments = MeshTri(mesh.points.T.copy(), mesh.cells.T.copy()), given(mesh)
        times = interleaved({
            "xfemnav": lambda mesh=mesh: by_kernel(mesh),
            "kernel": lambda arguments=arguments: assemble(*arguments),
            "numpy": lambda mesh=mesh: by_list(mesh),
            "scikit-fem": lambda theirs=theirs: by_skfem(theirs),
        }, repeats)
        K, same = by_kernel(mesh), by_list(mesh)
        each = {name: 1e6 * time / len(mesh.cells) for name, time in times.items()}
        over = {name: time / times["xfemnav"] for name, time in times.items()}
        rows.append((len(mesh.points), len(mesh.cells), *each.values(), over["numpy"], over["scikit-fem"],
                     f"{abs(K - same).max() / abs(same).max():.0e}"))
        sizes.append(len(mesh.points))
        seconds.append(times["xfemnav"])
        if target == 5_000:
            marks += [mark("assembly: us an element, 5k nodes", 0.3, each["xfemnav"]),
                      mark("assembly: time over numpy's, 5k nodes", 0.1, 1 / over["numpy"]),
                      mark("assembly: time over scikit-fem's, 5k nodes", 0.05, 1 / over["scikit-fem"])]
    growth = exponent(sizes[1:], seconds[1:])
    marks.append(mark("assembly: growth from 5k to 80k nodes, power of N", 1.15, growth))
    text = table(("nodes", "elements", "xfemnav, us/element", "of it the kernel", "numpy", "scikit-fem",
                  "numpy over xfemnav", "scikit-fem over xfemnav", "difference"), rows)
    keep("assembly", text + f"\nGrowth of xfemnav from 5k to 80k nodes: N^{growth:.2f}.\n", marks)


if __name__ == "__main__":
    main()
