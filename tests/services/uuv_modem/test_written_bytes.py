"""uuv_modem: bytes written into the store for each transmitted frame."""

from __future__ import annotations

from builders.records import encoded_image
from builders.written_bytes import written_bytes

from sonarpost.runtime.service import UnitOfWork
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService

PACKETS = 20
MAX_BYTES = 4096
INTERVAL_S = 6.0


def test_written_bytes_of_a_frame_do_not_depend_on_the_length_of_the_queue(platform):
    service = UuvModemService(platform("uuv-1"), UuvModemConfig(port="socket://127.0.0.1:1", rate=1))
    endpoint = service._endpoint

    def add_images(first: int, last: int) -> None:
        with endpoint.step():
            for number in range(first, last + 1):
                endpoint.add(encoded_image(number, 500), 0.0)
            service.commit(UnitOfWork())

    def send(now: float) -> int:
        with endpoint.step():
            packet = endpoint.next_packet(now)
            assert packet is not None
            service.commit(UnitOfWork())
        with endpoint.step():
            endpoint.packet_sent(packet.frames, INTERVAL_S)
            service.commit(UnitOfWork())
        return len(packet.frames)

    def written_per_frame(start_s: float) -> float:
        frames: list[int] = []
        times = [start_s + n * INTERVAL_S for n in range(PACKETS)]
        total = written_bytes(service.store, lambda: frames.extend(map(send, times)))
        return total / sum(frames)

    add_images(1, 10)
    few = written_per_frame(10.0)
    add_images(11, 735)
    many = written_per_frame(1000.0)
    service.stop()
    assert endpoint.queue.images_waiting > 700
    assert few <= MAX_BYTES
    assert many <= MAX_BYTES
    assert many <= 1.5 * few
