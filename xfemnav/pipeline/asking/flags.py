"""Flags and scenario files in one raw scenario: flags win.

What is made here is raw: a dict as TOML gives it, which the schema then checks as a whole.
"""

import difflib
import os
import re
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.rules import BLADE
from xfemnav.naming import NUMBER_OR_PLACE, Names, literal
from xfemnav.naming import flag as option
from xfemnav.pipeline.asking.arguments import path_of, plain, real, shown
from xfemnav.pipeline.asking.settings import FLAGS, KEYS, KINDS, LARGEST, OF_COMPANIONS, TABLE

FLAG_OF = {place: option(name) for name, place in FLAGS.items()}
#: Places of paths; "cut.*.markups" are those of every cut.
PATHS = ("image", "mask", "segment.template", "segment.template_mask", "mesh.file", "boundary.displacement",
         "tissue.labels", "cut.*.markups", "resect.*.markups", "resect.*.mask", "companion.*.image", "points.*",
         "streamlines.*", "surfaces.*")
BACKSLASH = ("In double quotes a backslash begins an escape: write a path of Windows in single quotes, 'C:\\Users', or "
             "with /.")
CONTROL = re.compile(r"[\x00-\x1f\x7f]")
NUMBERS = {2: "two", 3: "three"}
MARKUPS = (".json", ".fcsv", ".csv", ".tsv", ".tag")
MASKS = (".nii", ".nii.gz", ".nrrd", ".mha", ".mgz")


def add_flags(raw: dict, flags: dict, own: tuple[str, ...] = ()) -> tuple[list[str], dict[str, Path]]:
    """Put the `flags` (by name, without dashes) into `raw`, in place.

    The problems found, one line each, and the files that the flags name, by their place in the scenario. `own` are
    the other arguments of who takes the flags, which a wrong name may be meant for.
    """
    given = {name: plain(value) for name, value in flags.items() if value is not None and not _is_empty(value)}
    found = [f"{name}: unknown option{_meant(name, own)}" for name in sorted(set(flags) - set(TABLE))]
    files = {}
    for name, place in FLAGS.items():
        if name in given:
            _put(raw, place, _plain(place, given[name]))
            if place in PATHS:
                files[place] = path_of(given[name], name)
    _add_cuts(raw, given, found, files)
    _add_lips(raw, given, found)
    _add_resections(raw, given, found, files)
    _add_files(raw, given, found, files)
    return found, files


def set_by(flags: dict) -> dict[str, str]:
    """The option that has set a place of the scenario, or all of a section, by the place; of `flags` that are given."""
    given = [name for name, value in flags.items() if value is not None and not _is_empty(value)]
    own = {place: name for name in given if (place := FLAGS.get(name) or KEYS.get(name))}
    return {name: name for name in ("cut", "resect") if name in given} | own


def by_option(text: str, flags: dict[str, str]) -> str:
    """A problem of a place that an option has set, by the option: 'cut.0.points.1.0' is of what sets 'cut.points'."""
    place, separator, what = text.partition(":")
    keys = [re.sub(r"\.\d+", "", place), place.partition(".")[0]]
    name = next((flags[key] for key in keys if key in flags), None)
    return f"⟦!{name}⟧:{what}" if name and separator else text


def _meant(name: str, own: tuple[str, ...]) -> str:
    """The flag, or the other argument, that a wrong name is nearest to; the key of a scenario means its flag."""
    keys = {place.rpartition(".")[2]: flag for flag, place in FLAGS.items()}
    names = keys | {flag: flag for flag in (*TABLE, *own)}
    near = difflib.get_close_matches(name.strip("-").replace("-", "_").lower(), names, 1, 0.6)
    return f", did you mean '{names[near[0]]}'?" if near else ""


def keys(edge: Names) -> Names:
    """How a run of a scenario calls settings: by their keys there, and what has none as the edge does."""
    def key(name: str, value: str = "") -> str:
        alone = name in ("left", "right") and NUMBER_OR_PLACE.fullmatch(value)
        place = KEYS["opening_mm"] if alone else FLAGS.get(name) or KEYS.get(name)
        if place is None:
            return edge.setting(name, value)
        return f"{place} = {_of_toml(name, value)}" if value else place

    return Names(key, edge.given, "See `xfemnav schema` for every key.", edge.given_listed)


