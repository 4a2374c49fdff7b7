"""Scenario and flags: all that is wrong is told at once, and each stage gets its own parameters and no others."""

import subprocess
import sys
from dataclasses import fields
from typing import get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.asking.config import configure, scenario_problems
from xfemnav.pipeline.asking.scenario import CompanionSection, Scenario, problems
from xfemnav.pipeline.asking.scenario_file import read_toml
from xfemnav.pipeline.asking.settings import FLAGS, KINDS, OF_COMPANIONS, STAGES, TABLE
from xfemnav.pipeline.keeping.keys import canonical
from xfemnav_cli.run import Control, run

SCENARIO = """
xfemnav = 1
image = "head.nii.gz"
[[cut]]
name = "approach"
points = [[-54.7, 41.5], [-22.0, 18.0]]
[[retract]]
side = "left"
displacement_mm = [3.5, 1.0]
[mesh]
element_size_mm = 4.0
"""
CUT = {"cut": ("0,0 10,0",)}


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(SCENARIO)
    return path


def refused(code, *arguments, **flags):
    with pytest.raises(XfemnavError) as caught:
        configure(*arguments, **flags)
    assert caught.value.code == code
    return caught.value.message


def test_every_problem_is_told_at_once_with_the_nearest_name():
    found = problems({
        "xfemnav": 1, "imge": "a", "mesh": {"elment_size_mm": 3, "corridor_mm": float("nan")}, "space": "mni",
        "cut": [{"points": [[0, 0], [1, 1]], "name": "a"}, {"points": [["0", 0], [1, 1]], "name": "a"}],
        "retract": [{"side": "top", "cut": "approach", "displacement_mm": [1, 2]}],
    })
    text = "\n".join(found)
    for part in ("imge: unknown key, did you mean 'image'", "mesh.elment_size_mm: unknown key, did you mean 'element",
                 "mesh.corridor_mm", "space: ", "cut.1.points.0.0", "two cuts are called 'a'", "retract.0.side",
                 "no cut is called 'approach'"):
        assert part in text, part


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e999", '"12"', "true", "[1]", '""', "{}"])
def test_what_is_no_finite_number_is_no_displacement(scenario, value):
    """Row 35."""
    scenario.write_text(SCENARIO.replace("3.5", value))
    assert "retract.0.displacement_mm" in refused("E780", scenario=scenario)


@pytest.mark.parametrize("value", ["nan,1", "inf,1", "1e999,1", "a,b", "nan", "inf", "1,2,3", "", ",", "0x1,2", "1;2"])
def test_what_is_no_finite_number_is_no_flag(value):
    assert "left: " in refused("E780", "head.nii", flags=CUT | {"left": value})


def test_several_wrong_flags_are_told_at_once():
    text = refused("E780", None, flags={"cut": ("1,a",), "left": "x", "fill": float("nan"), "element_size_mm": -1.0})
    for part in ("cut: ", "left: ", "fill: ", "element_size_mm: ", "no image"):
        assert part in text, part


def test_a_run_needs_a_cut_but_a_mesh_does_not():
    assert "(cut=" in refused("E780", "head.nii", flags={})
    assert configure("head.nii", flags={}, until="mesh").mesh.corridor == ()


def test_flags_and_image_win_over_the_scenario(scenario):
    plain = configure(scenario=scenario)
    assert plain.image == scenario.parent / "head.nii.gz" and plain.mesh.element_size_mm == 4.0
    changed = configure("other.nii", scenario, {"element_size_mm": 2.0, "right": "-1,-2", "left": (1, 2)})
    assert str(changed.image) == "other.nii" and changed.mesh.element_size_mm == 2.0
    assert [(r.side, r.displacement_mm) for r in changed.constrain.retractions] == [(1, (1.0, 2.0)), (-1, (-1.0, -2.0))]
    replaced = configure(scenario=scenario, flags=CUT)
    assert replaced.constrain.cuts[0].points == ((0.0, 0.0), (10.0, 0.0)) and replaced.constrain.retractions == ()


def test_opening_is_half_on_each_lip_and_excludes_the_others():
    config = configure("head.nii", flags=CUT | {"opening_mm": 5.0, "blade": "0.1,0.6"})
    assert [(r.side, r.normal_mm, r.blade) for r in config.constrain.retractions] == [
        (1, 2.5, (0.1, 0.6)), (-1, 2.5, (0.1, 0.6))]
    assert "opening_mm: " in refused("E780", "head.nii", flags=CUT | {"opening_mm": 5.0, "left": "1,1"})
    assert "lip_force: " in refused("E780", "head.nii", flags=CUT | {"left": "1,1", "lip_force": ("left=1,1",)})


