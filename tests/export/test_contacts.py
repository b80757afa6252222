"""Reading contacts from the c2 service's folder: latest version, latest decision, rejected files."""

import os

import pytest
from builders.common import eventually, running
from builders.exports import FIRST_UTC_S, decision, image, mission, store

from sonarpost import keys, wire
from sonarpost.errors import StoredFileError
from sonarpost.export.contacts import load_contacts
from sonarpost.export.live import LiveContacts
from sonarpost.messages import Relayed
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service


def test_latest_image_version_is_exported(tmp_path):
    versions = [image(version=v, missing_fraction=1 / v if v > 1 else 1.0) for v in (2, 10, 9)]
    found = load_contacts(store(tmp_path, *versions))
    (contact,) = found.contacts
    assert contact.image.version == 10  # compared as a number, not as text
    assert contact.image_path.name.endswith("_v10.png")
    assert found.problems == ()


def test_masks_are_not_kept_in_memory(tmp_path):
    partial = image(missing_mask=b"\x80" * 48, complete=False, missing_fraction=0.125)
    (stored,) = load_contacts(store(tmp_path, partial)).contacts
    assert (stored.image.missing_fraction, stored.image.missing_runs) == (0.125, "")
    live = LiveContacts().add(partial)
    assert (live.image.missing_fraction, live.image.missing_runs) == (0.125, "")


def test_latest_decision_is_exported_for_any_image_version(tmp_path):
    store(tmp_path, image(version=3))
    store(tmp_path, decision(decision_id="b", verdict="unsure", decided_utc_s=FIRST_UTC_S + 9, image_version=3))
    store(tmp_path, decision(decision_id="a", verdict="mine_like", decided_utc_s=FIRST_UTC_S + 10, image_version=1))
    (contact,) = load_contacts(tmp_path).contacts
    assert contact.review == "mine_like"
    assert [d.decision_id for d in contact.decisions] == ["b", "a"]


def test_repeated_image_identifier_is_another_contact(tmp_path):
    later = FIRST_UTC_S + 86400
    store(tmp_path, image(), image(first_frame_utc_s=later, last_frame_utc_s=later))
    store(tmp_path, decision(decision_id="old", verdict="not_mine_like", decided_utc_s=FIRST_UTC_S + 60))
    store(tmp_path, decision(decision_id="new", verdict="mine_like", decided_utc_s=later + 60))
    # With a wrong clock, neither of the two candidates matches.
    store(tmp_path, decision(decision_id="unmatched", decided_utc_s=5.0))
    found = load_contacts(tmp_path)
    assert [(c.review, len(c.decisions)) for c in found.contacts] == [("not_mine_like", 1), ("mine_like", 1)]
    assert len({c.uid for c in found.contacts}) == 2
    assert [d.decision_id for d in found.unmatched] == ["unmatched"]
    # A single candidate matches at any time.
    found = load_contacts(store(tmp_path / "one", image(), decision(decided_utc_s=5.0)))
    assert found.contacts[0].review == "mine_like"


def test_decision_matches_vessel_vehicle_and_image(tmp_path):
    others = {"vessel_id": "vessel-2"}, {"vehicle_id": "uuv-2"}, {"image_id": "00A8"}
    store(tmp_path, image(), *(decision(decision_id=f"d{n}", **other) for n, other in enumerate(others)))
    found = load_contacts(tmp_path)
    assert [c.review for c in found.contacts] == ["unreviewed"]
    assert len(found.unmatched) == 3


def test_contact_identifier_is_permanent(tmp_path):
    (before,) = load_contacts(store(tmp_path, image())).contacts
    (after,) = load_contacts(store(tmp_path, image(version=2, last_frame_utc_s=FIRST_UTC_S + 99), decision())).contacts
    assert before.uid == after.uid == "sonarpost.vessel-1.uuv-1.20161012T090001Z.00A7"


