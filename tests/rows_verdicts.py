"""Rows of the verdicts on a run: strain, rotation, growth, stillness, pressure, and the safe part that E401 names."""

import numpy as np
from rows import Row
from small import CUT, write

import xfemnav

COARSE = {"element_size_mm": 8, "corridor_element_mm": 4, "report": False}
FLAP = """xfemnav = 1
image = "head.nii.gz"
[mesh]
element_size_mm = 6
corridor_element_mm = 2
corridor_mm = 6
[[cut]]
points = {points}
[boundary]
craniotomy_mm = 45
[load]
gravity = [-1, 0]
[solve]
model = "{model}"
"""
SOFT = """xfemnav = 1
image = "head.nii.gz"
[mesh]
element_size_mm = 8
corridor_element_mm = 4
[tissue]
labels = "labels.nii.gz"
by_label.4 = { kind = "ventricle" }
[load]
gravity = [0, -1]
[boundary]
skull = "contact"
[[boundary.arc]]
start = [-30, -41]
end = [30, -41]
skull = "fixed"
"""


def run(folder, scenario=None, **flags):
    """The record of a run on the small brain; its warnings are in it."""
    import warnings

    write(folder / "head.nii.gz")
    if scenario is not None:
        (folder / "case.toml").write_text(scenario)
        flags |= {"scenario": folder / "case.toml"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", xfemnav.XfemnavWarning)
        image = None if scenario else folder / "head.nii.gz"
        return xfemnav.run(image, output=folder / "out", cache=folder / "cache", **COARSE | flags).record


def codes(record) -> list[str]:
    """The codes of a record's warnings."""
    return [item["code"] for item in record["warnings"]]


def text_of(record, code) -> str:
    """The first warning with a code."""
    return next(item["text"] for item in record["warnings"] if item["code"] == code)


def flap(depth_mm: float, model: str = "linear") -> str:
    """A cut that enters and goes on below the surface: a flap of tissue, which gravity pulls outwards."""
    angle = np.linspace(np.pi, np.pi - 0.6, 12)
    along = np.column_stack([(45 - depth_mm) * np.cos(angle), (55 - depth_mm) * np.sin(angle)])
    return FLAP.format(points=[[-60.0, 0.0], *along.tolist()], model=model)


def thin_flap(folder):
    """A flap 3 mm thick: small strains blow it up."""
    record = run(folder, flap(3.0), element_size_mm=6, corridor_element_mm=2, young_kpa=9)
    checks, verdicts = record["checks"], record["verdicts"]
    assert record["status"] == "untrusted" and record["error"]["code"] == "E401"
    assert checks["inverted_mm2"] <= 1 and checks["main_strain"] < 0.3, "what was judged before says nothing"
    assert verdicts["tripled_mm2"]["verdict"] == "untrusted" and verdicts["turning_mm"]["verdict"] == "look"
    assert np.hypot(*(np.array(verdicts["tripled_mm2"]["place_mm"]) - [-42, 13])) < 8
    return (f"{checks['tripled_mm2']:.0f} mm2 grow over threefold, turned by {checks['turned_deg']:.0f} degrees, at "
            "({:.0f}, {:.0f}) mm".format(*verdicts["tripled_mm2"]["place_mm"])), "E401"


def finite_flap(folder):
    """The same with finite strains, which turn it as it is: only where it goes is not to be believed."""
    record = run(folder, flap(3.0, "neo-hookean"), element_size_mm=6, corridor_element_mm=2)
    assert record["status"] == "complete" and "W407" in codes(record)
    assert record["checks"]["turning_mm"] is None and record["checks"]["tripled_mm2"] == 0
    return f"it moves by {record['checks']['max_displacement_mm']:.0f} mm, over 20", "W407"


def named_part_is_safe(folder, what, flags, scaled):
    """The run that E401 names is trusted, and 1.05 times as much is not."""
    record = run(folder, **flags)
    assert record["error"]["code"] == "E401"
    part = float(record["error"]["text"].split(f"largest safe {what} is ")[1].split(" of this one")[0])
    again = [run(folder / name, **flags | scaled(part * times)) for name, times in (("safe", 1), ("more", 1.05))]
    assert [each["status"] for each in again] == ["complete", "untrusted"]
    return f"{what} of {part:g}: trusted; 1.05 times that: E401", "E401"


def beside_gravity(folder):
    """Gravity is not scaled: the tissue has sunk at any opening."""
    for name in ("safe", "more"):
        (folder / name).mkdir()
    given = {"cut": CUT, "gravity": "0,-1", "skull": "contact", "young_kpa": 1.0}
    return named_part_is_safe(folder, "opening", given | {"opening_mm": 40}, lambda part: {"opening_mm": 40 * part})


def of_forces(folder):
    """A force is no opening."""
    for name in ("safe", "more"):
        (folder / name).mkdir()
    return named_part_is_safe(folder, "force", {"cut": CUT, "lip_force": "left=0,70"},
                              lambda part: {"lip_force": f"left=0,{70 * part}"})


def still(folder):
    """A cut that nobody opens."""
    record = run(folder, cut=CUT)
    assert codes(record) == ["W409"]
    barely = run(folder, cut=CUT, opening_mm=0.006)
    assert codes(barely) == ["W409"] and codes(run(folder, cut=CUT, opening_mm=0.4)) == []
    return f"moves by {barely['checks']['max_displacement_mm']:.3f} mm, under 0.1", "W409"


def small_strain(folder):
    """An opening of 6 mm: amber, without a warning."""
    record = run(folder, cut=CUT, opening_mm=6)
    found = record["verdicts"]["largest_strain"]
    assert codes(record) == [] and found["verdict"] == "look" and found["limit"] == 0.1 < found["value"] < 0.3
    return f"strain {found['value']:.2f}: amber in report and run.json", ""


def large_strain(folder):
    """An opening of 16 mm."""
    record = run(folder, cut=CUT, opening_mm=16)
    assert record["status"] == "complete" and codes(record) == ["W406"]
    assert 'model="neo-hookean"' in text_of(record, "W406") and record["verdicts"]["main_strain"]["value"] > 0.3
    return f"strain {record['checks']['main_strain']:.2f}", "W406"


def soft_strain(folder):
    """A soft ventricle may be strained as it likes."""
    x, y = np.indices((64, 72)) * 2.0 + np.array([-63, -71])[:, None, None]
    write(folder / "labels.nii.gz", (4 * ((x / 15) ** 2 + ((y - 5) / 20) ** 2 < 1)).astype(np.uint8))
    record = run(folder, SOFT, young_kpa=6)
    checks = record["checks"]
    assert checks["main_strain"] < 0.3 < checks["largest_strain"] and "W406" not in codes(record)
    return f"strain {checks['largest_strain']:.2f}, of the main tissue {checks['main_strain']:.2f}", ""


def pascals(folder):
    """3000 Pa given as kPa."""
    record = run(folder, cut=CUT, opening_mm=4, young_kpa=3000)
    assert codes(record) == ["W408", "W408"] and "mmHg" in text_of(record, "W408")
    return f"{record['checks']['blade_pressure_kPa']:.0f} kPa under a blade, E 3000 kPa", "W408"


def default_blade(folder):
    """A blade that nobody asked for is shortened without a word; one that was given is not."""
    record = run(folder, cut=CUT, opening_mm=4)
    assert codes(record) == [] and 0 < record["retractor"][0]["blade"][1] < 0.8
    given = run(folder, cut=CUT, opening_mm=4, blade="0,0.8")
    assert codes(given) == ["W404"]
    return f"it holds 0 to {record['retractor'][0]['blade'][1]:.2f}, as run.json says", ""


ROWS = [
    Row("A3", "a thin flap of tissue under gravity, small strains", "moved by 24 mm or blown up 500 times, exit 0",
        thin_flap),
    Row("A3", "the same, finite strains", "81 mm", finite_flap),
    Row("A5", "E401 beside gravity names an opening", "at .609 of it E401 again", beside_gravity),
    Row("A5", "E401 with a force on a lip", "spoke of an opening", of_forces),
    Row("A15", "no opening, or one of .006 mm", "unchanged image, without warnings", still),
    Row("A16", "strain above .1", "green", small_strain),
    Row("A16", "strain above .3", "green at .37", large_strain),
    Row("A16", "strain above .3 in a soft ventricle", "-", soft_strain),
    Row("A17", "Young's modulus in Pa", "524 kPa under a blade, without a word", pascals),
    Row("D", "the default blade is shortened", "W404 of a blade that nobody gave", default_blade),
]
