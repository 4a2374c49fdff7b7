"""The pictures of the pages: of the runs that they describe, and of the scenarios that they print.

Called by `make docs` when out/demo and out/worked-case are there; `python docs/pictures.py NAME ...` draws some alone.
"""

import re
import sys
from io import BytesIO
from pathlib import Path

import matplotlib
import nibabel as nib
import numpy as np
import shapely
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image
from scipy.spatial import cKDTree

import xfemnav
from data_synthetic import surgery

DOCS = Path(__file__).parent
OUT = DOCS.parent / "out"
WIDTH, SMALL = 1100, 960  # pixels: every letter can be read, and a repository can carry it
PANEL_IN, TITLE_IN, GAP_IN = 3.1, 0.3, 0.08
BRAIN = np.array([[-78.0, -112.0], [78.0, 78.0]])  # mm, what a panel shows: all of the slice
FRONT = np.array([[-66.0, -2.0], [8.0, 62.0]])  # the left frontal lobe
YELLOW, CYAN, RED, GREEN = "#ffd21f", "#35d0ff", "#ff4040", "#59e36b"
BLUE, ORANGE = "#0b62a8", "#d1410c"


# Runs ----------------------------------------------------------------------------------------------------------------

def scenario(page: str, number: int = 0, **changes: str) -> Path:
    """The scenario that is block `number` of a page, as a file beside the images; `changes` are text: new text."""
    text = re.findall(r"^```toml\n(.*?)^```", (DOCS / f"{page}.md").read_text(), re.MULTILINE | re.DOTALL)[number]
    for old, new in changes.items():
        if old not in text:
            raise ValueError(f"{page}.md has no {old!r} in scenario {number}")
        text = text.replace(old, new)
    path = OUT / "surgery" / f"{page}-{number}.toml"
    path.write_text(text)
    return path


def run(page: str, number: int = 0, changes: dict | None = None, **flags) -> xfemnav.Result:
    """The run of a page's scenario."""
    words = [page, str(number), *(changes or {}).values(), *map(str, flags.values())]
    folder = OUT / "pictures" / re.sub(r"[^\w.]+", "-", "-".join(words)).strip("-")
    return xfemnav.run(scenario=scenario(page, number, **(changes or {})), output=folder, report=False, **flags)


# Panels --------------------------------------------------------------------------------------------------------------

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
    low = np.array([-98.5, -134.5])
    high = low + pixel * np.array(values.shape)
    panel.imshow(values.T, cmap="gray", vmin=0, vmax=255, origin="lower", interpolation="nearest",
                 extent=(low[0], high[0], low[1], high[1]))


def preoperative(kind: str = "image") -> np.ndarray:
    """The slice (n1, n2) of an image of the operation at 18 mm."""
    volume = nib.load(surgery.write(OUT / "surgery")[kind])
    return np.asarray(volume.dataobj)[:, :, round(18 - volume.affine[2, 3])]


def updated(result, role: str = "updated") -> np.ndarray:
    """A slice (n1, n2) that a run has written."""
    return np.asarray(nib.load(result.folder / result.record["outputs"][role]).dataobj)[:, :, 0]


def edge(panel, mask, colour: str, **style) -> None:
    """The outline of a mask (n1, n2)."""
    lines = [start + np.arange(n) for start, n in zip((-98.0, -134.0), mask.shape)]
    panel.contour(*lines, np.asarray(mask, float).T, levels=[0.5], colors=colour, linewidths=style.get("lw", 1.0),
                  linestyles=style.get("ls", "solid"))


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
    """How far the tissue has moved, drawn where it is now; the colours, from 0 to `most` mm."""
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
    figure.savefig(drawn, format="png", dpi=SMALL / figure.get_figwidth(), metadata={"Software": None})
    pixels = np.asarray(Image.open(drawn).convert("RGB"))
    found, index = np.unique(pixels.reshape(-1, 3), axis=0, return_inverse=True)
    nearest = cKDTree(palette()).query(found)[1].astype(np.uint8)
    image = Image.fromarray(nearest[index].reshape(pixels.shape[:2]), "P")
    image.putpalette(palette().tobytes())
    image.save(DOCS / "figures" / f"{name}.png", optimize=True)


# The pictures --------------------------------------------------------------------------------------------------------

def shrunk(name: str) -> None:
    """A run's own figure at WIDTH pixels."""
    figure = Image.open(OUT / name / "figure.png").convert("RGB")
    size = WIDTH, round(figure.height * WIDTH / figure.width)
    figure.resize(size, Image.Resampling.LANCZOS).save(DOCS / f"{name}.png", optimize=True)


