"""uuv_modem with the paper's link: every frame into the water, in order, once, whatever happens."""

from __future__ import annotations

import json
import math
import os

import msgpack
import pytest
from builders.common import eventually
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost import keys
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.errors import ConfigError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.messages import AcousticFrame, Contact, EncodedImage
from sonarpost.modem.micromodem import RATES, nmea
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService, summary_of
from sonarpost.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.simulation.channel.emulator import ChannelEmulator

IN, TX, RX = keys.image_encoded("uuv-1"), keys.acoustic_tx("uuv-1"), keys.acoustic_rx("vessel-1")
CONTACT = Contact(contact_id="c", vehicle_id="uuv-1", lat_deg=56.4, lon_deg=-5.6, atd_confidence=1.5, channel="port")


@pytest.fixture
def begin(runner, platform, modem_pair):
    def start(**options):
        usual = {"port": modem_pair.port(modem_pair.VEHICLE), "link": "paper", "rate": 1, "retry_s": 0.05}
        return runner.start(UuvModemService(platform("uuv-1"), UuvModemConfig(**(usual | options))))

    return start


@pytest.fixture
def compressor(runner):
    return runner.peer("uuv-1", "compressor")


@pytest.fixture
def ears(runner, platform, modem_pair):
    """The vessel's modem and what it hears: the list of frames in their order."""
    hearer = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
    service = runner.start(OpModemService(platform("vessel-1"), OpModemConfig(port=modem_pair.port(modem_pair.VESSEL))))
    return lambda: service.modem.ready, hearer.received


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


@pytest.mark.parametrize("rate", [0, 1, 4, 5])
def test_frames_arrive_byte_for_byte_at_every_rate(rate, modem_pair, begin, compressor, ears, encoded, watch):
    modem_pair.start()
    ready, heard = ears
    seen = watch(TX)
    eventually(ready)
    service = begin(rate=rate)
    image = encoded(height_px=80, width_px=100)
    compressor.send(IN, "uuv_modem", image)
    frames = flat(planned(image, rate))
    eventually(lambda: len(heard) == len(frames))
    assert [f.data for f in heard] == frames
    assert {(f.source, f.destination, f.direction) for f in heard} == {(3, 1, "rx")}
    assert [f.frame_number for f in heard] == [n for p in planned(image, rate) for n in range(1, len(p) + 1)]
    eventually(lambda: service.health().counters.get("images_sent") == 1)
    counters = service.health().counters
    assert (counters["packets_sent"], counters["frames_sent"]) == (len(planned(image, rate)), len(frames))
    eventually(lambda: len(seen) == len(frames), what="the copies for watchers")
    shown = [msgpack.unpackb(s.payload.to_bytes()) for s in seen]
    assert [s["data"] for s in shown] == frames
    assert {(s["direction"], s["rate"]) for s in shown} == {("tx", rate)}


def test_it_tells_that_it_lives(modem_pair, begin, check_monitoring):
    modem_pair.start()
    service = begin()
    eventually(lambda: service.health().state == "ok")
    assert service.health().gauges["modem_ready"] == 1.0
    check_monitoring(service)


def test_images_go_in_the_order_of_their_arrival(modem_pair, begin, compressor, ears, encoded):
    modem_pair.start()
    ready, heard = ears
    eventually(ready)
    service = begin(rate=5)
    images = [encoded(f"{n:04d}") for n in range(4)]
    compressor.send(IN, "uuv_modem", *images)
    eventually(lambda: service.health().counters.get("images_sent") == 4)
    eventually(lambda: len(heard) == sum(len(flat(planned(i, 5))) for i in images))
    assert [f.data for f in heard] == [frame for i in images for frame in flat(planned(i, 5))]


def test_a_stop_in_the_middle_goes_on_with_the_next_packet(modem_pair, begin, runner, compressor, ears, encoded):
    modem_pair.start()
    ready, heard = ears
    eventually(ready)
    service = begin(rate=0)
    image = encoded(height_px=100, width_px=160)
    packets = planned(image, 0)
    assert len(packets) > 12
    compressor.send(IN, "uuv_modem", image)
    eventually(lambda: service.store.get_state("progress") is not None)
    eventually(lambda: len(heard) >= 4)
    runner.stop(service)
    assert 0 < len(heard) < len(packets), "stopped in the middle"
    again = begin(rate=0)
    eventually(lambda: again.health().counters.get("images_sent") == 1)
    eventually(lambda: [f.data for f in heard][-1] == packets[-1][0])
    data = [f.data for f in heard]
    assert list(dict.fromkeys(data)) == list(dict.fromkeys(flat(packets)))
    # At most the one packet that was under way when the process stopped went twice.
    assert len(data) - len(packets) in (0, 1)
    assert again.store.get_state("progress") is None


