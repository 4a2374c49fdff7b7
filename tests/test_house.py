"""How the code stands: its files and functions small, all that is public explained, the dimension known below alone.

Exceptions are listed by name. A list may only shrink: what is on it and need not be is a failure too.
"""

import ast
import re
from pathlib import Path

import pytest

from benchmarks import mutations
from xfemnav.errors import FAULTS

ROOT = Path(__file__).parents[1]
SOURCES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text())
           for folder in ("xfemnav", "cli") for path in sorted((ROOT / folder).rglob("*.py"))}
LINES, BODY, LONG_SHARE = 400, 30, 0.015
#: Above the parts of a mesh, files that tell the plane from space: users give points of a slice, or of the world.
PLANE_OR_WORLD = {"xfemnav/imaging/carrying/landmarks.py", "xfemnav/imaging/frames/slices.py",
                  "xfemnav/pipeline/running/session.py"}
ABOVE_PARTS = ("xfemnav/mechanics/", "xfemnav/imaging/", "xfemnav/pipeline/", "cli/")
CODE = re.compile(r"\b[EW]\d{3}\b")


def body_lines(function: ast.FunctionDef) -> int:
    """Lines of a function's body without its docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return function.end_lineno - body[0].lineno + 1 if body else 0


def public(node, name=""):
    """Public functions, classes and methods, not those within functions; of overloads the last."""
    for child in node.body:
        if isinstance(child, (ast.FunctionDef, ast.ClassDef)) and not child.name.startswith("_"):
            marks = [ast.unparse(mark) for mark in child.decorator_list]
            if "overload" not in marks:
                yield f"{name}{child.name}", child
            if isinstance(child, ast.ClassDef):
                yield from public(child, f"{child.name}.")


def is_dimension(node):
    """`.dim`, a name d, dim or n_dim, or an array's number of columns; not `.ndim`, which is 2 of points anywhere."""
    if isinstance(node, ast.Subscript):
        return re.search(r"\bshape(\(.*\))?$", ast.unparse(node.value)) and ast.unparse(node.slice) in ("1", "-1", "1:")
    return getattr(node, "id", getattr(node, "attr", "")) in ("d", "dim", "n_dim")


def told_dimensions(tree) -> list[str]:
    """Comparisons of a dimension with 2 or 3."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            literals = {getattr(each, "value", None) for side in sides for each in getattr(side, "elts", [side])
                        if not isinstance(each, ast.Attribute | ast.Subscript)}
            if any(map(is_dimension, sides)) and literals & {2, 3}:
                found.append(f"line {node.lineno}: {ast.unparse(node)}")
    return found


#: Settings of the mechanics, and in how many files one may be called by its name.
SETTINGS, HOMES = ("tip_enrichment", "lip_constraint", "skull_gap_mm", "stress_state"), 4
#: Most parameters of a function; kernels, which have no values to hold them in, may have more.
PARAMETERS = 8
#: Functions with more: it is called by keywords, with what a scenario says of a companion.
MANY = {"xfemnav/imaging/carrying/companions.py: carry"}


def words(tree) -> set[str]:
    """All that code calls by name: variables, attributes, parameters, and the last word of texts that are one name."""
    found = set()
    for node in ast.walk(tree):
        names = (getattr(node, field, None) for field in ("id", "attr", "arg"))
        found |= {name for name in names if isinstance(name, str)}
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"[\w.]+", node.value):
            found.add(node.value.rpartition(".")[2])
    return found


@pytest.mark.parametrize("setting", SETTINGS)
def test_a_setting_is_at_home_in_few_files(setting):
    """Not counting messages, which name it to who reads them."""
    homes = [name for name, tree in SOURCES.items() if setting in words(tree)]
    assert 0 < len(homes) <= HOMES, homes


def test_functions_take_few_parameters():
    many = set()
    for name, tree in SOURCES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and "njit" not in " ".join(map(ast.unparse, node.decorator_list)):
                given = {arg.arg for arg in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)}
                many |= {f"{name}: {node.name}"} if len(given - {"self", "cls"}) > PARAMETERS else set()
    assert many == MANY


def test_files_are_short():
    assert [name for name in SOURCES if len((ROOT / name).read_text().splitlines()) > LINES] == []


def test_functions_are_short():
    lines = {f"{name}: {node.name}": body_lines(node) for name, tree in SOURCES.items() for node in ast.walk(tree)
             if isinstance(node, ast.FunctionDef)}
    long = {name: n for name, n in lines.items() if n > BODY}
    assert len(long) <= LONG_SHARE * len(lines), long


@pytest.mark.parametrize("name", SOURCES)
def test_all_that_is_public_is_explained(name):
    tree = SOURCES[name]
    assert ast.get_docstring(tree), "the module"
    assert [each for each, node in public(tree) if not ast.get_docstring(node)] == []


def test_above_the_parts_the_dimension_is_not_asked_for():
    """What follows from it there is in the arrays' shapes."""
    asked = {name: found for name, tree in SOURCES.items() if name.startswith(ABOVE_PARTS)
             and (found := told_dimensions(tree))}
    assert set(asked) == PLANE_OR_WORLD, asked


@pytest.mark.parametrize("source, seen", [
    ("mesh.dim == 2", 1), ("3 == d", 1), ("points.shape[1] == 2", 1), ("np.shape(x)[-1] in (2, 3)", 1),
    ("x.shape[1:] != (2,)", 1), ("dim < 3", 1), ("x.ndim == 2", 0), ("len(x) == 3", 0), ("d == e", 0),
    ("x.shape[0] == 3", 0), ("a.shape[1] == b[2]", 0), ("x.shape[1] == 4", 0),
])
def test_the_check_sees_who_asks(source, seen):
    assert len(told_dimensions(ast.parse(source))) == seen


def test_every_code_is_awaited_by_a_test():
    """In a test's code, not in what it says of itself."""
    awaited = set()
    for path in (ROOT / "tests").glob("*.py"):
        tree = ast.parse(path.read_text())
        said = {id(node.body[0].value) for node in ast.walk(tree)
                if isinstance(node, (ast.Module, ast.FunctionDef, ast.ClassDef)) and ast.get_docstring(node)}
        awaited |= {code for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
                    and id(node) not in said for code in CODE.findall(node.value)}
    assert set(FAULTS) - awaited == set()


@pytest.mark.parametrize("fault", mutations.FAULTS, ids=lambda fault: fault.what)
def test_every_planted_fault_has_its_place(fault):
    """Where code moves or changes, the list of faults goes with it: else one is planted nowhere."""
    assert mutations.source(fault).read_text().count(fault.right) == 1 and fault.wrong != fault.right
    assert fault.tests and all((ROOT / f"tests/test_{name}.py").exists() for name in fault.tests)
