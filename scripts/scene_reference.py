"""Writes docs/scene.md anew: every table and key of a scene, from the schema.

python scripts/scene_reference.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from palpate.scene.quantities import LONGEST_M, SHORTEST_M
from palpate.scene.schema import Config

PAGE = Path(__file__).parents[1] / "docs" / "scene.md"

_HEAD = """# Scene files

A scene is a TOML file. `palpate build SCENE` reads it, checks it, and says in one line what is wrong with it: the key, the value and
what was expected. Every key that a scene may have is on this page, with its range and its default. `scripts/scene_reference.py`
writes this page from the schema, `palpate.scene.schema`. Quantities are in SI units, named at the end of the key; points are
`[x, y, z]` in the frame of the surface file. A table with two brackets, `[[contact]]`, may stand several times.

A scene has either `[[contact]]` or `[[tool]]` tables. Contacts are patches that a tip holds; they make a patch model, which
`[reduction]` reduces. Tools are spheres that touch anywhere; they make a surface model, for which `[surface]` says how good it must be.
"""


def main() -> None:
    PAGE.write_text(page())


def page() -> str:
    """The page, as Markdown."""
    schema = Config.model_json_schema()
    scalars = {name: field for name, field in schema["properties"].items() if not _tables(field)}
    text = [_HEAD, "## The scene itself\n", _rows(scalars, schema)]
    for name, field in schema["properties"].items():
        if tables := _tables(field):
            bracket = f"[[{name}]]" if "items" in field else f"[{name}]"
            text += [f"## `{bracket}`\n", *_section(bracket, tables, schema, name in schema["required"])]
    return "\n".join(text)


def _section(bracket: str, names: list[str], schema: dict[str, Any], required: bool) -> list[str]:
    """The tables that may stand under one name: a choice among several is made by `shape` or `region`."""
    lines = ["Required.\n"] if required else []
    if len(names) == 1:
        return lines + _table(bracket, names[0], schema)
    for name in names:
        properties = schema["$defs"][name]["properties"]
        tag = next(key for key in ("shape", "region") if key in properties)
        lines += [f'### `{bracket}` with `{tag} = "{properties[tag]["const"]}"`\n']
        lines += _table(bracket, name, schema)
    return lines


def _table(bracket: str, name: str, schema: dict[str, Any]) -> list[str]:
    definition = schema["$defs"][name]
    inner = {key: _tables(field) for key, field in definition["properties"].items()}
    required = definition.get("required", [])
    fields = {
        key: field | {"required": key in required}
        for key, field in definition["properties"].items()
        if not inner[key]
    }
    lines = [definition["description"] + "\n", _rows(fields, schema)]
    for key, names in inner.items():
        if names:
            under = f"[[{bracket.strip('[]')}.{key}]]"
            about = definition["properties"][key].get("description", "")
            regions = ", ".join(_link(n, schema) for n in names)
            lines += [f"`{under}`: {about}. Tables as those of `[[fixed]]`: {regions}.\n"]
    return lines


def _link(name: str, schema: dict[str, Any]) -> str:
    return f'`region = "{schema["$defs"][name]["properties"]["region"]["const"]}"`'


def _rows(fields: dict[str, Any], schema: dict[str, Any]) -> str:
    lines = ["| key | value | default | what |", "|---|---|---|---|"]
    for key, field in fields.items():
        given = field.get("required", key in schema["required"])
        default = "required" if given else _default(field)
        lines.append(f"| `{key}` | {_value(field)} | {default} | {_about(field)} |")
    return "\n".join(lines) + "\n"


def _default(field: dict[str, Any]) -> str:
    value = field.get("default", field.get("const"))
    if value is None:
        return "unset"
    return f"`{value!r}`".replace("'", '"')


def _about(field: dict[str, Any]) -> str:
    return str(field.get("description", "")).replace("|", "\\|")


def _value(field: dict[str, Any]) -> str:
    """What a key takes, in words."""
    if "anyOf" in field:
        return " or ".join(_value(part) for part in field["anyOf"] if part.get("type") != "null")
    if "const" in field:
        return f'`"{field["const"]}"`'
    if "enum" in field:
        return ", ".join(f'`"{value}"`' for value in field["enum"])
    match field["type"]:
        case "array":
            of = field.get("prefixItems") or [field["items"]]
            many = f"{len(of)} " if "prefixItems" in field else "list of "
            return f"{many}{_plural(_value(of[0]))}"
        case "string":
            return f"text, `{field['pattern']}`" if "pattern" in field else "text"
        case kind:
            return {"number": "number", "integer": "whole number"}[kind] + _range(field)


def _plural(value: str) -> str:
    kind, comma, limits = value.partition(",")
    return f"{kind}s{comma}{limits}"


def _range(field: dict[str, Any]) -> str:
    if (field.get("minimum"), field.get("maximum")) in {(SHORTEST_M, LONGEST_M), (-LONGEST_M, LONGEST_M)}:
        return ""  # of every length
    low = [f"at least {field['minimum']:g}"] if "minimum" in field else []
    low += [f"above {field['exclusiveMinimum']:g}"] if "exclusiveMinimum" in field else []
    high = [f"at most {field['maximum']:g}"] if field.get("maximum", 10**9) != 10**9 else []
    high += [f"below {field['exclusiveMaximum']:g}"] if "exclusiveMaximum" in field else []
    return ", " + ", ".join(low + high) if low + high else ""


def _tables(field: dict[str, Any]) -> list[str]:
    """The definitions of the tables that a key holds, none where it holds a value."""
    of = field.get("items", field)
    references = of.get("oneOf", [of])
    return [part["$ref"].rpartition("/")[2] for part in references if "$ref" in part]


if __name__ == "__main__":
    main()
