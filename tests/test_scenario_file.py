"""The scenario that a run writes: read back it is the same settings, whatever they are and wherever the files lie."""

import copy
import os
import tomllib
from dataclasses import fields
from pathlib import Path

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.asking.config import Config, configure
from xfemnav.pipeline.asking.scenario import Scenario, problems
from xfemnav.pipeline.asking.scenario_file import placed, scenario_text, seen_from, toml
from xfemnav.pipeline.asking.settings import TABLE
from xfemnav.pipeline.telling.scenariodocs import plain_keys, section_of
from xfemnav_cli.run import run

EVERYTHING = {
    "xfemnav": 1, "image": "head.nii.gz", "mask": "mask.nii.gz", "points": ["a.csv", "b.csv"],
    "streamlines": ["t.trk"], "surfaces": ["s.stl"], "slice": {}, "segment": {}, "solve": {}, "warp": {}, "mesh": {},
    "cut": [{"name": "one", "points": [[0, 0], [1, 1.5]]}, {"name": "two", "points": [[1, 2, 3], [4, 5, 6]]}],
    "retract": [{"cut": "one", "side": "left", "normal_mm": 2.0}],
    "resect": [{"name": "tumour", "outline": [[0, 0], [1, 0], [1, 1]]}],
    "companion": [{"image": "c.nii.gz"}, {"image": "d.nii.gz", "kind": "label"}],
    "tissue": {"labels": "l.nii.gz", "by_label": {"4": {"kind": "ventricle"}, "7": {"poisson": 0.1}}},
    "boundary": {"arc": [{"start": [0, 1], "end": [2, 3], "skull": "free"}]},
    "load": {"gravity": [0.0, -1.0], "pressure": [{"name": "press", "on": "tumour", "kpa": 0.5}]},
    "step": [{"name": "open", "acts": ["one", "gravity"]}, {"name": "more", "acts": ["two"], "ends": ["gravity"]}],
}
#: What keys of a volume stand in.
IN_SPACE = {
    "xfemnav": 1, "image": "head.nii.gz", "dimension": 3, "warp": {}, "boundary": {},
    "cut": [{"name": "one", "points": [[0, 0, 1], [1, 1.5, 1]], "towards": [0, 0, -9]}],
    "retract": [{"cut": "one", "side": "left", "normal_mm": 2.0}],
}
OF_SPACE = ("dimension", "towards", "depth_mm", "blade_along", "transform_spacing_mm")
#: Keys of which one alone is given; values where the schema says less than the checks; what a value needs beside it.
ONE_OF = (("points", "markups"), ("outline", "markups", "label", "mask"), ("index", "position_mm"),
          ("displacement_mm", "normal_mm", "force_mN_per_mm"))
VALUES = {"blade": [0.1, 0.7], "gravity": [0.6, 0.8], "poisson": 0.25, "points": [[0.1, 1e-7], [1e8, -3]],
          "outline": [[0, 0], [2, 0], [2, 2]], "corridor": [[0, 0], [5, 5]], "spacing": [0.5, 2.0], "acts": ["one"],
          "ends": ["one left"], "on": "outline", "cut": "one", "label": [1, 4], "dimension": 3,
          "towards": [1.5, 2.5, 1e-7], "blade_along": [0.1, 0.7], "craniotomies": [[0.5, 1.5]]}
CALLED = (("name", ("cut", 0)), ("name", ("resect", 0)))  # others name them, so they have names in EVERYTHING
NEEDS = {"hold_tip": {"solve": {"lip_constraint": "pointwise"}}}


def leaves():
    """Every key of a scenario that is no section: place of its section, its name, and values that it may take."""
    schema = Scenario.model_json_schema()
    sections = [((), schema)]
    for place, section in sections:
        for name, item in section["properties"].items():
            if inner := section_of(item):
                where = (0,) if item.get("type") == "array" else ("4",) if "patternProperties" in item else ()
                sections.append(((*place, name, *where), schema["$defs"][inner]))
        for name, item in plain_keys(section).items():
            if name != "xfemnav" and (name, place) not in CALLED:
                yield place, name, values(name, item, VALUES if place or name in OF_SPACE else {})


def values(name: str, item: dict, own: dict) -> list:
    """Values of a key that are not its default: its `own`, or by its schema."""
    if name in own:
        return [own[name]]
    kind = next(kind for kind in item.get("anyOf", [item]) if kind.get("type") != "null")
    if "enum" in kind:
        return [value for value in kind["enum"] if value != item.get("default")]
    default, pattern = item.get("default") or 0, kind.get("pattern")
    texts = kind.get("items", {}).get("type") == "string"
    return {"boolean": lambda: [not default], "integer": lambda: [default + 2], "number": lambda: [default + 0.1 + 0.2],
            "string": lambda: ["a name" if pattern else "a b \"c\" \\ \x7f ü.csv"],
            "array": lambda: [["x.csv"] if texts else [1.5, 2.5]]}[kind["type"]]()