def test_a_displacement_says_from_where_it_counts_and_a_force_does_not(scenario):
    """Left out, it is the mechanics' choice; `opening_mm` is two displacements along the normal."""
    opened = configure("head.nii", flags=CUT | {"opening_mm": 5.0})
    assert [r.relative_to for r in opened.constrain.retractions] == [None, None]
    start, blade = SCENARIO.split("[[retract]]")[0], '[[retract]]\nside = "left"\nrelative_to = "{}"\n{}\n'
    for counts in ("loads", "rest"):
        scenario.write_text(start + blade.format(counts, "normal_mm = 2.0"))
        assert configure(scenario=scenario).constrain.retractions[0].relative_to == counts
    for counts, what in (("loads", "force_mN_per_mm = [1.0, 0.0]"), ("gravity", "normal_mm = 2.0")):
        scenario.write_text(start + blade.format(counts, what))
        assert "relative_to" in refused("E780", scenario=scenario)


def test_a_stage_reads_its_own_parameters_and_no_others():
    """What a flag changes: the parameters of one stage, or of mesh and constrain where the cut draws the corridor."""
    start = CUT | {"opening_mm": 4.0}
    base = configure("head.nii", flags=start)
    for changed, flags in (
        ("warp", {"interp": "cubic"}), ("constrain", {"opening_mm": 5.0}), ("constrain", {"poisson": 0.3}),
        ("mesh", {"element_size_mm": 5.0}), ("segment", {"slice": 3}), ("read", {"nan": 0.0}),
        ("mesh constrain", {"cut": ("0,0 9,1",)}), ("constrain", {"skull": "free"}),
    ):
        other = configure("head.nii", flags=start | flags)
        assert [s for s in ("read", *STAGES) if getattr(other, s) != getattr(base, s)] == changed.split(), flags
    uniform = configure("head.nii", flags=start | {"corridor_mm": 0.0})
    moved = configure("head.nii", flags=start | {"corridor_mm": 0.0, "cut": ("0,0 9,1",), "space": "lps"})
    assert uniform.mesh == moved.mesh != base.mesh


def test_planned_corridor_keeps_the_mesh_when_the_cut_moves(scenario):
    scenario.write_text(SCENARIO + "corridor = [[-60, 40], [-20, 20]]\n")
    moved = scenario.with_name("moved.toml")
    moved.write_text(scenario.read_text().replace("-22.0, 18.0", "-23.0, 19.0"))
    assert configure(scenario=scenario).mesh == configure(scenario=moved).mesh


# Hostile files -------------------------------------------------------------------------------------------------------

PARTS = st.sampled_from(["..", ".", "a", "/etc", "passwd", "\0", "link", "~", "c:\\x", " ", "ü", "/"])


@settings(max_examples=60, deadline=None)
@given(st.lists(PARTS, min_size=1, max_size=5))
def test_paths_stay_in_the_folder_of_the_scenario(tmp_path_factory, parts):
    """Row 49: whatever the path, either it lies in the folder, or E781 (E780 where it is no path at all)."""
    home = tmp_path_factory.mktemp("home") / "inner"
    home.mkdir()
    (home / "link").symlink_to("/etc")
    text = "/".join(parts)
    path = home / "case.toml"
    escaped = text.replace("\\", "\\\\").replace("\0", "\\u0000")
    path.write_text(SCENARIO.replace("head.nii.gz", escaped), encoding="utf-8")
    try:
        assert configure(scenario=path).image.resolve().is_relative_to(home)
    except XfemnavError as error:
        assert error.code == "E781"


@pytest.mark.parametrize("text", [
    "x = " + "[" * 100_000, "x = " + "[" * 40 + "]" * 40, "a.b." * 20_000 + "c = 1", "xfemnav = 1\nxfemnav = 1", "[[[",
    "xfemnav = 1\nimage = 3", "", "\0", "# " + "x" * 1_000_001,
], ids=["nested", "deep", "dotted", "duplicate", "torn", "type", "empty", "nul", "long"])
def test_hostile_scenarios_are_one_error(tmp_path, text):
    """Row 50."""
    path = tmp_path / "case.toml"
    path.write_text(text)
    message = refused("E780", scenario=path)
    assert len(message) < 2000
    assert scenario_problems(path)


