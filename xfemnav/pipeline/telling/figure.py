"""The run in one picture: the four panels of the paper's Fig. 2, its Fig. 1, and the displacement.

Everything is drawn in the slice's plane coordinates (mm), e2 upwards and e1 to the right, or to the left in
radiological display: then the axes of the panels are inverted, and nothing else. The same data give the same bytes:
matplotlib's own defaults and font, no date, no software version.
"""

from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.figure import Figure

from xfemnav.pipeline.keeping.disk import write_atomic
from xfemnav.pipeline.telling.display import NEUROLOGICAL, convention, edges, lip_ends, lips_told, mirrored
from xfemnav.pipeline.telling.panels import (
    CUT,
    DPI,
    GAP_IN,
    LINE_LETTERS,
    OVERLAP,
    PANEL_IN,
    TIP,
    TITLE_IN,
    draw_grey,
    drawn_png,
    look_at,
    mark_sides,
    outlined,
    panels,
    scale_bar,
    window,
)

INSET, INSET_CELLS = 0.36, 6  # panel (e)'s inset: its size as a part of the panel, and how many cells it is wide
MARGIN_MM = 10.0             # shown around the organ, and around the cuts in the close view
HEAVISIDE = "#0b62a8"
FAST = {"pil_kwargs": {"compress_level": 3}}


def draw_figure(path: Path, slice, mask, problem, solution, update, display: str = NEUROLOGICAL) -> Path:
    """Write the six panels as a PNG at `path`, and return it.

    `slice` is an imaging Slice and `mask` bool (n1, n2) on its grid; `problem` and `solution` are those of mechanics;
    `update` is the result of the warp on the same grid. Only their attributes are read. `display`: neurological or
    radiological.
    """
    write_atomic(path, drawn_png(_drawn, slice, mask, problem, solution, update, display, **FAST))
    return path


def _drawn(slice, mask, problem, solution, update, display) -> Figure:
    """The figure."""
    whole = _box_of_organ(slice, mask)
    close = _box_of_cuts([*(cut.path for cut in problem.cuts), *_rings(problem)], whole)
    caption = _caption(slice, problem.cuts, display)
    figure, (a, b, c, d, e, f) = panels(*(whole[1] - whole[0]), len(caption))
    for panel in (a, b, c, d, e, f):  # before anything is drawn, which asks which way round it is
        look_at(panel, close if panel is e else whole, mirrored(slice.plane, display))
    grey = window(slice, mask)
    _preoperative(a, slice, problem, grey)
    _mask(b, slice, mask, problem)
    _mesh(c, problem)
    _updated(d, slice, mask, update, grey)
    _enrichment(e, slice, problem, close)
    _displacement(f, solution)
    for panel, ink in zip((a, b, c, d, e, f), ("white", "white", "black", "white", "black", "black")):
        box = close if panel is e else whole
        mark_sides(panel, edges(slice.plane, slice.axes, display), ink)
        scale_bar(panel, box, ink)
    figure.text(0.5, 0.1 / figure.get_figheight(), "\n".join(caption), ha="center", fontsize=9)
    return figure


def draw_pair(slice, mask, paths, update, display: str = NEUROLOGICAL) -> bytes:
    """A small PNG of the organ before, with the `paths` (k, 2) mm of its cuts, and after; else as `draw_figure`."""
    return drawn_png(_pair, slice, mask, paths, update, display)


def _pair(slice, mask, paths, update, display) -> Figure:
    """The figure of `draw_pair`."""
    whole = _box_of_organ(slice, mask)
    height = PANEL_IN * (whole[1, 1] - whole[0, 1]) / (whole[1, 0] - whole[0, 0])
    figure = Figure((2 * PANEL_IN + 3 * GAP_IN, height + TITLE_IN + GAP_IN), DPI)
    before, after = figure.subplots(1, 2, subplot_kw={"xticks": [], "yticks": []})
    figure.subplots_adjust(GAP_IN / figure.get_figwidth(), GAP_IN / figure.get_figheight(),
                           1 - GAP_IN / figure.get_figwidth(), 1 - TITLE_IN / figure.get_figheight(), 0.03)
    for panel in (before, after):
        look_at(panel, whole, mirrored(slice.plane, display))
    grey = window(slice, mask)
    draw_grey(before, slice, np.where(mask, slice.values, np.nan), grey)
    for path in paths:
        _draw_cut(before, path, CUT, "black")
        _name_lips(before, path, slice.axes, 10, CUT, "black")
    _updated(after, slice, mask, update, grey)
    for panel, title in ((before, "before"), (after, "after")):
        panel.set_title(title)
        mark_sides(panel, edges(slice.plane, slice.axes, display), "white")
        scale_bar(panel, whole, "white")
    return figure


