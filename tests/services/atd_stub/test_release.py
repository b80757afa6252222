"""atd_stub: release of contacts by the credit of the acoustic transmit queue."""

import os
import random
import subprocess
import sys

import numpy as np
import pytest
from builders.common import REPOSITORY, eventually

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.messages import Contact, Pixels, QueuedImage, QueueState, Snippet
from sonarpost.services.atd_stub.release import RELEASE_EXPIRY_S, PendingContacts, ReleaseCredit
from sonarpost.sonar.image_files import write_tiff


def queue_state(waiting, accepted=None, bytes_left=()):
    images = tuple(
        QueuedImage(image_id=f"{n:04d}", contact_id="c", bytes_left=left, preview_utc_s=None, expected_utc_s=1.0)
        for n, left in enumerate(bytes_left)
    )
    counts = {"messages_waiting": 0, "message_bytes": 0, "images_waiting": waiting, "images_accepted": accepted}
    link = {"rate": 1, "frame_loss": None, "packet_interval_s": 5.0}
    return QueueState(platform_id="uuv-1", time_utc_s=1.0, images=images, **counts, **link)


# Credit


@pytest.fixture
def credit():
    return ReleaseCredit(8)


def test_images_in_the_queue_and_released_contacts_use_credit(credit):
    assert credit.available(0) == 0, "before the first queue state"
    credit.update(queue_state(0, 10), 1000.0)
    assert credit.available(0) == 8
    credit.update(queue_state(3, 10), 1000.0)
    assert credit.available(0) == 5
    credit.released(2, 1000.0)
    assert (credit.available(0), credit.in_flight(0)) == (3, 5)
    credit.update(queue_state(4, 11), 1001.0)
    assert (credit.available(0), credit.in_flight(0)) == (3, 5)
    credit.update(queue_state(5, 12), 1002.0)
    assert credit.in_flight(0) == 5
    credit.update(queue_state(4, 12), 1003.0)
    assert credit.available(0) == 4
    credit.update(queue_state(20, 12), 1003.0)
    assert credit.available(0) == 0


def test_contacts_that_the_compressor_has_not_accepted_use_credit_even_when_their_release_times_expire(credit):
    credit.update(queue_state(0, 0), 1000.0)
    credit.released(6, 1000.0)
    credit.update(queue_state(0, 0), 1000.0 + RELEASE_EXPIRY_S + 1.0)
    assert credit.available(6) == 2
    assert credit.available(0) == 8


def test_images_without_bytes_left_do_not_use_credit(credit):
    credit.update(queue_state(3, 0, bytes_left=(64, 0, 1)), 1000.0)
    assert credit.in_flight(0) == 2
    credit.update(queue_state(503, 0, bytes_left=[1] * 500), 1001.0)
    assert credit.in_flight(0) == 503


def test_a_lost_contact_blocks_its_credit_for_ten_minutes(credit):
    credit.update(queue_state(0, 0), 1000.0)
    credit.released(8, 1000.0)
    credit.update(queue_state(0, 7), 1001.0)
    assert credit.available(0) == 7
    credit.update(queue_state(0, 7), 1000.0 + RELEASE_EXPIRY_S)
    assert credit.available(0) == 7
    credit.update(queue_state(0, 7), 1000.5 + RELEASE_EXPIRY_S)
    assert credit.available(0) == 8


def test_released_contacts_do_not_expire_while_no_queue_state_arrives_and_not_in_the_future(credit):
    credit.update(queue_state(0, 0), 90_000.0)
    credit.released(8, 90_000.0)
    assert credit.available(0) == 0, "the modem service is down; its contacts wait for it"
    credit.update(queue_state(0, 0), 1000.0)
    assert credit.available(0) == 8, "the clock was set back"


def test_a_queue_state_without_a_count_keeps_release_times_until_they_expire(credit):
    credit.update(queue_state(0), 1000.0)
    credit.released(3, 1000.0)
    credit.update(queue_state(3), 1010.0)
    assert credit.available(0) == 2
    credit.update(queue_state(0), 1000.5 + RELEASE_EXPIRY_S)
    assert credit.available(0) == 8


def test_a_replaced_store_resets_the_count(credit):
    credit.update(queue_state(0, 700), 1000.0)
    credit.released(5, 1000.0)
    credit.update(queue_state(0, 0), 1001.0)
    assert credit.available(0) == 3, "these five are still on the way to the new store"
    credit.update(queue_state(5, 5), 1002.0)
    assert credit.available(0) == 3
    credit.update(queue_state(0, 5), 1003.0)
    assert credit.available(0) == 8
    credit.released(5, 1003.0)
    credit.update(queue_state(2, 2), 1004.0)
    assert credit.in_flight(0) == 5


