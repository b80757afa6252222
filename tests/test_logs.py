"""Logs: one line for each event, and the log context."""

import json
import logging
import math
import re

import msgpack
import pytest
from builders.record_samples import COMPLETE_IMAGE, SAMPLES
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys, logs, wire
from sonarpost.logs import IntervalLog, JsonFormatter, TextFormatter, context_of_payload, kv
from sonarpost.messages import Contact, Decision, ImagePart, Pixels, Relayed, Snippet


def record(message="Image stored", /, *args, **fields):
    made = logging.LogRecord("n", logging.WARNING, "f.py", 1, message, args, None)
    made.created = 1476262800.25
    vars(made).update(kv(**fields))
    return made


def text(*args, **fields):
    return TextFormatter("relay").format(record(*args, **fields))


def event(*args, **fields):
    line = JsonFormatter("relay").format(record(*args, **fields))
    assert "\n" not in line

    def no_constant(name):
        raise AssertionError(f"{name} is no JSON")

    return dict(json.loads(line, parse_constant=no_constant))


def test_text_line():
    assert (
        text(image_id="0001", bytes=232)
        == "2016-10-12T09:00:00.250Z WARNING relay: Image stored image_id=0001 bytes=232"
    )
    assert text("Took %d of %s", 2, "3") == "2016-10-12T09:00:00.250Z WARNING relay: Took 2 of 3"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("", '""'),
        ("two words", '"two words"'),
        ("a=b", '"a=b"'),
        ('say "x"', '"say \\"x\\""'),
        ("line\nline", '"line\\nline"'),
        ("\x1b[2J", '"\\u001b[2J"'),
        ("a\x85b", '"a\\u0085b"'),
        ("größe", "größe"),
        (0.123456789, "0.123457"),
        (math.nan, "nan"),
        (None, "None"),
        (b"\xff\n", "\"b'\\\\xff\\\\n'\""),
    ],
)
def test_text_value_is_quoted_if_needed(value, shown):
    assert text(x=value).endswith(f" x={shown}")


def test_json_line():
    assert event(image_id="0001", ratio=0.5, missing=None) == {
        "time": "2016-10-12T09:00:00.250Z",
        "level": "warning",
        "service": "relay",
        "message": "Image stored",
        "image_id": "0001",
        "ratio": 0.5,
        "missing": None,
    }


def test_field_does_not_replace_time_or_level():
    got = event(time=1, level="x", service="y", message="z")
    assert (got["level"], got["service"], got["message"]) == ("warning", "relay", "Image stored")
    assert (got["time_"], got["level_"], got["service_"], got["message_"]) == (1, "x", "y", "z")


@given(st.text(), st.text() | st.floats() | st.integers() | st.binary())
def test_any_event_is_one_printable_line(message, value):
    made = record("%s", message, x=value)
    line = TextFormatter("relay").format(made)
    assert line.isprintable()
    assert re.match(r"2016-10-12T09:00:00\.250Z WARNING relay: ", line)
    parsed = json.loads(JsonFormatter("relay").format(made))
    assert parsed["message"] == message


def with_exception():
    try:
        int("two\nlines")
    except ValueError as error:
        made = record()
        made.exc_info = (type(error), error, error.__traceback__)
    return made


def test_traceback_follows_the_text_line_and_is_a_json_field():
    made = with_exception()
    lines = TextFormatter("relay").format(made).splitlines()
    assert lines[0].endswith("Image stored")
    assert lines[1].startswith("Traceback")
    assert lines[-1].startswith("ValueError: invalid literal")
    line = JsonFormatter("relay").format(made)
    assert "\n" not in line
    assert "ValueError: invalid literal" in json.loads(line)["traceback"]


def test_logs_are_written_to_standard_error_in_the_configured_format(capsys):
    logs.configure_logging("relay", "warning", "json")
    logging.getLogger("a.b").info("Not shown")
    logging.getLogger("a.b").warning("Shown", extra=kv(n=1))
    logs.configure_logging("c2", "debug")
    logging.getLogger("a.b").debug("Shown too", exc_info=False)
    out, err = capsys.readouterr()
    assert out == ""
    first, second = err.splitlines()
    assert (json.loads(first)["message"], json.loads(first)["n"]) == ("Shown", 1)
    assert second.endswith("DEBUG c2: Shown too")
    assert len(logging.getLogger().handlers) == 1


def test_log_context_is_in_both_formats():
    with logs.log_context(vehicle="uuv-1", image_id=None):
        with logs.log_context(image_id="00A7"):
            assert text("Sent", bytes=3).endswith(": Sent vehicle=uuv-1 image_id=00A7 bytes=3")
            assert event("Sent", image_id="00A8")["image_id"] == "00A8"  # the call overrides the context
        assert text("Sent").endswith(": Sent vehicle=uuv-1")
    assert text("Sent").endswith(": Sent")


