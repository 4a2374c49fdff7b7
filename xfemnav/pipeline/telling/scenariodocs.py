"""The page of the scenario's keys, `docs/reference/scenario.md`, written from the schema that checks scenarios.

    python -m xfemnav.pipeline.telling.scenariodocs > docs/reference/scenario.md
"""

from xfemnav.naming import said
from xfemnav.pipeline.asking.flags import FLAG_OF
from xfemnav.pipeline.asking.scenario import Scenario
from xfemnav.pipeline.telling.errordocs import IN_DOCS

HEAD = """\
# The scenario

Written by `make docs` from `xfemnav/pipeline/asking/scenario.py`, which checks scenarios; edit it there.

A scenario is a TOML file with the settings of one run: `xfemnav run` with ⟦scenario=FILE⟧. Flags win over it.
`xfemnav check FILE` lists all its problems at once; `xfemnav schema` prints its JSON Schema. Unknown keys are refused.
Paths are relative to the file and stay in its folder, so that a scenario from elsewhere reads no file of yours (E781);
`allow_outside` lifts that. Lengths are mm, stiffnesses kPa, forces mN per mm of thickness.
Every run writes its scenario, defaults filled in, as `scenario.toml` among its [outputs](outputs.md).
An example is in [worked-case.md](../use/worked-case.md).

On the command line, ⟦cut⟧, ⟦markup⟧, ⟦left⟧, ⟦right⟧, ⟦lip_force⟧, ⟦opening_mm⟧, ⟦blade⟧, ⟦blade_along⟧,
⟦towards⟧, ⟦depth_mm⟧ and ⟦internal⟧
say what `[[cut]]` and `[[retract]]` say here. A ⟦cut⟧ takes the place of all cuts of the scenario and of what held
their lips; a ⟦resect⟧ takes the place of all resections. ⟦companion=[KIND=]FILE⟧, with its ⟦axes⟧ and
⟦tensor_order⟧, ⟦points⟧, ⟦streamlines⟧ and ⟦surfaces⟧ come after the scenario's own.
"""


def page() -> str:
    """The whole page, Markdown: the keys at the top, then a table a section."""
    schema = Scenario.model_json_schema()
    lines = [said(HEAD, IN_DOCS), "## At the top\n", table("", plain_keys(schema), schema.get("required", ()))]
    return "\n".join([*lines, *sections("", schema, schema["$defs"])])


def plain_keys(section: dict) -> dict:
    """The keys of a section that are no sections themselves."""
    return {name: item for name, item in section["properties"].items() if section_of(item) is None}


def sections(prefix: str, parent: dict, definitions: dict):
    """Heading, words and table of every section in a section, and of those inside them."""
    for name, item in parent["properties"].items():
        section = section_of(item)
        if section is not None:
            found = definitions[section]
            place = prefix + name + (".LABEL" if "patternProperties" in item else "")
            yield f"## {f'[[{place}]]' if item.get('type') == 'array' else f'[{place}]'}\n"
            yield found["description"] + "\n"
            yield table(place, plain_keys(found), found.get("required", ()))
            yield from sections(f"{place}.", found, definitions)


def section_of(item: dict) -> str | None:
    """Name of the schema of a section, or of the sections of an array or by label; None for a plain key."""
    inner = [item, item.get("items"), item.get("additionalProperties"), *item.get("patternProperties", {}).values()]
    reference = next((each["$ref"] for each in inner if isinstance(each, dict) and "$ref" in each), None)
    return reference.rsplit("/", 1)[1] if reference else None


def table(section: str, keys: dict, required) -> str:
    """One row a key: its values, default, meaning and flag."""
    rows = ["| key | value | default | meaning | flag |", "|--|--|--|--|--|"]
    for name, item in keys.items():
        flag = FLAG_OF.get(f"{section}.{name}" if section else name)
        cells = (f"`{name}`", values(item), "required" if name in required else shown(item.get("default")),
                 item.get("description", ""), f"`{flag}`" if flag else "")
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def values(item: dict) -> str:
    """The values that a key takes, in words."""
    kind, *more = (kind for kind in item.get("anyOf", [item]) if kind.get("type") != "null")
    if more:
        return " or ".join(map(values, (kind, *more)))
    if "enum" in kind:
        return ", ".join(f"`{value}`" for value in kind["enum"])
    if "const" in kind:
        return f"`{kind['const']}`"
    if kind["type"] == "array":
        inner = kind["items"] if "items" in kind else kind["prefixItems"][0]
        return {"array": "points", "string": "texts"}.get(inner.get("type"), "numbers")
    return {"number": "number", "integer": "whole number", "boolean": "true or false", "string": "text"}[kind["type"]]


def shown(value) -> str:
    """A default as TOML would write it; nothing for none."""
    if value is None:
        return ""
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


if __name__ == "__main__":
    print(page(), end="")