@pytest.mark.parametrize("written", [
    lambda text: b"\xef\xbb\xbf" + text.encode(), lambda text: text.replace("\n", "\r\n").encode(),
    lambda text: text.replace("\n", "\r").encode(), lambda text: text.replace("\n", "\r\n").encode("utf-8-sig")])
def test_scenarios_as_editors_save_them(scenario, written):
    wanted = read_toml(scenario)
    scenario.write_bytes(written(SCENARIO))
    assert read_toml(scenario) == wanted


@pytest.mark.parametrize("content, words", [
    (SCENARIO.encode("utf-16"), "UTF-16 text"), (SCENARIO.encode("utf-16-le"), "UTF-16 text"),
    (SCENARIO.encode("utf-16-be"), "UTF-16 text"), (b"# caf\xe9\n" + SCENARIO.encode(), "no UTF-8 text (byte 5)")])
def test_other_encodings_are_told_by_their_names(scenario, content, words):
    scenario.write_bytes(content)
    assert words in refused("E780", scenario=scenario) and words in scenario_problems(scenario)[0]


@pytest.mark.parametrize("path", ["C:\\Users\\me\\a.nii", "C:\\data\\a.nii", "D:\\Ubung\\a.nii", "C:\\temp\\a.nii",
                                  "C:\\brain\\t1.nii"])
def test_backslashes_in_double_quotes_are_told_with_both_ways_out(scenario, path):
    """Some of them are escapes that TOML knows: a tab is in the path then, and no backslash."""
    scenario.write_text(SCENARIO.replace('"head.nii.gz"', f'"{path}"'))
    for text in (refused("E780", scenario=scenario), scenario_problems(scenario)[0]):
        assert "single quotes, 'C:\\Users', or with /" in text
    for mended in (f"'{path}'", f'"{path}"'.replace("\\", "/")):
        scenario.write_text(SCENARIO.replace('"head.nii.gz"', mended))
        assert "single quotes" not in " ".join(scenario_problems(scenario))


def test_a_file_whose_name_has_a_tab_is_read(scenario):
    (scenario.parent / "a\tb.nii").write_bytes(b"")
    scenario.write_text(SCENARIO.replace("head.nii.gz", "a\\tb.nii"))
    assert configure(scenario=scenario).image.name == "a\tb.nii"


def test_check_lists_missing_files_too(scenario):
    assert [line[:11] for line in scenario_problems(scenario)] == ["E100 image:"]
    (scenario.parent / "head.nii.gz").write_bytes(b"")
    assert scenario_problems(scenario) == []


@pytest.mark.parametrize("header, rows, code", [
    ("x,y,ux,uy", "0,0,1,1\n5,0,1,1", None), ("x,y,ux,uy,side", "0,0,1,1,1\n5,0,1,1,-1", None),
    ("x,y,u", "0,0,1", "E408"), ("x,y,ux,uy", "0,0,1,nan\n1,1,1,1", "E408"), ("x,y,ux,uy", "0,0,1,1", "E408"),
    ("", "", "E408"),
])
def test_measured_boundary_is_read_or_refused(tmp_path, header, rows, code):
    path = tmp_path / "surface.csv"
    path.write_text(f"{header}\n{rows}\n")
    flags = CUT | {"boundary_displacement": path}
    if code:
        refused(code, "head.nii", flags=flags)
        return
    read = configure("head.nii", flags=flags)
    assert len(read.constrain.skull.measured.rows) == 2
    path.write_text(path.read_text(), encoding="utf-8-sig")  # with the mark that spreadsheets put first
    assert configure("head.nii", flags=flags).constrain == read.constrain
    assert "boundary_displacement: " in refused("E780", "head.nii", flags=flags | {"space": "voxel"})


# One list of flags ---------------------------------------------------------------------------------------------------

def test_command_line_and_table_of_flags_agree():
    own = {field.name for field in fields(Control)} | {"image", "scenario"}
    assert {option.name for option in run.params} - own == set(TABLE)


def test_choices_of_the_command_line_are_those_of_the_schema():
    for option in run.params:
        if option.name not in FLAGS or not hasattr(option.type, "choices"):
            continue
        section = Scenario
        *path, name = FLAGS[option.name].split(".")
        for part in path:
            section = section.model_fields[part].annotation
        annotation = section.model_fields[name].annotation
        choices = [c for arm in (get_args(annotation) or ()) for c in (get_args(arm) or [arm]) if isinstance(c, str)]
        assert list(option.type.choices) == choices, option.name


