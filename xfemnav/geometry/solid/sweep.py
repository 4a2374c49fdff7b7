"""Sheets drawn by hand: a curve on the cortex swept into the depth, or a flat rectangle; clipped to the organ."""

from collections.abc import Callable

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.geometry.solid.sheet import Sheet

#: Distance (mm) of the sheet's vertices, along and down.
STEP_MM = 1.5
#: The organ's surface is looked for this far (mm) outside and inside of where a curve was drawn.
DRAWN_OFF_MM = 20.0
#: A sheet goes on outside of the organ by this (mm): no node of a mesh lies so far out.
PROLONG_MM = 8.0
#: The inward direction is that of the surface within this (mm).
AROUND_MM = 10.0


def swept(field: Callable, curve, *, towards=None, depth_mm: float | None = None, name: str = "cut",
          craniotomy: bool = True) -> Sheet:
    """The sheet that a curve sweeps `towards` a point (3,) mm, which is its front, or along the organ's inward normal
    to `depth_mm` below its surface, or so far towards the point.

    field: points (n, 3) mm -> signed distance (n,) mm from the organ's surface, positive inside; curve (k, 3) mm, on
    the cortex or near it.

    Raises
    ------
    XfemnavError
        E301 no part of it enters the organ; E302 the curve lies deep inside; E303 it has no length, or no depth.
    """
    curve = resampled(np.asarray(curve, float), name)
    if towards is not None:
        target = np.asarray(towards, float)
        ways = target - curve
        far = np.linalg.norm(ways, axis=1)
        if far.min() < STEP_MM:
            raise XfemnavError("E303", f"cut '{name}' has no depth: its target {_mm(target)} lies on its curve; give "
                                       "the "
                                       "deep end of the approach.")
        ways /= far[:, None]
    else:
        ways, far = inward(field, curve, name), np.full(len(curve), np.inf)
    enters = _entries(field, curve, ways, np.full(len(curve), -DRAWN_OFF_MM), np.minimum(DRAWN_OFF_MM, far))
    _refuse_unentered(field, curve, enters, name)
    start = np.where(np.isfinite(enters), enters, np.nanmean(np.where(np.isfinite(enters), enters, np.nan)))
    if depth_mm is not None:
        far = np.minimum(far, start + depth_mm)
    if not (far - start).min() > 0:
        raise XfemnavError("E303", f"cut '{name}' has no depth where it enters the organ at "
                                   f"{_mm(curve[np.argmin(far - start)])} mm; give a deeper target, or more "
                                   "⟦depth_mm⟧.")
    return _grid(curve, ways, start, far, PROLONG_MM, name, craniotomy, np.isfinite(enters))


def flat(field: Callable, centre, axes, size, *, name: str = "cut", craniotomy: bool = True) -> Sheet:
    """A rectangle about `centre` (3,) mm, `size` (2,) mm along the first two of its `axes`, unit rows (3, 3): its left
    is where the third, its normal, points. It goes into the depth along that axis on which it leaves the organ most.

    Raises XfemnavError E301 where no part of it lies in the organ, E303 for one without area.
    """
    (x, y, normal), (width, height) = np.asarray(axes, float), np.asarray(size, float)
    if not min(width, height) > STEP_MM:
        raise XfemnavError("E303", f"cut '{name}' is {width:g} x {height:g} mm: it has no area; give the plane its "
                                   "size.")
    outside = {}
    for k, (axis, long, across, wide) in enumerate(((x, width, y, height), (y, height, x, width))):
        for sign in (1, -1):
            ends = np.linspace(-0.5, 0.5, 9)[:, None] * wide * across - sign * long / 2 * axis
            outside[k, sign] = field(centre + ends).mean()
    k, sign = min(outside, key=outside.get)
    down, depth, wide = sign * (x, y)[k], (width, height)[k], (height, width)[k]
    along = np.cross(down, normal)
    n = max(3, int(np.ceil(wide / STEP_MM)) + 1)
    curve = centre - depth / 2 * down + np.linspace(-wide / 2, wide / 2, n)[:, None] * along
    ways, far = np.tile(down, (n, 1)), np.full(n, depth)
    enters = _entries(field, curve, ways, np.zeros(n), far)
    grid = curve[:, None] + np.linspace(0, depth, 40)[:, None] * down
    if not (field(grid.reshape(-1, 3)) > 0).any():
        raise XfemnavError("E301", f"cut '{name}' does not enter the organ: its plane about {_mm(centre)} mm lies "
                                   "outside of "
                                   "it; is it in the image's frame?")
    entered = np.isfinite(enters)
    start = np.where(entered, enters, enters[entered].mean() if entered.any() else 0.0)
    return _grid(curve, ways, start, far, start if entered.any() else 0.0, name, craniotomy and entered.any(), entered)