def raw_with(place: tuple, name: str, value) -> dict:
    """A scenario with everything in it, and this value at its place."""
    raw = copy.deepcopy(IN_SPACE if name in OF_SPACE else EVERYTHING)
    for section, keys in NEEDS.get(name, {}).items():
        raw[section] |= keys
    section = raw
    for part in place:
        section = section[part]
    for rival in (other for group in ONE_OF if name in group for other in group if other != name):
        section.pop(rival, None)
    if name == "force_mN_per_mm":
        section.pop("relative_to", None)
    section[name] = value
    if value == "voxel":  # which plane mm are not read in
        del raw["boundary"]["arc"]
    return raw


@pytest.mark.parametrize("place, name, choices", list(leaves()), ids=str)
def test_every_key_is_read_back(place, name, choices):
    """Of the whole schema: a key that is added to it is here of itself."""
    assert choices
    for value in choices:
        raw = raw_with(place, name, value)
        assert problems(raw) == []
        asked = Scenario.model_validate(raw)
        written = toml({"xfemnav": 1} | asked.model_dump(mode="json", exclude={"xfemnav"}))
        assert Scenario.model_validate(tomllib.loads(written)) == asked


# Through configure: the same parameters of every stage ----------------------------------------------------------------

MINIMAL_IN_SPACE = {"dim": 3, "cut": ("-60,10,5 -15,5,5",), "towards": "0,0,0", "opening_mm": 4.0}
MINIMAL = {"cut": ("-60,10 -15,5",), "opening_mm": 4.0}
#: Flags of their own form, and what some need beside them; all others get a value by their type.
OWN = {"cut": ("-60,10 -15,5", "1,2 3,4"), "left": "3.5,1", "right": "-3.5,-1", "lip_force": ("left=0.1,-70",),
       "opening_mm": 0.3, "blade": "0.1,0.7", "internal": True, "resect": ("label=1,4", "0,0 2,0 2,2"),
       "markup": "second", "companion": ("tensor=d.nii.gz", "x_dseg.nii.gz"), "gravity": "0.6,0.8",
       "spacing": "0.5,2", "poisson": 0.25, "points": (Path("a.csv"), Path("b.csv")), "nan": -0.5, "dim": 3,
       "towards": "0.5,1,-20", "blade_along": "0.1,0.7"}
BESIDE = {"resect": {"labels": Path("l.nii.gz")}, "axes": {"companion": ("vector=v.nii.gz",)},
          "tensor_order": {"companion": ("tensor=v.nii.gz",)}, "hold_tip": {"lip_constraint": "pointwise"},
          "mesh": {}, "boundary_displacement": {}}


def flag_values(name: str) -> list:
    """Values of a flag of `xfemnav run`."""
    option = next(option for option in run.params if option.name == name)
    if name in OWN:
        return [OWN[name]]
    if isinstance(option.type, click.Choice):
        return list(option.type.choices)
    if option.is_flag:
        return [True]
    path = (Path(f"{name}.file"),) if option.multiple else Path(f"{name}.file")
    return {"integer": [3], "float": [0.1 + 0.2]}.get(option.type.name, [path])


def settings_of(config: Config) -> dict:
    """What a run does: all of it but how its scenario spells the places of files, and whether they may lie anywhere."""
    found = {field.name: getattr(config, field.name) for field in fields(config)}
    for name in ("parameters", "settings"):
        found[name] = placed(found[name], config.named, Path("/")) | {"allow_outside": None}
    for name in ("files", "named"):
        found[name] = {place: os.path.realpath(path) for place, path in found[name].items()}
    return found | {"also_read": None}


