"""xfemnav's mesh generator beside gmsh's frontal algorithm on one brain outline, interleaved in one process.

    python benchmarks/mesh.py [repetitions]

Both get the same nodes on the outline, as gmsh would be used with a contour of an image, and their time runs from these
nodes (xfemnav: from the outline itself) to arrays of points and triangles. Medians; trust the ratios, not the seconds.
"""

import sys
import time

import gmsh
import numpy as np
import shapely
from nilearn.datasets import load_mni152_brain_mask

from xfemnav.geometry.distmesh import distmesh
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.outline_nodes import outline_nodes, rail_nodes
from xfemnav.imaging.outline import outline_of

TARGETS = (1_000, 5_000, 20_000, 80_000)


def brain_outline() -> np.ndarray:
    """Outline (n, 2) mm of the MNI152 brain, the axial slice at 52 % of its height."""
    image = load_mni152_brain_mask(resolution=1)
    mask = np.asarray(image.dataobj) > 0
    return outline_of(mask[:, :, int(0.52 * mask.shape[2])], (0.0, 0.0), (1.0, 1.0))


def gmsh_frontal(nodes, h) -> tuple[Mesh, float]:
    """Mesh of the polygon `nodes` (n, 2) mm by gmsh's frontal-Delaunay algorithm, and the seconds it took."""
    start = time.perf_counter()
    gmsh.clear()
    points = [gmsh.model.geo.addPoint(x, y, 0, h) for x, y in nodes]
    lines = [gmsh.model.geo.addLine(a, b) for a, b in zip(points, points[1:] + points[:1])]
    for line in lines:
        gmsh.model.geo.mesh.setTransfiniteCurve(line, 2)
    gmsh.model.geo.addPlaneSurface([gmsh.model.geo.addCurveLoop(lines)])
    gmsh.model.geo.synchronize()
    gmsh.model.mesh.generate(2)
    tags, xyz, _ = gmsh.model.mesh.getNodes()
    _, corners = gmsh.model.mesh.getElementsByType(2)
    number = np.zeros(int(tags.max()) + 1, int)
    number[tags] = np.arange(len(tags))
    arrays = xyz.reshape(-1, 3)[:, :2], number[corners].reshape(-1, 3)
    seconds = time.perf_counter() - start
    return Mesh(*arrays), seconds


def own(outline, h) -> tuple[Mesh, float]:
    """Mesh by xfemnav, and the seconds it took."""
    start = time.perf_counter()
    mesh = distmesh(outline, h)
    return mesh, time.perf_counter() - start


def hausdorff(outline, mesh) -> float:
    """Hausdorff distance, mm, between the outline and the mesh's boundary."""
    rings = [shapely.LinearRing(loop) for loop in (outline, mesh.points[mesh.boundary_loops[0]])]
    return shapely.hausdorff_distance(*(shapely.segmentize(ring, 0.2) for ring in rings))


def main(repetitions: int = 5) -> None:
    """Print one row for each size and mesher."""
    outline = brain_outline()
    area = shapely.Polygon(outline).area
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("Mesh.Algorithm", 6)
    gmsh.option.setNumber("General.NumThreads", 1)
    own(outline, np.sqrt(area / 500))  # loads the compiled kernels
    print(f"outline: {len(outline)} points, {area:.0f} mm2; medians of {repetitions}")
    print("| mesher | nodes | seconds | ratio | q_min | q_mean | Hausdorff mm |\n|---|---|---|---|---|---|---|")
    for target in TARGETS:
        h = np.sqrt(area / (target * np.sqrt(3) / 2))
        nodes = rail_nodes(outline_nodes(outline, lambda points, h=h: np.full(len(points), h)))
        runs = [(own(outline, h), gmsh_frontal(nodes, h)) for _ in range(repetitions)]
        peer = np.median([seconds for _, (_, seconds) in runs])
        for name, column in (("xfemnav", 0), ("gmsh frontal", 1)):
            mesh, seconds = runs[0][column][0], np.median([run[column][1] for run in runs])
            figures = (f"{seconds:.3f}", f"{seconds / peer:.2f}", f"{mesh.quality.min():.2f}",
                       f"{mesh.quality.mean():.4f}", f"{hausdorff(outline, mesh):.3f}")
            print(f"| {name} | {len(mesh.points)} | " + " | ".join(figures) + " |")
    gmsh.finalize()


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