def test_progress_at_another_rate_is_no_progress(modem_pair, begin, runner, compressor, ears, encoded):
    modem_pair.start()
    ready, heard = ears
    eventually(ready)
    service = begin(rate=0)
    image = encoded(height_px=100, width_px=160)
    compressor.send(IN, "uuv_modem", image)
    eventually(lambda: len(heard) >= 3)
    runner.stop(service)
    before = len(heard)
    again = begin(rate=5)
    eventually(lambda: again.health().counters.get("images_sent") == 1)
    frames = flat(planned(image, 5))
    eventually(lambda: [f.data for f in heard][-len(frames) :] == frames)
    assert len(heard) <= before + 1 + len(frames)


def test_progress_counts_for_the_same_image_sent_the_same_way_only(platform, modem_pair, encoded):
    image = encoded()
    kept = {"image_id": "0001", "rate": 1, "of": 2, "done": 1}
    for changed, done in (({}, 1), ({"rate": 5}, 0), ({"of": 3}, 0), ({"image_id": "0002"}, 0)):
        service = UuvModemService(
            platform("uuv-1"), UuvModemConfig(port=modem_pair.port(modem_pair.VEHICLE), link="paper", rate=1)
        )
        with service.store.transaction() as tx:
            tx.put_state("progress", msgpack.packb(kept | changed))
        assert service._packets_done(image, 2) == done, changed
        service.store.close()


def test_a_port_that_is_not_there_is_named_and_used_when_it_comes(modem_pair, begin, compressor, encoded):
    service = begin()
    compressor.send(IN, "uuv_modem", encoded())
    eventually(lambda: modem_pair.port(modem_pair.VEHICLE) in service.health().detail)
    assert (service.health().state, service.health().gauges["modem_ready"]) == ("degraded", 0.0)
    eventually(lambda: service.store.inbox_depth() == 1, what="the image in the store")
    modem_pair.start()
    eventually(lambda: service.health().state == "ok")
    eventually(lambda: service.health().counters.get("images_sent") == 1)


def test_a_port_that_goes_away_in_the_middle_costs_no_frame(modem_pair, begin, compressor, encoded, ears):
    channel = modem_pair.start()
    ready, heard = ears
    eventually(ready)
    service = begin(rate=0)
    image = encoded(height_px=100, width_px=160)
    compressor.send(IN, "uuv_modem", image)
    eventually(lambda: len(heard) >= 3)
    assert channel.totals().transmitted >= 3
    modem_pair.stop()
    eventually(lambda: modem_pair.port(modem_pair.VEHICLE) in service.health().detail)
    modem_pair.start()
    eventually(lambda: service.health().counters.get("images_sent") == 1)
    assert service.health().counters["packets_failed"] >= 1
    assert service.health().counters["packets_sent"] == len(planned(image, 0))


def test_garbage_on_the_line_is_counted_and_harms_nothing(modem_pair, begin, serial_cable, compressor, encoded, ears):
    modem_pair.start()
    ready, heard = ears
    eventually(ready)
    line = serial_cable(modem_pair.port(modem_pair.VEHICLE))
    service = begin(port=line.port)
    eventually(lambda: service.modem.ready)
    line.say(b"\x00\xff" * 500 + b"\r\n$CA\r\n$CATXF,*00\r\n$CACYC,1,2*FF\r\n" + nmea.format("CATXF", "x"))
    eventually(lambda: service.health().counters.get("sentences_rejected", 0) >= 3)
    image = encoded()
    compressor.send(IN, "uuv_modem", image)
    eventually(lambda: [f.data for f in heard] == flat(planned(image)))
    assert service.health().state == "ok"


def test_a_modem_that_says_nothing_is_named(begin, serial_cable):
    line = serial_cable(None)
    service = begin(port=line.port, reply_timeout_s=0.05)
    eventually(lambda: service.health().counters.get("modem_unresponsive", 0) >= 1)
    health = service.health()
    assert health.state == "degraded"
    assert health.detail.startswith(f"{line.port}: no valid reply to ")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"stream": b"\x10\x00"}, "stream"),
        ({"stream": b"\xee" * 20}, "stream"),
        ({"height_px": 700}, "height_px: got 700"),
        ({"image_id": "abcd"}, "image_id"),
    ],
)
def test_an_image_that_can_never_be_sent_is_refused_to_its_sender(
    change, said, begin, compressor, encoded, refused, modem_pair, ears
):
    from sonarpost import wire

    modem_pair.start()
    service = begin(rate=5)
    bad = msgpack.packb(msgpack.unpackb(wire.encode(encoded())) | change)
    compressor.send_bytes(IN, "uuv_modem", bad)
    eventually(lambda: len(refused(compressor)) == 1)
    assert said in refused(compressor)[0][1]
    assert refused(service) == refused(compressor)
    compressor.send(IN, "uuv_modem", encoded())
    eventually(lambda: service.health().counters.get("images_sent") == 1)


