"""The codec of stage values: what comes back is what went in, equal values are equal bytes, liars are refused."""

import io
import pickle
from dataclasses import dataclass, fields

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from xfemnav.errors import XfemnavError
from xfemnav.geometry.mesh import Mesh
from xfemnav.geometry.plane.cut import Cut
from xfemnav.pipeline.keeping.store import ARRAYS, TREE, load, read_array, save

TRIANGLE = Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
DTYPES = st.sampled_from([np.float64, np.float32, np.int64, np.int8, np.bool_, np.complex128])
LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text(),
                   DTYPES.flatmap(lambda dtype: arrays(dtype, st.tuples(st.integers(0, 3), st.integers(0, 3)))))
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3).map(tuple)
                      | st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3), max_leaves=8)


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and a == b


@settings(max_examples=60, deadline=None)
@given(VALUES)
def test_what_comes_back_is_what_went_in(tmp_path_factory, value):
    folder = tmp_path_factory.mktemp("value")
    save(folder, value)
    assert same(load(folder), value)


@pytest.mark.parametrize("value", [float("inf"), -float("inf"), np.float32(1.5), np.array(3.0), np.int64(7)])
def test_odd_numbers_come_back(tmp_path, value):
    save(tmp_path, value)
    back = load(tmp_path)
    assert type(back) is type(value) and back == value


@pytest.mark.parametrize("kind", [sp.csr_array, sp.csc_array, sp.csr_matrix, sp.csc_matrix])
def test_sparse_matrices_come_back(tmp_path, kind):
    matrix = kind(sp.random(20, 30, 0.1, random_state=0))
    save(tmp_path, {"K": matrix})
    back = load(tmp_path)["K"]
    assert type(back) is type(matrix) and (back != matrix).nnz == 0


def test_dataclasses_come_back_nested_and_frozen(tmp_path):
    save(tmp_path, (TRIANGLE, Cut([[0.0, 0.0], [1.0, 1.0]], "approach", mouth=False)))
    mesh, cut = load(tmp_path)
    assert isinstance(mesh, Mesh) and isinstance(cut, Cut)
    for one, back in ((TRIANGLE, mesh),):
        assert all(np.array_equal(getattr(one, f.name), getattr(back, f.name)) for f in fields(one))
    assert (cut.name, cut.mouth, cut.length) == ("approach", False, 2**0.5)
    assert not mesh.points.flags.writeable


def test_same_value_same_bytes(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        save(tmp_path / name, {"mesh": TRIANGLE, "K": sp.eye_array(3).tocsr(), "x": 0.1})
    assert all((tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes() for name in (TREE, ARRAYS))


def test_unknown_types_are_refused_when_written(tmp_path):
    with pytest.raises(TypeError, match="set cannot be stored"):
        save(tmp_path, {"x": {1, 2}})


def npy(array) -> bytearray:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array)
    return bytearray(stream.getvalue())


def test_header_that_claims_more_than_the_file_holds_takes_no_memory():
    """Row 52: a header of 745 GiB over 80 bytes of data."""
    data = npy(np.zeros(10))
    lie = data.replace(b"(10,)", b"(99999999999,)", 1)
    lie = lie.replace(b" " * 9 + b"\n", b"\n", 1) if len(lie) > len(data) else lie
    with pytest.raises(ValueError, match="claims"):
        read_array(bytes(lie))


class Exploit:
    """Unpickling this makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (self.path, "w"))


def test_pickle_inside_an_array_is_never_loaded(tmp_path):
    """Row 51: an array of Python objects would run code when it is read."""
    victim = tmp_path / "made-by-pickle"
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.array([Exploit(str(victim))], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="Python objects"):
        read_array(stream.getvalue())
    (tmp_path / TREE).write_text('{"array": "v"}')
    (tmp_path / ARRAYS).write_bytes(pickle.dumps(Exploit(str(victim))))
    with pytest.raises(XfemnavError, match="E701"):
        load(tmp_path)
    assert not victim.exists()


@dataclass(frozen=True)
class Foreign:
    """A dataclass that is none of xfemnav's."""

    x: int = 0


@pytest.mark.parametrize("tree", [
    '{"class": "test_store:Foreign", "fields": {}}', '{"class": "xfemnav.errors:warn", "fields": {}}',
    '{"class": "subprocess:Popen", "fields": {"args": "true"}}', '{"what": 1}', "[", '{"array": "missing"}',
])
def test_files_that_name_other_classes_or_are_no_value_are_refused(tmp_path, tree):
    save(tmp_path, None)
    (tmp_path / TREE).write_text(tree)
    with pytest.raises(XfemnavError, match="E701"):
        load(tmp_path)
