"""The report: self-contained, inert whatever the names in it, equal for equal runs; and a paragraph that tells all."""

import copy
import json
import os
from io import BytesIO
from typing import get_args
from urllib.parse import unquote_to_bytes, urlsplit

import numpy as np
import pytest
from matplotlib import colormaps
from pages import Tags
from PIL import Image

from xfemnav.errors import FAULTS
from xfemnav.pipeline.asking.scenario import Scenario
from xfemnav.pipeline.telling import methods, palette
from xfemnav.pipeline.telling.methods import methods_paragraph
from xfemnav.pipeline.telling.report import MMHG_PER_KPA, UNCHECKED, checked, flat, render, retractor_row, write_report

EVIL = "<img src=x onerror=alert(1)>"
PNG = b"\x89PNG\r\n\x1a\n stand-in"


@pytest.fixture
def run():
    """The record of a run with every section, as in run.json."""
    asked = Scenario.model_validate({
        "xfemnav": 1, "solve": {"tip_enrichment": "topological"}, "image": "/data/sub-01_T1w.nii.gz",
        "cut": [{"name": "approach", "points": [[-54.7, 41.5], [-22.0, 18.0]]}],
        "retract": [{"side": "left", "displacement_mm": [-3.5, -1.0], "blade": [0.0, 0.8]},
                    {"side": "right", "force_mN_per_mm": [1.0, 0.5]}],
    })
    return json.loads(json.dumps({
        "schema": "xfemnav-run/1", "status": "complete", "exit_code": 0, "version": "9.8.7",
        "argv": ["xfemnav", "run", "sub-01_T1w.nii.gz", "--cut", "-54.7,41.5 -22.0,18.0"],
        "parameters": asked.model_dump(),
        "stages": [{"name": "segment", "status": "ran", "key": "ab" * 32, "seconds": 1.2345}],
        "outputs": {"updated": "sub-01_desc-updated_T1w.nii.gz"},
        "input": {"sha256": "cd" * 32, "shape": [197, 233, 1], "affine": [[1.0, 0.0, 0.0, -98.0]], "dtype": "int16"},
        "slice": {"plane": "axial", "offset": 18.0, "shape": [197, 233], "axes": np.eye(3).tolist()},
        "segmentation": {"method": "vote", "area_mm2": 15000.0},
        "resections": [], "pieces": [{"name": "organ", "area_mm2": 15000.0, "place_mm": [0.0, 0.0], "fate": "fixed"}],
        "contact": [],
        "model": {"name": "linear", "load_steps": 1, "newton_iterations": 1, "linear_difference_mm": 0.0},
        "cuts": [{"name": "approach", "path": [[-54.7, 41.5], [-22.0, 18.0]], "length_mm": 40.27}],
        "mesh": {"n_nodes": 5012, "n_cells": 9876, "min_quality": 0.81, "mean_quality": 0.993, "hausdorff_mm": 0.2},
        "enrichment": {"heaviside_nodes": 77, "tip_nodes": 6, "n_dof": 10226},
        "retractor": [{"cut": "approach", "side": "left", "force_mN_per_mm": [3.0, -4.0], "mean_pressure_kPa": 2.0,
                       "blade": [0.0, 0.75]}],
        "tips": [{"cut": "approach", "point_mm": [-22.0, 18.0], "K_I_Pa_sqrt_m": 35.36, "K_II_Pa_sqrt_m": -1.25,
                  "radius_mm": 4.0}],
        "checks": {"residual": 1e-12, "inverted_mm2": 0.0, "det_F_p01": 0.97, "largest_strain": 0.09,
                   "min_gap_mm": None, "cavity_mm2": 166.4, "vacated_mm2": 2.0,
                   "overlap_mm2": 0.0, "lip_error_mm": {"rms": 0.004, "max": 0.08}, "max_displacement_mm": 3.64},
        "verdicts": {"largest_strain": {"value": 0.09, "limit": 0.1, "verdict": "ok"}},
        "warnings": [{"code": "W301", "text": "the cut starts 2.1 mm inside"}],
    }))


def with_every_string(value, text):
    """`value` with `text` added to every string that a user can choose."""
    if isinstance(value, dict):
        return {key: with_every_string(item, text) for key, item in value.items()}
    if isinstance(value, list):
        return [with_every_string(item, text) for item in value]
    return value + text if isinstance(value, str) else value


def test_names_cannot_become_markup(run):
    evil = copy.deepcopy(run)
    for key in ("argv", "outputs", "stages"):
        evil[key] = with_every_string(run[key], EVIL)
    evil["parameters"]["image"] = evil["parameters"]["mask"] = EVIL
    evil["parameters"]["cut"][0]["name"] = evil["retractor"][0]["cut"] = evil["cuts"][0]["name"] = EVIL
    evil["warnings"][0]["text"] = EVIL
    evil["error"] = {"code": "E401", "text": EVIL}
    page = Tags(render(evil, {"figure": PNG}))
    assert [attrs["src"][:22] for tag, attrs in page.tags if tag == "img"] == ["data:image/png;base64,"]
    assert not [attrs for _, attrs in page.tags if any(name.startswith("on") for name in attrs)]
    assert "alert(1)" in page.text, "shown as text"