def test_the_credit_is_restored_from_what_the_last_release_stored(credit):
    credit.update(queue_state(2, 40), 1000.0)
    credit.released(5, 1000.0)
    restored = ReleaseCredit(8)
    restored.unpack(credit.pack())
    assert restored.available(0) == 0
    restored.update(queue_state(4, 43), 1005.0)
    assert (restored.in_flight(0), restored.available(0)) == (6, 2)


def test_limit_0_gives_unlimited_credit():
    credit = ReleaseCredit(0)
    assert credit.available(1000) is None
    credit.released(5, 1000.0)
    assert credit.in_flight(0) == 0


# The list of pending contacts


def snippet(name, confidence):
    image = Pixels.from_array(np.full((16, 16), 7, np.uint8))
    return Snippet(contact=Contact(contact_id=name, vehicle_id="uuv-1", atd_confidence=confidence), pixels=image)


def commit(store, effects):
    with store.transaction() as tx:
        effects.write(tx)


BY_PRIORITY = [("c", 1.9), ("a", 1.5), ("d", 1.5), ("e", 1.25), ("b", 0.0), ("f", None), ("g", None)]


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "pending.db")
    yield store
    store.close()


def test_pending_contacts_are_removed_most_confident_first_also_after_a_restart(store):
    pending = PendingContacts(store)
    for name, confidence in sorted(BY_PRIORITY):
        effects = UnitOfWork()
        pending.add(effects, [snippet(name, confidence)])
        commit(store, effects)
    removed = []
    for count in (1, 3, 2, 9):
        effects = UnitOfWork()
        first = pending.remove_first(UnitOfWork(), count)
        payloads = pending.remove_first(effects, count)
        assert payloads == first, "nothing changes without a commit"
        assert len(payloads) == min(count, len(BY_PRIORITY) - len(removed))
        removed += payloads
        commit(store, effects)
        pending.add(UnitOfWork(), [snippet("not committed", 2.0)])
        pending = PendingContacts(store)
        assert len(pending) == len(BY_PRIORITY) - len(removed)
    names = [wire.decode(Snippet, each, "removed").contact.contact_id for each in removed]
    assert names == [name for name, _ in BY_PRIORITY]


# The service


@pytest.fixture
def start_service(start_service):
    return lambda **options: start_service(mode="snippets", **({"max_in_flight": 2} | options))


@pytest.fixture
def put_images(incoming, texture):
    """Image files whose text files have the confidence of the detector, in the order of their names."""

    def put(confidences, first=0):
        for number, confidence in enumerate(confidences, start=first):
            name = f"p{number:03d}"
            (incoming / f"{name}.txt").write_text(f"contact_id: {name}\natd_confidence: {confidence}\n")
            write_tiff(incoming / f".{name}.tiff", texture(seed=number))
            (incoming / f".{name}.tiff").rename(incoming / f"{name}.tiff")

    return put


@pytest.fixture
def modem(client):
    """A modem service of which only the queue states exist."""

    class Modem:
        waiting, accepted = 0, 0

        def publish(self):
            client.put(keys.acoustic_queue("uuv-1"), wire.encode(queue_state(self.waiting, self.accepted)))

        def accept(self, count):
            self.waiting += count
            self.accepted += count
            self.publish()

        def transmit(self, count):
            self.waiting -= count
            self.publish()

    return Modem()


def publish_until(modem, condition):
    eventually(lambda: (modem.publish(), condition())[1])


def test_the_most_confident_contacts_are_released_first_and_never_too_many(
    start_service, compressor, put_images, modem, gauge, counter
):
    confidences = random.Random(3).sample([n / 10 for n in range(20)], 8)
    put_images(confidences)
    service = start_service()
    eventually(lambda: counter(service, "contacts_detected") == 8)
    assert gauge(service, "contacts_waiting") == 8
    assert "8 contacts wait for the first queue_state of uuv_modem" in service.health().detail
    publish_until(modem, lambda: len(compressor.received) == 2)
    eventually(lambda: (gauge(service, "contacts_in_flight"), gauge(service, "contacts_waiting")) == (2, 6))
    assert service.health().state == "ok"
    assert "6 contacts wait for space in the acoustic transmit queue" in service.health().detail
    for number in range(3, 7):
        modem.accept(1)
        modem.transmit(1)
        eventually(lambda number=number: len(compressor.received) >= number)
    # A contact released too early would be before the new one, which is the most confident.
    put_images([2.0], first=8)
    eventually(lambda: counter(service, "contacts_detected") == 9)
    for number in range(7, 10):
        modem.accept(1)
        modem.transmit(1)
        eventually(lambda number=number: len(compressor.received) >= number)
    expected = sorted(confidences, reverse=True)
    assert [s.contact.atd_confidence for s in compressor.received] == [*expected[:6], 2.0, *expected[6:]]


