"""Values of the stages as files: one npz for the arrays, one JSON tree for everything around them.

The codec knows numbers, strings, tuples, dicts, numpy arrays, scipy sparse matrices and the frozen dataclasses of
xfemnav, nested as they like. The same value gives the same bytes, nothing is pickled, and an array's header is held
against the bytes that follow it before any memory is taken.
"""

import dataclasses
import importlib
import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import scipy.sparse

from xfemnav.errors import XfemnavError

TREE, ARRAYS = "value.json", "value.npz"
EPOCH = (1980, 1, 1, 0, 0, 0)  # the zip format's zero, in place of the time of writing


def save(folder: Path, value) -> None:
    """Write `value` into `folder` as value.json and value.npz. Raises TypeError for a type that the codec lacks."""
    arrays: dict[str, np.ndarray] = {}
    tree = _encode(value, "v", arrays)
    (folder / TREE).write_text(json.dumps(tree, sort_keys=True, separators=(",", ":")))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, array in arrays.items():
            header = io.BytesIO()
            np.lib.format.write_array(header, array, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", EPOCH), header.getvalue())
    (folder / ARRAYS).write_bytes(packed.getbuffer())


def load(folder: Path):
    """The value that `save` wrote. Raises XfemnavError E701 when the files are not in this format."""
    try:
        tree = json.loads((folder / TREE).read_text(encoding="utf-8"))
        with zipfile.ZipFile(folder / ARRAYS) as archive:
            arrays = {name.removesuffix(".npy"): read_array(archive.read(name)) for name in archive.namelist()}
        return _decode(tree, arrays)
    except (ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise XfemnavError("E701", f"{folder} holds no stored value: {error}. Remove it and run again.") from error


def read_array(data: bytes) -> np.ndarray:
    """The array in the bytes of a .npy file. Raises ValueError on pickles and on headers that lie about the size."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read_header:
        raise ValueError(f"npy version {version} is not known")
    shape, fortran, dtype = read_header[version](stream)
    if dtype.hasobject:
        raise ValueError("the array holds Python objects, which are never loaded")
    claimed, held = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if claimed != held:
        raise ValueError(f"the header claims {claimed} bytes of data and the file holds {held}")
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape, order="F" if fortran else "C").copy()


# One branch a type: what it becomes in JSON, and back ----------------------------------------------------------------

def _encode(value, name: str, arrays: dict):
    if value is None or isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if isinstance(value, np.generic):
        return {"scalar": str(value.dtype), "value": _encode(value.item(), name, arrays)}
    if isinstance(value, float):
        return {"float": repr(value)}
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, np.ndarray):
        arrays[name] = np.ascontiguousarray(value) if value.ndim else value
        return {"array": name}
    if scipy.sparse.issparse(value):
        matrix = value.tocsr()
        parts = {p: _encode(getattr(matrix, p), f"{name}.{p}", arrays) for p in ("data", "indices", "indptr")}
        return {"sparse": value.format, "kind": type(value).__name__, "shape": list(value.shape), "parts": parts}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_encode(item, f"{name}.{i}", arrays) for i, item in enumerate(value)]}
    if isinstance(value, dict):
        # By number: a key may hold characters that no name of a zip member can.
        return {"dict": [[key, _encode(item, f"{name}.{i}", arrays)] for i, (key, item) in enumerate(value.items())]}
    if dataclasses.is_dataclass(value):
        kept = [f.name for f in dataclasses.fields(value) if f.init]
        return {
            "class": f"{type(value).__module__}:{type(value).__qualname__}",
            "fields": {field: _encode(getattr(value, field), f"{name}.{field}", arrays) for field in kept},
        }
    raise TypeError(f"{name}: {type(value).__name__} cannot be stored")


def _decode(tree, arrays: dict):
    if not isinstance(tree, dict):
        return tree
    if "scalar" in tree:
        return np.dtype(tree["scalar"]).type(_decode(tree["value"], arrays))
    if "float" in tree:
        return float(tree["float"])
    if "path" in tree:
        return Path(tree["path"])
    if "array" in tree:
        return arrays[tree["array"]]
    if "sparse" in tree:
        parts = {part: _decode(item, arrays) for part, item in tree["parts"].items()}
        kind = scipy.sparse.csr_array if tree["kind"].endswith("_array") else scipy.sparse.csr_matrix
        return kind((parts["data"], parts["indices"], parts["indptr"]), shape=tree["shape"]).asformat(tree["sparse"])
    if "tuple" in tree:
        return tuple(_decode(item, arrays) for item in tree["tuple"])
    if "list" in tree:
        return [_decode(item, arrays) for item in tree["list"]]
    if "dict" in tree:
        return {key: _decode(item, arrays) for key, item in tree["dict"]}
    return _our_class(tree["class"])(**{field: _decode(item, arrays) for field, item in tree["fields"].items()})


def _our_class(name: str) -> type:
    """The dataclass of xfemnav called "module:Class"; a file can name no other."""
    module, _, qualname = name.partition(":")
    if not module.startswith("xfemnav."):
        raise ValueError(f"{name} is no class of xfemnav")
    found = getattr(importlib.import_module(module), qualname)
    if not dataclasses.is_dataclass(found):
        raise ValueError(f"{name} is no dataclass")
    return found
