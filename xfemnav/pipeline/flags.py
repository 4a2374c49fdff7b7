"""Flags and scenario files in one raw scenario: flags win.

What is made here is raw: a dict as TOML gives it, which the schema then checks as a whole.
"""

import math
import os
import re
from pathlib import Path

from xfemnav.errors import XfemnavError

#: Flag -> its place in the scenario. Cuts and lips have flags of their own form (`_add_cuts`, `_add_lips`).
FLAGS: dict[str, str] = {
    "mask": "mask",
    "space": "space",
    "volume": "volume",
    "nan": "nan",
    "spacing": "spacing",
    "nifti_frame": "nifti_frame",
    "resample_mask": "resample_mask",
    "min_resection_mm": "min_resection_mm",
    "max_memory": "max_memory_gb",
    "strict": "strict",
    "allow_outside": "allow_outside",
    "slice": "slice.index",
    "slice_mm": "slice.position_mm",
    "plane": "slice.plane",
    "segment_method": "segment.method",
    "skull_on": "segment.skull",
    "template": "segment.template",
    "template_mask": "segment.template_mask",
    "mesh": "mesh.file",
    "element_size_mm": "mesh.element_size_mm",
    "corridor_mm": "mesh.corridor_mm",
    "corridor_element_mm": "mesh.corridor_element_mm",
    "grade_at_data_ends": "mesh.grade_at_data_ends",
    "young_kpa": "tissue.young_kpa",
    "poisson": "tissue.poisson",
    "skull": "boundary.skull",
    "craniotomy_mm": "boundary.craniotomy_mm",
    "skull_ramp_mm": "boundary.skull_ramp_mm",
    "skull_gap_mm": "boundary.skull_gap_mm",
    "lips": "boundary.lips",
    "loose_pieces": "boundary.loose_pieces",
    "boundary_displacement": "boundary.displacement",
    "gravity": "load.gravity",
    "labels": "tissue.labels",
    "model": "solve.model",
    "stress_state": "solve.stress_state",
    "tip_enrichment": "solve.tip_enrichment",
    "lip_constraint": "solve.lip_constraint",
    "hold_tip": "solve.hold_tip",
    "interp": "warp.interp",
    "outside": "warp.outside",
    "fill": "warp.fill",
    "transforms": "warp.transforms",
}
FLAG_OF = {place: "--" + name.replace("_", "-") for name, place in FLAGS.items()}
CUT_FLAGS = ("cut", "markup", "internal", "left", "right", "lip_force", "opening_mm", "blade", "resect")
FILE_FLAGS = ("companion", "points", "streamlines", "surfaces")
#: Places of paths; "cut.*.markups" are those of every cut.
PATHS = ("image", "mask", "segment.template", "segment.template_mask", "mesh.file", "boundary.displacement",
         "tissue.labels", "cut.*.markups", "resect.*.markups", "resect.*.mask", "companion.*.image", "points.*",
         "streamlines.*", "surfaces.*")
BACKSLASH = ("In double quotes a backslash begins an escape: write a path of Windows in single quotes, 'C:\\Users', or "
             "with /.")
CONTROL = re.compile(r"[\x00-\x1f\x7f]")
MARKUPS = (".json", ".fcsv", ".csv", ".tsv", ".tag")
KINDS = ("continuous", "label", "vector", "axis", "tensor")
OF_COMPANIONS = {"axes": "axes", "tensor_order": "order"}  # flag: key of every companion that is given by a flag
MASKS = (".nii", ".nii.gz", ".nrrd", ".mha", ".mgz")


def add_flags(raw: dict, flags: dict) -> tuple[list[str], dict[str, Path]]:
    """Put the `flags` (by name, without dashes) into `raw`, in place.

    The problems found, one line each, and the files that the flags name, by their place in the scenario.
    """
    given = {name: value for name, value in flags.items() if value is not None and not _is_empty(value)}
    known = {*FLAGS, *CUT_FLAGS, *FILE_FLAGS, *OF_COMPANIONS}
    found = [f"{name}: unknown option" for name in sorted(set(given) - known)]
    files = {}
    for name, place in FLAGS.items():
        if name in given:
            _put(raw, place, _plain(place, given[name]))
            if place in PATHS:
                files[place] = Path(given[name])
    _add_cuts(raw, given, found, files)
    _add_lips(raw, given, found)
    _add_resections(raw, given, found, files)
    _add_files(raw, given, found, files)
    return found, files


def path_places(raw: dict) -> dict[str, str]:
    """Every path that a raw scenario names, by its place; 'cut.0.markups' is that of the first cut."""
    places = {}
    for pattern in PATHS:
        _walk(raw, pattern.split("."), (), places)
    return places