def test_a_full_transmit_queue_holds_contacts_over_a_restart_of_this_service(
    start_service, runner, compressor, put_images, modem, gauge
):
    put_images([1.0])
    service = start_service(max_in_flight=3)
    publish_until(modem, lambda: len(compressor.received) == 1)
    modem.accept(1)
    modem.waiting = 3
    publish_until(modem, lambda: gauge(service, "contacts_in_flight") == 3)
    put_images([0.5, 1.5], first=1)
    eventually(lambda: gauge(service, "contacts_waiting") == 2)
    runner.stop(service)
    service = start_service(max_in_flight=3)
    eventually(lambda: gauge(service, "files_waiting") == 0)
    assert len(compressor.received) == 1, "no queue state has arrived"
    publish_until(modem, lambda: gauge(service, "contacts_in_flight") == 3)
    assert gauge(service, "contacts_waiting") == 2
    modem.transmit(1)
    eventually(lambda: len(compressor.received) == 2)
    modem.accept(1)
    modem.transmit(1)
    eventually(lambda: len(compressor.received) == 3)
    assert [s.contact.atd_confidence for s in compressor.received] == [1.0, 1.5, 0.5]


def test_while_the_compressor_is_down_no_more_than_the_limit_is_released(
    start_service, put_images, modem, gauge, request
):
    put_images([1.0] * 5)
    service = start_service()
    publish_until(modem, lambda: gauge(service, "outbox") == 2)
    publish_until(modem, lambda: gauge(service, "contacts_waiting") == 3)
    compressor = request.getfixturevalue("compressor")
    eventually(lambda: len(compressor.received) >= 2)
    put_images([2.0], first=5)
    eventually(lambda: gauge(service, "contacts_waiting") == 4)
    modem.accepted = 2
    publish_until(modem, lambda: len(compressor.received) >= 4)
    assert [s.contact.contact_id for s in compressor.received][:4] == ["p000", "p001", "p005", "p002"]


def test_limit_0_releases_without_a_queue_state(start_service, compressor, put_images):
    put_images([1.0] * 20)
    start_service(max_in_flight=0)
    eventually(lambda: len(compressor.received) == 20)


def test_a_malformed_queue_state_is_ignored(start_service, compressor, put_images, publish, modem, lines):
    service = start_service()
    publish(keys.acoustic_queue("uuv-1"), b"\xc1")
    eventually(lambda: lines("Ignoring malformed queue state"))
    put_images([1.0])
    publish_until(modem, lambda: len(compressor.received) == 1)
    assert not service.failed


def test_a_release_that_cannot_be_stored_is_tried_again(
    start_service, compressor, put_images, modem, gauge, unwritable
):
    put_images([1.0, 0.5])
    service = start_service(max_in_flight=1)
    eventually(lambda: gauge(service, "contacts_waiting") == 2)
    with unwritable(service):
        publish_until(modem, lambda: "readonly" in service.health().detail)
        assert (gauge(service, "contacts_in_flight"), gauge(service, "contacts_waiting")) == (0, 2)
    eventually(lambda: len(compressor.received) == 1)
    eventually(lambda: service.health().state == "ok")


def test_a_process_that_is_killed_repeatedly_sends_each_contact_once(router, tmp_path, compressor, put_images, modem):
    images, kills = 24, 2
    put_images([round(random.Random(n).uniform(0, 2), 3) for n in range(images)])
    config = tmp_path / "uuv.toml"
    config.write_text(
        f'[platform]\nid = "uuv-1"\nrouter = ["{router}"]\nstate_dir = "{tmp_path / "vehicle"}"\n'
        f'health_interval_s = 0.1\n[atd_stub]\nmode = "snippets"\ninput_dir = "{tmp_path / "incoming"}"\n'
        "poll_s = 0.05\nsettle_s = 0.0\nmax_in_flight = 8\n"
    )
    command = [sys.executable, "-m", "sonarpost.services.atd_stub", "--config", str(config)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "common")}

    def all_received(count):
        modem.accepted = len(compressor.received)
        modem.publish()
        return len(compressor.received) >= count

    for life in range(kills + 1):
        process = subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.DEVNULL, env=environment)
        try:
            # A little further each time.
            count = images if life == kills else (life + 1) * images // (kills + 2)
            eventually(lambda count=count: all_received(count))
        finally:
            process.kill()
            process.wait()
    assert sorted(s.contact.contact_id for s in compressor.received) == [f"p{n:03d}" for n in range(images)]
