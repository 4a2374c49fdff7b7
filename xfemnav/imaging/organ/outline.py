"""A pixel mask -> its smooth outline, finer than a pixel.

The outline of a raw mask is a staircase, and a mesh that follows it has slivers. Smoothing the binary mask with a
Gaussian of one pixel before taking the half level leaves no stairs. It is curvature flow: a boundary of radius R moves
inwards by sigma^2 / (2 R), and an outline of any shape loses pi sigma^2, three pixels of area.
"""

import numpy as np
import shapely
from skimage import measure

from xfemnav.errors import XfemnavError, warn

SIGMA = 1.0  # pixels
SPECK = 1e-3  # of the organ's area: what may come off without a word
REACH = 4  # of the Gaussian, pixels
WEIGHTS = np.exp(-0.5 / SIGMA**2 * np.arange(-REACH, REACH + 1) ** 2)
WEIGHTS = WEIGHTS / WEIGHTS.sum()
MARGIN = 5  # pixels of background added around the slice, so that an organ cut by the slice's edge has an outline


def outline_of(mask: np.ndarray, origin, spacing) -> np.ndarray:
    """Outline (n, 2) plane mm of the organ in `mask` (n1, n2): its longest closed loop.

    Counter-clockwise, the last point not repeated, a simple polygon. Pixel (i, j) is centred at
    origin + (i, j) * spacing. Raises E201 when the mask is empty or too thin to have an inside; warns (W207) of other
    loops: what hangs on by less than two pixels comes off when the mask is smoothed.
    """
    loops = _loops(mask)
    polygons = [part for loop in loops for part in shapely.get_parts(shapely.make_valid(shapely.Polygon(loop)))]
    organ = max(polygons, key=lambda part: part.area, default=shapely.Polygon())
    if organ.area == 0:
        raise XfemnavError("E201", f"the mask has no inside: its {int(np.sum(mask))} pixels are nowhere two wide. "
                                   "Give another ⟦mask=FILE⟧.")
    lost = sum(part.area for part in polygons) - organ.area
    if lost > SPECK * organ.area:
        area = lost * float(np.prod(spacing))
        warn("W207", f"{area:.1f} mm2 of the mask hang on by less than two pixels and are left out.")
    loop = shapely.get_coordinates(shapely.geometry.polygon.orient(organ).exterior)[:-1]
    apart = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1) > 1e-3  # pixels; level crossings beside a node
    return np.asarray(origin, float) + (loop[apart] - MARGIN) * np.asarray(spacing, float)


def rings_of_mask(mask: np.ndarray, origin, spacing) -> tuple[np.ndarray, ...]:
    """All closed outlines (k, 2) plane mm of a mask, holes too, smoothed as `outline_of`; none when it is empty."""
    return tuple(np.asarray(origin, float) + (loop - MARGIN) * np.asarray(spacing, float) for loop in _loops(mask))


def _loops(mask):
    """Closed contours (k, 2) pixels of the smoothed mask, in the array with its margin."""
    return [loop[:-1] for loop in measure.find_contours(_smoothed(mask), 0.5) if len(loop) > 3]


def _smoothed(mask):
    """The mask in its margin (n1 + 2 MARGIN, n2 + 2 MARGIN) after a Gaussian of SIGMA, cut off at REACH."""
    values = np.pad(np.asarray(mask, float), MARGIN)
    for axis in (0, 1):
        wide = np.pad(values, [(REACH, REACH) if k == axis else (0, 0) for k in (0, 1)])
        shifted = [wide[k:][:len(values)] if axis == 0 else wide[:, k:][:, :values.shape[1]]
                   for k in range(2 * REACH + 1)]
        values *= WEIGHTS[REACH]
        for k in range(REACH):  # the small terms first
            both = shifted[k] + shifted[-1 - k]
            both *= WEIGHTS[k]
            values += both
    return values
