"""docs/specifications/zenoh.md is true: its tables have every field, its bytes are the bytes, its programs run."""

from __future__ import annotations

import hashlib
import inspect
import queue
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh
from builders.common import REPOSITORY, eventually
from builders.record_samples import RECORD_TYPES, SAMPLES

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery import outbox, protocol, transaction
from sonarpost.delivery import scheduler as schedule
from sonarpost.delivery.protocol import AckReply, attachment
from sonarpost.delivery.records import OutboxItem
from sonarpost.messages import Contact, Decision, Record, Snippet
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.c2.service import ADVICE_PRIORITY, COMMAND_PRIORITY
from sonarpost.services.relay.service import DECISION_PRIORITY, DETAIL_PRIORITY, PREVIEW_PRIORITY

PlatformMaker = Callable[[str], PlatformConfig]
TEXT = (REPOSITORY / "docs" / "specifications" / "zenoh.md").read_text(encoding="utf-8")
FIELDS = [(t, name) for t in RECORD_TYPES for name in t.model_fields]
UNITS = {"mps": "m/s", "deg": "°", "db": "dB", "px": "px", "m": "m", "s": "s"}
NAMED_OTHERWISE = {
    "bits": "bit",
    "bytes_received": "byte",
    "bytes_total": "byte",
    "bytes_left": "byte",
    "message_bytes": "byte",
}


def section(heading: str) -> str:
    found = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", TEXT, re.MULTILINE | re.DOTALL)
    assert found is not None, f"no section {heading}"
    return found.group(1)


def table(heading: str, number: int = 0) -> dict[str, dict[str, str]]:
    """Return a table of a section: cells by column name, by the first cell of each row."""
    lines = re.findall(r"(?:^\|.*\n)+", section(heading), re.MULTILINE)[number].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0].strip("`"): dict(zip(rows[0], row, strict=True)) for row in rows[2:]}


# Records


@pytest.mark.parametrize("record_type", RECORD_TYPES, ids=lambda t: t.TYPE)
def test_a_table_has_the_fields_of_its_record_in_their_order(record_type: type[Record]) -> None:
    assert list(table(record_type.TYPE)) == list(record_type.model_fields)


def test_there_is_a_section_for_every_record_and_for_no_other() -> None:
    headings = re.findall(r"^### (.+)$", TEXT.split("\n## Records\n")[1].split("\n## ")[0], re.MULTILINE)
    assert sorted(headings) == [t.TYPE for t in RECORD_TYPES]


def schema_of(record_type: type[Record], name: str) -> dict[str, Any]:
    """Return what pydantic knows of a field, without the None that it may also be."""
    schema: dict[str, Any] = record_type.model_json_schema()["properties"][name]
    return next((option for option in schema.get("anyOf", []) if option.get("type") != "null"), schema)


def documented_type(schema: Mapping[str, Any]) -> str:
    if "$ref" in schema:
        return next(t.TYPE for t in RECORD_TYPES if schema["$ref"].endswith(f"/{t.__name__}"))
    if schema["type"] == "array":
        return f"array of {documented_type(schema['items'])}"
    if schema["type"] == "object":
        return f"map of str to {documented_type(schema['additionalProperties'])}"
    if schema.get("format") == "binary":
        return "bin"
    return {"string": "str", "integer": "int", "number": "float", "boolean": "bool"}[schema["type"]]


def documented_range(schema: Mapping[str, Any]) -> str:
    """Return how the range cell of a field begins."""
    inner = schema.get("items") or schema.get("additionalProperties")
    if inner:
        text = documented_range(inner)
        return text if "enum" in inner or not text else f"{text} each"
    if "enum" in schema:
        return ", ".join(f"`{v}`" if isinstance(v, str) else str(v) for v in schema["enum"])
    if "pattern" in schema:
        return f"`{schema['pattern']}`"
    if "maxLength" in schema:
        unit = "bytes" if schema.get("format") == "binary" else "characters"
        low = f"{schema['minLength']} " if schema.get("minLength") else ""
        return f"{low}to {schema['maxLength']} {unit}"
    if "maximum" in schema or "exclusiveMaximum" in schema:
        low = f"above {schema['exclusiveMinimum']}" if "exclusiveMinimum" in schema else str(schema["minimum"])
        high = f"below {schema['exclusiveMaximum']}" if "exclusiveMaximum" in schema else str(schema["maximum"])
        return f"{low} to {high}".replace(str(2**63 - 1), "2^63-1")
    return ""


