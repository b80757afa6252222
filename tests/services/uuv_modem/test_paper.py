"""uuv_modem with the `paper` wire format: every frame is sent in order and once, also after restarts and faults."""

import json
import math

import msgpack
import pytest
from builders.common import eventually
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys, wire
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.link.frames.contact_record import ContactSummary, summary_of
from sonarpost.link.frames.paper.frame import parse_frame
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.messages import AcousticFrame, Contact, EncodedImage
from sonarpost.modem.interface import PacketSent
from sonarpost.modem.micromodem import RATES, MicroModem, MicroModemConfig
from sonarpost.runtime.modem_runner import ModemRunner
from sonarpost.runtime.serial_port import SerialPort
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService

IN, TX, RX = keys.image_encoded("uuv-1"), keys.acoustic_tx("uuv-1"), keys.acoustic_rx("vessel-1")
CONTACT = Contact(contact_id="c", vehicle_id="uuv-1", lat_deg=56.4, lon_deg=-5.6, atd_confidence=1.5, channel="port")


@pytest.fixture
def start_service(start_service):
    """Start uuv_modem, by default with the `paper` format."""
    return lambda **options: start_service(**({"link": "paper"} | options))


@pytest.fixture
def received(runner, start_vessel, modem_pair):
    """The frames that the vessel's modem received, in their order; the modems run."""
    modem_pair.start()
    receiver = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
    service = start_vessel()
    eventually(lambda: service.modem.ready)
    return receiver.received


@pytest.fixture(scope="session")
def vq():
    return default_registry().create("vq", CodecResources(open_codebook("nominal-10").tiles))


@pytest.fixture
def encoded(vq, texture):
    def make(image_id="0001", height_px=40, width_px=60, contact=CONTACT):
        return EncodedImage(
            vehicle_id="uuv-1",
            image_id=image_id,
            contact=contact,
            codec="vq",
            model=vq.model_hash,
            height_px=height_px,
            width_px=width_px,
            stream=vq.encode(texture(height_px, width_px)),
            original_sha256="0" * 64,
        )

    return make


def planned(image, rate=1):
    summary = summary_of(image.contact, image.height_px, image.width_px)
    return plan_packets(image.image_id, image.stream, summary, RATES[rate].frames, RATES[rate].frame_bytes)


def flat(packets):
    return [frame for packet in packets for frame in packet]


@pytest.mark.parametrize("rate", [0, 5])
def test_frames_arrive_byte_for_byte_at_every_rate(rate, received, start_service, compressor, encoded, watch):
    seen = watch(TX)
    service = start_service(rate=rate)
    image = encoded(height_px=80, width_px=100)
    compressor.send(IN, "uuv_modem", image)
    frames = flat(planned(image, rate))
    eventually(lambda: len(received) == len(frames))
    assert [f.data for f in received] == frames
    assert {(f.source, f.destination, f.direction) for f in received} == {(3, 1, "rx")}
    assert [f.frame_number for f in received] == [n for p in planned(image, rate) for n in range(1, len(p) + 1)]
    eventually(lambda: service.health().counters.get("images_sent") == 1)
    counters = service.health().counters
    assert (counters["packets_sent"], counters["frames_sent"]) == (len(planned(image, rate)), len(frames))
    eventually(lambda: len(seen) == len(frames), what="the copies for observers")
    published = [msgpack.unpackb(s.payload.to_bytes()) for s in seen]
    assert [s["data"] for s in published] == frames
    assert {(s["direction"], s["rate"]) for s in published} == {("tx", rate)}


def test_images_are_sent_in_order_of_arrival(received, start_service, compressor, encoded):
    service = start_service(rate=5)
    images = [encoded(f"{n:04d}") for n in range(4)]
    compressor.send(IN, "uuv_modem", *images)
    eventually(lambda: service.health().counters.get("images_sent") == 4)
    eventually(lambda: len(received) == sum(len(flat(planned(i, 5))) for i in images))
    assert [f.data for f in received] == [frame for i in images for frame in flat(planned(i, 5))]


def test_restart_during_an_image_continues_with_the_next_packet(received, start_service, runner, compressor, encoded):
    service = start_service(rate=0)
    image = encoded(height_px=100, width_px=160)
    packets = planned(image, 0)
    assert len(packets) > 12
    compressor.send(IN, "uuv_modem", image)
    eventually(lambda: len(received) >= 4)
    runner.stop(service)
    assert 0 < len(received) < len(packets), "stopped in the middle"
    again = start_service(rate=0)
    eventually(lambda: again.health().counters.get("images_sent") == 1)
    eventually(lambda: [f.data for f in received][-1] == packets[-1][0])
    data = [f.data for f in received]
    assert list(dict.fromkeys(data)) == list(dict.fromkeys(flat(packets)))
    # Only the packet in flight at the stop can be sent twice.
    assert len(data) - len(packets) in (0, 1)
    assert again.store.state_names("link/paper/queue/image/") == ()


