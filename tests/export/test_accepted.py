"""What c2 keeps, read back: latest version, latest decision, nothing guessed, nothing hidden by a bad file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from builders.common import eventually
from builders.exports import FIRST_UTC_S, decision, image, keep, mission

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.errors import StoredFileError
from sonarpost.export.accepted import load_accepted
from sonarpost.messages import Relayed
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service


def test_the_latest_version_of_a_picture_counts(tmp_path: Path) -> None:
    versions = [image(version=v, missing_fraction=1 / v if v > 1 else 1.0) for v in (2, 10, 9)]
    found = load_accepted(keep(tmp_path, *versions))
    (contact,) = found.contacts
    assert contact.image.version == 10  # as a number: by name, 9 would be the last
    assert contact.picture is not None
    assert contact.picture.name.endswith("_v10.png")
    assert found.problems == ()


def test_the_latest_decision_counts_whatever_version_it_saw(tmp_path: Path) -> None:
    keep(tmp_path, image(version=3))
    keep(tmp_path, decision(decision_id="b", verdict="unsure", decided_utc_s=FIRST_UTC_S + 9, image_version=3))
    keep(tmp_path, decision(decision_id="a", verdict="mine_like", decided_utc_s=FIRST_UTC_S + 10, image_version=1))
    (contact,) = load_accepted(tmp_path).contacts
    assert contact.review == "mine_like"
    assert [d.decision_id for d in contact.decisions] == ["b", "a"]


def test_an_identifier_that_came_again_is_another_contact(tmp_path: Path) -> None:
    later = FIRST_UTC_S + 86400
    keep(tmp_path, image(), image(first_frame_utc_s=later, last_frame_utc_s=later))
    keep(tmp_path, decision(decision_id="old", verdict="not_mine_like", decided_utc_s=FIRST_UTC_S + 60))
    keep(tmp_path, decision(decision_id="new", verdict="mine_like", decided_utc_s=later + 60))
    # A clock that was wrong: there are two candidates and nothing to choose by.
    keep(tmp_path, decision(decision_id="lost", decided_utc_s=5.0))
    found = load_accepted(tmp_path)
    assert [(c.review, len(c.decisions)) for c in found.contacts] == [("not_mine_like", 1), ("mine_like", 1)]
    assert len({c.uid for c in found.contacts}) == 2
    assert [d.decision_id for d in found.unmatched] == ["lost"]


def test_with_one_candidate_the_clock_is_not_asked(tmp_path: Path) -> None:
    found = load_accepted(keep(tmp_path, image(), decision(decided_utc_s=5.0)))
    assert found.contacts[0].review == "mine_like"


def test_a_decision_belongs_to_its_vessel_vehicle_and_image(tmp_path: Path) -> None:
    others = {"vessel_id": "vessel-2"}, {"vehicle_id": "uuv-2"}, {"image_id": "00A8"}
    keep(tmp_path, image(), *(decision(decision_id=f"d{n}", **other) for n, other in enumerate(others)))
    found = load_accepted(tmp_path)
    assert [c.review for c in found.contacts] == ["unreviewed"]
    assert len(found.unmatched) == 3


def test_a_contact_keeps_its_identifier_as_it_grows(tmp_path: Path) -> None:
    (before,) = load_accepted(keep(tmp_path, image())).contacts
    (after,) = load_accepted(keep(tmp_path, image(version=2, last_frame_utc_s=FIRST_UTC_S + 99), decision())).contacts
    assert before.uid == after.uid == "sonarpost.vessel-1.uuv-1.20161012T090001Z.00A7"


@pytest.mark.parametrize("half", [{"lat_deg": None}, {"lon_deg": None}])
def test_half_a_position_is_none(tmp_path: Path, half: dict[str, None]) -> None:
    found = load_accepted(keep(tmp_path, image(contact=half)))
    assert (len(found.located), len(found.unlocated)) == (0, 1)


def test_a_position_of_zero_is_one(tmp_path: Path) -> None:
    found = load_accepted(keep(tmp_path, image(contact={"lat_deg": 0.0, "lon_deg": 0.0})))
    assert found.located[0].position == (0.0, 0.0)


def test_a_picture_that_did_not_arrive_or_is_gone_is_none(tmp_path: Path) -> None:
    keep(tmp_path, image("0001", codec="", model=""), image("0002"))
    next(tmp_path.rglob("*_0002_v1.png")).unlink()
    assert [c.picture for c in load_accepted(tmp_path).contacts] == [None, None]


BAD = {
    "no JSON": (b"{", "", "EOF"),
    "an array": (b"[]", "", "object"),
    "a field missing": (b'{"type": "reconstructed_image", "v": 1}', "vessel_id", "a value"),
    "a later version": (None, "v", "1"),
    "too long": (b" " * (1 << 20) + b"  ", "size", "at most"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_named_and_hides_nothing(tmp_path: Path, kind: str) -> None:
    keep(tmp_path, image("0001"))
    text, field, expected = BAD[kind]
    if text is None:
        text = next(tmp_path.rglob("*.json")).read_bytes().replace(b'"v": 1', b'"v": 2')
    bad = tmp_path / "vessel-1" / "bad.json"
    bad.write_bytes(text)
    found = load_accepted(tmp_path)
    assert len(found.contacts) == 1
    (problem,) = found.problems
    assert (problem.where, problem.field) == (str(bad), field)
    assert expected in str(problem)


def test_no_vessel_speaks_for_another(tmp_path: Path) -> None:
    keep(tmp_path, image(), decision())
    (tmp_path / "vessel-1").rename(tmp_path / "vessel-2")
    found = load_accepted(tmp_path)
    assert found.contacts == found.unmatched == ()
    assert [(p.field, p.value, p.expected) for p in found.problems] == [("vessel_id", "vessel-1", "vessel-2")] * 2


def test_files_that_are_being_written_and_strange_files_are_left(tmp_path: Path) -> None:
    keep(tmp_path, image())
    (tmp_path / "vessel-1" / ".half.json").write_text("{")
    (tmp_path / "readme.json").write_text("{")
    assert load_accepted(tmp_path).problems == ()


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StoredFileError, match=r"nowhere.*the folder that c2 keeps"):
        load_accepted(tmp_path / "nowhere")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    keep(tmp_path, image())
    folder = tmp_path / "vessel-1" / "folder.json"
    folder.mkdir()
    found = load_accepted(tmp_path)
    assert len(found.contacts) == 1
    assert [(p.where, p.value) for p in found.problems] == [(str(folder), "Is a directory")]


def test_every_kind_of_contact(tmp_path: Path) -> None:
    found = load_accepted(mission(tmp_path))
    assert [c.review for c in found.contacts] == [
        "unreviewed",
        "mine_like",
        "not_mine_like",
        "unsure",
        "unreviewed",
        "unreviewed",
    ]
    assert [c.name for c in found.unlocated] == ["uuv-1/0005"]


def test_c2_writes_what_is_read(tmp_path: Path, platform: Callable[[str], PlatformConfig]) -> None:
    service = C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out"))
    assert service.start()
    try:
        said = {keys.image_reconstructed("vessel-1"): image(), keys.contact_decision("vessel-1"): decision()}
        for key, record in said.items():
            envelope = Relayed(vessel_id="vessel-1", key=key, payload=wire.encode(record), relayed_utc_s=1.0)
            service.session.put(keys.shore_inbox("vessel-1"), wire.encode(envelope))
        eventually(lambda: service.health().counters.get("records_handled") == 2)
    finally:
        service.stop()
    found = load_accepted(tmp_path / "out")
    assert found.problems == found.unmatched == ()
    assert [(c.name, c.decision) for c in found.contacts] == [("uuv-1/00A7", decision())]
    mine = keep(tmp_path / "mine", image(), decision())

    def vessels_files(out_dir: Path) -> dict[Path, bytes]:
        return {p.relative_to(out_dir): p.read_bytes() for p in (out_dir / "vessel-1").rglob("*") if p.is_file()}

    assert vessels_files(mine) == vessels_files(tmp_path / "out")
