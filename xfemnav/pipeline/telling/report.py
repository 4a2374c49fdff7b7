"""The run as one HTML page that needs no other file and runs no script: `report.html` beside `run.json`.

The page is for the reader who must decide whether to believe the result and then has to describe it: a verdict, the
figure, the checks, warnings with what to do about them, the retractors' forces, and a methods paragraph to paste. It
holds nothing that differs between two runs of the same settings (no dates, no seconds, no folders, and not the command:
all these are in run.json), so equal runs give equal pages.
"""

import base64
import copy
import math
import os
from pathlib import Path
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from xfemnav.errors import FAULTS
from xfemnav.naming import Names, flag, said, told
from xfemnav.pipeline.asking.flags import keys, path_places
from xfemnav.pipeline.asking.scenario_file import AGAIN, put
from xfemnav.pipeline.keeping.disk import write_atomic
from xfemnav.pipeline.telling import bearings
from xfemnav.pipeline.telling.display import convention, ends, in_space, lip_ends, lips_told
from xfemnav.pipeline.telling.methods import CITATIONS, methods_paragraph
from xfemnav.pipeline.telling.palette import reduced
from xfemnav.pipeline.telling.verdicts import MMHG_PER_KPA

VERDICTS = {
    "complete": "Complete",
    "untrusted": "NOT TO BE TRUSTED. Use these results to find out why, and for nothing else.",
}
CHECKS = {  # name in run.json: (what it is, unit)
    "residual": ("relative residual of the linear system", ""),
    "lip_error_mm": ("difference between the held lips and what was prescribed", "mm"),
    "max_displacement_mm": ("largest displacement", "mm"),
    "mean_displacement_mm": ("mean displacement, by area", "mm"),
    "inverted_mm2": ("tissue turned inside out (0 wanted)", "mm²"),
    "det_F_p01": ("local change of area, 1 % quantile (1 is none, below 0 is inside out)", ""),
    "largest_strain": ("strain that 1 % of the tissue exceeds", ""),
    "main_strain": ("the same of the main tissue, without what is far softer", ""),
    "turning_mm": ("misplacement of tissue that turns, by small rotations", "mm"),
    "turned_deg": ("the angle by which that tissue turns, or more", "degrees"),
    "turned_mm2": ("the area of that tissue", "mm²"),
    "resized_mm2": ("tissue whose area more than doubles or halves", "mm²"),
    "tripled_mm2": ("tissue whose area more than trebles", "mm²"),
    "min_gap_mm": ("smallest gap between lips, or outline and skull (0: they touch; below: an error)", "mm"),
    "cavity_mm2": ("cavity: pixels inside the moved outline that hold no tissue", "mm²"),
    "vacated_mm2": ("vacated: pixels that the outline has drawn back from", "mm²"),
    "overlap_mm2": ("overlap: pixels that hold tissue twice (0 wanted)", "mm²"),
    "blade_pressure_kPa": ("largest mean pressure of a blade", "kPa"),
    "main_young_kpa": ("Young's modulus of the main tissue", "kPa"),
}
#: Words of the page of a slice, and of a volume's.
SPACE = {"_mm2": "_mm3", "mm²": "mm³", "area": "volume", "pixels": "voxels", "outline": "surface"}
WORDS = {"ok": "ok", "look": "look at it", "untrusted": "not trusted"}
#: The page calls settings by the keys of the scenario beside it, whichever way the run was asked for.
NAMES = keys(Names(flag, flag, "", ""))
EARLIER_PX = 900  # width of the pictures of earlier steps
#: What no check can see, and who must.
UNCHECKED = ("whether the mask is the organ", "whether cuts and resections are where the surgeon's are",
             "whether tissue, skull and blades are as stated", "how far the patient's tissue moved out of this plane",
             "how the result compares with an image taken during surgery")


def dimension_of(run: dict) -> int:
    """2 of the run of a slice, 3 of a volume's; records of before do not say it, and are of slices."""
    return run.get("dimension", 2)


def worded(text: str, dimension: int) -> str:
    """A text, or the name of a check, of slices as it is for volumes."""
    for word, other in SPACE.items() if dimension > 2 else ():
        text = text.replace(word, other)
    return text


