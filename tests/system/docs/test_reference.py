"""The generated reference pages describe every record, key, configuration key and command."""

import argparse
import re

import pytest
import reference

from sonarpost.cli.main import parser
from sonarpost.config import SERVICES, table_names


def test_every_record_key_configuration_key_and_argument_is_described():
    for record in reference.record_types():
        summary, fields = reference.described(record)
        assert summary, record.TYPE
        assert set(fields) == set(record.model_fields), record.TYPE
        assert all(fields.values()), record.TYPE
    types = {record.TYPE for record in reference.record_types()} | {"none"}
    for row in reference.key_rows():
        assert row.summary, row
        if row.record:
            assert row.record in types, row
            assert all((row.source, row.to, row.delivery)), row
        else:
            assert "*" in row.key or "{key}" in row.key, row
    for name in table_names():
        page = reference.configuration(name)
        rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in page.splitlines() if line.startswith("| `")]
        assert all(cells[0].strip() and cells[-1].strip() for cells in rows), name
        assert {cells[0].strip("` ") for cells in rows} >= set(reference.configuration_type(name).model_fields)
    for name, command in parser().tree().items():
        assert command.description, name
        for action in command._actions:
            if not isinstance(action, argparse._SubParsersAction):
                assert reference.argument_help(action, command), (name, action)


@pytest.mark.parametrize("name", SERVICES)
def test_consumed_keys_of_a_service_are_in_its_table(name, service):
    rows = [row for row in reference.key_rows() if name in row.to.split(", ")]
    for key, record in service.consumed_keys().items():
        found = [r for r in rows if re.fullmatch(re.sub(r"\\{\w+\\}", "[^/]+", re.escape(r.key)), key)]
        assert record.TYPE in {row.record for row in found}, key


def test_rows_have_type_unit_range_and_default():
    for page, rows in (
        (
            reference.records(),
            (
                "| `heading_deg` | float | ° | 0 to below 360 | yes | nil | Heading",
                "| `stream` | bin |  | 2 to 65542 bytes | no | required |",
                "| `images` | array of [queued_image](#queued_image) |  | at most 500 | no |",
                '| `channel` | str |  | `"port"`, `"starboard"` | yes | nil |',
                "| `counters` | map of str to int |  | 0 to 2^63-1 each | no | required |",
            ),
        ),
        (
            reference.configuration("uuv_modem"),
            ("| `reply_timeout_s` | number | s | above 0 to 600 | `5.0` |", "| `port` | text |  |  | **required** |"),
        ),
        (reference.configuration("platform"), ("`[platform.tls]`",)),
        (reference.configuration("relay"), ("`[[relay.upstreams]]`",)),
        (
            reference.metrics(),
            (
                "| `sonarpost_up` | gauge | platform, service | 1 while the service's liveliness",
                "| `sonarpost_exporter_records_rejected_total` | counter |  |",
            ),
        ),
        (reference.package_drawing(), ("<title>link imports codec, errors,", ">monitoring</text>")),
        (reference.rate_table(), ("| 1 | PSK BCH 128:8 | 3 x 64 | 192 | 6.1 | 31 | -7.1 | 145 |",)),
        # 3 frames with 54 bytes of payload in 6.1 s, for images of 200 B with a contact record of 25 B.
        (reference.image_table(), ("| 1 | 27 | 17.9 | 10.4 | 7.1 | 3.0 |",)),
    ):
        for row in rows:
            assert row in page
