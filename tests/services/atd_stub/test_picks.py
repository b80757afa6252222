"""atd_stub: contacts of the picks beside a survey are sent once, and before the others that wait."""

from builders.common import eventually

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.detection.picks import PICKED, picks_path
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.release import PendingContacts
from sonarpost.sonar.readers import read_survey


def test_picks_are_sent_once_and_invalid_lines_reported(start_service, compressor, put_file, survey_bytes, counter):
    survey = put_file("line.xtf", survey_bytes(1))
    service = start_service(confidence_threshold=2.0)  # no contact of its own
    first = read_survey(survey).pings[0].number
    eventually(lambda: counter(service, "files_processed") == 1)
    assert compressor.received == []
    text = f"# by anna\n{first + 5},port,3\nwrong\n{first + 5},port,999999\n"
    put_file(picks_path(survey).name, text.encode())
    eventually(lambda: len(compressor.received) == 1)
    (snippet,) = compressor.received
    assert (snippet.contact.ping_number, snippet.contact.channel) == (first + 5, "port")
    assert (snippet.contact.atd_class, snippet.contact.atd_confidence, snippet.source) == (PICKED, None, "line.xtf")
    assert (snippet.pixels.height_px, snippet.pixels.width_px) == (80, 140)
    eventually(lambda: counter(service, "picks_ignored") == 2)
    put_file(picks_path(survey).name, (text + f"{first + 9},starboard,4\n").encode())
    eventually(lambda: len(compressor.received) == 2, what="the new pick alone")
    assert compressor.received[1].contact.channel == "starboard"
    assert service.health().counters == {
        "files_processed": 1,
        "contacts_detected": 0,
        "contacts_picked": 2,
        "picks_ignored": 2,
    }


def snippet_of(contact_id, confidence):
    contact = Contact(contact_id=contact_id, vehicle_id="uuv-1", atd_confidence=confidence)
    return Snippet(contact=contact, pixels=Pixels(data=b"\0" * 256, height_px=16, width_px=16, bits=8), source="a")


def test_picks_are_released_before_all_others_and_replace_those_that_wait(tmp_path):
    store = Store(tmp_path / "pending.db")
    pending = PendingContacts(store)

    def commit(add, *snippets):
        effects = UnitOfWork()
        add(effects, snippets)
        with store.transaction() as tx:
            effects.write(tx)

    commit(pending.add, snippet_of("a", 2.0), snippet_of("b", 0.2), snippet_of("c", None))
    commit(pending.add_picks, snippet_of("p", None), snippet_of("b", 0.2))
    names = lambda pending: [  # noqa: E731
        wire.decode(Snippet, p, "test").contact.contact_id for p in pending.remove_first(UnitOfWork(), None)
    ]
    assert names(pending) == ["p", "b", "a", "c"]
    restarted = PendingContacts(store)
    commit(restarted.add_picks, snippet_of("q", None))
    assert names(restarted) == ["p", "b", "q", "a", "c"]
    store.close()