@pytest.mark.parametrize(("record_type", "name"), FIELDS, ids=lambda v: v.TYPE if isinstance(v, type) else v)
def test_a_field_is_documented_with_type_unit_range_nil_and_default(record_type: type[Record], name: str) -> None:
    row, field, schema = table(record_type.TYPE)[name], record_type.model_fields[name], schema_of(record_type, name)
    assert row["field"] == f"`{name}`"
    assert row["type"] == documented_type(schema)
    suffix = name.rpartition("_")[2] if "_" in name else ""
    assert row["unit"] == NAMED_OTHERWISE.get(name, UNITS.get(suffix, ""))
    assert row["range"].startswith(documented_range(schema))
    assert (row["nil"] != "no") == ("anyOf" in record_type.model_json_schema()["properties"][name])
    expected = "required" if field.is_required() else "nil" if field.default is None else "empty"
    assert row["absent"] == expected


def test_units_are_in_the_names_of_what_has_one() -> None:
    for record_type, name in FIELDS:
        if table(record_type.TYPE)[name]["unit"] and name not in NAMED_OTHERWISE:
            assert name.rpartition("_")[2] in UNITS


# Keys and numbers


def test_every_key_is_in_the_table() -> None:
    names = {
        "platform": "{platform}",
        "vehicle": "{uuv}",
        "vessel": "{vessel}",
        "kind": "{kind}",
        "service": "{service}",
        "site": "{site}",
        "answerer": "{answerer}",
    }
    documented = set(table("Keys", 1))
    found = set()
    for name, function in inspect.getmembers(keys, inspect.isfunction):
        if name.startswith(("_", "everything")) or function.__module__ != keys.__name__:
            continue  # those of everything are for access control
        if "key" in inspect.signature(function).parameters:
            continue  # works on a key that another one has made
        sample = {parameter: f"x{parameter}" for parameter in inspect.signature(function).parameters}
        key = function(**sample)
        for parameter, value in sample.items():
            key = key.replace(value, names[parameter])
        if "*" in key:
            assert f"`{key}`" in TEXT, name
        else:
            assert key in documented, name
            found.add(key)
    assert {key for key in documented if key.startswith("sonarpost/")} == found
    assert keys.delivery_query("{key}", "c").replace("/c", "/{consumer}") in TEXT


def test_numbers_in_the_text_are_those_of_the_code() -> None:
    assert protocol.CHUNK_BYTES == 32768
    assert TEXT.count("32768") > 4
    assert f"A record is at most {protocol.MAX_RECORD_BYTES} bytes" in TEXT
    assert f"payloads up to {wire.MAX_PAYLOAD_BYTES}" in TEXT
    assert table("The attachment")["size"]["range"] == f"0 to {protocol.MAX_RECORD_BYTES}"
    assert f"{outbox.REPLY_TIMEOUT_S:g} s in sonarpost" in TEXT
    assert f"at most {protocol.MAX_BATCH_RECORDS}, and at most {protocol.CHUNK_BYTES} bytes together" in TEXT
    assert f"sonarpost has {schedule.WINDOW} queries and {schedule.WINDOW_BYTES} bytes in flight" in TEXT
    assert f"the first {schedule.PROBE_WINDOW} and no" in TEXT
    assert f"up to {schedule.MAX_WINDOW_BYTES} bytes while answers come within {schedule.GROW_BELOW_S:g} s" in TEXT
    assert "half a second of it" in TEXT
    assert schedule.CHUNK_S == 0.5
    assert f"Priorities 1 and\n   {schedule.URGENT_PRIORITY} wait" in TEXT
    assert f"those of the {transaction.MAX_PARTIAL_RECORDS} records touched last" in TEXT
    assert f"(sonarpost: {outbox.BACK_OFF_S[0]} s, rising to {outbox.BACK_OFF_S[-1]:g} s)" in TEXT
    told = f"{DECISION_PRIORITY} decisions, {PREVIEW_PRIORITY} first versions of a picture, {DETAIL_PRIORITY} later"
    assert told in TEXT
    rows = table("Keys", 1)
    assert rows["sonarpost/v1/{platform}/command/{kind}"]["priority"] == str(COMMAND_PRIORITY)
    assert rows["sonarpost/v1/{vessel}/advice"]["priority"] == str(ADVICE_PRIORITY)
    assert "tcp/127.0.0.1:7447" in PlatformConfig(id="x").router
    assert f"({PlatformConfig(id='x').health_interval_s:g} s by default)" in TEXT
    assert str(36**4) in TEXT
    assert wire.encoding_of(Snippet) in TEXT


