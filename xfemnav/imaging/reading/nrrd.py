"""NRRD (.nrrd, and .nhdr with its data file beside it) header -> what its voxels are and where they lie.

Raw and gzip encodings are read. Field meanings: definition of the NRRD file format, teem.sourceforge.net/nrrd.
"""

import re

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.imaging.reading.formats import (
    Header,
    Vectors,
    check_affine,
    completed,
    data_file,
    impossible,
    lengths,
    not_read,
    numbers,
)

NO_POSITION = "it names no space that is the patient's (left-posterior-superior, ...)"

_INTEGERS = {"i1": ("signed char", "int8", "int8_t"), "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
             "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
             "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
             "i4": ("int", "signed int", "int32", "int32_t"), "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
             "i8": ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64",
                    "int64_t"),
             "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t")}
TYPES = {word: code for code, words in _INTEGERS.items() for word in words} | {"float": "f4", "double": "f8"}
PACKINGS = {"raw": "", "gzip": "gzip", "gz": "gzip"}
TO_RAS = {"right-anterior-superior": (1, 1, 1), "ras": (1, 1, 1), "left-anterior-superior": (-1, 1, 1),
          "las": (-1, 1, 1), "left-posterior-superior": (-1, -1, 1), "lps": (-1, -1, 1)}
MM_PER_UNIT = {"mm": 1.0, "": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3}
COLOURS = {"rgb-color", "rgba-color", "hsv-color", "xyz-color"}
LAYOUTS = {"3d-symmetric-matrix": "upper", "3d-masked-symmetric-matrix": "masked", "3d-matrix": "matrix"}
SERIES = {"list", "time", "none", "???", "stub", "domain", "space", "scalar"}  # kinds that make no axis a vector


def recognises(head: bytes) -> bool:
    """Whether `head`, the first bytes of a file, starts a NRRD."""
    return re.match(rb"NRRD000\d\r?\n", head) is not None


def _fields(head: bytes, name: str) -> tuple[dict[str, str], int]:
    """The header's fields in small letters, and its length in bytes; a detached header may end with its file."""
    end = re.search(rb"\n\r?\n", head)
    text, length = (head[: end.start()], end.end()) if end else (head, len(head))
    fields = {}
    for line in text.decode("utf-8", "replace").splitlines()[1:]:
        field, colon, value = line.partition(":")
        if line.startswith("#") or value.startswith("=") or not line.strip():
            continue  # a comment, or a key of somebody's own
        field = field.strip().lower().replace("datafile", "data file").replace("byteskip", "byte skip")
        if not colon or field in fields:
            raise impossible(name, f"line {line[:60]!r}")
        fields[field] = value.strip()
    if not end and "data file" not in fields:
        raise XfemnavError("E101", f"{name} is damaged: it ends within its header, or that is longer than {len(head)} "
                                   "bytes. Copy it again.")
    return fields, length


def read_header(head: bytes, name: str) -> Header:
    """Checked header of the file `name` whose first bytes are `head`.

    Raises E101 (cut off), E105 (impossible field), E106 (an encoding that is not read), E122 (colour, complex).
    """
    fields, length = _fields(head, name)
    sizes = _sizes(fields, name)
    beside = data_file(fields["data file"], name) if "data file" in fields else ""
    packing = fields.get("encoding", "").lower()
    if packing not in PACKINGS:
        raise not_read(name, f"has the encoding {packing[:20]!r}")
    skip = numbers(fields.get("byte skip", "0"), name, "byte skip", int)
    if fields.get("line skip", "0") != "0" or (skip[:1] != [0] and PACKINGS[packing]) or len(skip) != 1 or skip[0] < 0:
        raise not_read(name, "skips lines or bytes before its voxels")
    space, other = _axes(fields, sizes, name)
    shape = [sizes[axis] for axis in space] + [1] * (3 - len(space)) + [sizes[axis] for axis in other]
    offset = (0 if beside else length) + min(skip[0], 2**40)
    return Header(tuple(shape), _dtype(fields, name), offset, packing=PACKINGS[packing], data_file=beside,
                  last_axis=_last_axis(other, space), vector=_is_vector(fields, other, name),
                  vectors=_vectors_of(fields, other, name))


@np.errstate(all="ignore")  # what overflows is refused by its result
def read_frame(head: bytes, name: str) -> tuple[np.ndarray, int]:
    """Affine (4, 4) voxel -> RAS mm, and its code: 1, or 0 where the file names no space of the patient's.

    Raises E110 when unusable.
    """
    fields, _ = _fields(head, name)
    sizes = _sizes(fields, name)
    space, _ = _axes(fields, sizes, name)
    affine, directions = np.eye(4), _directions(fields, sizes, name)
    if directions is None:
        spacings = numbers(fields.get("spacings", "1 " * len(sizes)), name, "spacings")
        columns = np.diag([*[spacings[axis] for axis in space], *[1.0] * (3 - len(space))])
    else:
        columns = completed(np.array([directions[axis] for axis in space], float).T * _units(fields, name)[:, None])
        origin = _vectors(fields.get("space origin", "(0,0,0)"), name, "space origin")
        if len(origin) != 1 or origin[0] is None:
            raise impossible(name, "space origin")
        affine[:3, 3] = origin[0] * _units(fields, name)
    affine[:3, :3] = columns
    signs = _signs(fields)
    affine[:3] *= np.array(signs or (1, 1, 1))[:, None]
    check_affine(affine, name)
    return affine, int(signs is not None and directions is not None)


def _signs(fields) -> tuple[int, int, int] | None:
    """Signs that take the axes of the file's space to RAS; None where it names none of the patient's."""
    return TO_RAS.get(fields.get("space", "").lower())


