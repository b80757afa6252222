"""c2: records of vessels are committed, stored in files and published; a vessel cannot send for another one."""

import hashlib
import json

import msgpack
import numpy as np
import pytest
from builders.common import eventually
from builders.record_samples import SAMPLES
from builders.records import decision_record, reconstructed_image
from builders.shore import relayed

from sonarpost import keys, wire
from sonarpost.export.contacts import mask_of_runs
from sonarpost.files import AtomicFiles
from sonarpost.messages import Contact, Pixels, ReceivedStatus, Relayed
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.sonar.image_files import read_image


@pytest.fixture
def image(texture):
    def make(image_id="AAAA", vessel="vessel-1", seed=1):
        pixels = Pixels.from_array(texture(seed=seed))
        missing = np.zeros((40, 60), dtype=np.bool_)
        missing[30:, :] = True
        return reconstructed_image(
            pixels,
            vessel_id=vessel,
            image_id=image_id,
            contact=Contact(contact_id="uuv-1/AAAA", vehicle_id="uuv-1", lat_deg=56.4, lon_deg=-5.6),
            complete=False,
            missing_fraction=0.25,
            missing_mask=np.packbits(missing).tobytes(),
            bytes_received=30,
        )

    return make


def send(relay, *records):
    relay.send(
        keys.shore_inbox(relay.platform.id), "c2", *(r if isinstance(r, Relayed) else relayed(r) for r in records)
    )