def test_incomplete_position_is_none_and_zero_is_valid(tmp_path):
    store(tmp_path / "a", image("0001", contact={"lat_deg": None}), image("0002", contact={"lon_deg": None}))
    found = load_contacts(store(tmp_path / "a", image("0003", contact={"lat_deg": 0.0, "lon_deg": 0.0})))
    assert [c.position for c in found.located] == [(0.0, 0.0)]
    assert len(found.unlocated) == 2
    # The path of the image is None without an image or its file.
    store(tmp_path / "b", image("0001", codec="", model=""), image("0002"))
    next(tmp_path.rglob("*_0002_v1.png")).unlink()
    assert [c.image_path for c in load_contacts(tmp_path / "b").contacts] == [None, None]


INVALID_FILES = {
    "invalid JSON": (b"{", "", "EOF"),
    "an array": (b"[]", "", "object"),
    "missing field": (b'{"type": "reconstructed_image", "v": 1}', "vessel_id", "a value"),
    "later schema version": (None, "v", "1"),
    "too large": (b" " * (1 << 22) + b"  ", "", "larger than 4194304 bytes"),
}


@pytest.mark.parametrize("kind", INVALID_FILES)
def test_invalid_file_is_reported_and_others_are_read(tmp_path, kind):
    store(tmp_path, image("0001"))
    text, field, expected = INVALID_FILES[kind]
    if text is None:
        text = next(tmp_path.rglob("*.json")).read_bytes().replace(b'"v": 1', b'"v": 2')
    bad = tmp_path / "vessel-1" / "bad.json"
    bad.write_bytes(text)
    found = load_contacts(tmp_path)
    assert len(found.contacts) == 1
    (problem,) = found.problems
    assert (problem.where, problem.field) == (str(bad), field)
    assert expected in str(problem)


def test_record_of_another_vessel_is_rejected(tmp_path):
    store(tmp_path, image(), decision())
    (tmp_path / "vessel-1").rename(tmp_path / "vessel-2")
    found = load_contacts(tmp_path)
    assert found.contacts == found.unmatched == ()
    assert [(p.field, p.value, p.expected) for p in found.problems] == [("vessel_id", "vessel-1", "vessel-2")] * 2


def test_unrelated_files_are_ignored_and_unreadable_ones_reported(tmp_path):
    with pytest.raises(StoredFileError, match=r"nowhere.*the out_dir of c2"):
        load_contacts(tmp_path / "nowhere")
    store(tmp_path, image())
    (tmp_path / "vessel-1" / ".half.json").write_text("{")
    (tmp_path / "readme.json").write_text("{")
    assert load_contacts(tmp_path).problems == ()
    (tmp_path / "vessel-1" / "folder.json").mkdir()
    os.mkfifo(tmp_path / "vessel-1" / "pipe.json")
    (tmp_path / "vessel-1" / "zero.json").symlink_to("/dev/zero")
    found = load_contacts(tmp_path)
    assert len(found.contacts) == 1
    names = ("folder.json", "pipe.json", "zero.json")
    expected = [(str(tmp_path / "vessel-1" / name), "not a regular file") for name in names]
    assert [(p.where, p.value) for p in found.problems] == expected


def test_all_kinds_of_contacts(tmp_path):
    found = load_contacts(mission(tmp_path))
    reviews = "unreviewed mine_like not_mine_like unsure unreviewed unreviewed"
    assert [c.review for c in found.contacts] == reviews.split()
    assert [c.name for c in found.unlocated] == ["uuv-1/0005"]


def test_c2_files_are_readable(tmp_path, platform):
    with running(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out"))) as service:
        records = {keys.image_reconstructed("vessel-1"): image(), keys.contact_decision("vessel-1"): decision()}
        for key, record in records.items():
            envelope = Relayed(vessel_id="vessel-1", key=key, payload=wire.encode(record), relayed_utc_s=1.0)
            service.session.put(keys.shore_inbox("vessel-1"), wire.encode(envelope))
        eventually(lambda: service.health().counters.get("records_handled") == 2)
    found = load_contacts(tmp_path / "out")
    assert found.problems == found.unmatched == ()
    assert [(c.name, c.decision) for c in found.contacts] == [("uuv-1/00A7", decision())]
    expected = store(tmp_path / "expected", image(), decision())

    def files(out_dir):
        return {p.relative_to(out_dir): p.read_bytes() for p in (out_dir / "vessel-1").rglob("*") if p.is_file()}

    assert files(expected) == files(tmp_path / "out")
