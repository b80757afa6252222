"""The generated reference pages describe every record, key, configuration key and command."""

from __future__ import annotations

import argparse
import re
import tomllib

import pytest
import reference
from builders.common import REPOSITORY
from pydantic_core import to_jsonable_python
from reference import Command

import sonarpost
from sonarpost.config import SERVICES, PlatformConfig, ServiceConfig
from sonarpost.messages import Record
from sonarpost.runtime.service import Service

NOT_ON_ZENOH = {"acoustic_channel"}
TABLES = ("platform", *SERVICES)


@pytest.mark.parametrize("record", reference.record_types(), ids=lambda record: record.TYPE)
def test_record_and_its_fields_are_described(record: type[Record]) -> None:
    summary, fields = reference.described(record)
    assert summary
    assert set(fields) == set(record.model_fields)
    section = re.search(rf"^## {record.TYPE}\n(.*?)(?=^## |\Z)", reference.records(), re.MULTILINE | re.DOTALL)
    assert section
    assert summary in section.group(1)
    for name, description in fields.items():
        assert re.search(rf"^\| `{name}` \| \S.*\| {re.escape(description)} \|$", section.group(1), re.MULTILINE)


def test_field_row_has_type_unit_range_nil_and_default() -> None:
    rows = reference.records().splitlines()
    assert any(r.startswith("| `heading_deg` | float | ° | 0 to below 360 | yes | nil | Heading") for r in rows)
    assert any(r.startswith("| `stream` | bin |  | 2 to 65542 bytes | no | required |") for r in rows)
    assert any(
        r.startswith("| `images` | array of [queued_image](#queued_image) |  | at most 500 | no |") for r in rows
    )
    assert any(r.startswith('| `channel` | str |  | `"port"`, `"starboard"` | yes | nil |') for r in rows)
    assert any(r.startswith("| `counters` | map of str to int |  | 0 to 2^63-1 each | no | required |") for r in rows)


def test_every_key_is_described() -> None:
    rows = reference.key_rows()
    assert len(rows) > 35
    types = {record.TYPE for record in reference.record_types()} | {"none"}
    for row in rows:
        assert row.summary, row
        if row.record:
            assert row.record in types, row
            assert all((row.source, row.to, row.delivery)), row
        page = reference.key_table() if row.record else reference.wildcard_table()
        assert f"| `{row.key}`" in page
        assert row.record or "*" in row.key or "{key}" in row.key, row


@pytest.mark.parametrize("name", [n for n in SERVICES if n not in NOT_ON_ZENOH])
def test_consumed_keys_of_a_service_are_in_its_table(name: str, service: Service[ServiceConfig]) -> None:
    rows = [row for row in reference.key_rows() if name in row.to.split(", ")]
    for key, record in service.consumed_keys().items():
        found = [r for r in rows if re.fullmatch(re.sub(r"\\{\w+\\}", "[^/]+", re.escape(r.key)), key)]
        assert record.TYPE in {row.record for row in found}, key


@pytest.mark.parametrize("name", TABLES)
def test_configuration_keys_are_described(name: str) -> None:
    page, fields = reference.configuration(name), reference.configuration_type(name).model_fields
    listed = set()
    for row in [line for line in page.splitlines() if line.startswith("| `")]:
        key, kind, _, _, default, meaning = (cell.strip("` ") for cell in re.split(r"(?<!\\)\|", row)[1:-1])
        assert all((kind, default, meaning)), f"[{name}] {key}"
        listed.add(key)
        if key in fields and default not in ("**required**", "none", "below"):
            value = tomllib.loads(f"value = {default}")["value"]
            assert value == to_jsonable_python(fields[key].get_default(call_default_factory=True))
    assert listed >= set(fields)
    assert f"## [{name}]\n" in reference.configuration()


def test_configuration_row_has_type_unit_range_and_default() -> None:
    assert "| `reply_timeout_s` | number | s | above 0 to 600 | `5.0` |" in reference.configuration("uuv_modem")
    assert "| `port` | text |  |  | **required** |" in reference.configuration("uuv_modem")
    assert "`[platform.tls]`" in reference.configuration("platform")
    assert "`[[relay.upstreams]]`" in reference.configuration("relay")


@pytest.mark.parametrize("command", reference.command_list(), ids=lambda command: command.name)
def test_command_and_its_arguments_are_described(command: Command) -> None:
    assert command.description
    assert f"# {command.name}\n" in reference.commands()
    for action in command.parser._actions:
        if not isinstance(action, argparse._SubParsersAction):
            assert reference.argument_help(action, command.parser), reference.argument_name(action)


def test_fixed_metrics_are_described() -> None:
    assert "| `sonarpost_up` | gauge | platform, service | 1 while the service's liveliness" in reference.metrics()
    assert "| `sonarpost_exporter_records_rejected_total` | counter |  |" in reference.metrics()


def test_rates() -> None:
    assert "| 1 | PSK BCH 128:8 | 3 x 64 | 192 | 6.1 | 31 | -7.1 | 145 |" in reference.rate_table()
    assert reference.rate_table().count("| not published | not published |") == 4
    # 3 frames with 54 bytes of payload in 6.1 s, for images of 200 B with a contact record of 25 B.
    assert "| 1 | 27 | 17.9 | 10.4 | 7.1 | 3.0 |" in reference.image_table()


def test_every_public_name_is_in_the_api_page() -> None:
    page = (REPOSITORY / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^::: sonarpost\.(\w+)$", page, re.MULTILINE)) == sorted(sonarpost.__all__)


def test_pages_that_the_code_names_exist() -> None:
    named = set()
    for folder in ("common", "services", "research", "packaging", "config"):
        for path in (REPOSITORY / folder).rglob("*"):
            if path.suffix in (".py", ".toml", ".sh", ".yml"):
                named |= set(re.findall(r"\bdocs/[\w/-]+\.md\b", path.read_text(encoding="utf-8")))
    assert len(named) > 8
    assert {name for name in named if not (REPOSITORY / name).exists()} == set()


def test_every_mark_in_a_page_has_a_generator() -> None:
    marks = set()
    for page in [*REPOSITORY.glob("docs/**/*.md"), *REPOSITORY.glob("services/*/README.md")]:
        marks |= set(re.findall(r"^<!-- generated: (\w+)", page.read_text(encoding="utf-8"), re.MULTILINE))
    assert marks
    assert marks <= set(reference.GENERATORS)


def test_platform_table_is_the_model_of_the_platform() -> None:
    assert reference.configuration_type("platform") is PlatformConfig
