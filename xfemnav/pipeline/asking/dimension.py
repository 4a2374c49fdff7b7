"""What a scenario of a volume has that one of a slice has not, and the other way round."""

from xfemnav.pipeline.asking.flags import tables
from xfemnav.pipeline.asking.settings import OF_A_SLICE, SOLID, UNKNOWN_IN_SPACE


def dimension_problems(raw: dict) -> list[str]:
    """One line a problem of a raw scenario: what its dimension does not know, and vectors of another length."""
    dimension = raw.get("dimension", 2)
    if dimension not in (2, 3):
        return []  # the schema says so
    return [*_lengths(raw, dimension), *(_of_a_slice(raw) if dimension == 3 else _of_a_volume(raw))]


def in_its_dimension(scenario):
    """A checked scenario with what a volume has in place of a slice's defaults, where nothing else is said."""
    if scenario.dimension == 2:
        return scenario

    def filled(section):
        own = {key: value for key, value in SOLID._asdict().items()
               if key in type(section).model_fields and key not in section.model_fields_set}
        return section.model_copy(update=own)

    return scenario.model_copy(update={name: filled(getattr(scenario, name)) for name in ("mesh", "boundary", "solve")})


def _at(raw, place):
    """The value at a place of a raw scenario, None where there is none."""
    for name in place.split("."):
        raw = raw.get(name) if isinstance(raw, dict) else None
    return raw


def _of_a_slice(raw):
    found = [f"{place}: a volume (dimension 3) has none: {why}" for place, why in OF_A_SLICE.items()
             if (value := _at(raw, place)) is not None and value is not False and value not in ([], ())]
    for place, (words, why) in UNKNOWN_IN_SPACE.items():
        if _at(raw, place) in ((words,) if isinstance(words, str) else words):
            found.append(f"{place}: '{_at(raw, place)}' is for slices: {why}")
    for i, cut in enumerate(tables(raw, "cut")):
        points = cut.get("points")
        if points is not None and cut.get("towards") is None and cut.get("depth_mm") is None:
            found.append(f"cut.{i}: a curve needs a depth: give ⟦towards=X,Y,Z⟧, its deep end, or ⟦depth_mm=D⟧")
        if cut.get("internal"):
            found.append(f"cut.{i}.internal: in a volume a Plane inside the organ is an internal cut; leave it out")
    if len(tables(raw, "cut")) > 1:
        found.append("cut: in a volume there is one cut so far; run one after the other")
    return found


def _of_a_volume(raw):
    found = [f"cut.{i}.{key}: is for volumes (⟦dim=3⟧)" for i, cut in enumerate(tables(raw, "cut"))
             for key in ("towards", "depth_mm") if cut.get(key) is not None]
    found += [f"retract.{i}.blade_along: is for volumes (⟦dim=3⟧)" for i, blade in enumerate(tables(raw, "retract"))
              if blade.get("blade_along") is not None]
    return found + ["warp.transform_spacing_mm: is for volumes (⟦dim=3⟧)"] * (
        _at(raw, "warp.transform_spacing_mm") is not None)


def _lengths(raw, dimension):
    """Vectors that have another number of components than the dimension."""
    named = {f"retract.{i}.{key}": blade.get(key) for i, blade in enumerate(tables(raw, "retract"))
             for key in ("displacement_mm", "force_mN_per_mm")}
    named["load.gravity"] = _at(raw, "load.gravity")
    if dimension == 3:
        named |= {f"cut.{i}.points": (cut.get("points") or [None])[0] for i, cut in enumerate(tables(raw, "cut"))}
        named |= {f"cut.{i}.towards": cut.get("towards") for i, cut in enumerate(tables(raw, "cut"))}
    where = "volume, x,y,z in the world" if dimension == 3 else "slice, x,y in the plane"
    return [f"{place}: wants {dimension} numbers in a {where}, got {len(value)}" for place, value in named.items()
            if isinstance(value, list | tuple) and len(value) in (2, 3) and len(value) != dimension]
