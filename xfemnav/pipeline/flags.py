"""Flags and scenario files in one raw scenario: flags win.

What is made here is raw: a dict as TOML gives it, which the schema then checks as a whole.
"""

import math
from pathlib import Path

from xfemnav.errors import XfemnavError

#: Flag -> its place in the scenario. Cuts and lips have flags of their own form (`_add_cuts`, `_add_lips`).
FLAGS: dict[str, str] = {
    "mask": "mask",
    "space": "space",
    "volume": "volume",
    "nan": "nan",
    "spacing": "spacing",
    "resample_mask": "resample_mask",
    "max_memory": "max_memory_gb",
    "strict": "strict",
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
    "boundary_displacement": "boundary.displacement",
    "stress_state": "solve.stress_state",
    "tip_enrichment": "solve.tip_enrichment",
    "lip_constraint": "solve.lip_constraint",
    "hold_tip": "solve.hold_tip",
    "interp": "warp.interp",
    "outside": "warp.outside",
    "fill": "warp.fill",
}
FLAG_OF = {place: "--" + name.replace("_", "-") for name, place in FLAGS.items()}
CUT_FLAGS = ("cut", "internal", "left", "right", "lip_force", "opening_mm", "blade")
PATHS = ("image", "mask", "segment.template", "segment.template_mask", "mesh.file", "boundary.displacement")


def add_flags(raw: dict, flags: dict) -> list[str]:
    """Put the `flags` (by name, without dashes) into `raw`, in place; the problems found, one line each."""
    given = {name: value for name, value in flags.items() if value is not None and not _is_empty(value)}
    found = [f"{name}: unknown option" for name in sorted(set(given) - set(FLAGS) - set(CUT_FLAGS))]
    for name, place in FLAGS.items():
        if name in given:
            _put(raw, place, _plain(place, given[name]))
    _add_cuts(raw, given, found)
    _add_lips(raw, given, found)
    return found


def confined(raw: dict, folder: Path) -> dict[str, Path]:
    """The files that a raw scenario in `folder` names, by place. Raises E781 when one lies outside the folder.

    Symbolic links are followed before they are judged.
    """
    folder, files, outside = folder.resolve(), {}, []
    for place in PATHS:
        value = _get(raw, place)
        if not isinstance(value, str):
            continue
        if "\0" in value or Path(value).is_absolute() or not (folder / value).resolve().is_relative_to(folder):
            outside.append(f"{place}: {value!r}")
        files[place] = folder / value
    if outside:
        raise XfemnavError("E781", f"paths in a scenario stay in its folder {folder}; {'; '.join(outside)}. "
                                   "Move the file, or name it on the command line.")
    return files


def _add_cuts(raw: dict, given: dict, found: list[str]) -> None:
    """--cut, repeated, takes the place of the scenario's cuts and of what held their lips."""
    cuts = given.get("cut", ())
    if isinstance(cuts, str) or (len(cuts) and _is_point(cuts[0])):
        cuts = (cuts,)
    if len(cuts):
        points = [_points(cut, found) for cut in cuts]
        names = ["cut"] if len(points) == 1 else [f"cut {i + 1}" for i in range(len(points))]
        raw["cut"] = [{"name": name, "points": path} for name, path in zip(names, points)]
        raw.pop("retract", None)
    if given.get("internal"):
        raw["cut"] = [item | {"internal": True} for item in tables(raw, "cut")]


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
    if place == "spacing" and isinstance(value, str):
        return numbers(value) or value
    return value


def printed(path) -> str:
    """A path as text: bytes that are no UTF-8 become escapes."""
    return str(path).encode(errors="backslashreplace").decode()


def _is_empty(value) -> bool:
    return isinstance(value, tuple) and not value


def _is_point(value) -> bool:
    return not isinstance(value, str) and len(value) > 0 and not hasattr(value[0], "__len__")


def _points(text, found: list[str]) -> list:
    """Points of "x,y x,y ..." or of rows of numbers."""
    if not isinstance(text, str):
        return [[float(x) for x in point] for point in text]
    points = [numbers(word) for word in text.replace(";", " ").split()]
    if not points or any(point is None or len(point) not in (2, 3) for point in points):
        found.append(f"--cut: wants points 'x,y x,y ...', got {text[:60]!r}")
        return [[0.0, 0.0], [1.0, 0.0]]  # stands in, so that the other problems are found too
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


def _get(raw: dict, place: str):
    for part in place.split("."):
        raw = raw.get(part) if isinstance(raw, dict) else None
    return raw


def _put(raw: dict, place: str, value) -> None:
    *sections, name = place.split(".")
    for section in sections:
        raw = raw.setdefault(section, {})
        if not isinstance(raw, dict):
            return  # the schema says what is wrong with it
    raw[name] = value
