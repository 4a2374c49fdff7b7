"""Whatever bytes a file holds, it is read or refused with a code: no other error, no hang, no memory without end.

The same targets that `tests/fuzz/fuzz.py` feeds by coverage for as long as one likes, here with inputs of a known
shape: every field of a NIfTI header at its extremes, markups and scenarios of the right words in the wrong places.
"""

import json
import resource
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import nibabel
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.fuzz.seeds import AFFINE, CUT
from tests.fuzz.targets import TARGETS, fed, seeds, words

HANG = timedelta(seconds=10)  # an example takes milliseconds; a busy machine may take a thousand times as long
GROWTH = 2e5  # kB by which a test may raise the most memory that the process ever held; the files have a few kB

EXTREMES = [0, 1, -1, 2, 7, 348, 32767, -32768, 2**31 - 1, 2**63 - 1, 1.5, -0.0, 1e-45, 1e-3, 1e19, 1e38, 1e300,
            float("inf"), float("nan")]


def header(kind, dtype, fields) -> bytes:
    """A small NIfTI whose header has these extreme `fields`: (name, place, value)."""
    image = kind(np.arange(24).reshape(4, 3, 2).astype(dtype), AFFINE)
    image.set_qform(AFFINE, code=1)
    whole = image.to_bytes()
    size = image.header.template_dtype.itemsize
    raw = np.frombuffer(whole[:size], image.header.template_dtype).copy()
    for name, place, value in fields:
        with np.errstate(all="ignore"):
            at = raw[name].reshape(-1)
            if at.dtype.kind in "iu":
                limits = np.iinfo(at.dtype)
                value = 0 if value != value else int(min(max(value, limits.min), limits.max))
            if at.dtype.kind in "iuf":
                at[place % len(at)] = value
    return raw.tobytes() + whole[size:]


FIELDS = [name for name in nibabel.Nifti1Header.template_dtype.names if name != "magic"]
CHANGES = st.lists(st.tuples(st.sampled_from(FIELDS), st.integers(0, 7), st.sampled_from(EXTREMES)), max_size=5)


@pytest.fixture(scope="module")
def loaded():
    """All that readers are made of is in memory, libraries and kernels."""
    for name in TARGETS:
        fed(name, seeds(name)[0])


