"""Which contact a payload concerns; whatever the payload is, telling it harms nothing."""

from __future__ import annotations

import logging
from collections.abc import Callable

import msgpack
import pytest
from builders.common import eventually
from builders.record_samples import COMPLETE_IMAGE, SAMPLES
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys, logs, wire
from sonarpost.config import PlatformConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.messages import AcousticFrame, Contact, Decision, Pixels, Relayed, Snippet
from sonarpost.monitoring.log_context import LogContext, context_of_payload
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

CONTACT = Contact(contact_id="line-7", vehicle_id="uuv-1")
SNIPPET = Snippet(contact=CONTACT, picture=Pixels(height_px=1, width_px=1, bits=8, data=b"\0"))
IMAGE_KEY = keys.image_reconstructed("vessel-1")


def relayed(payload: bytes) -> bytes:
    return wire.encode(Relayed(vessel_id="vessel-1", key=IMAGE_KEY, payload=payload, relayed_utc_s=1.0))


def frame(data: bytes) -> bytes:
    fields = {"direction": "rx", "platform_id": "vessel-1", "time_utc_s": 1.0, "source": 3, "destination": 1, "rate": 1}
    return wire.encode(AcousticFrame(**fields, packet=1, frame_number=1, frame_count=1, data=data))  # type: ignore[arg-type]


def test_records_say_what_they_concern() -> None:
    whole = {"vehicle": "uuv-1", "image_id": "00A7", "contact_id": COMPLETE_IMAGE.contact.contact_id}  # type: ignore[union-attr]
    assert context_of_payload(wire.encode(SNIPPET), "k") == {"vehicle": "uuv-1", "contact_id": "line-7"}
    assert context_of_payload(wire.encode(COMPLETE_IMAGE), "k") == whole
    assert context_of_payload(relayed(wire.encode(COMPLETE_IMAGE)), "k") == whole
    decision = next(record for record in SAMPLES.values() if isinstance(record, Decision))
    assert context_of_payload(wire.encode(decision), "k") == {
        "vehicle": decision.vehicle_id,
        "image_id": decision.image_id,
    }


def test_a_frame_says_its_image_where_its_format_does() -> None:
    for packet in plan_packets("00A7", b"\x01\x02" + bytes(range(80)), ContactSummary(), 3, 64):
        for data in packet:
            assert context_of_payload(frame(data), "k") == {"image_id": "00A7"}
    assert context_of_payload(frame(b"\xff\xff"), "k") == {}


@pytest.mark.parametrize("payload", [b"", b"\xc1", relayed(b"\xc1"), relayed(relayed(wire.encode(COMPLETE_IMAGE)))])
def test_what_says_nothing_concerns_nobody(payload: bytes) -> None:
    assert context_of_payload(payload, "k") == {}


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
def test_fields_of_other_types_are_left_out(fields: dict[str, object]) -> None:
    assert all(isinstance(value, str) for value in context_of_payload(msgpack.packb(fields), "k").values())


def test_a_refused_record_is_named_in_the_log(
    platform: Callable[[str], PlatformConfig], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    logs.set_up("relay")
    service = RelayService(platform("vessel-1"), RelayConfig())
    assert service.start()
    try:
        elsewhere = COMPLETE_IMAGE.model_copy(update={"vessel_id": "vessel-2"})
        service.session.put(IMAGE_KEY, wire.encode(elsewhere))
        eventually(lambda: service.health().counters.get("records_refused") == 1)
    finally:
        service.stop()
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "Record refused" in line]
    assert "vehicle=uuv-1 image_id=00A7" in line


@pytest.mark.parametrize("name", SAMPLES)
def test_a_record_concerns_what_its_payload_does(name: str) -> None:
    payload = wire.encode(SAMPLES[name])
    concern = LogContext(payload, "k")
    expected = context_of_payload(payload, "k")
    assert concern.fields() == expected
    concern.record = SAMPLES[name]
    assert concern.fields() == expected
