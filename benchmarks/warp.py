"""Side by side: the warp's exact map and sampling against matplotlib, scipy and SimpleITK on the same mesh and image.

    python -m benchmarks.warp [--nodes 5000] [--size 512] [--repeats 7]

The rows are timed in turns, so that a busy machine is busy for all; the table has medians, minima, and the medians'
ratios to matplotlib's.
"""

import argparse
from statistics import median
from time import perf_counter

import matplotlib.tri as tri
import numpy as np
import SimpleITK as sitk
from scipy.ndimage import map_coordinates
from scipy.spatial import Delaunay

from xfemnav.imaging.warp import covered, pull_back, sample, update


def mesh(n_nodes: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) pixels on a jittered hexagonal lattice in an ellipse, and cells (m, 3), positively oriented."""
    radii = np.array([0.43, 0.47]) * size
    h = np.sqrt(np.pi * radii.prod() / n_nodes * 2 / np.sqrt(3))
    rows = np.arange(0, size, h * np.sqrt(3) / 2)
    y, x = np.meshgrid(rows, np.arange(0, size, h), indexing="ij")
    points = np.stack([x + (np.arange(len(rows)) % 2)[:, None] * h / 2, y], axis=-1).reshape(-1, 2)
    points = points[(((points - size / 2) / radii) ** 2).sum(axis=1) < 1]
    points += np.random.default_rng(0).normal(0, 0.05 * h, points.shape)
    cells = Delaunay(points).simplices
    a, b, c = points[cells].swapaxes(0, 1)
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    cells = np.where((twice > 0)[:, None], cells, cells[:, ::-1])
    return points, cells[np.abs(twice) > 0.2 * h**2]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--nodes", type=int, default=5000)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    shape, origin, spacing = (args.size, args.size), np.zeros(2), np.ones(2)
    points, cells = mesh(args.nodes, args.size)
    wave = 0.008 * args.size * np.sin(2 * np.pi * points[:, ::-1] / args.size)
    there = points + wave
    rest, moved = points[cells], there[cells]
    pixels = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).astype(float)
    image = np.random.default_rng(1).normal(size=shape)
    companions = np.random.default_rng(2).normal(size=(20, *shape))
    organ = covered(rest, origin, spacing, shape)
    pulled = pull_back(rest, moved, origin, spacing, shape)
    at = np.nan_to_num(pulled.resting).reshape(-1, 2).T
    moving = sitk.GetImageFromArray(image)
    displacement = sitk.GetImageFromArray((pulled.field[..., ::-1]).copy(), isVector=True)
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)

    def finder():
        """matplotlib's answer to which triangle a pixel is in."""
        triangulation = tri.Triangulation(*there.T, cells)
        return triangulation, triangulation.get_trifinder()

    def finder_map():
        _, find = finder()
        return find(pixels[..., 0], pixels[..., 1])

    def interpolated_map():
        triangulation, find = finder()
        return [tri.LinearTriInterpolator(triangulation, x, trifinder=find)(pixels[..., 0], pixels[..., 1])
                for x in points.T]

    def resample():
        transform = sitk.DisplacementFieldTransform(sitk.Image(displacement))
        return sitk.Resample(moving, transform, sitk.sitkLinear)

    rows = {
        "matplotlib: TriFinder, triangle of each pixel": finder_map,
        "matplotlib: LinearTriInterpolator, map": interpolated_map,
        "SimpleITK: Resample by displacement field, linear": resample,
        "scipy: map_coordinates, linear": lambda: map_coordinates(image, at, order=1),
        "xfemnav: pull_back, map": lambda: pull_back(rest, moved, origin, spacing, shape),
        "xfemnav: sample, linear": lambda: sample(image, origin, spacing, pulled.resting),
        "xfemnav: sample, cubic": lambda: sample(image, origin, spacing, pulled.resting, "cubic"),
        "xfemnav: sample, nearest": lambda: sample(image, origin, spacing, pulled.resting, "nearest"),
        "xfemnav: pull_back and update, map and one image": lambda: update(
            image, origin, spacing, organ, pull_back(rest, moved, origin, spacing, shape)),
        "xfemnav: update, 20 companions": lambda: [
            update(companion, origin, spacing, organ, pulled) for companion in companions],
    }
    for run in rows.values():
        run()    # compiled kernels are loaded
    seconds = {name: [] for name in rows}
    for _ in range(args.repeats):
        for name, run in rows.items():
            start = perf_counter()
            run()
            seconds[name].append(perf_counter() - start)
    theirs = np.stack([np.ma.filled(x, np.nan) for x in interpolated_map()], axis=-1)
    both = np.isfinite(theirs[..., 0]) & pulled.tissue
    reference = median(seconds["matplotlib: TriFinder, triangle of each pixel"])
    print(f"{len(points)} nodes, {len(cells)} triangles, {args.size}^2 pixels, {args.repeats} repeats")
    print(f"{'':52s} median ms    min ms    ratio")
    for name, times in seconds.items():
        print(f"{name:52s} {1e3 * median(times):9.2f} {1e3 * min(times):9.2f}  {median(times) / reference:7.4f}")
    print(f"maps agree to {np.abs(theirs - pulled.resting)[both].max():.1e} px on {both.sum()} pixels")


if __name__ == "__main__":
    main()