def cuts() -> None:
    """A bent cut, its branch, an internal cut: as drawn, as opened, and how far tissue has moved."""
    result = run("cuts")
    figure, (a, b, c) = panels(1, 3, np.array([[-66.0, -16.0], [54.0, 72.0]]))
    grey(a, preoperative())
    for cut in result.record["cuts"]:
        line(a, cut["path"], YELLOW)
    for name, at in (("approach", (-50, 25)), ("branch", (-34, 49)), ("hidden", (42, 33))):
        word(a, at, name, YELLOW)
    grey(b, updated(result))
    lips(b, result)
    colour_bar(c, displacement(c, result, 3.5))
    for panel, title in ((a, "as drawn"), (b, "updated, lips in blue"), (c, "displacement")):
        finished(panel, title, "black" if panel is c else "white", 20)
    saved(figure, "cuts")


def resections() -> None:
    """A corridor and a tumour taken out: as drawn, and the cavity without and with gravity."""
    still, sunk = run("resections", changes={"gravity = [0.6, -0.8]": "gravity = [0.006, -0.008]"}), run("resections")
    figure, (a, b, c) = panels(1, 3, FRONT)
    grey(a, preoperative())
    corridor = np.array([[-60.0, 41.0], [-55.0, 47.0], [-31.0, 28.0], [-35.0, 22.0], [-60.0, 41.0]])
    line(a, corridor, YELLOW, ls=(0, (4, 2)))
    edge(a, preoperative("labels") == surgery.TUMOUR, YELLOW, ls="dashed", lw=1.6)
    word(a, (-45, 24), "corridor", YELLOW)
    word(a, (-20, 11), "tumour (label)", YELLOW)
    for panel, result in ((b, still), (c, sunk)):
        grey(panel, updated(result))
        edge(panel, updated(still, "cavity"), CYAN)
    for panel, title in ((a, "as drawn"), (b, "taken out"), (c, "with gravity; blue: (b)'s cavity")):
        finished(panel, title)
    saved(figure, "resections")


def contact() -> None:
    """A lip pushed against the other one: with contact, and without."""
    box = np.array([[-66.0, 8.0], [-16.0, 54.0]])
    figure, (a, b, c) = panels(1, 3, box)
    grey(a, preoperative())
    for panel, kind, title in ((b, "contact", "lips in contact"), (c, "free", "lips free; red: tissue lies twice")):
        result = run("contact", changes={'lips = "contact"': f'lips = "{kind}"'})
        grey(panel, updated(result))
        edge(panel, updated(result, "overlap"), RED, lw=1.2)
        lips(panel, result)
        finished(panel, title)
    line(a, result.record["cuts"][0]["path"], YELLOW)
    a.annotate("", (-50.5, 27.2), (-46.0, 32.9), arrowprops={"color": GREEN, "width": 2, "headwidth": 8})
    word(a, (-40, 38), "left lip:\npushed 3 mm", GREEN)
    word(a, (-56, 24), "right lip:\nnobody holds it", YELLOW)
    finished(a, "as drawn")
    saved(figure, "contact")


def tissues() -> None:
    """Labels of tissues, and the motion under gravity of one tissue and of several."""
    several = run("tissues-and-loads")
    one = run("tissues-and-loads", changes={'kind = "ventricle"': 'kind = "parenchyma"', "young_kpa = 9.0": ""})
    figure, (a, b, c) = panels(1, 3, BRAIN)
    grey(a, preoperative())
    labels = preoperative("labels")
    for label, colour, name, at in ((surgery.VENTRICLE, CYAN, "label 4: ventricle", (25, -62)),
                                    (surgery.TUMOUR, YELLOW, "label 7:\ntumour", (-30, 42))):
        edge(a, labels == label, colour, lw=1.4)
        word(a, at, name, colour)
    a.annotate("", (44, -2 - 40), (20, 30 - 40), arrowprops={"color": GREEN, "width": 2, "headwidth": 8})
    word(a, (48, -14), "gravity", GREEN)
    most = max(np.linalg.norm(each.motion.moved - each.motion.rest, axis=2).max() for each in (one, several))
    for panel, result in ((b, one), (c, several)):
        colours = displacement(panel, result, most)
    colour_bar(b, colours)
    for panel, title in ((a, "tissues and load"), (b, "displacement, one tissue"), (c, "displacement, three tissues")):
        finished(panel, title, "white" if panel is a else "black", 20)
    saved(figure, "tissues-and-loads")