def test_choices_of_companions_are_those_of_the_schema():
    options = {option.name: list(option.type.choices) for option in run.params if option.name in OF_COMPANIONS}
    options["kind"] = list(KINDS)
    for flag, choices in options.items():
        annotation = CompanionSection.model_fields[OF_COMPANIONS.get(flag, flag)].annotation
        found = [c for arm in get_args(annotation) for c in (get_args(arm) or [arm]) if isinstance(c, str)]
        assert choices == found, flag


def test_companions_by_flags_have_their_axes_and_order():
    given = {"companion": ("tensor=d.nii.gz", "x_dseg.nii.gz"), "axes": "image", "tensor_order": "mrtrix"}
    carried = configure("head.nii", flags=CUT | given | {"opening_mm": 4.0}).carry.companions
    assert [(item.kind, item.axes, item.order) for item in carried] == [("tensor", "image", "mrtrix"),
                                                                        (None, "image", "mrtrix")]
    plain = configure("head.nii", flags=CUT | {"companion": ("vector=v.nrrd",), "opening_mm": 4.0}).carry.companions[0]
    assert (plain.kind, plain.axes, plain.order) == ("vector", "file", None)
    with pytest.raises(XfemnavError, match=r"E780.*tensor_order: is for companions"):
        configure("head.nii", flags=CUT | {"tensor_order": "fsl", "opening_mm": 4.0})


def test_every_stage_has_parameters_that_a_key_can_hold():
    config = configure("head.nii", flags=CUT | {"opening_mm": 4.0})
    for stage in STAGES:
        params = getattr(config, stage)
        canonical(params)
        assert all(hasattr(params, f.name) for f in fields(params))


def test_configuring_imports_no_numerics():
    code = ("import sys, xfemnav_cli.main; from xfemnav.pipeline.asking.config import configure;"
            "configure('a.nii', flags={'cut': ('0,0 1,1',)});"
            "assert not {'numpy', 'scipy', 'nibabel'} & set(sys.modules)")
    subprocess.run([sys.executable, "-c", code], check=True)


ANYTHING = st.sampled_from([None, True, -1, 10**400, 1e308, float("nan"), "", "cut", "gravity", "\0", [], [[]], [[[]]],
                            {}, [{}], [None], ["cut", 1], [1e308, 0], [[0, 0], [0, "x"]], {"name": []}, {"1": []},
                            [{"name": {}, "on": []}], [{"start": 1}]])
PLACES = st.sampled_from([(section, key) for section, keys in {
    "cut": ("name", "points", "markups", "smooth"), "retract": ("name", "cut", "side", "normal_mm", "blade"),
    "resect": ("name", "outline", "label", "mask"), "step": ("name", "acts", "ends", "frame"),
    "companion": ("image", "kind", "axes"), "load": ("gravity", "pressure", "fluid_level_mm"),
    "boundary": ("skull", "arc", "displacement"), "tissue": ("young_kpa", "labels", "by_label"),
    "mesh": ("file", "corridor"), "slice": ("index", "plane"),
}.items() for key in keys])


@settings(max_examples=300)
@given(st.lists(st.tuples(PLACES, ANYTHING, st.booleans()), max_size=6),
       st.dictionaries(st.sampled_from(["cut", "retract", "step", "load", "tissue", "slice"]), ANYTHING, max_size=2))
def test_no_value_of_a_scenario_is_a_bug(places, sections):
    """Whatever stands where a name, a number or a table should: problems in words."""
    raw = {"xfemnav": 1, "image": "head.nii.gz", "cut": [{"points": [[0, 0], [1, 1]]}]}
    for (section, key), value, as_array in places:
        items = raw.setdefault(section, [{}] if as_array else {})
        (items[0] if isinstance(items, list) else items)[key] = value
    assert all(isinstance(text, str) for text in problems(raw | sections))


def test_directions_as_large_as_numbers_go_are_told():
    for gravity in ([0, 1e9], [1e9, 1e9], [0, 0], [1e-200, 0]):
        assert "must be a direction" in "\n".join(problems({"xfemnav": 1, "load": {"gravity": gravity}}))


@pytest.mark.parametrize("value", ["3.5", " 3.5", 3.5])
def test_one_number_moves_a_lip_away_from_the_other(value):
    """As in a session."""
    (blade,) = configure("head.nii", flags=CUT | {"left": value}).constrain.retractions
    assert (blade.side, blade.normal_mm, blade.displacement_mm) == (1, 3.5, None)
