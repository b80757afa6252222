"""atd_stub: each file is processed once, bad files are quarantined with a reason, polling continues."""

import os
from pathlib import Path

import numpy as np
import pytest
import tifffile
from builders.common import eventually
from builders.joined_surveys import FEW_CANDIDATES
from builders.survey_oracle import tiny_survey
from builders.surveys import MAKERS

from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.services.atd_stub import service as atd_stub
from sonarpost.services.atd_stub.input_folder import InputFile, StableFiles, list_input_files
from sonarpost.sonar.image_files import write_png
from sonarpost.sonar.readers import read_survey

THRESHOLD = 0.3
"""With this threshold each of the small surveys has more than three contacts."""


@pytest.fixture
def start_service(start_service):
    return lambda **options: start_service(**({"confidence_threshold": THRESHOLD, "max_contacts": 3} | options))


@pytest.fixture
def put_image(incoming):
    """Put a complete image file into the folder."""

    def put(name, pixels):
        hidden = incoming / f".{name}"
        (write_png if name.endswith("png") else tifffile.imwrite)(hidden, pixels)
        return hidden.rename(incoming / name)

    return put


@pytest.fixture
def check_next_image(texture, put_image, compressor):
    """Check that a service in snippets mode still works: it sends a good image."""

    def check():
        compressor.received.clear()
        put_image("good.tiff", texture(seed=99))
        eventually(lambda: [s.source for s in compressor.received] == ["good.tiff"], what="the image after the bad one")

    return check


def best_of(path):
    return detect(
        read_survey(path),
        DetectorSettings(**FEW_CANDIDATES.model_dump(), confidence_threshold=THRESHOLD, max_contacts=3),
    )


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
        assert (snippet.pixels.height_px, snippet.pixels.width_px, snippet.source) == (80, 140, "line.xtf")
    assert len({s.contact.contact_id for s in compressor.received}) == 3
    health = service.health()
    assert (health.state, health.counters) == ("ok", {"files_processed": 1, "contacts_detected": 3})
    assert path.is_file(), "a good file stays where it is"
    check_monitoring(service)


