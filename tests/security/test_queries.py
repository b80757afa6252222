"""Which certificate may query the records that c2 has accepted."""

import msgpack
import pytest
import zenoh
from builders.common import WAIT_S, eventually, running
from builders.records import decision_record

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.messages import Comment, Relayed
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

pytestmark = pytest.mark.system

CONTACTS, STATES = keys.shore_contact_all(), keys.tasking_state_all()
CERTIFICATES = ("uuv-1", "vessel-1", "vessel-2", "console-1", "observer-1", "shore-2")
# What docs/explanation/security.md grants at the shore's router; at a vessel's router no certificate may query.
ALLOWED = {"console-1": {CONTACTS, STATES}, "observer-1": {CONTACTS, STATES}, "shore-2": {CONTACTS}}


@pytest.fixture
def c2(world, tmp_path, monkeypatch):
    # This test queries faster than clients may.
    monkeypatch.setattr("sonarpost.services.c2.queries.BURST", 1e9)
    platform = PlatformConfig(
        id="shore-1", router=(world.shore_local,), state_dir=tmp_path / "state", health_interval_s=1.0
    )
    with running(C2Service(platform, C2Config(out_dir=tmp_path / "out"))) as service:
        yield service


def received(session, selector):
    """Return the payloads of all replies to a query."""
    replies = session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=WAIT_S)
    return [msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]


def test_only_readers_of_the_shore_may_query(world, c2, shore_session):
    fields = {"vehicle_id": "uuv-1", "image_id": "AAAA", "image_version": 1, "author": "expert", "commented_utc_s": 2.0}
    comment = Comment(comment_id="a-1", vessel_id="vessel-1", verdict="unsure", **fields)
    decision = decision_record("d1")
    key = keys.contact_decision("vessel-1")
    envelope = Relayed(vessel_id="vessel-1", key=key, payload=wire.encode(decision), relayed_utc_s=1.0)
    shore_session.put(keys.shore_inbox("vessel-1"), wire.encode(envelope))
    shore_session.put(keys.tasking_comment("vessel-1"), wire.encode(comment))
    for selector in (CONTACTS, STATES):
        eventually(lambda selector=selector: len(received(shore_session, selector)) == 2, what=selector)

    granted: dict[str, set[str]] = {}
    for who in CERTIFICATES:
        for door in (world.shore_tls, world.vessel_tls):
            with world.open("nameless" if who == "shore-2" else who, endpoint=door) as session:
                allowed = ALLOWED.get(who, set()) if door == world.shore_tls else set()
                for selector in sorted(allowed):
                    # Routes are announced after the session is open.
                    eventually(
                        lambda selector=selector, session=session: bool(received(session, selector)), what=selector
                    )
                for selector in (CONTACTS, STATES, keys.shore_decision("vessel-1"), "sonarpost/v1/**"):
                    found = [record["type"] for record in received(session, selector) if "type" in record]
                    if found:
                        assert found[-1] == "page"
                        granted.setdefault(who, set()).add(selector)
    own = keys.shore_decision("vessel-1")
    assert granted == {who: {*selectors, own} for who, selectors in ALLOWED.items()}
    # A vessel neither queries its own decisions at the shore nor answers for c2.
    assert any(CONTACTS in denied or own in denied for _, _, denied in world.shore.denied())


def test_peers_cannot_answer_for_c2(world, c2, shore_session):
    asked: list[str] = []
    for who in ("vessel-1", "console-1", "observer-1", "nameless"):
        with world.open(who) as session:
            session.declare_queryable(CONTACTS, lambda query, who=who: (asked.append(who), query.drop()), complete=True)
            eventually(lambda: [r["type"] for r in received(shore_session, CONTACTS)] == ["page"])
            assert [r["type"] for r in received(shore_session, CONTACTS)] == ["page"]
    assert asked == []
