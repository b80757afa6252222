"""Tables of the reference pages, made from code: records, keys, configuration, commands, modem rates and packages."""

import argparse
import inspect
import json
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from typing import Any

import griffe
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

import sonarpost
from sonarpost import keys, limits, messages
from sonarpost.cli.deployment import config_files
from sonarpost.cli.main import parser
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.config import ModemTable, PlatformConfig, ServiceConfig, table_names
from sonarpost.messages import Record
from sonarpost.monitoring.fleet import FleetState
from sonarpost.registry import EXTENSIONS

UNITS = {
    "airtime_s": "s",
    "m_per_s": "m/s",
    "mps": "m/s",
    "bytes_per_s": "B/s",
    "db_per_decade": "dB a decade",
    "deg": "°",
    "db": "dB",
    "px": "px",
    "hz": "Hz",
    "psu": "psu",
    "bytes": "B",
    "days": "d",
    "m": "m",
    "c": "°C",
    "s": "s",
}
# Quantities whose names do not end in their unit.
NAMED_OTHERWISE = {
    "bits": "bit",
    "baud": "bit/s",
    "serial_baud": "bit/s",
    "bytes_received": "B",
    "bytes_total": "B",
    "bytes_left": "B",
}
_FLOW = re.compile(r"Record: (?P<record>\w+)\. From: (?P<source>.*?)\. To: (?P<to>.*?)\. Delivery: (?P<delivery>.*?)\.")
# A bar outside code; Python-Markdown shows a backslash inside code.
_CELL_BAR = re.compile(r"\|(?=(?:[^`]*`[^`]*`)*[^`]*$)")
_PARAMETERS = ("platform", "vehicle", "vessel", "site", "kind", "service")


@dataclass(frozen=True, slots=True)
class KeyRow:
    """One key expression: its function in `sonarpost.keys`, its placeholders in braces, and what its docstring says."""

    name: str
    key: str
    summary: str
    record: str
    source: str
    to: str
    delivery: str


def generate(name: str, argument: str) -> str:
    """Return the Markdown for one mark in a page.

    Raises:
        KeyError: There is no generator of this name.
    """
    return GENERATORS[name](argument)


def records(_: str = "") -> str:
    """Return a section for every record: its description and a table of its fields."""
    sections = []
    for record in record_types():
        summary, fields = described(record)
        schemas = record.model_json_schema()["properties"]
        rows = [
            (
                f"`{field}`",
                _type(schema := _without_null(schemas[field])),
                unit(field),
                _range(schema),
                "yes" if "anyOf" in schemas[field] else "no",
                _absent(record, field),
                fields.get(field, ""),
            )
            for field in record.model_fields
        ]
        header = ("field", "type", "unit", "range", "nil", "if absent", "meaning")
        sections.append(f"## {record.TYPE}\n\n{summary}\n\n{table(header, rows)}")
    return "\n\n".join(sections)


def record_types() -> list[type[Record]]:
    """Return every record of `sonarpost.messages`, in the order of the modules, and of each module."""
    modules = (messages.contact, messages.image, messages.acoustic, messages.vehicle, messages.review, messages.service)
    return [
        t
        for module in modules
        for t in vars(module).values()
        if inspect.isclass(t) and issubclass(t, Record) and t.TYPE and t.__module__ == module.__name__
    ]


def key_table(service: str = "") -> str:
    """Return the table of keys, of all or of those that one service sends or receives."""
    rows = [row for row in key_rows() if row.record]
    if not service:
        header = ("key and meaning", "record", "from, to", "delivery")
        return table(
            header,
            [(f"`{r.key}`<br>{r.summary}", _record(r), f"from {r.source}<br>to {r.to}", r.delivery) for r in rows],
        )
    cells = []
    for row in rows:
        for direction, names in (("in", row.to), ("out", row.source)):
            if {service, "every service"} & set(names.split(", ")):
                other = f"to {row.to}" if direction == "out" else f"from {row.source}"
                cells.append((direction, f"`{row.key}`", _record(row), f"{row.delivery}, {other}"))
    return table(("direction", "key", "record", "delivery"), sorted(cells, key=lambda cell: cell[0]))


def wildcard_table(_: str = "") -> str:
    """Return the table of key expressions with wildcards and of those for access control."""
    return table(("key expression", "meaning"), [(f"`{r.key}`", r.summary) for r in key_rows() if not r.record])


