"""The mesh of a whole organ, beside gmsh's given the same surface, and of twenty masks.

    python -m benchmarks.volume_mesh

The brain mask of MNI152, from its signed distance, with elements of 1.25 mm about a planar cut that grow to 5 mm. gmsh
is given the triangles of that mesh's boundary and the same sizes, times what leads to about as many nodes. *Angles* are
dihedral. *Volume* is the mesh's, less that within the zero level of the distance; of the distances between the two
surfaces, from either, *p99* is the 99th percentile and *far* the largest, between points .4 mm apart: under .2 mm there
is nothing to see. *Defects* are edges of the boundary that are not in two facets, and nodes not in one ring of them.

The twenty masks are meshed from 1.25 mm about a place at their surface to 5 mm, smaller ones to 2.5 mm.
"""

from benchmarks.timing import interleaved, keep, mark, table  # isort: skip (sets the number of threads)

from time import process_time

import gmsh
import numpy as np

from benchmarks.verification.solids import about_place, brain, coarse_for, defects, dihedral, fidelity, masks
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.solid.field import Field
from xfemnav.geometry.solid.stuffing import stuff
from xfemnav.imaging.organ.distance import signed_distance

REPEATS = 3
SCALE = 0.57  # of sizes given to gmsh
ALGORITHMS = {"gmsh Delaunay": 1, "gmsh HXT": 10}
COARSER = 0.265  # growth of the sizes that leads to 83k nodes


def about_cut(points, growth=0.2) -> np.ndarray:
    """Wanted size (n,) mm about a cut in the plane x = 20 mm, in the upper half of the right hemisphere."""
    x, y, z = points.T
    beyond = np.stack([np.abs(x - 20) - 1, np.abs(y) - 30, 40 - z])
    return 1.25 + growth * np.linalg.norm(np.maximum(beyond, 0), axis=0)


def by_gmsh(surface: Mesh, algorithm: int) -> Mesh:
    """Mesh of what the boundary of a mesh encloses."""
    gmsh.clear()
    nodes, facets = np.unique(surface.boundary_facets, return_inverse=True)
    gmsh.option.setNumber("Mesh.Algorithm3D", algorithm)
    gmsh.model.addDiscreteEntity(2, 1)
    gmsh.model.mesh.addNodes(2, 1, np.arange(1, len(nodes) + 1), surface.points[nodes].ravel())
    gmsh.model.mesh.addElementsByType(1, 2, [], facets.ravel() + 1)
    gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop([1])])
    gmsh.model.geo.synchronize()
    box = gmsh.model.mesh.field.add("Box")
    for name, value in {"VIn": 1.25 * SCALE, "VOut": 5 * SCALE, "XMin": 19, "XMax": 21, "YMin": -30, "YMax": 30,
                        "ZMin": 40, "ZMax": 200, "Thickness": 3.75 / 0.2}.items():
        gmsh.model.mesh.field.setNumber(box, name, value)
    gmsh.model.mesh.field.setAsBackgroundMesh(box)
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    gmsh.model.mesh.generate(3)
    tags, xyz, _ = gmsh.model.mesh.getNodes()
    _, corners = gmsh.model.mesh.getElementsByType(4)
    number = np.zeros(int(tags.max()) + 1, int)
    number[tags] = np.arange(len(tags))
    return Mesh(xyz.reshape(-1, 3), number[corners].reshape(-1, 4))


def angles(mesh) -> str:
    """Smallest and largest dihedral angle, degrees."""
    found = dihedral(mesh)
    return f"{found.min():.1f}-{found.max():.1f}"


def beside_gmsh(field: Field) -> tuple[str, list[dict]]:
    """The table of meshers, and its marks."""
    own = stuff(field, about_cut, 1.25, 5.0)
    made = {"xfemnav": own}

    def run(name, mesher):
        made[name] = mesher()

    runs = {"xfemnav": lambda: run("xfemnav", lambda: stuff(field, about_cut, 1.25, 5.0))}
    for name, algorithm in ALGORITHMS.items():
        runs[name] = lambda name=name, algorithm=algorithm: run(name, lambda: by_gmsh(own, algorithm))
    seconds = interleaved(runs, REPEATS)
    rate = {name: 1e5 * time / len(made[name].points) for name, time in seconds.items()}
    rows = [(name, len(mesh.points), len(mesh.cells), f"{mesh.quality.min():.3f}", angles(mesh), seconds[name],
             rate[name]) for name, mesh in made.items()]
    text = table(("mesher", "nodes", "cells", "q min", "angles", "seconds", "seconds for 100k nodes"), rows)
    over = rate["xfemnav"] / rate["gmsh Delaunay"]
    return text, [mark("mesh in space: seconds for 100k nodes", 4, rate["xfemnav"]),
                  mark("mesh in space: time over gmsh Delaunay's, for as many nodes", 0.5, over)]


def of_masks() -> tuple[str, list[dict]]:
    """The table of the twenty masks, and its marks."""
    rows, worst = [], {"q": 1.0, "low": 180.0, "high": 0.0, "defects": 0, "volume": 0.0}
    for name, (mask, affine) in masks().items():
        start = process_time()
        field = signed_distance(mask, affine)
        middle = process_time()
        mesh = stuff(field, about_place(field), 1.25, coarse_for(field))
        end = process_time()
        wrong, found, angle = defects(mesh), fidelity(field, mesh), dihedral(mesh)
        rows.append((name, len(mesh.points), f"{mesh.quality.min():.2f}", f"{angle.min():.0f}-{angle.max():.0f}",
                     sum(wrong), f"{100 * found['volume']:+.2f}", f"{found['p99']:.2f}", f"{found['far']:.2f}",
                     f"{middle - start:.2f}", f"{end - middle:.2f}"))
        worst = {"q": min(worst["q"], mesh.quality.min()), "low": min(worst["low"], angle.min()),
                 "high": max(worst["high"], angle.max()), "defects": worst["defects"] + sum(wrong),
                 "volume": max(worst["volume"], abs(found["volume"]))}
    text = table(("mask", "nodes", "q min", "angles", "defects", "volume %", "p99 mm", "far mm", "s for the distance",
                  "s for the mesh"), rows)
    return text, [mark("twenty masks: 1 - q min", 0.7, 1 - worst["q"]),
                  mark("twenty masks: 20 degrees over the smallest angle", 1, 20 / worst["low"]),
                  mark("twenty masks: largest angle, degrees", 145, worst["high"]),
                  mark("twenty masks: defects of their boundaries", 0, worst["defects"]),
                  mark("twenty masks: error of the volume", 3e-3, worst["volume"])]


def main() -> None:
    """Both tables."""
    gmsh.initialize()
    for option in ("General.Terminal", "General.NumThreads"):
        gmsh.option.setNumber(option, option.endswith("Threads"))
    field = signed_distance(*brain())
    text, marks = beside_gmsh(field)
    gmsh.finalize()
    mesh = stuff(field, lambda x: about_cut(x, COARSER), 1.25, 5.0)
    near = fidelity(field, mesh)
    text += f"\nCoarser, {len(mesh.points)} nodes: volume {100 * near['volume']:+.2f} %, p99 {near['p99']:.2f} mm.\n\n"
    marks.append(mark("mesh in space: p99 between the surfaces, 83k nodes, mm", 0.75, near["p99"]))
    rows, more = of_masks()
    keep("volume_mesh", text + rows, marks + more)


if __name__ == "__main__":
    main()
