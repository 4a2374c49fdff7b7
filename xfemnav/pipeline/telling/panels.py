"""What the figures of a slice and of a volume share: panels over a caption, grey images in plane coordinates, marks."""

from io import BytesIO

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from xfemnav.imaging.carrying.background import blank_of

PANEL_IN, DPI = 4.0, 140     # width of a panel, and dots an inch
TITLE_IN, GAP_IN, FOOT_IN = 0.35, 0.12, 0.6  # above each row, between panels, below the last row
LINE_IN, LINE_LETTERS = 0.17, 170  # of the caption below that
CUT, TIP, OVERLAP = "#ffd21f", "#d1410c", "#ff3030"


def drawn_png(draw, *data, **how) -> bytes:
    """The figure that `draw` makes of the `data`, as a PNG: matplotlib's own settings, no date, no software version.

    `how`: what else the writer of PNG files takes.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        png = BytesIO()
        draw(*data).savefig(png, format="png", metadata={"Software": None}, **how)
    return png.getvalue()


def panels(width, height, lines, rows=2):
    """A figure with `rows` of three panels that show a field of `width` by `height` mm each, over a caption."""
    panel, foot = (PANEL_IN, PANEL_IN * height / width), FOOT_IN + lines * LINE_IN
    size = np.array([3 * panel[0] + 4 * GAP_IN, rows * (panel[1] + TITLE_IN) + foot])
    figure = Figure(size, DPI)
    places = [(GAP_IN + column * (panel[0] + GAP_IN), foot + row * (panel[1] + TITLE_IN))
              for row in reversed(range(rows)) for column in range(3)]
    return figure, [figure.add_axes([*(place / size), *(panel / size)], xticks=[], yticks=[]) for place in places]


def look_at(panel, box, inverted):
    """Show a box (2, 2) mm, with e1 to the left where the panel is `inverted`."""
    panel.set(xlim=box[::-1, 0] if inverted else box[:, 0], ylim=box[:, 1], aspect="equal")


def draw_grey(panel, slice, values, window):
    """Image (n1, n2) in plane coordinates: the slice's origin is the centre of pixel (0, 0)."""
    low = slice.origin - slice.spacing / 2
    high = low + values.shape * slice.spacing
    panel.set_facecolor("black")
    panel.imshow(values.T, cmap="gray", vmin=window[0], vmax=window[1], interpolation="nearest",
                 origin="lower", extent=(low[0], high[0], low[1], high[1]))


def mark_sides(panel, letters, ink):
    """Letters of the patient's sides at the left, right, lower and upper edge of the panel."""
    west, east, south, north = letters
    paper = "black" if ink == "white" else "white"
    for x, y, ha, va, letter in ((0.02, 0.5, "left", "center", west), (0.98, 0.5, "right", "center", east),
                                 (0.5, 0.01, "center", "bottom", south), (0.5, 0.99, "center", "top", north)):
        panel.text(x, y, letter, ha=ha, va=va, transform=panel.transAxes, color=ink, fontweight="bold",
                   path_effects=outlined(2, paper))


def outlined(width, colour):
    """The effect of a line or text of so many points' edge in another colour."""
    return [withStroke(linewidth=width, foreground=colour)]


def scale_bar(panel, box, ink):
    """A bar of a round length, about a seventh of the panel, in the lower left corner."""
    width, height = box[1] - box[0]
    mm = max((length for length in (1, 2, 5, 10, 20, 50) if length <= width / 6), default=1)
    y = box[0, 1] + 0.04 * width
    x, end = (box[1, 0] - 0.04 * width - np.array([0, mm]) if panel.xaxis_inverted()
              else box[0, 0] + 0.04 * width + np.array([0, mm]))
    halo = outlined(5, "black" if ink == "white" else "white")
    panel.plot([x, end], [y, y], color=ink, lw=3, solid_capstyle="butt", path_effects=halo)
    panel.text((x + end) / 2, y + 0.015 * height, f"{mm} mm", color=ink, ha="center", fontsize=9, path_effects=halo)


def window(slice, mask) -> tuple[float, float]:
    """Grey window that before and after share: the organ's values but for .5 % at either end, and the background's,
    unless that is farther off than those are wide: water is 1000 units from air."""
    low, high = np.percentile(slice.values[mask], [0.5, 99.5])
    blank = blank_of(slice.values, mask)
    near = low - (high - low) <= blank <= high + (high - low)
    ends = [low, high, blank] if near else [low, high]
    return min(ends), max(*ends, low + 1e-9)