def key_rows() -> list[KeyRow]:
    """Return every key expression of `sonarpost.keys`, in the order of the module."""
    rows = []
    for name, function in vars(keys).items():
        if name.startswith("_") or not inspect.isfunction(function):
            continue
        if "Raises:" in (function.__doc__ or ""):
            continue  # parses a key
        parameters = list(inspect.signature(function).parameters)
        if "key" in parameters:
            key = function("{key}", *["consumer"] * (len(parameters) - 1)).replace("/consumer", "/{consumer}")
        else:
            key = function(**{parameter: f"x{parameter}" for parameter in parameters})
            for parameter in _PARAMETERS:
                key = re.sub(rf"\bx{parameter}\b", f"{{{parameter}}}", key)
        summary, _, flows = " ".join(inspect.getdoc(function).split()).partition(" Record: ")
        found = [flow.groupdict() for flow in _FLOW.finditer(f"Record: {flows}")]
        none = dict.fromkeys(("record", "source", "to", "delivery"), "")
        rows.extend(KeyRow(name, key, summary, **flow) for flow in found or [none])
    return rows


def configuration(service: str = "") -> str:
    """Return the tables of the configuration of one service, of `platform`, or of all of them with headings."""
    if service:
        return _configuration_tables(configuration_type(service), service)
    names = table_names()
    return "\n\n".join(f"## [{name}]\n\n{_configuration_tables(configuration_type(name), name)}" for name in names)


def configuration_type(service: str) -> type[ServiceConfig]:
    """Return the model of a configuration table."""
    own: Mapping[str, type[ServiceConfig]] = {"platform": PlatformConfig, "modem": ModemTable}
    return own.get(service) or config_files.configuration_type(service)


def commands(_: str = "") -> str:
    """Return a section for every command of `sonarpost`."""
    return "\n\n".join(_command_section(command) for command in parser().tree().values())


def rate_table(_: str = "") -> str:
    """Return the table of Micro-Modem rates."""
    import rates  # noqa: PLC0415 it needs the extension simulation

    return table(rates.RATE_HEADER, rates.rate_rows())


def image_table(_: str = "") -> str:
    """Return the table of images a minute at each rate."""
    import rates  # noqa: PLC0415 it needs the extension simulation

    return table(rates.IMAGE_HEADER, rates.image_rows())


def metrics(_: str = "") -> str:
    """Return the table of the metrics that do not depend on a service's counters and gauges."""
    from sonarpost.extensions.metrics.command import FleetCollector  # noqa: PLC0415 it can be removed

    rows = []
    for family in FleetCollector(lambda: FleetState(services=(), connected=True, rejected=0)).collect():
        name = family.name + ("_total" if family.type == "counter" else "")
        labels = ", ".join(getattr(family, "_labelnames", ()))
        rows.append((f"`{name}`", family.type, labels, family.documentation))
    return table(("metric", "type", "labels", "meaning"), rows)


def limit_table(_: str = "") -> str:
    """Return the table of all declared limits."""
    for module in pkgutil.walk_packages(sonarpost.__path__, "sonarpost."):
        if not module.name.endswith("__main__"):
            import_module(module.name)
    found = sorted(limits.DECLARED.values(), key=lambda one: (one.surface, one.source, one.resource, one.module))
    return table(
        ("surface", "source", "resource", "limit", "at the limit", "rule", "module"),
        [
            (
                *(
                    one.surface,
                    one.source,
                    one.resource,
                    f"{_number(one.value)} {one.unit}".strip(),
                    one.at_limit,
                    one.rule,
                ),
                f"`{one.module.removeprefix('sonarpost.')}`",
            )
            for one in found
        ],
    )