def test_a_port_of_no_known_kind_is_said_before_anything_is_opened(platform):
    with pytest.raises(ConfigError, match="gopher://sea"):
        UuvModemService(platform("uuv-1"), UuvModemConfig(port="gopher://sea"))
    assert not (platform("uuv-1").state_dir / "uuv_modem.db").exists()


def finite(low, high):
    return st.none() | st.floats(low, high)


CONTACTS = st.builds(
    Contact,
    contact_id=st.just("c"),
    vehicle_id=st.just("uuv-1"),
    channel=st.sampled_from([None, "port", "starboard"]),
    time_utc_s=finite(0, 253402300799),
    lat_deg=finite(-90, 90),
    lon_deg=finite(-180, 180),
    position_sigma_m=finite(0, 20000),
    depth_m=finite(-100, 12000),
    altitude_m=finite(0, 20000),
    heading_deg=st.none() | st.floats(0, 360, exclude_max=True),
    ground_range_m=finite(0, 20000),
    atd_confidence=finite(0, 2),
    pixel_along_m=st.none() | st.floats(0, 100, exclude_min=True),
    pixel_across_m=st.none() | st.floats(0, 100, exclude_min=True),
)


@settings(max_examples=300, deadline=None)
@given(contact=CONTACTS, height_px=st.integers(16, 512), width_px=st.integers(16, 512))
def test_every_contact_that_can_be_has_a_record_on_the_link(contact, height_px, width_px):
    record = ContactSummary.unpack(summary_of(contact, height_px, width_px).pack())
    assert (record.height_px, record.width_px) == (height_px, width_px)
    both = contact.lat_deg is not None and contact.lon_deg is not None
    assert (record.lat_deg is not None) == both
    if both:
        assert math.isclose(record.lat_deg, contact.lat_deg, abs_tol=1e-7)
    if contact.time_utc_s is None or contact.time_utc_s > 0xFFFFFFFE:
        assert record.time_utc_s is None
    else:
        assert abs(record.time_utc_s - contact.time_utc_s) <= 0.5


def busy_fraction(log):
    """Part of the time from the first packet's start to the last one's end in which a packet was in the water."""
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    sent = [(line["transmitted_s"], line["airtime_s"]) for line in lines if line["event"] == "packet"]
    end_s = max(start_s + airtime_s for start_s, airtime_s in sent)
    return len(sent), sum(airtime_s for _, airtime_s in sent) / (end_s - min(start_s for start_s, _ in sent))


def test_the_water_is_kept_busy_at_rate_5(tmp_path, runner, platform, compressor, encoded):
    # In real time, as what is measured is what the host needs between packets. SONARPOST_BUSY_IMAGES=7 measures 21 full
    # packets, SONARPOST_BUSY_BAUD=19200 a serial line that takes its time.
    baud = float(os.environ.get("SONARPOST_BUSY_BAUD", "0")) or None
    images = [encoded(f"{n:04d}", 420, 500) for n in range(int(os.environ.get("SONARPOST_BUSY_IMAGES", "1")))]
    images.append(encoded("LAST"))
    assert [len(packet) for packet in planned(images[0], 5)] == [1, 8, 8], "full packets, the hardest to fill"
    log = tmp_path / "water.jsonl"
    modems = (ModemSite(address=1), ModemSite(address=3, east_m=150.0))
    ports = tmp_path / "ports"
    channel = ChannelEmulator(EmulatorConfig(modem=modems, pty_dir=ports, serial_baud=baud or 0.0, log=log))
    channel.start()
    try:
        service = runner.start(
            UuvModemService(platform("uuv-1"), UuvModemConfig(port=str(ports / "modem-2"), link="paper", rate=5))
        )
        eventually(lambda: service.modem.ready)
        compressor.send(IN, "uuv_modem", *images)
        eventually(lambda: service.health().counters.get("images_sent") == len(images), timeout_s=120.0)
        runner.stop(service)
    finally:
        channel.stop()
    packets, busy = busy_fraction(log)
    print(f"{packets} packets, air time {100 * busy:.1f} % busy")
    assert packets == sum(len(planned(image, 5)) for image in images)
    assert baud or busy >= 0.95