def unchecked(dimension: int) -> tuple[str, ...]:
    """What no check of a run can see: a volume has no tissue out of its plane."""
    return tuple(item for item in UNCHECKED if dimension == 2 or "plane" not in item)


def check_rows(run: dict) -> list[dict]:
    """The rows of the table of checks that a run, or a step of one, has."""
    names = [worded(name, dimension_of(run)) for name in CHECKS]
    return [check_row(name, run) for name in names if run["checks"].get(name) is not None]


def checked(run: dict) -> str:
    """What the word "complete" says of a run, and what it does not."""
    found = [item["verdict"] for step in run.get("steps") or [run] for item in step["verdicts"].values()]
    looks = found.count("look")
    amber = f", {looks} of them beyond a limit that asks for a look" if looks else ""
    return (f"Complete: every stage has ended, and of {len(found)} checks with a limit none says that the result is "
            f"not to be trusted{amber}. Not checked: {'; '.join(unchecked(dimension_of(run)))}.")


def write_report(run: dict, folder: Path, figures: dict[str, Path]) -> Path:
    """Write `folder`/report.html for `run`, the content of its run.json, and return the path.

    `figures`: the pictures by role, "figure" the last step's, "figure:<step>" those of earlier ones.
    """
    target = folder / "report.html"
    page = render(run, {role: reduced(path.read_bytes(), None if role == "figure" else EARLIER_PX)
                        for role, path in figures.items()})
    write_atomic(target, page.encode(errors="backslashreplace"))  # file names may hold bytes that are no UTF-8
    return target


def render(run: dict, figures: dict[str, bytes]) -> str:
    """The page. Every value is escaped by the template engine: names of files and cuts are other people's text."""
    error, solid = run.get("error"), dimension_of(run) > 2
    display, lips = display_told(run, run["cuts"])
    return template("report.html").render(
        title=Path(run["parameters"]["image"]).name,
        status=run["status"],
        verdict=VERDICTS[run["status"]],
        checked=checked(run),
        display=display,
        lips=lips,
        unit="mm³" if solid else "mm²",
        solid=solid,
        places=[sentence[0].upper() + sentence[1:] for sentence in bearings.told(run)],
        error=error and error | {"text": told(error, NAMES)},
        figure=embedded(figures.get("figure")),
        steps=[step_row(step, embedded(figures.get(f"figure:{step['name']}")), run["outputs"])
               for step in run.get("steps", ())],
        pieces=[{"size": piece["volume_mm3" if solid else "area_mm2"], **piece} for piece in run["pieces"]],
        contacts=run["contact"],
        points=run.get("points", ()),
        again=AGAIN,
        stages=run["stages"],
        checks=check_rows(run),
        warnings=[(each["code"], told(each, NAMES), said(FAULTS[each["code"]].remedy, NAMES))
                  for each in run["warnings"]],
        retractors=[retractor_row(each, lips_of(run)) for each in run["retractor"]],
        tips=[tip_row(each) for each in run["tips"]],
        parameters=list(flat(settings(run["parameters"]))),
        input=list(flat(run["input"])),
        outputs=[(role, name, link(name)) for role, name in run["outputs"].items()],
        methods=methods_paragraph(run),
        citations=CITATIONS[dimension_of(run)],
        version=run["version"],
    )


def settings(parameters: dict) -> dict:
    """The parameters of a run without the folders that its files lie in."""
    found = copy.deepcopy(parameters)
    for place, path in path_places(found).items():
        put(found, place, Path(path).name)
    return {name: value for name, value in found.items() if name != "allow_outside"}


def template(name: str) -> Template:
    """A page of this folder, which escapes every value that is put in."""
    return Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    ).get_template(name)


def embedded(png: bytes | None) -> str | None:
    """A PNG as the base64 text of a data URL; None stays None."""
    return base64.b64encode(png).decode() if png else None


