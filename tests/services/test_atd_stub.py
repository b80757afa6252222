"""atd_stub: every file once ever, bad ones aside with their reason, and nothing stops the polling."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from builders.common import eventually

from sonarpost import keys
from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub import service as atd_stub
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.folder import FileSeen, SettledFiles, look_at
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.sonar.image_files import read_image, write_png, write_tiff
from sonarpost.sonar.readers.xtf import read_xtf

KEY = keys.contact_detected("uuv-1")
THRESHOLD = 0.3
"""At which each of the small surveys has more than the three contacts that are asked for."""


@pytest.fixture
def config(tmp_path, put_file):
    return AtdStubConfig(
        input_dir=tmp_path / "incoming",
        poll_s=0.02,
        settle_s=0.0,
        confidence_threshold=THRESHOLD,
        max_contacts=3,
    )


@pytest.fixture
def begin(runner, platform, config):
    """Starts the service, with what differs from the usual configuration."""

    def start(**changes):
        return runner.start(AtdStubService(platform("uuv-1"), config.model_copy(update=changes)))

    return start


@pytest.fixture
def compressor(runner):
    return runner.peer("uuv-1", "compressor", {KEY: Snippet})


@pytest.fixture
def sent_picture(texture, put_file, compressor):
    """Proves that a service in snippets mode still works: a good picture goes through."""

    def check():
        compressor.received.clear()
        # Whole when it appears: an empty file would be taken as it is and set aside.
        path = put_file(".good.tiff", b"")
        write_tiff(path, texture(seed=99))
        path.rename(path.with_name("good.tiff"))
        eventually(
            lambda: [s.source for s in compressor.received] == ["good.tiff"], what="the picture after the bad one"
        )

    return check


def best_of(path):
    return detect(read_xtf(path), DetectorSettings(confidence_threshold=THRESHOLD, max_contacts=3))


def counter(service, name):
    return service.health().counters.get(name, 0)


def settled(service):
    """Every file in the folder has been dealt with."""
    return service.health().gauges["files_waiting"] == 0


def test_a_survey_gives_its_contacts_most_confident_first(begin, compressor, put_file, survey_bytes, check_monitoring):
    path = put_file("line.xtf", survey_bytes(1))
    service = begin()
    eventually(lambda: len(compressor.received) == 3)
    best = best_of(path)
    assert [s.contact.atd_confidence for s in compressor.received] == [d.confidence for d in best]
    for snippet, detection in zip(compressor.received, best, strict=True):
        contact = snippet.contact
        assert (contact.vehicle_id, contact.ping_number, contact.channel) == (
            "uuv-1",
            detection.ping_number,
            detection.side.value,
        )
        assert (contact.lat_deg, contact.lon_deg) == (detection.position.lat_deg, detection.position.lon_deg)
        assert (snippet.picture.height_px, snippet.picture.width_px, snippet.source) == (80, 140, "line.xtf")
    assert len({s.contact.contact_id for s in compressor.received}) == 3
    health = service.health()
    assert (health.state, health.counters) == ("ok", {"files_processed": 1, "contacts_detected": 3})
    assert path.is_file(), "a good file stays where it is"
    check_monitoring(service)


def test_a_file_is_processed_once_ever_whatever_its_name(begin, runner, compressor, put_file, survey_bytes):
    put_file("a.xtf", survey_bytes(1))
    service = begin()
    eventually(lambda: len(compressor.received) == 3)
    put_file("b.xtf", survey_bytes(1))
    eventually(lambda: settled(service) and len(service._dealt_with) == 2)
    os.utime(service.config.input_dir / "a.xtf", (1, 1))
    put_file("c.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 6)
    runner.stop(service)
    put_file("d.xtf", survey_bytes(1))
    again = begin()
    eventually(lambda: settled(again) and len(again._dealt_with) == 4)
    assert counter(again, "files_processed") == 0
    assert len({s.contact.contact_id for s in compressor.received}) == len(compressor.received) == 6


def test_contacts_found_while_nobody_takes_them_wait_in_the_store(begin, runner, put_file, survey_bytes):
    put_file("a.xtf", survey_bytes(1))
    service = begin()
    eventually(lambda: counter(service, "contacts_detected") == 3)
    eventually(lambda: service.health().gauges["outbox"] == 3)
    runner.stop(service)
    begin()
    late = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    eventually(lambda: len(late.received) == 3)


def test_files_are_taken_oldest_first(begin, compressor, put_file, texture):
    for name, age in (("c.tiff", 10), ("a.tiff", 30), ("b.png", 20), ("d.tiff", 10)):
        path = put_file(name, b"")
        (write_png if name.endswith("png") else write_tiff)(path, texture(seed=age + ord(name[0])))
        os.utime(path, (1_000_000 - age, 1_000_000 - age))
    begin(mode="snippets")
    eventually(lambda: len(compressor.received) == 4)
    assert [s.source for s in compressor.received] == ["a.tiff", "b.png", "c.tiff", "d.tiff"]


@pytest.mark.parametrize(
    ("name", "spoil", "said"),
    [
        ("empty.xtf", lambda data: b"", "empty.xtf"),
        ("cut.xtf", lambda data: data[:-100], "cut.xtf"),
        ("header-only.xtf", lambda data: data[:700], "header-only.xtf"),
        ("text.XTF", lambda data: b"this is no survey\n" * 200, "text.XTF"),
    ],
)
def test_a_bad_survey_goes_to_quarantine_with_its_reason(
    name, spoil, said, begin, compressor, put_file, survey_bytes, caplog
):
    service = begin()
    path = put_file(name, spoil(survey_bytes(1)))
    aside = path.parent / "quarantine" / name
    eventually(lambda: aside.is_file() and not path.exists(), what="quarantine")
    reason = (aside.parent / f"{name}.reason.txt").read_text()
    assert said in reason
    assert "expected" in reason
    assert any(r.message == "File quarantined" for r in caplog.records)
    eventually(lambda: counter(service, "files_quarantined") == 1)
    put_file("good.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 3, what="the file after the bad one")
    assert service.health().state == "ok"


def test_two_bad_files_of_one_name_both_stay_in_quarantine(begin, put_file, tmp_path):
    service = begin(quarantine_dir=tmp_path / "elsewhere")
    for number, data in enumerate((b"one", b"two", b"one"), start=1):
        path = put_file("line.xtf", data)
        eventually(lambda path=path: not path.exists(), what="quarantine")
        eventually(lambda number=number: counter(service, "files_quarantined") == min(number, 2))
    eventually(lambda: not service._dealt_with, what="forgetting what is no longer there")
    kept = sorted(p for p in (tmp_path / "elsewhere").iterdir() if p.suffix == ".xtf")
    assert {p.read_bytes() for p in kept} == {b"one", b"two"}
    assert all(p.with_name(f"{p.name}.reason.txt").is_file() for p in kept)


def test_a_growing_file_is_left_until_it_rests():
    settle = SettledFiles(2.0)
    small, grown = FileSeen(Path("a"), 10, 1), FileSeen(Path("a"), 20, 2)
    assert settle.look((small,), 0.0) == ()
    assert settle.look((small,), 1.9) == ()
    assert settle.look((grown,), 2.1) == ()
    assert settle.look((grown,), 4.0) == ()
    assert settle.look((grown,), 4.2) == (grown,)
    assert settle.look((), 5.0) == ()
    assert settle.look((grown,), 9.0) == (), "one that was away is new"


def test_a_file_that_is_still_written_is_not_taken(begin, compressor, put_file, survey_bytes):
    service = begin(settle_s=0.4)
    data = survey_bytes(1)
    path = put_file("growing.xtf", data[:1000])
    with path.open("ab") as file:
        for start in range(1000, len(data), len(data) // 8):
            file.write(data[start : start + len(data) // 8])
            file.flush()
            looks = service._settled._since.copy()
            eventually(lambda looks=looks: service._settled._since != looks, what="another look at the folder")
            assert counter(service, "files_quarantined") == 0
    eventually(lambda: len(compressor.received) == 3)
    assert counter(service, "files_quarantined") == 0


def test_only_regular_files_of_known_kind_are_looked_at(tmp_path):
    (tmp_path / "folder.xtf").mkdir()
    (tmp_path / "loop.xtf").symlink_to(tmp_path / "loop.xtf")
    (tmp_path / "nowhere.xtf").symlink_to(tmp_path / "absent")
    os.mkfifo(tmp_path / "pipe.xtf")
    for name in (".hidden.xtf", "notes.txt", "good.XTF"):
        (tmp_path / name).write_bytes(b"x")
    assert [seen.path.name for seen in look_at(tmp_path, (".xtf",))] == ["good.XTF"]


def test_pictures_are_sent_as_they_are(begin, compressor, put_file, texture):
    pictures = {"eight.tiff": texture(16, 512), "sixteen.tiff": texture(512, 16, dtype=np.uint16)}
    for name, pixels in pictures.items():
        write_tiff(put_file(name, b""), pixels)
    begin(mode="snippets")
    eventually(lambda: len(compressor.received) == 2)
    for snippet in compressor.received:
        wanted = pictures[snippet.source]
        assert snippet.picture.bits == 8 * wanted.dtype.itemsize
        np.testing.assert_array_equal(snippet.picture.to_array(), wanted)
        assert snippet.contact.contact_id.startswith(Path(snippet.source).stem + "-")
        assert snippet.contact.atd_confidence is None, "nothing is guessed"


@pytest.mark.parametrize(
    ("name", "pixels", "said"),
    [
        ("deep.tiff", np.zeros((40, 40), np.uint32), "32 bits"),
        ("float.tiff", np.zeros((40, 40), np.float32), "float"),
        ("small.tiff", np.zeros((15, 40), np.uint8), "height_px: got 15, expected 16..512"),
        ("wide.tiff", np.zeros((40, 513), np.uint8), "width_px: got 513, expected 16..512"),
        ("colour.tiff", np.dstack([np.full((40, 40), n, np.uint8) for n in (1, 2, 3)]), "RGB"),
    ],
)
def test_a_picture_that_cannot_be_sent_goes_to_quarantine(name, pixels, said, begin, put_file, sent_picture):
    import tifffile

    service = begin(mode="snippets")
    path = put_file(f".{name}", b"")
    tifffile.imwrite(path, pixels)
    path = path.rename(path.with_name(name))
    reason = path.parent / "quarantine" / f"{name}.reason.txt"
    eventually(lambda: reason.is_file() and not path.exists(), what="quarantine")
    assert said in reason.read_text()
    sent_picture()
    assert service.health().state == "ok"


def test_a_folder_that_takes_nothing_keeps_bad_files_and_is_not_asked_again(
    begin, runner, tmp_path, put_file, sent_picture, caplog
):
    # A file where the quarantine's parent should be refuses like a read-only folder does, also to the superuser.
    (tmp_path / "occupied").write_text("")
    nowhere = tmp_path / "occupied" / "quarantine"
    service = begin(mode="snippets", quarantine_dir=nowhere)
    path = put_file("bad.tiff", b"no picture")
    eventually(lambda: settled(service) and counter(service, "files_quarantined") == 1)
    assert path.is_file()
    assert sum(r.message == "File cannot be moved" for r in caplog.records) == 1
    sent_picture()
    runner.stop(service)
    (tmp_path / "occupied").unlink()
    again = begin(mode="snippets", quarantine_dir=nowhere)
    eventually(lambda: (nowhere / "bad.tiff").is_file() and not path.exists())
    assert "signature" in (nowhere / "bad.tiff.reason.txt").read_text()
    assert counter(again, "files_quarantined") == 0, "it was counted when it was met first"


def test_a_file_that_cannot_be_read_does_not_stop_the_others(begin, compressor, put_file, survey_bytes, tmp_path):
    # Reading this process's memory from its beginning is an input/output error, as a bad sector is.
    broken = tmp_path / "incoming" / "broken.xtf"
    broken.symlink_to("/proc/self/mem")
    service = begin()
    eventually(lambda: service.health().state == "degraded")
    assert "Input/output error" in service.health().detail
    put_file("good.xtf", survey_bytes(1))
    eventually(lambda: len(compressor.received) == 3, what="the file behind the broken one")
    broken.unlink()
    eventually(lambda: service.health().state == "ok")


def test_a_folder_that_is_not_there_is_waited_for(begin, tmp_path, compressor, survey_bytes):
    (tmp_path / "disk").write_text("not mounted yet")
    service = begin(input_dir=tmp_path / "disk" / "incoming")
    eventually(lambda: service.health().state == "degraded")
    assert str(tmp_path / "disk") in service.health().detail
    (tmp_path / "disk").unlink()
    eventually(lambda: service.health().state == "ok")
    (tmp_path / "disk" / "incoming" / "line.xtf").write_bytes(survey_bytes(1))
    eventually(lambda: len(compressor.received) == 3)
    # Away at one stroke: the service makes its folder anew whenever it finds none.
    (tmp_path / "disk").rename(tmp_path / "unmounted")
    (tmp_path / "disk").mkdir(exist_ok=True)
    eventually((tmp_path / "disk" / "incoming").is_dir, what="the folder made anew")
    assert service.health().state == "ok"


@pytest.mark.parametrize("when", ["before", "during"])
def test_a_file_that_vanishes_is_taken_when_it_comes_back(
    when, begin, compressor, put_file, survey_bytes, tmp_path, monkeypatch
):
    read, hashed, gone = atd_stub.snippets.from_survey, atd_stub.content_hash, []

    def vanish(path):
        if not gone:
            gone.append(path)
            path.rename(tmp_path / "away")

    def vanish_then_hash(path):
        vanish(path)
        return hashed(path)

    def vanish_then_read(path, *rest):
        vanish(path)
        return read(path, *rest)

    if when == "before":
        monkeypatch.setattr(atd_stub, "content_hash", vanish_then_hash)
    else:
        monkeypatch.setattr(atd_stub.snippets, "from_survey", vanish_then_read)
    service = begin()
    path = put_file("line.xtf", survey_bytes(1))
    eventually(lambda: bool(gone) and settled(service))
    assert counter(service, "files_quarantined") == 0
    (tmp_path / "away").rename(path)
    eventually(lambda: len(compressor.received) == 3)
    assert service.health().state == "ok"


def test_a_file_that_changes_while_it_is_read_is_read_again(begin, compressor, put_file, survey_bytes, monkeypatch):
    read, changed = atd_stub.snippets.from_survey, []

    def change_then_read(path, *rest):
        found = read(path, *rest)
        if not changed:
            changed.append(path)
            path.write_bytes(survey_bytes(2))
        return found

    monkeypatch.setattr(atd_stub.snippets, "from_survey", change_then_read)
    service = begin()
    path = put_file("line.xtf", survey_bytes(1))
    eventually(lambda: len(compressor.received) == 3)
    eventually(lambda: counter(service, "files_processed") == 1)
    assert [s.contact.atd_confidence for s in compressor.received] == [d.confidence for d in best_of(path)]


def test_a_name_that_is_not_text_is_no_obstacle(begin, compressor, tmp_path, survey_bytes, put_file):
    folder = os.fsencode(tmp_path / "incoming")
    for name, data in ((b"gr\xfcn.xtf", survey_bytes(1)), (b"\xff\xfe.xtf", b"no survey")):
        with open(os.path.join(folder, name), "wb") as file:  # noqa: PTH118, PTH123 a name of bytes
            file.write(data)
    service = begin()
    eventually(lambda: len(compressor.received) == 3)
    assert compressor.received[0].source == "gr\\udcfcn.xtf"
    eventually(lambda: counter(service, "files_quarantined") == 1)
    put_file("after.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 6)
    assert not service.failed


def test_a_defect_costs_one_file(begin, compressor, put_file, survey_bytes, monkeypatch, caplog):
    read = atd_stub.snippets.from_survey

    def stumble(path, *rest):
        return read(path, *rest) if path.name != "odd.xtf" else 1 // 0

    monkeypatch.setattr(atd_stub.snippets, "from_survey", stumble)
    service = begin()
    path = put_file("odd.xtf", survey_bytes(1))
    eventually((path.parent / "quarantine" / "odd.xtf").is_file)
    put_file("good.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 3)
    assert "ZeroDivisionError" in (path.parent / "quarantine" / "odd.xtf.reason.txt").read_text()
    assert any(r.exc_info for r in caplog.records if r.message == "File not processed")
    assert not service.failed


def test_a_full_disk_finds_nothing_twice_and_loses_nothing(begin, compressor, put_file, survey_bytes):
    service = begin()
    service.store._db.execute("PRAGMA max_page_count=1")
    put_file("line.xtf", survey_bytes(1))
    eventually(lambda: "disk is full" in service.health().detail)
    assert compressor.received == []
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(compressor.received) == 3)
    eventually(lambda: service.health().state == "ok")
    eventually(lambda: counter(service, "files_processed") == 1)


@pytest.mark.realdata
def test_real_pictures_go_through_unchanged(begin, compressor, data_dir, put_file):
    found = sorted((data_dir / "snippets").rglob("images/*.png"))[:3]
    if not found:
        pytest.skip(f"no pictures below {data_dir / 'snippets'}")
    for path in found:
        put_file(path.name, path.read_bytes())
    begin(mode="snippets")
    eventually(lambda: len(compressor.received) == len(found))
    for snippet in compressor.received:
        path = next(p for p in found if p.name == snippet.source)
        np.testing.assert_array_equal(snippet.picture.to_array(), read_image(path))
