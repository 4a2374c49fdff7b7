"""Verdicts on checks, the safe part that E401 names, and both in what a run leaves."""

import json
import math
import re

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rows_verdicts import COARSE, codes, flap, run
from small import CUT, QUICK, write
from small import xfemnav as command

from xfemnav import limits
from xfemnav.errors import FAULTS
from xfemnav.naming import said
from xfemnav.pipeline.running.runfile import run_schema
from xfemnav.pipeline.stages.stage_safe import CLOSE, largest_part, scaled, told
from xfemnav.pipeline.telling.verdicts import (
    BOUNDS,
    DOUBTS,
    REASONS,
    doubts,
    is_trusted,
    plain,
    reasons,
    stillness,
    verdicts,
)

LINEAR, FINITE = {"name": "linear"}, {"name": "neo-hookean"}


def judged(model=LINEAR, pixel_mm2=1.0, **checks):
    """The verdicts on some checks."""
    return {name: item["verdict"] for name, item in verdicts({"checks": checks, "model": model}, pixel_mm2).items()}


@pytest.mark.parametrize("name, values", [
    ("residual", {1e-9: "ok", 2e-8: "untrusted", math.nan: "untrusted"}),
    ("inverted_mm2", {0.0: "ok", 0.02: "look", 1.01: "untrusted"}),
    ("overlap_mm2", {0.0: "ok", 1.0: "look", 2.0: "look", 3.0: "untrusted"}),
    ("largest_strain", {0.1: "ok", 0.11: "look", 0.9: "look"}),
    ("main_strain", {0.3: "ok", 0.31: "look"}),
    ("turning_mm", {1.0: "ok", 1.1: "look"}),
    ("resized_mm2", {10.0: "ok", 11.0: "look"}),
    ("tripled_mm2", {1.0: "ok", 1.1: "untrusted"}),
    ("max_displacement_mm", {20.0: "ok", 24.0: "look", 51.0: "untrusted"}),
    ("blade_pressure_kPa", {13.3: "ok", 13.4: "look"}),
    ("main_young_kpa", {0.09: "look", 0.1: "ok", 100.0: "ok", 101.0: "look"}),
])
def test_a_check_is_held_against_its_limit(name, values):
    assert {value: judged(**{name: value})[name] for value in values} == values


def test_every_limit_of_a_check_has_a_case_above_and_what_is_not_known_no_verdict():
    assert judged(turning_mm=None, blade_pressure_kPa=None) == {}
    assert set(DOUBTS) | set(REASONS) <= set(map(plain, BOUNDS))
    assert {code for code, _ in DOUBTS.values()} | {"W409", "E401"} <= set(FAULTS)


def test_finite_strains_are_for_more_than_small_ones():
    assert judged(FINITE, largest_strain=0.2) == {"largest_strain": "ok"}
    assert judged(FINITE, largest_strain=0.31) == {"largest_strain": "look"}


def test_large_pixels_may_overlap_by_two():
    assert judged(pixel_mm2=4.0, overlap_mm2=8.0) == {"overlap_mm2": "look"}
    assert judged(pixel_mm2=4.0, overlap_mm2=12.0) == {"overlap_mm2": "untrusted"}


@given(st.floats(0, 1e3), st.floats(0, 1e3), st.floats(0, 1e3), st.floats(0, 100))
def test_a_run_is_trusted_when_no_reason_is_given(inverted, tripled, overlap, moved):
    facts = {"model": LINEAR, "checks": {"inverted_mm2": inverted, "tripled_mm2": tripled, "overlap_mm2": overlap,
                                         "max_displacement_mm": moved}}
    assert is_trusted(facts, 1.0) == (not reasons("", verdicts(facts, 1.0)))


