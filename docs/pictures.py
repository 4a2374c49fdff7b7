"""The pictures of the pages: of the runs that they describe, and of the scenarios that they print.

Called by `make docs` when out/demo, out/demo3d and out/worked-case are there; `python docs/pictures.py NAME ...` draws
some alone.
"""

import re
import sys
import warnings
from functools import partial
from pathlib import Path

import matplotlib
import nibabel as nib
import numpy as np
from panels import (
    BLUE,
    CYAN,
    GREEN,
    ORANGE,
    RED,
    YELLOW,
    colour_bar,
    displacement,
    edge,
    finished,
    grey,
    inked,
    line,
    lips,
    panels,
    saved,
    word,
)
from PIL import Image

import xfemnav
from xfemnav_examples import surgery, tumours

DOCS = Path(__file__).parent
OUT = DOCS.parent / "out"
WIDTH = 1100  # pixels, of a run's own figure
BRAIN = np.array([[-78.0, -112.0], [78.0, 78.0]])  # mm, what a panel shows: all of the slice
FRONT = np.array([[-66.0, -2.0], [8.0, 62.0]])  # the left frontal lobe


# Runs ----------------------------------------------------------------------------------------------------------------

def run(page: str, changes: dict | None = None) -> xfemnav.Result:
    """The run of the first scenario that a page prints, with `changes` of its text, old: new."""
    text = re.search(r"^```toml\n(.*?)^```", (DOCS / f"use/{page}.md").read_text(), re.MULTILINE | re.DOTALL)[1]
    for old, new in (changes or {}).items():
        if old not in text:
            raise ValueError(f"the scenario of {page}.md has no {old!r}")
        text = text.replace(old, new)
    name = re.sub(r"[^\w.]+", "-", "-".join([page, *(changes or {}).values()])).strip("-")
    path = OUT / "surgery" / f"{name}.toml"
    path.write_text(text)
    return xfemnav.run(scenario=path, output=OUT / "pictures" / name, report=False)


def preoperative(stem: str = "sub-mni_T1w") -> np.ndarray:
    """The slice (n1, n2) of an image of the operation at 18 mm."""
    volume = nib.load(OUT / f"surgery/{stem}.nii.gz")
    return np.asarray(volume.dataobj)[:, :, round((18 - volume.affine[2, 3]) / volume.affine[2, 2])]


def updated(result, role: str = "updated") -> np.ndarray:
    """A slice (n1, n2) that a run has written."""
    return np.asarray(nib.load(result.folder / result.record["outputs"][role]).dataobj)[:, :, 0]


# The pictures --------------------------------------------------------------------------------------------------------

def shrunk(name: str) -> None:
    """A run's own figure at WIDTH pixels."""
    figure = Image.open(OUT / name / "figure.png").convert("RGB")
    size = WIDTH, round(figure.height * WIDTH / figure.width)
    figure.resize(size, Image.Resampling.LANCZOS).save(DOCS / f"figures/{name}.png", optimize=True)


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
    still, sunk = run("resections", {"gravity = [0.6, -0.8]": "gravity = [0.006, -0.008]"}), run("resections")
    figure, (a, b, c) = panels(1, 3, FRONT)
    grey(a, preoperative())
    corridor = np.array([[-60.0, 41.0], [-55.0, 47.0], [-31.0, 28.0], [-35.0, 22.0], [-60.0, 41.0]])
    line(a, corridor, YELLOW, ls=(0, (4, 2)))
    edge(a, preoperative("sub-mni_dseg") == surgery.TUMOUR, YELLOW, ls="dashed", lw=1.6)
    word(a, (-45, 24), "corridor", YELLOW)
    word(a, (-20, 11), "tumour (label)", YELLOW)
    for panel, result in ((b, still), (c, sunk)):
        grey(panel, updated(result))
        edge(panel, updated(still, "cavity"), CYAN)
    for panel, title in ((a, "as drawn"), (b, "taken out"), (c, "with gravity; blue: the cavity without")):
        finished(panel, title)
    saved(figure, "resections")


