"""atd_stub: each file is processed once, bad files are quarantined with a reason, polling continues."""

from __future__ import annotations

import importlib.metadata
import os
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from builders.common import eventually
from builders.survey_oracle import tiny_survey
from builders.surveys import MAKERS
from PIL import Image

from sonarpost import keys
from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub import service as atd_stub
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.input_folder import InputFile, StableFiles, list_input_files
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.sonar import readers
from sonarpost.sonar.image_files import read_image, write_png, write_tiff
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.readers.xtf import XtfSource

KEY = keys.contact_detected("uuv-1")
THRESHOLD = 0.3
"""With this threshold each of the small surveys has more than three contacts."""


@pytest.fixture
def config(tmp_path, put_file):
    return AtdStubConfig(
        input_dir=tmp_path / "incoming",
        poll_s=0.02,
        settle_s=0.0,
        confidence_threshold=THRESHOLD,
        max_contacts=3,
        max_in_flight=0,
    )


@pytest.fixture
def start_service(runner, platform, config):
    """Start the service with changes to the usual configuration."""

    def start(**changes):
        return runner.start(AtdStubService(platform("uuv-1"), config.model_copy(update=changes)))

    return start


@pytest.fixture
def compressor(runner):
    return runner.peer("uuv-1", "compressor", {KEY: Snippet})


@pytest.fixture
def check_next_image(texture, put_file, compressor):
    """Check that a service in snippets mode still works: it sends a good image."""

    def check():
        compressor.received.clear()
        # Complete when it appears: an empty file would be quarantined.
        path = put_file(".good.tiff", b"")
        write_tiff(path, texture(seed=99))
        path.rename(path.with_name("good.tiff"))
        eventually(lambda: [s.source for s in compressor.received] == ["good.tiff"], what="the image after the bad one")

    return check


def best_of(path):
    return detect(read_survey(path), DetectorSettings(confidence_threshold=THRESHOLD, max_contacts=3))


def counter(service, name):
    return service.health().counters.get(name, 0)


def all_processed(service):
    """Return whether every file in the folder is processed."""
    return service.health().gauges["files_waiting"] == 0


def test_contacts_of_a_survey_are_sent_most_confident_first(
    start_service, compressor, put_file, survey_bytes, check_monitoring
):
    path = put_file("line.xtf", survey_bytes(1))
    service = start_service()
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