def files(folder):
    """All files but the database."""
    found = (str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    return sorted(name for name in found if not name.startswith("archive.db"))


def test_image_is_stored_and_published_as_plain_msgpack(begin, relay, image, out, watch, check_monitoring):
    seen = watch(keys.shore_image("vessel-1"))
    service = begin()
    sent = image()
    send(relay, sent)
    eventually(lambda: len(seen) == 1)
    shown = msgpack.unpackb(seen[0].payload.to_bytes())
    assert (shown["type"], shown["image_id"], shown["contact"]["lat_deg"]) == ("reconstructed_image", "AAAA", 56.4)
    shown_pixels = shown["pixels"]
    pixels = np.frombuffer(shown_pixels["data"], np.uint8).reshape(shown_pixels["height_px"], shown_pixels["width_px"])
    assert hashlib.sha256(pixels.tobytes()).hexdigest() == shown["pixels_sha256"]
    assert str(seen[0].encoding) == "application/msgpack;schema=sonarpost.reconstructed_image.v1"
    name = "uuv-1_20231114T221320Z_AAAA_v1"
    assert files(out) == [f"vessel-1/{name}.{kind}" for kind in ("json", "png", "tiff")]
    np.testing.assert_array_equal(read_image(out / "vessel-1" / f"{name}.tiff"), pixels)
    side = json.loads((out / "vessel-1" / f"{name}.json").read_text())
    assert side["pixels_sha256"] == sent.pixels_sha256
    assert mask_of_runs(side["missing_runs"], *pixels.shape) == sent.missing_mask
    eventually(lambda: relay.store.outbox_depth() == 0)
    eventually(lambda: service.health().counters == {"records_handled": 1, "images_stored": 1})
    check_monitoring(service)


def test_decision_is_stored_and_published(begin, relay, out, watch):
    seen = watch(keys.shore_decision("vessel-1"))
    begin()
    send(relay, decision_record("d1", remark="Stein oder Mine? \u2014 pr\u00fcfen", confidence=0.75))
    eventually(lambda: len(seen) == 1)
    assert msgpack.unpackb(seen[0].payload.to_bytes())["verdict"] == "mine_like"
    [kept] = (out / "vessel-1" / "decisions").iterdir()
    assert json.loads(kept.read_text()) == decision_record(
        "d1", remark="Stein oder Mine? \u2014 prüfen", confidence=0.75
    ).model_dump(mode="json")


def test_repeated_record_changes_no_file_and_is_published_again(begin, relay, image, out, watch):
    images, decisions = watch(keys.shore_image("vessel-1")), watch(keys.shore_decision("vessel-1"))
    service = begin()
    send(relay, image(), decision_record())
    eventually(lambda: len(decisions) == 1)
    before = {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in out.rglob("*.[!d]*") if p.is_file()}
    send(relay, image(), decision_record())
    eventually(lambda: (len(images), len(decisions)) == (2, 2))
    assert before == {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in out.rglob("*.[!d]*") if p.is_file()}
    eventually(lambda: service.health().counters.get("records_handled") == 4)
    counters = service.health().counters
    assert (counters["images_stored"], counters["images_repeated"]) == (1, 1)
    assert (counters["decisions_stored"], counters["decisions_repeated"]) == (1, 1)


def test_different_decision_with_the_same_identifier_is_refused(begin, relay, out, refused, watch):
    seen = watch(keys.shore_decision("vessel-1"))
    service = begin()
    send(relay, decision_record("d1"), decision_record("d1", verdict="not_mine_like"), decision_record("d2"))
    eventually(lambda: len(seen) == 2)
    assert [msgpack.unpackb(s.payload.to_bytes())["decision_id"] for s in seen] == ["d1", "d2"]
    [(_, reason)] = refused(service)
    assert "decision_id: got 'd1', expected an identifier that no other decision has" in reason
    assert [json.loads(p.read_text())["verdict"] for p in (out / "vessel-1" / "decisions").iterdir()] == [
        "mine_like"
    ] * 2


def test_identifiers_cannot_leave_the_folder(begin, relay, out, tmp_path):
    hostile = ["../../escaped", "/etc/cron.d/x", "..", ".", "a/b", "x" * 64, "%2e%2e%2f", "~root", "-rf", "CON:|<>?*"]
    hostile += ["$(x)`y`", "after"]
    service = begin()
    send(relay, *(decision_record(each) for each in hostile))
    eventually(lambda: service.health().counters.get("decisions_stored") == len(hostile))
    kept = list((out / "vessel-1" / "decisions").iterdir())
    assert sorted(json.loads(p.read_text())["decision_id"] for p in kept) == sorted(hostile)
    assert files(out) == sorted(f"vessel-1/decisions/{p.name}" for p in kept)
    assert {p.name for p in tmp_path.iterdir()} == {"out", "state"}


def test_identifiers_that_are_no_file_names_block_nothing(begin, relay, refused):
    """The console of a vessel can be a third-party program: an invalid record must not block later ones."""
    service = begin()
    for each in ("\u00fc" * 64, "\U0001f41f" * 64, "x" * 65, "a\x00b", "a\nb"):
        fields = msgpack.unpackb(wire.encode(decision_record())) | {"decision_id": each}
        send(relay, relayed(decision_record(), payload=msgpack.packb(fields)))
    send(relay, decision_record("after"))
    eventually(lambda: service.health().counters.get("decisions_stored", 0) + len(refused(service)) == 6)
    eventually(lambda: service.store.inbox_depth() == 0)
    assert service.health().state == "ok"


def test_envelopes_with_invalid_content_are_refused_with_the_reason(begin, relay, image, refused, out):
    other, decision = image(vessel="vessel-2"), decision_record()
    invalid = [
        (relayed(other, "vessel-1"), "vessel_id"),
        (relayed(decision, key="sonarpost/v1/vessel-1/health/relay"), "key"),
        (relayed(decision, key="../../../etc"), "key"),
        (relayed(decision, key=keys.image_reconstructed("vessel-1")), "type"),
        (relayed(decision, payload=wire.encode(decision)[:-3]), "payload"),
        (relayed(other), "vessel_id: got 'vessel-2', expected the vessel in the key"),
    ]
    service = begin()
    send(relay, *(each for each, _ in invalid), image())
    eventually(lambda: service.health().counters.get("images_stored") == 1)
    eventually(lambda: len(refused(relay)) == len(invalid))
    assert refused(service) == refused(relay)
    for (key, reason), (_, field) in zip(refused(relay), invalid, strict=True):
        assert key == keys.shore_inbox("vessel-1")
        assert field in reason
        assert "expected" in reason
    assert {p.parts[0] for p in (f.relative_to(out) for f in out.rglob("*.json"))} == {"vessel-1"}
    assert service.health().counters["records_refused"] == len(invalid)


def test_vessels_have_separate_folders(begin, runner, relay, image, out):
    begin()
    other = runner.peer("vessel-2", "relay")
    send(relay, image(seed=1), decision_record())
    send(other, image(vessel="vessel-2", seed=2), decision_record(vessel_id="vessel-2"))
    eventually(lambda: len(list(out.rglob("*.json"))) == 4)
    one, two = (json.loads(next((out / v).glob("*.json")).read_text()) for v in ("vessel-1", "vessel-2"))
    assert (one["vessel_id"], two["vessel_id"]) == ("vessel-1", "vessel-2")
    assert one["pixels_sha256"] != two["pixels_sha256"]


def test_record_committed_before_a_stop_is_handled_after_the_restart(begin, runner, platform, relay, image, out, watch):
    seen = watch(keys.shore_image("vessel-1"))
    idle = C2Service(platform("shore-1"), C2Config(out_dir=out))
    with idle.store.transaction() as tx:
        tx.accept(keys.shore_inbox("vessel-1"), wire.encode(relayed(image())))
    idle.store.close()
    assert not out.exists()
    service = begin()
    eventually(lambda: len(seen) == 1)
    assert len(files(out)) == 3
    runner.stop(service)
    again = begin()
    assert again.store.inbox_depth() == 0
    send(relay, image("BBBB"))
    eventually(lambda: len(seen) == 2)
    assert msgpack.unpackb(seen[1].payload.to_bytes())["image_id"] == "BBBB"


def test_records_stay_in_the_store_while_the_folder_is_not_writable(begin, relay, image, tmp_path, watch):
    seen = watch(keys.shore_image("vessel-1"))
    blocker = tmp_path / "disk"
    blocker.write_text("not mounted")
    service = begin(out_dir=blocker / "out")
    send(relay, image("AAAA"), image("BBBB"))
    eventually(lambda: service.health().state == "degraded")
    assert str(blocker) in service.health().detail
    eventually(lambda: relay.store.outbox_depth() == 0, what="acknowledgement of what is in the store")
    assert seen == []
    blocker.unlink()
    eventually(lambda: len(seen) == 2)
    assert [msgpack.unpackb(s.payload.to_bytes())["image_id"] for s in seen] == ["AAAA", "BBBB"]
    eventually(lambda: service.health().state == "ok")


def test_batch_of_records_is_flushed_once(begin, relay, image, out, watch, monkeypatch):
    flushes = []
    commit = AtomicFiles.commit
    monkeypatch.setattr(AtomicFiles, "commit", lambda files: (flushes.append(len(files)), commit(files)))
    seen = watch(keys.shore_image("vessel-1"))
    twice = image("0007", seed=7)
    send(relay, *(image(f"{n:04d}", seed=n) for n in range(40)), twice, decision_record("d1"), decision_record("d1"))
    service = begin()
    eventually(lambda: service.health().counters.get("records_handled") == 43)
    counters = service.health().counters
    assert (counters["images_stored"], counters["images_repeated"]) == (40, 1)
    assert (counters["decisions_stored"], counters["decisions_repeated"]) == (1, 1)
    assert len(files(out)) == 3 * 40 + 1
    assert len(flushes) < 30, "far fewer than records"
    eventually(lambda: len(seen) == 41)


def test_failed_batch_is_handled_again(begin, relay, image, out, monkeypatch):
    commit = AtomicFiles.commit
    failures = []

    def fails_twice(files):
        if len(failures) < 2:
            failures.append(len(files))
            files.drop_from(0)
            raise OSError(28, "No space left on device")
        commit(files)

    monkeypatch.setattr(AtomicFiles, "commit", fails_twice)
    send(relay, *(image(f"{n:04d}", seed=n) for n in range(20)))
    service = begin()
    eventually(lambda: service.health().counters.get("images_stored") == 20)
    assert len(failures) == 2
    assert len(files(out)) == 3 * 20
    eventually(lambda: service.health().counters["records_handled"] == 20)


def test_temporary_files_of_a_killed_c2_are_deleted_at_the_next_start(begin, relay, image, out):
    for folder in (out / "vessel-1", out / "vessel-1" / "decisions"):
        folder.mkdir(parents=True)
        (folder / ".uuv-1_20231114T221320Z_AAAA_v1.tiff.k2j3h4.tmp").write_bytes(b"half")
    begin()
    send(relay, image(), decision_record())
    eventually(lambda: [name.rpartition(".")[2] for name in files(out)] == ["json", "json", "png", "tiff"])


def test_status_of_a_vehicle_is_published_and_not_archived(begin, relay, watch, refused, out):
    samples = watch(keys.shore_status("vessel-1"))
    service = begin()
    record = SAMPLES["received-status"]
    foreign = record.model_copy(update={"vessel_id": "vessel-2"})
    for inner in (foreign, record):
        envelope = Relayed(
            vessel_id="vessel-1",
            key=keys.acoustic_status("vessel-1"),
            payload=wire.encode(inner),
            relayed_utc_s=1476262840.0,
        )
        relay.send(keys.shore_inbox("vessel-1"), "c2", envelope)
    eventually(lambda: len(samples) == 1)
    assert wire.decode(ReceivedStatus, samples[0].payload.to_bytes(), "status") == record
    eventually(lambda: len(refused(relay)) == 1)
    eventually(lambda: service.health().counters.get("statuses_published") == 1)
    assert [path for path in out.rglob("*") if path.suffix in (".json", ".tiff", ".png")] == []
