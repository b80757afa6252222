"""The backlog of coded images: vessels in turn, and which failures count against an image."""

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from types import SimpleNamespace

import pytest
from builders.common import eventually

from sonarpost import keys, wire
from sonarpost.archive import decode_worker
from sonarpost.archive.backlog import BacklogRecord
from sonarpost.archive.decode_worker import Decoded, DecodeWorker, PackedImage, coded_image
from sonarpost.archive.decoder import Decoder
from sonarpost.archive.reader import open_archive
from sonarpost.archive.shore_archive import Batch
from sonarpost.codec.registry import default_registry
from sonarpost.delivery.store import Store
from sonarpost.errors import DatabaseUnavailableError, RejectedByDatabaseError
from sonarpost.messages import ImagePart
from sonarpost.services.c2 import decoding
from sonarpost.services.c2.decoding import Decoding

MACHINE = Decoded(reason="killed", failure="machine")
CRASH = Decoded(reason="crashed", failure="crash")


class Backlog:
    """A backlog with decoders in this process; `failing` returns how an image fails, None if it is decoded."""

    def __init__(self, folder, workers=1):
        self.store = Store(folder / "c2.db")
        self.archive = open_archive(folder)
        self.stopping = threading.Event()
        self.tried, self.stored, self.quarantined = [], [], []
        self.faults, self.alone = set(), []
        self.failing = lambda _: None
        self.refusing = lambda _: None
        self.decoding = Decoding(
            self.store,
            lambda: self.archive.backlog,
            [self] * workers,
            self._keep,
            lambda e, _: self._quarantined(e),
            self.stopping,
        )
        self._decoder = Decoder(())

    def add(self, vessel, *image_ids):
        parts = [ImagePart(u="uuv-1", i=image_id, n=1, t=1.7e9) for image_id in image_ids]
        key = keys.shore_part(vessel, "shore-9")
        for part in parts:
            self.archive.write(Batch(waiting=[BacklogRecord(key, wire.encode(part), vessel)]))
        self.decoding.wake()

    def decode(self, vessel_id, payload):
        image = coded_image(vessel_id, payload)
        name = f"{image.vessel_id}/{image.image_id}"
        self.tried.append(name)
        self.faults.add(self.decoding.fault)
        return self.failing(name) or Decoded(PackedImage(self._decoder.decode(image)))

    def _keep(self, images, entries):
        for image, _ in images:
            if error := self.refusing(f"{image.vessel_id}/{image.image_id}"):
                raise error
        self.archive.write(Batch(finished=entries))
        self.stored += [f"{image.vessel_id}/{image.image_id}" for image, _ in images]

    def _quarantined(self, entry):
        self.archive.backlog.discard([entry])
        self.quarantined.append(f"{entry.vessel_id}/{coded_image(entry.vessel_id, entry.payload).image_id}")

    def close(self):
        """As a worker: nothing to end."""

    def run(self, until):
        thread = threading.Thread(target=self.decoding.run)
        thread.start()
        try:
            eventually(lambda: not thread.is_alive() or until())
        finally:
            self.stopping.set()
            self.decoding.close()
            thread.join()

    def waiting(self):
        return self.archive.backlog.waiting_count


@pytest.fixture
def backlog(tmp_path, monkeypatch):
    for name in ("RETRY_S", "MAX_RETRY_S", "MAX_PAUSE_S"):
        monkeypatch.setattr(decoding, name, 0.0)
    made = Backlog(tmp_path)
    with closing(made.store), closing(made.archive):
        yield made


def ids(count):
    return [f"{number:04d}" for number in range(1, count + 1)]