def check_row(name: str, run: dict) -> dict:
    """A row of the table of checks: what it is, value, limit and verdict ("" for a check that has none)."""
    what, unit = (worded(text, dimension_of(run)) for text in CHECKS[name.replace("_mm3", "_mm2")])
    judged = run["verdicts"].get(name)
    limit, verdict = (shown(float(judged["limit"])), judged["verdict"]) if judged else ("", "")
    return {"what": what, "unit": unit, "value": shown(run["checks"][name]), "limit": limit, "verdict": verdict,
            "word": WORDS.get(verdict, "")}


def link(name: str) -> str:
    """Relative address of a file beside the page, whatever bytes are in its name."""
    return quote(os.fsencode(name))


def step_row(step: dict, figure: str | None, outputs: dict[str, str]) -> dict:
    """What the page says of a step: what began and ended, its key figures, and its picture unless it is the last."""
    name = outputs.get(f"figure:{step['name']}")
    checks, judged = step["checks"], {item["verdict"] for item in step["verdicts"].values()}
    worst = next(verdict for verdict in ("untrusted", "look", "ok") if verdict in judged)
    return {
        "name": step["name"], "acts": ", ".join(step["acts"]) or "-", "ends": ", ".join(step["ends"]) or "-",
        "moved": f"{checks['max_displacement_mm']:.2f}", "cavity": f"{checks['cavity_mm2']:.0f}",
        "inverted": f"{checks['inverted_mm2']:.2f}", "verdict": worst, "word": WORDS[worst], "figure": figure,
        "file": name and link(name),
    }


def display_told(run: dict, cuts: list[dict], display: str | None = None) -> tuple[str, str]:
    """Which way round the pictures of a run are, and which of the lips of its cuts is which: in words."""
    display = run["parameters"]["display"] if display is None else display
    if dimension_of(run) > 2:
        return in_space(display), ""  # the sentence on where a cut is says it
    shown = run["slice"]["plane"], run["slice"].get("axes"), display
    return convention(*shown), lips_told([(cut["name"], cut["path"]) for cut in cuts], *shown)


def lips_of(run: dict) -> dict[str, dict[str, str]]:
    """The letter of the patient's side that each lip lies towards, by cut."""
    if dimension_of(run) > 2:
        return {cut["name"]: dict(zip(("right", "left"), ends(cut["left"]))) for cut in run["cuts"]}
    return {cut["name"]: lip_ends(cut["path"], run["slice"]["axes"]) for cut in run["cuts"]}


def retractor_row(retractor: dict, lips: dict[str, dict[str, str]]) -> dict:
    """A row of the table of forces: components and size in mN per mm of thickness, in a volume mN; pressure in kPa and
    mmHg.

    `lips`: as `lips_of` gives them.
    """
    force = retractor.get("force_mN") or retractor["force_mN_per_mm"]
    pressure = retractor["mean_pressure_kPa"]
    return {
        "cut": retractor["cut"],
        "side": f"{retractor['side']} of it, the {lips[retractor['cut']][retractor['side']]} lip",
        "force": f"({', '.join(f'{x:.2f}' for x in force)})",
        "size": f"{math.hypot(*force):.2f}",
        "kpa": f"{pressure:.3f}",
        "mmhg": f"{pressure * MMHG_PER_KPA:.1f}",
    }


def tip_row(tip: dict) -> dict:
    """A row of the table of tips: where, and the two stress intensity factors in Pa sqrt(m)."""
    x, y = tip["point_mm"]
    opening, shearing = (f"{tip[name]:.1f}" for name in ("K_I_Pa_sqrt_m", "K_II_Pa_sqrt_m"))
    return {"cut": tip["cut"], "place": f"({x:.1f}, {y:.1f})", "opening": opening, "shearing": shearing}


def flat(value, name: str = ""):
    """The leaves of nested parameters as rows ('mesh.element_size_mm', '3'), in order; unset ones are left out."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from flat(inner, f"{name}.{key}" if name else key)
    elif isinstance(value, list | tuple) and value and isinstance(value[0], dict):
        for number, inner in enumerate(value, 1):
            yield from flat(inner, f"{name}[{number}]")
    elif value is not None:
        yield name, shown(value)


def shown(value) -> str:
    """A value for people: four digits, words for truth values, the items of a list or an object in a row."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {shown(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(f"({shown(item)})" if isinstance(item, list | tuple) else shown(item) for item in value)
    return str(value)