def test_context_of_a_record_is_read_once_and_only_for_a_line(monkeypatch):
    reads: list[bytes] = []

    def read(payload):
        reads.extend([payload] if payload else [])
        return {"image_id": "00A7"} if payload else {}

    monkeypatch.setattr(logs, "context_of_payload", read)
    with logs.log_context(vehicle="uuv-1"), logs.log_context(b"record"):
        assert reads == []
        assert text("Sent").endswith(": Sent vehicle=uuv-1 image_id=00A7")
        with logs.log_context(step=2):
            assert event("Sent")["step"] == 2
        assert reads == [b"record"]
    assert text("Sent").endswith(": Sent")
    with logs.log_context(b"record"):
        pass
    assert reads == [b"record"]


def test_context_holds_vehicle_image_and_contact_of_a_record():
    assert COMPLETE_IMAGE.contact is not None
    image = {"vehicle": "uuv-1", "image_id": "00A7", "contact_id": COMPLETE_IMAGE.contact.contact_id}
    contact = Contact(contact_id="line-7", vehicle_id="uuv-1")
    snippet = Snippet(contact=contact, pixels=Pixels(height_px=1, width_px=1, bits=8, data=b"\0"))
    assert context_of_payload(wire.encode(snippet)) == {"vehicle": "uuv-1", "contact_id": "line-7"}
    assert context_of_payload(wire.encode(COMPLETE_IMAGE)) == image
    assert context_of_payload(relayed(wire.encode(COMPLETE_IMAGE))) == image
    decision = next(record for record in SAMPLES.values() if isinstance(record, Decision))
    assert context_of_payload(wire.encode(decision)) == {"vehicle": decision.vehicle_id, "image_id": decision.image_id}


def test_a_batch_has_one_line_with_counts_and_first_and_last_record(caplog):
    caplog.set_level(logging.INFO)
    payloads = [wire.encode(COMPLETE_IMAGE.model_copy(update={"image_id": name})) for name in ("0001", "0002", "0003")]
    logs.log_batch(logging.getLogger("n"), "Queued", payloads, images=3)
    logs.log_batch(logging.getLogger("n"), "Queued", payloads[2:], images=1)
    several, one = (line.__dict__["fields"] for line in caplog.records)
    assert several == {"first": "uuv-1/0001", "last": "uuv-1/0003", "images": 3}
    assert (one["vehicle"], one["image_id"], one["images"]) == ("uuv-1", "0003", 1)


def relayed(payload):
    key = keys.image_reconstructed("vessel-1")
    return wire.encode(Relayed(vessel_id="vessel-1", key=key, payload=payload, relayed_utc_s=1.0))


@pytest.mark.parametrize("payload", [b"", b"\xc1", relayed(b"\xc1"), relayed(relayed(wire.encode(COMPLETE_IMAGE)))])
def test_invalid_payload_has_no_context(payload):
    assert context_of_payload(payload) == {}


@given(
    st.dictionaries(
        st.sampled_from(["type", "vehicle_id", "image_id", "contact", "payload", "data"]),
        st.none()
        | st.integers(0, 9)
        | st.text(max_size=3)
        | st.binary(max_size=9)
        | st.lists(st.integers(0, 9), max_size=2),
    )
)
def test_context_omits_fields_of_other_types(fields):
    assert all(isinstance(value, str) for value in context_of_payload(msgpack.packb(fields)).values())


def test_context_of_every_record_type():
    for record in SAMPLES.values():
        contact = getattr(record, "contact", None)
        expected = {
            "vehicle": getattr(record, "vehicle_id", None) or getattr(contact, "vehicle_id", None),
            "image_id": getattr(record, "image_id", None),
            "contact_id": getattr(contact, "contact_id", None),
        }
        if isinstance(record, ImagePart):
            expected |= {"vehicle": record.u, "image_id": record.i}
        if not isinstance(record, Relayed):
            known = {field: value for field, value in expected.items() if value is not None}
            assert context_of_payload(wire.encode(record)) == known


def interval_log(now, interval_s=60.0):
    return IntervalLog(logging.getLogger("n"), logging.WARNING, "Record refused", interval_s, lambda: now[0])


def logged(caplog):
    return [vars(r)["fields"] for r in caplog.records]


def test_interval_log_writes_one_line_an_interval(caplog):
    now = [1000.0]
    refused = interval_log(now)
    for number in range(6001):
        now[0] = 1000.0 + number / 50
        refused.log(number=number)
    assert logged(caplog) == [{"number": 0}, {"number": 3000, "suppressed": 2999}, {"number": 6000, "suppressed": 2999}]


def test_interval_log_writes_the_end_of_a_burst(caplog):
    now = [0.0]
    refused = interval_log(now)
    for number in range(5):
        refused.log(number=number)
    refused.flush()
    assert len(caplog.records) == 1, "the interval has not ended"
    now[0] = 60.0
    refused.flush()
    refused.flush()
    assert logged(caplog)[1:] == [{"number": 4, "suppressed": 3}]
    refused.log(number=5)
    refused.flush(stopping=True)
    assert logged(caplog)[2:] == [{"number": 5}], "one occurrence alone has no count"