def _walk(value, pattern, place, places) -> None:
    if not pattern:
        if isinstance(value, str):
            places[".".join(place)] = value
    elif pattern[0] == "*":
        for i, item in enumerate(value if isinstance(value, list | tuple) else ()):
            _walk(item, pattern[1:], (*place, str(i)), places)
    elif isinstance(value, dict):
        _walk(value.get(pattern[0]), pattern[1:], (*place, pattern[0]), places)


def confined(raw: dict, folder: Path, allow_outside: bool | None = None) -> dict[str, Path]:
    """The files that a raw scenario in `folder` names, by place. Raises E781 when one lies outside the folder, and
    E780 for one with control characters, as a path of Windows in double quotes has them.

    Symbolic links are followed before they are judged. `allow_outside`, or else the scenario's own key, lets files lie
    where they will.
    """
    folder, files, outside = folder.resolve(), {}, []
    anywhere = (raw.get("allow_outside") if allow_outside is None else allow_outside) is True
    for place, value in path_places(raw).items():
        if CONTROL.search(value) and not os.path.lexists(folder / value):
            raise XfemnavError("E780", f"{place} names {value!a}, with a tab or another control character. {BACKSLASH}")
        inside = not Path(value).is_absolute() and (folder / value).resolve().is_relative_to(folder)
        if not (inside or anywhere):
            outside.append(f"{place}: {value!r}")
        files[place] = folder / value
    if outside:
        raise XfemnavError("E781", f"paths in a scenario stay in its folder {folder}; {'; '.join(outside)}. "
                                   "Move the file, name it on the command line, or allow it: allow_outside = true in "
                                   "the scenario, or --allow-outside.")
    return files


def _add_cuts(raw: dict, given: dict, found: list[str], files: dict[str, Path]) -> None:
    """--cut, repeated, takes the place of the scenario's cuts and of what held their lips."""
    cuts = _repeated(given.get("cut", ()))
    if len(cuts):
        names = ["cut"] if len(cuts) == 1 else [f"cut {i + 1}" for i in range(len(cuts))]
        raw["cut"] = [{"name": name} for name in names]
        raw.pop("retract", None)
        for i, (item, cut) in enumerate(zip(raw["cut"], cuts)):
            if _names_a_file(cut, MARKUPS):
                item["markups"], files[f"cut.{i}.markups"] = printed(cut), Path(cut)
            else:
                item["points"] = _points(cut, "--cut", found)
    if "markup" in given:
        raw["cut"] = [item | {"markup": given["markup"]} if "markups" in item else item for item in tables(raw, "cut")]
    if given.get("internal"):
        raw["cut"] = [item | {"internal": True} for item in tables(raw, "cut")]


def _add_resections(raw: dict, given: dict, found: list[str], files: dict[str, Path]) -> None:
    """--resect, repeated, takes the place of the scenario's resections: points, a point file, a mask, or label=N,N."""
    resections = _repeated(given.get("resect", ()))
    if len(resections):
        raw["resect"] = []
    for i, value in enumerate(resections):
        item = {"name": "resection" if len(resections) == 1 else f"resection {i + 1}"}
        is_mask = str(value).lower().endswith(MASKS) and isinstance(value, str | Path)
        for key, named in (("mask", is_mask), ("markups", _names_a_file(value, MARKUPS))):
            if named:
                item[key], files[f"resect.{i}.{key}"] = printed(value), Path(value)
                break
        else:
            labels = str(value).removeprefix("label=").replace(" ", "").split(",")
            if isinstance(value, str) and value.startswith("label=") and all(map(str.isdecimal, labels)):
                item["label"] = int(labels[0]) if len(labels) == 1 else list(map(int, labels))
            elif isinstance(value, str) and value.startswith("label="):
                found.append(f"--resect: wants whole numbers label=N or label=N,N,N, got {value[:60]!r}")
                item["label"] = 1  # stands in
            else:
                item["outline"] = _points(value, "--resect", found)
        raw["resect"].append(item)


def _add_files(raw: dict, given: dict, found: list[str], files: dict[str, Path]) -> None:
    """--companion [KIND=]FILE, --points, --streamlines and --surfaces FILE come after the scenario's own."""
    for value in _repeated(given.get("companion", ())):
        kind, separator, name = str(value).partition("=")
        said, name = ({"kind": kind}, name) if separator and kind in KINDS else ({}, value)
        said |= {key: given[flag] for flag, key in OF_COMPANIONS.items() if flag in given}
        items = raw["companion"] = [*tables(raw, "companion"), {"image": printed(name)} | said]
        files[f"companion.{len(items) - 1}.image"] = Path(name)
    found += [f"--{flag.replace('_', '-')}: is for companions given by --companion, and there is none"
              for flag in OF_COMPANIONS if flag in given and "companion" not in given]
    for key in ("points", "streamlines", "surfaces"):
        for value in _repeated(given.get(key, ())):
            raw[key] = [*raw.get(key, ()), printed(value)]
            files[f"{key}.{len(raw[key]) - 1}"] = Path(value)


