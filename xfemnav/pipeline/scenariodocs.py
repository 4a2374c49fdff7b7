"""The page of the scenario's keys, `docs/scenario.md`, written from the schema that checks scenarios.

    python -m xfemnav.pipeline.scenariodocs > docs/scenario.md
"""

from xfemnav.pipeline.flags import FLAG_OF
from xfemnav.pipeline.scenario import Scenario

HEAD = """\
# The scenario

Written by `make docs` from `xfemnav/pipeline/scenario.py`, which checks scenarios; edit it there.

A scenario is a TOML file with the settings of one run: `xfemnav run --scenario FILE`. Flags win over it.
`xfemnav check FILE` lists all its problems at once; `xfemnav schema` prints its JSON Schema. Unknown keys are refused.
Paths are relative to the file and stay in its folder. Lengths are mm, stiffnesses kPa, forces mN per mm of thickness.
An example is in [worked-case.md](worked-case.md).

On the command line, `--cut`, `--left`, `--right`, `--lip-force`, `--opening-mm`, `--blade` and `--internal` say what
`[[cut]]` and `[[retract]]` say here. A `--cut` takes the place of all cuts of the scenario and of what held their lips.
"""


def page() -> str:
    """The whole page, Markdown: the keys at the top, then a table a section."""
    schema = Scenario.model_json_schema()
    top = {name: item for name, item in schema["properties"].items() if section_of(item) is None}
    lines = [HEAD, "## At the top\n", table("", top, schema.get("required", ()))]
    for name, item in schema["properties"].items():
        section = section_of(item)
        if section is not None:
            found = schema["$defs"][section]
            brackets = f"[[{name}]]" if item.get("type") == "array" else f"[{name}]"
            lines += [f"## {brackets}\n", found["description"] + "\n",
                      table(name, found["properties"], found.get("required", ()))]
    return "\n".join(lines)


def section_of(item: dict) -> str | None:
    """Name of the schema of a section or of an array's sections; None for a plain key."""
    reference = item.get("$ref") or item.get("items", {}).get("$ref")
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
    kinds = [kind for kind in item.get("anyOf", [item]) if kind.get("type") != "null"]
    (kind,) = kinds
    if "enum" in kind:
        return ", ".join(f"`{value}`" for value in kind["enum"])
    if "const" in kind:
        return f"`{kind['const']}`"
    if kind["type"] == "array":
        inner = kind["items"] if "items" in kind else kind["prefixItems"][0]
        return "points" if inner.get("type") == "array" else "numbers"
    return {"number": "number", "integer": "whole number", "boolean": "true or false", "string": "text"}[kind["type"]]


def shown(value) -> str:
    """A default as TOML would write it; nothing for none."""
    if value is None:
        return ""
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


if __name__ == "__main__":
    print(page(), end="")
