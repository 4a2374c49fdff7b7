"""Panels of the pages' pictures: slices of the MNI grid with lines, words, the patient's sides and a bar of mm."""

from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
import shapely
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image
from scipy.spatial import cKDTree

WIDTH = 960  # pixels: every letter can be read, and a repository can carry it
PANEL_IN, TITLE_IN, GAP_IN = 3.1, 0.3, 0.08
CORNER = np.array([-98.5, -134.5])  # mm, of the MNI grid
YELLOW, CYAN, RED, GREEN = "#ffd21f", "#35d0ff", "#ff4040", "#59e36b"
BLUE, ORANGE = "#0b62a8", "#d1410c"


def panels(rows: int, columns: int, box) -> tuple[Figure, list]:
    """A figure whose panels each show the `box` (2, 2) mm."""
    height = PANEL_IN * np.ptp(box[:, 1]) / np.ptp(box[:, 0])
    size = np.array([columns * (PANEL_IN + GAP_IN) + GAP_IN, rows * (height + TITLE_IN) + GAP_IN])
    figure = Figure(size)
    found = []
    for row in reversed(range(rows)):
        for column in range(columns):
            corner = GAP_IN + column * (PANEL_IN + GAP_IN), GAP_IN + row * (height + TITLE_IN)
            panel = figure.add_axes([*(corner / size), *([PANEL_IN, height] / size)], xticks=[], yticks=[])
            panel.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal", facecolor="black")
            found.append(panel)
    return figure, found


def finished(panel, title: str, ink: str = "white", bar: float = 10.0) -> None:
    """Title, the patient's sides (e1 is R, e2 is A: neurological display), and a bar of `bar` mm."""
    halo = [withStroke(linewidth=2, foreground="black" if ink == "white" else "white")]
    panel.set_title(title, fontsize=9, pad=3)
    for x, y, ha, va, letter in ((0.02, 0.5, "left", "center", "L"), (0.98, 0.5, "right", "center", "R"),
                                 (0.5, 0.015, "center", "bottom", "P"), (0.5, 0.985, "center", "top", "A")):
        panel.text(x, y, letter, ha=ha, va=va, transform=panel.transAxes, color=ink, weight="bold", path_effects=halo)
    (west, east), (south, north) = panel.get_xlim(), panel.get_ylim()
    x, y = west + 0.04 * (east - west), south + 0.04 * (north - south)
    panel.plot([x, x + bar], [y, y], color=ink, lw=3, solid_capstyle="butt", path_effects=halo)
    panel.text(x + bar / 2, y + 0.02 * (north - south), f"{bar:g} mm", color=ink, ha="center", fontsize=8,
               path_effects=halo)


def grey(panel, values, pixel: float = 1.0) -> None:
    """A slice (n1, n2) of the MNI grid, pixels of 1 mm, or larger ones from the same corner."""
    high = CORNER + pixel * np.array(values.shape)
    panel.imshow(values.T, cmap="gray", vmin=0, vmax=255, origin="lower", interpolation="nearest",
                 extent=(CORNER[0], high[0], CORNER[1], high[1]))


def edge(panel, mask, colour: str, **style) -> None:
    """The outline of a mask (n1, n2)."""
    lines = [start + 0.5 + np.arange(n) for start, n in zip(CORNER, mask.shape)]
    panel.contour(*lines, np.asarray(mask, float).T, levels=[0.5], colors=colour, linewidths=style.get("lw", 1.0),
                  linestyles=style.get("ls", "solid"))


def inked(panel, mask, colour: str) -> None:
    """The pixels of a mask (n1, n2) in a colour."""
    high = CORNER + mask.shape
    panel.imshow(np.ma.masked_equal(mask, 0).T, cmap=matplotlib.colors.ListedColormap([colour]), origin="lower",
                 interpolation="nearest", extent=(CORNER[0], high[0], CORNER[1], high[1]))


def line(panel, path, colour: str, lw: float = 1.6, ls="solid") -> None:
    """A line (n, 2) mm with a dark halo."""
    panel.plot(*np.transpose(path), color=colour, lw=lw, ls=ls, solid_capstyle="butt",
               path_effects=[withStroke(linewidth=lw + 1.2, foreground="black")])


def word(panel, point, text: str, colour: str, **where) -> None:
    """A word beside a place (2,) mm."""
    style = dict(fontsize=8, color=colour, ha="center", va="center") | where
    panel.text(*point, text, path_effects=[withStroke(linewidth=2.5, foreground="black")], **style)


def lips(panel, result, colour: str = CYAN) -> None:
    """Both lips of every cut, where they are now."""
    for cut in result.record["cuts"]:
        along = shapely.get_coordinates(shapely.segmentize(shapely.LineString(cut["path"]), 0.5))
        for side in ("left", "right"):
            line(panel, result.to_current(along, side), colour, 1.0)


def displacement(panel, result, most: float):
    """How far the tissue of a result has moved, drawn where it is now; the colours, from 0 to `most` mm."""
    moved, rest = result.motion.moved, result.motion.rest
    size = np.linalg.norm(moved - rest, axis=2).ravel()
    panel.set_facecolor("white")
    return panel.tripcolor(*moved.reshape(-1, 2).T, size, triangles=np.arange(size.size).reshape(-1, 3),
                           shading="gouraud", vmin=0, vmax=most)


def colour_bar(panel, colours, unit: str = "mm") -> None:
    """A scale of colours in the panel's upper left corner."""
    scale = panel.inset_axes([0.03, 0.95, 0.2, 0.025])
    panel.figure.colorbar(colours, cax=scale, orientation="horizontal")
    scale.tick_params(labelsize=7, pad=1, length=2)
    panel.text(0.25, 0.95, unit, fontsize=7, transform=panel.transAxes)


def palette() -> np.ndarray:
    """The colours (n, 3) uint8 that a picture may have: greys, the scale of displacements, and inks on both."""
    inks = [matplotlib.colors.to_rgb(ink) for ink in (YELLOW, CYAN, RED, GREEN, BLUE, ORANGE)]
    blends = [share * np.array(ink) + (1 - share) * paper for ink in inks for share in (1, 0.75, 0.5, 0.25)
              for paper in (0, 1)]
    scale = matplotlib.colormaps["viridis"](np.arange(0, 256, 3))[:, :3]
    return np.rint(255 * np.concatenate([np.linspace(0, 1, 56)[:, None] * np.ones(3), scale, blends])).astype(np.uint8)


def saved(figure, name: str) -> None:
    """Write docs/figures/NAME.png: the same data give the same bytes."""
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=WIDTH / figure.get_figwidth(), metadata={"Software": None})
    pixels = np.asarray(Image.open(drawn).convert("RGB"))
    found, index = np.unique(pixels.reshape(-1, 3), axis=0, return_inverse=True)
    nearest = cKDTree(palette()).query(found)[1].astype(np.uint8)
    image = Image.fromarray(nearest[index].reshape(pixels.shape[:2]), "P")
    image.putpalette(palette().tobytes())
    image.save(Path(__file__).parent / "figures" / f"{name}.png", optimize=True)