def resampled(curve, name: str) -> np.ndarray:
    """Points (k, 3) mm about STEP_MM apart on a polyline (n, 3) mm. Raises XfemnavError E303 for one of no length."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    if len(curve) < 2 or not arc[-1] > STEP_MM:
        raise XfemnavError("E303", f"cut '{name}' has no length: its points lie within {arc[-1]:.2g} mm; draw a line "
                                   "on the "
                                   "cortex.")
    at = np.linspace(0, arc[-1], max(3, int(np.ceil(arc[-1] / STEP_MM)) + 1))
    return np.stack([np.interp(at, arc, x) for x in curve.T], axis=1)


def inward(field: Callable, curve, name: str) -> np.ndarray:
    """Unit normals (k, 3) of the organ's surface about a curve (k, 3) mm, inwards, smooth along it."""
    ways = np.stack([field(curve + AROUND_MM * e) - field(curve - AROUND_MM * e) for e in np.eye(3)], axis=1)
    length = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
    at = np.linspace(0, length, len(curve))
    weight = np.exp(-(((at[:, None] - at) / AROUND_MM) ** 2))
    ways = weight @ ways
    size = np.linalg.norm(ways, axis=1)
    if not size.min() > 1e-3:
        raise XfemnavError("E301", f"cut '{name}' is nowhere near the organ's surface at {_mm(curve[np.argmin(size)])} "
                                   "mm; "
                                   "draw it on the cortex, or give ⟦towards⟧.")
    return ways / size[:, None]


def _entries(field, curve, ways, low, high):
    """How far (k,) mm along its way from each point of a curve the organ begins, of several places the nearest to the
    curve; infinite where it does not between `low` and `high` (k,) mm."""
    steps = np.linspace(0, 1, 81)[:, None] * (high - low) + low
    depth = field((curve + steps[..., None] * ways).reshape(-1, 3)).reshape(steps.shape)
    enters = (depth[:-1] <= 0) & (depth[1:] > 0)
    share = np.divide(-depth[:-1], depth[1:] - depth[:-1], out=np.zeros_like(depth[1:]), where=enters)
    at = np.where(enters, steps[:-1] + share * (steps[1:] - steps[:-1]), np.inf)
    return np.take_along_axis(at, np.abs(at).argmin(axis=0)[None], axis=0)[0]


def _refuse_unentered(field, curve, enters, name):
    if np.isfinite(enters).mean() >= 0.5:
        return
    depth = field(curve)
    k = int(np.argmax(np.abs(depth)))
    if depth[k] > 0:
        raise XfemnavError("E302", f"cut '{name}' is drawn {depth[k]:.0f} mm deep inside the organ at {_mm(curve[k])} "
                                   "mm; draw "
                                   "its curve on the cortex, where it enters.")
    raise XfemnavError("E301", f"cut '{name}' does not enter the organ: its curve lies {-depth[k]:.0f} mm outside of "
                               "it at "
                               f"{_mm(curve[k])} mm; is it in the image's frame, and on its surface?")


def _grid(curve, ways, start, far, out, name, craniotomy, entered):
    """The sheet of all ways from `out` mm before the organ begins at `start` (k,) to its front at `far` (k,) mm."""
    depth = float((far - start).max())
    down = np.linspace(0, 1, max(3, int(np.ceil(depth / STEP_MM)) + 1))
    out = np.broadcast_to(out, start.shape)
    before = np.linspace(-1, 0, int(np.ceil(out.max() / STEP_MM)) + 1)[:-1] if out.max() > 0 else np.empty(0)
    at = np.concatenate([start + before[:, None] * out, start + down[:, None] * (far - start)])
    share = np.concatenate([before[:, None] * out / (far - start), np.repeat(down[:, None], len(curve), axis=1)])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    vertices = (curve + at[..., None] * ways).reshape(-1, 3)
    chart = np.stack([np.tile(along / along[-1], len(at)), share.ravel()], axis=1)
    n = len(curve)
    corner = (np.arange(len(at) - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([corner, corner + 1, corner + n], axis=1),
                                np.stack([corner + 1, corner + n + 1, corner + n], axis=1)])
    mouth = (curve + start[:, None] * ways)[entered]
    return merged(Sheet(vertices, triangles, chart, mouth, name, bool(craniotomy)))


def merged(sheet: Sheet) -> Sheet:
    """The sheet with vertices at one place as one, their chart coordinates in the mean, and without flat triangles."""
    _, first, same = np.unique(np.round(sheet.vertices / 1e-6).astype(np.int64), axis=0, return_index=True,
                               return_inverse=True)
    same = same.ravel()
    count = np.bincount(same)
    at = np.stack([np.bincount(same, x) / count for x in sheet.at.T], axis=1)
    triangles = same[sheet.triangles]
    x = sheet.vertices[first][triangles]
    area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / 2
    solid = area > 1e-6 * np.median(area)
    return Sheet(sheet.vertices[first], triangles[solid], at, sheet.mouth_line, sheet.name, sheet.craniotomy)


def _mm(point):
    return f"({', '.join(f'{x:.1f}' for x in point)})"
