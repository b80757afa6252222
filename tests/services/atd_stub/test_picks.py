"""atd_stub: contacts of the picks beside a survey are sent once, and before the others that wait."""

from __future__ import annotations

import pytest
from builders.common import eventually

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.detection.picks import PICKED, picks_path
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.pending_contacts import PendingContacts
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.sonar.readers import read_survey

KEY = keys.contact_detected("uuv-1")


@pytest.fixture
def service(runner, platform, tmp_path, put_file, survey_bytes):
    """A service in whose folder is one survey without a contact above the threshold."""
    put_file("line.xtf", survey_bytes(1))
    config = AtdStubConfig(
        input_dir=tmp_path / "incoming", poll_s=0.02, settle_s=0.0, confidence_threshold=2.0, max_in_flight=0
    )
    return runner.start(AtdStubService(platform("uuv-1"), config))


def counters(service):
    return service.health().counters


def test_picks_are_sent_once_and_invalid_lines_reported(service, runner, put_file):
    compressor = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    survey = service.config.input_dir / "line.xtf"
    first = read_survey(survey).pings[0].number
    eventually(lambda: counters(service).get("files_processed") == 1)
    assert compressor.received == []
    text = f"# by anna\n{first + 5},port,3\nwrong\n{first + 5},port,999999\n"
    put_file(picks_path(survey).name, text.encode())
    eventually(lambda: len(compressor.received) == 1)
    (snippet,) = compressor.received
    assert (snippet.contact.ping_number, snippet.contact.channel) == (first + 5, "port")
    assert (snippet.contact.atd_class, snippet.contact.atd_confidence, snippet.source) == (PICKED, None, "line.xtf")
    assert (snippet.picture.height_px, snippet.picture.width_px) == (80, 140)
    eventually(lambda: counters(service).get("picks_ignored") == 2)
    put_file(picks_path(survey).name, (text + f"{first + 9},starboard,4\n").encode())
    eventually(lambda: len(compressor.received) == 2, what="the new pick alone")
    assert compressor.received[1].contact.channel == "starboard"
    assert counters(service) == {"files_processed": 1, "contacts_detected": 0, "contacts_picked": 2, "picks_ignored": 2}


def commit(store, effects):
    with store.transaction() as tx:
        effects.write(tx)


def snippet_of(contact_id, confidence):
    contact = Contact(contact_id=contact_id, vehicle_id="uuv-1", atd_confidence=confidence)
    return Snippet(contact=contact, picture=Pixels(data=b"\0" * 256, height_px=16, width_px=16, bits=8), source="a")


def test_picks_are_released_before_all_others_and_replace_those_that_wait(tmp_path):
    store = Store(tmp_path / "pending.db")
    pending = PendingContacts(store)
    effects = UnitOfWork()
    pending.add(effects, [snippet_of("a", 2.0), snippet_of("b", 0.2), snippet_of("c", None)])
    commit(store, effects)
    effects = UnitOfWork()
    pending.add_picks(effects, [snippet_of("p", None), snippet_of("b", 0.2)])
    commit(store, effects)
    payloads = pending.remove_first(UnitOfWork(), None)
    assert [wire.decode(Snippet, p, "test").contact.contact_id for p in payloads] == ["p", "b", "a", "c"]
    assert PendingContacts(store)._next_number == pending._next_number
    store.close()
