"""A default is one: on the page of the scenario's keys, in the help, the schema, the mechanics and every function.

The page is the text that is kept, not one made anew of the table of settings.
"""

import ast
import re
import tomllib

import pytest
from test_house import ROOT, SOURCES

from xfemnav.mechanics.rules import LipRules, Retraction, Rules, Skull, Solid
from xfemnav.pipeline.asking.parameters import ReadParams
from xfemnav.pipeline.asking.scenario import Scenario
from xfemnav.pipeline.asking.settings import OF_COMPANIONS, TABLE, SolidDefaults
from xfemnav.pipeline.running.apply import Choices
from xfemnav_cli import tools
from xfemnav_cli.run import run

ROW = re.compile(r"^\| `(?P<key>\w+)` \|[^|]*\| (?:`(?P<default>[^`|]*)`)? ?\|.*\| `--(?P<flag>[\w-]+)` \|$",
                 re.MULTILINE)
#: What a value of the mechanics, of the reader, or of `xfemnav apply` is when nothing is said.
VALUES = {
    "young_kpa": Solid().young_kpa, "poisson": Solid().poisson, "stress_state": Solid().stress_state,
    "skull": Skull().kind, "skull_gap_mm": Skull().gap_mm, "craniotomy_mm": Skull().craniotomy_mm,
    "skull_ramp_mm": Skull().ramp_mm, "lips": LipRules().lips, "lip_constraint": LipRules().lip_constraint,
    "hold_tip": LipRules().hold_tip, "model": Rules().model, "loose_pieces": Rules().loose,
    "nifti_frame": ReadParams().nifti_frame, "volume": ReadParams().volume, "nan": ReadParams().nan,
    "spacing": ReadParams().spacing, "interp": Choices().interp, "outside": Choices().outside, "fill": Choices().fill,
}
#: Parameters of a setting's name that are something else, or of a special case.
OTHERS = {
    "mechanics/conditions/lips.py: knots_along spacing",       # of hats
    "geometry/plane/sizing.py: SizeField corridor_mm",         # a field without a corridor
    "imaging/carrying/warp.py: update fill",                   # an image of known background
    "pipeline/running/result.py: _updated interp",             # labels
    *(f"pipeline/asking/settings.py: SolidDefaults {name}" for name in SolidDefaults._fields),  # of volumes
}


def on_page() -> dict:
    """Flag -> its default on the page, None where there is none, values as TOML has them."""
    text = (ROOT / "docs/reference/scenario.md").read_text()
    found = {}
    for row in ROW.finditer(text):
        written = row["default"]
        quoted = written if written is None or re.fullmatch(r"[\d.]+|true|false|\[\]", written) else f"'{written}'"
        found[row["flag"].replace("-", "_")] = tomllib.loads(f"x = {quoted}")["x"] if written else None
    return found


PAGE = on_page()


def in_schema(name):
    """The default of a setting's key."""
    section, (*path, key) = Scenario, TABLE[name].place.split(".")
    for part in path:
        section = section.model_fields[part].annotation
    return section.model_fields[key].get_default(call_default_factory=True)


def test_the_page_has_every_setting_that_is_a_key_once():
    text = (ROOT / "docs/reference/scenario.md").read_text()
    flags = [row["flag"].replace("-", "_") for row in ROW.finditer(text)]
    listed = {name for name, one in TABLE.items() if one.place and one.default != () and name not in OF_COMPANIONS}
    assert sorted(flags) == sorted(listed)


@pytest.mark.parametrize("name", PAGE)
def test_a_default_is_one(name):
    """Told, if there is one to tell, as it is: a number is no text, and 0 is not nothing."""
    default = PAGE[name]
    assert in_schema(name) == default and type(in_schema(name)) is type(default)
    said = re.search(r"\[([^\]]*)\]$", next(option.help for option in run.params if option.name == name))
    assert (said is None) == (default is None or default is False)
    if said is not None:
        assert said[1] == default if isinstance(default, str) else float(said[1]) == default
    if name in VALUES:
        assert VALUES[name] == default and type(VALUES[name]) is type(default)
    if name in ("interp", "outside"):
        assert next(option.default for option in tools.apply.params if option.name == name) == default


def test_blades_hold_what_the_help_says():
    begin, end = Retraction(0, 1, normal_mm=1.0).blade
    assert next(option.help for option in run.params if option.name == "blade").endswith(f" {begin:g} to {end:g}.")


def literals(node):
    """The defaults of a function or class that stand there as they are: (name, value)."""
    if isinstance(node, ast.FunctionDef):
        given = [*node.args.posonlyargs, *node.args.args]
        pairs = [*zip(given[len(given) - len(node.args.defaults):], node.args.defaults),
                 *zip(node.args.kwonlyargs, node.args.kw_defaults)]
        pairs = [(arg.arg, value) for arg, value in pairs]
    else:
        pairs = [(each.target.id, each.value) for each in node.body if isinstance(each, ast.AnnAssign)]
    for name, value in pairs:
        try:
            yield name, ast.literal_eval(value)
        except (TypeError, ValueError):
            continue


def test_a_parameter_that_is_called_as_a_setting_has_its_default():
    """None leaves it to the caller, `...` to an overload."""
    known = {name: [default] for name, default in PAGE.items()}
    for name, default in PAGE.items():
        known.setdefault(TABLE[name].place.rpartition(".")[2], []).append(default)
    apart, seen = set(), 0
    for path, tree in SOURCES.items():
        for node in ast.walk(tree):
            for name, value in literals(node) if isinstance(node, ast.FunctionDef | ast.ClassDef) else ():
                if name in known and value is not None and value is not ...:
                    seen += 1
                    if value not in known[name]:
                        apart.add(f"{path.partition('/')[2]}: {node.name} {name}")
    assert apart == OTHERS and seen > 40