def _of_toml(name: str, value: str) -> str:
    """The value of a flag as its key has it."""
    if name == "opening_mm":  # of both lips together
        return f"{float(value) / 2:g} (left and right)"
    if name in ("left", "right"):  # one number counts along the normal
        return f"{literal(value, '[]')} ({name})"
    if name == "lip_force":
        side, _, force = value.partition("=")
        return f"{literal(force, '[]')} ({side})"
    if name == "cut":
        return f"[{', '.join(f'[{point}]' if ',' in point else point for point in value.split())}]"
    return {"True": "true"}.get(value) or literal(value, "[]")


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
    folder, files, outside = Path(os.path.realpath(folder)), {}, []
    anywhere = (raw.get("allow_outside") if allow_outside is None else allow_outside) is True
    for place, value in path_places(raw).items():
        leads_to = None if "\0" in value or os.path.isabs(value) else Path(os.path.realpath(folder / value))
        inside = leads_to is not None and leads_to.is_relative_to(folder)
        if CONTROL.search(value) and (inside or anywhere) and not os.path.lexists(folder / value):
            raise XfemnavError("E780", f"{place} names {value!a}, with a tab or another control character. {BACKSLASH}")
        if not (inside or anywhere):
            outside.append(f"{place}: {value!r}")
        files[place] = folder / value
    if outside:
        raise XfemnavError("E781", f"paths in a scenario stay in its folder {folder}; {'; '.join(outside)}. "
                                   "Move the file, name it on the command line, or allow it: allow_outside = true in "
                                   "the scenario, or ⟦!allow_outside=True⟧.")
    return files


def _add_cuts(raw: dict, given: dict, found: list[str], files: dict[str, Path]) -> None:
    """`cut`, repeated, takes the place of the scenario's cuts and of what held their lips."""
    cuts = _repeated(given.get("cut", []))
    if cuts:
        names = ["cut"] if len(cuts) == 1 else [f"cut {i + 1}" for i in range(len(cuts))]
        raw["cut"] = [{"name": name} for name in names]
        raw.pop("retract", None)
        for i, (item, cut) in enumerate(zip(raw["cut"], cuts)):
            if _names_a_file(cut, MARKUPS):
                item["markups"], files[f"cut.{i}.markups"] = printed(cut), path_of(cut, "cut")
            else:
                item["points"] = _points(cut, "cut", found)
    if "markup" in given:
        raw["cut"] = [item | {"markup": given["markup"]} if "markups" in item else item for item in tables(raw, "cut")]
    for name in ("towards", "depth_mm"):
        if name in given:
            said = _vector(given[name], name, "X,Y,Z", found, 3) if name == "towards" else given[name]
            raw["cut"] = [item | {name: said} for item in tables(raw, "cut")]
    if given.get("internal", False) is not False:
        raw["cut"] = [item | {"internal": given["internal"]} for item in tables(raw, "cut")]


def _add_resections(raw: dict, given: dict, found: list[str], files: dict[str, Path]) -> None:
    """`resect`, repeated, takes the place of the scenario's resections: points, a point file, a mask, or label=N,N."""
    resections = _repeated(given.get("resect", []))
    if resections:
        raw["resect"] = []
    for i, value in enumerate(resections):
        item = {"name": "resection" if len(resections) == 1 else f"resection {i + 1}"}
        is_mask = str(value).lower().endswith(MASKS) and isinstance(value, str | Path)
        for key, named in (("mask", is_mask), ("markups", _names_a_file(value, MARKUPS))):
            if named:
                item[key], files[f"resect.{i}.{key}"] = printed(value), path_of(value, "resect")
                break
        else:
            labels = str(value).removeprefix("label=").replace(" ", "").split(",")
            if isinstance(value, str) and value.startswith("label=") and all(map(str.isdecimal, labels)):
                item["label"] = int(labels[0]) if len(labels) == 1 else list(map(int, labels))
            elif isinstance(value, str) and value.startswith("label="):
                found.append(f"⟦!resect⟧: wants whole numbers label=N or label=N,N,N, got {value[:60]!r}")
                item["label"] = 1  # stands in
            else:
                item["outline"] = _points(value, "resect", found)
        raw["resect"].append(item)