# The panels ----------------------------------------------------------------------------------------------------------

def _preoperative(panel, slice, problem, grey):
    """Fig. 2 (a): the slice as it was scanned, with the cut."""
    panel.set_title("(a) preoperative slice with the cut")
    draw_grey(panel, slice, slice.values, grey)
    for cut in problem.cuts:
        _draw_cut(panel, cut.path, CUT, "black")
        _name_lips(panel, cut.path, slice.axes, 10, CUT, "black")
    _draw_resections(panel, problem, CUT, "black")


def _mask(panel, slice, mask, problem):
    """Fig. 2 (b): the organ, a binary image."""
    panel.set_title("(b) mask")
    draw_grey(panel, slice, mask, (0, 1))
    for cut in problem.cuts:
        _draw_cut(panel, cut.path, TIP, "white")
    _draw_resections(panel, problem, TIP, "white")


def _mesh(panel, problem):
    """Fig. 2 (c): the mesh, which knows nothing of the cut."""
    mesh = problem.mesh
    panel.set_title(f"(c) mesh: {len(mesh.points)} nodes, {len(mesh.cells)} triangles")
    _draw_mesh(panel, mesh, "0.5", 0.3)
    for cut in problem.cuts:
        _draw_cut(panel, cut.path, "black", "white")
    _draw_resections(panel, problem, "black", "white")


def _updated(panel, slice, mask, update, grey):
    """Fig. 2 (d): the slice as it is now, in the grey window of (a): the organ, what has moved out of its mask, and
    what is left without tissue, in the value that the file has there."""
    panel.set_title("(d) updated slice, masked")
    shown = mask | (update.field != 0).any(axis=2) | update.cavity | update.vacated
    draw_grey(panel, slice, np.where(shown, update.updated, np.nan), grey)
    if update.overlap.any():
        lines = [o + s * np.arange(n) for o, s, n in zip(slice.origin, slice.spacing, slice.values.shape)]
        panel.contour(*lines, update.overlap.T, levels=[0.5], colors=OVERLAP, linewidths=1.0)
        panel.set_title("(d) updated slice, masked; red: lips overlap")


def _enrichment(panel, slice, problem, box):
    """The paper's Fig. 1 on this mesh: circles are set J, squares set K; fine meshes get an inset at the tip."""
    panel.set_title("(e) the cut and its enriched nodes")
    h, width = _size_at_cuts(problem), box[1, 0] - box[0, 0]
    _draw_enriched(panel, problem, h * PANEL_IN / width)
    for cut in problem.cuts:
        _name_lips(panel, cut.path, slice.axes, 24, "black", "white")
    zoom = INSET * width / (INSET_CELLS * h)
    for tip in problem.parts.fronts.at[:1] if zoom > 2 else ():
        inset = panel.inset_axes([*_emptiest_corner(panel, box, problem), INSET, INSET], xticks=[], yticks=[], zorder=6)
        _draw_enriched(inset, problem, zoom * h * PANEL_IN / width)
        low, high = tip + np.outer([-0.5, 0.5], INSET * np.ptp(box, axis=0) / zoom)
        look_at(inset, np.array([low, high]), panel.xaxis_inverted())
        panel.indicate_inset_zoom(inset, edgecolor="black")
    panel.legend(*panel.get_legend_handles_labels(), loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, fontsize=8,
                 frameon=False, handletextpad=0.2, columnspacing=1.0)


def _size_at_cuts(problem) -> float:
    """Element size, mm, about the cuts: the median over the cells with enriched nodes, or all where there are none."""
    enriched = np.concatenate([problem.enrichment.heaviside_nodes, problem.enrichment.tip_nodes])
    cells = np.isin(problem.mesh.cells, enriched).any(axis=1)
    return float(np.median(problem.mesh.sizes[cells if cells.any() else slice(None)]))


def _draw_enriched(panel, problem, cell_in):
    """Mesh, cuts, and the nodes of J and K with marks of half a cell; a cell is `cell_in` inches wide on paper."""
    mesh, J, K = problem.mesh, problem.enrichment.heaviside_nodes, problem.enrichment.tip_nodes
    _draw_mesh(panel, mesh, "0.65", 0.5)
    for cut in problem.cuts:
        _draw_cut(panel, cut.path, "black", "white")
    _draw_resections(panel, problem, "black", "white")
    style = dict(ls="none", mfc="none", ms=float(np.clip(0.5 * 72 * cell_in, 2.5, 9.0)), mew=0.9, zorder=5)
    panel.plot(*mesh.points[J].T, marker="o", mec=HEAVISIDE, label=f"set J: {len(J)} nodes, H (Eq. 2)", **style)
    panel.plot(*mesh.points[K].T, marker="s", mec=TIP, label=f"set K: {len(K)} nodes, $F_1$..$F_4$ (Eq. 3)", **style)


