"""Bytes that a service writes into its store for each frame or image: they do not grow with the number of contacts."""

import sqlite3

import pytest
from builders.common import eventually
from builders.records import encoded_image
from builders.vessel_frames import CONTACT, packet, preview_frame, received

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import CodedImage, ReceivedImage
from sonarpost.modem.interface import FrameDecoded
from sonarpost.runtime.saved_endpoint import SavedEndpoint
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService
from sonarpost.services.uuv_modem.vehicle_endpoint import VehicleEndpoint

VESSEL = "vessel-1"
ITEMS, CONTACTS = 20, 725


def written_bytes(store, action):
    """Return the bytes that SQLite appends to the write-ahead log of a store during `action`."""
    connection = sqlite3.connect(store.path)
    assert connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone() == (0, 0, 0)
    connection.close()
    action()
    return store.path.with_name(f"{store.path.name}-wal").stat().st_size


@pytest.mark.parametrize(("frames_in_packet", "delivered"), [(3, True), (1, False)])
def test_frame_received_by_op_modem(runner, platform, modem_pair, frames_in_packet, delivered):
    """Every frame of 60 bytes starts a new image, which is delivered to the decompressor if there is one."""
    consumers = ("decompressor",) if delivered else ()
    config = OpModemConfig(port=modem_pair.port(modem_pair.VESSEL), image_consumers=consumers)
    service = runner.start(OpModemService(platform(VESSEL), config))
    if delivered:
        runner.peer(VESSEL, "decompressor", {keys.acoustic_image(VESSEL): ReceivedImage})

    def receive(number):
        frames = [received(preview_frame(number + n, 12, 64), n + 1) for n in range(frames_in_packet)]
        for frame in frames:
            service.on_modem_event(FrameDecoded(frame))
        service.on_modem_event(packet(*frames))
        eventually(lambda: service.store.outbox_depth() == 0)

    def written_per_frame(first):
        numbers = range(first, first + frames_in_packet * ITEMS, frames_in_packet)
        # One packet at a time: the commits of a delivery depend on how many images wait.
        total = sum(written_bytes(service.store, lambda n=n: receive(n)) for n in numbers)
        return total / (frames_in_packet * ITEMS)

    receive(1)
    few = written_per_frame(1000)
    for number in range(2, CONTACTS):
        service.on_modem_event(packet(preview_frame(number, 12, 64), src=3 + number % 2))
    eventually(lambda: service.store.outbox_depth() == 0)
    many = written_per_frame(2000)
    assert service.health().gauges["images_incomplete"] > CONTACTS
    assert max(few, many) <= 8192
    assert many <= 1.5 * few


def test_frame_sent_by_uuv_modem(tmp_path):
    store = Store(tmp_path / "uuv_modem.db", page_bytes=UuvModemService.PAGE_BYTES)
    link = SavedEndpoint(store, "link/", lambda: VehicleEndpoint("uuv-1", UuvModemConfig(port="unused", rate=1)))

    def commit():
        with store.transaction() as tx:
            link.changes().write(tx)

    def add_images(first, last):
        with link.step() as endpoint:
            for number in range(first, last + 1):
                endpoint.add(encoded_image(number, 500), 0.0)
            commit()

    def send(now):
        with link.step() as endpoint:
            frames = endpoint.next_packet(now).frames
            commit()
        with link.step() as endpoint:
            endpoint.packet_sent(frames, 6.0)
            commit()
        return len(frames)

    def written_per_frame(start_s):
        frames = []
        times = [start_s + 6.0 * n for n in range(ITEMS)]
        return written_bytes(store, lambda: frames.extend(map(send, times))) / sum(frames)

    add_images(1, 10)
    few = written_per_frame(10.0)
    add_images(11, CONTACTS)
    many = written_per_frame(1000.0)
    assert link.current.queue.images_waiting > CONTACTS - 30
    assert max(few, many) <= 4096
    assert many <= 1.5 * few
    store.close()


def test_image_decoded_by_the_decompressor(runner, platform, tmp_path):
    service = runner.start(DecompressorService(platform(VESSEL), DecompressorConfig(out_dir=tmp_path / "out")))
    op_modem = runner.peer(VESSEL, "op_modem")
    relay = runner.peer(VESSEL, "relay", {keys.image_coded(VESSEL): CodedImage})

    def contact_only(number):
        update = ImageUpdate(3, image_of_number(number), 1, CONTACT, b"", (), False, 0, 0, 1, 0, 1.7e9, 1.7e9)
        return received_image(update, VESSEL, "uuv-1")

    def process(numbers):
        expected = len(relay.received) + len(numbers)
        op_modem.send(keys.acoustic_image(VESSEL), "decompressor", *map(contact_only, numbers))
        eventually(lambda: len(relay.received) == expected)
        eventually(lambda: service.store.outbox_depth() + service.store.inbox_depth() == 0)

    def written_per_image(first):
        return written_bytes(service.store, lambda: [process([n]) for n in range(first, first + ITEMS)]) / ITEMS

    process([1])
    few = written_per_image(10)
    process(range(100, 100 + CONTACTS // 5))
    many = written_per_image(2000)
    record_bytes = len(wire.encode(contact_only(1))) + len(wire.encode(relay.received[0]))
    assert few - record_bytes <= 8192
    assert abs(many - few) <= 1024, "two pages: the table of accepted records has one more level"