def extension_table(_: str = "") -> str:
    """Return the table of the extensions: the first paragraph of each README, and the extensions that it names."""
    rows = []
    for path in sorted(EXTENSIONS.glob("*/README.md")):
        text = path.read_text(encoding="utf-8")
        paragraph = " ".join(text.split("\n\n")[1].split()).partition(" Needs the extension")[0]
        needs = ", ".join(f"`{name}`" for name in re.findall(r"\]\(\.\./(\w+)/README\.md\)", text))
        rows.append((f"`{path.parent.name}`", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", paragraph), needs))
    return table(("extension", "what it adds", "needs"), rows)


def package_drawing(_: str = "") -> str:
    """Return the drawing of the packages and their imports."""
    import packages  # noqa: PLC0415 it needs import-linter's package grimp

    return packages.drawing()


GENERATORS: Mapping[str, Callable[[str], str]] = {
    "records": records,
    "keys": key_table,
    "wildcards": wildcard_table,
    "configuration": configuration,
    "commands": commands,
    "rates": rate_table,
    "images": image_table,
    "metrics": metrics,
    "limits": limit_table,
    "extensions": extension_table,
    "packages": package_drawing,
}


def described(model: type[BaseModel]) -> tuple[str, dict[str, str]]:
    """Return a model's summary and the description of each field, those of its bases included."""
    fields: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if base.__doc__ and issubclass(base, BaseModel) and base is not BaseModel:
            for section in griffe.Docstring(inspect.cleandoc(base.__doc__)).parse("google", warnings=False):
                if isinstance(section, griffe.DocstringSectionAttributes):
                    fields |= {item.name: " ".join(item.description.split()) for item in section.value}
    text = inspect.cleandoc(model.__doc__ or "").partition("Attributes:")[0].strip()
    return text, {name: fields[name] for name in model.model_fields if name in fields}


def unit(name: str) -> str:
    """Return the unit of a quantity, from its name."""
    if name in NAMED_OTHERWISE:
        return NAMED_OTHERWISE[name]
    return next((text for suffix, text in UNITS.items() if name.endswith(f"_{suffix}")), "")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(_CELL_BAR.sub(r"\\|", cell) for cell in line) + " |" for line in lines)


def _record(row: KeyRow) -> str:
    return "-" if row.record == "none" else f"`{row.record}`"


def _without_null(schema: Mapping[str, Any]) -> Mapping[str, Any]:
    return next((option for option in schema.get("anyOf", []) if option.get("type") != "null"), schema)


def _type(schema: Mapping[str, Any]) -> str:
    """Return the name of a type of msgpack for the JSON schema of a field."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return next((f"[{t.TYPE}](#{t.TYPE})" for t in record_types() if t.__name__ == name), name)
    match schema.get("type"):
        case "array" if "prefixItems" in schema:
            return "array of " + ", ".join(_type(item) for item in schema["prefixItems"])
        case "array":
            return f"array of {_type(schema['items'])}"
        case "object":
            return f"map of str to {_type(schema['additionalProperties'])}"
        case "string" if schema.get("format") == "binary":
            return "bin"
        case kind:
            return {"string": "str", "integer": "int", "number": "float", "boolean": "bool"}[str(kind)]


def _range(schema: Mapping[str, Any]) -> str:
    """Return the range of values for the JSON schema of a field."""
    if inner := schema.get("items") or schema.get("additionalProperties"):
        text = _range(inner) if isinstance(inner, dict) else ""
        count = f"at most {schema['maxItems']}" if "maxItems" in schema else ""
        return ", ".join(part for part in (f"{text} each" if text else "", count) if part)
    if "const" in schema or "enum" in schema:
        return ", ".join(f"`{_toml(value)}`" for value in schema.get("enum", [schema.get("const")]))
    if "pattern" in schema:
        return _pattern(schema["pattern"])
    if "maxLength" in schema:
        what = "bytes" if schema.get("format") == "binary" else "characters"
        return f"{schema.get('minLength', 0)} to {schema['maxLength']} {what}"
    low = f"above {schema['exclusiveMinimum']:g}" if "exclusiveMinimum" in schema else _number(schema.get("minimum"))
    high = f"below {schema['exclusiveMaximum']:g}" if "exclusiveMaximum" in schema else _number(schema.get("maximum"))
    if low and high:
        return f"{low} to {high}"
    return f"from {low}" if low else f"to {high}" if high else ""


def _pattern(pattern: str) -> str:
    """Return a pattern without its anchors, or the list of values if it is `^(one|two)$`."""
    inner = pattern.removeprefix("^").removesuffix("$")
    if re.fullmatch(r"\(\w+(\|\w+)+\)", inner):
        return ", ".join(f"`{_toml(value)}`" for value in inner[1:-1].split("|"))
    return f"`{inner}`"


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return "2^63-1" if value == 2**63 - 1 else f"{value:.12g}"


def _absent(record: type[Record], field: str) -> str:
    info = record.model_fields[field]
    return "required" if info.is_required() else "nil" if info.default is None else "empty"


def _configuration_tables(model: type[BaseModel], name: str) -> str:
    """Return the table of one configuration table, followed by those of the tables inside it."""
    _, fields = described(model)
    schema = model.model_json_schema()
    rows, inside = [], []
    for field, info in model.model_fields.items():
        inner = _without_null(schema["properties"][field])
        target = inner.get("items", inner)
        if "$ref" in target:
            definition = schema["$defs"][target["$ref"].rpartition("/")[2]]
            if "properties" in definition:
                inside.append((field, _model_named(info.annotation, definition["title"]), "items" in inner))
                inner = {"type": "array", "items": {"type": "object"}} if "items" in inner else {"type": "object"}
            else:
                inner = {"type": "array", "items": definition} if "items" in inner else definition
        default = info.get_default(call_default_factory=True)
        rows.append(
            (
                f"`{field}`",
                _configuration_type_text(inner, info.annotation),
                unit(field),
                _range(inner) if "properties" not in inner else "",
                "**required**" if default is PydanticUndefined else _default(default),
                fields.get(field, ""),
            )
        )
    text = table(("key", "type", "unit", "range", "default", "meaning"), rows)
    for field, inner_model, many in inside:
        brackets = f"[[{name}.{field}]]" if many else f"[{name}.{field}]"
        text += f"\n\n`{brackets}`:\n\n{_configuration_tables(inner_model, f'{name}.{field}')}"
    return text


def _model_named(annotation: object, title: str) -> type[BaseModel]:
    """Return the model inside an annotation such as `tuple[Model, ...]` or `Model | None`."""
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel) and annotation.__name__ == title:
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        try:
            return _model_named(argument, title)
        except LookupError:
            continue
    raise LookupError(title)


def _configuration_type_text(schema: Mapping[str, Any], annotation: object) -> str:
    match schema.get("type"):
        case "array":
            fixed = schema.get("prefixItems", ())
            item = _configuration_type_text(fixed[0] if fixed else schema["items"], None)
            items = item.replace("list", "lists", 1) if item.startswith("list") else f"{item}s"
            return f"list of {len(fixed)} {items}" if fixed else f"list of {items}"
        case "object":
            return "table"
        case "string":
            return "path" if schema.get("format") == "path" else "text"
        case kind:
            return {"integer": "integer", "number": "number", "boolean": "boolean"}.get(str(kind), "text")


def _default(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, BaseModel) or (isinstance(value, tuple) and value and isinstance(value[0], BaseModel)):
        return "below"
    return f"`{_toml(value)}`"


def _toml(value: object) -> str:
    value = value.value if isinstance(value, Enum) else value
    if isinstance(value, (bool, int, float)):
        return json.dumps(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }" if value else "{}"
    return json.dumps(str(value))


def _command_section(command: CommandParser) -> str:
    is_whole = command.prog == "sonarpost"  # it describes the options that every command has
    usage = " ".join(command.format_usage().removeprefix("usage: ").split())
    if not is_whole:
        usage = usage.replace(" [-h] [-v | -q]", "")
    heading = "#" * (len(command.prog.split()) + 1)
    example = f"\n{command.epilog}" if command.epilog and not is_whole else ""
    text = f"{heading} {command.prog}\n\n{command.description}\n\n```text\n{usage}{example}\n```"
    rows = []
    for action in command._actions:
        if isinstance(action, argparse._SubParsersAction):
            rows += [(f"`{choice.dest}`", choice.help or "", "") for choice in action._choices_actions]
        elif action.help != argparse.SUPPRESS and (action.dest not in ("help", "verbosity") or is_whole):
            meaning = argument_help(action, command)
            rows.append(
                (f"`{argument_name(action)}`", meaning, "" if "default" in meaning else _argument_default(action))
            )
    if not rows:
        return text
    if not any(default for *_, default in rows):
        return f"{text}\n\n{table(('argument', 'meaning'), [row[:2] for row in rows])}"
    return f"{text}\n\n{table(('argument', 'meaning', 'default'), rows)}"


def argument_name(action: argparse.Action) -> str:
    """Return how an argument is written, with the name of its value."""
    if not action.option_strings:
        return str(action.metavar or action.dest)
    names = ", ".join(action.option_strings)
    return names if action.nargs == 0 else f"{names} {_metavar(action)}"


def argument_help(action: argparse.Action, command: argparse.ArgumentParser) -> str:
    """Return the help line of an argument."""
    return " ".join(((action.help or "") % {**vars(action), "prog": command.prog}).split())


def _argument_default(action: argparse.Action) -> str:
    empty = action.nargs == 0 or action.default in (None, argparse.SUPPRESS, [], ())
    return "" if empty else f"`{action.default}`"


def _metavar(action: argparse.Action) -> str:
    if action.choices is not None and action.metavar is None:
        return "{" + ",".join(str(choice) for choice in action.choices) + "}"
    name = action.metavar or action.dest.upper()
    return " ".join(name) if isinstance(name, tuple) else name
