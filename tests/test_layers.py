"""The house rules that a machine can hold: who imports whom, where foreign packages live, what the wheel carries."""

import ast
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from fnmatch import fnmatch
from graphlib import TopologicalSorter
from pathlib import Path

import numpy as np
import pytest

from xfemnav.pipeline.layers import LAYERS, ROOMS, reach

ROOT = Path(__file__).parents[1]
PACKAGE = sorted((ROOT / "xfemnav").rglob("*.py")) + sorted((ROOT / "cli").rglob("*.py"))
EVERYWHERE = set(LAYERS)

# Third-party package -> the layers that may import it. A package that is not listed may be imported nowhere.
HOMES = {
    "numpy": EVERYWHERE - {"cli"},
    "scipy": EVERYWHERE - {"cli"},
    "numba": {"geometry", "mechanics", "imaging", "pipeline"},  # pipeline: where compiled kernels are kept, no kernels
    "sksparse": {"mechanics"},
    "shapely": EVERYWHERE - {"cli"},
    "nibabel": {"imaging"},
    "SimpleITK": {"imaging"},
    "skimage": {"imaging"},
    "pyamg": {"mechanics"},
    "pydicom": {"imaging"},
    "h5py": {"imaging"},
    "meshio": {"pipeline", "imaging"},  # imaging: the self-test of surfaces alone, which other programs must read
    "matplotlib": {"pipeline"},
    "jinja2": {"pipeline"},
    "PIL": {"pipeline"},
    "pydantic": {"pipeline"},
    "rich": {"cli"},
    "click": {"cli"},
    "lazy_loader": {"root"},
}
EXAMPLES = {"xfemnav_examples": "cli/example.py"}  # the package of data_synthetic, and who alone imports it
FORBIDDEN = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "data_synthetic", "tests"}


def layer_of(path: Path) -> str:
    """'geometry', ..., 'cli', or 'root' for the modules beside the layers (`xfemnav.errors`, the public names)."""
    parts = path.relative_to(ROOT).parts
    if parts[0] == "cli" or parts == ("xfemnav", "__main__.py"):  # the command by another name
        return "cli"
    return parts[1] if len(parts) > 2 else "root"


def imports(source: str):
    """Every module that `source` imports, wherever the statement stands: (dotted name, line)."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"line {node.lineno}: relative import")
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)


def own_layer(module: str) -> str | None:
    """The layer of an imported module of this project, 'root' for what all may import, None for foreign modules."""
    first, *rest = module.split(".")
    if first in ("xfemnav_cli", "cli"):
        return "cli"
    if first != "xfemnav":
        return None
    return rest[0] if rest and rest[0] in LAYERS else "root"


def faults(layer: str, source: str, module_name: str = "") -> list[str]:
    """What `source`, a module of `layer`, imports against the rules."""
    found = []
    for module, line in imports(source):
        first, own = module.split(".")[0], own_layer(module)
        if first in FORBIDDEN:
            found.append(f"line {line}: {first} is never imported")
        elif first in EXAMPLES:
            if module_name != EXAMPLES[first]:
                found.append(f"line {line}: {first} is imported by {EXAMPLES[first]} alone")
        elif own is not None:
            # The public names at the root are the Python face of the pipeline; whoever imports them depends on it.
            allowed = {"root", *reach(layer)} if layer != "root" else {"root", "pipeline"}
            if own not in allowed:
                found.append(f"line {line}: {layer} must not import {module}")
        elif first not in sys.stdlib_module_names and layer not in HOMES.get(first, ()):
            found.append(f"line {line}: {first} has no place in {layer}")
    return found


@pytest.mark.parametrize("path", PACKAGE, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_keep_to_the_layers(path):
    assert faults(layer_of(path), path.read_text(), path.relative_to(ROOT).as_posix()) == []


def room_of(module: str) -> tuple[str, int]:
    """The layer of a module by its dotted name, and which floor of it: 0 for the files beside its folders."""
    layer, room = [*module.split(".")[1:], "", ""][:2]
    return layer, ROOMS.get(layer, ()).index(room) + 1 if room in ROOMS.get(layer, ()) else 0


@pytest.mark.parametrize("path", PACKAGE, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_keep_to_the_order_of_the_rooms(path):
    layer, floor = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
    above = [f"line {line}: {module}" for module, line in imports(path.read_text())
             if module.startswith("xfemnav.") and room_of(module)[0] == layer and room_of(module)[1] > floor]
    assert above == []


def test_the_rooms_are_the_folders():
    for layer, rooms in ROOMS.items():
        assert sorted(rooms) == sorted(path.parent.name for path in (ROOT / "xfemnav" / layer).glob("*/__init__.py"))


@pytest.mark.parametrize("layer, source", [
    ("mechanics", "from xfemnav.imaging.carrying.warp import pull_back"),
    ("imaging", "import xfemnav.mechanics.solving.solution"),
    ("geometry", "def f():\n    from xfemnav.pipeline import store"),
    ("pipeline", "from xfemnav_cli.main import main"),
    ("pipeline", "import nibabel.nifti1"),
    ("mechanics", "from skimage.measure import label"),
    ("cli", "import numpy as np"),
    ("geometry", "import click"),
    ("imaging", "import cv2"),
    ("pipeline", "import pickle"),
    ("cli", "from data_synthetic.phantom import slice_a"),
    ("cli", "from xfemnav_examples import files"),
])
def test_the_check_sees_a_wrong_import(layer, source):
    assert len(faults(layer, source)) == 1


def test_no_modules_import_each_other_in_a_circle():
    """Wherever the import stands, in a function too: what a module needs is there before it."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in PACKAGE}
    graph = {name: {own for module, _ in imports(path.read_text()) for own in (module, module.rpartition(".")[0])
                    if own in names and own != name} for name, path in names.items()}
    assert len(list(TopologicalSorter(graph).static_order())) == len(PACKAGE)  # CycleError names the circle