def test_attachment_and_reply_have_the_documented_fields() -> None:
    item = OutboxItem("relay", 6, "k", "", 4, b"", bytes(32))
    assert list(msgpack.unpackb(attachment(bytes(16), item, done_up_to=5))) == list(table("The attachment"))
    assert list(msgpack.unpackb(AckReply("stored").pack(max_batch=2))) == list(table("The reply"))
    several = protocol.batch_attachment(bytes(16), [item], done_up_to=5)
    assert list(msgpack.unpackb(several)) == list(table("Several records in one query"))
    replies = protocol.pack_replies([AckReply("stored")])
    assert list(msgpack.unpackb(replies)) == list(table("Several records in one query", 1))


def test_the_example_of_an_error_is_one() -> None:
    snippet = SAMPLES["snippet-without-wide"].model_dump()
    snippet["contact"]["lat_deg"] = 91.0
    with pytest.raises(wire.PayloadError) as caught:
        wire.decode(
            Snippet, msgpack.packb({"type": "snippet", "v": 1} | snippet), "sonarpost/v1/uuv-1/contact/detected"
        )
    assert f"    {caught.value}\n" in TEXT


# Bytes


def blocks(language: str) -> dict[str, str]:
    return dict(re.findall(rf'^```{language} title="(\w+)"\n(.*?)^```$', TEXT, re.MULTILINE | re.DOTALL))


def hex_block(name: str) -> bytes:
    return bytes.fromhex("".join(line.split("#")[0] for line in blocks("hex")[name].splitlines()))


def test_the_hex_examples_are_the_bytes() -> None:
    decision = wire.encode(SAMPLES["decision-bare"])
    item = OutboxItem("relay", 1, "k", "", 4, decision, hashlib.sha256(decision).digest())
    assert {name: hex_block(name) for name in blocks("hex")} == {
        "raster": wire.encode(SAMPLES["raster-16-bits"]),
        "decision": decision,
        "attachment": attachment(bytes(range(16)), item),
        "reply": AckReply("stored").pack(protocol.MAX_BATCH_RECORDS),
        "more": AckReply("more", 32768).pack(protocol.MAX_BATCH_RECORDS),
    }
    assert f"A decision, {len(decision)} bytes:" in TEXT
    assert f"with those {len(decision)} bytes" in TEXT


@pytest.mark.parametrize("name", blocks("hex"))
def test_what_stands_beside_the_bytes_is_what_they_say(name: str) -> None:
    """Every line after the first holds one field, whose name and value stand in its comment."""
    first, *lines = blocks("hex")[name].splitlines()
    assert first.endswith(f"# map of {len(lines)}")
    for line in lines:
        said = line.split("# ")[1]
        (field, value), *_ = msgpack.unpackb(b"\x81" + bytes.fromhex(line.split("#")[0])).items()
        if isinstance(value, bytes):
            assert said == f"{field}: {len(value)} bytes"
        else:
            shown = "nil" if value is None else f'"{value}"' if isinstance(value, str) else str(value)
            assert said == f"{field}: {shown}"


# Programs


class Taker(Service[ServiceConfig]):
    """Keeps what it is handed, under a name and from a key that a test gives it."""

    key = keys.contact_detected("uuv-1")
    takes: type[Record] = Snippet
    NAME = "compressor"

    def __init__(self, platform: PlatformConfig) -> None:
        super().__init__(platform, ServiceConfig())
        self.got: list[Any] = []

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return {self.key: self.takes}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        self.got.append(record)