def test_image_is_sent_from_its_beginning_after_a_change_of_rate(received, start_service, runner, compressor, encoded):
    service = start_service(rate=0)
    image = encoded(height_px=100, width_px=160)
    compressor.send(IN, "uuv_modem", image)
    eventually(lambda: len(received) >= 3)
    runner.stop(service)
    before = len(received)
    again = start_service(rate=5)
    eventually(lambda: again.health().counters.get("images_sent") == 1)
    frames = flat(planned(image, 5))
    eventually(lambda: [f.data for f in received][-len(frames) :] == frames)
    assert len(received) <= before + 1 + len(frames)


def test_health_names_an_absent_port_and_the_image_is_sent_when_it_appears(
    modem_pair, start_service, compressor, encoded
):
    service = start_service()
    compressor.send(IN, "uuv_modem", encoded())
    eventually(lambda: modem_pair.port(modem_pair.VEHICLE) in service.health().detail)
    assert (service.health().state, service.health().gauges["modem_ready"]) == ("degraded", 0.0)
    eventually(lambda: service.health().gauges["images_waiting"] == 1.0, what="the image in the queue")
    modem_pair.start()
    eventually(lambda: service.health().state == "ok")
    eventually(lambda: service.health().counters.get("images_sent") == 1)


def test_loss_of_the_port_during_an_image_loses_no_packet(modem_pair, received, start_service, compressor, encoded):
    service = start_service(rate=0)
    image = encoded(height_px=100, width_px=160)
    compressor.send(IN, "uuv_modem", image)
    eventually(lambda: len(received) >= 3)
    modem_pair.stop()
    eventually(lambda: modem_pair.port(modem_pair.VEHICLE) in service.health().detail)
    modem_pair.start()
    eventually(lambda: service.health().counters.get("images_sent") == 1)
    assert service.health().counters["packets_failed"] >= 1
    assert service.health().counters["packets_sent"] == len(planned(image, 0))


def test_health_names_the_port_of_a_silent_modem(start_service, serial_cable):
    cable = serial_cable(None)
    service = start_service(port=cable.port, reply_timeout_s=0.05)
    eventually(lambda: service.health().counters.get("modem_unresponsive", 0) >= 1)
    health = service.health()
    assert health.state == "degraded"
    assert health.detail.startswith(f"{cable.port}: no valid reply to ")


@pytest.mark.parametrize("link", ["paper", "v1"])
def test_invalid_images_are_refused_to_their_sender(link, start_service, compressor, encoded, refused, modem_pair):
    changes = [
        ({"stream": b"\x10\x00"}, "stream"),
        ({"stream": b"\xee" * 20}, "stream"),
        ({"height_px": 700}, "height_px"),
        ({"image_id": "abcd"}, "image_id"),
    ]
    modem_pair.start()
    service = start_service(rate=5, link=link)
    for change, _ in changes:
        bad = msgpack.packb(msgpack.unpackb(wire.encode(encoded())) | change)
        compressor.send_bytes(IN, "uuv_modem", bad)
    compressor.send(IN, "uuv_modem", encoded())
    eventually(lambda: service.health().counters.get("images_sent") == 1)
    assert refused(service) == refused(compressor)
    for (_, reason), (_, expected) in zip(refused(compressor), changes, strict=True):
        assert expected in reason


def test_class_of_contacts_is_sent(received, start_service, compressor, encoded):
    start_service()
    changes = {"atd_class": "structure", "p_mine_like": 0.05, "p_other_object": 0.9}
    compressor.send(IN, "uuv_modem", encoded(contact=CONTACT.model_copy(update=changes)))
    eventually(lambda: any(frame.data[:1] == b"C" for frame in received))
    frame = parse_frame(next(frame.data for frame in received if frame.data[:1] == b"C"))
    sent = (frame.contact.atd_class, frame.contact.p_mine_like, frame.contact.p_other_object)
    assert sent == ("structure", 0.05, 0.9)


def test_unsupported_port_is_an_error_before_the_store_is_opened(platform):
    with pytest.raises(ConfigError, match="gopher://sea"):
        UuvModemService(platform("uuv-1"), UuvModemConfig(port="gopher://sea"))
    assert not (platform("uuv-1").state_dir / "uuv_modem.db").exists()


