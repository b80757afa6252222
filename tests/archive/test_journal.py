"""Journal in a file: the state of an image, from the decisions on it."""

import pytest
from builders.records import decision_record

from sonarpost.archive import journal as module
from sonarpost.archive.journal import Criteria, Journal, JournalEntry

KEY = "sonarpost/v1/shore/contact/vessel-1/decision"


def entry(number, verdict, operator="op"):
    record = decision_record(f"d{number}", verdict=verdict, operator=operator, decided_utc_s=float(number))
    return JournalEntry(KEY, record, "vessel-1", record.vehicle_id, record.image_id, record.decision_id)


@pytest.fixture
def journal(tmp_path):
    journal = Journal(tmp_path)
    yield journal
    journal.close()


def state(journal):
    states = ("unreviewed", "mine_like", "not_mine_like", "unsure", "disputed")
    (found,) = [each for each in states if journal.page([KEY], Criteria(review=each), 0, 1)]
    return found


def test_the_newest_decisions_on_an_image_count_for_its_state(journal, monkeypatch):
    monkeypatch.setattr(module, "MAX_REVIEWED", 3)
    journal.append([entry(1, "mine_like", "ann"), entry(2, "not_mine_like", "ben")], 1.0)
    assert state(journal) == "disputed"
    journal.append([entry(3, "not_mine_like", "ben"), entry(4, "not_mine_like", "ben")], 1.0)
    assert state(journal) == "not_mine_like"


def test_decisions_on_an_image_that_arrive_together_are_read_once(journal, monkeypatch):
    read = []
    review_state = module.review_state
    monkeypatch.setattr(module, "review_state", lambda rows, where: read.append(len(rows)) or review_state(rows, where))
    journal.append([entry(number, "unsure") for number in range(100)], 1.0)
    assert read == [100]
    assert state(journal) == "unsure"