def _add_files(raw: dict, given: dict, found: list[str], files: dict[str, Path]) -> None:
    """`companion` [KIND=]FILE, `points`, `streamlines` and `surfaces` come after the scenario's own."""
    for value in _repeated(given.get("companion", [])):
        kind, separator, name = str(path_of(value, "companion")).partition("=")
        said, name = ({"kind": kind}, name) if separator and kind in KINDS else ({}, value)
        if separator and kind.isidentifier() and not said and not os.path.lexists(value):
            found.append(f"⟦!companion⟧: {shown(kind)} is no kind; wants [KIND=]FILE, its kind one of "
                         f"{', '.join(KINDS)}")
        said |= {key: given[name] for name, key in OF_COMPANIONS.items() if name in given}
        items = raw["companion"] = [*tables(raw, "companion"), {"image": printed(name)} | said]
        files[f"companion.{len(items) - 1}.image"] = path_of(name, "companion")
    found += [f"⟦!{name}⟧: is for companions given by ⟦!companion⟧, and there is none"
              for name in OF_COMPANIONS if name in given and "companion" not in given]
    for key in ("points", "streamlines", "surfaces"):
        for value in _repeated(given.get(key, [])):
            raw[key] = [*raw.get(key, ()), printed(value)]
            files[f"{key}.{len(raw[key]) - 1}"] = path_of(value, key)


def _repeated(value) -> list:
    """The values of a repeatable flag: of a list of words, paths, or lists of points each, else the one value."""
    inner = value if isinstance(value, list) else []
    several = any(isinstance(item, str | Path) or (isinstance(item, list) and any(isinstance(x, list) for x in item))
                  for item in inner)
    return value if several or value == [] else [value]


def _names_a_file(value, endings: tuple[str, ...]) -> bool:
    return isinstance(value, Path) or (isinstance(value, str) and value.lower().endswith(endings))


def _add_lips(raw: dict, given: dict, found: list[str]) -> None:
    """`left`, `right`, `lip_force`, `opening_mm` hold the lips of the first cut; `blade` is for all of them."""
    n = 3 if raw.get("dimension") == 3 else 2
    lips = [{"side": side} | _moved(given[side], side, found, n) for side in ("left", "right") if side in given]
    for text in _repeated(given.get("lip_force", [])):
        side, _, force = text.partition("=") if isinstance(text, str) else ("", "", "")
        pair = numbers(force)
        if side not in ("left", "right") or not _is_point(pair) or len(pair) != n:
            found.append(f"⟦!lip_force⟧: wants {_in_space('left=FX,FY or right=FX,FY', n)}, got {shown(text)}")
        else:
            lips.append({"side": side, "force_mN_per_mm": pair})
    if "opening_mm" in given:
        if (opening := real(given["opening_mm"])) is None:
            found.append(f"⟦!opening_mm⟧: wants a number of mm, at most {LARGEST:g}, got {shown(given['opening_mm'])}")
        elif opening < 0:
            found.append(f"⟦!opening_mm⟧: is how far the lips part, and not negative, got {opening:g}; did you mean "
                         f"⟦!opening_mm={-opening:g}⟧?")
        if lips:
            found.append("⟦!opening_mm⟧: moves both lips, so it excludes ⟦!left⟧, ⟦!right⟧ and ⟦!lip_force⟧")
        lips += [{"side": side, "normal_mm": (opening or 0.0) / 2} for side in ("left", "right")]
    sides = [lip["side"] for lip in lips]
    for side in sorted(set(sides)):
        if sides.count(side) > 1 and "opening_mm" not in given:
            found.append(f"⟦!lip_force⟧: the {side} lip has a displacement or another force already")
    if lips and tables(raw, "cut"):
        first = tables(raw, "cut")[0].get("name", "cut")
        kept = [item for item in tables(raw, "retract")
                if not (item.get("cut", first) == first and item.get("side") in sides)]
        raw["retract"] = kept + [{"cut": first} | lip for lip in lips]
    for name in ("blade", "blade_along"):
        if name in given:
            blade = _span(given[name], name, found)
            if not tables(raw, "retract"):
                found.append(f"⟦!{name}⟧: no lip is moved or pulled (⟦!left⟧, ⟦!right⟧, ⟦!lip_force⟧, ⟦!opening_mm⟧)")
            raw["retract"] = [item | {name: blade} for item in tables(raw, "retract")]


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