def test_texts_name_step_place_value_and_limit():
    facts = {"model": LINEAR, "places": {"tripled_mm2": [1.0, 2.0], "turning_mm": [3.0, 4.0]},
             "checks": {"tripled_mm2": 92.0, "turning_mm": 2.5, "turned_mm2": 92.0, "turned_deg": 48.0}}
    found = verdicts(facts, 1.0)
    (why,), ((code, text),) = reasons("open", found), doubts("open", found, facts["checks"], "linear")
    assert "'open'" in why and "92 mm2 about (1.0, 2.0) mm" in why and "over 1 mm2" in why
    assert code == "W407" and "(3.0, 4.0)" in text and "48 degrees" in text and "2.5 mm, over 1 mm" in text
    assert "neo-hookean" in text and "neo-hookean" not in doubts("", found, facts["checks"], "neo-hookean")[0][1]


def test_nothing_moves_when_no_step_does():
    assert stillness([{"max_displacement_mm": 0.0}, {"max_displacement_mm": 5.0}], False) == []
    ((code, text),) = stillness([{"max_displacement_mm": 0.0}, {"max_displacement_mm": 0.05}], True)
    assert code == "W409" and "0.05 mm" in text and "taken out" in text


# The safe part --------------------------------------------------------------------------------------------------------

@given(st.floats(2e-3, 0.999))
def test_the_part_named_is_safe_and_a_little_more_is_not(edge):
    asked = []
    found = largest_part(lambda part: asked.append(part) or part <= edge)
    assert found in asked and found <= edge < CLOSE * 1.005 * found
    assert float(f"{found:.3g}") == found and len(asked) <= 20


@given(st.floats(0, 9e-4))
def test_none_is_named_where_none_is_safe(edge):
    assert largest_part(lambda part: part <= edge) is None
    assert largest_part(lambda part: False) is None


@given(st.floats(0.2, 0.9), st.floats(0.001, 0.03))
def test_a_narrow_gap_is_not_the_end(edge, width):
    """Safe up to `edge`, but for a narrow gap at two thirds of it."""
    found = largest_part(lambda part: part <= edge and not 0 <= part - edge / 1.5 <= width)
    gap = edge / 1.5
    assert edge / CLOSE / 1.005 < found <= edge or (found < gap <= 1.05 * found <= gap + width)


@given(st.floats(0.3, 0.9), st.floats(0.06, 0.2))
def test_the_part_named_is_safe_where_less_is_not(low, width):
    """Gravity may fold tissue that an opening unfolds: safe from `low` on, but for too much."""
    found = largest_part(lambda part: low <= part <= min(low + width, 0.97))
    assert found is None or low <= found <= low + width


def test_all_that_blades_do_is_scaled_and_nothing_else():
    from xfemnav.pipeline.asking.config import configure

    config = configure("head.nii.gz", None, {"cut": CUT, "left": "1,2", "lip_force": "right=-3,4", "gravity": "0,-1",
                                             "skull": "contact", "skull_gap_mm": 1.0})
    (step,), (half,) = config.steps, scaled(config.steps, 0.5)
    left, right = half.constrain.retractions
    assert left.displacement_mm == (0.5, 1.0) and right.force_mN_per_mm == (-1.5, 2.0)
    assert step.constrain.retractions[0].displacement_mm == (1.0, 2.0)
    whole = {**vars(step.constrain), "retractions": ()}
    assert whole == {**vars(half.constrain), "retractions": ()}


