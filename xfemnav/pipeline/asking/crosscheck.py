"""What sections of a scenario say of each other: names that must exist, be unique, or act before others.

It reads the raw scenario, so that these problems are told even when a section has its own.
"""

import difflib
from itertools import chain

from xfemnav.pipeline.asking.dimension import dimension_problems
from xfemnav.pipeline.asking.flags import tables
from xfemnav.pipeline.keeping.names import slug

GRAVITY, OUTLINE = "gravity", "outline"


def cross_problems(raw: dict) -> list[str]:
    """One line a problem."""
    return [*_repeated(raw), *_retractions(raw), *_voxels(raw), *_resections(raw), *_pressures(raw), *_steps(raw),
            *dimension_problems(raw)]


def retraction_name(retract: dict, first_cut: str) -> str:
    """What steps call a retraction of a raw scenario."""
    return str(retract.get("name") or "") or f"{retract.get('cut') or first_cut} {retract.get('side')}"


def actors(raw: dict) -> dict[str, list[str]]:
    """Names of everything that may act, by kind, in the order of the file."""
    cuts = [str(item.get("name", "cut")) for item in tables(raw, "cut")]
    load = raw.get("load") if isinstance(raw.get("load"), dict) else {}
    return {
        "cut": cuts,
        "retract": [retraction_name(item, cuts[0] if cuts else "cut") for item in tables(raw, "retract")],
        "resect": [str(item.get("name", "resection")) for item in tables(raw, "resect")],
        "pressure": [str(item.get("name", "pressure")) for item in tables(load, "pressure")],
        "gravity": [GRAVITY] if load.get("gravity") is not None else [],
    }


def _repeated(raw):
    found, steps = actors(raw), [str(item.get("name")) for item in tables(raw, "step")]
    kinds = {"cut": "cuts", "resect": "resections", "pressure": "pressures"}
    words = [f"{kind}.{i}.name: two {kinds[kind]} are called '{name}'" for kind in kinds
             for i, name in enumerate(found[kind]) if name in found[kind][:i]]
    files = list(map(slug, steps))
    words += [f"step.{i}.name: two steps are called '{name}', or alike but for signs" for i, name in enumerate(steps)
              if files[i] in files[:i]]
    if steps:  # only steps call things of different kinds by one kind of name
        every = [(kind, name) for kind, names in found.items() for name in names]
        words += [f"{kind}: the name '{name}' is taken by another section; steps could not tell them apart"
                  for i, (kind, name) in enumerate(every)
                  if any(name == other and (kind != k or kind == "retract") for k, other in every[:i])]
    return words


def _retractions(raw):
    cuts, found = actors(raw)["cut"], []
    for i, retract in enumerate(tables(raw, "retract")):
        name = retract.get("cut")
        if name is None and len(cuts) != 1:
            found.append(f"retract.{i}.cut: say which cut it holds; there are {len(cuts)}")
        elif name is not None and name not in cuts:
            found.append(f"retract.{i}.cut: no cut is called '{name}'{_near(name, cuts) or _known(cuts)}")
    return found


def _voxels(raw):
    boundary = raw.get("boundary")
    if raw.get("space") != "voxel" or not isinstance(boundary, dict):
        return []
    found = []
    if boundary.get("displacement") is not None:
        found.append("boundary.displacement: its rows are plane mm, which space 'voxel' does "
                     "not read; give them and the cuts in ras or lps")
    if boundary.get("arc"):
        found.append("boundary.arc: its points are plane mm, which space 'voxel' does not read; use ras or lps")
    return found


def _resections(raw):
    tissue = raw.get("tissue") if isinstance(raw.get("tissue"), dict) else {}
    return [f"resect.{i}.label: a label needs the map [tissue] labels" for i, item in enumerate(tables(raw, "resect"))
            if item.get("label") is not None and tissue.get("labels") is None]


def _pressures(raw):
    known = [*actors(raw)["resect"], OUTLINE]
    load = raw.get("load") if isinstance(raw.get("load"), dict) else {}
    return [f"load.pressure.{i}.on: no resection is called '{item.get('on')}'{_near(item.get('on'), known)}"
            for i, item in enumerate(tables(load, "pressure")) if item.get("on") not in known]


def _steps(raw):
    found, acting, named = [], set(), set()
    known = actors(raw)
    every = list(chain.from_iterable(known.values()))
    may_end = {*known["retract"], *known["pressure"], GRAVITY}
    cut_of = {name: str(item.get("cut") or (known["cut"] or ["cut"])[0])
              for name, item in zip(known["retract"], tables(raw, "retract"))}
    load = raw.get("load") if isinstance(raw.get("load"), dict) else {}
    wall_of = {name: str(item.get("on")) for name, item in zip(known["pressure"], tables(load, "pressure"))}
    steps = tables(raw, "step")
    acts = {name for step in steps for name in _names(step, "acts")}
    acting |= set(every) - acts
    for i, step in enumerate(steps):
        for name in _names(step, "acts"):
            if name not in every:
                found.append(f"step.{i}.acts: nothing is called '{name}'{_near(name, every)}")
            elif name in named:
                found.append(f"step.{i}.acts: '{name}' acts already")
            named.add(name)
        acting |= set(_names(step, "acts"))
        for name in _names(step, "ends"):
            if name not in may_end:
                found.append(f"step.{i}.ends: '{name}' is no retraction, pressure or gravity{_near(name, may_end)}")
            elif name not in acting:
                found.append(f"step.{i}.ends: '{name}' does not act by then")
            acting.discard(name)
        found += [f"step.{i}: '{blade}' acts before its cut '{cut}'" for blade, cut in cut_of.items()
                  if blade in acting and cut in every and cut not in acting]
        found += [f"step.{i}: the pressure '{pressure}' acts before the resection '{on}'"
                  for pressure, on in wall_of.items() if pressure in named and on in every and on not in acting]
    return found


def _names(step: dict, key: str) -> list[str]:
    """The names in a list of a step; what else is in it is the schema's to refuse."""
    names = step.get(key, ())
    return [name for name in names if isinstance(name, str)] if isinstance(names, list | tuple) else []


def _known(names: list[str]) -> str:
    return f"; there is {', '.join(map(repr, names[:9]))}" if names else ""


def _near(name, known) -> str:
    near = difflib.get_close_matches(str(name), list(map(str, known)), 1, 0.5)
    return f", did you mean '{near[0]}'?" if near else ""