def _emptiest_corner(panel, box, problem):
    """Lower left corner, as fractions of the panel, of the inset's place that is farthest from cuts and resections."""
    places = np.array([(x, y) for x in (0.01, 0.99 - INSET) for y in (0.15, 0.99 - INSET)])  # .15: above the scale bar
    within = places + INSET / 2
    if panel.xaxis_inverted():
        within = [1, 0] + [-1, 1] * within
    centres = box[0] + within * (box[1] - box[0])
    lines = [*(cut.path for cut in problem.cuts), *_rings(problem)]
    along = [start + t * (end - start) for line in lines for start, end in zip(line, line[1:])
             for t in np.linspace(0, 1, 20)]
    distance = np.linalg.norm(centres[:, None] - along, axis=2).min(axis=1)
    return places[np.argmax(distance)]


def _displacement(panel, solution):
    """How far the tissue has moved, drawn where it is now; exact, for the map is affine on each triangle."""
    moved = np.linalg.norm(solution.moved - solution.rest, axis=2).ravel()
    panel.set_title(f"(f) displacement, at most {moved.max():.1f} mm")
    corners = solution.moved.reshape(-1, 2)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    colours = panel.tripcolor(*corners.T, moved, triangles=triangles, shading="gouraud", vmin=0)
    scale = panel.inset_axes([0.15, -0.04, 0.7, 0.025])
    panel.text(0.87, -0.04, "mm", transform=panel.transAxes, va="bottom")
    panel.figure.colorbar(colours, cax=scale, orientation="horizontal")


# What the panels share -----------------------------------------------------------------------------------------------

def _draw_mesh(panel, mesh, grey, width):
    """All edges as one line with gaps: far faster to draw than one line each."""
    panel.plot(*np.insert(mesh.points[mesh.edges], 2, np.nan, axis=1).reshape(-1, 2).T, color=grey, lw=width)


def _draw_cut(panel, path, colour, halo):
    panel.plot(*path.T, color=colour, lw=1.8, solid_capstyle="butt", path_effects=outlined(3, halo))


def _rings(problem):
    """Closed outlines (k, 2) mm of everything that is taken out, their first points repeated."""
    return [np.vstack([ring, ring[:1]]) for resection in problem.resections for ring in resection.rings]


def _draw_resections(panel, problem, colour, halo):
    for ring in _rings(problem):
        panel.plot(*ring.T, color=colour, lw=1.4, ls=(0, (4, 2)), path_effects=outlined(2.4, halo))


def _name_lips(panel, path, axes, gap, colour, halo):
    """The patient's side that each lip lies towards, `gap` points beside it."""
    start, end = path[0], path[-1]
    along = (end - start) / np.linalg.norm(end - start)
    left = np.array([-along[1], along[0]]) * ([-1, 1] if panel.xaxis_inverted() else 1)
    for name, side in (("left", left), ("right", -left)):
        panel.annotate(f"{lip_ends(path, axes)[name]} lip", start + 0.5 * (end - start), gap * side,
                       textcoords="offset points", color=colour, ha=_alignment(side[0], "right", "left"),
                       va=_alignment(side[1], "top", "bottom"), path_effects=outlined(2.5, halo))


def _alignment(component, negative, positive):
    """Text alignment that keeps a label on its own side of the cut."""
    return positive if component > 0.3 else negative if component < -0.3 else "center"


def _caption(slice, cuts, display) -> list[str]:
    """Lines: what is shown, which way round, and which lip is which."""
    shown = (f"{slice.plane} slice at {slice.offset:.1f} mm, {convention(slice.plane, slice.axes, display)}. Research "
             "use only, not a medical device.")
    lips = lips_told([(cut.name, cut.path) for cut in cuts], slice.plane, slice.axes, display)
    return [line for text in (shown, lips) for line in wrap(text, LINE_LETTERS)]


def _box_of_organ(slice, mask):
    """Corners (2, 2) mm of the part to show: the organ and its margin, no side shorter than .6 of the other."""
    pixels = np.argwhere(mask)
    low, high = slice.origin + slice.spacing * [pixels.min(axis=0), pixels.max(axis=0)] + [[-MARGIN_MM], [MARGIN_MM]]
    middle, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, 0.6 * half.max())
    return np.array([middle - half, middle + half])


def _box_of_cuts(lines, whole):
    """Corners (2, 2) mm of the closest view on all lines that has the shape of `whole`; `whole` itself without any."""
    if not lines:
        return whole
    points = np.concatenate(lines)
    shape = whole[1] - whole[0]
    half = shape / 2 * ((np.ptp(points, axis=0) + 2 * MARGIN_MM) / shape).max()
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.array([middle - half, middle + half])