def tumour_core() -> None:
    """A tumour in three labels with specks, a shell beside it: as labelled, outlined, and taken out."""
    image = nib.load(OUT / "surgery" / "sub-mni_T1w.nii.gz")
    grid = preoperative()
    place = np.linalg.inv(image.affine)[:2] @ [-40.0, 26.0, 18.0, 1.0]
    labels = tumours.tumour(np.random.default_rng(16), grid.shape, (1, 1), place, 13.0) * (grid > 0)
    path = OUT / "pictures" / "seg.nii.gz"
    path.parent.mkdir(exist_ok=True)
    nib.save(nib.Nifti1Image(np.repeat(labels[:, :, None], image.shape[2], 2), image.affine), path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = xfemnav.run(image.get_filename(), slice_mm=18, labels=path, resect="label=1,3,4", skull="contact",
                             gravity="0.003,-0.004", output=OUT / "pictures" / "tumour-core", report=False)
    figure, (a, b, c) = panels(1, 3, FRONT)
    for panel in (a, b):
        grey(panel, grid)
    for label, colour in ((tumours.OEDEMA, GREEN), (tumours.ENHANCING, ORANGE), (tumours.NECROSIS, RED)):
        edge(a, labels == label, colour, lw=1)
    edge(b, np.isin(labels, tumours.CORE), RED, lw=1)
    edge(b, updated(result, "cavity"), CYAN, lw=1.4)
    grey(c, updated(result))
    for panel, title in ((a, "oedema, rim, necrosis"), (b, "the core, and what is taken out"), (c, "updated")):
        finished(panel, title)
    saved(figure, "tumour-core")


def contact() -> None:
    """A lip pushed against the other one: with contact, and without."""
    box = np.array([[-66.0, 8.0], [-16.0, 54.0]])
    figure, (a, b, c) = panels(1, 3, box)
    grey(a, preoperative())
    for panel, kind, title in ((b, "contact", "lips in contact"), (c, "free", "lips free; red: tissue lies twice")):
        result = run("contact", {'lips = "contact"': f'lips = "{kind}"'})
        grey(panel, updated(result))
        inked(panel, updated(result, "overlap"), RED)
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
    one = run("tissues-and-loads", {'kind = "ventricle"': 'kind = "parenchyma"', "young_kpa = 9.0": ""})
    figure, (a, b, c) = panels(1, 3, BRAIN)
    grey(a, preoperative())
    labels = preoperative("sub-mni_dseg")
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
    now = [(float(row[0]), float(row[1])) for row in rows], [row[-1] for row in rows]
    tracts = surgery.fibres(), nib.streamlines.load(name["streamlines"]).streamlines
    labelled = updated(result, "companion:sub-mni_dseg")
    for panel, image, labels, lines, (points, words) in (
        (a, preoperative(), preoperative("sub-mni_dseg"), tracts[0], (targets, list(surgery.TARGETS))),
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
    grey(c, 255 * preoperative("sub-mni_label-GM_probseg"), 3)
    grey(d, 255 * updated(result, "companion:sub-mni_label-GM_probseg"))
    titles = "before: labels, fibres, targets", "after", "before: grey matter, 3 mm voxels", "after, 1 mm pixels"
    for panel, title in zip((a, b, c, d), titles):
        finished(panel, title)
    saved(figure, "companions")


def finite_strain() -> None:
    """An opening of 12 mm by both models, and how the models part as it grows."""
    openings = (2, 4, 6, 8, 10, 12)
    found = {model: [run("finite-strain-model", {"normal_mm = 6.0": f"normal_mm = {mm / 2}",
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


PICTURES = {**{name: partial(shrunk, name) for name in ("demo", "demo3d", "worked-case")}, "cuts": cuts,
            "resections": resections, "tumour-core": tumour_core, "contact": contact, "tissues-and-loads": tissues,
            "steps": steps, "companions": companions, "finite-strain-model": finite_strain}


if __name__ == "__main__":
    surgery.write(OUT / "surgery")
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        for chosen in sys.argv[1:] or PICTURES:
            PICTURES[chosen]()