def test_a_file_is_processed_once_under_any_name(start_service, runner, compressor, put_file, survey_bytes):
    put_file("a.xtf", survey_bytes(1))
    service = start_service()
    eventually(lambda: len(compressor.received) == 3)
    put_file("b.xtf", survey_bytes(1))
    eventually(lambda: all_processed(service) and len(service._processed) == 2)
    os.utime(service.config.input_dir / "a.xtf", (1, 1))
    put_file("c.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 6)
    runner.stop(service)
    put_file("d.xtf", survey_bytes(1))
    again = start_service()
    eventually(lambda: all_processed(again) and len(again._processed) == 4)
    assert counter(again, "files_processed") == 0
    assert len({s.contact.contact_id for s in compressor.received}) == len(compressor.received) == 6


@pytest.fixture
def plug_in_reader(monkeypatch):
    """Register a reader of `.abc`, whose files are XTF, as an installed package does."""
    module = types.ModuleType("plug_in_sonar")
    module.open_abc = XtfSource
    monkeypatch.setitem(sys.modules, "plug_in_sonar", module)
    point = importlib.metadata.EntryPoint("abc", "plug_in_sonar:open_abc", readers.ENTRY_POINTS)
    monkeypatch.setattr(readers, "entry_points", lambda group: [point] if group == readers.ENTRY_POINTS else [])
    readers._plug_ins.cache_clear()
    yield
    readers._plug_ins.cache_clear()


@pytest.mark.usefixtures("plug_in_reader")
def test_files_of_a_plug_in_reader_are_processed(start_service, compressor, put_file, survey_bytes):
    put_file("line.ABC", survey_bytes(1))
    service = start_service()
    eventually(lambda: len(compressor.received) == 3)
    assert {snippet.source for snippet in compressor.received} == {"line.ABC"}
    assert counter(service, "files_quarantined") == 0


@pytest.mark.parametrize("kind", ["jsf", "sdf", "sl2", "sl3", "svlog"])
def test_recordings_of_every_format_are_processed(kind, start_service, tmp_path, put_file):
    path = MAKERS[kind](tiny_survey(40, 400), tmp_path)
    put_file(path.name, path.read_bytes())
    service = start_service()
    eventually(lambda: counter(service, "files_processed") == 1)
    assert counter(service, "files_quarantined") == 0


@pytest.mark.realdata
def test_a_lowrance_recording_is_processed(start_service, put_file, data_dir):
    put_file("line.sl3", (data_dir / "surveys" / "lowrance" / "40MCAL3.sl3").read_bytes())
    service = start_service()
    eventually(lambda: counter(service, "files_processed") == 1)
    assert counter(service, "files_quarantined") == 0


def test_contacts_wait_in_the_store_while_the_compressor_is_down(start_service, runner, put_file, survey_bytes):
    put_file("a.xtf", survey_bytes(1))
    service = start_service()
    eventually(lambda: counter(service, "contacts_detected") == 3)
    eventually(lambda: service.health().gauges["outbox"] == 3)
    runner.stop(service)
    start_service()
    late = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    eventually(lambda: len(late.received) == 3)


def test_files_are_processed_oldest_first(start_service, compressor, put_file, texture):
    for name, age in (("c.tiff", 10), ("a.tiff", 30), ("b.png", 20), ("d.tiff", 10)):
        path = put_file(name, b"")
        (write_png if name.endswith("png") else write_tiff)(path, texture(seed=age + ord(name[0])))
        os.utime(path, (1_000_000 - age, 1_000_000 - age))
    start_service(mode="snippets")
    eventually(lambda: len(compressor.received) == 4)
    assert [s.source for s in compressor.received] == ["a.tiff", "b.png", "c.tiff", "d.tiff"]


@pytest.mark.parametrize(
    ("name", "spoil", "expected"),
    [
        ("empty.xtf", lambda data: b"", "empty.xtf"),
        ("cut.xtf", lambda data: data[:1200], "cut.xtf"),
        ("header-only.xtf", lambda data: data[:700], "header-only.xtf"),
        ("text.XTF", lambda data: b"this is no survey\n" * 200, "text.XTF"),
    ],
)
def test_a_bad_survey_is_quarantined_with_its_reason(
    name, spoil, expected, start_service, compressor, put_file, survey_bytes, caplog
):
    service = start_service()
    path = put_file(name, spoil(survey_bytes(1)))
    aside = path.parent / "quarantine" / name
    eventually(lambda: aside.is_file() and not path.exists(), what="quarantine")
    reason = (aside.parent / f"{name}.reason.txt").read_text()
    assert expected in reason
    assert "expected" in reason
    assert any(r.message == "File quarantined" for r in caplog.records)
    eventually(lambda: counter(service, "files_quarantined") == 1)
    put_file("good.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 3, what="the file after the bad one")
    assert service.health().state == "ok"


def test_a_survey_cut_by_a_power_failure_is_processed_with_a_warning(
    start_service, compressor, put_file, survey_bytes, caplog
):
    service = start_service()
    path = put_file("cut.xtf", survey_bytes(1)[:-658])
    eventually(lambda: len(compressor.received) == 3)
    assert counter(service, "files_processed") == 1
    assert counter(service, "files_quarantined") == 0
    assert path.exists()
    [warning] = [r for r in caplog.records if r.message == "Survey reader warning"]
    assert warning.fields["file"] == "cut.xtf"
    assert "the file ends inside its last packet" in warning.fields["warning"]


def test_two_bad_files_of_one_name_are_both_kept_in_quarantine(start_service, put_file, tmp_path):
    service = start_service(quarantine_dir=tmp_path / "elsewhere")
    for number, data in enumerate((b"one", b"two", b"one"), start=1):
        path = put_file("line.xtf", data)
        eventually(lambda path=path: not path.exists(), what="quarantine")
        eventually(lambda number=number: counter(service, "files_quarantined") == min(number, 2))
    eventually(lambda: not service._processed, what="removal of absent files from memory")
    kept = sorted(p for p in (tmp_path / "elsewhere").iterdir() if p.suffix == ".xtf")
    assert {p.read_bytes() for p in kept} == {b"one", b"two"}
    assert all(p.with_name(f"{p.name}.reason.txt").is_file() for p in kept)


def test_a_growing_file_is_complete_when_it_no_longer_changes():
    stable = StableFiles(2.0)
    small, grown = InputFile(Path("a"), 10, 1), InputFile(Path("a"), 20, 2)
    assert stable.update((small,), 0.0) == ()
    assert stable.update((small,), 1.9) == ()
    assert stable.update((grown,), 2.1) == ()
    assert stable.update((grown,), 4.0) == ()
    assert stable.update((grown,), 4.2) == (grown,)
    assert stable.update((), 5.0) == ()
    assert stable.update((grown,), 9.0) == (), "a file that was absent is a new file"


def test_a_file_that_is_still_written_is_not_processed(start_service, compressor, put_file, survey_bytes):
    service = start_service(settle_s=0.4)
    data = survey_bytes(1)
    path = put_file("growing.xtf", data[:1000])
    with path.open("ab") as file:
        for start in range(1000, len(data), len(data) // 8):
            file.write(data[start : start + len(data) // 8])
            file.flush()
            before = service._stable_files._unchanged_since_s.copy()
            eventually(lambda before=before: service._stable_files._unchanged_since_s != before, what="another poll")
            assert counter(service, "files_quarantined") == 0
    eventually(lambda: len(compressor.received) == 3)
    assert counter(service, "files_quarantined") == 0


def test_only_regular_files_with_a_known_suffix_are_listed(tmp_path):
    (tmp_path / "folder.xtf").mkdir()
    (tmp_path / "loop.xtf").symlink_to(tmp_path / "loop.xtf")
    (tmp_path / "nowhere.xtf").symlink_to(tmp_path / "absent")
    os.mkfifo(tmp_path / "pipe.xtf")
    for name in (".hidden.xtf", "notes.txt", "good.XTF"):
        (tmp_path / name).write_bytes(b"x")
    assert [file.path.name for file in list_input_files(tmp_path, (".xtf",))] == ["good.XTF"]


def test_image_files_are_sent_unchanged(start_service, compressor, put_file, texture):
    images = {"eight.tiff": texture(16, 512), "sixteen.tiff": texture(512, 16, dtype=np.uint16)}
    for name, pixels in images.items():
        write_tiff(put_file(name, b""), pixels)
    start_service(mode="snippets")
    eventually(lambda: len(compressor.received) == 2)
    for snippet in compressor.received:
        expected = images[snippet.source]
        assert snippet.picture.bits == 8 * expected.dtype.itemsize
        np.testing.assert_array_equal(snippet.picture.to_array(), expected)
        assert snippet.contact.contact_id.startswith(Path(snippet.source).stem + "-")
        assert snippet.contact.atd_confidence is None, "no confidence is invented"


def test_a_large_colour_jpeg_is_sent_with_its_position_and_a_warning(
    start_service, compressor, put_file, texture, caplog
):
    put_file("p.txt", b"lat_deg: 56.4\nlon_deg: -5.6\npixel_along_m: 0.1\n")
    path = put_file(".p.jpg", b"")
    Image.fromarray(np.dstack([texture(1024, 400)] * 2 + [texture(1024, 400) // 2])).save(path)
    path.rename(path.with_name("p.jpg"))
    start_service(mode="snippets")
    eventually(lambda: len(compressor.received) == 1)
    (snippet,) = compressor.received
    assert (snippet.picture.width_px, snippet.picture.height_px) == (200, 512)
    assert (snippet.contact.lat_deg, snippet.contact.pixel_along_m) == (56.4, 0.2)
    warnings = [r.fields["warning"] for r in caplog.records if r.message == "Image file warning"]
    assert warnings[1] == "400 × 1024 px resized to 200 × 512 px"


@pytest.mark.parametrize(
    ("name", "pixels", "expected"),
    [
        ("complex.tiff", np.zeros((40, 40), np.complex64), "sample type: got 'complex64', expected integer or float"),
        ("small.tiff", np.zeros((15, 40), np.uint8), "got '40 × 15 px', expected 16 to 512 px a side; fit ="),
        ("wide.tiff", np.zeros((40, 513), np.uint8), "got '513 × 40 px', expected 16 to 512 px a side; fit ="),
    ],
)
def test_an_image_that_cannot_be_sent_is_quarantined(name, pixels, expected, start_service, put_file, check_next_image):
    import tifffile

    service = start_service(mode="snippets", fit="refuse")
    path = put_file(f".{name}", b"")
    tifffile.imwrite(path, pixels)
    path = path.rename(path.with_name(name))
    reason = path.parent / "quarantine" / f"{name}.reason.txt"
    eventually(lambda: reason.is_file() and not path.exists(), what="quarantine")
    assert expected in reason.read_text()
    check_next_image()
    assert service.health().state == "ok"


def test_a_bad_file_stays_when_the_quarantine_cannot_be_written(
    start_service, runner, tmp_path, put_file, check_next_image, caplog
):
    # A file in place of the parent folder fails like a read-only folder does, also for the superuser.
    (tmp_path / "occupied").write_text("")
    nowhere = tmp_path / "occupied" / "quarantine"
    service = start_service(mode="snippets", quarantine_dir=nowhere)
    path = put_file("bad.tiff", b"no image")
    eventually(lambda: all_processed(service) and counter(service, "files_quarantined") == 1)
    assert path.is_file()
    assert sum(r.message == "File cannot be moved to quarantine" for r in caplog.records) == 1
    check_next_image()
    runner.stop(service)
    (tmp_path / "occupied").unlink()
    again = start_service(mode="snippets", quarantine_dir=nowhere)
    eventually(lambda: (nowhere / "bad.tiff").is_file() and not path.exists())
    assert "signature" in (nowhere / "bad.tiff.reason.txt").read_text()
    assert counter(again, "files_quarantined") == 0, "it was counted when it was first processed"


def test_an_unreadable_file_does_not_block_the_others(start_service, compressor, put_file, survey_bytes, tmp_path):
    # Reading the memory of this process from offset 0 is an input/output error, like a bad sector.
    broken = tmp_path / "incoming" / "broken.xtf"
    broken.symlink_to("/proc/self/mem")
    service = start_service()
    eventually(lambda: service.health().state == "degraded")
    assert "Input/output error" in service.health().detail
    put_file("good.xtf", survey_bytes(1))
    eventually(lambda: len(compressor.received) == 3, what="the file after the broken one")
    broken.unlink()
    eventually(lambda: service.health().state == "ok")


def test_an_absent_input_folder_is_made_when_possible(start_service, tmp_path, compressor, survey_bytes):
    (tmp_path / "disk").write_text("not mounted yet")
    service = start_service(input_dir=tmp_path / "disk" / "incoming")
    eventually(lambda: service.health().state == "degraded")
    assert str(tmp_path / "disk") in service.health().detail
    (tmp_path / "disk").unlink()
    eventually(lambda: service.health().state == "ok")
    (tmp_path / "disk" / "incoming" / "line.xtf").write_bytes(survey_bytes(1))
    eventually(lambda: len(compressor.received) == 3)
    # Removed by one rename, as the service makes its folder again when it is absent.
    (tmp_path / "disk").rename(tmp_path / "unmounted")
    (tmp_path / "disk").mkdir(exist_ok=True)
    eventually((tmp_path / "disk" / "incoming").is_dir, what="the folder made again")
    assert service.health().state == "ok"


@pytest.mark.parametrize("when", ["before", "during"])
def test_a_removed_file_is_processed_when_it_is_back(
    when, start_service, compressor, put_file, survey_bytes, tmp_path, monkeypatch
):
    read, hashed, removed = atd_stub.detect_in_survey, atd_stub.content_sha256, []

    def remove(path):
        if not removed:
            removed.append(path)
            path.rename(tmp_path / "away")

    def remove_then_hash(path):
        remove(path)
        return hashed(path)

    def remove_then_read(path, *rest):
        remove(path)
        return read(path, *rest)

    if when == "before":
        monkeypatch.setattr(atd_stub, "content_sha256", remove_then_hash)
    else:
        monkeypatch.setattr(atd_stub, "detect_in_survey", remove_then_read)
    service = start_service()
    path = put_file("line.xtf", survey_bytes(1))
    eventually(lambda: bool(removed) and all_processed(service))
    assert counter(service, "files_quarantined") == 0
    (tmp_path / "away").rename(path)
    eventually(lambda: len(compressor.received) == 3)
    assert service.health().state == "ok"


def test_a_file_that_changes_while_it_is_read_is_read_again(
    start_service, compressor, put_file, survey_bytes, monkeypatch
):
    read, changed = atd_stub.detect_in_survey, []

    def change_then_read(path, *rest):
        found = read(path, *rest)
        if not changed:
            changed.append(path)
            path.write_bytes(survey_bytes(2))
        return found

    monkeypatch.setattr(atd_stub, "detect_in_survey", change_then_read)
    service = start_service()
    path = put_file("line.xtf", survey_bytes(1))
    eventually(lambda: len(compressor.received) == 3)
    eventually(lambda: counter(service, "files_processed") == 1)
    assert [s.contact.atd_confidence for s in compressor.received] == [d.confidence for d in best_of(path)]


def test_a_file_name_that_is_not_utf_8_is_accepted(start_service, compressor, tmp_path, survey_bytes, put_file):
    folder = os.fsencode(tmp_path / "incoming")
    for name, data in ((b"gr\xfcn.xtf", survey_bytes(1)), (b"\xff\xfe.xtf", b"no survey")):
        with open(os.path.join(folder, name), "wb") as file:  # noqa: PTH118, PTH123 a name of bytes
            file.write(data)
    service = start_service()
    eventually(lambda: len(compressor.received) == 3)
    assert compressor.received[0].source == "gr\\udcfcn.xtf"
    eventually(lambda: counter(service, "files_quarantined") == 1)
    put_file("after.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 6)
    assert not service.failed


def test_a_defect_of_the_detector_loses_one_file(
    start_service, compressor, put_file, survey_bytes, monkeypatch, caplog
):
    read = atd_stub.detect_in_survey

    def fail_on_one(path, *rest):
        return read(path, *rest) if path.name != "odd.xtf" else 1 // 0

    monkeypatch.setattr(atd_stub, "detect_in_survey", fail_on_one)
    service = start_service()
    path = put_file("odd.xtf", survey_bytes(1))
    eventually((path.parent / "quarantine" / "odd.xtf").is_file)
    put_file("good.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 3)
    assert "ZeroDivisionError" in (path.parent / "quarantine" / "odd.xtf.reason.txt").read_text()
    assert any(r.exc_info for r in caplog.records if r.message == "File not processed")
    assert not service.failed


def test_contacts_are_sent_once_after_a_full_disk(start_service, compressor, put_file, survey_bytes):
    service = start_service()
    service.store._db.execute("PRAGMA max_page_count=1")
    put_file("line.xtf", survey_bytes(1))
    eventually(lambda: "disk is full" in service.health().detail)
    assert compressor.received == []
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(compressor.received) == 3)
    eventually(lambda: service.health().state == "ok")
    eventually(lambda: counter(service, "files_processed") == 1)


@pytest.mark.realdata
def test_real_images_are_sent_unchanged(start_service, compressor, data_dir, put_file):
    found = sorted((data_dir / "snippets").rglob("images/*.png"))[:3]
    if not found:
        pytest.skip(f"no images below {data_dir / 'snippets'}")
    for path in found:
        put_file(path.name, path.read_bytes())
    start_service(mode="snippets")
    eventually(lambda: len(compressor.received) == len(found))
    for snippet in compressor.received:
        path = next(p for p in found if p.name == snippet.source)
        np.testing.assert_array_equal(snippet.picture.to_array(), read_image(path))
