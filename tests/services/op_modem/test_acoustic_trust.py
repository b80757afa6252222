"""op_modem with the shipped configuration, set up by the documentation: frames without the key change nothing."""

from random import Random

import pytest
from builders.acoustic_attack import attack, forged_contact, forgeries, genuine_frames, run, set_up, shipped
from builders.common import eventually
from builders.vessel_frames import CONTACT, packet

from sonarpost import keys
from sonarpost.config import PlatformConfig
from sonarpost.errors import ConfigError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.messages import ReceivedMessage
from sonarpost.security.acoustic_key import link_key
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.op_modem.vessel_endpoint import VesselLink
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService

VESSEL = "vessel-1"
MESSAGE = keys.message_received(VESSEL)


@pytest.fixture(scope="module")
def key_file(tmp_path_factory):
    """The key of a fleet that the documented commands set up."""
    return set_up(tmp_path_factory.mktemp("fleet"))


@pytest.fixture
def key(key_file):
    found = link_key(shipped(key_file)[0])
    assert found is not None
    return found


@pytest.fixture
def begin(runner, router, tmp_path, modem_pair, key_file):
    """Start op_modem with config/vessel.toml; only addresses and folders are those of the test."""

    def start(**environment):
        environment = {
            "SONARPOST_PLATFORM__ROUTER": f'["{router}"]',
            "SONARPOST_PLATFORM__STATE_DIR": str(tmp_path / "state"),
            "SONARPOST_PLATFORM__HEALTH_INTERVAL_S": "0.1",
            "SONARPOST_OP_MODEM__PORT": modem_pair.port(modem_pair.VESSEL),
            **environment,
        }
        return runner.start(OpModemService(*shipped(key_file, **environment)))

    return start


def test_service_with_the_shipped_configuration_rejects_every_kind_of_forgery_and_every_replay(
    begin, decompressor, complete, key, runner
):
    messages = runner.peer(VESSEL, "autonomy", {MESSAGE: ReceivedMessage})
    service = begin(SONARPOST_OP_MODEM__MESSAGE_CONSUMERS='["autonomy"]')
    images = set(range(1, 13))
    genuine = genuine_frames(key, len(images))
    for data in genuine:
        service.on_modem_event(packet(data))
    eventually(lambda: complete() == images)
    before = (len(decompressor.received), service.health().counters["images_received"])
    forged = forgeries(Random(7))
    for _ in range(160):
        service.on_modem_event(packet(next(forged)))
    assert len(genuine) >= 70
    for data in genuine:
        service.on_modem_event(packet(data))
        service.on_modem_event(packet(data, src=4))
    health = service.health()
    assert health.counters["frames_rejected"] == 160 + 2 * len(genuine)
    assert health.gauges["frames_replayed"] == len(genuine)
    assert health.counters["messages_received"] == 0
    assert (len(decompressor.received), health.counters["images_received"]) == before
    assert messages.received == []
    assert {image.authenticated for image in decompressor.received} == {True}
    assert health.gauges["unauthenticated"] == 0.0
    assert "unauthenticated" not in health.detail


@pytest.mark.parametrize("frames", [800, pytest.param(100_000, marks=pytest.mark.system)])
def test_documented_deployment_accepts_no_forged_and_no_replayed_frame(frames, key_file):
    found = run(key_file, frames, used_counters=1_044_000)
    assert (found["forged"], found["forged_accepted"], found["replays_accepted"]) == (frames, 0, 0)
    assert found["replays"] >= 468


def test_attack_succeeds_without_authentication(key_file):
    """Shows that the attack of this file is one: without a key the same frames are accepted."""
    platform, config = shipped(key_file, SONARPOST_PLATFORM__ACOUSTIC_AUTH="none")
    link = VesselLink(platform.id, config)
    found = attack(link, 80, [])
    assert found["forged_accepted"] >= 30


