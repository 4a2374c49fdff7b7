"""xfemnav's mesh generator beside gmsh's frontal algorithm on one brain outline.

    python -m benchmarks.mesh

Both get the same nodes on the outline, as gmsh would be used with a contour of an image, and their time runs from these
nodes (xfemnav: from the outline itself) to arrays of points and triangles. distmeshpy, where it is installed, is timed
once at 5k nodes.
"""

from benchmarks.timing import exponent, interleaved, keep, mark, table  # isort: skip (sets the number of threads)

import importlib.util
from time import process_time

import gmsh
import numpy as np
import shapely
from nilearn.datasets import load_mni152_brain_mask
from scipy.ndimage import map_coordinates

from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.rail import outline_nodes, rail_nodes
from xfemnav.imaging.organ.outline import outline_of

#: Number of nodes, and repetitions.
TARGETS = {1_000: 7, 5_000: 7, 20_000: 5, 80_000: 5}


def brain_outline() -> np.ndarray:
    """Outline (n, 2) mm of the MNI152 brain, the axial slice at 52 % of its height."""
    image = load_mni152_brain_mask(resolution=1)
    mask = np.asarray(image.dataobj) > 0
    return outline_of(mask[:, :, int(0.52 * mask.shape[2])], (0.0, 0.0), (1.0, 1.0))


def gmsh_frontal(nodes, h) -> Mesh:
    """Mesh of the polygon `nodes` (n, 2) mm by gmsh's frontal-Delaunay algorithm."""
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
    return Mesh(xyz.reshape(-1, 3)[:, :2], number[corners].reshape(-1, 3))


def hausdorff(outline, mesh) -> float:
    """Hausdorff distance, mm, between the outline and the mesh's boundary."""
    rings = [shapely.LinearRing(loop) for loop in (outline, mesh.outline)]
    return shapely.hausdorff_distance(*(shapely.segmentize(ring, 0.2) for ring in rings))


def distmeshpy_seconds(outline, h) -> float:
    """Seconds of distmeshpy for the inside of the outline, from its signed distance on a grid of .25 mm."""
    from distmeshpy import distmesh2d

    low, high, step = outline.min(axis=0) - 2 * h, outline.max(axis=0) + 2 * h, 0.25
    grid = np.stack(np.meshgrid(*(np.arange(a, b + step, step) for a, b in zip(low, high)), indexing="ij"), axis=-1)
    distance = shapely.distance(shapely.LinearRing(outline), shapely.points(grid))
    distance[shapely.contains_xy(shapely.Polygon(outline), grid[..., 0], grid[..., 1])] *= -1

    def signed(points, **_):
        return map_coordinates(distance, ((points - low) / step).T, order=1, mode="nearest")

    start = process_time()
    box = tuple(zip(outline.min(axis=0), outline.max(axis=0)))
    distmesh2d(signed, lambda points, **_: np.ones(len(points)), h, box)
    return process_time() - start


def main() -> None:
    """Print one row for each size and mesher."""
    outline = brain_outline()
    area = shapely.Polygon(outline).area
    gmsh.initialize()
    for option, value in {"General.Terminal": 0, "Mesh.Algorithm": 6, "General.NumThreads": 1}.items():
        gmsh.option.setNumber(option, value)
    rows, sizes, seconds, marks = [], [], [], []
    for target, repeats in TARGETS.items():
        h = np.sqrt(area / (target * np.sqrt(3) / 2))
        nodes, made = rail_nodes(outline_nodes(outline, lambda points, h=h: np.full(len(points), h))), {}
        runs = {"xfemnav": lambda h=h: distmesh(outline, h), "gmsh frontal": lambda h=h, n=nodes: gmsh_frontal(n, h)}

        def kept(name, run, made=made):
            made[name] = run()

        times = interleaved({name: lambda name=name, run=run: kept(name, run) for name, run in runs.items()}, repeats)
        far = {name: hausdorff(outline, mesh) for name, mesh in made.items()}
        for name, mesh in made.items():
            rows.append((name, len(mesh.points), times[name], times[name] / times["gmsh frontal"],
                         mesh.quality.min(), f"{mesh.quality.mean():.4f}", far[name]))
        sizes.append(len(made["xfemnav"].points))
        seconds.append(times["xfemnav"])
        if target >= 5_000:
            marks += [
                mark(f"mesh: {what}, {target // 1000}k nodes", limit, measured)
                for what, limit, measured in (
                    ("time over gmsh's", 0.35, times["xfemnav"] / times["gmsh frontal"]),
                    ("1 - q min", 0.25, 1 - made["xfemnav"].quality.min()),
                    ("Hausdorff distance over gmsh's", 1.1, far["xfemnav"] / far["gmsh frontal"]),
                )
            ]
        if target == 5_000 and importlib.util.find_spec("distmeshpy"):
            theirs = distmeshpy_seconds(outline, h)
            rows.append(("distmeshpy", target, theirs, theirs / times["gmsh frontal"], "", "", ""))
            marks.append(mark("mesh: time over distmeshpy's, 5k nodes", 0.01, times["xfemnav"] / theirs))
    gmsh.finalize()
    marks.append(mark("mesh: growth from 5k to 80k nodes, power of N", 1.15, exponent(sizes[1:], seconds[1:])))
    text = table(("mesher", "nodes", "seconds", "over gmsh", "q min", "q mean", "Hausdorff mm"), rows)
    text += f"\nGrowth of xfemnav from 5k to 80k nodes: N^{exponent(sizes[1:], seconds[1:]):.2f}.\n"
    keep("mesh", text, marks)


if __name__ == "__main__":
    main()
