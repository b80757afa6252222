"""The examples of docs/specifications/zenoh.md: bytes, programs and observable delivery."""

import hashlib
import re
import sys
from collections.abc import Callable

import msgpack
import pytest
from builders.common import REPOSITORY, WAIT_S, eventually, running
from builders.line_program import LineProgram, run_program
from builders.record_samples import SAMPLES

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery import protocol
from sonarpost.delivery.protocol import AckReply, attachment
from sonarpost.delivery.records import OutboxItem
from sonarpost.messages import Contact, Decision, Record, Snippet
from sonarpost.runtime.service import Service, UnitOfWork

__all__ = ["run_program"]

PlatformMaker = Callable[[str], PlatformConfig]
TEXT = (REPOSITORY / "docs" / "specifications" / "zenoh.md").read_text(encoding="utf-8")
TUTORIAL = (REPOSITORY / "docs" / "tutorials" / "own-detector.md").read_text(encoding="utf-8")


def test_example_of_an_error_message():
    snippet = SAMPLES["snippet-classified"].model_dump()
    snippet["contact"]["lat_deg"] = 91.0
    with pytest.raises(wire.PayloadError) as caught:
        wire.decode(
            Snippet, msgpack.packb({"type": "snippet", "v": 1} | snippet), "sonarpost/v1/uuv-1/contact/detected"
        )
    assert f"\n{caught.value}\n" in TEXT


def blocks(language):
    return dict(re.findall(rf'^```{language} title="([\w.]+)"\n(.*?)^```$', TEXT + TUTORIAL, re.MULTILINE | re.DOTALL))


def hex_block(name):
    return bytes.fromhex("".join(line.split("#")[0] for line in blocks("hex")[name].splitlines()))


def test_hex_examples_equal_the_encoded_records():
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


def test_comments_of_hex_examples_equal_the_decoded_fields():
    """Every line after the first has one field, and its name and value as a comment."""
    texts = [block.splitlines() for block in blocks("hex").values()]
    assert all(first.endswith(f"# map of {len(lines)}") for first, *lines in texts)
    for line in [line for _, *lines in texts for line in lines]:
        comment = line.split("# ")[1]
        (field, value), *_ = msgpack.unpackb(b"\x81" + bytes.fromhex(line.split("#")[0])).items()
        if isinstance(value, bytes):
            assert comment == f"{field}: {len(value)} bytes"
        else:
            shown = "nil" if value is None else f'"{value}"' if isinstance(value, str) else str(value)
            assert comment == f"{field}: {shown}"


class RecordingConsumer(Service[ServiceConfig]):
    """Stores every record that it consumes."""

    key = keys.contact_detected("uuv-1")
    record_type: type[Record] = Snippet
    NAME = "compressor"

    def __init__(self, platform):
        super().__init__(platform, ServiceConfig())
        self.received = []

    def consumed_keys(self):
        return {self.key: self.record_type}

    def handle(self, key, record, effects):
        self.received.append(record)


class DecisionConsumer(RecordingConsumer):
    key = keys.contact_decision("vessel-1")
    record_type = Decision
    NAME = "relay"


Run = Callable[..., LineProgram]


@pytest.fixture
def run(tmp_path, run_program):
    """Runs a program of the page as a process that cannot import sonarpost."""

    def start(name, *arguments):
        path = tmp_path / f"{name}.py"
        path.write_text("import sys\nsys.modules['sonarpost'] = None\n" + blocks("python")[name], encoding="utf-8")
        return run_program(sys.executable, str(path), *arguments)

    return start


def test_published_contact_reaches_consumer_and_watcher(run, router, platform):
    with running(RecordingConsumer(platform("uuv-1"))) as consumer:
        watching = run("watch", router)
        while not watching.lines.get(timeout=120).startswith("sonarpost/v1/uuv-1/health/compressor health"):
            pass
        run("detector.py", router).wait()
        eventually(lambda: len(consumer.received) == 1)
        line = ""
        while not line.startswith(keys.contact_detected("uuv-1")):
            line = watching.lines.get(timeout=120)
        assert line.split() == [keys.contact_detected("uuv-1"), "snippet"]
    snippet = consumer.received[0]
    assert snippet.contact == Contact(
        contact_id="my-detector-1",
        vehicle_id="uuv-1",
        time_utc_s=snippet.contact.time_utc_s,
        lat_deg=41.5251,
        lon_deg=-70.6712,
        atd_confidence=1.5,
    )
    assert snippet.pixels.to_array()[5].tolist() == list(range(0, 192, 2))