RANGES = {
    "time_utc_s": (0, 253402300799),
    "lat_deg": (-90, 90),
    "lon_deg": (-180, 180),
    "position_sigma_m": (0, 20000),
    "depth_m": (-100, 12000),
    "altitude_m": (0, 20000),
    "heading_deg": (0, 359.9),
    "ground_range_m": (0, 20000),
    "atd_confidence": (0, 2),
    "pixel_along_m": (1e-9, 100),
    "pixel_across_m": (1e-9, 100),
}
CONTACTS = st.builds(
    Contact,
    contact_id=st.just("c"),
    vehicle_id=st.just("uuv-1"),
    channel=st.sampled_from([None, "port", "starboard"]),
    atd_class=st.sampled_from([None, "mine_like", "clutter", "structure", "sphere"]),
    **{name: st.none() | st.floats(*limits) for name, limits in RANGES.items()},
)
SIDES_PX = st.integers(16, 512)


@given(contact=CONTACTS, height_px=SIDES_PX, width_px=SIDES_PX, probabilities=st.none() | st.floats(0, 1))
def test_every_valid_contact_has_a_contact_record(contact, height_px, width_px, probabilities):
    if probabilities is not None:
        changes = {"p_mine_like": probabilities, "p_other_object": 1 - probabilities}
        contact = contact.model_copy(update=changes)
    unclassified = contact.model_copy(update=dict.fromkeys(("atd_class", "p_mine_like", "p_other_object")))
    plain = ContactSummary.unpack(summary_of(unclassified, height_px, width_px).pack())
    assert not plain.is_classified
    record = ContactSummary.unpack(summary_of(contact, height_px, width_px).pack())
    assert (record.height_px, record.width_px) == (height_px, width_px)
    assert record.atd_class == (None if contact.atd_class == "sphere" else contact.atd_class)
    assert (record.p_mine_like is None) == (record.p_other_object is None) == (probabilities is None)
    both = contact.lat_deg is not None and contact.lon_deg is not None
    assert (record.lat_deg is not None) == both
    if both:
        assert math.isclose(record.lat_deg, contact.lat_deg, abs_tol=2.001e-7)
        assert math.isclose(plain.lat_deg, contact.lat_deg, abs_tol=1e-7)
    if contact.time_utc_s is None or contact.time_utc_s > 0xFFFFFFFE:
        assert record.time_utc_s is None
    else:
        assert abs(record.time_utc_s - contact.time_utc_s) <= 0.5


def busy_fraction(log):
    """Return the number of packets, and the share of the time from first to last in which one was transmitted."""
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    sent = [(line["transmitted_s"], line["airtime_s"]) for line in lines if line["event"] == "packet"]
    end_s = max(start_s + airtime_s for start_s, airtime_s in sent)
    return len(sent), sum(airtime_s for _, airtime_s in sent) / (end_s - min(start_s for start_s, _ in sent))


@pytest.mark.system
def test_channel_is_as_busy_at_rate_5_as_the_modem_permits(tmp_path, runner, platform, compressor, encoded):
    """In real time: the host needs little time between packets, compared with the driver alone on this machine."""
    image = encoded(height_px=420, width_px=500)
    packets = planned(image, 5)
    assert [len(packet) for packet in packets] == [1, 8, 8], "full packets, the hardest to fill"

    def transmit(name, send):
        log = tmp_path / f"{name}.jsonl"
        modems = (ModemSite(address=1), ModemSite(address=3, east_m=150.0))
        channel = ChannelEmulator(EmulatorConfig(modem=modems, pty_dir=tmp_path / name, log=log))
        channel.start()
        try:
            send(str(tmp_path / name / "modem-2"))
        finally:
            channel.stop()
        return busy_fraction(log)

    def with_service(port):
        service = runner.start(UuvModemService(platform("uuv-1"), UuvModemConfig(port=port, link="paper", rate=5)))
        eventually(lambda: service.modem.ready)
        compressor.send(IN, "uuv_modem", image)
        eventually(lambda: service.health().counters.get("images_sent") == 1)
        runner.stop(service)

    def with_driver(port):
        events = []
        driver = ModemRunner(MicroModem(MicroModemConfig(3), port), SerialPort(port, 19200), events.append)
        driver.start()
        eventually(lambda: driver.ready)
        for frames in packets:
            driver.send_packet(1, 5, frames)
        eventually(lambda: sum(isinstance(event, PacketSent) for event in events) == len(packets))
        driver.stop()

    count, possible = transmit("driver", with_driver)
    assert transmit("service", with_service)[0] == count == len(packets)
    assert busy_fraction(tmp_path / "service.jsonl")[1] >= possible - 0.1