def test_image_of_one_vessel_does_not_wait_behind_those_of_another(backlog):
    backlog.add("vessel-2", *ids(40))
    backlog.add("vessel-1", "0001")
    backlog.add("vessel-3", "0001", "0002")
    backlog.run(lambda: len(backlog.stored) == 43)
    # One image of each other vessel comes first at most.
    assert {backlog.tried.index("vessel-1/0001"), backlog.tried.index("vessel-3/0001")} <= {0, 1, 2}
    assert backlog.tried.index("vessel-3/0002") <= 5
    assert [name for name in backlog.stored if name.startswith("vessel-2")] == [f"vessel-2/{i}" for i in ids(40)]
    assert backlog.waiting() == 0


def test_fault_of_the_machine_degrades_and_quarantines_no_image(backlog):
    left = 50
    names = [f"{vessel}/{image_id}" for vessel in ("vessel-1", "vessel-2") for image_id in ids(10)]

    def failing(_):
        nonlocal left
        left -= 1
        return MACHINE if left > 0 and left % 3 else None

    backlog.failing = failing
    for vessel in ("vessel-1", "vessel-2"):
        backlog.add(vessel, *ids(10))
    backlog.run(lambda: len(backlog.stored) == 20)
    assert sorted(backlog.stored) == names
    assert (backlog.quarantined, backlog.store.refused_count()) == ([], 0)
    assert any("cannot be decoded and stored now: killed" in fault for fault in backlog.faults)
    assert backlog.decoding.fault == ""


def test_image_is_quarantined_after_it_alone_has_crashed_decoders_that_decode_others(backlog):
    backlog.failing = lambda name: CRASH if name == "vessel-2/0001" else None
    backlog.add("vessel-2", "0001")
    # While it is the only image, nothing shows that it is to blame.
    backlog.decoding.wake()
    thread = threading.Thread(target=backlog.decoding.run)
    thread.start()
    try:
        eventually(lambda: len(backlog.tried) >= 10)
        assert (backlog.quarantined, backlog.waiting()) == ([], 1)
        for number, image_id in enumerate(ids(5), start=1):
            backlog.add("vessel-1", image_id)
            eventually(lambda: len(backlog.stored) == number)  # noqa: B023 used in this iteration
            tried = len(backlog.tried)
            eventually(lambda: backlog.quarantined or len(backlog.tried) > tried + 2)  # noqa: B023
        eventually(lambda: backlog.decoding.fault == "")
    finally:
        backlog.stopping.set()
        backlog.decoding.close()
        thread.join()
    assert backlog.quarantined == ["vessel-2/0001"]
    [(key,)] = backlog.store._read("SELECT key FROM refused")
    assert key == keys.shore_part("vessel-2", "shore-9")
    assert backlog.waiting() == 0


def test_image_that_the_archive_refuses_is_found_in_its_batch_and_the_others_are_stored(backlog):
    backlog.decoding.workers *= 4
    backlog.decoding._idle *= 4
    error = {"vessel-2/0003": RejectedByDatabaseError("rejected"), "vessel-2/0006": ValueError("unexpected")}
    backlog.refusing = error.get
    backlog.add("vessel-2", *ids(8))
    backlog.add("vessel-1", *ids(8))
    backlog.run(lambda: len(backlog.stored) == 14 and backlog.waiting() == 2)
    assert not any(name in backlog.stored for name in error)
    # Each stored image between two of their failures counts.
    backlog.stopping.clear()
    added = iter(ids(10_000)[100:])

    def quarantined():
        backlog.add("vessel-1", next(added))
        return len(backlog.quarantined) == 2

    backlog.run(quarantined)
    assert sorted(backlog.quarantined) == sorted(error)


def test_archive_that_is_away_quarantines_no_image(backlog):
    left = 100

    def refusing(_):
        nonlocal left
        left -= 1
        return DatabaseUnavailableError("away") if left > 0 else None

    backlog.refusing = refusing
    backlog.add("vessel-1", *ids(8))
    backlog.run(lambda: len(backlog.stored) == 8)
    assert backlog.store.refused_count() == 0
    assert any("now: away" in fault for fault in backlog.faults)