def _repeated(value) -> tuple:
    """The values of a repeatable flag; one value alone, or one list of points, is a tuple of one."""
    if isinstance(value, str | Path) or (len(value) and not isinstance(value[0], Path) and _is_point(value[0])):
        return (value,)
    return tuple(value)


def _names_a_file(value, endings: tuple[str, ...]) -> bool:
    return isinstance(value, Path) or (isinstance(value, str) and value.lower().endswith(endings))


def _add_lips(raw: dict, given: dict, found: list[str]) -> None:
    """--left, --right, --lip-force, --opening-mm hold the lips of the first cut; --blade is for all of them."""
    lips = [{"side": side, "displacement_mm": _vector(given[side], f"--{side}", "DX,DY", found)}
            for side in ("left", "right") if side in given]
    forces = given.get("lip_force", ())
    for text in (forces,) if isinstance(forces, str) else forces:
        side, _, force = text.partition("=")
        lips.append({"side": side, "force_mN_per_mm": _vector(force, "--lip-force", "left=FX,FY", found)})
    if "opening_mm" in given:
        if lips:
            found.append("--opening-mm: moves both lips, so it excludes --left, --right and --lip-force")
        lips += [{"side": side, "normal_mm": given["opening_mm"] / 2} for side in ("left", "right")]
    sides = [lip["side"] for lip in lips]
    for side in sorted(set(sides)):
        if sides.count(side) > 1 and "opening_mm" not in given:
            found.append(f"--lip-force: the {side} lip has a displacement or another force already")
    if lips and tables(raw, "cut"):
        first = tables(raw, "cut")[0].get("name", "cut")
        kept = [item for item in tables(raw, "retract")
                if not (item.get("cut", first) == first and item.get("side") in sides)]
        raw["retract"] = kept + [{"cut": first} | lip for lip in lips]
    if "blade" in given:
        blade = _vector(given["blade"], "--blade", "FROM,TO", found)
        if not tables(raw, "retract"):
            found.append("--blade: no lip is moved or pulled (--left, --right, --lip-force, --opening-mm)")
        raw["retract"] = [item | {"blade": blade} for item in tables(raw, "retract")]


def tables(raw: dict, name: str) -> list[dict]:
    """The tables of the array `name` of a raw scenario; what is no table is left to the schema."""
    items = raw.get(name, ())
    return [item for item in items if isinstance(item, dict)] if isinstance(items, list | tuple) else []


def _plain(place: str, value):
    """A flag's value as TOML would give it."""
    if place in PATHS:
        return printed(value)
    if place in ("spacing", "load.gravity") and isinstance(value, str):
        return numbers(value) or value
    return value


def printed(path) -> str:
    """A path as text: bytes that are no UTF-8 become escapes."""
    return str(path).encode(errors="backslashreplace").decode()


def _is_empty(value) -> bool:
    return isinstance(value, tuple) and not value


def _is_point(value) -> bool:
    return not isinstance(value, str) and len(value) > 0 and not hasattr(value[0], "__len__")


def _points(text, flag: str, found: list[str]) -> list:
    """Points of "x,y x,y ..." or of rows of numbers."""
    if not isinstance(text, str):
        return [[float(x) for x in point] for point in text]
    points = [numbers(word) for word in text.replace(";", " ").split()]
    if not points or any(point is None or len(point) not in (2, 3) for point in points):
        found.append(f"{flag}: wants points 'x,y x,y ...' or a file, got {text[:60]!r}")
        return [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]  # stands in, so that the other problems are found too
    return points


def _vector(value, flag: str, form: str, found: list[str]) -> list[float]:
    """Two finite numbers of "3.5,1" or of a pair."""
    pair = numbers(value) if isinstance(value, str) else [float(x) for x in value]
    if pair is None or len(pair) != 2 or not all(map(math.isfinite, pair)):
        found.append(f"{flag}: wants two finite numbers {form}, got {str(value)[:60]!r}")
        return [0.0, 0.0]
    return pair


def numbers(text: str) -> list[float] | None:
    """The numbers of "a,b,c", or None when it is something else."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return None


def _put(raw: dict, place: str, value) -> None:
    *sections, name = place.split(".")
    for section in sections:
        raw = raw.setdefault(section, {})
        if not isinstance(raw, dict):
            return  # the schema says what is wrong with it
    raw[name] = value