def _sizes(fields, name: str) -> tuple[int, ...]:
    sizes = lengths(fields.get("sizes", ""), name, "sizes")
    if numbers(fields.get("dimension", ""), name, "dimension", int) != [len(sizes)]:
        raise impossible(name, f"dimension {fields.get('dimension', '')[:20]!r} of {len(sizes)} sizes")
    return sizes


def _dtype(fields, name: str) -> np.dtype:
    words = " ".join(fields.get("type", "").lower().split())
    if words not in TYPES:
        raise impossible(name, f"type {words[:40]!r}")
    dtype, order = np.dtype(TYPES[words]), fields.get("endian", "").lower()
    if dtype.itemsize > 1 and order not in ("little", "big"):
        raise impossible(name, f"endian {order[:20]!r}")
    return dtype.newbyteorder(">" if order == "big" else "<")


def _vectors(text: str, name: str, field: str) -> list:
    """The vectors (3,) of a line such as "(1,0,0) none (0,0,1)"; None for none, two numbers get a third of 0."""
    words = re.findall(r"none|\([^()]*\)", text)
    vectors = [None if word == "none" else numbers(word[1:-1].replace(",", " "), name, field) for word in words]
    if re.sub(r"none|\([^()]*\)|\s", "", text) or any(v is not None and len(v) not in (2, 3) for v in vectors):
        raise impossible(name, f"{field} {text[:60]!r}")
    return [None if vector is None else np.array([*vector, 0.0][:3]) for vector in vectors]


def _directions(fields, sizes, name: str):
    """One vector (3,) or None an axis of the file; None when the file has no directions."""
    if "space directions" not in fields:
        return None
    directions = _vectors(fields["space directions"], name, "space directions")
    if len(directions) != len(sizes):
        raise impossible(name, f"space directions {fields['space directions'][:60]!r} of {len(sizes)} axes")
    return directions


def _units(fields, name: str) -> np.ndarray:
    """mm per unit of the three axes of space."""
    units = [word.strip().lower() for word in re.findall(r'"([^"]*)"', fields.get("space units", ""))][:3]
    if set(units) - set(MM_PER_UNIT):
        raise XfemnavError("E110", f"{name} has the space units {units}; xfemnav knows mm, cm, m and um. Convert it, "
                                   "or give the pixel sizes: ⟦spacing=0.9,0.9⟧.")
    return np.array([MM_PER_UNIT[unit] for unit in units] + [1.0] * (3 - len(units)))


def _kinds(fields, sizes, name: str) -> list[str]:
    kinds = fields.get("kinds", "").lower().split() or ["???"] * len(sizes)
    if len(kinds) != len(sizes):
        raise impossible(name, f"kinds {fields['kinds'][:60]!r} of {len(sizes)} axes")
    return kinds


def _axes(fields, sizes, name: str) -> tuple[list[int], list[int]]:
    """Which axes of the file are space (1 to 3), and which (none or one) is not.

    Axes of space have a direction; where none has, a spacing, or a kind that says so, or they are the first three.
    """
    directions, kinds = _directions(fields, sizes, name), _kinds(fields, sizes, name)
    spacings = numbers(fields.get("spacings", "1 " * len(sizes)), name, "spacings")
    if len(spacings) != len(sizes):
        raise impossible(name, f"spacings {fields['spacings'][:60]!r} of {len(sizes)} axes")
    if directions is not None:
        space = [axis for axis, direction in enumerate(directions) if direction is not None]
    else:
        domain = [kind in ("domain", "space") or (kind in ("???", "none") and spacings[axis] == spacings[axis])
                  for axis, kind in enumerate(kinds)]
        space = [axis for axis, inside in enumerate(domain) if inside][:3]
    other = [axis for axis in range(len(sizes)) if axis not in space]
    if not 1 <= len(space) <= 3 or len(other) > 1:
        raise impossible(name, f"{len(space)} axes of space and {len(other)} others")
    return space, other


def _last_axis(other: list[int], space: list[int]) -> int:
    """Where the axis that is not space stands among the three of space, of which the missing ones come last."""
    return other[0] if other and other[0] < len(space) else -1


def _kind(fields, other: list[int]) -> str:
    """Kind of the axis that is not space; "" where there is none."""
    if not other:
        return ""
    return fields.get("kinds", "").lower().split()[other[0]] if "kinds" in fields else "???"


def _vectors_of(fields, other: list[int], name: str) -> Vectors:
    """Components are in the measurement frame, whose axes are given in the file's space, or in that space itself."""
    signs = _signs(fields)
    world = np.diag(np.array(signs or (1, 1, 1), float))
    if signs is None or not other:
        return Vectors(None, world, LAYOUTS.get(_kind(fields, other), ""))
    frame = _vectors(fields.get("measurement frame", "(1,0,0) (0,1,0) (0,0,1)"), name, "measurement frame")
    whole = len(frame) == 3 and all(axis is not None and np.isfinite(axis).all() for axis in frame)
    if not whole or np.linalg.det(frame) == 0:
        raise impossible(name, f"measurement frame {fields['measurement frame'][:60]!r}")
    return Vectors(world @ np.array(frame).T, world, LAYOUTS.get(_kind(fields, other), ""))


def _is_vector(fields, other: list[int], name: str) -> bool:
    kind = _kind(fields, other)
    if not other:
        return False
    if kind in COLOURS or kind == "complex":
        raise XfemnavError("E122", f"{name} is a {kind} image; give one scalar intensity a voxel.")
    return kind not in SERIES