def test_the_table_is_the_design():
    """geometry <- mechanics, geometry <- imaging, all <- pipeline <- cli; mechanics and imaging never meet."""
    assert reach("mechanics") == ("geometry", "mechanics")
    assert reach("imaging") == ("geometry", "imaging")
    assert set(reach("cli")) == EVERYWHERE
    folders = {path.name for path in (ROOT / "xfemnav").iterdir() if (path / "__init__.py").exists()}
    assert folders | {"cli"} == EVERYWHERE


@pytest.mark.parametrize("path", PACKAGE, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_array_is_unpickled(path):
    """numpy refuses pickled objects unless it is asked to: nobody asks."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert isinstance(node.value, ast.Constant) and node.value.value is False, f"line {node.value.lineno}"


def test_importing_the_packages_imports_no_numerics():
    """`import xfemnav` and every package of it cost nothing: numpy alone would take longer than `--help` may."""
    names = ["xfemnav", *(f"xfemnav.{layer}" for layer in LAYERS if layer != "cli"), "xfemnav.errors", "xfemnav_cli"]
    heavy = set(HOMES) - {"click", "rich", "lazy_loader"}
    code = f"import sys, {', '.join(names)}; print(*({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_examples_stand_on_what_the_wheel_brings():
    """They go by another name in the wheel: they name each other relatively, and of the project geometry alone."""
    for path in (ROOT / "data_synthetic").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                known = name.split(".")[0] in (*sys.stdlib_module_names, "numpy", "scipy", "nibabel", "shapely")
                assert known or name.startswith("xfemnav.geometry"), f"{path.name} line {node.lineno}: {name}"


def test_build_names_every_package_and_its_data():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for path in [*PACKAGE, *(ROOT / "data_synthetic").glob("*.py")]}
    called = {folder: name for name, folder in settings["package-dir"].items()}
    packages = {(".".join((called.get(parts[0], parts[0]), *parts[1:]))): folder for folder in folders
                for parts in [folder.relative_to(ROOT).parts]}
    assert sorted(packages) == sorted(settings["packages"])
    for name, folder in packages.items():
        data = {path.name for path in folder.iterdir() if path.is_file() and path.suffix not in (".py", ".pyc")}
        patterns = settings["package-data"].get(name, [])
        assert {file for file in data if not any(fnmatch(file, pattern) for pattern in patterns)} == set(), name


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """The sdist, and the wheel that is built of it."""
    home = tmp_path_factory.mktemp("built")
    copy = home / "source"  # a build leaves files in the folder that it reads
    for name in ("xfemnav", "cli", "data_synthetic"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    make = "import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", make, home], cwd=copy, check=True, capture_output=True)
    sdist, = home.glob("*.tar.gz")
    subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", home, sdist], check=True)
    return sdist, next(home.glob("xfemnav-*.whl"))


@pytest.mark.slow
def test_wheel_claims_no_foreign_name(built):
    """It installs `xfemnav`, `xfemnav_cli` and `xfemnav_examples` alone: `cli` would claim that name for everyone."""
    with zipfile.ZipFile(built[1]) as wheel:
        shipped = {name for name in wheel.namelist() if ".dist-info/" not in name}
    data = [path for end in ("*.html", "*.json", "*.pyi", "py.typed") for path in (ROOT / "xfemnav").rglob(end)]
    examples = [path for end in ("*.py", "*.toml") for path in (ROOT / "data_synthetic").glob(end)]
    sources = {path.relative_to(ROOT).as_posix() for path in [*PACKAGE, *data, *examples]}
    called = {"cli": "xfemnav_cli", "data_synthetic": "xfemnav_examples"}
    assert shipped == {"/".join((called.get(first, first), *rest)) for first, *rest in (n.split("/") for n in sources)}


@pytest.mark.slow
def test_wheel_alone_has_the_examples(built, tmp_path):
    """In an environment that sees the libraries, and of this project its wheel alone."""
    home = tmp_path / "venv"
    venv.create(home, with_pip=False)
    site, = (home / "lib").glob("python*/site-packages")
    with zipfile.ZipFile(built[1]) as wheel:
        wheel.extractall(site)
    libraries = tmp_path / "libraries"  # links to what is installed here, without the project
    libraries.mkdir()
    for path in Path(np.__file__).parents[1].iterdir():
        if "xfemnav" not in path.name and path.suffix not in (".pth", ".egg-link"):
            (libraries / path.name).symlink_to(path)
    (site / "libraries.pth").write_text(f"{libraries}\n")
    program = [home / "bin" / "python", "-c", "from xfemnav_cli.main import main; main()"]
    for name, image in (("phantom", "sub-phantom_T1w.nii.gz"), ("surgery", "sub-mni_T1w.nii.gz")):
        done = subprocess.run([*program, "example", name, name], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert (tmp_path / name / image).is_file() and str(Path(name) / image) in done.stdout.splitlines()
    code = "import xfemnav, xfemnav_examples as e; print(xfemnav.__file__, e.__file__)"
    where = subprocess.run([program[0], "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert where.count(str(site)) == 2
