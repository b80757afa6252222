"""Two vessels receive the same vehicle: the lead vessel merges their frames, and refuses those of other senders."""

from contextlib import suppress

import pytest
from builders.acoustic_attack import forged_contact, genuine_frames
from builders.common import eventually
from builders.vessel_frames import packet
from pydantic import ValidationError

from sonarpost import keys, wire
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import ConfigError, DeliveryError
from sonarpost.messages import AcousticFrame, Command
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.op_modem.config import OpModemConfig

LEAD, OTHER = "vessel-1", "vessel-2"
IMAGES = 4
INBOX = keys.vessel_frames(LEAD, OTHER)


@pytest.fixture
def begin(begin, key_file):
    return lambda name, **options: begin(name, key_file=key_file, **options)


@pytest.fixture
def frames(key_file):
    return genuine_frames(read_key(key_file), IMAGES)


@pytest.fixture
def vessels(begin):
    lead = begin(LEAD, other_vessels=[OTHER])
    other = begin(OTHER, address=2, lead_vessel=LEAD, image_consumers=[])
    return lead, other


def gauge(service, name):
    return service.health().gauges.get(name)


def merged(service):
    return service.health().counters.get("frames_merged", 0)


def record(data, **changes):
    usual = {"direction": "rx", "platform_id": OTHER, "time_utc_s": 1e9, "source": 3, "destination": 1}
    usual |= {"rate": 1, "packet": 1, "frame_number": 1, "frame_count": 1, "data": data}
    return AcousticFrame(**(usual | changes))


def test_frames_of_two_vessels_make_complete_images_at_the_lead(vessels, decompressor, frames, watch):
    lead, other = vessels
    assert Command in lead.consumed_keys().values()
    assert other.consumed_keys() == {}
    published = watch(INBOX)
    for number, frame in enumerate(frames):
        lead.on_modem_event(packet(*([frame] if number % 2 else [])))
        other.on_modem_event(packet(*([frame] if number % 2 == 0 or number % 5 == 0 else [])))
    sent = sum(n % 2 == 0 or n % 5 == 0 for n in range(len(frames)))
    eventually(lambda: merged(lead) == sent)
    duplicates = sum(n % 2 == 1 and n % 5 == 0 for n in range(len(frames)))
    assert gauge(lead, "frames_duplicate") == duplicates > 0
    assert gauge(lead, "frames_late") == gauge(lead, "frames_replayed") == 0
    eventually(lambda: {i.image_id for i in decompressor.received if i.complete} == {f"000{n}" for n in range(1, 5)})
    assert {(image.vessel_id, image.vehicle_id) for image in decompressor.received} == {(LEAD, "uuv-1")}
    assert all(image.authenticated for image in decompressor.received)
    for image_id in {image.image_id for image in decompressor.received}:
        versions = [image.version for image in decompressor.received if image.image_id == image_id]
        assert versions == list(range(1, len(versions) + 1))
    assert published == []
    eventually(lambda: gauge(other, "outbox") == 0)


def test_frames_wait_at_the_other_vessel_until_the_lead_runs_and_a_restart_keeps_the_window(
    begin, runner, frames, decompressor
):
    other = begin(OTHER, address=2, lead_vessel=LEAD, image_consumers=[])
    other.on_modem_event(packet(*frames[:8]))
    eventually(lambda: gauge(other, "outbox") == 8)
    lead = begin(LEAD, other_vessels=[OTHER])
    eventually(lambda: merged(lead) == 8)
    runner.stop(lead)
    lead = begin(LEAD, other_vessels=[OTHER])
    lead.on_modem_event(packet(*frames[:8]))
    assert gauge(lead, "frames_duplicate") == 8
    assert lead.health().counters.get("frames_rejected", 0) == 0
    for first in range(8, len(frames), 8):
        other.on_modem_event(packet(*frames[first : first + 8]))
    eventually(lambda: merged(lead) == len(frames) - 8)
    eventually(lambda: sum(image.complete for image in decompressor.received) >= IMAGES)


def test_hostile_vessel_changes_nothing(vessels, runner, frames, refused):
    lead, _other = vessels
    hostile = runner.peer(OTHER, "hostile", {})
    hostile.send(INBOX, "op_modem", record(frames[0], platform_id="vessel-3"))
    hostile.send(INBOX, "op_modem", record(frames[0], direction="tx"))
    hostile.send(INBOX, "op_modem", record(frames[0], source=200))
    hostile.send_bytes(INBOX, "op_modem", b"not a record")
    eventually(lambda: gauge(hostile, "outbox") == 0)
    assert [reason.split(":")[1].strip() for _, reason in refused(hostile)][:3] == [
        "platform_id",
        "direction",
        "source",
    ]
    assert len(refused(hostile)) == 4
    for data in (b"", bytes(2048), forged_contact(7), frames[1][:-1] + b"\0", frames[0], frames[0]):
        hostile.send(INBOX, "op_modem", record(data))
    eventually(lambda: lead.health().counters.get("frames_rejected", 0) == 5)
    assert merged(lead) == 1
    assert gauge(lead, "images_incomplete") <= 1


def test_frames_of_other_senders_and_plain_publications_are_not_accepted(vessels, runner, frames):
    lead, other = vessels
    stranger = runner.peer("vessel-3", "stranger", {})
    stranger.send(keys.vessel_frames(LEAD, "vessel-3"), "op_modem", record(frames[0], platform_id="vessel-3"))
    lead.session.put(INBOX, wire.encode(record(frames[0])))
    other.on_modem_event(packet(*frames[1:5]))
    eventually(lambda: merged(lead) == 4)
    assert gauge(stranger, "outbox") == 1
    assert gauge(lead, "inbox") == 0
    assert (gauge(lead, "feedback_open"), gauge(other, "feedback_open")) == (1, 0), "the other vessel receives only"


def test_frame_of_a_failed_commit_is_new_again(vessels, frames):
    lead, other = vessels
    with suppress(DeliveryError), lead._link.step():
        lead.handle(INBOX, record(frames[0]), UnitOfWork())
        raise DeliveryError("not committed")
    other.on_modem_event(packet(frames[0]))
    eventually(lambda: merged(lead) == 1)
    assert gauge(lead, "frames_duplicate") == 0


@pytest.mark.parametrize(
    "options",
    [{"lead_vessel": "vessel-3"}, {"link": "paper"}, {"other_vessels": [OTHER] * 2}, {"other_vessels": ["Vessel 2"]}],
)
def test_invalid_combination_is_refused(options):
    with pytest.raises(ValidationError):
        OpModemConfig(**({"port": "/dev/ttyS0", "other_vessels": [OTHER]} | options))


@pytest.mark.parametrize("options", [{"other_vessels": [OTHER, LEAD]}, {"lead_vessel": LEAD}])
def test_own_name_is_refused(options, begin):
    with pytest.raises(ConfigError, match="other vessels than vessel-1"):
        begin(LEAD, **options)


@pytest.mark.parametrize("options", [{"other_vessels": [OTHER]}, {"lead_vessel": OTHER}])
def test_merging_without_a_key_is_refused(options, platform):
    with pytest.raises(ConfigError, match="an acoustic key"):
        OpModemConfig(port="/dev/ttyS0", **options).check_with(platform(LEAD))