@pytest.mark.parametrize("blades, more, wanted", [
    ([{"side": "left", "normal_mm": 5.0}, {"side": "right", "normal_mm": 5.0}], {},
     "opening is 0.73 of this one (opening_mm=7.3)"),
    ([{"side": "left", "displacement_mm": [0.0, 10.0], "blade": [0.0, 0.6]}], {},
     "opening is 0.73 of this one (left=(0, 7.3) blade=(0, 0.6))"),
    ([{"side": "left", "force_mN_per_mm": [-3.0, 4.0]}], {}, 'force is 0.73 of this one (lip_force="left=-2.19,2.92")'),
    ([{"side": "left", "force_mN_per_mm": [-3.0, 4.0]}, {"side": "right", "displacement_mm": [1.0, 0.0]}], {},
     'opening and force is 0.73 of this one (lip_force="left=-2.19,2.92" right=(0.73, 0))'),
    ([{"side": "left", "normal_mm": 5.0}], {}, "opening is 0.73 of this one ('left' normal_mm = 3.65)"),
    ([{"side": "left", "displacement_mm": [1.0, 2.0]}], {"step": [{}]},
     "opening is 0.73 of this one ('left' displacement_mm = 0.73,1.46)"),
])
def test_the_part_is_told_as_what_to_give(blades, more, wanted):
    empty = {"cut": "cut", "displacement_mm": None, "normal_mm": None, "force_mN_per_mm": None, "relative_to": None,
             "blade": [0.0, 0.8]}
    parameters = {"cut": [{"name": "cut"}], "step": [], "retract": [empty | {"name": b["side"]} | b for b in blades]}
    assert wanted in said(told(0.73, parameters | more))
    assert told(None, parameters | more).startswith("No part of this ")


def part_of(record) -> float:
    """The part that an untrusted run names."""
    assert record["status"] == "untrusted", record["checks"]
    return float(re.search(r"largest safe [a-z ]+ is ([\d.]+) of this one", record["error"]["text"])[1])


STEPS = """xfemnav = 1
image = "head.nii.gz"
[load]
gravity = [0, -1]
[[cut]]
points = [[-60, 10], [-15, 5]]
[[cut]]
name = "later"
points = [[60, 10], [20, 5]]
[[retract]]
name = "blade"
cut = "cut"
side = "left"
displacement_mm = [0, {}]
[[step]]
name = "sink"
acts = ["gravity"]
[[step]]
name = "open"
acts = ["cut", "blade"]
[[step]]
name = "more"
acts = ["later"]
frame = "current"
"""
CASES = {  # what is asked, as a function of a part of it
    "opening": lambda part: {"cut": CUT, "opening_mm": 44 * part},
    "finite strains": lambda part: {"cut": CUT, "left": f"0,{-6 * part}", "lips": "free", "model": "neo-hookean"},
    "forces": lambda part: {"cut": CUT, "lip_force": [f"left=0,{60 * part}", f"right=0,{-60 * part}"]},
    "with gravity": lambda part: {"cut": CUT, "opening_mm": 40 * part, "gravity": "0,-1", "skull": "contact",
                                  "young_kpa": 1.0},
    "with a gap": lambda part: {"cut": CUT, "opening_mm": 60 * part, "skull": "contact", "skull_gap_mm": 2.0},
    "lies twice": lambda part: {"cut": CUT, "left": f"0,{-6 * part}", "lips": "free"},
    "steps": lambda part: {"scenario": STEPS.format(26 * part)},
}


@pytest.mark.parametrize("case", CASES)
def test_at_the_part_that_is_named_the_run_is_trusted_and_beyond_it_is_not(case, tmp_path):
    whole = run(tmp_path, **CASES[case](1.0))
    part = part_of(whole)
    assert run(tmp_path, **CASES[case](part))["status"] == "complete"
    assert run(tmp_path, **CASES[case](1.05 * part))["status"] == "untrusted"


@settings(max_examples=6, deadline=None)
@given(st.floats(-150, -30), st.floats(0.6, 1.5), st.sampled_from(["contact", "fixed"]))
def test_the_law_of_the_named_part_holds_for_blades_of_any_direction(tmp_path_factory, degrees, young, skull):
    folder = tmp_path_factory.mktemp("law")
    x, y = (30 * f(math.radians(degrees)) for f in (math.cos, math.sin))

    def record(part):
        return run(folder, cut=CUT, right=f"{part * x},{part * y}", gravity="0.3,-0.9", young_kpa=young, skull=skull)

    whole = record(1.0)
    if whole["status"] == "untrusted" and "largest safe" in whole["error"]["text"]:
        part = part_of(whole)
        assert [record(times)["status"] for times in (part, min(1.05 * part, 1.0))] == ["complete", "untrusted"]