def written_again(config: Config, folder: Path, **flags) -> Config:
    """The configuration of the scenario that a run into `folder` writes."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scenario.toml").write_text(scenario_text(config.settings, config.named, folder), encoding="utf-8")
    return configure(scenario=folder / "scenario.toml", **flags)


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The folder in which commands are given, with the few files that are read when flags are."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "boundary_displacement.file").write_text("x,y,ux,uy\n0,0,1,0\n1,1,1,0\n")
    return tmp_path


@pytest.mark.parametrize("name", TABLE)
def test_every_flag_is_read_back(home, name):
    """Of the command: a flag that is added to it is here of itself."""
    alone = {"left", "right", "lip_force", "opening_mm"} & {name}
    for value in flag_values(name):
        base = MINIMAL_IN_SPACE if name in (*OF_SPACE, "dim") else {"cut": MINIMAL["cut"]} if alone else MINIMAL
        config = configure(home / "head.nii.gz", flags=base | BESIDE.get(name, {}) | {name: value})
        again = written_again(config, home / "study" / "out")
        assert settings_of(again) == settings_of(config)
        assert again.settings["allow_outside"] is True


def test_a_blade_that_nobody_gave_is_not_given_when_it_is_read_back(home):
    """What is filled in is in run.json; the scenario leaves it out, for a blade that is given and shortened is W404."""
    config = configure(home / "head.nii.gz", flags=MINIMAL)
    assert config.parameters["retract"][0]["blade"] == [0.0, 0.8]
    again = written_again(config, home)
    assert [blade.blade_given for blade in again.constrain.retractions] == [False, False]
    assert again.parameters == config.parameters | {"image": "head.nii.gz"}


def test_a_scenario_in_the_folder_of_its_files_needs_no_leave(home):
    config = configure(home / "in" / "head.nii.gz", flags=MINIMAL)
    (home / "in").mkdir()
    assert written_again(config, home).settings["allow_outside"] is False
    assert written_again(config, home / "in").settings["image"] == "head.nii.gz"


NAMES = st.text(st.characters(codec="utf-8", exclude_characters="/\0"), min_size=1, max_size=30).filter(
    lambda name: name not in (".", "..") and len(os.fsencode(name)) < 200)


@given(NAMES, NAMES)
def test_any_name_of_a_file_is_read_back(name, folder):
    config = configure(f"/data/{folder}/{name}", flags=MINIMAL)
    text = scenario_text(config.settings, config.named, Path("/data/out"))
    assert tomllib.loads(text)["image"] == f"../{folder}/{name}"


def test_a_name_that_is_no_text_is_told(home):
    """TOML is UTF-8: such a name cannot stand in it, and the command line can."""
    image = Path(os.fsdecode(b"caf\xe9.nii"))
    config = configure(image, flags=MINIMAL)
    text = scenario_text(config.settings, config.named, home)
    assert "# TOML holds UTF-8 alone" in text and "image = caf\\udce9.nii" in text
    (home / "scenario.toml").write_text(text, encoding="utf-8")
    again = configure(image, home / "scenario.toml")
    assert again.image == image


def test_paths_go_where_links_lead(home):
    """The output folder is a link, and so is the image's: '..' is where they lead. The image keeps its own name."""
    for name in ("disk/out", "store", "study"):
        (home / name).mkdir(parents=True)
    (home / "store" / "blob").write_bytes(b"")
    (home / "study" / "sub-01_T1w.nii.gz").symlink_to(home / "store" / "blob")
    (home / "alias").symlink_to(home / "study")
    (home / "out").symlink_to(home / "disk" / "out")
    found = seen_from(home / "out", Path("alias/sub-01_T1w.nii.gz"))
    assert found == "../../study/sub-01_T1w.nii.gz" and (home / "out" / found).resolve() == home / "store" / "blob"
    assert seen_from(Path("nowhere"), Path("study/x")) == "../study/x"


@pytest.mark.parametrize("given, name", [(".", "series"), ("..", None), ("../series/", "series")])
def test_a_folder_is_called_by_its_own_name(home, monkeypatch, given, name):
    (home / "series").mkdir()
    monkeypatch.chdir(home / "series")
    assert configure(given, flags=MINIMAL).image.name == (name or home.name)


# E781 -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key, flag, code", [
    ("", None, "E781"), ("allow_outside = true", None, None), ("", True, None), ("allow_outside = false", True, None),
    ('allow_outside = "yes"', None, "E781"), ("allow_outside = true", False, "E781")])
def test_paths_leave_the_folder_where_it_is_allowed(home, key, flag, code):
    (home / "case").mkdir()
    case = home / "case" / "case.toml"
    for image in ("../head.nii.gz", str(home / "head.nii.gz")):
        case.write_text(f"xfemnav = 1\nimage = '{image}'\n{key}\n[[cut]]\npoints = [[0, 0], [1, 1]]\n")
        flags = {} if flag is None else {"allow_outside": flag}
        if code:
            with pytest.raises(XfemnavError, match=r"E781.*allow_outside = true.*allow_outside=True"):
                configure(scenario=case, flags=flags)
        else:
            assert os.path.realpath(configure(scenario=case, flags=flags).image) == str(home / "head.nii.gz")


@pytest.mark.parametrize("key, code", [("", "E781"), ("allow_outside = true", "E780")])
def test_what_is_no_path_is_told(home, key, code):
    text = f'xfemnav = 1\nimage = "a\\u0000b.nii"\n{key}\n[[cut]]\npoints = [[0, 0], [1, 1]]\n'
    (home / "case.toml").write_text(text)
    with pytest.raises(XfemnavError, match=f"^{code} "):
        configure(scenario=home / "case.toml")