def test_pause_after_a_crash_does_not_depend_on_other_images_of_the_batch(backlog, monkeypatch):
    now_s = 0.0
    monkeypatch.setattr(decoding, "MAX_PAUSE_S", 300.0)
    duration_s = {"vessel-1/0001": 100.0, "vessel-2/0001": 2.0, "vessel-2/0002": 1.0}
    failure = {"vessel-2/0001": CRASH, "vessel-2/0002": MACHINE}

    def failing(name):
        nonlocal now_s
        now_s += duration_s[name]
        return failure.get(name)

    backlog.failing = failing
    for name in duration_s:
        backlog.add(*name.split("/"))
    monkeypatch.setattr(decoding, "time", SimpleNamespace(monotonic=lambda: now_s))
    with ThreadPoolExecutor(1) as pool:
        backlog.decoding._decode(pool, backlog.decoding._next())
    assert backlog.stored == ["vessel-1/0001"]
    assert backlog.decoding._vessel("vessel-2").retry_at_s - now_s == decoding.PAUSE_FACTOR * 2.0


def test_batches_are_limited_by_their_pixels(backlog, monkeypatch):
    sizes = []
    monkeypatch.setattr(decoding, "BATCH_BYTES", 2 * 16 * 16)
    keep = backlog._keep
    monkeypatch.setattr(backlog.decoding, "_keep", lambda *kept: (sizes.append(len(kept[0])), keep(*kept)))
    backlog.add("vessel-1", *ids(4))
    backlog.run(lambda: backlog.waiting() == 0)
    assert sizes == [2, 2]


@pytest.fixture
def worker(tmp_path):
    made = []

    def start(*codebooks, max_decode_s=60.0):
        made.append(DecodeWorker(codebooks, tmp_path / "codebooks", tmp_path, max_decode_s))
        return made[-1]

    yield start
    for each in made:
        each.close()


@pytest.fixture
def coded(texture):
    stream = default_registry().create("emb").encode(texture(), 200)
    part = ImagePart(u="uuv-1", i="0001", n=1, t=1.7e9, p=stream)
    return "vessel-1", wire.encode(part)


@pytest.mark.system
def test_end_of_a_decoder_is_blamed_on_the_machine_unless_it_ends_by_itself(worker, coded, tmp_path):
    assert worker(str(tmp_path / "missing.tiles")).decode(*coded).failure == "machine"
    for number, failure in ((signal.SIGKILL, "machine"), (signal.SIGTERM, "machine"), (signal.SIGSEGV, "crash")):
        decoder = worker()
        assert decoder.decode(*coded).image is not None
        os.kill(decoder.pid, number)
        result = decoder.decode(*coded)
        assert (result.image, result.failure) == (None, failure)
        assert decoder.decode(*coded).image is not None


@pytest.mark.system
def test_decoder_that_does_not_finish_is_ended_after_its_processor_time(worker, texture):
    # The kernel counts processor time in ticks: the decoding must last longer than one.
    stream = default_registry().create("emb").encode(texture(512, 512), 20_000)
    part = ImagePart(u="uuv-1", i="0001", n=1, t=1.7e9, p=stream)
    payload = wire.encode(part)
    before = signal.signal(signal.SIGPROF, signal.SIG_IGN)  # children inherit it
    try:
        result = worker(max_decode_s=1e-6).decode("vessel-1", payload)
    finally:
        signal.signal(signal.SIGPROF, before)
    assert (result.failure, result.reason) == ("crash", "the decoder did not finish within 1e-06 s of processor time")


@pytest.mark.system
@pytest.mark.parametrize("step", ["_write", "_read"])
def test_stop_between_two_steps_of_a_decoding_is_no_crash(worker, coded, monkeypatch, step):
    decoder = worker()
    assert decoder.decode(*coded).image is not None
    original = getattr(decode_worker, step)

    def stopped(*arguments):
        decoder.close()
        return original(*arguments)

    monkeypatch.setattr(decode_worker, step, stopped)
    assert decoder.decode(*coded).failure == "machine"
    assert decoder.decode(*coded).reason == "the service stops"