def test_delivery_program_waits_for_its_consumer(run, router, client, platform, tmp_path):
    (tmp_path / "record").write_bytes(hex_block("decision"))
    asked = []
    silent = client.declare_queryable(
        f"{DecisionConsumer.key}/delivery/relay", lambda q: asked.append(q.payload.to_bytes())
    )
    program = run("deliver", router, DecisionConsumer.key, "relay", str(tmp_path / "record"))
    eventually(lambda: hex_block("decision") in asked, what="an attempt without a reply")
    silent.undeclare()
    with running(DecisionConsumer(platform("vessel-1"))) as consumer:
        program.wait()
        assert program.lines.get(timeout=120) == "stored"
        eventually(lambda: consumer.received == [SAMPLES["decision-bare"]])


def test_delivery_program_sends_pieces_and_reports_a_refusal(run, router, platform, tmp_path):
    """100 kB that are not a snippet: the consumer refuses them after the last piece."""
    (tmp_path / "record").write_bytes(msgpack.packb({"type": "snippet", "v": 1, "filler": b"x" * 100_000}))
    with running(RecordingConsumer(platform("uuv-1"))) as consumer:
        program = run("deliver", router, RecordingConsumer.key, "compressor", str(tmp_path / "record"))
        program.wait()
        assert (
            program.lines.get(timeout=120)
            == f"refused {RecordingConsumer.key}: contact: got 'nothing', expected a value"
        )
        assert consumer.store.refused_count() == 1
    assert consumer.received == []


class Producer(Service[ServiceConfig]):
    NAME = "decider"

    def handle(self, key, record, effects):
        raise AssertionError("consumes nothing")


def queue_decision(producer, consumer, number):
    effects = UnitOfWork()
    fields = SAMPLES["decision-bare"].model_dump() | {"decision_id": f"d{number}"}
    effects.send(DecisionConsumer.key, consumer, Decision(**fields))
    producer.commit(effects)


def test_record_for_two_consumers_is_published_with_both_sequence_numbers(client, platform):
    seen = []

    def show(sample):
        fields = msgpack.unpackb(sample.attachment.to_bytes())
        seen.append((fields["consumer"], fields["seq"], msgpack.unpackb(sample.payload.to_bytes())["decision_id"]))

    client.declare_subscriber(DecisionConsumer.key, show)
    producer = Producer(platform("vessel-1"), ServiceConfig())
    queue_decision(producer, "op_modem", 1)
    queue_decision(producer, "relay", 2)
    queue_decision(producer, "op_modem", 2)
    with running(producer):
        eventually(lambda: len(seen) == 3)
        assert sorted(seen) == [("op_modem", 1, "d1"), ("op_modem", 2, "d2"), ("relay", 1, "d2")]


def test_consumer_ignores_publications_with_an_attachment(client, platform):
    with running(DecisionConsumer(platform("vessel-1"))) as consumer:
        publisher = client.declare_publisher(DecisionConsumer.key)
        eventually(lambda: publisher.matching_status.matching)
        publisher.put(b"rubbish", attachment=b"anything")
        publisher.put(hex_block("decision"), attachment=hex_block("attachment"))
        publisher.delete()
        publisher.put(hex_block("decision"))
        eventually(lambda: len(consumer.received) == 1)
        assert consumer.store.refused_count() == 0


def test_service_answers_the_example_query_with_the_example_reply(client, platform):
    selector = "sonarpost/v1/vessel-1/contact/decision/delivery/relay"

    def ask(payload, attached):
        replies = client.get(selector, payload=payload, attachment=attached, timeout=WAIT_S)
        received = replies.recv()
        assert str(received.ok.key_expr) == selector
        return received.ok.payload.to_bytes()

    with running(DecisionConsumer(platform("vessel-1"))) as consumer:
        querier = client.declare_querier(selector)
        eventually(lambda: querier.matching_status.matching)
        assert ask(hex_block("decision"), hex_block("attachment")) == hex_block("reply")
        again = AckReply.unpack(ask(hex_block("decision"), hex_block("attachment")), "k")
        assert (again.status, again.highest) == ("stored", 1)
        assert again.highest_sha256 == hashlib.sha256(hex_block("decision")).digest()
        eventually(lambda: len(consumer.received) == 1)
        # Refused for its content: a repeated query is validated again.
        bad = msgpack.packb({"type": "decision", "v": 9})
        item = OutboxItem("relay", 2, "k", "", 4, bad, hashlib.sha256(bad).digest())
        first, again = (AckReply.unpack(ask(bad, attachment(bytes(range(16)), item)), "k") for _ in range(2))
        assert first == again == AckReply("refused", reason=f"{DecisionConsumer.key}: v: got 9, expected 1")
        assert consumer.store.refused_count() == 2
        # Refused for its attachment: without origin and number it is not stored.
        refused = AckReply.unpack(ask(hex_block("decision"), None), "k")
        assert refused.status == "refused"
        assert f"{selector}: payload: got b''" in refused.reason
        assert consumer.store.refused_count() == 2