def test_the_page_needs_nothing_and_may_run_nothing(run):
    page = Tags(render(run, {"figure": PNG}))
    names = {tag for tag, _ in page.tags}
    assert not names & {"script", "link", "iframe", "object", "embed", "form", "base"}
    links = [attrs[name] for tag, attrs in page.tags for name in ("src", "href", "action") if name in attrs]
    assert all(link.startswith("data:") or link in run["outputs"].values() for link in links)
    policy = next(attrs["content"] for tag, attrs in page.tags if attrs.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'") and "script" not in policy


@pytest.mark.parametrize("name", ["sub-01_T1w.nii.gz", "a b&c\"<d>.nii", "javascript:alert(1).nii",
                                  "caf\udce9.nii", "a#b?c%d"])
def test_files_are_linked_by_name_whatever_is_in_it(run, name):
    run["outputs"] = {"updated": name}
    links = [attrs["href"] for tag, attrs in Tags(render(run, {})).tags if tag == "a"]
    assert len(links) == 1 and urlsplit(links[0])[:2] == ("", "") and unquote_to_bytes(links[0]) == os.fsencode(name)


def test_complete_says_what_was_checked_and_what_was_not(run):
    text = Tags(render(run, {})).text
    assert "of 1 checks with a limit none says that the result is not to be trusted. Not checked: whether the" in text
    run["verdicts"]["main_strain"] = {"value": 0.2, "limit": 0.1, "verdict": "look"}
    assert "of 2 checks with a limit none says that the result is not to be trusted, 1 of them beyond" in checked(run)
    for word in UNCHECKED:
        assert word in text
    run |= {"status": "untrusted", "error": {"code": "E401", "text": "folded"}}
    assert "Not checked" not in Tags(render(run, {})).text


def test_the_page_says_which_way_round_it_shows_the_slice(run):
    """Lips are never told by 'left lip': the patient's left is another one."""
    text = Tags(render(run, {"figure": PNG})).text
    assert "Neurological display: the patient's left on the left, anterior at the top. Left and right of a cut" in text
    assert "left of 'approach' is the A lip" in text
    run["parameters"]["display"] = "radiological"
    text = Tags(render(run, {"figure": PNG})).text
    assert "Radiological display: the patient's right on the left, anterior at the top." in text
    assert "seen from its mouth in neurological display: left of 'approach' is the A lip" in text
    assert "left lip" not in text.lower() and "right lip" not in text.lower()


def test_pictures_of_pages_are_small_and_true():
    """A figure of greys, the displacement's colours and lines, in 256 colours: the same to the eye."""
    grey = np.linspace(0, 255, 300)[None, :, None].repeat(90, axis=0).repeat(3, axis=2)
    shades = 255 * colormaps["viridis"](np.linspace(0, 1, 300))[None, :, :3].repeat(90, axis=0)
    lines = np.concatenate([np.full((30, 75, 3), line) for line in palette.LINES], axis=1)
    drawn = np.concatenate([grey, shades, lines]).astype(np.uint8)
    png = BytesIO()
    Image.fromarray(drawn).save(png, format="PNG")
    small = Image.open(BytesIO(palette.reduced(png.getvalue())))
    assert small.mode == "P" and small.size == (300, 210)
    assert np.abs(np.asarray(small.convert("RGB")).astype(int) - drawn).max() <= 8
    assert Image.open(BytesIO(palette.reduced(png.getvalue(), 100))).size == (100, 70)
    assert palette.reduced(png.getvalue()) == palette.reduced(png.getvalue())


def test_same_run_same_page_cached_or_not(run):
    again = copy.deepcopy(run)
    again["stages"][0] |= {"status": "cached", "seconds": 0.01}
    assert render(run, {"figure": PNG}) == render(again, {"figure": PNG})


def test_untrusted_is_unmistakable_and_says_why(run):
    assert 'class="status complete"' in render(run, {"figure": PNG})
    run |= {"status": "untrusted", "error": {"code": "E401", "text": "the retraction folds the tissue: 3.1 mm2"}}
    page = render(run, {"figure": PNG})
    assert 'class="status untrusted"' in page and "NOT TO BE TRUSTED" in page and "3.1 mm2" in page


def test_a_warning_comes_with_its_remedy(run):
    text = Tags(render(run, {})).text
    assert "W301" in text and "2.1 mm inside" in text and FAULTS["W301"].remedy in text


def test_pressure_in_mmhg(run):
    """1 mmHg is 133.322 Pa; 2 kPa are 15.0 mmHg. The size of (3, -4) is 5."""
    assert pytest.approx(1000 / 133.322, rel=1e-5) == MMHG_PER_KPA
    row = retractor_row(run["retractor"][0], {"approach": {"left": "A", "right": "P"}})
    assert row["side"] == "left of it, the A lip"
    assert (row["size"], row["kpa"], row["mmhg"]) == ("5.00", "2.000", "15.0")


def test_parameters_are_all_listed_but_the_unset(run):
    rows = dict(flat(run["parameters"]))
    assert rows["mesh.element_size_mm"] == "3" and rows["retract[1].blade"] == "0, 0.8"
    assert rows["cut[1].points"] == "(-54.7, 41.5), (-22, 18)" and rows["resample_mask"] == "no"
    assert "mask" not in rows and "retract[2].blade" not in rows


def test_methods_paragraph_tells_what_another_lab_needs(run):
    text = methods_paragraph(run)
    for part in ("sub-01_T1w.nii.gz", "xfemnav 9.8.7", "numpy ", "5012 nodes", "9876 linear triangles", "3 kPa",
                 "ratio 0.45", "plane strain", "by 77 nodes", "by the 6 whose support", "10226 degrees",
                 "within 20 mm", "over 4 mm",
                 "lip left of the cut was displaced by (-3.5, -1) mm over 0 to 80 %",
                 "lip right of the cut was loaded with (1, 0.5) mN",
                 "mortar", "3.64 mm", "linear interpolation", "40.3 mm long", "(-54.7, 41.5) to (-22.0, 18.0)",
                 "majority of three methods", "axial slice at 18.0 mm"):
        assert part in text, part
    assert "/data" not in text and "  " not in text and ".." not in text


@pytest.mark.parametrize("change, wanted", [
    ({"mesh": {"file": "mine.vtu"}}, "The mesh was given; it had 5012 nodes"),
    ({"mesh": {"corridor_mm": 0.0}}, "edges of 3 mm (quality"),
    ({"boundary": {"skull": "free"}}, "The outline was free."),
    ({"boundary": {"skull_ramp_mm": 0.0}}, "mm of the cut's mouth."),
    ({"boundary": {"displacement": "surface.csv"}}, "moved as measured (surface.csv)"),
    ({"solve": {"lip_constraint": "pointwise"}}, "as in [1]"),
    ({"solve": {"stress_state": "stress"}}, "plane stress"),
    ({"solve": {"tip_enrichment": "none"}}, "no crack-tip functions"),
    ({"retract": []}, "cut's mouth; the skull's grip set in over 4 mm. Lips that nothing held could"),
    ({"boundary": {"lips": "free"}}, "Lips that nothing held were free. The tissue moved"),
    ({"boundary": {"displacement": "surface.csv", "displacement_weight": 2.0}}, "followed by springs of 2 kPa/mm"),
    ({"solve": {"model": "neo-hookean"}}, "isotropic, and neo-Hookean in plane strain"),
    ({"load": {"gravity": [0.0, -1.0]}}, "Gravity acted along (0, -1) on tissue of 1000 kg/m³, drained."),
    ({"tissue": {"labels": "dseg.nii", "by_label": {"7": {"kind": "tumour", "young_kpa": None, "poisson": None}}}},
     "Label 7 of dseg.nii was tumour (9 kPa, 0.45)."),
    ({"companion": [{"image": "a/flair.nii", "kind": "continuous"}]}, "Through the same map went flair.nii."),
])
def test_methods_paragraph_follows_the_parameters(run, change, wanted):
    for section, value in change.items():
        run["parameters"][section] = run["parameters"][section] | value if isinstance(value, dict) else value
    assert wanted in methods_paragraph(run)


def test_every_choice_of_a_scenario_has_words():
    def choices(section, name):
        annotation = Scenario.model_fields[section].annotation.model_fields[name].annotation
        return set(get_args(next((each for each in get_args(annotation) if get_args(each)), annotation)))

    assert set(methods.TIPS) == choices("solve", "tip_enrichment")
    assert set(methods.LIPS) == choices("solve", "lip_constraint")
    assert set(methods.SKULLS) | {"free"} == choices("boundary", "skull")
    assert set(methods.ORGANS) == choices("segment", "method") - {"auto"} | {"mask", "stripped"}


def test_paper_is_cited(run):
    text = Tags(render(run, {"figure": PNG})).text
    for part in ("Vigneron", "Lecture Notes in Computer Science 3217", "Moës", "not a medical device"):
        assert part in text


def test_written_whole_with_any_name(run, tmp_path):
    run["parameters"]["image"] = "caf\udce9.nii"  # a byte that is no UTF-8, as the file system hands it over
    path = write_report(run, tmp_path, {})
    assert path == tmp_path / "report.html" and [path] == list(tmp_path.iterdir())
    assert "<img" not in path.read_text(encoding="utf-8")
