"""A run of a volume in one picture: three planes through the middle of what the cut opens, before, after, and how far
the tissue has moved.

Each plane is one of voxels, a Slice of the volume, and drawn as slices are (see `figure`): in its plane coordinates,
mm, turned by `display`.
"""

from dataclasses import replace
from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.figure import Figure

from xfemnav.geometry.mesh import area_vectors
from xfemnav.imaging.frames.slices import PLANES, take_slice
from xfemnav.pipeline.keeping.disk import write_atomic
from xfemnav.pipeline.telling.display import NEUROLOGICAL, edges, in_space, left_of, mirrored
from xfemnav.pipeline.telling.panels import (
    CUT,
    LINE_LETTERS,
    OVERLAP,
    TIP,
    draw_grey,
    drawn_png,
    look_at,
    mark_sides,
    outlined,
    panels,
    scale_bar,
    window,
)

MARGIN_MM = 35.0  # shown around the cut
LIPS = (("left", CUT), ("right", TIP))


def draw_solid_figure(path: Path, volume, mask, problem, solution, update, display: str = NEUROLOGICAL) -> Path:
    """Write the nine panels as a PNG at `path`, and return it.

    `volume` is an imaging Volume and `mask` bool (n1, n2, n3) on its grid; the others as in `figure.draw_figure`.
    """
    write_atomic(path, drawn_png(_drawn, volume, mask, problem, solution, update, display))
    return path


def _drawn(volume, mask, problem, solution, update, display) -> Figure:
    """The figure."""
    rest, lips = problem.parts.lips.facets, solution.lips.swapaxes(0, 1)
    middle = middle_of(rest, lips) if len(rest) else problem.mesh.points.mean(axis=0)
    caption = _caption(problem.cuts, middle, display)
    figure, found = panels(1, 1, len(caption), rows=3)
    grey, most = window(volume, mask), solution.max_displacement_mm
    planes = [_through(volume, plane, middle) for plane in PLANES]
    boxes = _boxes(planes, np.concatenate([rest, *lips]), problem.mesh.points)
    for k, (shown, box) in enumerate(zip(planes, boxes)):
        before, after, moved = found[k::3]
        for panel in (before, after, moved):
            look_at(panel, box, mirrored(shown.plane, display))
        draw_grey(before, shown, shown.values, grey)
        before.set_title(f"{shown.plane} slice at {shown.offset:.1f} mm, before, with the cut")
        _draw_section(before, shown, rest, CUT)
        _after(after, volume, shown, update, lips, grey)
        colours = _displacement(moved, volume, shown, update, most)
        for panel, ink in ((before, "white"), (after, "white"), (moved, "black")):
            mark_sides(panel, edges(shown.plane, shown.axes, display), ink)
            scale_bar(panel, box, ink)
    scale = found[7].inset_axes([0.15, -0.05, 0.7, 0.025])
    found[7].text(0.87, -0.05, "mm", transform=found[7].transAxes, va="bottom")
    figure.colorbar(colours, cax=scale, orientation="horizontal")
    figure.text(0.5, 0.1 / figure.get_figheight(), "\n".join(caption), ha="center", fontsize=9)
    return figure


def _through(volume, plane, point):
    """The slice of a volume in a plane through a point (3,) mm: of voxels, whose normal is not quite the world's."""
    normal = take_slice(volume, plane=plane, index=0).axes[2]
    return take_slice(volume, plane=plane, position_mm=float(normal @ point))


def middle_of(rest, lips) -> np.ndarray:
    """The middle (3,) mm of what the cut opens: of its facets `rest` (l, 3, 3) mm, weighted by how far their two
    `lips` (2, l, 3, 3) mm are apart; of all of them alike where nothing opens."""
    areas = np.linalg.norm(area_vectors(rest), axis=1)
    gaps = np.linalg.norm((lips[0] - lips[1]).mean(axis=1), axis=1)
    weights = areas * gaps if (areas * gaps).sum() > 0 else areas
    return np.average(rest.mean(axis=1), axis=0, weights=weights)


