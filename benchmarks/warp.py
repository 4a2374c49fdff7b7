"""Side by side: the warp's exact map and sampling against matplotlib, scipy and SimpleITK on the same mesh and image.

    python -m benchmarks.warp

5k nodes, 512 x 512 pixels.
"""

from benchmarks.probes import sample

from benchmarks.timing import interleaved, keep, mark, table  # isort: skip (sets the number of threads)

import matplotlib.tri as tri
import numpy as np
import SimpleITK as sitk
from scipy.ndimage import map_coordinates
from scipy.spatial import Delaunay

from xfemnav.imaging.carrying.voxels import sample_volume
from xfemnav.imaging.carrying.warp import covered, pull_back, update

NODES, SIZE, REPEATS = 5_000, 512, 9
LINEAR, ITK = "matplotlib: LinearTriInterpolator, map", "SimpleITK: Resample by displacement field, linear"
ONE, EACH = "xfemnav: pull_back and update, map and one image", "xfemnav: update, 20 images one by one"
MANY = "xfemnav: sample_volume, 20 companions on the grid"


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
    shape, origin, spacing = (SIZE, SIZE), np.zeros(2), np.ones(2)
    points, cells = mesh(NODES, SIZE)
    wave = 0.008 * SIZE * np.sin(2 * np.pi * points[:, ::-1] / SIZE)
    there = points + wave
    rest, moved = points[cells], there[cells]
    pixels = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).astype(float)
    image = np.random.default_rng(1).normal(size=shape)
    companions = np.random.default_rng(2).normal(size=(20, *shape))
    organ = covered(rest, origin, spacing, shape)
    pulled = pull_back(rest, moved, origin, spacing, shape)
    at = np.nan_to_num(pulled.resting).reshape(-1, 2).T
    places = pulled.places[pulled.tissue]
    stacked, flat = np.ascontiguousarray(companions.transpose(1, 2, 0)[:, :, None]), np.eye(3)[:, :2]
    volume = np.random.default_rng(3).normal(size=(SIZE // 2, SIZE // 2, 64, 1))
    tilted = np.array([[0.5, 0], [0, 0.5], [0.01, 0.013]])
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
        LINEAR: interpolated_map,
        ITK: resample,
        "scipy: map_coordinates, linear": lambda: map_coordinates(image, at, order=1),
        "xfemnav: pull_back, map": lambda: pull_back(rest, moved, origin, spacing, shape),
        "xfemnav: sample, linear": lambda: sample(image, origin, spacing, pulled.resting),
        "xfemnav: sample, cubic": lambda: sample(image, origin, spacing, pulled.resting, "cubic"),
        "xfemnav: sample, nearest": lambda: sample(image, origin, spacing, pulled.resting, "nearest"),
        ONE: lambda: update(
            image, organ, pull_back(rest, moved, origin, spacing, shape)),
        EACH: lambda: [
            update(companion, organ, pulled) for companion in companions],
        MANY: lambda: sample_volume(stacked, flat, np.zeros(3), places, "linear"),
        "xfemnav: sample_volume, one companion in 3-D": lambda: sample_volume(
            volume, tilted, np.array([0, 0, 20.0]), places, "linear"),
    }
    seconds = interleaved(rows, REPEATS)
    theirs = np.stack([np.ma.filled(x, np.nan) for x in interpolated_map()], axis=-1)
    both = np.isfinite(theirs[..., 0]) & pulled.tissue
    off = np.abs(theirs - pulled.resting)[both].max()
    linear, itk = seconds[LINEAR], seconds[ITK]
    text = table(("what", "ms", "over LinearTriInterpolator", "over SimpleITK"),
                 [(name, 1e3 * time, f"{time / linear:.4f}", f"{time / itk:.4f}") for name, time in seconds.items()])
    text += f"\n{len(points)} nodes, {len(cells)} triangles; the maps agree to {off:.0e} px on {both.sum()} pixels.\n"
    one, many = seconds[ONE], seconds[MANY]
    keep("warp", text, [
        mark("warp: map and one image over matplotlib's LinearTriInterpolator", 1 / 20, one / linear),
        mark("warp: map and one image over SimpleITK's resampling alone", 1 / 5, one / itk),
        mark("warp: 20 companions, ms", 15, 1e3 * many),
        mark("warp: map beside matplotlib's, px", 1e-3, off),
    ])


if __name__ == "__main__":
    main()