def test_where_no_part_is_safe_it_says_so(tmp_path):
    """Gravity alone moves the tissue by more than 50 mm, whatever the blades do."""
    record = run(tmp_path, cut=CUT, opening_mm=4, gravity="0,-1", skull="contact", young_kpa=0.3)
    assert "No part of this opening is safe" in record["error"]["text"]
    loose = run(tmp_path, flap(3.0), element_size_mm=6, corridor_element_mm=2, young_kpa=9)
    assert "No blade acts" in loose["error"]["text"]


def test_the_named_opening_can_be_pasted(tmp_path):
    text = run(tmp_path, cut=CUT, opening_mm=44)["error"]["text"]
    opening = float(re.search(r"opening_mm=([\d.]+)\)", text)[1])
    assert run(tmp_path, cut=CUT, opening_mm=opening)["status"] == "complete"


# What a run leaves ----------------------------------------------------------------------------------------------------

def test_verdicts_are_in_the_record_and_in_the_report(tmp_path):
    record = run(tmp_path, cut=CUT, opening_mm=16, report=True)
    jsonschema.validate(record, run_schema())
    assert record["verdicts"]["main_strain"]["verdict"] == "look" and codes(record) == ["W406"]
    page = (tmp_path / "out/report.html").read_text()
    row = r'<tr><td>(.*?)</td>.*<td class="number">(.*?)</td><td class="verdict (\w*)">(.*?)</td></tr>'
    rows = re.findall(row, page)
    assert len(rows) >= len(record["verdicts"])
    strain = next(row for row in rows if row[0].startswith("strain that 1 %"))
    assert strain[1:] == (f"{limits.SMALL_STRAIN.value:g}", "look", "look at it")


def test_steps_have_verdicts_of_their_own(tmp_path):
    record = run(tmp_path, STEPS.format(4), report=True)
    jsonschema.validate(record, run_schema())
    assert all(step["verdicts"]["residual"]["verdict"] == "ok" for step in record["steps"])
    assert record["steps"][-1]["verdicts"] == record["verdicts"]
    assert "places" not in record
    assert (tmp_path / "out/report.html").read_text().count('<td class="verdict ok">ok</td></tr>') >= 3


def test_a_warning_of_a_step_names_it(tmp_path):
    record = run(tmp_path, STEPS.format(12))
    said = [item["text"] for item in record["warnings"] if item["code"] == "W406"]
    assert len(said) == 2 and "in step 'open'" in said[0] and "in step 'more'" in said[1]


def test_strict_refuses_what_is_doubtful(tmp_path, capfd):
    image = write(tmp_path / "head.nii.gz")
    code, _, err = command(capfd, "run", image, "-o", tmp_path / "out", "-w", tmp_path / "cache", "--strict", *QUICK,
                           "--cut", CUT, "--opening-mm", "16")
    assert code == 65 and "W406" in err and "--strict" in err
    assert json.loads((tmp_path / "out/run.json").read_text())["status"] == "failed"


def test_a_run_that_fails_tells_its_warnings(tmp_path, capfd):
    """A cut prolonged to the outline (W301), and then lips that nobody can hold so."""
    image = write(tmp_path / "head.nii.gz")
    code, _, err = command(capfd, "run", image, "-o", tmp_path / "out", "-w", tmp_path / "cache", *QUICK,
                           "--cut", "-41,9 -15,5", "--left=0,-4", "--right", "0,4")
    assert code == 65 and "E405" in err
    recorded = json.loads((tmp_path / "out/run.json").read_text())["warnings"]
    assert all(item["code"] in err for item in recorded)


def test_the_same_run_without_blades_given_is_told_of_no_blade(tmp_path):
    assert COARSE["corridor_element_mm"] == 4, "two elements are 8 of the 30 mm that the cut is long"
    assert "W404" in codes(run(tmp_path, cut=CUT, opening_mm=4, blade=(0.0, 0.8)))