@pytest.fixture(autouse=True)
def memory(loaded):
    """What a file claims is not allocated."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < GROWTH


@settings(max_examples=150, deadline=HANG)
@given(kind=st.sampled_from([nibabel.Nifti1Image, nibabel.Nifti2Image]), changes=CHANGES, choice=st.integers(0, 3),
       dtype=st.sampled_from(["u1", "<i2", "<f4", "<f8"]), missing=st.integers(0, 40))
@example(nibabel.Nifti2Image, [("srow_y", 2, 1e300)], 0, "<i2", 0)  # squares of the affine overflow
@example(nibabel.Nifti2Image, [("scl_slope", 0, 1e300)], 0, "<i2", 0)  # values beyond float32
@example(nibabel.Nifti1Image, [("sform_code", 0, 0), ("quatern_b", 0, 1e19)], 0, "<i2", 0)
def test_any_field_of_a_nifti_header(kind, changes, choice, dtype, missing):
    names = kind.header_class.template_dtype.names
    content = header(kind, dtype, [change for change in changes if change[0] in names])
    fed("nifti", bytes([choice]) + content[: len(content) - missing // 20 * missing])


@settings(max_examples=150, deadline=HANG)
@given(start=st.sampled_from(seeds("dicom")), missing=st.integers(0, 400), changes=st.lists(
    st.tuples(st.integers(128, 1000), st.binary(max_size=9)), max_size=4))
def test_any_bytes_anywhere_in_a_dicom_file(start, changes, missing):
    content = bytearray(start)
    for place, new in changes:
        content[place : place + len(new)] = new
    fed("dicom", bytes(content[: len(content) - missing // 20 * missing]))


def test_voxels_beyond_float32_are_not_written_as_infinite():
    """An image is updated in float32: a value that is infinite there counts as infinite."""
    assert not fed("nifti", b"\0" + header(nibabel.Nifti2Image, "<i2", [("scl_slope", 0, 1e300)]))
    assert fed("nifti", b"\2" + header(nibabel.Nifti2Image, "<i2", [("scl_slope", 0, 1e300)]))


def test_separators_that_are_space_to_some_are_space_to_all():
    """str.strip takes U+001E off a number, float does not."""
    assert fed("markups", b"x,y,z\n60,-10,7\x1e\n")


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=6) | st.sampled_from(
    words("markups"))
JSON = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
    st.sampled_from(words("markups")), inner, max_size=5), max_leaves=15)


@settings(max_examples=150, deadline=HANG)
@given(places=st.lists(st.tuples(st.integers(0, 40), JSON), max_size=4))
def test_any_value_anywhere_in_a_markups_file(places):
    content = json.loads(CUT)
    for number, value in places:
        inner = list(containers(content))
        holder = inner[number % len(inner)]
        keys = list(holder) if isinstance(holder, dict) else range(len(holder))
        if keys:
            holder[keys[number % len(keys)]] = value
    fed("markups", json.dumps(content).encode())


def containers(value):
    """Every table and list in a JSON value, itself too."""
    if isinstance(value, dict | list):
        yield value
        for inner in value.values() if isinstance(value, dict) else value:
            yield from containers(inner)


NUMBERS = st.integers(-99, 99) | st.floats(-99, 99) | st.integers() | st.floats()
POINTS = st.lists(st.lists(NUMBERS, min_size=1, max_size=4), max_size=4)
VALUES = NUMBERS | st.booleans() | st.text(max_size=6) | st.sampled_from(words("scenario")) | POINTS | st.lists(
    NUMBERS, max_size=4) | st.sampled_from(["head.nii.gz", "cut.mrk.json", "surface.csv", "case.toml", "../x"])
TABLES = ["", "[slice]", "[[cut]]", "[[retract]]", "[[resect]]", "[[companion]]", "[tissue]", "[tissue.by_label.7]",
          "[boundary]", "[[boundary.arc]]", "[load]", "[[load.pressure]]", "[mesh]", "[solve]", "[warp]", "[[step]]"]
LINES = st.lists(st.tuples(st.sampled_from(words("scenario")), VALUES), max_size=4)


def toml(value) -> str:
    """A value as TOML writes it."""
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=True)
    return str(value).lower() if isinstance(value, bool | float) else str(value)


@settings(max_examples=150, deadline=HANG)
@given(st.lists(st.tuples(st.sampled_from(TABLES), LINES), max_size=6), st.sampled_from(range(len(seeds("scenario")))))
def test_any_key_anywhere_in_a_scenario(tables, start):
    lines = [seeds("scenario")[start].decode()]
    for table, rows in tables:
        lines += [table, *(f"{key} = {toml(value)}" for key, value in rows if key.isidentifier())]
    fed("scenario", "\n".join(lines).encode("utf-8", "surrogatepass"))


PIECES = [b"", b"\xff", bytes(4), b"\xff\xff\xff\x7f", b"9", b"-1 ", b"99999999 ", b"nan ", b"<", b"\n", b'"',
          b"1e308 ", b"=", b"3 "]


@settings(max_examples=400, deadline=HANG)
@given(seed=st.sampled_from(range(len(seeds("surface")))),
       places=st.lists(st.tuples(st.floats(0, 1), st.sampled_from(PIECES), st.integers(0, 9)), max_size=4))
def test_any_bytes_anywhere_in_a_surface(seed, places):
    content = seeds("surface")[seed]
    for part, put, length in places:
        at = 1 + int(part * (len(content) - 1))
        content = content[:at] + put + content[at + length:]
    fed("surface", content)


def without(key: str) -> bytes:
    """A record in which something is missing."""
    return json.dumps({name: value for name, value in json.loads(seeds("record")[0]).items() if name != key}).encode()


def mesh_of(corner: str) -> bytes:
    """A mesh of one triangle with another last corner."""
    return seeds("vtu")[0].replace(b"0 1 10<", f"{corner}<".encode())


def components(count: int) -> bytes:
    """A triangle off the slice, whose points have displacements of so many components."""
    array = f'<DataArray type="Float64" Name="displacement" NumberOfComponents="{count}">{"0 " * 3 * count}</DataArray>'
    return seeds("vtu")[0].replace(b"0 0 10", b"0 0 50").replace(
        b"<Cells>", f"<PointData>{array}</PointData><Cells>".encode())


#: Inputs that were once answered by a traceback, or a warning of numpy's.
FOUND = {
    "a record without parameters": ("record", lambda: without("parameters")),
    "a triangle of no size": ("vtu", lambda: mesh_of("0 1e-120 10").replace(b"10 1 0 10", b"10 1e-120 0 10")),
    "a triangle out of reach": ("vtu", lambda: mesh_of("0 1e200 10")),
    "displacements of one component": ("vtu", lambda: components(1)),
    "displacements of four components": ("vtu", lambda: components(4)),
    "a table with a cell without end": ("table", lambda: b"\5x,y,ux,uy\n" + b"1" * 140_000),
    "a table with a line that ends oddly": ("table", lambda: b"\5x,y,ux,uy\n1,2,3\r4,5\n"),
}


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_is_refused_with_a_code(name):
    target, content = FOUND[name]
    assert not fed(target, content())


def test_a_remark_about_another_format_makes_no_other_format():
    """Where normals before it are left out, it comes to stand where formats have their marks."""
    assert fed("surface", seeds("surface")[15] + b"vn 0 0 1\n" * 99 + b"# <VTKFile\n")


@pytest.mark.parametrize("name", TARGETS)
def test_targets_take_what_is_right(name):
    """A fuzzer that begins with what is refused at the door never comes to the rooms behind it."""
    taken = [fed(name, seed) for seed in seeds(name)]
    assert all(taken) or (name == "nifti" and taken.count(False) == 2)  # two of several volumes: E121


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_fuzzing_by_coverage_finds_nothing_in_20_seconds(name, tmp_path):
    pytest.importorskip("atheris")
    # Linux counts the memory of who starts a program as the program's: of a shell that is little.
    fuzz = sys.executable, Path(__file__).parent / "fuzz" / "fuzz.py", name, "20", tmp_path
    done = subprocess.run(["sh", "-c", '"$@"; exit $?', "sh", *fuzz], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0 and "Done" in done.stderr, done.stderr[-3000:]