def _points(value, name: str, found: list[str]) -> list:
    """Points of "x,y x,y ..." or of rows of numbers."""
    text = isinstance(value, str)
    points = [numbers(word) for word in value.replace(";", " ").split()] if text else value
    if not points or not isinstance(points, list) or not all(map(_is_point, points)):
        form = "points 'x,y x,y ...' without brackets" if text else "rows of two or three numbers, points 'x,y x,y ...'"
        found.append(f"⟦!{name}⟧: wants {form}, or a file, got {shown(value)}"
                     f"{_points_meant(value, name) if text else ''}")
        return [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]  # stands in, so that the other problems are found too
    return points


def _is_point(value) -> bool:
    return isinstance(value, list) and len(value) in (2, 3) and None not in map(real, value)


def _points_meant(text: str, name: str) -> str:
    """Which points a text may stand for that is written otherwise: pairs, if each has a bracket, line or pair's end."""
    found = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)", text)
    if len(found) < 4 or len(found) % 2 or len(found) % 3 == 0 or re.search(r"[^\d\s.,;()\[\]+-]", text):
        return ""
    pairs = " ".join(map(",".join, zip(found[::2], found[1::2])))
    return f"; did you mean ⟦!{name}={pairs}⟧?"


def _moved(value, side: str, found: list[str], n: int) -> dict:
    """A lip's displacement of "3.5,1" or a pair, or how far it moves away from the other lip of one number."""
    alone = numbers(value) if isinstance(value, str) else [value]
    if alone is not None and len(alone) == 1 and real(alone[0]) is not None:
        return {"normal_mm": real(alone[0])}
    return {"displacement_mm": _vector(value, side, "DX,DY, or one, mm away from the other lip", found, n)}


def _span(value, name: str, found: list[str]) -> list[float]:
    """The held part of a cut."""
    known = len(found)
    span = _vector(value, name, "FROM,TO", found)
    if len(found) > known:
        return list(BLADE)
    if not 0 <= span[0] < span[1] <= 1:
        percent = f"; in percent, it is ⟦!{name}={span[0] / 100:g},{span[1] / 100:g}⟧" if 1 < span[1] <= 100 else ""
        ends = "0 the mouth and 1 the tip" if name == "blade" else "0 the first point and 1 the last"
        found.append(f"⟦!{name}⟧: {name} must be FROM,TO with 0 <= FROM < TO < 1, {ends}, got "
                     f"{span[0]:g},{span[1]:g}{percent}")
        return list(BLADE)
    return span


def _vector(value, name: str, form: str, found: list[str], n: int = 2) -> list[float]:
    """n numbers of "3.5,1" or of a pair: in a volume three, of the form DX,DY,DZ."""
    vector = numbers(value) if isinstance(value, str) else value
    if not _is_point(vector) or len(vector) != n:
        found.append(f"⟦!{name}⟧: wants {NUMBERS[n]} finite numbers {_in_space(form, n)}, none over {LARGEST:g}, got "
                     f"{shown(value)}")
        return [0.0] * n
    return vector


def _in_space(form: str, n: int) -> str:
    """How n numbers are written that are two in the plane."""
    return re.sub(r"([DF]?)X,[DF]?Y\b(?!,)", r"\1X,\1Y,\1Z", form) if n == 3 else form


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