@pytest.mark.parametrize(
    ("service", "config"), [(OpModemService, OpModemConfig), (UuvModemService, UuvModemConfig)], ids=["vessel", "uuv"]
)
def test_service_without_a_key_names_the_field_and_the_command(service, config, tmp_path):
    bare = PlatformConfig(id="vessel-1", state_dir=tmp_path)
    with pytest.raises(ConfigError, match=r"acoustic_key_file: got 'nothing'.*sonarpost pki acoustic.*acoustic_auth"):
        service(bare, config(port="unused"))
    missing = bare.model_copy(update={"acoustic_key_file": tmp_path / "acoustic.key"})
    with pytest.raises(ConfigError, match=r"acoustic_key_file: got 'No such file.*sonarpost pki acoustic"):
        service(missing, config(port="unused"))
    assert list(tmp_path.iterdir()) == []  # no store was opened


def test_paper_format_requires_an_explicit_choice(tmp_path, key_file):
    there = PlatformConfig(id="uuv-1", state_dir=tmp_path, acoustic_key_file=key_file)
    with pytest.raises(ConfigError, match=r"link: got 'paper'.*acoustic_auth"):
        UuvModemService(there, UuvModemConfig(port="unused", link="paper"))
    with pytest.raises(ConfigError, match=r"wire_formats.*acoustic_auth"):
        OpModemService(there, OpModemConfig(port="unused", link="paper", wire_formats=("paper",)))


def test_unauthenticated_link_is_visible_in_log_health_and_records(begin, decompressor, runner, caplog):
    messages = runner.peer(VESSEL, "autonomy", {MESSAGE: ReceivedMessage})
    service = begin(SONARPOST_PLATFORM__ACOUSTIC_AUTH="none", SONARPOST_OP_MODEM__MESSAGE_CONSUMERS='["autonomy"]')
    assert sum("unauthenticated" in record.message for record in caplog.records) == 1
    forged = forgeries(Random(7))
    for _ in range(8):
        service.on_modem_event(packet(next(forged)))
    eventually(lambda: decompressor.received and messages.received)
    assert {record.authenticated for record in (*decompressor.received, *messages.received)} == {False}
    health = service.health()
    assert health.gauges["unauthenticated"] == 1.0
    assert "acoustic_auth" not in health.detail, "a setting is not the cause of a fault"


def test_images_that_began_before_authentication_was_switched_on_stay_unauthenticated(
    begin, decompressor, complete, runner, key
):
    first = begin(SONARPOST_PLATFORM__ACOUSTIC_AUTH="none")
    first.on_modem_event(packet(forged_contact(1)))
    eventually(lambda: len(decompressor.received) == 1)
    runner.stop(first)
    frames = genuine_frames(key, 2)  # image 1 has the number and the contact record of the forged one
    for part in (frames[: len(frames) // 2], frames[len(frames) // 2 :]):
        service = begin()
        for data in part:
            service.on_modem_event(packet(data))
        runner.stop(service)
    begin()
    eventually(lambda: complete() == {1, 2})
    by_image = {
        name: {i.authenticated for i in decompressor.received if i.image_id == name} for name in ("0001", "0002")
    }
    assert by_image == {"0001": {False}, "0002": {True}}


def test_symbols_received_without_authentication_are_deleted(begin, runner):
    sender = V1Sender(SenderConfig(frame_bytes=64, channels=(LossChannel(0.3),), frames_per_image=6))
    sender.add_image(1, CONTACT, b"\x20" + bytes(150), 0.0)
    service = begin(SONARPOST_PLATFORM__ACOUSTIC_AUTH="none")
    for _ in range(2):
        service.on_modem_event(packet(sender.next_frame(0.0)))
    runner.stop(service)
    names = lambda service: [n for n in service.store.state_names("vehicle/link/v1/") if "symbols/" in n]  # noqa: E731
    again = begin(SONARPOST_PLATFORM__ACOUSTIC_AUTH="none")
    assert names(again)
    runner.stop(again)
    assert not names(begin())