def steps() -> None:
    """The slice before, and after each of the five steps."""
    xfemnav.run(scenario=OUT / "surgery/surgery.toml", output=OUT / "steps")
    figure, found = panels(2, 3, np.array([[-72.0, -18.0], [24.0, 74.0]]))
    names = ["drain", "cut", "retract", "resect", "release"]
    outline = updated(xfemnav.Result.load(OUT / "steps"), "mask")
    for panel, number in zip(found, range(-1, 5)):
        role = "updated" if number == 4 else f"updated:{names[number]}"
        grey(panel, preoperative() if number < 0 else updated(xfemnav.Result.load(OUT / "steps"), role))
        edge(panel, outline, YELLOW, lw=0.7)
        if number == 1:
            lips(panel, xfemnav.Result.load(OUT / "steps", step="cut"))
        finished(panel, "preoperative; yellow: the brain's outline" if number < 0 else f"{number + 1}. {names[number]}")
    saved(figure, "steps")


def companions() -> None:
    """Grey matter, labels, fibres and targets before and after."""
    result = run("companions")
    figure, (a, b, c, d) = panels(2, 2, FRONT)
    targets = np.array(list(surgery.TARGETS.values()))
    name = {role: result.folder / path for role, path in result.record["outputs"].items()}
    rows = [row.split(",") for row in name["points"].read_text().splitlines()[1:]]
    now = [(-float(row[0]), -float(row[1])) for row in rows], [row[-1] for row in rows]
    tracts = surgery.fibres(), nib.streamlines.load(name["streamlines"]).streamlines
    labelled = updated(result, "companion:sub-mni_dseg")
    for panel, image, labels, lines, (points, words) in (
        (a, preoperative(), preoperative("labels"), tracts[0], (targets, list(surgery.TARGETS))),
        (b, updated(result), labelled, tracts[1], now),
    ):
        grey(panel, image)
        for label in (surgery.VENTRICLE, surgery.TUMOUR):
            edge(panel, labels == label, CYAN, lw=1.4)
        for each in lines:
            panel.plot(*np.asarray(each)[:, :2].T, color=GREEN, lw=0.8)
        for (x, y), text in zip(points, words):
            panel.plot(x, y, "o", ms=5, color=YELLOW, mec="black")
            word(panel, (x + 1.5, y) if x > -50 else (x, y - 3), text, YELLOW, ha="left" if x > -50 else "center")
    matter = nib.load(OUT / "surgery/sub-mni_label-GM_probseg.nii.gz")
    grey(c, 255 * np.asarray(matter.dataobj)[:, :, round((18 - matter.affine[2, 3]) / 3)], 3)
    grey(d, 255 * updated(result, "companion:sub-mni_label-GM_probseg"))
    titles = "before: labels, fibres, targets", "after", "before: grey matter, 3 mm voxels", "after, 1 mm pixels"
    for panel, title in zip((a, b, c, d), titles):
        finished(panel, title)
    saved(figure, "companions")


def finite_strain() -> None:
    """An opening of 12 mm by both models, and how the models part as it grows."""
    openings = (2, 4, 6, 8, 10, 12)
    found = {model: [run("finite-strain-model", changes={"normal_mm = 6.0": f"normal_mm = {mm / 2}",
                                                         'model = "neo-hookean"': f'model = "{model}"'})
                     for mm in openings] for model in ("linear", "neo-hookean")}
    figure, (a, b, c) = panels(1, 3, np.array([[-66.0, 4.0], [-12.0, 58.0]]))
    for panel, (model, results) in zip((a, b), found.items()):
        grey(panel, updated(results[-1]))
        lips(panel, results[-1])
        finished(panel, f"{model}, opened by {openings[-1]} mm")
    c.set(xlim=(0, 13), ylim=(0, 1.5), aspect="auto", facecolor="white", xticks=openings)
    c.set_position([0.735, 0.2, 0.245, 0.68])
    parted = [result.record["model"]["linear_difference_mm"] for result in found["neo-hookean"]]
    pressure = {model: [each.record["retractor"][0]["mean_pressure_kPa"] for each in results]
                for model, results in found.items()}
    c.plot(openings, parted, "o-", color=ORANGE, label="largest difference, mm")
    for (model, values), style in zip(pressure.items(), ("s--", "s-")):
        c.plot(openings, values, style, color=BLUE, label=f"pressure of a blade, kPa, {model}")
    c.set_yticks(np.arange(0, 2.1, 0.5))
    c.set_ylim(0, 1.4 * max(max(parted), *map(max, pressure.values())))
    c.tick_params(labelsize=7)
    c.set_xlabel("opening, mm", fontsize=8)
    c.legend(fontsize=7, frameon=False)
    saved(figure, "finite-strain-model")


PICTURES = {"demo": lambda: shrunk("demo"), "worked-case": lambda: shrunk("worked-case"), "cuts": cuts,
            "resections": resections, "contact": contact, "tissues-and-loads": tissues, "steps": steps,
            "companions": companions, "finite-strain-model": finite_strain}


if __name__ == "__main__":
    surgery.write(OUT / "surgery")
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        for chosen in sys.argv[1:] or PICTURES:
            PICTURES[chosen]()