def section(triangles, slice) -> np.ndarray:
    """Segments (k, 2, 2) plane mm in which triangles (f, 3, 3) mm cross the plane of a slice."""
    at, height = slice.from_world(triangles)
    crosses = (height >= 0) != (np.roll(height, -1, axis=1) >= 0)
    at, height, crosses = (values[crosses.any(axis=1)] for values in (at, height, crosses))
    step = np.where(crosses, height - np.roll(height, -1, axis=1), 1.0)
    points = at + (height / step)[..., None] * (np.roll(at, -1, axis=1) - at)
    return points[crosses].reshape(-1, 2, 2)


def _boxes(planes, cut, organ):
    """Corners (2, 2) mm of what each panel shows, squares of one size: a cut's triangles (f, 3, 3) mm and a margin, or
    the `organ` (n, 3) mm where that is smaller."""
    def square(points):
        ends = [(at.min(axis=0), at.max(axis=0)) for at in (plane.from_world(points)[0] for plane in planes)]
        return [(low + high) / 2 for low, high in ends], max(np.max(high - low) for low, high in ends) / 2 + MARGIN_MM

    far = square(organ)
    near = square(cut.reshape(-1, 3)) if len(cut) else far
    middles, half = min(near, far, key=lambda each: each[1])
    return [np.array([middle - half, middle + half]) for middle in middles]


def _draw_section(panel, slice, triangles, colour):
    """All segments as one line with gaps."""
    ends = np.insert(section(triangles, slice), 2, np.nan, axis=1).reshape(-1, 2)
    panel.plot(*ends.T, color=colour, lw=1.6, solid_capstyle="round", path_effects=outlined(2.8, "black"))


def _after(panel, volume, slice, update, lips, grey):
    """The slice as it is now, with both lips, and a red line about tissue that lies twice."""
    draw_grey(panel, slice, _in(volume, slice, update.updated), grey)
    panel.set_title("after")
    twice = _in(volume, slice, update.overlap)
    if twice.any():
        lines = [o + s * np.arange(n) for o, s, n in zip(slice.origin, slice.spacing, slice.values.shape)]
        panel.contour(*lines, twice.T, levels=[0.5], colors=OVERLAP, linewidths=1.0)
        panel.set_title("after; red: tissue lies twice")
    for (_, colour), facets in zip(LIPS, lips):
        _draw_section(panel, slice, facets, colour)


def _displacement(panel, volume, slice, update, most):
    """How far the tissue in each voxel of the slice has moved."""
    here = np.zeros(volume.values.shape, bool)
    here.swapaxes(0, slice.array_axes[2])[slice.index] = True
    here &= update.pull_back.tissue
    moved = np.full(volume.values.shape, np.nan, np.float32)
    shift = update.pull_back.places_of(here) - update.pull_back.centres_of(np.argwhere(here))
    moved[here] = np.linalg.norm(shift, axis=1)
    low = slice.origin - slice.spacing / 2
    high = low + slice.values.shape * slice.spacing
    panel.set_title(f"displacement, at most {most:.1f} mm")
    return panel.imshow(_in(volume, slice, moved).T, vmin=0, vmax=max(most, 1e-9), interpolation="nearest",
                        origin="lower", extent=(low[0], high[0], low[1], high[1]))


def _in(volume, slice, values):
    """`values` (n1, n2, n3) of the volume in a slice of it, (m1, m2) along e1 and e2."""
    return take_slice(replace(volume, values=values), plane=slice.plane, index=slice.index).values


def _caption(cuts, middle, display) -> list[str]:
    """Lines: what is shown, which way round, and which lip is which."""
    place = ", ".join(f"{round(x, 1) + 0.0:.1f}" for x in middle)  # no -0.0
    shown = (f"Planes of voxels about ({place}) mm, the middle of what the cut opens; {in_space(display)}. Research "
             "use only, not a medical device.")
    lips = " ".join(f"Left of '{cut.name}', yellow, is the {left_of(cut.left)} lip; right of it, orange, the other."
                    for cut in cuts)
    return [line for text in (shown, lips) for line in wrap(text, LINE_LETTERS)]