class DecisionTaker(Taker):
    key = keys.contact_decision("vessel-1")
    takes = Decision
    NAME = "relay"


class Program:
    """A program of the page, as a process that cannot import sonarpost."""

    def __init__(self, tmp_path: Path, name: str, *arguments: str) -> None:
        path = tmp_path / f"{name}.py"
        path.write_text("import sys\nsys.modules['sonarpost'] = None\n" + blocks("python")[name], encoding="utf-8")
        self.process = subprocess.Popen(
            [sys.executable, str(path), *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line.strip())

    def wait(self) -> None:
        assert self.process.wait(timeout=20) == 0, self.process.stderr and self.process.stderr.read()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()


Run = Callable[..., Program]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    programs: list[Program] = []

    def start(name: str, *arguments: str) -> Program:
        programs.append(Program(tmp_path, name, *arguments))
        return programs[-1]

    yield start
    for program in programs:
        program.close()


def test_the_publishing_program_is_taken_by_a_consumer_and_seen_by_the_watching_one(
    run: Run, router: str, platform: PlatformMaker
) -> None:
    taker = Taker(platform("uuv-1"))
    taker.start()
    try:
        watching = run("watch", router)
        while not watching.lines.get(timeout=15).startswith("sonarpost/v1/uuv-1/health/compressor health"):
            pass
        run("publish", router).wait()
        eventually(lambda: len(taker.got) == 1)
        line = ""
        while not line.startswith(keys.contact_detected("uuv-1")):
            line = watching.lines.get(timeout=15)
        assert line.split() == [keys.contact_detected("uuv-1"), "snippet"]
    finally:
        taker.stop()
    snippet = taker.got[0]
    assert snippet.contact == Contact(
        contact_id="my-detector-1",
        vehicle_id="uuv-1",
        time_utc_s=snippet.contact.time_utc_s,
        lat_deg=41.5251,
        lon_deg=-70.6712,
        atd_confidence=1.5,
    )
    assert snippet.picture.to_array()[5].tolist() == list(range(0, 192, 2))


def test_the_handing_over_program_waits_for_its_consumer_and_knows_the_end(
    run: Run, router: str, platform: PlatformMaker, tmp_path: Path
) -> None:
    (tmp_path / "record").write_bytes(hex_block("decision"))
    program = run("handover", router, DecisionTaker.key, "relay", str(tmp_path / "record"))
    with pytest.raises(queue.Empty):
        program.lines.get(timeout=0.5)
    taker = DecisionTaker(platform("vessel-1"))
    taker.start()
    try:
        program.wait()
        assert program.lines.get(timeout=5) == "stored"
        eventually(lambda: taker.got == [SAMPLES["decision-bare"]])
    finally:
        taker.stop()


def test_the_handing_over_program_sends_long_records_in_pieces_and_learns_of_a_refusal(
    run: Run, router: str, platform: PlatformMaker, tmp_path: Path
) -> None:
    """100 kB that are no snippet: only when all of it is there can the consumer know."""
    (tmp_path / "record").write_bytes(msgpack.packb({"type": "snippet", "v": 1, "filler": b"x" * 100_000}))
    taker = Taker(platform("uuv-1"))
    taker.start()
    try:
        program = run("handover", router, Taker.key, "compressor", str(tmp_path / "record"))
        program.wait()
        assert program.lines.get(timeout=5) == f"refused {Taker.key}: contact: got 'nothing', expected a value"
        assert taker.store.refused_count() == 1
    finally:
        taker.stop()
    assert taker.got == []


# What the page says of the hand-off


class Producer(Service[ServiceConfig]):
    NAME = "decider"

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        raise AssertionError("takes nothing")


def owe(producer: Producer, consumer: str, number: int) -> None:
    effects = UnitOfWork()
    fields = SAMPLES["decision-bare"].model_dump() | {"decision_id": f"d{number}"}
    effects.send(DecisionTaker.key, consumer, Decision(**fields))
    producer.commit(effects)


def test_a_watcher_sees_the_first_window_while_the_consumer_is_away_and_the_rest_later(
    client: zenoh.Session, platform: PlatformMaker
) -> None:
    seen: list[dict[str, Any]] = []
    client.declare_subscriber(DecisionTaker.key, lambda s: seen.append(msgpack.unpackb(s.attachment.to_bytes())))
    producer = Producer(platform("vessel-1"), ServiceConfig())
    for number in range(20):
        owe(producer, "relay", number)
    producer.start()
    taker = DecisionTaker(platform("vessel-1"))
    try:
        eventually(lambda: len(seen) == schedule.PROBE_WINDOW)
        taker.start()
        eventually(lambda: len(seen) == 20)
        eventually(lambda: producer.store.outbox_depth() == 0)
        assert sorted(fields["seq"] for fields in seen) == list(range(1, 21))
    finally:
        producer.stop()
        taker.stop()


def test_a_record_for_two_consumers_is_published_for_each_under_its_number(
    client: zenoh.Session, platform: PlatformMaker
) -> None:
    seen: list[tuple[str, int, str]] = []

    def show(sample: zenoh.Sample) -> None:
        fields = msgpack.unpackb(sample.attachment.to_bytes())  # type: ignore[union-attr]
        seen.append((fields["consumer"], fields["seq"], msgpack.unpackb(sample.payload.to_bytes())["decision_id"]))

    client.declare_subscriber(DecisionTaker.key, show)
    producer = Producer(platform("vessel-1"), ServiceConfig())
    owe(producer, "op_modem", 1)
    owe(producer, "relay", 2)
    owe(producer, "op_modem", 2)
    producer.start()
    try:
        eventually(lambda: len(seen) == 3)
        assert sorted(seen) == [("op_modem", 1, "d1"), ("op_modem", 2, "d2"), ("relay", 1, "d2")]
    finally:
        producer.stop()


def test_a_publication_with_any_attachment_is_left_alone(client: zenoh.Session, platform: PlatformMaker) -> None:
    taker = DecisionTaker(platform("vessel-1"))
    taker.start()
    try:
        publisher = client.declare_publisher(DecisionTaker.key)
        eventually(lambda: publisher.matching_status.matching)
        publisher.put(b"rubbish", attachment=b"anything")
        publisher.put(hex_block("decision"), attachment=hex_block("attachment"))
        publisher.delete()
        publisher.put(hex_block("decision"))
        eventually(lambda: len(taker.got) == 1)
        assert taker.store.refused_count() == 0
    finally:
        taker.stop()


def test_the_bytes_of_the_page_are_a_conversation(client: zenoh.Session, platform: PlatformMaker) -> None:
    taker = DecisionTaker(platform("vessel-1"))
    taker.start()
    selector = "sonarpost/v1/vessel-1/contact/decision/handoff/relay"

    def ask(payload: bytes, attached: bytes | None) -> bytes:
        replies = client.get(selector, payload=payload, attachment=attached, timeout=5)
        received = replies.recv()
        assert received.ok is not None
        assert str(received.ok.key_expr) == selector
        return received.ok.payload.to_bytes()

    try:
        querier = client.declare_querier(selector)
        eventually(lambda: querier.matching_status.matching)
        assert ask(hex_block("decision"), hex_block("attachment")) == hex_block("reply")
        assert ask(hex_block("decision"), hex_block("attachment")) == hex_block("reply")
        eventually(lambda: len(taker.got) == 1)
        # Refused for its content: remembered, so that asking again does not refuse it a second time.
        bad = msgpack.packb({"type": "decision", "v": 9})
        item = OutboxItem("relay", 2, "k", "", 4, bad, hashlib.sha256(bad).digest())
        first, again = (AckReply.unpack(ask(bad, attachment(bytes(range(16)), item)), "k") for _ in range(2))
        assert first == AckReply("refused", reason=f"{DecisionTaker.key}: v: got 9, expected 1")
        assert again.status == "refused"
        assert "refused before" in again.reason
        assert taker.store.refused_count() == 1
        # Refused for its attachment, or for having none: nothing to remember it by.
        refused = AckReply.unpack(ask(hex_block("decision"), None), "k")
        assert refused.status == "refused"
        assert f"{selector}: payload: got b''" in refused.reason
        assert taker.store.refused_count() == 1
    finally:
        taker.stop()