def test_a_file_is_processed_once_under_any_name(
    start_service, runner, compressor, put_file, survey_bytes, incoming, counter, lines
):
    put_file("a.xtf", survey_bytes(1))
    service = start_service()
    eventually(lambda: len(compressor.received) == 3)
    put_file("b.xtf", survey_bytes(1))
    eventually(lambda: lines("File already processed"))
    [fields] = lines("File already processed")
    assert (fields["file"], fields["processed_as"]) == ("b.xtf", "a.xtf")
    os.utime(incoming / "a.xtf", (1, 1))
    put_file("c.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 6)
    assert counter(service, "files_processed") == 2
    runner.stop(service)
    put_file("d.xtf", survey_bytes(1))
    again = start_service()
    eventually(lambda: all_processed(again))
    assert counter(again, "files_processed") == 0
    assert len({s.contact.contact_id for s in compressor.received}) == len(compressor.received) == 6


def test_recordings_of_every_format_are_processed(start_service, tmp_path, put_file, counter):
    kinds = ["jsf", "sdf", "sl2", "sl3", "svlog"]
    for kind in kinds:
        path = MAKERS[kind](tiny_survey(40, 400), tmp_path)
        put_file(path.name, path.read_bytes())
    service = start_service()
    eventually(lambda: counter(service, "files_processed") == len(kinds))
    assert counter(service, "files_quarantined") == 0


def test_files_are_processed_oldest_first(start_service, compressor, put_image, texture):
    for name, age in (("c.tiff", 10), ("a.tiff", 30), ("b.png", 20), ("d.tiff", 10)):
        os.utime(put_image(name, texture(seed=age + ord(name[0]))), (1_000_000 - age, 1_000_000 - age))
    start_service(mode="snippets")
    eventually(lambda: len(compressor.received) == 4)
    assert [s.source for s in compressor.received] == ["a.tiff", "b.png", "c.tiff", "d.tiff"]


def test_bad_surveys_are_quarantined_with_their_reason(
    start_service, compressor, put_file, survey_bytes, lines, incoming, counter
):
    data = survey_bytes(1)
    bad = {"empty.xtf": b"", "cut.xtf": data[:1200], "header-only.xtf": data[:700], "text.XTF": b"no survey\n" * 200}
    for name, content in bad.items():
        put_file(name, content)
    service = start_service()
    eventually(lambda: counter(service, "files_quarantined") == len(bad))
    put_file("good.xtf", survey_bytes(2))
    eventually(lambda: len(compressor.received) == 3, what="the file after the bad ones")
    for name, content in bad.items():
        assert (incoming / "quarantine" / name).read_bytes() == content
        assert not (incoming / name).exists()
        reason = (incoming / "quarantine" / f"{name}.reason.txt").read_text()
        assert name in reason
        assert "expected" in reason
    assert len(lines("File quarantined")) == len(bad)
    assert service.health().state == "ok"


def test_a_survey_cut_by_a_power_failure_is_processed_with_a_warning(
    start_service, compressor, put_file, survey_bytes, counter, lines
):
    service = start_service()
    path = put_file("cut.xtf", survey_bytes(1)[:-658])
    eventually(lambda: len(compressor.received) == 3)
    assert counter(service, "files_processed") == 1
    assert counter(service, "files_quarantined") == 0
    assert path.exists()
    eventually(lambda: lines("Survey reader warning"))
    [warning] = lines("Survey reader warning")
    assert warning["file"] == "cut.xtf"
    assert "the file ends inside its last packet" in warning["warning"]


def test_two_bad_files_of_one_name_are_both_kept_in_quarantine(start_service, put_file, tmp_path, counter):
    service = start_service(quarantine_dir=tmp_path / "elsewhere")
    for number, data in enumerate((b"one", b"two", b"one"), start=1):
        path = put_file("line.xtf", data)
        eventually(lambda path=path: not path.exists(), what="quarantine")
        eventually(lambda number=number: counter(service, "files_quarantined") == min(number, 2))
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


def test_a_file_is_processed_when_it_is_settled_or_marked_as_done(
    start_service, compressor, put_file, survey_bytes, incoming
):
    growing = put_file("growing.xtf", survey_bytes(1)[:1000])
    os.utime(growing, (1e9, 1e9))  # older: it would be processed first
    service = start_service(settle_s=3600.0)
    put_file("complete.xtf", survey_bytes(2))
    (incoming / "complete.xtf.done").touch()
    eventually(lambda: len(compressor.received) == 3)
    assert {s.source for s in compressor.received} == {"complete.xtf"}
    eventually(lambda: service.health().gauges["files_waiting"] == 1)
    assert service.health().counters["files_processed"] == 1
    assert growing.is_file()


def test_only_regular_files_with_a_known_suffix_are_listed(tmp_path):
    (tmp_path / "folder.xtf").mkdir()
    (tmp_path / "loop.xtf").symlink_to(tmp_path / "loop.xtf")
    (tmp_path / "nowhere.xtf").symlink_to(tmp_path / "absent")
    os.mkfifo(tmp_path / "pipe.xtf")
    for name in (".hidden.xtf", "notes.txt", "good.XTF"):
        (tmp_path / name).write_bytes(b"x")
    assert [file.path.name for file in list_input_files(tmp_path, (".xtf",)).files] == ["good.XTF"]


def test_image_files_are_sent_unchanged_if_they_fit(start_service, compressor, put_image, texture, lines):
    images = {"eight.tiff": texture(16, 512), "sixteen.tiff": texture(512, 16, dtype=np.uint16)}
    for name, pixels in images.items():
        put_image(name, pixels)
    put_image("large.tiff", texture(1024, 400))
    start_service(mode="snippets")
    eventually(lambda: len(compressor.received) == 3)
    found = {snippet.source: snippet for snippet in compressor.received}
    assert found["large.tiff"].pixels.to_array().shape == (512, 200)
    eventually(lambda: lines("Image file warning"))
    assert lines("Image file warning")[-1]["warning"] == "400 × 1024 px resized to 200 × 512 px"
    for name, pixels in images.items():
        snippet = found[name]
        assert snippet.pixels.bits == 8 * pixels.dtype.itemsize
        np.testing.assert_array_equal(snippet.pixels.to_array(), pixels)
        assert snippet.contact.contact_id.startswith(Path(name).stem + "-")
        assert snippet.contact.atd_confidence is None, "no confidence is invented"
        assert snippet.wide is None, "nothing is known of the seabed around"


def test_images_that_cannot_be_sent_are_quarantined(
    start_service, put_image, put_file, check_next_image, incoming, counter
):
    put_file("position.txt", b"lat_deg: 123\n")
    bad = {
        "complex.tiff": (np.zeros((40, 40), np.complex64), "sample type: got 'complex64', expected integer or float"),
        "small.tiff": (np.zeros((15, 40), np.uint8), "got '40 × 15 px', expected 16 to 512 px a side; fit ="),
        "wide.tiff": (np.zeros((40, 513), np.uint8), "got '513 × 40 px', expected 16 to 512 px a side; fit ="),
        "position.tiff": (np.zeros((40, 40), np.uint8), "lat_deg"),
    }
    for name, (pixels, _) in bad.items():
        put_image(name, pixels)
    service = start_service(mode="snippets", fit="refuse")
    eventually(lambda: counter(service, "files_quarantined") == len(bad))
    check_next_image()
    for name, (_, expected) in bad.items():
        assert expected in (incoming / "quarantine" / f"{name}.reason.txt").read_text()
        assert not (incoming / name).exists()
    assert service.health().state == "ok"


def test_a_bad_file_stays_when_the_quarantine_cannot_be_written(
    start_service, runner, tmp_path, put_file, check_next_image, lines, counter
):
    # A file in place of the parent folder fails like a read-only folder does, also for the superuser.
    (tmp_path / "occupied").write_text("")
    nowhere = tmp_path / "occupied" / "quarantine"
    service = start_service(mode="snippets", quarantine_dir=nowhere)
    path = put_file("bad.tiff", b"no image")
    eventually(lambda: all_processed(service) and counter(service, "files_quarantined") == 1)
    assert path.is_file()
    assert len(lines("File cannot be moved to quarantine")) == 1
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


@pytest.mark.parametrize("during", ["content_sha256", "detect_in_survey"])
def test_a_file_that_is_removed_or_changed_while_it_is_read_is_processed_again(
    during, start_service, compressor, put_file, survey_bytes, tmp_path, monkeypatch, counter
):
    original, calls = getattr(atd_stub, during), []

    def disturbed(path, *rest):
        calls.append(path)
        if len(calls) == 1:
            path.rename(tmp_path / "away")
        found = original(path, *rest)
        if len(calls) == 2 and during == "detect_in_survey":
            path.write_bytes(survey_bytes(2))
        return found

    monkeypatch.setattr(atd_stub, during, disturbed)
    service = start_service()
    path = put_file("line.xtf", survey_bytes(1))
    eventually(lambda: bool(calls) and all_processed(service))
    assert counter(service, "files_quarantined") == 0
    (tmp_path / "away").rename(path)
    eventually(lambda: counter(service, "files_processed") == 1)
    eventually(lambda: len(compressor.received) == 3)
    assert [s.contact.atd_confidence for s in compressor.received] == [d.confidence for d in best_of(path)]
    assert service.health().state == "ok"


def test_a_file_name_that_is_not_utf_8_is_accepted(
    start_service, compressor, tmp_path, survey_bytes, put_file, counter
):
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


def test_contacts_are_sent_once_after_a_full_disk(
    start_service, compressor, put_file, survey_bytes, full_disk, counter
):
    service = start_service()
    with full_disk(service):
        put_file("line.xtf", survey_bytes(1))
        eventually(lambda: "disk is full" in service.health().detail)
        assert compressor.received == []
    eventually(lambda: len(compressor.received) == 3)
    eventually(lambda: service.health().state == "ok")
    eventually(lambda: counter(service, "files_processed") == 1)
